"""Interpolation as weighted sums of rows, over faces and in grids, with its gradient.

The derivative is summed in a fixed order, unlike that of torch's own indexing, and several times as fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import njit


@njit
def _gather(rows, index, weights, out):  # type: ignore[no-untyped-def]
    for i in range(len(index)):
        for k in range(index.shape[1]):
            w = weights[i, k]
            for c in range(rows.shape[1]):
                out[i, c] += w * rows[index[i, k], c]


@njit
def _scatter(gradient, index, weights, out):  # type: ignore[no-untyped-def]
    for i in range(len(index)):
        for k in range(index.shape[1]):
            w = weights[i, k]
            for c in range(out.shape[1]):
                out[index[i, k], c] += w * gradient[i, c]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, index: Tensor, weights: Tensor) -> Tensor:
        ctx.kept = index.numpy(), weights.numpy(), rows.shape
        out = np.zeros((len(index), rows.shape[1]), np.float32)
        _gather(np.ascontiguousarray(rows.detach().numpy()), *ctx.kept[:2], out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        index, weights, shape = ctx.kept
        out = np.zeros(shape, np.float32)
        _scatter(np.ascontiguousarray(gradients[0].numpy()), index, weights, out)
        return torch.from_numpy(out), None, None


def blend(rows: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Sums (n, c) of the `rows` (r, c) float32 at `index` (n, k) int64 times `weights` (n, k) float32."""
    return _Blend.apply(rows, index.contiguous(), weights.contiguous())
