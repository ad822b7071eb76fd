"""Which surfels learning begins with: how many, on the visual hull, or inside it too.

Outlines show nothing of hollows. What lies in one is found from surfels that begin inside the hull, and hardly ever
from those that begin on it: they paint what the views see of the hollow onto its lid. Behind a mirror, on the other
hand, surfels inside explain what is reflected, and explain it wrongly. Which is the case is not known beforehand:
`optim.starts` tries both.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..meshing.visual_hull import Region, colours_of
from .gaussians import Gaussians

if TYPE_CHECKING:
    from ..capture.capture import Capture
    from ..capture.training_views import Target

#: Most surfels for each pixel of a view that shows the object.
PER_PIXEL = 1.5
#: Most surfels where none are asked for, at least and at most; in between for each second there is to learn them.
FEWEST, MOST, PER_SECOND = 16_000, 64_000, 100
#: Surfels inside the hull, as a part of those on it; how opaque they begin; their deviation in distances between them.
INSIDE, FAINTLY, WIDE = 1 / 3, 0.1, 0.6


def surfel_limit(views: list[Target], wanted: int | None = None, seconds: float | None = None) -> int:
    """Number of surfels that suits pictures of this size: with more, the photographs are overfitted.

    Parameters
    ----------
    views : list of Target
    wanted : int, optional
        No more than these; None: `MOST`, and fewer where there is less time than these take.
    seconds : float, optional
        Of learning; None: all that it takes.
    """
    if wanted is None:
        wanted = MOST if seconds is None else int(min(max(FEWEST, PER_SECOND * seconds), MOST))
    shown = [v.camera.width * v.camera.height if v.mask is None else float(v.mask.sum()) for v in views]
    return min(max(int(PER_PIXEL * np.mean(shown)), 1), wanted)


def on_hull(capture: Capture, region: Region, surfels: int, bands: int, seed: int = 0) -> Gaussians:
    """Surfels on the first surface, no more than half of the `surfels` that there may be in the end."""
    points, normals, most = region.points, region.normals, max(surfels // 2, 1)
    spacing = region.spacing
    if len(points) > most:
        kept = np.sort(np.random.default_rng(seed).choice(len(points), most, replace=False))
        spacing *= (len(points) / most) ** 0.5
        points, normals = points[kept], normals[kept]
    return Gaussians.on_surface(points, normals, colours_of(points, normals, capture.training), 0.6 * spacing, bands)


def inside_hull(first: Gaussians, capture: Capture, region: Region, bands: int, seed: int = 0) -> Gaussians | None:
    """The surfels `first` and fainter ones strewn in the solid, turned as the surface next to them.

    Returns
    -------
    Gaussians or None
        None where nothing is known of a solid.
    """
    count = int(INSIDE * len(first))
    if not len(region.solid) or not count:
        return None
    rng = np.random.default_rng(seed)
    cells = region.solid[rng.choice(len(region.solid), count, replace=len(region.solid) < count)]
    points = (cells + rng.uniform(-0.5, 0.5, cells.shape) * region.spacing).astype(np.float32)
    normals = region.normals[cKDTree(region.points).query(points)[1]]
    apart = region.spacing * (len(region.solid) / count) ** (1 / 3)
    colours = colours_of(points, normals, capture.training)
    strewn = Gaussians.on_surface(points, normals, colours, WIDE * apart, bands)
    with torch.no_grad():
        strewn.parameters["opacity"].fill_(math.log(FAINTLY / (1 - FAINTLY)))
    both = {k: torch.cat([v.detach(), strewn.parameters[k].detach()]) for k, v in first.parameters.items()}
    return Gaussians(both, strewn.light)  # a light of its own: learning changes it in place
