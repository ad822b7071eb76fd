"""Which points of a carrier bring each vertex of another object along: moving least squares of points and normals.

The weights of a vertex sum to one and reproduce it at rest, so that points that move affinely move it alike, and they
change smoothly from vertex to vertex: the farther the nearest point, the wider the ones that count are apart, up to all
around of what a surface encloses. Beside a surface its normals say what its points cannot: where the vertex is above
it. They are as long as the root of the area around, so that what turns and scales the surface does so to the vertex.
Of points without faces what is left of the way to the vertex is added as it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from ..drgs_blender.core.errors import UsageError
from . import carrier_nodes, lookups, mesh_arrays

Array = np.ndarray

#: Points that carry a vertex.
COUNT = 3 * carrier_nodes.THREES
#: The reach: in the distance of the farthest of so many points, or in that of the nearest.
_NEAR, _AROUND, _REACH = 8, 1.6, 2.5
#: How far apart points are of which a vertex needs some, in the distance of the nearest one.
_SPACING = 1.3
#: Points of which each spacing is a set of its own; of finer ones so many an octave.
_FEW, _STEPS = 256, 8
#: Points that are chosen evenly, of as many at most.
_EVEN, _POOL = 1024, 50_000
#: What normals, or without these nothing, weigh against points: the square of a share of the way to the points' middle.
_OUT_OF_PLANE, _RIDGE = 1.0, 1e-6


def read_points(carrier: bpy.types.Object) -> Array:
    """(n, 3) float64 points of an evaluated mesh or point cloud, in its space.

    Raises
    ------
    UsageError
        There are none, or one is not finite.
    """
    data = carrier_nodes.points_of(carrier)
    points = np.empty((len(data), 3), np.float32)
    data.foreach_get("co", points.ravel())
    if not len(points) or not np.isfinite(points).all():
        problem = "has points that are not finite" if len(points) else "has no points"
        raise UsageError(f'Object "{carrier.name}"', problem, "Choose a frame at which it has some")
    return points.astype(np.float64)


def carry(obj: bpy.types.Object, carrier: bpy.types.Object, modifier: bpy.types.Modifier) -> float:
    """Let a nodes `modifier` of `obj` follow `carrier`, from where both are evaluated to be now.

    Where the carrier has other points in renders than in viewports, as by the levels of a subdivision, `obj` remembers
    both.

    Returns
    -------
    float
        The largest part of the way to a vertex that no point carries, in parts of the size of `obj`.

    Raises
    ------
    UsageError
        From `read_points`.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    vertices = mesh_arrays.read_vertices(obj.evaluated_get(depsgraph).data).astype(np.float64)
    into = np.array(obj.matrix_world.inverted() @ carrier.matrix_world, np.float64)
    shapes = [_shape(carrier, into)]
    with as_rendered(carrier):
        rendered = _shape(carrier, into)
    if len(rendered[0]) != len(shapes[0][0]):
        shapes.append(rendered)
    for suffix in ("", carrier_nodes.RENDERED):
        carrier_nodes.forget(obj.data, suffix)
    for shape, suffix in zip(shapes, ("", carrier_nodes.RENDERED)):
        index, weight, normal, left = shares(vertices, *shape)
        for i in range(carrier_nodes.THREES):
            three = slice(3 * i, 3 * i + 3)
            for name, values in (
                (carrier_nodes.INDICES, index),
                (carrier_nodes.WEIGHTS, weight),
                (carrier_nodes.NORMALS, normal),
            ):
                carrier_nodes.write(obj.data, name.format(i) + suffix, "FLOAT_VECTOR", values[:, three])
        carrier_nodes.write(obj.data, carrier_nodes.LEFT + suffix, "FLOAT_VECTOR", left)
        carrier_nodes.write(obj.data, carrier_nodes.COUNT + suffix, "FLOAT", np.full(len(vertices), len(shape[0])))
    obj.data[carrier_nodes.COUNT] = [len(points) for points, _ in shapes]
    modifier.node_group = carrier_nodes.tree_of(carrier)
    return float(np.linalg.norm(left, axis=1).max() / max(np.linalg.norm(np.ptp(vertices, axis=0)), 1e-30))


@contextmanager
def as_rendered(carrier: bpy.types.Object) -> Iterator[None]:
    """Show an object in viewports with the modifiers, and their levels, that it has in renders."""
    pairs = (("show_viewport", "show_render"), ("levels", "render_levels"))
    before = [
        (modifier, shown, getattr(modifier, shown), getattr(modifier, rendered))
        for modifier in carrier.modifiers
        for shown, rendered in pairs
        if hasattr(modifier, rendered)
    ]
    changed = [entry for entry in before if entry[2] != entry[3]]
    try:
        for modifier, shown, _, rendered in changed:
            setattr(modifier, shown, rendered)
        if changed:
            bpy.context.view_layer.update()
        yield
    finally:
        for modifier, shown, value, _ in changed:
            setattr(modifier, shown, value)
        if changed:
            bpy.context.view_layer.update()


def _shape(carrier: bpy.types.Object, into: Array) -> tuple[Array, Array]:
    """Points of a carrier and their normals as the nodes see them, (n, 3) each, brought `into` another space."""
    evaluated = carrier.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = read_points(evaluated) @ into[:3, :3].T + into[:3, 3]
    return points, normals_of(evaluated.data, points) if carrier.type == "MESH" else np.zeros_like(points)


def normals_of(mesh: bpy.types.Mesh, points: Array) -> Array:
    """(n, 3) mean normals of the faces at each vertex, as long as the roots of their areas; 0 where there are none."""
    corners, count = mesh_arrays.read_corner_vertices(mesh), len(mesh.polygons)
    sizes = np.empty(count, np.int32)
    mesh.polygons.foreach_get("loop_total", sizes)
    face = np.repeat(np.arange(count), sizes)
    following = np.arange(1, len(corners) + 1)
    following[np.cumsum(sizes) - 1] -= sizes
    start = points[corners[np.cumsum(sizes) - sizes]][face]  # cancels; keeps digits far from the origin
    cross = 0.5 * np.cross(points[corners] - start, points[corners[following]] - start)
    area = np.stack([np.bincount(face, cross[:, axis], count) for axis in range(3)], 1)
    normal = (area / np.sqrt(np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-30)))[face]
    total = np.stack([np.bincount(corners, normal[:, axis], len(points)) for axis in range(3)], 1)
    return total / np.maximum(np.bincount(corners, minlength=len(points)), 1)[:, None]


def shares(vertices: Array, points: Array, normals: Array) -> tuple[Array, Array, Array, Array]:
    """Which points carry each vertex, with which weights, and what these leave of its place.

    Parameters
    ----------
    vertices : (n, 3)
    points, normals : (s, 3) in the same space; normals of any length, 0 where there are none

    Returns
    -------
    (n, COUNT) int points; (n, COUNT) their weights, which sum to one; (n, COUNT) those of their normals; (n, 3) what is
    left. Weights are 0 where there are fewer points.
    """
    distance = lookups.nearest(points, vertices, _NEAR)[1]
    closest = distance[:, 0]
    reach = np.maximum(np.maximum(_REACH * closest, _AROUND * distance[:, -1]), 1e-30)
    spacing = spacings(points)
    coarsest = np.sqrt(2.0) * np.sort(spacing)[-COUNT - 1] if len(points) > COUNT else 0.0
    wanted = np.minimum(_SPACING * closest, coarsest)
    index, distance = _candidates(vertices, points, spacing, wanted)
    near = index >= 0
    if index.shape[1] > COUNT:  # the next one ends the reach of the others
        reach = np.minimum(reach, np.where(near[:, -1], distance[:, -1], np.inf))
        index, distance, near = index[:, :COUNT], distance[:, :COUNT], near[:, :COUNT]
    weight = np.maximum(1 - (distance / np.maximum(reach, 1e-30)[:, None]) ** 2, 0) ** 3
    weight *= np.clip(1 + 2 * np.log2(spacing[index] / np.maximum(wanted, 1e-30)[:, None]), 0, 1)
    weight = np.where(near, weight + 1e-12, 0)
    weight /= weight.sum(axis=1, keepdims=True)
    index = np.maximum(index, 0)
    middle = np.einsum("nk,nkc->nc", weight, points[index])
    offset = points[index] - middle[:, None]
    moments = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
    away = vertices - middle
    length = np.linalg.norm(normals, axis=1)
    inverse = (length > 0) / np.maximum(length, 1e-30)
    stiff = _OUT_OF_PLANE * (away**2).sum(axis=1)
    unit = (normals * inverse[:, None])[index]
    faced = weight * (length > 0)[index]
    trace = np.trace(moments, axis1=1, axis2=2)
    moments += stiff[:, None, None] * np.einsum("nk,nki,nkj->nij", faced, unit, unit)
    ridge = _RIDGE * (trace + stiff) + stiff * (1 - faced.sum(axis=1)) + 1e-30
    ridged = moments + ridge[:, None, None] * np.eye(3)
    towards = np.linalg.solve(ridged, away[..., None])[..., 0]
    short = away - np.einsum("nij,nj->ni", moments, towards)  # what the ridge takes; most of it comes back
    towards += np.linalg.solve(ridged, short[..., None])[..., 0]
    along = stiff[:, None] * faced * np.einsum("nkc,nc->nk", unit, towards) * inverse[index]
    weight = weight * (1 + np.einsum("nkc,nc->nk", offset, towards))
    left = away - np.einsum("nk,nkc->nc", weight, offset) - np.einsum("nk,nkc->nc", along, normals[index])
    missing = ((0, 0), (0, COUNT - index.shape[1]))
    return np.pad(index, missing), np.pad(weight, missing), np.pad(along, missing), left


def spacings(points: Array) -> Array:
    """(n,) how far apart points are among which each is kept, first points that are far apart, then ones between.

    Those whose spacing is at least `d` are about `d` apart (farthest point sampling; at random after `_EVEN`).
    """
    order = np.random.default_rng(0).permutation(len(points))
    pool = points[order[:_POOL]]
    spacing, away = np.zeros(len(points)), np.full(len(pool), np.inf)
    chosen, last = int(((pool - pool.mean(axis=0)) ** 2).sum(axis=1).argmax()), np.inf
    for _ in range(min(_EVEN, len(pool))):
        spacing[order[chosen]] = last
        away = np.minimum(away, ((pool - pool[chosen]) ** 2).sum(axis=1))
        chosen = int(away.argmax())
        last = np.sqrt(away[chosen])
    left = order[spacing[order] == 0]
    spacing[left] = last * np.sqrt(_EVEN / (_EVEN + 1.0 + np.arange(len(left))))
    spacing[np.isinf(spacing)] = max(spacing[np.isfinite(spacing)].max(initial=0.0), 1e-30)
    return np.maximum(spacing, 1e-6 * spacing.max())  # of points in one place


def _candidates(vertices: Array, points: Array, spacing: Array, wanted: Array) -> tuple[Array, Array]:
    """The points nearest to each vertex of those that are as sparse as it wants, and half an octave finer ones.

    Returns
    -------
    (n, COUNT + 1) int, -1 where there are no more; (n, COUNT + 1) distances
    """
    index = np.full((len(vertices), min(COUNT + 1, len(points))), -1)
    distance = np.zeros(index.shape)
    few = np.unique(np.sort(spacing)[-_FEW:])
    steps = np.arange(_STEPS * np.log2(few[0] / spacing.min())) / _STEPS
    levels = np.append(spacing.min() * 2.0**steps, few)
    # What is finer than this does not count.
    level = np.searchsorted(levels, np.maximum(wanted * (np.sqrt(0.5) + 1e-9), spacing.min()), side="right") - 1
    for number in np.unique(level):
        of, kept = np.flatnonzero(level == number), np.flatnonzero(spacing >= levels[number])
        found, away = lookups.nearest(points[kept], vertices[of], COUNT + 1)
        index[of, : found.shape[1]], distance[of, : found.shape[1]] = kept[found], away
    return index, distance
