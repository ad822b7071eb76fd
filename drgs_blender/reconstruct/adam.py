"""Adam (Kingma and Ba 2015) in place over arrays whose rows come and go."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from ..arrays import Array
from ..jit import njit, prange

_BETA1, _BETA2, _EPSILON = 0.9, 0.99, 1e-15
_BLOCK = 4096


class Adam:
    """The optimiser of named parameters.

    Parameters
    ----------
    parameters : name -> float32 tensor whose first axis counts rows
    """

    def __init__(self, parameters: dict[str, Tensor]) -> None:
        self.first = {k: np.zeros(v.shape, np.float32) for k, v in parameters.items()}
        self.second = {k: np.zeros(v.shape, np.float32) for k, v in parameters.items()}
        self.steps = 0

    def step(self, parameters: dict[str, Tensor], rates: dict[str, float | Array]) -> None:
        """One step for each parameter that has a gradient.

        Parameters
        ----------
        parameters : as they were given at first; changed in place, gradients removed
        rates : learning rate by name, or one for each column (c,) of the rows seen as (n, c)
        """
        self.steps += 1
        correction = (1 - _BETA2**self.steps) ** 0.5 / (1 - _BETA1**self.steps)
        for name, value in parameters.items():
            if value.grad is None:
                continue
            flat = value.detach().numpy().reshape(-1)
            width = value.numel() // max(len(value), 1)
            rate = np.broadcast_to(np.asarray(rates[name], np.float32), (max(width, 1),))
            gradient = np.ascontiguousarray(value.grad.numpy(), np.float32).reshape(-1)
            _step(
                flat, gradient, self.first[name].reshape(-1), self.second[name].reshape(-1),
                np.ascontiguousarray(rate * np.float32(correction)),
            )  # fmt: skip
            value.grad = None

    def take(self, rows: Array) -> None:
        """Keep the moments of `rows` in this order; those of -1 begin anew."""
        for moments in (self.first, self.second):
            for name, value in moments.items():
                kept = value[rows]
                kept[rows < 0] = 0
                moments[name] = np.ascontiguousarray(kept)


@njit(parallel=True)
def _step(value: Any, gradient: Any, first: Any, second: Any, rate: Any) -> None:
    width = len(rate)
    b1, b2, epsilon = np.float32(_BETA1), np.float32(_BETA2), np.float32(_EPSILON)
    one = np.float32(1.0)
    for block in prange((len(value) + _BLOCK - 1) // _BLOCK):
        for i in range(block * _BLOCK, min(len(value), (block + 1) * _BLOCK)):
            g = gradient[i]
            if not abs(g) < np.float32(np.inf):
                continue  # a surfel seen from within itself: its other views know better
            m = b1 * first[i] + (one - b1) * g
            v = b2 * second[i] + (one - b2) * g * g
            first[i], second[i] = m, v
            value[i] -= rate[i % width] * m / (np.sqrt(v) + epsilon)
