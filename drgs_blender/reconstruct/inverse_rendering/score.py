"""How well photographs are met, while materials and light are learned."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ...core.color import linear_to_srgb


class Score:
    """Running means of loss and error of the last steps.

    Attributes
    ----------
    loss : float
    error : float
        Squared, in sRGB. Both are NaN before the first step.
    """

    def __init__(self) -> None:
        self.loss, self.error = float("nan"), float("nan")

    @property
    def psnr(self) -> float:
        """Decibels in sRGB; NaN before the first step."""
        return float(-10 * np.log10(np.maximum(self.error, 1e-12)))

    def note(self, loss: float, predicted: Tensor, photographed: Tensor) -> None:
        """Add a step's loss and pixels (n, 3), linear Rec.709."""
        a, b = (linear_to_srgb(x.clamp(0, 1).numpy()) for x in (predicted, photographed))
        error = float(((a - b) ** 2).mean())
        first = not self.error >= 0
        self.loss = loss if first else 0.95 * self.loss + 0.05 * loss
        self.error = error if first else 0.95 * self.error + 0.05 * error
