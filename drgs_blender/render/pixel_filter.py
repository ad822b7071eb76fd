"""The pixel filter: Blackman and Harris's window, as in Cycles, or a box of one pixel.

Filter importance sampling (Ernst et al. 2006): the sub-pixel positions of `camera` are drawn from the filter, so all
samples have equal weight, no pixel's light is added to another's, and what is denoised stays a pixel's own. `film`
then takes plain means.
"""

from __future__ import annotations

import math

from ..compute.jit import inlined
from ..core.errors import UsageError

#: Widest pixel filter; its window is twice as wide, as that of Cycles.
WIDEST = 10.0


def check_filter(width: float) -> None:
    """Raise UsageError when there is no pixel filter of this width (`RenderSettings.filter_width`)."""
    if not 0 <= width <= WIDEST:
        raise UsageError("pixel filter", f"is {width:g} pixels wide", f"Choose 0 (a box) to {WIDEST:g}, such as 1.5")


@inlined
def filter_position(u, width):  # type: ignore[no-untyped-def]
    """Sub-pixel coordinate by filter importance sampling.

    Parameters
    ----------
    u : float64
        Random number in [0, 1).
    width : float64
        Pixels: `RenderSettings.filter_width`; 0: a box.

    Returns
    -------
    float64
        Pixels: in [0, 1) inside the pixel, `filter_reach` beyond it.
    """
    if width > 0.0:
        return 0.5 + 2.0 * width * _blackman_harris(u)
    # Just below one, so that adding the pixel's index in float32 stays inside the pixel for pictures of 65536 pixels.
    return min(u, 0.995)


@inlined
def filter_reach(width):  # type: ignore[no-untyped-def]
    """Pixels by which positions may lie beyond the pixel.

    Parameters
    ----------
    width : float64
        Pixels: `RenderSettings.filter_width`.

    Returns
    -------
    float64
        Pixels.
    """
    return max(width - 0.5, 0.0)


@inlined
def _blackman_harris(u):  # type: ignore[no-untyped-def]
    """Inverse CDF of Blackman and Harris's window: the coordinate in [-.5, .5] below which the part `u` of it lies.

    The window is nearly a Gaussian; a polynomial of what its own quantiles are near is off by .0015 at most.
    """
    z = math.sqrt(-math.log(max(4.0 * u * (1.0 - u), 1e-6)))
    z2 = z * z
    x = min(z * (0.1794079 - z2 * (0.00088309 + z2 * 0.00020995)), 0.5)
    return x if u > 0.5 else -x
