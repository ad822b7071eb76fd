"""The topology check: whether an evaluated mesh is the asset's, moved: the same vertices, joined by the same faces."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np

from ...drgs_blender.core.asset import Mesh
from ...drgs_blender.core.errors import AssetError
from .. import mesh_arrays

Array = np.ndarray

#: Modifiers that move vertices and never change their number.
DEFORMING = {
    *("ARMATURE", "CAST", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM", "LATTICE", "MESH_DEFORM", "SHRINKWRAP"),
    *("SIMPLE_DEFORM", "SMOOTH", "CORRECTIVE_SMOOTH", "LAPLACIANSMOOTH", "SURFACE_DEFORM", "WARP", "WAVE"),
    *("VOLUME_DISPLACE", "CLOTH", "COLLISION", "SOFT_BODY", "SURFACE", "MESH_CACHE", "MESH_SEQUENCE_CACHE"),
    *("DATA_TRANSFER", "NORMAL_EDIT", "WEIGHTED_NORMAL", "UV_PROJECT", "UV_WARP", "VERTEX_WEIGHT_EDIT"),
    *("VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY", "DYNAMIC_PAINT", "PARTICLE_SYSTEM"),
}


def check_modifiers(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Refuse an object that is subdivided last of all, before its mesh is asked for.

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
        if not shown or modifier.type in DEFORMING:
            continue
        if modifier.type == "SUBSURF" and len(obj.original.data.polygons):
            levels = modifier.render_levels if final else modifier.levels
            if min(levels, limit if render.use_simplify else levels) > 0:
                raise AssetError(
                    f'Object "{obj.name}"',
                    f'modifier "{modifier.name}" changes the number of vertices by subdividing the mesh',
                    "Remove it, or disable it for renders",
                )
        return


def check_topology(obj: bpy.types.Object, mesh: bpy.types.Mesh, rest: Mesh, warn: Callable[[str], None]) -> bool:
    """Compare the evaluated `mesh` of `obj` with the asset's mesh.

    Faces in another order, and triangles merged to polygons, still join the vertices as the asset does: every edge
    of the mesh is an edge of the asset. A mesh whose vertices were renumbered has other edges.

    Returns
    -------
    bool
        Whether the faces are the asset's, corner by corner.

    Raises
    ------
    AssetError
        Vertices were added, removed or renumbered; names object, asset and the modifiers that may have done it.
    """
    if len(mesh.vertices) != len(rest.vertices):
        raise _wrong_count(obj, len(mesh.vertices), len(rest.vertices))
    triangles = mesh_arrays.read_triangles(mesh)
    if triangles is not None and np.array_equal(triangles, rest.faces):
        return True
    foreign = np.setdiff1d(_keys(mesh_arrays.read_edges(mesh)), _keys(_edges(rest.faces)))
    if len(foreign):
        raise AssetError(
            f'Object "{obj.name}"',
            f"its faces do not join the vertices as {obj.original.drgs.asset.name} does "
            f"({len(foreign)} edges differ){_named(obj)}",
            "Undo the edit or disable the modifier, import the asset again, or choose the file of this mesh",
        )
    missing = len(rest.faces) - (len(mesh.loops) - 2 * len(mesh.polygons))
    if missing > 0:
        warn(f'"{obj.name}": {missing} faces of its asset were deleted; they are rendered all the same')
    elif missing < 0:
        warn(f'"{obj.name}": {-missing} faces are not in its asset and are not rendered')
    return False


def _edges(faces: Array) -> Array:
    """(3 m, 2) edges of triangles."""
    return faces[:, (0, 1, 1, 2, 2, 0)].reshape(-1, 2)


def _keys(edges: Array) -> Array:
    """One int64 an edge, the same for both directions."""
    return edges.min(axis=1).astype(np.int64) << 32 | edges.max(axis=1)


def _wrong_count(obj: bpy.types.Object, found: int, expected: int) -> AssetError:
    subject = f'Object "{obj.name}"'
    own = len(obj.original.data.vertices)
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
