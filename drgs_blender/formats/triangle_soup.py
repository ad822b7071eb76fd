"""Triangle soup: triangles that share no vertices, joined where their corners lie at exactly the same place."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def join_equal(*columns: Array) -> tuple[Array, Array]:
    """Rows that are equal in all `columns`, to the last bit (0 and -0 are equal), found once each.

    Parameters
    ----------
    columns : (n, k) float32 array
        Each.

    Returns
    -------
    first, number : (m,) int64 array
        Rows to keep, in their order, and (n,) int64 which of them each row is.
    """
    rows = np.ascontiguousarray(np.concatenate(columns, axis=1, dtype=np.float32) + np.float32(0))
    keys = rows.view(np.dtype((np.void, rows.shape[1] * 4))).reshape(-1)
    _, first, number = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return first[order], place[number.reshape(-1)]
