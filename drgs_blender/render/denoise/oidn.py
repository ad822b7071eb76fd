"""Intel's Open Image Denoise as an alternative to `svgf_spatial`, where the wheel `pyoidn` is installed.

A trained network: smoother than SVGF on single pictures, but it takes seconds to load, knows nothing of neighbouring
frames, and is no part of this package.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.errors import DeviceError
from ..film.guides import Guides

Array = np.ndarray

#: Pixels of its own mirror image around a picture while it is filtered. The network takes what lies beyond a picture
#: for black: an even grey came out with 0.93 to 1.16 of its light along the borders, and with 0.4 in a single pixel.
MARGIN = 16


def available() -> bool:
    """Whether `denoise_oidn` can work here."""
    try:
        require()
    except DeviceError:
        return False
    return True


def require() -> Callable[..., Array]:
    """The wheel's function; DeviceError, with what to do, where it is not installed or its libraries do not load."""
    try:
        from pyoidn import denoise
    except (ImportError, OSError) as error:
        raise DeviceError(
            "denoiser OIDN",
            f"cannot be loaded in the engine's Python ({error})",
            "Install it there with `pip install pyoidn`, or choose SVGF",
        ) from error
    return denoise


def denoise_oidn(
    components: Array, guides: Guides, split: bool = True, check: Callable[[], None] = lambda: None
) -> Array:
    """Filter the light of a picture on the CPU.

    Parameters
    ----------
    components : (h, w, 4, 3) float32 array
        Premultiplied light, see `shading_points.Radiance`; non-finite values count as black.
    guides : Guides
        Its coverage, albedo and normals; taken as free of noise.
    split : bool
        Filter each of the four components; else their sum alone, returned as the first (four times as fast).
    check : callable
        Called between runs; may raise to stop.

    Returns
    -------
    (h, w, 4, 3) float32 array
        0 where nothing is covered.

    Raises
    ------
    DeviceError: the wheel is not installed, or it cannot work on this machine.
    """
    run = require()
    cover = guides.coverage[..., None]
    albedo, normal = _widened(guides.albedo * cover), _widened(guides.normal * cover)
    light = np.nan_to_num(components, nan=0.0, posinf=0.0, neginf=0.0)
    out = np.zeros_like(light)
    noisy = [light[:, :, k] for k in range(4)] if split else [light.sum(axis=2)]
    for k, colour in enumerate(noisy):
        check()
        try:
            wide = run(_widened(colour), albedo, normal, hdr=True, clean_aux=True)
        except RuntimeError as error:
            raise DeviceError("denoiser OIDN", f"failed ({error})", "Choose SVGF") from error
        out[:, :, k] = np.where(cover > 0, wide[MARGIN:-MARGIN, MARGIN:-MARGIN], 0)
    return out


def _widened(picture: Array) -> Array:
    """(h, w, 3) with the margin, contiguous."""
    margin = (MARGIN, MARGIN)
    return np.ascontiguousarray(np.pad(picture, (margin, margin, (0, 0)), mode="symmetric"), np.float32)
