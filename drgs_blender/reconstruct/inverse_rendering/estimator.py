"""The rendering equation at pixels, with its derivatives: what arrives, before the surface's colours weigh it.

Of the BRDF only roughness and normal are inside the integral; albedo and metallic multiply four sums that every pixel
has, each of radiance L over the drawn directions, with the weight w of the balance heuristic:

    D  = sum w L cos / pi                 what a white Lambert surface reflects
    S  = sum w L lobe (1 - f),   f = (1 - v.h)^5, lobe = D G / (4 n.v), of GGX with height-correlated Smith
    P  = sum w L lobe f                   so that S F0 + P has Schlick's Fresnel
    E  = sum w L lobe fresnel             the exact dielectric of IOR 1.5

Directions and weights carry no derivative ("detached" sampling); radiance, roughness and normal do. Directions that
miss the object meet the environment, a table of texels; those that hit it the radiance cache.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_range
from ...render.integrator.brdf import fresnel_dielectric, ggx, sample_vndf, vndf_terms
from ...render.lights.environment import (
    EnvMap,
    cell_at,
    cell_end,
    direction_in_cell,
    envmap_pdf,
    first_cell,
    height_in_map,
    map_at,
)
from ...render.lights.product_sampling import block_of, in_cells_order, product_row
from ...render.sampling import (
    GOLDEN,
    INVERSE_PI,
    ONE,
    ZERO,
    F,
    U,
    basis,
    cosine_hemisphere,
    mix,
    scrambled,
    unit,
)
from ...render.scene.embree import trace
from ...render.scene.ray import Ray

Array = np.ndarray

#: Sums of a pixel: D, S, P, E of the module's text.
SUMS = 4
#: Fewest pixels for which another thread is worth while.
_FEW = 16
_NONE = np.int32(-1)


class Samples(NamedTuple):
    """Records of the drawn directions for `scatter`; (n, s, ...), s over both halves.

    Attributes
    ----------
    texel : (n, s, 4) int32 array
        Texels that a direction that misses the object reads; the first is -1 for any other direction.
    share : (n, s, 4) float32 array
        Of these texels.
    weight : (n, s, 4) float32 array
        Of the radiance in D, S, P, E.
    """

    texel: Array
    share: Array
    weight: Array


class Points(NamedTuple):
    """Pixels of one step.

    Attributes
    ----------
    origin, flat, towards : (n, 3) float32 array
        As in `Pixels`.
    key : (n,) uint32 array
        Of random numbers.
    turn : (n or 0, 3, 3) float32 array
        `View.turn` of their views; no rows where the light stands still in the world.
    """

    origin: Array
    flat: Array
    towards: Array
    key: Array
    turn: Array


class Lobes(NamedTuple):
    """Surface properties inside the integral.

    Attributes
    ----------
    normal : (n, 3) float32 array
        Unit shading normals.
    alpha2 : (n,) float32 array
        Square of GGX's alpha.
    """

    normal: Array
    alpha2: Array


class Plan(NamedTuple):
    """Sampling plan: how directions are drawn.

    Attributes
    ----------
    counts : (3,) int64 array
        Cosine, GGX and light samples of a pixel, even.
    sequence : (k, 3) uint32 array
        Points of a low discrepancy, scrambled pixel by pixel.
    """

    counts: Array
    sequence: Array


class Occluder(NamedTuple):
    """The mesh that rays meet.

    Attributes
    ----------
    intersect, scene : int
        Addresses, see `embree.trace`.
    faces : (m, 3) int32 array
    cache : (v, 4, 3) float32 array
        See `radiance_cache`.
    seen : bool
        Whether it has radiance; else it is black.
    lift : np.float32
        Metres above the surface from which rays start.
    """

    intersect: int
    scene: int
    faces: Array
    cache: Array
    seen: bool
    lift: np.float32


class Sky(NamedTuple):
    """The environment, met by rays that miss.

    Attributes
    ----------
    radiance : (height * width, 3) float32 array
        Lat-long, row by row.
    height, width : np.int32
    """

    radiance: Array
    height: np.int32
    width: np.int32


class Sums(NamedTuple):
    """Sums gathered per pixel, for either half of its samples.

    Attributes
    ----------
    values : (n, 2, SUMS, 3) float32 array
        D, S, P, E.
    by_a2 : (n, 2, SUMS, 3) float32 array
        Their derivatives by `Lobes.alpha2`.
    by_normal : (n or 0, 2, SUMS, 9) float32 array
        Channel by channel, those by the normal; no rows where they are not wanted.
    """

    values: Array
    by_a2: Array
    by_normal: Array


@njit
def _lobe(nl, nv, nh, sin2, a2):  # type: ignore[no-untyped-def]
    """D G / (4 nl nv), D, and derivatives of the logarithm of the former by a2, nl, nv and nh (on the unit sphere)."""
    value, d = ggx(nl, nv, nh * nh, sin2, a2)
    k = a2 * nh * nh + sin2
    rest = ONE - a2
    sv, sl = math.sqrt(a2 + rest * nv * nv), math.sqrt(a2 + rest * nl * nl)
    smith = nl * sv + nv * sl
    half = F(0.5)
    by_a2 = ONE / a2 - F(2.0) * nh * nh / k - half * (nl * (ONE - nv * nv) / sv + nv * (ONE - nl * nl) / sl) / smith
    by_nl = -(sv + nv * nl * rest / sl) / smith
    by_nv = -(sl + nl * nv * rest / sv) / smith
    by_nh = F(4.0) * nh * rest / k
    return value, d, by_a2, by_nl, by_nv, by_nh


@njit
def _bilinear(u, v, height, width):  # type: ignore[no-untyped-def]
    """Four texels and their shares at lat-long coordinates, wrapped in u and clamped in v."""
    x, y = u * F(width) - F(0.5), v * F(height) - F(0.5)
    y = min(max(y, ZERO), F(height - 1))
    c0, r0 = np.int32(x + ONE) - np.int32(1), np.int32(y)
    a, b = x - F(c0), y - F(r0)
    c1 = c0 + np.int32(1) if c0 + 1 < width else np.int32(0)
    c0 = np.int32(width - 1) if c0 < 0 else c0
    r1 = min(r0 + np.int32(1), np.int32(height - 1))
    i = (r0 * width + c0, r0 * width + c1, r1 * width + c0, r1 * width + c1)
    return i, ((ONE - a) * (ONE - b), a * (ONE - b), (ONE - a) * b, a * b)


@njit
def _cached(cache, a, b, c, u, v, dx, dy, dz, k):  # type: ignore[no-untyped-def]
    """Channel k of the radiance that leaves a face's point in a direction; never negative."""
    y0, band = F(0.28209479177387814), F(0.4886025119029199)
    total = ZERO
    for corner in range(3):
        vertex = a if corner == 0 else (b if corner == 1 else c)
        share = ONE - u - v if corner == 0 else (u if corner == 1 else v)
        of = y0 * cache[vertex, 0, k] + band * (
            dz * cache[vertex, 2, k] - dy * cache[vertex, 1, k] - dx * cache[vertex, 3, k]
        )
        total += share * max(of, ZERO)
    return total


@njit
def _turned(to_light, x, y, z):  # type: ignore[no-untyped-def]
    """A direction where the light stands still, from one of the world; the rotation row by row."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = to_light
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@njit
def _direction(strategy, numbers, normal, frame, view, alpha, bound, row, envmap, to_light):  # type: ignore[no-untyped-def]
    """Direction of a strategy (0 cosine, 1 GGX, 2 light) from three random uint32."""
    n0, n1, n2 = numbers
    nx, ny, nz = normal
    tx, ty, tz, bx, by, bz = frame
    if strategy == 2:
        number, _ = in_cells_order(row, block_of(row, n0, envmap), n0, n1, envmap)
        place = first_cell(number, envmap)
        while number > cell_end(place, envmap):
            place += 1
        column, upper, lower, a, b, c, d = cell_at(place, envmap)
        lx, ly, lz, _, _, _ = direction_in_cell(column, upper, lower, (a, b, c, d), n1, n2, envmap)
        xx, xy, xz, yx, yy, yz, zx, zy, zz = to_light
        return xx * lx + yx * ly + zx * lz, xy * lx + yy * ly + zy * lz, xz * lx + yz * ly + zz * lz
    if strategy == 0:
        x, y, z = cosine_hemisphere(unit(n0), unit(n1))
    else:
        vx, vy, vz = view
        ix, iy, iz = tx * vx + ty * vy + tz * vz, bx * vx + by * vy + bz * vz, nx * vx + ny * vy + nz * vz
        x, y, z = sample_vndf(unit(n0), unit(n1), ix, iy, iz, alpha, bound)
    return x * tx + y * bx + z * nx, x * ty + y * by + z * ny, x * tz + y * bz + z * nz


@njit
def _texels(radiance, t, p, k):  # type: ignore[no-untyped-def]
    """Channel k of four texels by their shares."""
    first = p[0] * radiance[t[0], k] + p[1] * radiance[t[1], k]
    return first + p[2] * radiance[t[2], k] + p[3] * radiance[t[3], k]


@njit
def gather_point(i, points, lobes, plan, occluder, sky, envmap, sums, samples):  # type: ignore[no-untyped-def]
    """Estimate the integrals of one pixel: all its samples, with MIS weights, into `Sums` and `Samples`.

    Parameters
    ----------
    i : int64
        Pixel.
    points : Points
    lobes : Lobes
    plan : Plan
    occluder : Occluder
    sky : Sky
    envmap : EnvMap
        From which light samples are drawn.
    sums : Sums
        Row `i` is written.
    samples : Samples
        Row `i` is written.
    """
    origin, flat, towards, key, turn = points
    normals, a2s = lobes
    counts, sequence = plan
    intersect, scene, faces, cache, seen, lift = occluder
    radiance, height, width = sky
    values, by_a2, by_normal = sums
    texel, share, weights = samples
    learn_normals, turned = by_normal.shape[0] > 0, turn.shape[0] > 0
    to_light = ONE, ZERO, ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ONE
    if turned:
        to_light = (
            turn[i, 0, 0], turn[i, 0, 1], turn[i, 0, 2], turn[i, 1, 0], turn[i, 1, 1], turn[i, 1, 2], turn[i, 2, 0],
            turn[i, 2, 1], turn[i, 2, 2],
        )  # fmt: skip
    nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
    gx, gy, gz = flat[i, 0], flat[i, 1], flat[i, 2]
    vx, vy, vz = towards[i, 0], towards[i, 1], towards[i, 2]
    ox, oy, oz = origin[i, 0] + lift * gx, origin[i, 1] + lift * gy, origin[i, 2] + lift * gz
    nv = nx * vx + ny * vy + nz * vz
    a2 = a2s[i]
    alpha = F(math.sqrt(a2))
    bound, norm = vndf_terms(max(nv, F(1e-4)), a2)
    frame = basis(nx, ny, nz)
    lx, ly, lz = _turned(to_light, nx, ny, nz)
    row = product_row(lx, ly, lz, envmap)
    place = 0
    for half in range(2):
        for strategy in range(3):
            own = mix(U(mix(key[i]) + U(U(3 * half + strategy + 1) * GOLDEN)))
            for j in range(counts[strategy] // 2):
                s = place
                place += 1
                texel[i, s, 0] = _NONE
                if strategy == 1 and not nv > ZERO:
                    continue
                n0 = scrambled(sequence[j, 0], mix(U(own + U(1))))
                n1 = scrambled(sequence[j, 1], mix(U(own + U(2))))
                n2 = scrambled(sequence[j, 2], mix(U(own + U(3))))
                dx, dy, dz = _direction(
                    strategy, (n0, n1, n2), (nx, ny, nz), frame, (vx, vy, vz), alpha, bound, row, envmap, to_light
                )
                nl = nx * dx + ny * dy + nz * dz
                if not (nl > F(1e-6) and gx * dx + gy * dy + gz * dz > ZERO):
                    continue
                hx, hy, hz = vx + dx, vy + dy, vz + dz
                scale = ONE / math.sqrt(max(hx * hx + hy * hy + hz * hz, F(1e-20)))
                hx, hy, hz = hx * scale, hy * scale, hz * scale
                nh, vh = nx * hx + ny * hy + nz * hz, min(max(vx * hx + vy * hy + vz * hz, ZERO), ONE)
                cx, cy, cz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
                value, density, l_a2, l_nl, l_nv, l_nh = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
                if nv > ZERO:
                    value, density, l_a2, l_nl, l_nv, l_nh = _lobe(nl, nv, nh, cx * cx + cy * cy + cz * cz, a2)
                lx, ly, lz = _turned(to_light, dx, dy, dz)
                u, v = map_at(lx, ly, lz, envmap)
                total = F(counts[0]) * nl * INVERSE_PI + F(counts[1]) * density * norm
                if counts[2] > 0:
                    total += F(counts[2]) * envmap_pdf(u, v, height_in_map(lx, ly, lz, envmap), row, envmap)
                if not total > F(1e-12):
                    continue
                w = ONE / total
                lobe = w * value * nl
                x = ONE - vh
                f = x * x
                f = f * f * x
                w0, w1, w2, w3 = w * nl * INVERSE_PI, lobe * (ONE - f), lobe * f, lobe * fresnel_dielectric(vh)
                ray = Ray((ox, oy, oz), (dx, dy, dz), ZERO, F(np.inf), _NONE)
                _, group, face, _, hu, hv, _, _, _ = trace(intersect, scene, ray)
                if group >= 0:
                    if not seen:
                        continue
                    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                    ex, ey, ez = -dx, -dy, -dz
                    if turned:  # the cache has seen this light from this side alone
                        ex, ey, ez = vx, vy, vz
                    red = _cached(cache, a, b, c, hu, hv, ex, ey, ez, 0)
                    green = _cached(cache, a, b, c, hu, hv, ex, ey, ez, 1)
                    blue = _cached(cache, a, b, c, hu, hv, ex, ey, ez, 2)
                else:
                    four, parts = _bilinear(u, v, height, width)
                    red, green, blue = (
                        _texels(radiance, four, parts, 0),
                        _texels(radiance, four, parts, 1),
                        _texels(radiance, four, parts, 2),
                    )
                    texel[i, s, 0], texel[i, s, 1], texel[i, s, 2], texel[i, s, 3] = four
                    share[i, s, 0], share[i, s, 1], share[i, s, 2], share[i, s, 3] = parts
                    weights[i, s, 0], weights[i, s, 1], weights[i, s, 2], weights[i, s, 3] = w0, w1, w2, w3
                for k in range(3):
                    light = red if k == 0 else (green if k == 1 else blue)
                    values[i, half, 0, k] += w0 * light
                    values[i, half, 1, k] += w1 * light
                    values[i, half, 2, k] += w2 * light
                    values[i, half, 3, k] += w3 * light
                    by_a2[i, half, 1, k] += l_a2 * w1 * light
                    by_a2[i, half, 2, k] += l_a2 * w2 * light
                    by_a2[i, half, 3, k] += l_a2 * w3 * light
                if learn_normals:
                    along = l_nl + ONE / nl
                    for axis in range(3):
                        l = dx if axis == 0 else (dy if axis == 1 else dz)
                        h = hx if axis == 0 else (hy if axis == 1 else hz)
                        e = vx if axis == 0 else (vy if axis == 1 else vz)
                        slope = along * l + l_nv * e + l_nh * h
                        for k in range(3):
                            light = red if k == 0 else (green if k == 1 else blue)
                            by_normal[i, half, 0, 3 * k + axis] += w0 / nl * l * light
                            by_normal[i, half, 1, 3 * k + axis] += w1 * slope * light
                            by_normal[i, half, 2, 3 * k + axis] += w2 * slope * light
                            by_normal[i, half, 3, 3 * k + axis] += w3 * slope * light


def gather(
    points: Points, lobes: Lobes, plan: Plan, occluder: Occluder, sky: Sky, envmap: EnvMap, sums: Sums, samples: Samples
) -> None:
    """`gather_point` of all points; light samples are drawn by the envmap."""
    given = points, lobes, plan, occluder, sky, envmap, sums, samples
    over_range(_gather, len(lobes.alpha2), *given, fewest=_FEW)


@njit
def _gather(first, last, points, lobes, plan, occluder, sky, envmap, sums, samples):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        gather_point(i, points, lobes, plan, occluder, sky, envmap, sums, samples)


def scatter(samples: Samples, gradient: Array, parts: Array) -> None:
    """Sum what each texel's radiance is worth to the loss, in parts of pixels.

    Parameters
    ----------
    samples : Samples
    gradient : (n, 2, SUMS, 3) float32 array
        Of the loss by the sums.
    parts : (p, texels, 3) float32 array
        Is added to, each by its own part of the pixels.
    """
    over_range(_scatter, len(parts), *samples, gradient, parts)


@njit
def _scatter(first, last, texel, share, weight, gradient, parts):  # type: ignore[no-untyped-def]
    n, samples = texel.shape[:2]
    for part in range(first, last):
        own = parts[part]
        for i in range(part * n // len(parts), (part + 1) * n // len(parts)):
            for s in range(samples):
                if texel[i, s, 0] < 0:
                    continue
                half = 2 * s // samples
                red = green = blue = ZERO
                for q in range(4):
                    w, of = weight[i, s, q], gradient[i, half, q]
                    red, green, blue = red + w * of[0], green + w * of[1], blue + w * of[2]
                for q in range(4):
                    to, w = own[texel[i, s, q]], share[i, s, q]
                    to[0] += w * red
                    to[1] += w * green
                    to[2] += w * blue
