"""The topology check: what an evaluated mesh has of its asset: all of it, moved, or a part."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import bpy
import numpy as np

from ...drgs_blender.core.asset import Mesh
from ...drgs_blender.core.asset.part import Part
from ...drgs_blender.core.errors import AssetError
from .. import lookups, mesh_arrays, proxies
from .face_match import Matched, match_faces

Array = np.ndarray

#: Modifiers that move vertices and never change their number.
DEFORMING = {
    *("ARMATURE", "CAST", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM", "LATTICE", "MESH_DEFORM", "SHRINKWRAP"),
    *("SIMPLE_DEFORM", "SMOOTH", "CORRECTIVE_SMOOTH", "LAPLACIANSMOOTH", "SURFACE_DEFORM", "WARP", "WAVE"),
    *("VOLUME_DISPLACE", "CLOTH", "COLLISION", "SOFT_BODY", "SURFACE", "MESH_CACHE", "MESH_SEQUENCE_CACHE"),
    *("DATA_TRANSFER", "NORMAL_EDIT", "WEIGHTED_NORMAL", "UV_PROJECT", "UV_WARP", "VERTEX_WEIGHT_EDIT"),
    *("VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY", "DYNAMIC_PAINT", "PARTICLE_SYSTEM"),
}
#: Modifiers that make other faces, and how.
REMODELLING = {
    "SUBSURF": "subdividing the mesh", "MULTIRES": "subdividing the mesh", "DECIMATE": "merging faces",
    "REMESH": "making a new mesh", "MIRROR": "mirroring the mesh", "SKIN": "making a new mesh",
    "SCREW": "making a new mesh", "OCEAN": "making a new mesh",
}  # fmt: skip


#: Matches that are kept.
_KEPT = 16


class _Kept(NamedTuple):
    """What was found of a mesh: the asset's faces, the state of the mesh, and what that has of them."""

    faces: Array
    state: tuple[Array, Array, Array]
    matched: Matched
    part: Part | None


_matches: list[_Kept] = []


def check_modifiers(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Refuse an object whose faces a modifier replaces, before its mesh is asked for.

    From 5.0 on Blender subdivides only when somebody looks at the result, which may take minutes.

    Raises
    ------
    AssetError
        Names object and modifier.
    """
    final = depsgraph.mode == "RENDER"
    render = depsgraph.scene_eval.render
    limit = render.simplify_subdivision_render if final else render.simplify_subdivision
    for modifier in reversed(obj.original.modifiers):
        shown = modifier.show_render if final else modifier.show_viewport
        if not shown or modifier.type in DEFORMING or not len(obj.original.data.polygons):
            continue
        if modifier.type in ("SUBSURF", "MULTIRES"):
            levels = modifier.render_levels if final else modifier.levels
            if min(levels, limit if render.use_simplify else levels) <= 0:
                continue
        if modifier.type in REMODELLING:
            raise AssetError(
                f'Object "{obj.name}"',
                f'modifier "{modifier.name}" changes the number of vertices by {REMODELLING[modifier.type]}',
                "Remove it, or disable it for renders",
            )


class Fit(NamedTuple):
    """How a mesh fits its asset.

    Attributes
    ----------
    part : Part, optional
        What it has left of the asset; None: all of it, once.
    vertices : (n,) int64 array, optional
        Vertices of the mesh that are the part's; None: all.
    corners : (m, 3) int32 array, optional
        Corners of the mesh for those of the faces of the part, or of the asset; None: they are in its order.
    """

    part: Part | None = None
    vertices: Array | None = None
    corners: Array | None = None

    def of_part(self, values: Array) -> Array:
        """Values of the mesh's vertices for those of the part."""
        return values if self.vertices is None else values[self.vertices]

    def rest(self, mesh: Mesh, count: int) -> Array:
        """(count, 3) places at rest of the vertices of the mesh, by those of the asset's; NaN of new ones."""
        own = self.of_asset(mesh.vertices)
        if self.vertices is None:
            return own
        found = np.full((count, 3), np.nan, np.float32)
        found[self.vertices] = own
        return found

    def of_asset(self, values: Array) -> Array:
        """Values of the asset's vertices for those of the part."""
        return values if self.part is None else values[self.part.vertices]


def check_topology(obj: bpy.types.Object, mesh: bpy.types.Mesh, rest: Mesh, warn: Callable[[str], None]) -> Fit:
    """Compare the evaluated `mesh` of `obj` with the asset's mesh.

    Vertices know which of the asset's they are, whatever was deleted, duplicated or reordered; those of older files are
    the asset's in its order. Triangles merged to polygons are the same faces.

    Raises
    ------
    AssetError
        The vertices do not know which of the asset's they are, and are others or joined by other faces; names object,
        asset and the modifiers that may have done it.
    """
    count = len(rest.vertices)
    if count and not len(mesh.vertices):  # all are deleted, masked or not built yet
        none, corners = np.zeros(0, np.int32), np.zeros((0, 3), np.int32)
        return Fit(Part(none, corners, none), None, corners)
    rows = mesh_arrays.source_rows(mesh, rest)
    if rows is None:
        raise _wrong_count(obj, len(mesh.vertices), count)
    triangles = mesh_arrays.read_triangles(mesh)
    if len(rows) == count and triangles is not None and np.array_equal(triangles, rest.faces):
        return Fit()
    own = mesh_arrays.read_source_vertices(mesh, rest)
    known = own is not None and bool((own >= 0).any())
    if not known and len(foreign := np.setdiff1d(_keys(mesh_arrays.read_edges(mesh)), _keys(_edges(rest.faces)))):
        raise AssetError(
            f'Object "{obj.name}"',
            f"its faces do not join the vertices as {obj.original.drgs.asset.name} does "
            f"({len(foreign)} edges differ){_named(obj)}",
            "Undo the edit or disable the modifier, import the asset again, or choose the file of this mesh",
        )
    matched, part = _kept_match(mesh, rows, rest)
    if not known and len(mesh.polygons) and not len(matched.face) and len(rest.faces):
        raise AssetError(
            f'Object "{obj.name}"', f"has no face of {obj.original.drgs.asset.name} any more{_named(obj)}",
            "Undo the edit or disable the modifier, or import the asset again",
        )  # fmt: skip
    if matched.foreign:
        warn(f'"{obj.name}": {matched.foreign} faces are not in its asset and are not rendered')
    if part is None:
        return Fit(corners=matched.corners)
    there = rows >= 0
    return Fit(part, None if there.all() else np.flatnonzero(there), matched.corners)


def _kept_match(mesh: bpy.types.Mesh, rows: Array, rest: Mesh) -> tuple[Matched, Part | None]:
    """Faces of a mesh that its asset has, and the part of it that they are; None: all, then in its order.

    The last ones are kept, as most frames of an animation move vertices alone.
    """
    joined = mesh_arrays.read_corner_vertices(mesh)
    start = np.zeros(0, np.int32) if len(joined) == 3 * len(mesh.polygons) else mesh_arrays.read_polygons(mesh)[0]
    state = rows, joined, start
    entry = lookups.recall(
        _matches,
        lambda known: known.faces is rest.faces and all(map(np.array_equal, known.state, state)),
        lambda: _Kept(rest.faces, state, *_match(mesh, rows, joined, rest)),
        _KEPT,
    )
    return entry.matched, entry.part


def _match(mesh: bpy.types.Mesh, rows: Array, joined: Array, rest: Mesh) -> tuple[Matched, Part | None]:
    matched = match_faces(mesh, rows, rest.faces)
    in_order = np.array_equal(rows, np.arange(len(rest.vertices)))
    if in_order and len(matched.face) == len(np.unique(matched.face)) == len(rest.faces):
        return matched._replace(corners=matched.corners[np.argsort(matched.face)]), None
    there = rows >= 0
    number = np.cumsum(there, dtype=np.int32) - 1
    return matched, Part(rows[there], np.ascontiguousarray(number[joined[matched.corners]], np.int32), matched.face)


def _edges(faces: Array) -> Array:
    """(3 m, 2) edges of triangles."""
    return faces[:, (0, 1, 1, 2, 2, 0)].reshape(-1, 2)


def _keys(edges: Array) -> Array:
    """One int64 an edge, the same for both directions."""
    return edges.min(axis=1).astype(np.int64) << 32 | edges.max(axis=1)


def _wrong_count(obj: bpy.types.Object, found: int, expected: int) -> AssetError:
    subject = f'Object "{obj.name}"'
    own = len(obj.original.data.vertices)
    if not expected:
        if obj.original.data.attributes.get(proxies.REST) is not None:
            problem = f"{_suspects(obj) or 'a modifier'} makes vertices that do not know where they are at rest"
            return AssetError(subject, problem, "Remove it, or disable it for renders")
        problem = f"its mesh has {own} vertices, and {obj.original.drgs.asset.name} has no mesh"
        return AssetError(subject, problem, "Delete them; with another mesh selected, Add Proxy Mesh takes that")
    if own != expected:
        return AssetError(
            subject,
            f"its mesh has {own} vertices, the asset {expected}",
            "Undo the edit that added or removed vertices, or import the asset again",
        )
    suspects = _suspects(obj) or "a modifier"
    return AssetError(
        subject,
        f"{suspects} changes the number of vertices from {expected} to {found}",
        "Remove it, or disable it for renders",
    )


def _suspects(obj: bpy.types.Object) -> str:
    """The modifiers that may change more than positions; "" without any."""
    names = [m.name for m in obj.original.modifiers if m.show_render and m.type not in DEFORMING]
    return "modifier " + " or ".join(f'"{name}"' for name in names) if names else ""


def _named(obj: bpy.types.Object) -> str:
    suspects = _suspects(obj)
    return f"; perhaps because of {suspects}" if suspects else ""
