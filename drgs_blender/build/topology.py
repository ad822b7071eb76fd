"""Meshes of files made fit for materials at vertices: welding, and subdivision without cracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.distinct_rows import distinct_row_indices

Array = np.ndarray


@dataclass(slots=True)
class Net:
    """A triangle mesh whose vertices may share a place.

    Vertices at one place are apart where shading or material must not blend (hard edges, seams between materials).
    ``point`` numbers the places: what is done to an edge is done to all edges between the same two points, so that no
    crack opens between them.

    Attributes
    ----------
    vertices : (n, 3) float64 array
    point : (n,) int64 array
    values : (n, c) float64 array
        Attributes of the vertices, interpolated linearly.
    faces : (m, 3) int64 array
    uvs : (m, 3, 2) float64 array
    tags : (m, t) int64 array
        Labels of the faces, inherited.
    inside : (m, 3, 3) float32 array
        Barycentric coordinates of the corners in the face of which theirs is a part.
    """

    vertices: Array
    point: Array
    values: Array
    faces: Array
    uvs: Array
    tags: Array
    inside: Array


def weld(
    vertices: Array, faces: Array, keys: Array, normals: Array | None, agree: float = 0.99
) -> tuple[Array, Array, Array]:
    """Merge the corners of faces into vertices by place, key and normal.

    New vertices are in the order of the original ones. Where one is split, the part with its first corner takes its
    turn and the others come after all: a mesh without vertices to merge or leave out keeps the numbers that it has.

    Parameters
    ----------
    vertices : (n, 3) array
        Finite.
    faces : (m, 3) array
    keys : (m,) int array
        Corners of faces with different keys (materials) are never merged.
    normals : (m, 3, 3) array or None
        Unit corner normals: corners whose normals differ (cosine below `agree`) stay apart; None merges them all.
    agree : float
        Cosine.

    Returns
    -------
    source : (k,) array
        The original vertex of each new one, the first of those that are merged.
    point : (k,) array
        The place of each new vertex, numbered.
    faces : (m, 3) array
        New faces.
    """
    extent = np.ptp(vertices, axis=0).max(initial=0.0)
    grid = np.round((vertices - vertices.min(axis=0)) / max(extent * 2e-7, 1e-30)).astype(np.int64)
    place = distinct_row_indices(*grid.T)
    corner_vertex = faces.reshape(-1)
    corner_place, corner_key = place[corner_vertex], np.repeat(keys, 3)
    group = distinct_row_indices(corner_place, corner_key)
    label = np.zeros(len(group), np.int64)
    if normals is not None:
        label = _clusters(group, normals.reshape(-1, 3), agree)
    _, first, new = np.unique(distinct_row_indices(group, label), return_index=True, return_inverse=True)
    source = np.full(len(first), len(vertices), np.int64)
    np.minimum.at(source, new.reshape(-1), corner_vertex)
    by_source = np.lexsort((first, source))
    is_split = np.zeros(len(first), bool)
    is_split[by_source[1:]] = source[by_source[1:]] == source[by_source[:-1]]
    order = np.lexsort((first, source, is_split))
    number = np.argsort(order)
    point = np.unique(corner_place[first[order]], return_inverse=True)[1].reshape(-1)
    return source[order], point, number[new].reshape(-1, 3)


def _clusters(group: Array, normals: Array, agree: float) -> Array:
    """Within each group, number corners by the first corner whose normal they agree with."""
    label = np.full(len(group), -1, np.int64)
    seeds = np.empty(group.max(initial=-1) + 1, np.int64)
    left, number = np.arange(len(group)), 0
    while len(left):
        seeds[group[left][::-1]] = left[::-1]  # the first corner left in each group
        seed = seeds[group[left]]
        same = (np.einsum("nc,nc->n", normals[left], normals[seed]) >= agree) | (seed == left)
        label[left[same]] = number
        left, number = left[~same], number + 1
    return label


def edges(net: Net) -> tuple[Array, int]:
    """Number of the edge between points from each corner to the next, (m, 3), and how many edges there are."""
    place = net.point[net.faces]
    following = place[:, [1, 2, 0]]
    key = np.minimum(place, following) * (int(net.point.max(initial=0)) + 1) + np.maximum(place, following)
    unique, number = np.unique(key.reshape(-1), return_inverse=True)
    return number.reshape(-1, 3), len(unique)


def edge_lengths(net: Net) -> Array:
    """Length of the edge from each corner to the next, (m, 3)."""
    corners, square = np.ascontiguousarray(net.faces.T), 0.0
    for axis in np.ascontiguousarray(net.vertices.T):  # numpy is slow at rows of three numbers
        at = axis.take(corners)
        square = square + (at[[1, 2, 0]] - at) ** 2
    return np.ascontiguousarray(np.sqrt(square).T)


def close_marks(edge: Array, lengths: Array, marked: Array) -> Array:
    """Mark the longest edge of every face with a marked edge, until nothing changes (Rivara's refinement).

    It keeps triangles from degenerating however often they are divided.
    """
    longest = np.take_along_axis(edge, lengths.argmax(axis=1)[:, None], 1)[:, 0]
    first, second, third = np.ascontiguousarray(edge.T)
    marked = marked.copy()
    while True:
        before = marked.sum()
        marked[longest[marked[first] | marked[second] | marked[third]]] = True
        if marked.sum() == before:
            return marked


def survivors(net: Net, edge: Array, marked: Array) -> Array:
    """For each face of `subdivide`'s net the face of this one that it is, corner for corner; -1 where it is new."""
    parts = marked[edge].sum(axis=1)
    same = (parts == 0) & (edge_lengths(net).argmax(axis=1) == 0)  # the others begin at another corner
    return np.repeat(np.where(same, np.arange(len(parts)), -1), parts + 1)


def subdivide(net: Net, edge: Array, marked: Array) -> Net:
    """Divide marked edges at their middles; `marked` (edges,) must be closed (`close_marks`).

    A face is bisected at its longest edge, and each half at its own marked edge if it has one.
    """
    m, n = len(net.faces), len(net.vertices)
    longest = edge_lengths(net).argmax(axis=1)[:, None]
    turn = 3 * np.arange(m)[:, None] + (longest + np.arange(3)) % 3  # start at the longest edge
    faces, uvs = net.faces.take(turn), net.uvs.reshape(-1, 2).take(turn, axis=0)
    inside = net.inside.reshape(-1, 3).take(turn, axis=0)
    edge = edge.take(turn)
    split = marked[edge]

    # Middles: one a pair of vertices; those of one edge between points share a place.
    start, end = faces[split], faces[:, [1, 2, 0]][split]
    key = np.minimum(start, end) * n + np.maximum(start, end)
    pairs, first, middle = np.unique(key, return_index=True, return_inverse=True)
    a, b = pairs // n, pairs % n
    place = np.cumsum(marked) - 1 + int(net.point.max(initial=-1)) + 1
    middles = np.full(faces.shape, -1, np.int64)
    middles[split] = n + middle.reshape(-1)

    # Children take the place of their parent in the list, so that neighbours stay close in memory: the half at the
    # first end of the longest edge, then the other one, each perhaps in two.
    parts = split.sum(axis=1) + 1
    parent = np.repeat(np.arange(m), parts)
    one = np.cumsum(parts) - parts
    other = one + 1 + split[:, 2]
    none, left, right = ~split[:, 0], split[:, 0] & ~split[:, 2], split[:, 0] & ~split[:, 1]
    twice_left, twice_right = split[:, 0] & split[:, 2], split[:, 0] & split[:, 1]
    slots = np.empty((len(parent), 3), np.int64)  # 0-2: corners, 3-5: middles
    slots[one[none]] = 0, 1, 2
    slots[one[left]] = 0, 3, 2
    slots[one[twice_left]] = 0, 3, 5
    slots[one[twice_left] + 1] = 3, 2, 5
    slots[other[right]] = 3, 1, 2
    slots[other[twice_right]] = 3, 1, 4
    slots[other[twice_right] + 1] = 3, 4, 2
    slots += 6 * parent[:, None]

    def at_slots(corners: Array) -> Array:
        both = np.concatenate([corners, 0.5 * (corners + corners[:, [1, 2, 0]])], 1)
        return both.reshape(-1, corners.shape[2]).take(slots, axis=0)

    return Net(
        np.concatenate([net.vertices, 0.5 * (net.vertices[a] + net.vertices[b])]),
        np.concatenate([net.point, place[edge[split][first]]]),
        np.concatenate([net.values, 0.5 * (net.values[a] + net.values[b])]),
        np.concatenate([faces, middles], 1).take(slots),
        at_slots(uvs),
        net.tags.take(parent, axis=0),
        at_slots(inside),
    )
