"""Densification and pruning: surfels split where gradients are large, removed where no view sees them.

A surfel whose projected centre is pulled hardest, in absolute values (Ye et al. 2024, "AbsGS"), is cut in two along
its longer axis; the halves keep its mean and nearly its covariance. How many are cut is set by a budget, not by a
threshold that would depend on the scene.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from ...core.arrays import Array
from ..model.gaussians import Gaussians
from ..model.raster import GradientStatistics
from .adam import Adam

#: Surfels fainter than this vanish.
FAINT = 0.03
#: Halves of a surfel lie this many deviations from its centre, and are this much shorter.
APART, SHORTER = 0.7, 0.65


def densify(
    gaussians: Gaussians, optimiser: Adam, statistics: GradientStatistics, budget: int, largest: float, smallest: float
) -> tuple[Gaussians, dict[str, int]]:
    """Prune, then cut until there are `budget` surfels.

    Parameters
    ----------
    gaussians : Gaussians
    optimiser : Adam
        Its moments follow the surfels.
    statistics : GradientStatistics
        Gradient statistics since the last round.
    budget : int
    largest : float
        Surfels with a larger deviation vanish, metres.
    smallest : float
        Surfels with a smaller one are not cut, metres.

    Returns
    -------
    surfels : Gaussians
    counts : dict of str to int
        How many were "pruned" and "cut".
    """
    opacity = gaussians.opacities().numpy(force=True)
    scale = np.exp(gaussians.parameters["scale"].numpy(force=True))
    finite = np.isfinite(gaussians.parameters["centre"].numpy(force=True)).all(1) & np.isfinite(scale).all(1)
    gradient, views = statistics.gradient.numpy(force=True), statistics.views.numpy(force=True)
    keep = finite & (opacity >= FAINT) & (scale.max(1) <= largest) & (views > 0)
    if not keep.any():
        keep[:] = finite
    kept = np.flatnonzero(keep)
    pull = np.where(scale.max(1) > smallest, gradient / np.maximum(views, 1), 0)[kept]
    count = min(max(budget - len(kept), 0), int((pull > 0).sum()))
    cut = np.sort(np.argsort(-pull, kind="stable")[:count])
    # The first half takes the place of the whole and keeps its moments.
    after = gaussians.select(np.concatenate([kept, kept[cut]]))
    if count:
        _part(after, cut, np.arange(len(kept), len(kept) + count))
    optimiser.reindex(np.concatenate([kept, np.full(count, -1)]))
    return after, {"pruned": int((~keep).sum()), "cut": count}


def _part(gaussians: Gaussians, first: Array, second: Array) -> None:
    """Move the halves `first` and `second` (equal until now) apart."""
    with torch.no_grad():
        scale = gaussians.parameters["scale"]
        there = lambda a: torch.from_numpy(a).to(scale.device)  # noqa: E731
        u, v, _ = (there(a[first]) for a in gaussians.frames())
        rows = there(first)
        along_u = scale[rows, 0] >= scale[rows, 1]
        step = APART * torch.where(along_u[:, None], u, v)
        long = torch.where(along_u, 0, 1)
        for half, sign in ((rows, 1.0), (there(second), -1.0)):
            gaussians.parameters["centre"][half] += sign * step
            scale[half, long] += math.log(SHORTER)
