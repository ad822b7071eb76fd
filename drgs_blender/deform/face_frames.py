"""The frame of reference of a face at rest: what attaching, binding and driving must agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.normals import VertexNormals, lengths, unit

Array = np.ndarray

#: A face is degenerate when twice its area is below this part of its squared longest edge: single precision no longer
#: says where it faces.
DEGENERATE = 1e-6
#: Matrices multiplied at a time: they stay in the processor's cache.
_TOGETHER = 4096


def dot(a: Array, b: Array) -> Array:
    """Row-wise dot products of (n, c) arrays."""
    return np.einsum("nc,nc->n", a, b)


def product(a: Array, b: Array) -> Array:
    """Products (n, i, j) float64 of small matrices (n, i, k) and (n, k, j).

    Sums are those of np.einsum, whose loops over three numbers cost more than the arithmetic; here loops run along n.
    """
    result = np.empty((len(a), a.shape[1], b.shape[2]))
    for first in range(0, len(a), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        left, right = (
            np.ascontiguousarray(np.moveaxis(a[rows], 0, -1)),
            np.ascontiguousarray(np.moveaxis(b[rows], 0, -1)),
        )
        for i, row in enumerate(left):
            total = np.zeros(right.shape[1:])
            for factor, vector in zip(row, right):
                total += factor * vector
            result[rows, i] = total.T
    return result


@dataclass(slots=True)
class Faces:
    """Triangles at rest, float64.

    Attributes
    ----------
    corners : (m, 3, 3) array
        Vertex positions.
    normal : (m, 3) array
        Unit normals; (0, 0, 1) where degenerate.
    area : (m,) array
    mean_edge : (m,) array
        Mean edge length: the unit of Binding.offset.
    degenerate : (m,) bool array
        No area, or not finite.
    """

    corners: Array
    normal: Array
    area: Array
    mean_edge: Array
    degenerate: Array

    @classmethod
    def of(cls, vertices: Array, faces: Array) -> Faces:
        """Measure the faces (m, 3) of `vertices` (n, 3)."""
        corners = np.asarray(vertices, np.float64)[faces]
        edges = corners[:, [1, 2, 0]] - corners
        edge = lengths(edges)
        cross = np.cross(edges[:, 0], -edges[:, 2])
        twice_area = lengths(cross)
        degenerate = ~(twice_area > DEGENERATE * edge.max(axis=1, initial=0.0) ** 2)
        cross[degenerate] = (0, 0, 1)
        return cls(corners, unit(cross), 0.5 * twice_area, np.nan_to_num(edge.mean(axis=1)), degenerate)


def corner_frames(vertices: Array, faces: Array) -> Array:
    """Frames (m, 3, 3, 3) float32 with columns (t, b, s) at the corners of faces, as Binding.normal defines them.

    Parameters
    ----------
    vertices : (n, 3) float32 array
    faces : (m, 3) int32 array
    """
    s = VertexNormals(faces, len(vertices))(vertices)[faces]
    edge = vertices[faces[:, 1]] - vertices[faces[:, 0]]
    t = edge[:, None] - s * np.einsum("fkc,fc->fk", s, edge)[..., None]
    length = np.sqrt(np.einsum("fkc,fkc->fk", t, t))
    usable = (length > 1e-4 * np.sqrt(np.einsum("fc,fc->f", edge, edge))[:, None]).all(axis=1)
    t /= np.where(usable[:, None], length, 1)[..., None]
    frames = np.stack([t, np.cross(s, t), s], -1)
    if not usable.all():  # the first edge stands on the face, or is none
        rows = np.flatnonzero(~usable)
        corners = np.tile(np.eye(3), (len(rows), 1))
        exact = shading_frames(Faces.of(vertices, faces), faces, vertices, np.repeat(rows, 3), corners)
        frames[rows] = exact.reshape(-1, 3, 3, 3)
    return frames


def local_normals(vertices: Array, faces: Array, normals: Array) -> Array:
    """Normals (m, 3, 3) at the corners of a mesh, each in the frame of its corner, as `posed_normals` takes them."""
    return np.einsum("fkji,fkj->fki", corner_frames(vertices, faces), normals)


def posed_normals(vertices: Array, faces: Array, local: Array) -> Array:
    """(m, 3, 3) float32 unit normals at the corners of a pose that have `local` ones."""
    with np.errstate(over="ignore", invalid="ignore"):
        turned = np.einsum("fkij,fkj->fki", corner_frames(vertices, faces), local)
        return unit(turned.reshape(-1, 3)).reshape(-1, 3, 3).astype(np.float32)


def shading_frames(faces: Faces, indices: Array, vertices: Array, face: Array, barycentric: Array) -> Array:
    """Frames (n, 3, 3) with columns (t, b, s) at points of faces, as Binding.normal defines them.

    Parameters
    ----------
    faces : Faces
        The mesh's, measured.
    indices : (m, 3) array
        Vertices of each face.
    vertices : (k, 3) array
    face : (n,) array
        Faces of the points.
    barycentric : (n, 3) array
        The points on them.
    """
    normals = VertexNormals(indices, len(vertices))(vertices).astype(np.float64)
    s = unit(np.einsum("nk,nkc->nc", barycentric, normals[indices[face]]))
    t = np.zeros_like(s)
    missing = np.ones(len(s), bool)
    corners = faces.corners[face]
    axis = np.eye(3)[np.argmin(np.abs(s), axis=-1)]  # never parallel to s
    for direction in (corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], axis):
        flat = direction - s * dot(direction, s)[:, None]
        length = np.linalg.norm(flat, axis=-1)
        use = missing & (length > 1e-6 * np.linalg.norm(direction, axis=-1))
        t[use] = flat[use] / length[use, None]
        missing &= ~use
    return np.stack([t, np.cross(s, t), s], -1)
