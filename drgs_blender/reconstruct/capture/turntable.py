"""Objects that were turned before a camera that stood still, as on a turntable: the light stood still with the camera.

Cameras are known in the space of the object, in which they go around it; lamps and room then go around with them. It
shows in the photographs: what is behind the object is the same wherever the camera should be.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter

from ...core.arrays import Array
from ...geometry.normals import rotation_between
from .capture import View

log = logging.getLogger(__name__)

#: Pixels of the longer side at which surroundings are compared; deviations of the blurs between which their detail is.
SIZE, FINE, COARSE = 64, 0.7, 4.0
#: Mask up to which a pixel shows no object, and pixels around the object that count as it.
TRACE, AROUND = 0.02, 3
#: Least angle between two cameras, degrees: their surroundings are others, unless the camera stood still.
APART = 20.0
#: How far surroundings may have moved in the picture, in parts of it, as a camera is moved a little between
#: photographs; least part of them that both views then show.
MOVED, SHARED = 0.2, 0.5
#: Deviation of detail, sRGB, that is no more than noise; fewest pairs of views that say anything.
PLAIN, PAIRS = 0.004, 8
#: Correlation from which on surroundings are the same: about .85 on a turntable, .15 to .25 where the camera moved.
SAME = 0.5


@dataclass(slots=True)
class Surroundings:
    """Detail (h, w) of what is around the object in a small picture, 0 elsewhere; (h, w) 1 where that is, else 0."""

    detail: Array
    known: Array


def is_turned(views: list[View]) -> bool:
    """Whether the views show the same surroundings from everywhere; False where they show none, or have no masks."""
    likeness = likeness_of_surroundings(views)
    log.debug("surroundings of views that are far apart are alike by %s", likeness)
    return likeness is not None and likeness > SAME


def likeness_of_surroundings(views: list[View]) -> float | None:
    """Median correlation of surroundings between views whose cameras are far apart; None: nothing to compare."""
    if any(view.mask is None for view in views):
        return None
    shown, facing = [_surroundings(view) for view in views], [_facing(view) for view in views]
    found = []
    for stride in {len(views) // part for part in (8, 4, 2)}:
        for first in range(len(views)):
            second = (first + stride) % len(views)
            alike = shown[first].known.shape == shown[second].known.shape
            if alike and rotation_between(facing[first], facing[second]) > np.radians(APART):
                found.append(correlation(shown[first], shown[second]))
    known = [value for value in found if value is not None]
    return float(np.median(known)) if len(known) >= PAIRS else None


def light_turns(views: list[View]) -> list[Array]:
    """(3, 3) rotations from directions of the world to those in which the light stands still: the first view's."""
    first = _facing(views[0])
    return [first @ _facing(view).T for view in views]


def _facing(view: View) -> Array:
    return np.asarray(view.camera.matrix_world, np.float64)[:3, :3]


def _surroundings(view: View) -> Surroundings:
    assert view.mask is not None
    step = max(1, max(view.mask.shape) // SIZE)
    h, w = (side // step for side in view.mask.shape)
    layers = np.dstack([view.colour.mean(axis=2), view.mask])[: h * step, : w * step]
    grey, mask = np.moveaxis(layers.reshape(h, step, w, step, 2).mean(axis=(1, 3)), 2, 0)
    known = binary_erosion(mask < TRACE, iterations=AROUND, border_value=1).astype(np.float64)
    return detail_of(grey, known)


def detail_of(grey: Array, known: Array, scale: float = 1.0) -> Surroundings:
    """What is between fine and coarse in a picture, where it is known.

    Parameters
    ----------
    grey : (h, w) float array
        Luminance, sRGB-encoded.
    known : (h, w) float array
        1 where it counts, 0 elsewhere.
    scale : float
        Of the blurs; 1 for pictures of `SIZE` pixels.
    """

    def blurred(deviation: float) -> Array:  # of what is known alone
        return gaussian_filter(grey * known, deviation) / np.maximum(gaussian_filter(known, deviation), 1e-3)

    return Surroundings((blurred(scale * FINE) - blurred(scale * COARSE)) * known, known)


def correlation(first: Surroundings, second: Surroundings) -> float | None:
    """The largest over all shifts, of what both show; None where there is nothing to see.

    Padfield 2012, "Masked object registration in the Fourier domain".
    """
    pair, h, w = (first, second), *first.known.shape
    if any(one.detail[one.known > 0].std() < PLAIN if one.known.any() else True for one in pair):
        return None
    size = 2 * h, 2 * w
    weight_a, sum_a, square_a = (np.fft.rfft2(x, size) for x in (first.known, first.detail, first.detail**2))
    weight_b, sum_b, square_b = (
        np.conj(np.fft.rfft2(x, size)) for x in (second.known, second.detail, second.detail**2)
    )
    both = np.maximum(np.fft.irfft2(weight_a * weight_b, size), 1e-3)
    mean_a, mean_b = (np.fft.irfft2(x, size) / both for x in (sum_a * weight_b, weight_a * sum_b))
    variance_a, variance_b = (
        np.maximum(np.fft.irfft2(x, size) / both - mean**2, 1e-9)
        for x, mean in ((square_a * weight_b, mean_a), (weight_a * square_b, mean_b))
    )
    found = (np.fft.irfft2(sum_a * sum_b, size) / both - mean_a * mean_b) / np.sqrt(variance_a * variance_b)
    down, across = (np.abs(np.fft.fftfreq(side, 1 / side)) for side in size)
    near = (down <= MOVED * h)[:, None] & (across <= MOVED * w)
    seen = both >= SHARED * min(one.known.sum() for one in pair)
    return float(found[near & seen].max(initial=-1.0))
