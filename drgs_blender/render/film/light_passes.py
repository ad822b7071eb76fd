"""Passes of light: which there are, and how they come from the light of pixels and add up to their beauty."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit, plain
from ...compute.threads import ROWS, over_range

Array = np.ndarray

#: Passes of light that are denoised, in the order of `Pixels.components`, and all: of the glossy ones' light, what
#: surfaces let pass is made passes of its own.
COMPONENTS = ("DiffDir", "DiffInd", "GlossDir", "GlossInd")
LIGHT_PASSES = (*COMPONENTS, "TransDir", "TransInd")


def light_parts(light: Array, noisy: Array, transmitted: Array | None, colours: dict[str, Array]) -> list[Array]:
    """Light of `LIGHT_PASSES`, (h, w, 3) float32 each; it adds up to that of the components.

    Denoisers carry light over to surfaces without lobes for it, by whose colour no pass can be divided: it goes to the
    first kind of lobe that there is.

    Parameters
    ----------
    light, noisy : (h, w, 4, 3) float32 array
        Components, denoised and not: of the denoised ones the same part passes surfaces as of the others.
    transmitted : (h, w, 2, 3) float32 array, optional
        Part of the glossy components of `noisy` that passes surfaces.
    colours : dict of str to array
        DiffCol, GlossCol and TransCol, as far as known.
    """
    parts = [light[:, :, i] for i in range(4)]
    if transmitted is None or not transmitted.any():
        return [*parts, *(np.zeros(parts[2].shape, np.float32) for _ in range(2))]
    through, whole = transmitted, noisy[:, :, 2:]
    if light is not noisy:
        through = light[:, :, 2:] * np.clip(np.where(whole > 0, through / np.where(whole > 0, whole, 1), 0), 0, 1)
    parts = [*parts[:2], *(parts[2 + i] - through[:, :, i] for i in range(2)), through[:, :, 0], through[:, :, 1]]
    known = [colours[name] != 0 for name in ("DiffCol", "GlossCol", "TransCol") if name in colours]
    if light is noisy or len(known) < 3:
        return parts
    for i in range(2):
        lost = sum(np.where(there, 0, part) for there, part in zip(known, parts[i::2]))
        for k, there in enumerate(known):
            parts[i + 2 * k] = np.where(there, parts[i + 2 * k] + lost, 0)
            lost = np.where(there, 0, lost)
    return parts


def add_light(light: Array, environment: Array, emission: Array, opaque: Array | np.float32) -> Array:
    """(h, w, 4) float32 Combined of (h, w, 4, 3) light, what is behind it and what surfaces emit, float32 all."""
    out = np.empty((*light.shape[:2], 4), np.float32)
    parts = (plain(part) for part in (light, environment, emission))
    over_range(_add, len(out), *parts, out, fewest=ROWS)
    out[..., 3] = opaque
    return out


@njit
def _add(y0, y1, light, environment, emission, out):  # type: ignore[no-untyped-def]
    for y in range(y0, y1):
        for x in range(out.shape[1]):
            for k in range(3):
                beauty = light[y, x, 0, k] + light[y, x, 1, k] + light[y, x, 2, k] + light[y, x, 3, k]
                out[y, x, k] = beauty + environment[y, x, k] + emission[y, x, k]
