"""A lattice that is bent as points in it are: what a proxy mesh does to the space in and around it.

The displacements u of the lattice's nodes minimise

    sum_v |u(X_v) - d_v|^2 + s sum |D2 u|^2 + a sum_v |u(X_v + h N_v) - d_v - h (n_v - N_v)|^2,

u being trilinear between nodes, d_v the displacements of the points, D2 all second differences along axes and across
the faces of cells, N and n the unit normals at rest and now. As second differences of affine maps are 0, these are
followed exactly; between and beside the points space bends as little as it can. The last term, of little weight, says
how space turns where all points lie in a sheet. Cells are only where points are or what they carry is, so that parts
that are near each other, as leaves, are apart.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from ..core.errors import UsageError
from ..core.frame import Particles
from ..geometry.normals import VertexNormals

Array = np.ndarray

#: Cells along the longest side, and cells at most.
_CELLS, _MOST = 40, 6_000
#: Cells from point to point on faces, and points on those of one size at most.
_APART, _MOST_SAMPLES = 3, 50_000
#: s and a; sums over points are those of the cells that have any.
_SMOOTH, _ASIDE = 1e-2, 1e-6
_CORNERS = np.array(list(product((0, 1), repeat=3)))
#: One along each axis, and none.
_STEPS = np.eye(4, 3, dtype=int)


def _samples(rest: Array, faces: Array, side: float):  # type: ignore[no-untyped-def]
    """Sparse (k, v): the vertices, and points on faces larger than `_APART` cells of a `side`, as far apart."""
    rows, columns, values = ([np.arange(len(rest))], [np.arange(len(rest))], [np.ones(len(rest))])
    count = len(rest)
    corners = rest[faces] if len(faces) else np.zeros((0, 3, 3))
    longest = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1, initial=0.0)
    parts = np.minimum(np.ceil(np.nan_to_num(longest) / (_APART * side)), _CELLS).astype(int)
    for n in np.unique(parts[parts > 1]):
        large = faces[parts == n]
        shares = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        shares = shares[(shares < 1).all(axis=1)]  # corners are there
        if len(large) * len(shares) > _MOST_SAMPLES:
            shares = shares[:: -(-len(large) * len(shares) // _MOST_SAMPLES)]
        rows.append(np.repeat(count + np.arange(len(large) * len(shares)), 3))
        columns.append(np.repeat(large[:, None], len(shares), axis=1).reshape(-1))
        values.append(np.tile(shares.reshape(-1), len(large)))
        count += len(large) * len(shares)
    return sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, len(rest))
    )


class LatticeFit:
    """Gives particles, the nodes of a lattice, that move as points do.

    Parameters
    ----------
    rest : (v, 3) array
        The points at rest, metres.
    faces : (m, 3) int array
        Of the mesh whose vertices they are; may be empty.
    carried : (n, 3) array
        What is in the space to be carried, metres.

    Attributes
    ----------
    nodes : (s, 3) float32 array
        At rest, metres.

    Raises
    ------
    UsageError
        There are no points.
    """

    def __init__(self, rest: Array, faces: Array, carried: Array) -> None:
        self._rest = np.asarray(rest, np.float64)
        if not len(self._rest):
            raise UsageError("the proxy", "has no vertices", "Give it some")
        self._normals = VertexNormals(faces, len(self._rest)) if len(faces) else None
        carried = np.asarray(carried, np.float64)
        self._side = max(float(np.ptp(np.concatenate([self._rest, carried]), axis=0).max()) / _CELLS, 1e-9)
        self._samples = _samples(self._rest, np.asarray(faces), self._side)
        points = self._samples @ self._rest
        self._lay_out(points, carried)
        self.nodes = np.ascontiguousarray(self._origin + self._side * self._place, np.float32)
        beside = self._samples @ self._beside(self._rest)
        at, aside = self._trilinear(points), self._trilinear(beside)
        filled = len(np.unique((points - self._origin) // self._side, axis=0))
        weight = filled / len(points)
        smooth = self._second_differences()
        moments = weight * (at.T @ at + _ASIDE * aside.T @ aside) + _SMOOTH * smooth.T @ smooth
        moments += 1e-14 * sparse.identity(moments.shape[0])
        self._solve = splu(moments.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
        self._data = weight * sparse.hstack([at.T, _ASIDE * aside.T]).tocsr()
        self._rest_beside = beside
        self._differences = [self._mean_difference(axis) for axis in range(3)]

    def particles(self, vertices: Array) -> Particles:
        """The nodes where the points are `vertices`, (v, 3), metres; not finite where one of these is not."""
        now = np.asarray(vertices, np.float64)
        lost = np.logical_not(np.isfinite(now).all(axis=1))
        now = np.where(lost[:, None], self._rest, now)
        sampled = self._samples @ np.concatenate([now - self._rest, self._beside(now)], axis=1)
        moved = self._solve(self._data @ np.concatenate([sampled[:, :3], sampled[:, 3:] - self._rest_beside]))
        slopes = np.stack([difference @ moved for difference in self._differences], axis=2)
        gradients = np.ascontiguousarray(slopes + np.eye(3), np.float32)
        if lost.any():
            near = np.unique(self._trilinear(self._rest[lost]).indices)
            moved[near] = np.nan
        return Particles(self.nodes, np.ascontiguousarray(self.nodes + moved, np.float32), gradients, all=True)

    def _beside(self, vertices: Array) -> Array:
        """Points a cell away along the normals; the points themselves without faces."""
        if self._normals is None:
            return vertices
        return vertices + self._side * self._normals(vertices.astype(np.float32)).astype(np.float64)

    def _lay_out(self, rest: Array, carried: Array) -> None:
        """Choose cells, and number their corners."""
        every = np.concatenate([rest, carried])
        low, extent = every.min(axis=0), np.ptp(every, axis=0)
        while True:
            self._origin = low - 2.5 * self._side
            self._shape = np.ceil(extent / self._side).astype(int) + 6
            cells = np.zeros(self._shape, bool)
            cells[tuple(self._cell(every).T)] = True
            with_points: Array = np.zeros(self._shape, bool)
            with_points[tuple(self._cell(rest).T)] = True
            cells = ndimage.binary_dilation(cells)
            while True:  # all that is carried is joined to points
                part, count = ndimage.label(cells)
                if len(np.setdiff1d(np.unique(part[with_points]), 0)) == count:
                    break
                cells = ndimage.binary_dilation(cells)
            cells = ndimage.binary_fill_holes(cells)
            if np.count_nonzero(cells) <= _MOST:
                break
            self._side *= 1.1
        self._cells = cells
        self._place = self._firsts()
        self._number = np.full(self._shape + 1, -1)
        self._number[tuple(self._place.T)] = np.arange(len(self._place))

    def _cell(self, points: Array) -> Array:
        found = np.floor((points - self._origin) / self._side).astype(int)
        return np.clip(found, 0, self._shape - 1)

    def _trilinear(self, points: Array):  # type: ignore[no-untyped-def]
        """Sparse (n, s): values at points of a field that has values at the nodes; the field ends with its cells."""
        cell = self._cell(points)
        inside = self._cells[tuple(cell.T)]
        rows = np.flatnonzero(inside)
        cell, share = cell[rows], ((points - self._origin) / self._side - cell)[rows].clip(0, 1)
        weights = [np.where(corner, share, 1 - share).prod(axis=1) for corner in _CORNERS]
        columns = [self._number[tuple((cell + corner).T)] for corner in _CORNERS]
        places = np.concatenate(columns), np.tile(rows, len(_CORNERS))
        return sparse.csr_matrix((np.concatenate(weights), places[::-1]), (len(points), len(self._place)))

    def _firsts(self, *axes: int) -> Array:
        """(k, 3) the first corners of what of the cells extends along `axes`: none are nodes, one edges, two faces."""
        there = np.zeros(self._shape + 1, bool)
        for corner in _CORNERS[(_CORNERS[:, axes] == 0).all(axis=1)]:
            there[tuple(slice(c, c + n) for c, n in zip(corner, self._shape))] |= self._cells
        return np.argwhere(there)

    def _nodes_at(self, first: Array, *steps: Array) -> Array:
        """(k, n) numbers of the nodes that are n `steps` from first ones."""
        return np.stack([self._number[tuple((first + step).T)] for step in steps], axis=1)

    def _edges(self, axis: int) -> Array:
        """(k, 2) nodes that an edge of a cell along `axis` joins."""
        return self._nodes_at(self._firsts(axis), *_STEPS[[3, axis]])

    def _second_differences(self):  # type: ignore[no-untyped-def]
        """Sparse (k, s): along each axis, and across each face of a cell."""
        parts = []
        for axis in range(3):
            edges = self._edges(axis)
            following = np.full(len(self._place), -1)
            following[edges[:, 0]] = edges[:, 1]
            third = following[edges[:, 1]]
            line = np.column_stack([edges, third])[third >= 0]
            parts.append(self._rows(line, (1.0, -2.0, 1.0)))
        for a, b in ((0, 1), (0, 2), (1, 2)):
            across = _STEPS[[3, a, b]]
            face = self._nodes_at(self._firsts(a, b), *across, across.sum(axis=0))
            parts.append(self._rows(face, (1.0, -1.0, -1.0, 1.0)) * np.sqrt(2))
        return sparse.vstack(parts).tocsr()

    def _rows(self, nodes: Array, values: tuple[float, ...]):  # type: ignore[no-untyped-def]
        rows = np.repeat(np.arange(len(nodes)), len(values))
        return sparse.csr_matrix(
            (np.tile(values, len(nodes)), (rows, nodes.reshape(-1))), (len(nodes), len(self._place))
        )

    def _mean_difference(self, axis: int):  # type: ignore[no-untyped-def]
        """Sparse (s, s): the mean slope of the edges along `axis` at each node."""
        edges = self._edges(axis)
        count = np.bincount(edges.reshape(-1), minlength=len(self._place))
        rows = np.concatenate([edges[:, 0], edges[:, 0], edges[:, 1], edges[:, 1]])
        columns = np.concatenate([edges[:, 1], edges[:, 0], edges[:, 1], edges[:, 0]])
        ones = np.ones(len(edges)) / self._side
        shares = np.concatenate([ones, -ones, ones, -ones]) / count[rows]
        return sparse.csr_matrix((shares, (rows, columns)), 2 * (len(self._place),))
