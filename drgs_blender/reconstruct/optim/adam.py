"""Adam (Kingma and Ba 2015) in place over arrays whose rows come and go."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import njit
from ...compute.threads import over_range
from ...core.arrays import Array

_BETA1, _BETA2, _EPSILON = 0.9, 0.99, 1e-15
#: Numbers below which waking threads takes longer than the step.
_FEW = 200_000


def descend(value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: Array) -> None:
    """One step of rows (n, k) in place, with their moments; `rate` (k,) float32 by columns."""
    rows = [t.detach().numpy() for t in (value, gradient, first, second)]
    over_range(step_rows, len(value), *rows, rate, fewest=_FEW // max(value.shape[1], 1))


class Adam:
    """The optimiser of named parameters.

    Parameters
    ----------
    parameters : dict of str to tensor
        name -> float32 tensor whose first axis counts rows.
    descend : callable
        Function of one step on the device of the tensors.

    Attributes
    ----------
    first, second : dict of str to tensor
        Moments by name, tensors like the parameters.
    """

    def __init__(self, parameters: dict[str, Tensor], descend: Callable[..., None] = descend) -> None:
        self.first = {k: torch.zeros_like(v, requires_grad=False) for k, v in parameters.items()}
        self.second = {k: torch.zeros_like(v, requires_grad=False) for k, v in parameters.items()}
        self.steps, self._descend = 0, descend

    def step(self, parameters: dict[str, Tensor], rates: dict[str, float | Array]) -> None:
        """One step for each parameter that has a gradient.

        Parameters
        ----------
        parameters : dict of str to tensor
            As they were given at first; changed in place, gradients removed.
        rates : dict of str to (float or array)
            Learning rate by name, or one for each column (c,) of the rows seen as (n, c).
        """
        self.steps += 1
        correction = (1 - _BETA2**self.steps) ** 0.5 / (1 - _BETA1**self.steps)
        for name, value in parameters.items():
            if value.grad is None:
                continue
            width = max(value.numel() // max(len(value), 1), 1)
            rate = np.broadcast_to(np.asarray(rates[name], np.float32), (width,))
            tensors = value.detach(), value.grad.contiguous(), self.first[name], self.second[name]
            rows = [t.reshape(-1, width) for t in tensors]
            self._descend(*rows, np.ascontiguousarray(rate * np.float32(correction)))
            value.grad = None

    def reindex(self, rows: Array) -> None:
        """Keep the moments of `rows` in this order; those of -1 start over."""
        for moments in (self.first, self.second):
            for name, value in moments.items():
                index = torch.from_numpy(rows).to(value.device)
                kept = value[index]
                kept[index < 0] = 0
                moments[name] = kept


@njit
def step_rows(begin, end, value, gradient, first, second, rate):  # type: ignore[no-untyped-def]
    """Step of Adam (Kingma and Ba 2015) for some rows, in place. No branch: vector code.

    Parameters
    ----------
    begin, end : int64
        Rows, half-open.
    value : (n, width) float32 array
        Changed.
    gradient : (n, width) float32 array
        A value whose gradient is not finite stays as it is.
    first, second : (n, width) float32 array
        Moments; changed.
    rate : (width,) float32 array
        Learning rates, the correction of the moments' bias included.
    """
    b1, b2, epsilon = np.float32(_BETA1), np.float32(_BETA2), np.float32(_EPSILON)
    one = np.float32(1.0)
    for i in range(begin, end):
        for k in range(value.shape[1]):
            g = gradient[i, k]
            m, v = b1 * first[i, k] + (one - b1) * g, b2 * second[i, k] + (one - b2) * g * g
            # Else a surfel seen from within itself: its other views know better.
            known = abs(g) < np.float32(np.inf)
            first[i, k] = m if known else first[i, k]
            second[i, k] = v if known else second[i, k]
            after = value[i, k] - rate[k] * m / (np.sqrt(v) + epsilon)
            value[i, k] = after if known else value[i, k]
