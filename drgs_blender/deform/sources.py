"""Deformation gradients of what only has positions: meshes (cage, cloth, soft body) and clouds of points (lattice)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..core.errors import AssetError
from ..geometry.normals import VertexNormals

Array = np.ndarray

#: Neighbours from which the gradient at a point of a cloud is found, and their ridge (part of their squared distance).
_NEIGHBOURS, _RIDGE = 12, 1e-3


class MeshSource:
    """The vertices of a deforming mesh as sources: x and F of each.

    F is the least-squares map of the edges around a vertex, by which a surface says how it stretches and shears; along
    the normal it turns and does not stretch.

    Parameters
    ----------
    vertices : (n, 3) array
        At rest.
    faces : (m, 3) array
        At rest.
    """

    def __init__(self, vertices: Array, faces: Array) -> None:
        self.rest = np.ascontiguousarray(vertices, np.float64)
        self._normals = VertexNormals(faces, len(self.rest))
        ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        self._edges = np.unique(np.sort(ends, axis=1), axis=0)
        edge = self._rest_edges()
        self._weight = 1.0 / np.maximum(np.einsum("nc,nc->n", edge, edge), 1e-300)
        self._inverse = np.linalg.inv(self._moments(edge, edge) + self._along(self.rest, self.rest) + 1e-9 * np.eye(3))

    def _rest_edges(self) -> Array:
        return self.rest[self._edges[:, 1]] - self.rest[self._edges[:, 0]]

    def _moments(self, a: Array, b: Array) -> Array:
        """(n, 3, 3) sum over edges at a vertex of w a b^T; both ends of an edge have the same product."""
        product = (self._weight[:, None, None] * a[:, :, None] * b[:, None, :]).reshape(-1, 9)
        n = len(self.rest)
        both = self._edges.T.reshape(-1)
        out = np.stack([np.bincount(both, np.tile(product[:, c], 2), n) for c in range(9)], -1)
        return out.reshape(n, 3, 3)

    def _along(self, now: Array, then: Array) -> Array:
        new, old = (self._normals(v.astype(np.float32)).astype(np.float64) for v in (now, then))
        return new[:, :, None] * old[:, None, :]

    def gradients(self, vertices: Array) -> Array:
        """(n, 3, 3) float32 deformation gradient at each vertex of `vertices` (n, 3)."""
        now = np.asarray(vertices, np.float64)
        if now.shape != self.rest.shape:
            raise AssetError("source mesh", f"has {len(now)} vertices, not {len(self.rest)}", "Bind to it again")
        edge = now[self._edges[:, 1]] - now[self._edges[:, 0]]
        return ((self._moments(edge, self._rest_edges()) + self._along(now, self.rest)) @ self._inverse).astype(
            np.float32
        )


class PointSource:
    """A cloud of points that deforms, as sources: x and F of each.

    F is the affine map that fits the neighbours best; where they lie in a plane or on a line, which leave it open, it
    is the rotation closest to it.

    Parameters
    ----------
    points : (n, 3) array
        At rest.
    """

    def __init__(self, points: Array) -> None:
        self.rest = np.ascontiguousarray(points, np.float64)
        count = min(_NEIGHBOURS + 1, len(self.rest))
        distance, index = cKDTree(self.rest).query(self.rest, k=count)
        self._index = index.reshape(-1, count)
        self._weight = np.exp(-((distance.reshape(-1, count) / np.maximum(distance.max(), 1e-300)) ** 2))
        self._offset = self._around(self.rest)
        moments = np.einsum("nk,nki,nkj->nij", self._weight, self._offset, self._offset)
        self._ridge = _RIDGE * np.trace(moments, axis1=1, axis2=2) / 3 + 1e-30
        self._inverse = np.linalg.inv(moments + self._ridge[:, None, None] * np.eye(3))

    def _around(self, points: Array) -> Array:
        some = points[self._index]
        return some - np.einsum("nk,nkc->nc", self._weight, some)[:, None] / self._weight.sum(axis=1)[:, None, None]

    def gradients(self, points: Array) -> Array:
        """(n, 3, 3) float32 deformation gradient at each of `points` (n, 3)."""
        now = np.asarray(points, np.float64)
        if now.shape != self.rest.shape:
            raise AssetError("source points", f"are {len(now)}, not {len(self.rest)}", "Bind to them again")
        fit = np.einsum("nk,nki,nkj->nij", self._weight, self._around(now), self._offset)
        u, _, vt = np.linalg.svd(fit)
        side = np.ones((len(u), 3))
        side[:, 2] = np.linalg.det(u @ vt)
        turn = (u * side[:, None]) @ vt
        return ((fit + self._ridge[:, None, None] * turn) @ self._inverse).astype(np.float32)
