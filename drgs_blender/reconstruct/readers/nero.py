"""NeRO's GlossySynthetic: k.png, k-depth.png, k-camera.pkl (world-to-camera pose, intrinsics).

The cameras are pickles. Only the few names that a numpy array needs are ever resolved, so a file can make arrays and
nothing else. Far depths are the background. The scenes are Y up. Of the 128 views of GlossySynthetic, 32 are left out
by the published split; of others every eighth.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from ...core.color import to_unit
from ...core.errors import AssetError
from ...formats.axes import UP_AXES
from ...formats.images import image_size, load_image
from .layout import OPENCV_TO_BLENDER, Layout, Photograph, complain_of_missing, invert, rigid
from .lens import Lens

Array = np.ndarray

#: Views left out of 128 by NeRO's `synthetic_split_128.pkl`, as GS-ROR's `nero2blender.py` lists them.
SPLIT_OF = 128
SPLIT = frozenset(
    (0, 2, 3, 4, 5, 7, 11, 14, 19, 29, 30, 31, 33, 49, 56, 57, 59, 61, 66, 68, 71, 73, 75, 91, 93, 95, 109, 110, 111,
     113, 120, 127)
)  # fmt: skip
_TEST_EVERY = 8
#: 16-bit depths end at 15 units, and what is farther than 14.5 is background (NeRO's dataset/database.py).
_BACKGROUND = 14.5 / 15.0
#: What a pickle of arrays may name.
_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("_codecs", "encode"),
}
_LARGEST = 1 << 20


class _Arrays(pickle.Unpickler):
    """Resolves nothing but what arrays are made of."""

    def find_class(self, module: str, name: str) -> Any:
        """The object of a name that is allowed."""
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which no camera needs")
        return super().find_class(module.replace("numpy.core", "numpy._core") if _NEW else module, name)


_NEW = int(np.__version__.split(".")[0]) >= 2


def sniff(path: Path) -> bool:
    """Whether `path` is a folder of numbered cameras."""
    return path.is_dir() and any(file.name[: -len("-camera.pkl")].isdigit() for file in path.glob("*-camera.pkl"))


def read(path: Path) -> Layout:
    """Read the folder. Raises AssetError."""
    numbers = sorted(int(n) for file in path.glob("*-camera.pkl") if (n := file.name[: -len("-camera.pkl")]).isdigit())
    missing = [f"{k}.png" for k in numbers if not (path / f"{k}.png").is_file()]
    complain_of_missing(str(path), missing, len(numbers))
    turn = np.eye(4)
    turn[:3, :3] = UP_AXES["y"]
    photographs = []
    published = numbers == list(range(SPLIT_OF))
    for k in numbers:
        file = path / f"{k}-camera.pkl"
        to_camera, intrinsics = _camera(file)
        width, height = image_size(path / f"{k}.png")
        fx, fy, cx, cy = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        lens = Lens(width, height, float(fx), float(fy), float(cx), float(cy))
        matrix = turn @ invert(rigid(to_camera, str(file))) @ OPENCV_TO_BLENDER
        depth = path / f"{k}-depth.png"
        mask = depth if depth.is_file() else None
        test = k in SPLIT if published else k % _TEST_EVERY == 0
        photographs.append(Photograph(f"{k:03d}", path / f"{k}.png", matrix, lens, mask, test))
    return Layout(photographs, upright=True, decode_mask=_nearer_than_background)


def _camera(path: Path) -> tuple[Array, Array]:
    """((3, 4) world-to-camera with OpenCV's axes, (3, 3) intrinsics)."""
    try:
        if path.stat().st_size > _LARGEST:
            raise AssetError(str(path), f"has {path.stat().st_size} bytes, a camera has some hundred")
        pose, intrinsics = _Arrays(io.BytesIO(path.read_bytes()), encoding="latin1").load()
        pose, intrinsics = np.asarray(pose, np.float64), np.asarray(intrinsics, np.float64)
    except AssetError:
        raise
    except Exception as error:  # a damaged pickle raises almost anything
        raise AssetError(str(path), f"is no camera ({error})", "Download the data set again") from error
    if pose.shape != (3, 4) or intrinsics.shape != (3, 3) or not np.isfinite(intrinsics).all():
        raise AssetError(str(path), f"holds arrays of shape {pose.shape}, {intrinsics.shape}, not (3, 4), (3, 3)")
    return pose, intrinsics


def _nearer_than_background(path: Path) -> Array:
    """(h, w) float32: 1 where a 16-bit depth is that of the object."""
    depth = load_image(path)[..., 0]
    return (to_unit(depth) < _BACKGROUND).astype(np.float32)
