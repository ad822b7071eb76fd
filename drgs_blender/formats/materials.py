"""NeRO's material arrays: ``albedo.npy metallic.npy roughness.npy`` in one folder, one row a vertex."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.color import srgb_to_linear
from ..core.errors import AssetError
from .files import MaterialsFile

Array = np.ndarray

_WIDTHS = {"albedo": 3, "metallic": 1, "roughness": 1}


def is_nero_folder(path: Path) -> bool:
    """Whether `path` is such a folder."""
    return path.is_dir() and all((path / f"{name}.npy").is_file() for name in _WIDTHS)


def read_nero_materials(path: Path) -> MaterialsFile:
    """Read the folder `path` (or that of any of its files). All three are sRGB-encoded there, decoded here.

    Raises
    ------
    AssetError
        A file is missing, no array of numbers, or of another length than the others.
    """
    folder = path if path.is_dir() else path.parent
    arrays: dict[str, Array] = {}
    for name, width in _WIDTHS.items():
        file = folder / f"{name}.npy"
        try:
            values = np.load(file, allow_pickle=False, mmap_mode="r")
        except (OSError, ValueError, EOFError, SyntaxError) as error:
            raise AssetError(str(file), f"cannot be read ({error})", "Export the materials again") from error
        if values.dtype.kind != "f" or values.ndim not in (1, 2) or values.size != len(values) * width:
            raise AssetError(str(file), f"is {values.dtype} {values.shape}, expected floats (n, {width})")
        if not np.isfinite(values).all():
            raise AssetError(str(file), "has values that are NaN or infinite", "Export the materials again")
        arrays[name] = srgb_to_linear(np.clip(np.asarray(values, np.float32).reshape(-1, width), 0.0, 1.0))
    if len({len(a) for a in arrays.values()}) != 1:
        counts = ", ".join(f"{len(a)} of {name}" for name, a in arrays.items())
        raise AssetError(str(folder), f"has arrays of different lengths: {counts}")
    return MaterialsFile(
        arrays["albedo"], arrays["roughness"][:, 0], arrays["metallic"][:, 0], "NeRO", ["decoded from sRGB"]
    )
