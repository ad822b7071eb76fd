"""Visibility of lights: the shadow rays of light samples, with what shadow linking and lamps without shadow change.

Shadow rays towards a light with shadow linking have a mask of its own (`light_links`); a lamp without shadow has none.
Rays of lobes see either before the nearest surface alone, and there weights are those of all lights.
Behind a surface that does not block the light, its own samples alone bring it, with the weight that they have in
Cycles: that of the power heuristic against the lobes, whose part is missing. So a rough surface is lit nearly in full,
and a mirror shows the surface, not the light behind it.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..lights.light_links import blockers_of, lights_of
from ..lights.light_sampler import light_flags
from ..lights.light_shapes import DIFFUSE, GLOSSY
from ..lights.light_shapes import SHADOW as SHADOWED
from ..lights.triangle_light import ABSENT
from ..sampling import ONE, ZERO, F
from ..scene import ray_masks
from . import wavefront as w
from .intersect import passed
from .mis import power_heuristic


@njit
def light_radiance(rays, slot, others, glossy_others, counts, receiver, scene, mask):  # type: ignore[no-untyped-def]
    """Radiance of a light sample times visibility and MIS weight over pdf, for the diffuse and the glossy lobe.

    Parameters
    ----------
    rays : Batch
        As `wavefront.light_directions` and `evaluate` left it.
    slot : int64
    others, glossy_others : float32
        Sum over the other strategies of count times pdf (sr^-1), for the diffuse and the glossy lobe.
    counts : tuple of float32
        Number of light samples, and of all samples of the other strategies.
    receiver : float32
        Set of the surface, see `light_links`.
    scene : Scene
    mask : int32
        Of the shadow ray, see `ray_masks`.

    Returns
    -------
    dr, dg, db, gr, gg, gb : float32
        For the diffuse and the glossy lobe, linear Rec.709, not yet times BRDF and cosine; 0 in shadow.
    """
    s, ints = rays
    i, c = w.at(slot)
    density = s[i + w.MV]
    r, g, b = s[i + w.ER], s[i + w.EG], s[i + w.EB]
    if not (s[i + w.LIVE] > ZERO and r + g + b > ZERO and density != ZERO):
        return ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    light = np.int64(ints[c + w.CELL])
    flags = light_flags(light, lights_of(scene.lights, receiver))
    if flags & ABSENT and mask >> ray_masks.WITHOUT:
        return ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    share, lobes = counts
    far = s[i + w.MU] * F(0.9999)
    bright, own, kind = ONE, blockers_of(scene.lights, receiver, light), mask // ray_masks.SHADOW
    if own != 0 and mask >> ray_masks.WITHOUT == 0:
        mask = own
    if flags & SHADOWED:
        bright = passed(scene, rays, slot, far, mask)
        if not bright > ZERO:
            return ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    if density < ZERO:
        others = glossy_others = ZERO
    density = share * abs(density)
    diffuse, glossy = bright / (others + density), bright / (glossy_others + density)
    if (own != 0 or not flags & SHADOWED) and others + glossy_others > ZERO:
        met = passed(scene, rays, slot, far, np.int32(kind * ray_masks.DIFFUSE))
        met_glossy = met
        if scene.traits.lobes_apart:
            met_glossy = passed(scene, rays, slot, far, np.int32(kind * ray_masks.GLOSSY))
        pdf = density / share
        behind = bright * power_heuristic(pdf, others / lobes) / density
        glossy_behind = bright * power_heuristic(pdf, glossy_others / lobes) / density
        diffuse, glossy = met * diffuse + (ONE - met) * behind, met_glossy * glossy + (ONE - met_glossy) * glossy_behind
    diffuse, glossy = diffuse if flags & DIFFUSE else ZERO, glossy if flags & GLOSSY else ZERO
    return r * diffuse, g * diffuse, b * diffuse, r * glossy, g * glossy, b * glossy
