"""How far what is shown is from the photographs. Radiance is linear Rec.709; photographs lie in [0, 1]."""

from __future__ import annotations

import torch
from torch import Tensor

#: Values from here on are taken for clipped: the light may have been any stronger.
CLIPPED = 0.98
#: Knee and exponent that weigh differences nearly as sRGB encoding does.
_KNEE, _EXPONENT = 0.03, 0.6


def log_loss(shown: Tensor, photographed: Tensor) -> Tensor:
    """Mean absolute difference of log(1 + x), (n, 3) each; a clipped photograph sets no upper bound.

    Its expectation over noisy estimates is least for a scene with little noise, not for the true one: light is made
    even and surfaces rough.
    """
    difference = torch.log1p(photographed) - torch.log1p(shown)
    return torch.where(photographed >= CLIPPED, difference.clamp(min=0), difference.abs()).mean()


def unbiased_loss(shown: Tensor, photographed: Tensor) -> Tensor:
    """Weighted squared error of two independent estimates (n, 2, 3) of each pixel.

    The product of both differences has the squared error of their mean value for expectation, without their variance,
    and so has its derivative: noise does not pull. A clipped photograph sets no upper bound.
    """
    difference = (shown - photographed[:, None]) / (photographed[:, None] + _KNEE) ** _EXPONENT
    product = difference[:, 0] * difference[:, 1]
    above = (photographed >= CLIPPED) & (difference.detach().mean(1) > 0)
    return torch.where(above, torch.zeros_like(product), product).mean()
