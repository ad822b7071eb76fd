"""Wavefront batches of rays, stage by stage: arithmetic that vectorises, apart from what waits for memory or Embree.

A batch is two flat arrays, one of float32 and one of uint32, made of packets of `LANES` slots: field f of a slot lies
f * LANES behind its field 0 (`at`). Loops over the lanes of a packet have constant length, no call and no branch that
matters, so that LLVM turns them into vector code; table lookups stand in loops of their own, where the processor
overlaps their cache misses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from .. import sampling
from ..lights.environment import cell_at, cell_end, direction_in_cell, envmap_pdf, envmap_touch, first_cell, map_at
from ..lights.light_sampler import sample_light
from ..lights.product_sampling import block_of, in_cells_order
from ..sampling import INVERSE_PI, ONE, TWO, ZERO, F, U, luminance, mix, scrambled, unit
from . import brdf

Array = np.ndarray

LANES = 16

# float32 fields, in units of LANES. Position and frame of the surface that a ray leaves (N shading normal, M normal of
# the specular lobe, G geometric normal, V towards the viewer) ...
OX, OY, OZ, NX, NY, NZ, MX, MY, MZ, GX, GY, GZ, VX, VY, VZ = (LANES * i for i in range(15))
# ... its albedo, metallic, alpha squared, weight of the diffuse lobe
AR, AG, AB, METALLIC, A2, KD = (LANES * i for i in range(15, 21))
# the ray's direction, whether there is one (1 or 0), BRDF times cosine (diffuse, specular), density of cosine and GGX
LX, LY, LZ, LIVE, QR, QG, QB, SR, SG, SB, PC, PG = (LANES * i for i in range(21, 33))
# where the direction meets the map of the environment, and the density of light sampling
MU, MV, PE = (LANES * i for i in range(33, 36))
# of paths: throughput, part of the diffuse lobe in sampling; of light samples: radiance (distance in MU, density in MV)
TR, TG, TB, SHARE, ER, EG, EB = (LANES * i for i in range(36, 43))
# of a point's samples: how many each strategy draws there; where rays meet surfels: size of those that they start on
WC, WG, WE, WL, SIZE = (LANES * i for i in range(43, 48))
_FLOATS = 48 * LANES
# uint32 fields: three random numbers, the key of more, the owner (a point, or a path), a place in a table, the row of
# the normal in the light's tables, the object of the surfels that the ray starts on (or -1)
N0, N1, N2, KEY, OWNER, CELL, ROW, OWN = (LANES * i for i in range(8))
_INTS = 8 * LANES
#: All constants above count in LANES. A device has one lane: there they are divided by it, by this table.
IN_LANES = (
    "LANES", "_FLOATS", "_INTS",
    "OX", "OY", "OZ", "NX", "NY", "NZ", "MX", "MY", "MZ", "GX", "GY", "GZ", "VX", "VY", "VZ",
    "AR", "AG", "AB", "METALLIC", "A2", "KD",
    "LX", "LY", "LZ", "LIVE", "QR", "QG", "QB", "SR", "SG", "SB", "PC", "PG",
    "MU", "MV", "PE", "TR", "TG", "TB", "SHARE", "ER", "EG", "EB", "WC", "WG", "WE", "WL", "SIZE",
    "N0", "N1", "N2", "KEY", "OWNER", "CELL", "ROW", "OWN",
)  # fmt: skip

_TINY = F(1e-30)


class Batch(NamedTuple):
    """Rays that are worked off together, with what they start from and what they find; see this module's head.

    Attributes
    ----------
    floats : (packets * 48 * LANES,) float32 array
        Fields from OX to SIZE.
    ints : (packets * 8 * LANES,) uint32 array
        Fields from N0 to OWN.
    """

    floats: Array
    ints: Array


@njit
def batch(capacity):  # type: ignore[no-untyped-def]
    """A `Batch` with room for `capacity` slots."""
    packets = (capacity + LANES - 1) // LANES
    return Batch(np.zeros(packets * _FLOATS, np.float32), np.zeros(packets * _INTS, np.uint32))


@inlined
def at(slot):  # type: ignore[no-untyped-def]
    """Places of a slot's field 0 in the two arrays."""
    packet, lane = slot // LANES, slot % LANES
    return packet * _FLOATS + lane, packet * _INTS + lane


@inlined
def packets(count):  # type: ignore[no-untyped-def]
    """Packets that hold `count` slots."""
    return (count + LANES - 1) // LANES


@njit
def scramble(rays, count):  # type: ignore[no-untyped-def]
    """Turn N0 to N2, a Sobol' point with reversed bits, into random numbers; CELL is the key of the point set."""
    ints = rays.ints
    for p in range(packets(count)):
        c = p * _INTS
        for i in range(c, c + LANES):
            key = ints[i + CELL]
            ints[i + N0] = scrambled(ints[i + N0], mix(U(key + U(1))))
            ints[i + N1] = scrambled(ints[i + N1], mix(U(key + U(2))))
            ints[i + N2] = scrambled(ints[i + N2], mix(U(key + U(3))))


@inlined
def _cosine_direction(s, i, u, v):  # type: ignore[no-untyped-def]
    """World direction in proportion to the cosine."""
    nx, ny, nz = s[i + NX], s[i + NY], s[i + NZ]
    bx, by, bz, cx, cy, cz = sampling.basis(nx, ny, nz)
    x, y, z = sampling.cosine_hemisphere(u, v)
    return x * bx + y * cx + z * nx, x * by + y * cy + z * ny, x * bz + y * cz + z * nz


@inlined
def _ggx_direction(s, i, u, v):  # type: ignore[no-untyped-def]
    """World direction by visible normals."""
    mx, my, mz, vx, vy, vz = s[i + MX], s[i + MY], s[i + MZ], s[i + VX], s[i + VY], s[i + VZ]
    bx, by, bz, cx, cy, cz = sampling.basis(mx, my, mz)
    up = max(mx * vx + my * vy + mz * vz, F(1e-6))
    a2 = s[i + A2]
    bound, _ = brdf.vndf_terms(up, a2)
    ix, iy = bx * vx + by * vy + bz * vz, cx * vx + cy * vy + cz * vz
    x, y, z = brdf.sample_vndf(u, v, ix, iy, up, math.sqrt(a2), bound)
    return x * bx + y * cx + z * mx, x * by + y * cy + z * my, x * bz + y * cz + z * mz


@njit
def cosine_directions(rays, count):  # type: ignore[no-untyped-def]
    """Directions in proportion to the cosine."""
    s, ints = rays
    for p in range(packets(count)):
        b, c = p * _FLOATS, p * _INTS
        for k in range(LANES):
            i = b + k
            x, y, z = _cosine_direction(s, i, unit(ints[c + k + N0]), unit(ints[c + k + N1]))
            s[i + LX], s[i + LY], s[i + LZ] = x, y, z


@njit
def ggx_directions(rays, count):  # type: ignore[no-untyped-def]
    """Directions by visible normals."""
    s, ints = rays
    for p in range(packets(count)):
        b, c = p * _FLOATS, p * _INTS
        for k in range(LANES):
            i = b + k
            x, y, z = _ggx_direction(s, i, unit(ints[c + k + N0]), unit(ints[c + k + N1]))
            s[i + LX], s[i + LY], s[i + LZ] = x, y, z


@njit
def brdf_directions(rays, count):  # type: ignore[no-untyped-def]
    """Directions from the mixture of both lobes; CELL says which (1 diffuse, 0 specular)."""
    s, ints = rays
    for p in range(packets(count)):
        b, c = p * _FLOATS, p * _INTS
        for k in range(LANES):
            i = b + k
            u, v = unit(ints[c + k + N0]), unit(ints[c + k + N1])
            x0, y0, z0 = _cosine_direction(s, i, u, v)
            x1, y1, z1 = _ggx_direction(s, i, u, v)
            diffuse = unit(ints[c + k + N2]) < s[i + SHARE]
            s[i + LX] = x0 if diffuse else x1
            s[i + LY] = y0 if diffuse else y1
            s[i + LZ] = z0 if diffuse else z1
            ints[c + k + CELL] = U(1) if diffuse else U(0)


@njit
def environment_directions(rays, count, envmap):  # type: ignore[no-untyped-def]
    """Directions towards the environment in proportion to its light on the surface, with MU, MV and PE."""
    s, ints = rays
    for slot in range(count):
        _, c = at(slot)
        ints[c + CELL] = U(block_of(ints[c + ROW], ints[c + N2], envmap))
    for slot in range(count):
        i, c = at(slot)
        block = np.int64(ints[c + CELL])
        ints[c + N2], s[i + ER] = in_cells_order(ints[c + ROW], block, ints[c + N2], mix(ints[c + N2]), envmap)
    # One loop a table, without a branch that waits for the table: the cache misses of many slots overlap.
    for slot in range(count):
        _, c = at(slot)
        ints[c + CELL] = U(first_cell(ints[c + N2], envmap))
    for slot in range(count):
        i, c = at(slot)
        s[i + PE] = F(cell_end(ints[c + CELL], envmap))
    for slot in range(count):
        _, c = at(slot)
        place = ints[c + CELL]
        while ints[c + N2] > cell_end(place, envmap):
            place = U(place + U(1))
        ints[c + CELL] = place
    for slot in range(count):
        i, c = at(slot)
        _, column, s[i + MV], s[i + LZ], density = cell_at(ints[c + CELL], envmap)
        s[i + MU], s[i + PE] = F(column), density * s[i + ER]
    for p in range(packets(count)):
        b, c = p * _FLOATS, p * _INTS
        for k in range(LANES):
            i = b + k
            s[i + LX], s[i + LY], s[i + LZ], s[i + MU], s[i + MV] = direction_in_cell(
                s[i + MU], s[i + MV], s[i + LZ], ints[c + k + N0], ints[c + k + N1], envmap
            )


@njit
def light_directions(rays, count, lights):  # type: ignore[no-untyped-def]
    """Directions towards lights, with ER, EG, EB, distance, density (see ``sample_light``) and the light in CELL."""
    s, ints = rays
    for slot in range(count):
        i, c = at(slot)
        lx, ly, lz, distance, r, g, b, density, light = sample_light(
            ints[c + N2], ints[c + N0], ints[c + N1], s[i + OX], s[i + OY], s[i + OZ], lights
        )
        s[i + LX], s[i + LY], s[i + LZ], s[i + MU], s[i + MV] = lx, ly, lz, distance, density
        s[i + ER], s[i + EG], s[i + EB] = r, g, b
        ints[c + CELL] = U(max(light, 0))


@njit
def look_up(rays, count, envmap):  # type: ignore[no-untyped-def]
    """MU, MV and PE of directions that were not drawn from the environment."""
    s, ints = rays
    for p in range(packets(count)):
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            s[i + MU], s[i + MV] = map_at(s[i + LX], s[i + LY], s[i + LZ], envmap)
    for slot in range(count):
        i, c = at(slot)
        if s[i + LIVE] > ZERO:
            s[i + PE] = envmap_pdf(s[i + MU], s[i + MV], ints[c + ROW], envmap)


@njit
def warm(rays, count, envmap):  # type: ignore[no-untyped-def]
    """Fetch what `envmap_radiance` will read, all at once, long before it waits for it."""
    s = rays.floats
    for slot in range(count):
        i, _ = at(slot)
        if s[i + LIVE] > ZERO:
            s[i + ER] = envmap_touch(s[i + MU], s[i + MV], envmap)


@njit
def evaluate(rays, count, shading_model):  # type: ignore[no-untyped-def]
    """BRDF of both lobes times cosine, pdfs of cosine and GGX sampling, and LIVE: whether any light can pass.

    Light passes only above both the geometric and the shading normal: the shadow terminator of coarse meshes shows
    their faces, and is not softened.
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            lx, ly, lz = s[i + LX], s[i + LY], s[i + LZ]
            mx, my, mz, vx, vy, vz = s[i + MX], s[i + MY], s[i + MZ], s[i + VX], s[i + VY], s[i + VZ]
            nl = max(s[i + NX] * lx + s[i + NY] * ly + s[i + NZ] * lz, ZERO)
            ml = max(mx * lx + my * ly + mz * lz, ZERO)
            mv = mx * vx + my * vy + mz * vz
            # Cosine and sine of the half vector, and of half the angle between the directions.
            vl = vx * lx + vy * ly + vz * lz
            inverse = ONE / max(TWO + TWO * vl, _TINY)
            hx, hy, hz = vx + lx, vy + ly, vz + lz
            cx, cy, cz = my * hz - mz * hy, mz * hx - mx * hz, mx * hy - my * hx
            mh2, sin2 = (ml + mv) * (ml + mv) * inverse, (cx * cx + cy * cy + cz * cz) * inverse
            a2 = s[i + A2]
            _, norm = brdf.vndf_terms(max(mv, ZERO), a2)
            angles, albedo = (ml, mv, vl, mh2, sin2), (s[i + AR], s[i + AG], s[i + AB])
            qr, qg, qb, sr, sg, sb, pg = brdf.evaluate(
                angles, albedo, s[i + KD], s[i + METALLIC], a2, norm, shading_model
            )
            s[i + QR], s[i + QG], s[i + QB] = qr * nl, qg * nl, qb * nl
            above = ml > ZERO
            s[i + SR] = sr * ml if above else ZERO
            s[i + SG] = sg * ml if above else ZERO
            s[i + SB] = sb * ml if above else ZERO
            s[i + PC], s[i + PG] = nl * INVERSE_PI, pg if above else ZERO
            out = min(s[i + GX] * lx + s[i + GY] * ly + s[i + GZ] * lz, max(nl, ml))
            s[i + LIVE] = ONE if out > ZERO else ZERO


@inlined
def _factor(s, i, cosine, ggx):  # type: ignore[no-untyped-def]
    """One over the density of all strategies together for the slot at i."""
    brdf_density = cosine * s[i + WC] * s[i + PC] + ggx * s[i + WG] * s[i + PG]
    return ONE / max(brdf_density + s[i + WE] * s[i + PE], _TINY)


@inlined
def _scale(s, i, k):  # type: ignore[no-untyped-def]
    """Multiply both lobes of the slot at i."""
    s[i + QR], s[i + QG], s[i + QB] = s[i + QR] * k, s[i + QG] * k, s[i + QB] * k
    s[i + SR], s[i + SG], s[i + SB] = s[i + SR] * k, s[i + SG] * k, s[i + SB] * k


@inlined
def weigh_one(s, i, cosine, ggx):  # type: ignore[no-untyped-def]
    """`weigh` for the slot at i."""
    _scale(s, i, _factor(s, i, cosine, ggx))


@njit
def weigh(rays, count, cosine, ggx):  # type: ignore[no-untyped-def]
    """Divide by the density of all strategies together; the arguments (1 or 0) say whether these two take part."""
    s = rays.floats
    for p in range(packets(count)):
        # Two loops, for LLVM vectorises none that reads and writes this many arrays.
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            s[i + ER] = _factor(s, i, cosine, ggx)
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            _scale(s, i, s[i + ER])


@njit
def weigh_apart(rays, count):  # type: ignore[no-untyped-def]
    """`weigh` where cosine sampling is of the diffuse lobe alone, GGX sampling of the specular one alone."""
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            light = s[i + WE] * s[i + PE]
            k = ONE / max(s[i + WC] * s[i + PC] + light, _TINY)
            s[i + QR], s[i + QG], s[i + QB] = s[i + QR] * k, s[i + QG] * k, s[i + QB] * k
            k = ONE / max(s[i + WG] * s[i + PG] + light, _TINY)
            s[i + SR], s[i + SG], s[i + SB] = s[i + SR] * k, s[i + SG] * k, s[i + SB] * k


@njit
def drop(rays, count, lobe):  # type: ignore[no-untyped-def]
    """Take the lobe whose fields begin at `lobe` (QR or SR) out of the BRDF."""
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * _FLOATS + lobe, p * _FLOATS + lobe + 3 * LANES):
            s[i] = ZERO


@inlined
def diffuse_share(mv, r, g, b, kd, metallic, shading_model):  # type: ignore[no-untyped-def]
    """Probability of sampling the diffuse lobe, from what both reflect towards the viewer."""
    fr, fg, fb = brdf.fresnel(max(mv, ZERO), r, g, b, metallic, shading_model)
    diffuse = kd * luminance(r, g, b)
    share = min(max(diffuse / max(diffuse + luminance(fr, fg, fb), _TINY), F(0.1)), F(0.8))
    share = share if mv > ZERO else ONE
    return share if kd > ZERO else ZERO


@njit
def lobe_shares(rays, count, shading_model):  # type: ignore[no-untyped-def]
    """SHARE: how often the diffuse lobe is sampled."""
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            mv = s[i + MX] * s[i + VX] + s[i + MY] * s[i + VY] + s[i + MZ] * s[i + VZ]
            s[i + SHARE] = diffuse_share(mv, s[i + AR], s[i + AG], s[i + AB], s[i + KD], s[i + METALLIC], shading_model)


@njit
def carry(rays, count, light):  # type: ignore[no-untyped-def]
    """Put throughput times both lobes into QR, QG, QB, and what a path's samples are divided by into PG and PE.

    PG becomes the density of the mixture of lobes, PE the same plus `light` times the density of light sampling.
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * _FLOATS, p * _FLOATS + LANES):
            s[i + QR] = s[i + TR] * (s[i + QR] + s[i + SR])
            s[i + QG] = s[i + TG] * (s[i + QG] + s[i + SG])
            s[i + QB] = s[i + TB] * (s[i + QB] + s[i + SB])
            density = max(s[i + SHARE] * s[i + PC] + (ONE - s[i + SHARE]) * s[i + PG], _TINY)
            s[i + PG] = density
            s[i + PE] = density + light * s[i + PE]


@njit
def fresh_numbers(rays, count, step):  # type: ignore[no-untyped-def]
    """Move on to the next key and hash three random numbers from it."""
    ints = rays.ints
    for p in range(packets(count)):
        c = p * _INTS
        for i in range(c, c + LANES):
            key = U(ints[i + KEY] + step)
            ints[i + KEY] = key
            ints[i + N0] = mix(key)
            ints[i + N1] = mix(U(key + U(0x68E31DA4)))
            ints[i + N2] = mix(U(key + U(0xB5297A4D)))
