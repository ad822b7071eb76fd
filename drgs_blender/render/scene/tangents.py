"""Tangents at the corners of a mesh's faces, as MikkTSpace makes them (Mikkelsen 2008), which Cycles and glTF use.

Corners of one position, normal and texture coordinates share a tangent, where their faces lie the same way round in the
texture. Faces that meet in a corner without sharing an edge there share it too, unlike in MikkTSpace.
"""

from __future__ import annotations

import numpy as np

from ...geometry.distinct_rows import distinct_row_indices

Array = np.ndarray


def corner_tangents(vertices: Array, faces: Array, normals: Array, uvs: Array) -> Array:
    """Tangents along u.

    Parameters
    ----------
    vertices : (n, 3) float32 array
        Object space.
    faces : (m, 3) int32 array
    normals : (m, 3, 3) float32 array
        Of the corners, unit, object space.
    uvs : (m, 3, 2) float32 array

    Returns
    -------
    (m, 3, 4) float32 array
        Unit tangent at each corner, object space; the sign of the bitangent, which is sign times normal x tangent.
    """
    corners = vertices[faces].astype(np.float64)
    edge = corners[:, 1:] - corners[:, :1]
    turn = (uvs[:, 1:] - uvs[:, :1]).astype(np.float64)
    area = turn[:, 0, 0] * turn[:, 1, 1] - turn[:, 0, 1] * turn[:, 1, 0]
    sign = np.where(area > 0, 1.0, -1.0)
    along = turn[:, 1, 1, None] * edge[:, 0] - turn[:, 0, 1, None] * edge[:, 1]
    along = _unit(along) * sign[:, None]
    known = (np.abs(area) > np.finfo(np.float32).tiny) & along.any(axis=1)
    along[~known] = 0.0

    columns = [vertices[faces].reshape(-1, 3), normals.reshape(-1, 3), uvs.reshape(-1, 2)]
    alike = distinct_row_indices(*(column for group in columns for column in group.T))
    group = 2 * alike + np.repeat(area > 0, 3)
    n = normals.reshape(-1, 3).astype(np.float64)
    weighted = _angles(corners, normals)[:, None] * _in_plane(np.repeat(along, 3, axis=0), n)
    sums = np.stack([np.bincount(group, weighted[:, k]) for k in range(3)], axis=1)
    tangent = _unit(sums)[group]
    # A face without extent in the texture takes the tangent of its neighbours, whichever way round they lie.
    lost = ~tangent.any(axis=1)
    other = np.where(group[lost] ^ 1 < len(sums), group[lost] ^ 1, group[lost])
    tangent[lost] = _unit(sums)[other]
    signs = np.repeat(sign, 3)
    signs[lost] = np.where(tangent[lost].any(axis=1), -signs[lost], 1.0)
    tangent[~tangent.any(axis=1)] = 1.0, 0.0, 0.0
    return np.concatenate([tangent, signs[:, None]], axis=1).astype(np.float32).reshape(-1, 3, 4)


def _unit(vectors: Array) -> Array:
    """At unit length; zero where there is none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-300)


def _in_plane(vectors: Array, normals: Array) -> Array:
    """Unit parts of (n, 3) vectors in the planes of normals."""
    return _unit(vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals)


def _angles(corners: Array, normals: Array) -> Array:
    """(3 m,) angles of the corners of (m, 3, 3) triangles, seen along their normals, radians."""
    found = []
    for k in range(3):
        n = normals[:, k].astype(np.float64)
        a = _in_plane(corners[:, (k + 1) % 3] - corners[:, k], n)
        b = _in_plane(corners[:, (k + 2) % 3] - corners[:, k], n)
        found.append(np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0)))
    return np.stack(found, axis=1).reshape(-1)
