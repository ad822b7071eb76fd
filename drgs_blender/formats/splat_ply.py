"""Splats written as the PLY of 3D Gaussian Splatting, which every viewer of splats reads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..core.asset.archive import replace_file
from .gaussian_ply import OWN_ALBEDO, OWN_NORMAL, OWN_NUMBERS
from .splats import SplatMaterials, Splats, normals, writable

Array = np.ndarray

#: Splats turned into rows at once; bounds the memory.
_BLOCK = 1 << 16
#: Opacities of 0 and 1 have no finite logit.
_EDGE = 1e-6


def write_splat_ply(path: Path, splats: Splats, materials: bool = False) -> None:
    """Write `splats` to `path`, in the axes they have. Raises AssetError or WriteError.

    With `materials`, normals are not 0, and albedo, roughness and metallic follow what 3DGS has.
    """
    splats = writable(splats, str(path))
    replace_file(path, _parts(splats, splats.materials if materials else None))


def _parts(splats: Splats, materials: SplatMaterials | None) -> Iterator[bytes | memoryview]:
    n, k = splats.sh.shape[:2]
    names = ["x", "y", "z", *OWN_NORMAL, *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    known = len(names)
    if materials is not None:
        names += [*OWN_ALBEDO, *OWN_NUMBERS]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in names]
    yield "\n".join([*header, "end_header\n"]).encode()
    for start in range(0, n, _BLOCK):
        rows = slice(start, min(start + _BLOCK, n))
        table = np.zeros((rows.stop - start, len(names)), "<f4")
        table[:, :3] = splats.centre[rows]
        table[:, 6:9] = splats.sh[rows, 0]
        table[:, 9 : 9 + 3 * (k - 1)] = splats.sh[rows, 1:].transpose(0, 2, 1).reshape(len(table), -1)  # R, G, B
        opacity = np.clip(splats.opacity[rows].astype(np.float64), _EDGE, 1 - _EDGE)
        table[:, known - 8] = np.log(opacity / (1 - opacity))
        table[:, known - 7 : known - 4] = np.log(splats.scale[rows])
        table[:, known - 4 : known] = splats.rotation[rows]
        if materials is not None:
            table[:, 3:6] = normals(splats.rotation[rows])
            table[:, known:] = np.column_stack([array[rows] for array in materials.arrays()])
        yield table.data.cast("B")
