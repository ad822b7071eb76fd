"""Losses of inverse rendering: pixels against photographs. Radiance is linear Rec.709."""

from __future__ import annotations

import torch
from torch import Tensor

#: Values from here on are taken for clipped, but of pictures that have brighter ones.
CLIPPED = 0.98
#: Knee and exponent that weigh differences nearly as sRGB encoding does.
_KNEE, _EXPONENT = 0.03, 0.6
#: Reflectance of polished metals in their brightest channel (silver .97, gold 1, copper .96, aluminium .92), and the
#: power of metallic that counts: the half-metals of the first steps must not be pulled, or bright paint becomes metal.
_POLISHED, _SURELY = 0.95, 6
#: Brightest channel from which metals are pulled, and from which wholly. The darkest that are common reflect half (iron
#: .56, titanium .54): what is darker is patina or dirt, and says nothing of the light.
_PATINA = 0.25, 0.5


def log_loss(predicted: Tensor, photographed: Tensor, clipped: Tensor) -> Tensor:
    """Mean absolute difference of log(1 + x), (n, 3) each; where it is `clipped` a photograph sets no upper bound.

    Its expectation over noisy estimates is least for a scene with little noise, not for the true one: light is made
    even and surfaces rough.
    """
    difference = torch.log1p(photographed) - torch.log1p(predicted)
    return torch.where(clipped, difference.clamp(min=0), difference.abs()).mean()


def metal_albedo_prior(albedo: Tensor, metallic: Tensor) -> Tensor:
    """Metal albedo prior: squared difference of the colours of metals (n, 3), (n,) from polished ones, weighted.

    Where light is dim, only metal shows how dim: dark metal in a light that is too even looks almost the same.
    Metals that are used polished reflect nine tenths and more of their brightest channel. Gradients scale a colour and
    leave its hue; what is not surely metal, or too dark for polished metal, has none.
    """
    known = albedo.detach()
    brightest = known.max(1, keepdim=True).values.clamp(min=1e-3)
    low, high = _PATINA
    weight = _surely_metal(metallic)[:, None] * ((brightest - low) / (high - low)).clamp(0, 1)
    return (weight * (albedo - known * (_POLISHED / brightest)) ** 2).sum(1).mean()


def metal_smoothness_prior(differences: Tensor, metallic: Tensor, likeness: Tensor) -> Tensor:
    """Metal smoothness prior: unevenness of metal, mean over edges, summed over channels.

    The albedo of metal takes in what its normals are off, from vertex to vertex, as no diffuse light evens them out.

    Parameters
    ----------
    differences : (e, 3) tensor
        Of albedo along edges, absolute.
    metallic : (e, 2) tensor
        Of their ends.
    likeness : (e, 1) tensor
        How alike the photographs show these.
    """
    return (likeness * _surely_metal(metallic.min(1, keepdim=True).values) * differences).mean(0).sum()


def _surely_metal(metallic: Tensor) -> Tensor:
    """How far surfaces are metal beyond doubt, 0..1, without a derivative."""
    return metallic.detach() ** _SURELY


def unbiased_loss(
    predicted: Tensor, photographed: Tensor, clipped: Tensor, weight_by_prediction: bool = False,
    weights: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Weighted squared error of two independent estimates (n, 2, 3) of each pixel.

    The product of both differences has the squared error of their mean value for expectation, without their variance,
    and so has its derivative: noise does not pull. A clipped photograph sets no upper bound.

    Parameters
    ----------
    predicted : (n, 2, 3) tensor
    photographed : (n, 3) tensor
    clipped : (n, 3) bool tensor
    weight_by_prediction : bool
        Weigh by what is shown, not by what was photographed. Where the mesh is a little off, one place mirrors what the
        photographs show beside it, bright or dark; weights that are least for bright photographs make a mean of these
        that is too dark.
    weights : (n, 3) tensor, optional
        How much each value counts; None: all the same.
    """
    difference = predicted - photographed[:, None]
    if weight_by_prediction:
        # The weight of an estimate goes with its own slope and the other's difference: it knows nothing of the latter.
        weight = (predicted.detach().clamp(min=0) + _KNEE) ** (-2 * _EXPONENT)
        product = (difference.detach().flip(1) * weight * difference).sum(1)
        product = product - product.detach() / 2  # the slope of a product, and its value
    else:
        weighed = difference / (photographed[:, None] + _KNEE) ** _EXPONENT
        product = weighed[:, 0] * weighed[:, 1]
    if weights is not None:
        product = product * weights
    above = clipped & (difference.detach().mean(1) > 0)
    return torch.where(above, torch.zeros_like(product), product).mean()
