"""Sample allocation: samples of each strategy at a shading point, with the ray origin and lobes that they share."""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit
from ..lights.product_sampling import product_row
from ..sampling import ONE, TWO, ZERO, F, U
from . import brdf
from . import wavefront as w
from .indirect import lifted
from .intersect import put_start
from .multiscatter import has_multiscatter, lobe_weights

#: Strategies. ``RenderSettings.strategy_samples`` has three counts: the third is of samples of the light, divided
#: between environment and lights.
COSINE, GGX, ENVIRONMENT, LIGHTS = range(4)
#: Columns of a point's state: start of the rays, alpha squared, normal m, samples of each strategy, weights of the
#: lobes (diffuse, metal by channel, dielectric).
ALPHA, NORMAL, COUNTS, WEIGHTS = 3, 4, 7, 11
POINT_STATE = 16
#: Part of the samples that go to the light where the surface is all diffuse, and for a specular lobe; less where that
#: is narrow: the part is `_LIGHT_GLOSSY` from this alpha on.
_LIGHT_DIFFUSE, _LIGHT_GLOSSY, _WIDE = F(0.75), F(0.5), F(0.03)
#: The same with bounces, where other surfaces' light is noisy too: of diffuse surfaces, where the environment has all
#: these samples, and of metals.
_LIGHT_ALONE, _LIGHT_METAL = F(0.625), F(0.25)


@njit
def _rounded(x):  # type: ignore[no-untyped-def]
    return F(np.int32(x + F(0.5)))


@njit
def _allocate(state, h, share, bounces, sampler):  # type: ignore[no-untyped-def]
    """Samples a pixel of each strategy at the h-th point; `share` is the diffuse lobe's part of what it reflects.

    Whole numbers in coarse steps: points of one pixel mostly agree, and then their samples add up to these numbers.
    """
    cosine, ggx, light = sampler.cosine, sampler.ggx, sampler.light
    envmap, lights = sampler.environment_share, sampler.lights_share
    if sampler.auto:
        total = cosine + ggx + light
        alpha = F(math.sqrt(state[h, ALPHA]))
        most = _LIGHT_METAL if share == ZERO and bounces > 0 else _LIGHT_GLOSSY
        glossy = most * min(ONE, max(F(0.05), alpha / _WIDE))
        diffuse = _LIGHT_ALONE if bounces > 0 and lights == ZERO else _LIGHT_DIFFUSE
        light = total * min(sampler.most_light, share * diffuse + (ONE - share) * glossy)
        light = light if envmap + lights > ZERO else ZERO
        ggx = (total - light) * (ONE - share)
        if total >= F(3.0):
            # At least one ray per lobe: light that only its rays find (`apart`) has no other strategy.
            step = max(ONE, F(np.int32(total / F(8.0))))
            light = step * _rounded(light / step)
            if lights > ZERO:
                # Lights without size are found by their own samples alone.
                light = max(light, TWO if envmap > ZERO else ONE)
            light = min(light, total - TWO)
            half = max(ONE, F(np.int32(step / TWO)))
            ggx = half * _rounded((total - light) * (ONE - share) / half)
            ggx = min(max(ggx, ONE), total - light - ONE) if share < ONE else ZERO
            ggx = ggx if share > ZERO else total - light
        cosine = total - light - ggx
    if envmap > ZERO and lights > ZERO and light >= TWO:
        envmap = min(max(_rounded(light * envmap), ONE), light - ONE) / light
        lights = ONE - envmap
    state[h, COUNTS + COSINE], state[h, COUNTS + GGX] = cosine, ggx
    state[h, COUNTS + ENVIRONMENT], state[h, COUNTS + LIGHTS] = light * envmap, light * lights


@njit
def write_point_states(first, last, points, scene, settings, sampler, scratch):  # type: ignore[no-untyped-def]
    """State shared by all samples of a point, see `POINT_STATE`, and its row in the light's tables.

    Alpha squared is -1 where the point is unusable.

    Parameters
    ----------
    first, last : int
        The points, half-open.
    points : PointArrays
    scene : Scene
    settings : Settings
    sampler : Sampler
    scratch : Scratch
        `state` and `row` are written.
    """
    origin, normal, flat, view = points.origin, points.normal, points.geometric_normal, points.viewer
    albedo, roughness, metallic = points.albedo, points.roughness, points.metallic
    state, row = scratch.state, scratch.row
    envmap, extent = scene.envmap, scene.traits.extent
    shading_model = settings.shading_model
    for i in range(first, last):
        h = i - first
        check = roughness[i] + metallic[i]
        for k in range(3):
            check += origin[i, k] + normal[i, k] + flat[i, k] + view[i, k] + albedo[i, k]
        if not abs(check) < F(1e18):
            state[h, ALPHA] = -ONE
            continue
        gx, gy, gz, vx, vy, vz = flat[i, 0], flat[i, 1], flat[i, 2], view[i, 0], view[i, 1], view[i, 2]
        state[h, 0], state[h, 1], state[h, 2] = lifted(origin[i, 0], origin[i, 1], origin[i, 2], gx, gy, gz, extent)
        mx, my, mz = brdf.glossy_normal(normal[i, 0], normal[i, 1], normal[i, 2], gx, gy, gz, vx, vy, vz)
        mv = mx * vx + my * vy + mz * vz
        own = albedo[i, 0], albedo[i, 1], albedo[i, 2]
        multiscatter = False
        if scene.traits.multiscatter and len(points.face) > 0:
            multiscatter = has_multiscatter(points.face[i], scene.geometry)
        weights = lobe_weights(mv, roughness[i], metallic[i], own, multiscatter, settings)
        state[h, ALPHA] = brdf.alpha_squared(roughness[i])
        state[h, WEIGHTS], metal, state[h, WEIGHTS + 4] = weights
        state[h, WEIGHTS + 1], state[h, WEIGHTS + 2], state[h, WEIGHTS + 3] = metal
        state[h, NORMAL], state[h, NORMAL + 1], state[h, NORMAL + 2] = mx, my, mz
        row[h] = U(product_row(normal[i, 0], normal[i, 1], normal[i, 2], envmap))
        _allocate(state, h, w.diffuse_share(mv, own, weights, shading_model), settings.bounces, sampler)


@njit
def put_sample(scene, rays, slot, points, i, state, h, rate):  # type: ignore[no-untyped-def]
    """Copy a shading point into a slot: surface, viewer, BRDF parameters and number of samples of each strategy.

    Parameters
    ----------
    scene : Scene
    rays : Batch
        Written: fields from OX to KD, WC to WL, OWNER, those of `put_start`, U where there are normal maps, and H and
        LIMIT where there are terminator offsets.
    slot : int64
    points : PointArrays
    i : int64
        The point's row.
    state : (block, POINT_STATE) float32 array
        As `write_point_states` left it.
    h : int64
        The point's row of `state`.
    rate : float32
        The point's part of its pixel's samples.
    """
    s, ints = rays
    normal, flat, view = points.normal, points.geometric_normal, points.viewer
    albedo = points.albedo
    a, c = w.at(slot)
    s[a + w.OX], s[a + w.OY], s[a + w.OZ] = state[h, 0], state[h, 1], state[h, 2]
    s[a + w.NX], s[a + w.NY], s[a + w.NZ] = normal[i, 0], normal[i, 1], normal[i, 2]
    s[a + w.MX], s[a + w.MY], s[a + w.MZ] = state[h, NORMAL], state[h, NORMAL + 1], state[h, NORMAL + 2]
    s[a + w.GX], s[a + w.GY], s[a + w.GZ] = flat[i, 0], flat[i, 1], flat[i, 2]
    s[a + w.VX], s[a + w.VY], s[a + w.VZ] = view[i, 0], view[i, 1], view[i, 2]
    s[a + w.AR], s[a + w.AG], s[a + w.AB] = albedo[i, 0], albedo[i, 1], albedo[i, 2]
    s[a + w.A2], s[a + w.KD], s[a + w.FD] = state[h, ALPHA], state[h, WEIGHTS], state[h, WEIGHTS + 4]
    s[a + w.FR], s[a + w.FG], s[a + w.FB] = state[h, WEIGHTS + 1], state[h, WEIGHTS + 2], state[h, WEIGHTS + 3]
    s[a + w.WC], s[a + w.WG] = state[h, COUNTS + COSINE] * rate, state[h, COUNTS + GGX] * rate
    s[a + w.WE], s[a + w.WL] = state[h, COUNTS + ENVIRONMENT] * rate, state[h, COUNTS + LIGHTS] * rate
    ints[c + w.OWNER] = U(h)
    if scene.traits.detailed:
        s[a + w.UX], s[a + w.UY], s[a + w.UZ] = ZERO, ZERO, ZERO
        if len(points.smooth) > 0:
            smooth = points.smooth
            s[a + w.UX], s[a + w.UY], s[a + w.UZ] = smooth[i, 0], smooth[i, 1], smooth[i, 2]
    if len(points.terminator) > 0:
        moved = points.terminator
        s[a + w.HX], s[a + w.HY], s[a + w.HZ], s[a + w.LIMIT] = moved[i, 0], moved[i, 1], moved[i, 2], moved[i, 3]
    put_start(scene.tracer, rays, slot, points, i)
