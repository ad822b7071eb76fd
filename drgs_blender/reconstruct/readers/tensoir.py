"""TensoIR's synthetic set: train_000/{metadata.json, rgba_LIGHT.png, albedo.png, normal.png}, test_000/...

Every view is there under several lights; a capture is that under one of them.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ...core.errors import AssetError
from .layout import Layout, Photograph, complain_of_missing, read_json, rigid
from .lens import Lens

#: The picture to learn from: the plain one, else TensoIR's usual training light, else the first.
_PREFERRED = ("rgba.png", "rgba_sunset.png", "rgba_sunset_000.png")


def sniff(path: Path) -> bool:
    """Whether `path` is a folder of folders with metadata."""
    return path.is_dir() and any((path / f"{split}_000" / "metadata.json").is_file() for split in ("train", "test"))


def read(path: Path, light: str | None = None) -> Layout:
    """Read the folder, the pictures of `light`, which only the test views may have. Raises AssetError."""
    folders = sorted(file.parent for file in path.glob("*_*/metadata.json") if _is_view(file.parent))
    chosen = _picture(folders)
    if light is not None:
        chosen = f"rgba_{light}.png"
        folders = [folder for folder in folders if (folder / chosen).is_file()] or folders
    missing = [f"{folder.name}/{chosen}" for folder in folders if not (folder / chosen).is_file()]
    complain_of_missing(str(path), missing, len(folders))
    photographs = []
    for folder in folders:
        file = folder / "metadata.json"
        data = read_json(file)
        try:
            numbers = [float(word) for word in str(data["cam_transform_mat"]).split(",")]
            angle, width, height = float(data["cam_angle_x"]), int(data["imw"]), int(data["imh"])
            matrix = np.reshape(numbers, (4, 4))
        except (KeyError, TypeError, ValueError) as error:
            raise AssetError(str(file), f"does not describe a camera ({error})", "Download it again") from error
        if not 0 < angle < math.pi or min(width, height) < 1:
            raise AssetError(str(file), "describes an impossible camera", "Download it again")
        focal = 0.5 * width / math.tan(angle / 2)
        lens = Lens(width, height, focal, focal, width / 2, height / 2)
        test = folder.name.startswith("test")
        photographs.append(Photograph(folder.name, folder / chosen, rigid(matrix, str(file)), lens, None, test))
    return Layout(photographs, upright=True)


def _is_view(folder: Path) -> bool:
    return folder.name.startswith(("train_", "test_"))


def _picture(folders: list[Path]) -> str:
    """The name of the picture that is read of every folder."""
    names = sorted(file.name for file in folders[0].glob("rgba*.png"))
    return next((name for name in _PREFERRED if name in names), names[0] if names else _PREFERRED[0])
