"""Splats that other programs left in Blender as point attributes, told as the columns of a 3DGS PLY.

Known are the names of PLY files, which Blender's PLY importer keeps; those of Blender's own splats; and those of
gaussian-splatting-blender-addon.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

Array = np.ndarray

#: Type of an attribute -> (its value property, values an element).
_TYPES = {
    "FLOAT": ("value", 1),
    "FLOAT_VECTOR": ("vector", 3),
    "FLOAT_COLOR": ("color", 4),
    "FLOAT4": ("value", 4),
    "QUATERNION": ("value", 4),
}
#: Harmonics beyond the first of degree 3.
_REST = 15
_EDGE, _SHORTEST = 1e-6, 1e-9


def is_splats(data: bpy.types.ID) -> bool:
    """Whether a mesh or point cloud has the attributes of splats."""
    names = getattr(data, "attributes", {}).keys()
    kinds = (
        ("opacity", "scale_0", "rot_0"),
        ("scale", "rotation", "radiance:base"),
        ("log_opacity", "logscale", "sh0"),
    )
    return any(all(name in names for name in kind) for kind in kinds)


def read_splats(data: bpy.types.Mesh | bpy.types.PointCloud) -> dict[str, Array]:
    """Columns (n,) float32 of splats by their names in a PLY, x, y and z first; object space."""
    columns = {name: column for name, column in zip("xyz", _read(data, "position").T)}
    names = data.attributes.keys()
    if "scale_0" in names:
        own = [a.name for a in data.attributes if a.domain == "POINT" and a.data_type == "FLOAT"]
        return columns | {n: _read(data, n)[:, 0] for n in own if n not in columns and n.isidentifier()}
    if "radiance:base" in names:
        base = _read(data, "radiance:base")
        opacity = np.clip(base[:, 3], _EDGE, 1 - _EDGE)
        harmonics = [base[:, :3], *_numbered(data, "radiance:sh_", 0)]
        scale, rotation = np.log(np.maximum(_read(data, "scale"), _SHORTEST)), _read(data, "rotation")
        logit = np.log(opacity / (1 - opacity))
    else:
        harmonics = [_read(data, "sh0"), *_numbered(data, "sh", 1)]
        scale, logit = _read(data, "logscale"), _read(data, "log_opacity")[:, 0]
        rotation = np.concatenate([_read(data, "quatw"), _read(data, "quatxyz")], axis=1)
    columns |= {f"f_dc_{i}": harmonics[0][:, i] for i in range(3)}
    rest = harmonics[1:]
    columns |= {f"f_rest_{i * len(rest) + k}": h[:, i] for i in range(3) for k, h in enumerate(rest)}
    columns |= {"opacity": logit} | {f"scale_{i}": scale[:, i] for i in range(3)}
    return columns | {f"rot_{i}": rotation[:, i] for i in range(4)}


def write_ply(path: Path, columns: dict[str, Array]) -> None:
    """Write columns as a binary PLY of vertices."""
    count = len(columns["x"])
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    head += [f"property float {name}" for name in columns] + ["end_header\n"]
    table = np.stack([*columns.values()], axis=1).astype("<f4")
    path.write_bytes("\n".join(head).encode() + table.tobytes())


def _numbered(data: bpy.types.ID, prefix: str, first: int) -> list[Array]:
    """(n, 3) harmonics of the whole bands that are there."""
    found: list[Array] = []
    while len(found) < _REST and f"{prefix}{first + len(found)}" in data.attributes:
        found.append(_read(data, f"{prefix}{first + len(found)}")[:, :3])
    return found[: max(k for k in (0, 3, 8, _REST) if k <= len(found))]


def _read(data: bpy.types.ID, name: str) -> Array:
    """(n, width) float32 of a point attribute.

    Raises
    ------
    TypeError
        It is no numbers, or not one value a point.
    """
    attribute = data.attributes.get(name)
    if attribute is None or attribute.domain != "POINT" or attribute.data_type not in _TYPES:
        raise TypeError(f"attribute {name} is {'missing' if attribute is None else attribute.data_type}")
    prop, width = _TYPES[attribute.data_type]
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(prop, values)
    return values.reshape(-1, width)
