"""Blender meshes to and from numpy arrays, all through bulk access."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Generic, TypeVar

import bpy
import numpy as np

from ..drgs_blender.core.arrays import shareable
from ..drgs_blender.core.asset import MATERIAL_CHANNELS, Mesh

Array = np.ndarray

#: Material channel -> (attribute data type, its value property, values an element).
ATTRIBUTES = {
    name: ("FLOAT_COLOR", "color", 4) if channel.width == 3 else ("FLOAT", "value", 1)
    for name, channel in MATERIAL_CHANNELS.items()
}
#: Types of attributes that brushes can paint.
COLOURS = ("FLOAT_COLOR", "BYTE_COLOR")
#: Attribute with the asset's vertex that each vertex is, and a checksum of that number.
SOURCE_VERTEX = "drgs_vertex"
#: Numbers of vertices that a float32 says exactly.
_NUMBERS = 1 << 24
#: Types of attributes besides colours that can be masks.
MASKS = {"BOOLEAN": bool, "FLOAT": np.float32}
T = TypeVar("T")


class OfArrays(Generic[T]):
    """What is made of arrays that nobody changes, kept for the last `most` of them by their identity."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._known: dict[int, tuple[Array, T]] = {}

    def get(self, array: Array, make: Callable[[], T]) -> T:
        """What was made of `array`, else what `make` makes."""
        known = self._known.pop(id(array), None)
        if known is None or known[0] is not array:
            known = array, make()
        self._known[id(array)] = known
        while len(self._known) > self._most:
            del self._known[next(iter(self._known))]
        return known[1]

    def clear(self) -> None:
        """Drop everything."""
        self._known.clear()


#: Keys of the meshes of assets, by their faces.
_keys: OfArrays[int] = OfArrays(8)


def new_mesh(name: str, source: Mesh) -> bpy.types.Mesh:
    """A Blender mesh with exactly the triangles of `source` in their order, smooth, with material attributes."""
    mesh = bpy.data.meshes.new(name)
    faces = len(source.faces)
    mesh.vertices.add(len(source.vertices))
    if len(source.vertices):  # else Blender has no such attribute
        mesh.attributes["position"].data.foreach_set("vector", source.vertices.ravel())
    mesh.loops.add(3 * faces)
    mesh.loops.foreach_set("vertex_index", source.faces.ravel())
    mesh.polygons.add(faces)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * faces, 3, dtype=np.int32))
    for channel in source.channels:
        write_channel(mesh, channel, getattr(source, channel))
    for group, members in source.groups.items():
        write_group(mesh, group, members)
    write_source_vertices(mesh, source)
    mesh.attributes.default_color_name = mesh.attributes.active_color_name = "albedo"
    mesh.update(calc_edges=True)
    mesh.shade_smooth()
    return mesh


def write_group(mesh: bpy.types.Mesh, name: str, members: Array) -> None:
    """Say by an attribute which vertices of a mesh are the `members`, (k,) int, of a group."""
    mask = np.zeros(len(mesh.vertices), bool)
    mask[members] = True
    mesh.attributes.new(name, "BOOLEAN", "POINT").data.foreach_set("value", mask)


def write_source_vertices(mesh: bpy.types.Mesh, rest: Mesh, rows: Array | None = None) -> None:
    """Have every vertex know which of its asset's it is, whatever is deleted, duplicated or reordered later.

    Parameters
    ----------
    mesh : bpy.types.Mesh
    rest : Mesh
        Of the asset.
    rows : (n,) int32 array, optional
        The asset's vertex of each, -1: none; by default the asset's in its order.
    """
    if (old := mesh.attributes.get(SOURCE_VERTEX)) is not None:
        mesh.attributes.remove(old)
    if len(mesh.vertices) > _NUMBERS:  # they know no number, so their faces must stay as they are
        return
    rows = np.arange(len(mesh.vertices), dtype=np.int32) if rows is None else rows
    attribute = mesh.attributes.new(SOURCE_VERTEX, "FLOAT2", "POINT")
    if not mesh.uv_layers and hasattr(mesh.uv_layers, "active_render"):
        mesh.uv_layers.active_render = None  # Blender 5.2 takes the first FLOAT2 for the UV map that renders
    attribute.data.foreach_set("vector", np.column_stack((rows, _checksum(rows, rest))).astype(np.float32).ravel())


def read_source_vertices(mesh: bpy.types.Mesh, rest: Mesh) -> Array | None:
    """(n,) int32 vertex of the asset's mesh `rest` that each is, -1 of new ones; None where the mesh does not know.

    Vertices of another asset, which was joined to this one, are new ones, too.

    Where Blender makes vertices between others (subdivided edges, cuts), it blends their numbers, so that checksums are
    wrong; integers it would copy.
    """
    attribute = mesh.attributes.get(SOURCE_VERTEX)
    if attribute is None or (attribute.data_type, attribute.domain) != ("FLOAT2", "POINT"):
        return None
    values = np.empty(2 * len(mesh.vertices), np.float32)
    attribute.data.foreach_get("vector", values)
    number, sums = values[::2], values[1::2]
    whole = (number >= 0) & (number < _NUMBERS) & (number == np.floor(number))
    rows = np.where(whole, number, 0).astype(np.int32)
    return np.where(whole & (_checksum(rows, rest) == sums), rows, -1).astype(np.int32)


def source_rows(mesh: bpy.types.Mesh, rest: Mesh) -> Array | None:
    """(n,) int32 asset's vertex of each vertex of a mesh, -1 of new ones; None where that is not known.

    A mesh that knows nothing, as those of older files, has the vertices of the asset if it has as many.

    Parameters
    ----------
    mesh : bpy.types.Mesh
    rest : Mesh
        Of the asset.
    """
    rows, count = read_source_vertices(mesh, rest), len(rest.vertices)
    if rows is not None and (rows < count).all() and (rows >= 0).any():
        return rows
    return np.arange(count, dtype=np.int32) if len(mesh.vertices) == count else None


def _key(rest: Mesh) -> int:
    """A number of the mesh of an asset."""
    crc, contiguous = zlib.crc32, np.ascontiguousarray
    return _keys.get(rest.faces, lambda: crc(contiguous(rest.vertices).data, crc(contiguous(rest.faces).data)))


def _checksum(rows: Array, rest: Mesh) -> Array:
    """(n,) float32 in [1, 2): bits of the finaliser of MurmurHash3, so that those of a mean are not the mean.

    They are others for the vertices of every asset.
    """
    x = rows.astype(np.uint32) + np.uint32(_key(rest))
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    return ((x >> np.uint32(9)) | np.uint32(0x3F800000)).view(np.float32)


def write_channel(mesh: bpy.types.Mesh, channel: str, values: Array) -> None:
    """Set the point attribute of a material channel, (n, 3) or (n,) float32."""
    kind, prop, width = ATTRIBUTES[channel]
    attribute = mesh.attributes.get(channel)
    if attribute is not None and (attribute.data_type, attribute.domain) != (kind, "POINT"):
        mesh.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = mesh.attributes.new(channel, kind, "POINT")
    if width == 4:
        values = np.column_stack((values, np.ones(len(values), np.float32)))
    attribute.data.foreach_set(prop, np.ascontiguousarray(values, np.float32).ravel())
    mesh.update_tag()


def restore_channels(mesh: bpy.types.Mesh, source: Mesh) -> None:
    """Set the point attributes of all material channels to those of `source`; those that it lacks go."""
    for channel in MATERIAL_CHANNELS:
        attribute = mesh.attributes.get(channel)
        if (values := getattr(source, channel)) is not None:
            write_channel(mesh, channel, values)
        elif attribute is not None:
            mesh.attributes.remove(attribute)
            mesh.update_tag()


def make_paintable(mesh: bpy.types.Mesh, channel: str, values: Array) -> None:
    """Set a material channel, (n, 3) or (n,) float32, as the active colour attribute, which brushes can paint."""
    attribute = mesh.attributes.get(channel)
    if attribute is None or attribute.data_type not in COLOURS or attribute.domain != "POINT":
        if attribute is not None:
            mesh.attributes.remove(attribute)
        attribute = mesh.attributes.new(channel, "FLOAT_COLOR", "POINT")
        colours = np.ones((len(values), 4), np.float32)
        colours[:, :3] = values if values.ndim == 2 else values[:, None]
        attribute.data.foreach_set("color", colours.ravel())
    mesh.attributes.active_color_name = channel
    mesh.update_tag()


def read_channel(mesh: bpy.types.Mesh, channel: str) -> Array | None:
    """The point attribute of a material channel, linear and within its limits; None where there is none.

    What is no number, or infinite, is NaN.

    Of a number that is stored as a colour, as brushes need it, the mean of red, green and blue.

    Raises
    ------
    TypeError
        The attribute exists with a domain or type that is no value per vertex.
    """
    attribute = mesh.attributes.get(channel)
    if attribute is None:
        return None
    kind, _, width = ATTRIBUTES[channel]
    painted = attribute.data_type in COLOURS
    if attribute.domain != "POINT" or not (painted or attribute.data_type == kind):
        raise TypeError(f"{attribute.data_type} on {attribute.domain}, expected {kind} on POINT")
    values = np.empty(len(mesh.vertices) * (4 if painted else 1), np.float32)
    attribute.data.foreach_get("color" if painted else "value", values)
    if painted:
        colours = values.reshape(-1, 4)
        values = np.empty((len(colours), 3), np.float32)
        for i in range(3):  # several times faster than all at once
            values[:, i] = colours[:, i]
        if width == 1:
            values = _brightness(values)
    values[np.isinf(values)] = np.nan
    return np.clip(values, 0, MATERIAL_CHANNELS[channel].limit, out=values)


def _brightness(colours: Array) -> Array:
    """(n,) float32 means of red, green and blue; of a grey its very number, so that what nobody painted stays."""
    return colours.mean(axis=1, dtype=np.float64).astype(np.float32)


def is_mask(attribute: bpy.types.Attribute) -> bool:
    """Whether an attribute has a number for each vertex that says how much of something it gets."""
    return attribute.domain == "POINT" and attribute.data_type in (*MASKS, *COLOURS)


def mask_names(obj: bpy.types.Object, typed: str) -> list[str]:
    """What `read_mask` can read of a mesh object and has `typed` in its name."""
    attributes = (a.name for a in obj.data.attributes if is_mask(a) and not a.name.startswith("."))
    return [name for name in (*(g.name for g in obj.vertex_groups), *attributes) if typed.lower() in name.lower()]


def read_mask(obj: bpy.types.Object, mesh: bpy.types.Mesh, name: str) -> Array | None:
    """(n,) float32: the vertex group `name` of `obj`, or the attribute of its evaluated `mesh`; None where neither is.

    Of a colour the mean of red, green and blue.
    """
    group, attribute = obj.vertex_groups.get(name), mesh.attributes.get(name)
    if group is not None:
        own = obj.original.data  # an evaluated mesh need not have the weights; one of other vertices has its own
        return group_weights(own if len(own.vertices) == len(mesh.vertices) else mesh, group.index)
    if attribute is None or not is_mask(attribute):
        return None
    if attribute.data_type in COLOURS:
        colours = np.empty(len(mesh.vertices) * 4, np.float32)
        attribute.data.foreach_get("color", colours)
        return _brightness(colours.reshape(-1, 4)[:, :3])
    values = np.empty(len(mesh.vertices), MASKS[attribute.data_type])
    attribute.data.foreach_get("value", values)
    return values.astype(np.float32)


def group_weights(mesh: bpy.types.Mesh, index: int) -> Array:
    """(n,) float32 weights in the vertex group of number `index`."""
    weights = np.zeros(len(mesh.vertices), np.float32)
    for vertex in mesh.vertices:
        for group in vertex.groups:
            if group.group == index:
                weights[vertex.index] = group.weight
    return weights


def read_vertices(mesh: bpy.types.Mesh) -> Array:
    """(n, 3) float32 positions in object space, which the engine can map."""
    vertices = shareable((len(mesh.vertices), 3), np.float32)
    if len(vertices):
        mesh.attributes["position"].data.foreach_get("vector", vertices.ravel())
    return vertices


def read_triangles(mesh: bpy.types.Mesh) -> Array | None:
    """(m, 3) int32 vertices of every polygon, or None where one is no triangle."""
    if len(mesh.loops) != 3 * len(mesh.polygons):
        return None  # none has fewer corners than three, so none may have more; they come one after the other
    return read_corner_vertices(mesh).reshape(-1, 3)


def loop_triangles(mesh: bpy.types.Mesh) -> Array:
    """(m, 3) int32 vertices of the triangles that polygons are cut into."""
    mesh.calc_loop_triangles()
    triangles = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles)
    return triangles.reshape(-1, 3)


def read_edges(mesh: bpy.types.Mesh) -> Array:
    """(k, 2) int32 vertices of the edges that polygons use."""
    used = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("edge_index", used)
    edges = np.empty(2 * len(mesh.edges), np.int32)
    mesh.edges.foreach_get("vertices", edges)
    return edges.reshape(-1, 2)[np.unique(used)]


def read_corner_normals(mesh: bpy.types.Mesh) -> Array:
    """(l, 3) float32 unit normals, object space, of all corners."""
    normals = np.empty((len(mesh.loops), 3), np.float32)
    mesh.corner_normals.foreach_get("vector", normals.ravel())
    return normals


def _is_smooth(mesh: bpy.types.Mesh) -> bool:
    """Whether all corners of a vertex have its normal."""
    return mesh.normals_domain == "POINT" and not mesh.has_custom_normals


def has_smooth_triangles(mesh: bpy.types.Mesh) -> bool:
    """Whether normals that are made of the triangles are those of the mesh.

    They are not where polygons are cut into triangles: those of a bent quad differ from it, in normal and angle.
    """
    return len(mesh.loops) == 3 * len(mesh.polygons) and _is_smooth(mesh)


def smooth_or_corner_normals(mesh: bpy.types.Mesh) -> Array | None:
    """(l, 3) float32 unit normals, object space, of all corners; None where `has_smooth_triangles`."""
    return None if has_smooth_triangles(mesh) else read_corner_normals(mesh)


def read_vertex_normals(mesh: bpy.types.Mesh) -> Array | None:
    """(n, 3) float32 unit normals, object space; None where corners of a vertex may have normals of their own.

    Cheap where there are some: Blender makes and keeps normals of corners when they are asked for.
    """
    if not _is_smooth(mesh):
        return None
    normals = shareable((len(mesh.vertices), 3), np.float32)
    mesh.vertex_normals.foreach_get("vector", normals.ravel())
    return normals


def read_loop_triangles(mesh: bpy.types.Mesh) -> tuple[Array, Array]:
    """Triangles of all polygons: their corners (m, 3) int32 and the polygon of each (m,) int32."""
    if read_triangles(mesh) is not None:
        count = len(mesh.polygons)
        return np.arange(3 * count, dtype=np.int32).reshape(-1, 3), np.arange(count, dtype=np.int32)
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    corners, polygons = np.empty((count, 3), np.int32), np.empty(count, np.int32)
    mesh.loop_triangles.foreach_get("loops", corners.ravel())
    mesh.loop_triangle_polygons.foreach_get("value", polygons)
    return corners, polygons


def read_polygons(mesh: bpy.types.Mesh) -> tuple[Array, Array]:
    """(p,) int32 first corner of every polygon, and how many it has."""
    start, total = np.empty(len(mesh.polygons), np.int32), np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", start)
    mesh.polygons.foreach_get("loop_total", total)
    return start, total


def read_corner_vertices(mesh: bpy.types.Mesh) -> Array:
    """(l,) int32 vertex of every corner."""
    vertices = np.empty(len(mesh.loops), np.int32)
    if len(vertices):
        mesh.attributes[".corner_vert"].data.foreach_get("value", vertices)  # copies; `loops` asks for each element
    return vertices


def read_material_index(mesh: bpy.types.Mesh) -> Array | None:
    """(p,) int32 material slot of every polygon; None where all have the first."""
    attribute = mesh.attributes.get("material_index")
    if attribute is None or attribute.domain != "FACE" or attribute.data_type != "INT":
        return None
    index = np.empty(len(mesh.polygons), np.int32)
    attribute.data.foreach_get("value", index)
    return index if index.any() else None


def read_uvs(mesh: bpy.types.Mesh, name: str) -> Array | None:
    """(l, 2) float32 of a UV map, of the one that renders when `name` is ""; None where there is no such map."""
    if name == "":
        layer = next((layer for layer in mesh.uv_layers if layer.active_render), None)
    else:
        layer = mesh.uv_layers.get(name)
    if layer is None:
        return None
    uvs = np.empty((len(mesh.loops), 2), np.float32)
    layer.uv.foreach_get("vector", uvs.ravel())
    return uvs
