"""Faces of an edited mesh that are faces of its asset, by the vertices that they join."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import bpy
import numpy as np

from .. import mesh_arrays

Array = np.ndarray

#: Corners of a polygon of which any three are tried; of larger ones the triangles that Blender cuts them into.
MOST = 8
#: Order and sorted keys of the faces of assets.
_sorted: mesh_arrays.OfArrays[tuple[Array, Array]] = mesh_arrays.OfArrays(4)


class Matched(NamedTuple):
    """Faces of a mesh that its asset has.

    Attributes
    ----------
    face : (m,) int32 array
        The asset's face of each.
    corners : (m, 3) int32 array
        Corners of the mesh, in the order of the corners of the asset's face.
    foreign : int
        Polygons that join vertices as no face of the asset does, as a whole or in part.
    """

    face: Array
    corners: Array
    foreign: int


def match_faces(mesh: bpy.types.Mesh, rows: Array, faces: Array) -> Matched:
    """Find the faces of an asset in a mesh; polygons stand for all triangles of their corners.

    Of a face that is there both ways round, as of a solidified shell, the asset's side counts.

    Parameters
    ----------
    mesh : bpy.types.Mesh
    rows : (n,) int32 array
        The asset's vertex of each vertex of the mesh; -1: none.
    faces : (k, 3) int32 array
        Of the asset.
    """
    corners, polygon = _triangles(mesh)
    of = rows[mesh_arrays.read_corner_vertices(mesh)]
    known = (of[corners] >= 0).all(axis=1)
    corners, polygon = corners[known], polygon[known]
    ids = of[corners]
    keys = _keys(ids)
    order, sorted_keys = _sorted.get(faces, lambda: _in_order(_keys(faces)))
    first = np.searchsorted(sorted_keys, keys)
    count = np.searchsorted(sorted_keys, keys, side="right") - first
    there = count > 0
    corners, polygon, ids, keys = corners[there], polygon[there], ids[there], keys[there]
    # of faces that join the same vertices (two sides of a sheet), copies take turns
    face = order[first[there] + _rank(keys) % count[there]].astype(np.int32)
    own = faces[face]
    same = ids[:, None, :] == own[:, :, None]
    order = same.argmax(axis=2)
    right = same.any(axis=2).all(axis=1)  # the same key, and not by chance
    flipped = (order[:, 1] - order[:, 0]) % 3 == 2
    both = np.zeros(len(faces), bool)
    both[face[~flipped]] = True
    right &= ~(flipped & both[face])  # the inside of a shell that a modifier made
    corners = np.take_along_axis(corners, order, axis=1)
    # a polygon stands for all triangles that fill it: one over a hole has three corners of a face by chance
    start, total = mesh_arrays.read_polygons(mesh)
    known_before = np.r_[0, np.cumsum(of >= 0)]
    filling = known_before[start + total] - known_before[start] - 2
    large = total > MOST
    right &= (np.bincount(polygon[right], minlength=len(total)) >= filling)[polygon] | large[polygon]
    whole = np.bincount(polygon[right], minlength=len(total)) >= np.where(large, total - 2, 1)
    return Matched(face[right], np.ascontiguousarray(corners[right], np.int32), int((~whole).sum()))


def _triangles(mesh: bpy.types.Mesh) -> tuple[Array, Array]:
    """(t, 3) corners of all triangles that polygons may stand for, and the (t,) polygon of each."""
    start, total = mesh_arrays.read_polygons(mesh)
    corners, polygons = [], []
    for size in np.unique(total[total <= MOST]):
        of_size = np.flatnonzero(total == size)
        for chosen in combinations(range(size), 3):
            corners.append(start[of_size, None] + np.array(chosen, np.int32))
            polygons.append(of_size)
    if (total > MOST).any():
        cut, polygon = mesh_arrays.read_loop_triangles(mesh)
        large = total[polygon] > MOST
        corners.append(cut[large])
        polygons.append(polygon[large])
    if not corners:
        return np.zeros((0, 3), np.int32), np.zeros(0, np.int64)
    return np.concatenate(corners), np.concatenate(polygons)


def _keys(ids: Array) -> Array:
    """(t,) uint64: one number of three vertices, whatever their order."""
    a, b, c = np.sort(ids, axis=1).T.astype(np.uint64)
    return (a * np.uint64(0x9E3779B97F4A7C15) ^ b) * np.uint64(0xBF58476D1CE4E5B9) ^ c * np.uint64(0x94D049BB133111EB)


def _in_order(keys: Array) -> tuple[Array, Array]:
    """The order of keys, and these in order."""
    order = np.argsort(keys, kind="stable")
    return order, keys[order]


def _rank(keys: Array) -> Array:
    """(t,) how many equal keys are before each."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]]) if len(keys) else np.zeros(0, np.int64)
    start = np.repeat(first, np.diff(np.r_[first, len(keys)]))
    rank = np.empty(len(keys), np.int64)
    rank[order] = np.arange(len(keys)) - start
    return rank
