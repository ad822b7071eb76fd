"""Splats as point attributes in Blender, converted from and to the columns of a 3DGS PLY.

Read are the names of PLY files, which Blender's PLY importer keeps; those of Blender's own splats, which it has from
version 5.3 on; and those of gaussian-splatting-blender-addon. Written are Blender's own.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from . import assets

Array = np.ndarray

#: Harmonics beyond the first of degree 3.
_REST = 15
_EDGE, _SHORTEST = 1e-6, 1e-9
#: Blender's own splats: first harmonic and opacity; the others are numbered.
_BASE, _OTHERS = "radiance:base", "radiance:sh_"


def is_splats(data: bpy.types.ID) -> bool:
    """Whether a mesh or point cloud has the attributes of splats."""
    names = getattr(data, "attributes", {}).keys()
    kinds = (
        ("opacity", "scale_0", "rot_0"),
        ("scale", "rotation", _BASE),
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
    if _BASE in names:
        base = _read(data, _BASE)
        opacity = np.clip(base[:, 3], _EDGE, 1 - _EDGE)
        harmonics = [base[:, :3], *_numbered(data, _OTHERS, 0)]
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


def read_ply(path: Path) -> dict[str, Array]:
    """Columns of a PLY as ``drgs`` and `write_ply` write them."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property float ")]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T))


def can_write() -> bool:
    """Whether this Blender makes point clouds of meshes, and so for scripts."""
    return "POINTCLOUD" in bpy.ops.object.convert.get_rna_type().properties["target"].enum_items


def new_object(context: bpy.types.Context, name: str, columns: dict[str, Array]) -> bpy.types.Object:
    """A point cloud of Blender's own splats, selected; before version 5.3, of points with the same attributes."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(columns["x"]))

    def beside(*names: str) -> Array:
        return np.stack([columns[n] for n in names], axis=1).astype(np.float32)

    opacity = 1 / (1 + np.exp(-columns["opacity"].astype(np.float64)))
    types = mesh.attributes.bl_rna.functions["new"].parameters["type"].enum_items
    _write(mesh, "position", "FLOAT_VECTOR", beside("x", "y", "z"))
    _write(mesh, "scale", "FLOAT_VECTOR", np.exp(beside("scale_0", "scale_1", "scale_2")))
    _write(mesh, "rotation", "QUATERNION", beside("rot_0", "rot_1", "rot_2", "rot_3"))
    base = np.column_stack([beside("f_dc_0", "f_dc_1", "f_dc_2"), opacity])
    _write(mesh, _BASE, "FLOAT4" if "FLOAT4" in types else "FLOAT_COLOR", base)
    rest = sum(n.startswith("f_rest_") for n in columns) // 3
    for k in range(rest):
        _write(mesh, f"{_OTHERS}{k}", "FLOAT_VECTOR", beside(*(f"f_rest_{i * rest + k}" for i in range(3))))
    obj = bpy.data.objects.new(name, mesh)
    assets.collection(context).objects.link(obj)
    for selected in context.selected_objects:
        selected.select_set(False)
    obj.select_set(True)
    context.view_layer.objects.active = obj
    bpy.ops.object.convert(target="POINTCLOUD")  # a script cannot give a point cloud its points before version 5.2
    if not mesh.users:
        bpy.data.meshes.remove(mesh)
    if hasattr(obj.data, "type"):
        obj.data.type = "GAUSSIAN_SPLAT"
    return obj


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
    if attribute is None or attribute.domain != "POINT":
        raise TypeError(f"attribute {name} is {'missing' if attribute is None else 'not one value a point'}")
    prop, width = _layout(attribute)
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(prop, values)
    return values.reshape(-1, width)


def _write(data: bpy.types.ID, name: str, kind: str, values: Array) -> None:
    attribute = data.attributes.get(name) or data.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(_layout(attribute)[0], np.ascontiguousarray(values, np.float32).ravel())


def _layout(attribute: bpy.types.Attribute) -> tuple[str, int]:
    """(property, numbers) of an element, as Blender describes the type: new versions bring new types."""
    element = attribute.bl_rna.properties["data"].fixed_type
    for name in ("value", "vector", "color"):
        found = element.properties.get(name)
        if found is not None and found.type == "FLOAT":
            return name, found.array_length or 1
    raise TypeError(f"attribute {attribute.name} is {attribute.data_type}")
