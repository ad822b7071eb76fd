"""LLFF: poses_bounds.npy beside a folder of images, in the order of their names.

A row is a 3x5 matrix and two depths. Its columns are where the camera's down, right and backward axes point, where the
camera stands, and (height, width, focal length).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.errors import AssetError
from .layout import PICTURES, Layout, Photograph, find_mask, rigid
from .lens import Lens

_FILE = "poses_bounds.npy"
_FOLDERS = ("images", "images_2", "images_4", "images_8")


def sniff(path: Path) -> bool:
    """Whether `path` is such a file, or a folder with it."""
    return (path.name == _FILE and path.is_file()) or (path / _FILE).is_file()


def read(path: Path) -> Layout:
    """Read the folder. Raises AssetError."""
    file = path if path.is_file() else path / _FILE
    folder = file.parent
    try:
        rows = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise AssetError(str(file), f"is no array of numbers ({error})", "Export it again") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f" or not np.isfinite(rows).all():
        raise AssetError(str(file), f"has shape {rows.shape}, not (images, 17) finite numbers", "Export it again")
    listed = {name: _pictures(folder / name) for name in _FOLDERS}
    fitting = [images for images in listed.values() if len(images) == len(rows)]
    if not fitting:
        counts = ", ".join(f"{name}: {len(images)}" for name, images in listed.items() if images) or "none"
        problem = f"has {len(rows)} cameras, but the folders of images have other numbers ({counts})"
        raise AssetError(str(file), problem, "Restore the images: they are matched by the order of their names")
    photographs = []
    for row, image in zip(rows.astype(np.float64), fitting[0]):
        columns = row[:15].reshape(3, 5)
        down, right, back, centre, (height, width, focal) = columns.T
        matrix = rigid(np.column_stack([right, -down, back, centre]), f"{file}, {image.name}")
        if min(height, width, focal) <= 0:
            raise AssetError(f"{file}, {image.name}", "has no size or focal length", "Export it again")
        lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2)
        photographs.append(Photograph(image.stem, image, matrix, lens, find_mask(folder / "masks", image)))
    return Layout(photographs, upright=False)


def _pictures(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("*") if file.suffix in PICTURES) if folder.is_dir() else []
