"""Deformation by points of any kind, through Geometry Nodes: clouds, vertices without faces, simulated particles.

Each vertex goes where a sum of the nearest points goes, with the weights of moving least squares: they sum to one and
reproduce the vertex at rest, so that points that move affinely move it alike. Where points lie in a plane or on a line,
what is left of the way to the vertex is added as it was.
"""

from __future__ import annotations

import bpy
import numpy as np

from ..drgs_blender.core.errors import UsageError
from . import cage_nodes, lookups, mesh_arrays

Array = np.ndarray

#: Points that carry a vertex, in threes; the ridge of their moments, in parts of their spread.
_THREES, _RIDGE = 4, 1e-4
#: Point attributes, one for each three of them; and what is left.
INDICES, WEIGHTS = (f"drgs_points_{what}_{{}}" for what in ("indices", "weights"))
LEFT = "drgs_points_left"
#: Begins the names of the trees.
NAME = "DR-GS Points"


def read_points(carrier: bpy.types.Object) -> Array:
    """(n, 3) float64 points of an evaluated mesh or point cloud, in its space.

    Raises
    ------
    UsageError
        There are none, or one is not finite.
    """
    data = cage_nodes.points_of(carrier)
    points = np.empty((len(data), 3), np.float32)
    data.foreach_get("co", points.ravel())
    if not len(points) or not np.isfinite(points).all():
        problem = "has points that are not finite" if len(points) else "has no points"
        raise UsageError(f'Object "{carrier.name}"', problem, "Choose a frame at which it has some")
    return points.astype(np.float64)


def carry(obj: bpy.types.Object, carrier: bpy.types.Object, modifier: bpy.types.Modifier) -> None:
    """Let a nodes `modifier` of `obj` follow the points of `carrier`, from where both are evaluated to be now.

    Raises
    ------
    UsageError
        From `read_points`.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    points = read_points(carrier.evaluated_get(depsgraph))
    into = np.array(obj.matrix_world.inverted() @ carrier.matrix_world, np.float64)
    points = points @ into[:3, :3].T + into[:3, 3]
    vertices = mesh_arrays.read_vertices(obj.evaluated_get(depsgraph).data).astype(np.float64)
    index, weight, left = shares(vertices, points)
    for i in range(_THREES):
        three = slice(3 * i, 3 * i + 3)
        cage_nodes.write(obj.data, INDICES.format(i), "FLOAT_VECTOR", index[:, three])
        cage_nodes.write(obj.data, WEIGHTS.format(i), "FLOAT_VECTOR", weight[:, three])
    cage_nodes.write(obj.data, LEFT, "FLOAT_VECTOR", left)
    cage_nodes.note_count(obj.data, len(points))
    modifier.node_group = cage_nodes.tree_of(NAME, carrier, _places)


def shares(vertices: Array, points: Array) -> tuple[Array, Array, Array]:
    """Which points carry each vertex, with which weights, and what these leave of its place.

    Parameters
    ----------
    vertices, points : (n, 3), (s, 3) in the same space

    Returns
    -------
    (n, 12) int; (n, 12), which sum to one and are 0 where there are fewer points; (n, 3)
    """
    index, distance = lookups.nearest(points, vertices, 3 * _THREES)
    weight = np.exp(-2.0 * (distance / np.maximum(distance[:, -1:], 1e-30)) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    middle = np.einsum("nk,nkc->nc", weight, points[index])
    offset = points[index] - middle[:, None]
    moments = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
    ridge = _RIDGE * np.trace(moments, axis1=1, axis2=2) + 1e-30
    towards = np.linalg.solve(moments + ridge[:, None, None] * np.eye(3), (vertices - middle)[..., None])
    weight = weight * (1.0 + np.einsum("nkc,nc->nk", offset, towards[..., 0]))
    left = vertices - np.einsum("nk,nkc->nc", weight, points[index])
    missing = ((0, 0), (0, 3 * _THREES - index.shape[1]))
    return np.pad(index, missing), np.pad(weight, missing), left


def _places(build: cage_nodes.Builder, place: cage_nodes.Place) -> bpy.types.NodeSocket:
    """The sum of where the points of each vertex are now."""
    total = build.attribute(LEFT, "FLOAT_VECTOR")
    for i in range(_THREES):
        indices = build.parts(build.attribute(INDICES.format(i), "FLOAT_VECTOR"))
        weights = build.parts(build.attribute(WEIGHTS.format(i), "FLOAT_VECTOR"))
        for index, weight in zip(indices, weights):
            total = build.vector("ADD", total, build.scaled(place(index), weight))
    return total
