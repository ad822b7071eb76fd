"""The captured illumination, an environment that is learned: log radiance on a lat-long grid that grows."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

Array = np.ndarray


class LearnedLight:
    """Log radiance (h, 2 h, 3), linear Rec.709, in the mapping of `asset.Environment`."""

    def __init__(self, rows: int, radiance: float) -> None:
        self.log = torch.full((rows, 2 * rows, 3), float(np.log(max(radiance, 1e-4))))

    def radiance(self) -> Tensor:
        """(h, w, 3) radiance, with a derivative by `log`."""
        return torch.exp(self.log.clamp(-12.0, 12.0))

    def grow(self) -> None:
        """Twice as many rows and columns, interpolated: wrapped around the horizon, held at the poles."""
        with torch.no_grad():
            across = 0.75 * self.log
            left, right = (across + 0.25 * torch.roll(self.log, shift, 1) for shift in (1, -1))
            wide = torch.stack([left, right], 2).flatten(1, 2)
            above, below = torch.cat([wide[:1], wide[:-1]]), torch.cat([wide[1:], wide[-1:]])
            tall = torch.stack([0.75 * wide + 0.25 * above, 0.75 * wide + 0.25 * below], 1).flatten(0, 1)
        self.log = tall

    def roughness(self) -> Tensor:
        """Mean squared difference of log radiance between neighbours."""
        across = self.log - torch.roll(self.log, 1, 1)
        return (across**2).mean() + ((self.log[1:] - self.log[:-1]) ** 2).mean()


def colour_cast(radiance: Tensor) -> Tensor:
    """Deviation of (h, w, 3) radiance from grey, relative to its mean: the paper's white-balance regulariser."""
    grey = radiance.mean(-1, keepdim=True)
    return (radiance - grey).abs().mean() / radiance.detach().mean()
