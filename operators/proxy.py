"""Add Proxy Mesh: a mesh that bends a capture that has none."""

from __future__ import annotations

from itertools import product

import bpy
import numpy as np
from bpy.props import IntProperty

from ..addon import assets, mesh_arrays, proxies, surfel_points
from ..drgs_blender.core.asset import Surfels
from ..drgs_blender.core.asset.part import taken
from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator
from .bind_cage import apply_modifiers, thin_out

Array = np.ndarray

NAME = "DR-GS Proxy"
#: Cells along the diagonal of the surfels from which a proxy is made, before it is thinned out.
_CELLS = 64
#: How far a surfel reaches, in standard deviations, and by how many points along each axis a large one is told.
_REACH, _ACROSS = 1.5, 7


class DRGS_OT_add_proxy(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Give captures without a mesh one that can be posed, weight-painted and simulated, and that carries their surfels: the mesh that is selected too, or a new one around them"""  # noqa: E501

    bl_idname = "drgs.add_proxy"
    bl_label = "Add Proxy Mesh"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    faces: IntProperty(
        name="Faces", description="Triangles of a new proxy, about", min=50, soft_max=10000, default=2000
    )

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context), vertices=False, data=True)
        given = list(selection.of_type(context.selected_objects, "MESH"))
        if len(given) > 1:
            raise UsageError("Selection", f"holds {len(given)} other meshes", "Select one proxy, or none for a new one")
        shapes = [
            shape_of(given[0], obj, context) if given else hull_of(context, obj, self.faces)
            for obj in _without_mesh(objects)
        ]
        for obj, (vertices, triangles) in zip(objects, shapes):
            selection.own_mesh(obj)
            proxies.fill(obj.data, vertices, triangles)
            obj.display_type = "WIRE"
        if given:
            given[0].hide_set(True)
            given[0].hide_render = True
        selection.select_only(context, objects, objects[-1])
        return {"FINISHED"}


def _without_mesh(objects: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """`objects`; UsageError where one has a mesh already."""
    for obj in objects:
        if len(obj.data.vertices):
            own = len(assets.load(assets.file_of(obj)).mesh.vertices)
            problem = "has a mesh that can be bent itself" if own else "has a proxy already"
            remedy = "Choose a capture without a mesh" + ("" if own else ", or delete its vertices in Edit Mode before")
            raise UsageError(f'Object "{obj.name}"', problem, remedy)
    return objects


def shape_of(proxy: bpy.types.Object, obj: bpy.types.Object, context: bpy.types.Context) -> tuple[Array, Array]:
    """(n, 3) vertices and (m, 3) triangles of the evaluated mesh of an object, in the space of `obj`.

    Raises
    ------
    UsageError
        It has no faces, or is nowhere near the surfels.
    """
    shape = proxy.evaluated_get(context.evaluated_depsgraph_get()).data
    triangles = mesh_arrays.loop_triangles(shape)
    if not len(triangles):
        raise UsageError(f'Object "{proxy.name}"', "has no faces that could carry anything", "Give it faces")
    selection.check_size(obj)
    world = selection.in_world(proxy, mesh_arrays.read_vertices(shape))
    into = np.array(obj.matrix_world.inverted(), np.float64)
    vertices = world @ into[:3, :3].T + into[:3, 3]
    centre = left_surfels(obj).centre
    size = float(np.ptp(centre, axis=0).max())
    if (vertices.min(axis=0) > centre.max(axis=0) + size).any() or (
        vertices.max(axis=0) < centre.min(axis=0) - size
    ).any():
        raise UsageError(f'Object "{proxy.name}"', f'is not at "{obj.name}"', "Move it over the capture, as its shape")
    return vertices, triangles


def left_surfels(obj: bpy.types.Object) -> Surfels:
    """The surfels of its asset that an object has, as they were captured."""
    asset = assets.load(assets.file_of(obj))
    left = surfel_points.left_of(obj, asset)
    return asset.surfels if left is None else taken(asset.surfels, left)


def hull_of(context: bpy.types.Context, obj: bpy.types.Object, faces: int) -> tuple[Array, Array]:
    """A closed mesh of about `faces` triangles around all surfels that an object has, in its space, as `shape_of`."""
    surfels = left_surfels(obj)
    if not len(surfels):
        raise UsageError(f'Object "{obj.name}"', "has no surfels", "Choose another")
    side = max(float(np.linalg.norm(np.ptp(surfels.centre, axis=0))) / _CELLS, 1e-6)
    vertices, quads = boundary_of(np.unique(np.floor(_points_on(surfels, side) / side).astype(np.int64), axis=0))
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata((vertices * side).tolist(), [], quads.tolist())
    made = bpy.data.objects.new(NAME, mesh)
    assets.collection(context).objects.link(made)
    try:
        selection.add_modifier(made, "REMESH", "REMESH", mode="VOXEL", voxel_size=side)
        selection.add_modifier(made, "SMOOTH", "SMOOTH", factor=0.5, iterations=4)
        apply_modifiers(context, made)
        thin_out(context, made, faces, 1e-4 * side)
        found = mesh_arrays.read_vertices(made.data).astype(np.float64), mesh_arrays.loop_triangles(made.data)
    finally:
        selection.remove_with_mesh(made)
    if not len(found[1]):
        raise UsageError(f'Object "{obj.name}"', "has surfels in one place only", "Select a mesh of your own too")
    return found


def _points_on(surfels: Surfels, side: float) -> Array:
    """(n, 3) float64 points on surfels: their centres, and of those larger than `side` a grid."""
    centre, scale = (np.asarray(values, np.float64) for values in (surfels.centre, surfels.scale))
    large = np.flatnonzero(scale.max(axis=1) > 0.5 * side)
    w, x, y, z = np.asarray(surfels.rotation[large], np.float64).T
    u = np.stack((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)), 1) * scale[large, :1]
    v = np.stack((2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)), 1) * scale[large, 1:]
    reach = np.linspace(-_REACH, _REACH, _ACROSS)
    return np.concatenate([centre, *(centre[large] + a * u + b * v for a in reach for b in reach)])


def boundary_of(cells: Array) -> tuple[Array, Array]:
    """Vertices and quads of the surface around unit cells, (n, 3) int, and all cells that touch them; no hole stays."""
    around = np.array(list(product((-1, 0, 1), repeat=3)))
    filled = np.unique((cells[:, None] + around).reshape(-1, 3), axis=0)
    low = filled.min(axis=0) - 1
    grid = np.zeros(filled.max(axis=0) - low + 2, bool)
    grid[tuple((filled - low).T)] = True
    grid = ~_outside(grid)
    corners = []
    for axis in range(3):
        a, b = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        change = np.diff(grid.astype(np.int8), axis=axis)
        for sign, loop in ((-1, (0 * a, a, a + b, b)), (1, (0 * a, b, a + b, a))):
            first = np.argwhere(change == sign) + np.eye(3, dtype=int)[axis]
            corners.append(first[:, None] + np.array(loop))
    vertices, quads = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    return (vertices + low).astype(np.float64), quads.reshape(-1, 4)


def _outside(filled: Array) -> Array:
    """Cells of a grid that empty cells join to its border, which is empty."""
    found = np.zeros_like(filled)
    found[0] = True
    count = 0
    while count != (count := int(np.count_nonzero(found))):
        for axis in range(3):
            ahead, behind = ([slice(None)] * 3 for _ in range(2))
            ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
            found[tuple(ahead)] |= found[tuple(behind)]
            found[tuple(behind)] |= found[tuple(ahead)]
            found &= ~filled
    return found


CLASSES = (DRGS_OT_add_proxy,)
