"""Light at the visible points: multi-strategy direct light with ray-traced visibility, then a path traced on.

See docs/rendering.md for the estimator. Everything here runs per point, in blocks, in parallel; a point's result
depends on nothing but the point, the scene, the light, the settings, the seed and the frame number.
"""

from __future__ import annotations

import math

import numpy as np

from ..errors import UsageError
from ..frame import RenderSettings
from ..jit import get_num_threads, njit, prange
from . import brdf, sampling
from .embree import closest_hit, occluded
from .light import EnvironmentLight, density_at, radiance_at, sample_map, to_map
from .points import Radiance, ShadingPoints
from .sampling import GOLDEN, INVERSE_PI, ONE, TWO, ZERO, F, U, mix, unit
from .scene import TraceScene

Array = np.ndarray

_FAR = F(np.inf)
_BLOCK = 64
_RED, _GREEN, _BLUE = F(0.2126), F(0.7152), F(0.0722)
_TINY = F(1e-30)
#: Ray offset from the surface: relative to the point's own and to the scene's largest coordinate.
_OFFSET_POINT, _OFFSET_SCENE = F(1e-5), F(2e-6)
#: Russian roulette starts after this many bounces.
_SURE_BOUNCES = 3


def integrate(
    scene: TraceScene, light: EnvironmentLight, points: ShadingPoints, settings: RenderSettings, frame_number: int
) -> Radiance:
    """Light that leaves `points` towards the camera.

    Parameters
    ----------
    scene, light : what rays meet, and what they see when they meet nothing
    points : visible points, world space
    settings : ``cosine``, ``ggx`` and ``environment`` samples a pixel, divided among its ``aa`` sub-samples;
        ``bounces``, ``look``, ``seed``
    frame_number : int, part of the seed

    Returns
    -------
    Radiance
        Linear Rec.709, never NaN or Inf. A point with a coordinate that is not finite stays black.

    Raises
    ------
    UsageError
        When settings are out of range.
    """
    counts = (settings.cosine, settings.ggx, settings.environment)
    if min(counts) < 0 or settings.bounces < 0 or settings.aa < 1:
        raise UsageError(
            "render settings", "samples, bounces or aa are negative", "Use counts of zero or more, aa >= 1"
        )
    if settings.look not in brdf.LOOKS:
        raise UsageError("render settings", f"look {settings.look!r} is unknown", "Use principled or paper")
    n = len(points)
    components, variance = np.zeros((n, 4, 3), np.float32), np.zeros((n, 2), np.float32)
    if n == 0 or light.black or sum(counts) == 0:
        return Radiance(components, variance)
    _kernel(
        (points.pixel, points.sample),
        (points.origin, points.normal, points.geometric_normal, points.view),
        (points.albedo, points.roughness, points.metallic),
        (scene.bvh.intersect_address, scene.bvh.occluded_address, scene.bvh.scene),
        (scene.shading_faces, scene.shading, F(scene.extent)),
        (light.texels, light.cells, light.guide, light.row_z, light.rotation),
        brdf.layer_table(),
        (
            sampling.sobol(max(counts)),
            np.array(counts, np.int32),
            np.array([(1 << (32 - max(0, (n - 1).bit_length()))) - 1 for n in counts], np.uint32),
        ),
        settings.aa,
        settings.bounces,
        brdf.LOOKS[settings.look],
        U(mixed(settings.seed, frame_number)),
        8 * get_num_threads(),
        components,
        variance,
    )
    return Radiance(components, variance)


def mixed(seed: int, frame_number: int) -> int:
    """One 32-bit key of the job's seed and the frame's number."""
    value = (seed * 0x9E3779B97F4A7C15 + (frame_number + 1) * 0xD1B54A32D192ED03) & (2**64 - 1)
    value ^= value >> 32
    value = value * 0xD6E8FEB86659FD93 & (2**64 - 1)
    return value >> 32


@njit
def _offset(px, py, pz, gx, gy, gz, extent):  # type: ignore[no-untyped-def]
    """Lift a ray's start off the surface by more than rounding can push it below."""
    lift = _OFFSET_POINT * max(abs(px), max(abs(py), abs(pz))) + _OFFSET_SCENE * extent
    return px + lift * gx, py + lift * gy, pz + lift * gz


@njit
def _half_vector(nx, ny, nz, vx, vy, vz, lx, ly, lz, nl, nv):  # type: ignore[no-untyped-def]
    """(v . l, cos^2, sin^2) of the angle between the normal and the half vector."""
    vl = vx * lx + vy * ly + vz * lz
    inverse = ONE / max(TWO + TWO * vl, _TINY)
    hx, hy, hz = vx + lx, vy + ly, vz + lz
    cx, cy, cz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
    return vl, (nl + nv) * (nl + nv) * inverse, (cx * cx + cy * cy + cz * cz) * inverse


@njit
def _beyond(ox, oy, oz, dx, dy, dz, hit, tracer, geometry, light, table, look, bounces, key):  # type: ignore[no-untyped-def]
    """Radiance that comes back along a ray that hit a surface: a path of up to `bounces` vertices from that hit on.

    At each vertex one environment sample and one BRDF sample, combined by the balance heuristic.
    """
    intersect_address, occluded_address, tree = tracer
    shading_faces, shading, extent = geometry
    texels, cells, guide, row_z, rotation = light
    red = green = blue = ZERO
    tr = tg = tb = ONE
    t, face, hu, hv, gx, gy, gz = hit
    for bounce in range(bounces):
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        i, j, k = shading_faces[face, 0], shading_faces[face, 1], shading_faces[face, 2]
        hw = ONE - hu - hv
        nx = hw * shading[i, 0] + hu * shading[j, 0] + hv * shading[k, 0]
        ny = hw * shading[i, 1] + hu * shading[j, 1] + hv * shading[k, 1]
        nz = hw * shading[i, 2] + hu * shading[j, 2] + hv * shading[k, 2]
        ar = hw * shading[i, 3] + hu * shading[j, 3] + hv * shading[k, 3]
        ag = hw * shading[i, 4] + hu * shading[j, 4] + hv * shading[k, 4]
        ab = hw * shading[i, 5] + hu * shading[j, 5] + hv * shading[k, 5]
        roughness = hw * shading[i, 6] + hu * shading[j, 6] + hv * shading[k, 6]
        metallic = hw * shading[i, 7] + hu * shading[j, 7] + hv * shading[k, 7]
        # Both sides are the same: the geometric normal faces the ray, the shading normal follows it.
        scale = ONE / math.sqrt(max(gx * gx + gy * gy + gz * gz, _TINY))
        if gx * dx + gy * dy + gz * dz > ZERO:
            scale = -scale
        gx, gy, gz = gx * scale, gy * scale, gz * scale
        length = nx * nx + ny * ny + nz * nz
        if length > F(1e-12):
            scale = ONE / math.sqrt(length)
            if gx * nx + gy * ny + gz * nz < ZERO:
                scale = -scale
            nx, ny, nz = nx * scale, ny * scale, nz * scale
        else:
            nx, ny, nz = gx, gy, gz
        ox, oy, oz = _offset(px, py, pz, gx, gy, gz, extent)
        vx, vy, vz = -dx, -dy, -dz
        nv = nx * vx + ny * vy + nz * vz
        a2 = brdf.alpha_squared(roughness)
        kd = brdf.diffuse_weight(roughness, metallic, nv, look, table)
        bound, norm, share = ZERO, ZERO, ONE
        if nv > ZERO:
            bound, norm = brdf.vndf_terms(nv, a2)
            fr, fg, fb = brdf.fresnel(nv, ar, ag, ab, metallic, look)
            diffuse = kd * (_RED * ar + _GREEN * ag + _BLUE * ab)
            glossy = _RED * fr + _GREEN * fg + _BLUE * fb
            share = min(max(diffuse / max(diffuse + glossy, _TINY), F(0.1)), F(0.9))
        rest = ONE - share

        key = U(key + GOLDEN)
        n0, n1 = mix(key), mix(U(key + U(0x68E31DA4)))
        n2 = mix(U(key + U(0xB5297A4D)))
        lx, ly, lz, u, v, pe = sample_map(n0, n1, n2, texels, cells, guide, row_z, rotation)
        nl = nx * lx + ny * ly + nz * lz
        if nl > ZERO and gx * lx + gy * ly + gz * lz > ZERO:
            vl, nh2, sin2 = _half_vector(nx, ny, nz, vx, vy, vz, lx, ly, lz, nl, nv)
            qr, qg, qb, sr, sg, sb, pg = brdf.evaluate(nl, nv, vl, nh2, sin2, ar, ag, ab, kd, metallic, a2, norm, look)
            er, eg, eb = radiance_at(u, v, texels)
            weight = nl / (pe + share * nl * INVERSE_PI + rest * pg)
            er, eg, eb = tr * er * (qr + sr) * weight, tg * eg * (qg + sg) * weight, tb * eb * (qb + sb) * weight
            if er + eg + eb > ZERO and not occluded(occluded_address, tree, ox, oy, oz, lx, ly, lz, ZERO, _FAR):
                red, green, blue = red + er, green + eg, blue + eb

        bx, by, bz, cx, cy, cz = sampling.basis(nx, ny, nz)
        n0, n1, n2 = mix(U(key + U(0x7FEB352D))), mix(U(key + U(0x2C1B3C6D))), mix(U(key + U(0x297A2D39)))
        if unit(n2) < share:
            x, y, z = sampling.cosine_hemisphere(unit(n0), unit(n1))
        else:
            x, y = bx * vx + by * vy + bz * vz, cx * vx + cy * vy + cz * vz
            x, y, z = brdf.sample_vndf(unit(n0), unit(n1), x, y, nv, math.sqrt(a2), bound)
        lx, ly, lz = x * bx + y * cx + z * nx, x * by + y * cy + z * ny, x * bz + y * cz + z * nz
        nl = z
        if not (nl > ZERO and gx * lx + gy * ly + gz * lz > ZERO):
            break
        vl, nh2, sin2 = _half_vector(nx, ny, nz, vx, vy, vz, lx, ly, lz, nl, nv)
        qr, qg, qb, sr, sg, sb, pg = brdf.evaluate(nl, nv, vl, nh2, sin2, ar, ag, ab, kd, metallic, a2, norm, look)
        pb = share * nl * INVERSE_PI + rest * pg
        fr, fg, fb = tr * (qr + sr) * nl, tg * (qg + sg) * nl, tb * (qb + sb) * nl
        last = bounce + 1 == bounces
        if last:
            free = not occluded(occluded_address, tree, ox, oy, oz, lx, ly, lz, ZERO, _FAR)
        else:
            t, face, hu, hv, gx, gy, gz = closest_hit(intersect_address, tree, ox, oy, oz, lx, ly, lz, ZERO, _FAR)
            free = face < 0
        if free:
            u, v = to_map(lx, ly, lz, rotation)
            er, eg, eb = radiance_at(u, v, texels)
            weight = ONE / (pb + density_at(u, v, texels))
            red, green, blue = red + fr * er * weight, green + fg * eg * weight, blue + fb * eb * weight
        if free or last:
            break
        weight = ONE / pb
        tr, tg, tb = fr * weight, fg * weight, fb * weight
        if bounce + 1 >= _SURE_BOUNCES:
            survive = min(ONE, max(tr, max(tg, tb)))
            if not unit(mix(U(key + U(0x165667B1)))) < survive:
                break
            tr, tg, tb = tr / survive, tg / survive, tb / survive
        dx, dy, dz = lx, ly, lz
    return red, green, blue


@njit
def _point(  # type: ignore[no-untyped-def]
    pixel, sample, surface, frame, tracer, geometry, light, table, numbers, aa, bounces, look, seed, components,
    variance, i,
):  # fmt: skip
    """All samples of one visible point."""
    ox, oy, oz, nx, ny, nz, gx, gy, gz, vx, vy, vz = frame
    ar, ag, ab, roughness, metallic = surface
    intersect_address, _, tree = tracer
    sequence, counts, strata = numbers
    texels, cells, guide, row_z, rotation = light
    ox, oy, oz = _offset(ox, oy, oz, gx, gy, gz, geometry[2])
    nv = nx * vx + ny * vy + nz * vz
    a2 = brdf.alpha_squared(roughness)
    alpha = math.sqrt(a2)
    kd = brdf.diffuse_weight(roughness, metallic, nv, look, table)
    bound, norm = brdf.vndf_terms(max(nv, ZERO), a2)
    bx, by, bz, cx, cy, cz = sampling.basis(nx, ny, nz)
    ix, iy = bx * vx + by * vy + bz * vz, cx * vx + cy * vy + cz * vz
    share = ONE / F(aa)
    n_cosine, n_ggx, n_light = F(counts[0]) * share, F(counts[1]) * share, F(counts[2]) * share
    pixel_key = mix(U(seed ^ mix(U(pixel))))
    diffuse_1 = diffuse_2 = glossy_1 = glossy_2 = ZERO
    total = 0
    for strategy in range(3):
        key = mix(U(pixel_key + U(U(strategy + 1) * GOLDEN)))
        # The point set fills strata of 2^32 / n; below them every point is moved by itself.
        below = strata[strategy]
        shift_0, shift_1 = U(mix(U(key + U(1))) & ~below), U(mix(U(key + U(2))) & ~below)
        shift_2 = U(mix(U(key + U(3))) & ~below)
        # This sub-sample's part of the pixel's samples: n / aa on average, n over all sub-samples together.
        dither = unit(mix(U(key + U(4)))) if counts[strategy] % aa else ZERO
        step = F(counts[strategy]) * share
        first = np.int32(F(sample) * step + dither)
        past = np.int32(F(sample + 1) * step + dither) if sample + 1 < aa else counts[strategy]
        for j in range(first, past):
            total += 1
            own = mix(U(key ^ U(U(j + 1) * U(0x85EBCA6B))))
            n0 = U((sequence[j, 0] ^ shift_0) + (mix(U(own + U(5))) & below))
            n1 = U((sequence[j, 1] ^ shift_1) + (mix(U(own + U(6))) & below))
            u = v = pe = ZERO
            if strategy == 2:
                n2 = U((sequence[j, 2] ^ shift_2) + (mix(U(own + U(7))) & below))
                lx, ly, lz, u, v, pe = sample_map(n2, n0, n1, texels, cells, guide, row_z, rotation)
                nl = nx * lx + ny * ly + nz * lz
            else:
                if strategy == 0:
                    x, y, nl = sampling.cosine_hemisphere(unit(n0), unit(n1))
                elif nv > ZERO:
                    x, y, nl = brdf.sample_vndf(unit(n0), unit(n1), ix, iy, nv, alpha, bound)
                else:
                    continue
                lx, ly, lz = x * bx + y * cx + nl * nx, x * by + y * cy + nl * ny, x * bz + y * cz + nl * nz
            if not (nl > ZERO and gx * lx + gy * ly + gz * lz > ZERO):
                continue
            vl, nh2, sin2 = _half_vector(nx, ny, nz, vx, vy, vz, lx, ly, lz, nl, nv)
            qr, qg, qb, sr, sg, sb, pg = brdf.evaluate(nl, nv, vl, nh2, sin2, ar, ag, ab, kd, metallic, a2, norm, look)
            hit = closest_hit(intersect_address, tree, ox, oy, oz, lx, ly, lz, ZERO, _FAR)
            free = hit[1] < 0
            if not free and bounces == 0:
                continue
            if strategy != 2:
                u, v = to_map(lx, ly, lz, rotation)
                pe = density_at(u, v, texels)
            if free:
                er, eg, eb = radiance_at(u, v, texels)
                row = 0
            else:
                er, eg, eb = _beyond(ox, oy, oz, lx, ly, lz, hit, tracer, geometry, light, table, look, bounces, own)
                row = 1
            weight = nl / (n_cosine * nl * INVERSE_PI + n_ggx * pg + n_light * pe)
            er, eg, eb = er * weight, eg * weight, eb * weight
            qr, qg, qb, sr, sg, sb = qr * er, qg * eg, qb * eb, sr * er, sg * eg, sb * eb
            components[i, row, 0] += qr
            components[i, row, 1] += qg
            components[i, row, 2] += qb
            components[i, row + 2, 0] += sr
            components[i, row + 2, 1] += sg
            components[i, row + 2, 2] += sb
            value = _RED * qr + _GREEN * qg + _BLUE * qb
            diffuse_1, diffuse_2 = diffuse_1 + value, diffuse_2 + value * value
            value = _RED * sr + _GREEN * sg + _BLUE * sb
            glossy_1, glossy_2 = glossy_1 + value, glossy_2 + value * value
    # Variance of a sum of `total` samples, from their spread; from one sample alone, its square.
    if total > 1:
        count = F(total)
        scale = count / (count - ONE)
        diffuse_2 = max(ZERO, diffuse_2 - diffuse_1 * diffuse_1 / count) * scale
        glossy_2 = max(ZERO, glossy_2 - glossy_1 * glossy_1 / count) * scale
    variance[i, 0], variance[i, 1] = diffuse_2, glossy_2


@njit(parallel=True)
def _kernel(  # type: ignore[no-untyped-def]
    keys, frames, surfaces, tracer, geometry, light, table, numbers, aa, bounces, look, seed, lanes,
    components, variance,
):  # fmt: skip
    pixel, sample = keys
    origin, normal, flat, view = frames
    albedo, roughness, metallic = surfaces
    n = len(pixel)
    blocks = (n + _BLOCK - 1) // _BLOCK
    # Threads get neighbouring lanes, lanes get every so-manyth block: no thread is left with all the costly ones.
    for lane in prange(lanes):
        for block in range(lane, blocks, lanes):
            for i in range(block * _BLOCK, min(n, (block + 1) * _BLOCK)):
                # No views of rows: each would count references, and the threads would wait for each other's counts.
                check = roughness[i] + metallic[i]
                for k in range(3):
                    check += origin[i, k] + normal[i, k] + flat[i, k] + view[i, k] + albedo[i, k]
                if not abs(check) < F(1e18):
                    continue
                frame = (
                    origin[i, 0], origin[i, 1], origin[i, 2], normal[i, 0], normal[i, 1], normal[i, 2],
                    flat[i, 0], flat[i, 1], flat[i, 2], view[i, 0], view[i, 1], view[i, 2],
                )  # fmt: skip
                surface = (albedo[i, 0], albedo[i, 1], albedo[i, 2], roughness[i], metallic[i])
                _point(
                    pixel[i], sample[i], surface, frame, tracer, geometry, light, table, numbers, aa, bounces,
                    look, seed, components, variance, i,
                )  # fmt: skip
