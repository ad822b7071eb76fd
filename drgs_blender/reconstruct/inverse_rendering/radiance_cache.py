"""The radiance cache: light that the object itself sends, which photographs show of each vertex by direction.

That is the paper's radiance of the surfels during training. It does not depend on materials that are still unknown.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from ...formats.harmonics import basis
from .pixels import Pixels

Array = np.ndarray

#: Degree of the spherical harmonics, and how strongly all but their mean are held back.
DEGREE, _RIDGE = 1, 0.5
#: Pixels taken in at once.
_BLOCK = 1 << 17


def edges_of(faces: Array) -> Array:
    """(e, 2) int64 undirected edges of (m, 3) faces, each once, lower vertex first."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64), axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)


def adjacency(edges: Array, count: int) -> csr_matrix:
    """(count, count) ones where one of `edges` (e, 2) connects two points."""
    both = np.concatenate([edges, edges[:, ::-1]])
    return coo_matrix((np.ones(len(both), np.float32), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()


def radiance_cache(pixels: Pixels, count: int, edges: Array) -> tuple[Array, Array]:
    """Outgoing radiance of `count` points by least squares over the pixels that show them.

    Returns
    -------
    harmonics : (v, 4, 3) float32 array
        Linear Rec.709: coefficients of ``formats.harmonics.basis``; points that no photograph shows take the mean of
        their neighbours along `edges` (e, 2), in turn.
    weight : (v,) float32 array
        How many pixels show a point.
    """
    terms = (DEGREE + 1) ** 2
    upper = [(i, j) for i in range(terms) for j in range(i, terms)]
    total = np.zeros((count, len(upper) + 3 * terms + 1))
    for first in range(0, len(pixels), _BLOCK):
        part = slice(first, first + _BLOCK)
        y = basis(pixels.towards[part], DEGREE)
        products = [y[:, i] * y[:, j] for i, j in upper]
        values = (y[:, :, None] * pixels.colour[part, None, :]).reshape(len(y), -1)
        point = pixels.index[part].reshape(-1)
        row = np.repeat(np.arange(len(y)), pixels.index.shape[1])
        spread = coo_matrix((pixels.share[part].reshape(-1), (point, row)), shape=(count, len(y))).tocsr()
        total += spread @ np.column_stack([*products, values, np.ones(len(y))])
    matrix = np.zeros((count, terms, terms))
    for column, (i, j) in enumerate(upper):
        matrix[:, i, j] = matrix[:, j, i] = total[:, column]
    target = total[:, len(upper) : -1].reshape(count, terms, 3)
    weight = total[:, -1]
    # A point that few pixels show has little more than a mean.
    held = np.diag([1e-9] + [_RIDGE] * (terms - 1)) / (4 * np.pi)
    harmonics = np.linalg.solve(matrix + held * (1 + 0.2 * weight[:, None, None]), target)
    harmonics[weight < 1e-3] = 0
    harmonics = filled(harmonics.reshape(count, -1), weight > 1e-3, edges).reshape(count, terms, 3)
    return harmonics, weight.astype(np.float32)


def filled(values: Array, known: Array, edges: Array, rounds: int = 200) -> Array:
    """`values` (v, c) with the unknown rows filled from neighbours, outwards from the known ones; float32."""
    near = adjacency(edges, len(values))
    values = np.where(known[:, None], values, 0.0)
    filled = known.copy()
    for _ in range(rounds):
        count = near @ filled.astype(np.float64)
        new = ~filled & (count > 0)
        if not new.any():
            break
        values[new] = (near @ values)[new] / count[new, None]
        filled |= new
    if not filled.all() and known.any():
        values[~filled] = values[known].mean(axis=0)
    return values.astype(np.float32)
