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
from ..lights.environment import (
    cell_at,
    cell_end,
    direction_in_cell,
    envmap_pdf,
    envmap_touch,
    first_cell,
    height_in_map,
    map_at,
)
from ..lights.light_links import lights_of
from ..lights.light_sampler import sample_light
from ..lights.product_sampling import block_of, in_cells_order
from ..sampling import INVERSE_PI, ONE, TWO, ZERO, F, U, luminance, mix, scrambled, unit
from . import brdf

Array = np.ndarray

LANES = 16

# float32 fields, in units of LANES. Position and frame of the surface that a ray leaves (N shading normal, M normal of
# the specular lobe, G geometric normal, V towards the viewer) ...
OX, OY, OZ, NX, NY, NZ, MX, MY, MZ, GX, GY, GZ, VX, VY, VZ = (LANES * i for i in range(15))
# ... its albedo, weight of the metal by channel and of the dielectric layer, alpha squared, weight of the diffuse lobe
AR, AG, AB, FR, FG, FB, FD, A2, KD = (LANES * i for i in range(15, 24))
# the ray's direction, whether there is one (1 or 0), BRDF times cosine (diffuse, specular), density of cosine and GGX
LX, LY, LZ, LIVE, QR, QG, QB, SR, SG, SB, PC, PG = (LANES * i for i in range(24, 36))
# where the direction meets the map of the environment, and the density of light sampling
MU, MV, PE = (LANES * i for i in range(36, 39))
# of paths: throughput, part of the diffuse lobe in sampling; of light samples: radiance (distance in MU, density in MV)
TR, TG, TB, SHARE, ER, EG, EB = (LANES * i for i in range(39, 46))
# of a point's samples: how many each strategy draws there; where rays meet surfels: size of those that they start on
WC, WG, WE, WL, SIZE = (LANES * i for i in range(46, 51))
# where there are normal or bump maps: the shading normal without them, 0 where it is N
UX, UY, UZ = (LANES * i for i in range(51, 54))
# where smooth meshes have a terminator offset: see `scene.terminator`, and the part of it that a shadow ray gets
HX, HY, HZ, LIMIT, MOVED = (LANES * i for i in range(54, 59))
# of paths: the alpha that the surface has at least, see `path_regularisation`
LEAST_ALPHA = LANES * 59
#: Four fields, 256 bytes, divide it: at 51 or 59 fields the kernel took a tenth longer than at 48, 56, 60, 64 or 72.
PACKET_FLOATS = 60 * LANES
#: Where lights are linked, the set of the surface: of a point's samples, which have no throughput, and of paths.
POINT_SET, PATH_SET = TR, WL
# uint32 fields: three random numbers, the key of more, the owner (a point, or a path), a place in a table, the row of
# the normal in the light's tables, the object of the surfels that the ray starts on (or -1)
N0, N1, N2, KEY, OWNER, CELL, ROW, OWN = (LANES * i for i in range(8))
PACKET_INTS = 8 * LANES
#: All constants above count in LANES. A device has one lane: there they are divided by it, by this table.
IN_LANES = (
    "LANES", "PACKET_FLOATS", "PACKET_INTS",
    "OX", "OY", "OZ", "NX", "NY", "NZ", "MX", "MY", "MZ", "GX", "GY", "GZ", "VX", "VY", "VZ",
    "AR", "AG", "AB", "FR", "FG", "FB", "FD", "A2", "KD",
    "LX", "LY", "LZ", "LIVE", "QR", "QG", "QB", "SR", "SG", "SB", "PC", "PG",
    "MU", "MV", "PE", "TR", "TG", "TB", "SHARE", "ER", "EG", "EB", "WC", "WG", "WE", "WL", "SIZE",
    "UX", "UY", "UZ", "HX", "HY", "HZ", "LIMIT", "MOVED", "LEAST_ALPHA", "POINT_SET", "PATH_SET",
    "N0", "N1", "N2", "KEY", "OWNER", "CELL", "ROW", "OWN",
)  # fmt: skip

_TINY = F(1e-30)


class Batch(NamedTuple):
    """Rays that are worked off together, with what they start from and what they find; see this module's head.

    Attributes
    ----------
    floats : (packets * 60 * LANES,) float32 array
        Fields from OX to LEAST_ALPHA.
    ints : (packets * 8 * LANES,) uint32 array
        Fields from N0 to OWN.
    """

    floats: Array
    ints: Array


@njit
def batch(capacity):  # type: ignore[no-untyped-def]
    """A `Batch` with room for `capacity` slots.

    Parameters
    ----------
    capacity : int64
        Slots; rounded up to whole packets.

    Returns
    -------
    Batch
        All fields 0.
    """
    packets = (capacity + LANES - 1) // LANES
    return Batch(np.zeros(packets * PACKET_FLOATS, np.float32), np.zeros(packets * PACKET_INTS, np.uint32))


@inlined
def at(slot):  # type: ignore[no-untyped-def]
    """Places of a slot's field 0 in the two arrays.

    Parameters
    ----------
    slot : int64

    Returns
    -------
    i, c : int64
        Index in `Batch.floats` and in `Batch.ints`; a field's constant is added to it.
    """
    packet, lane = slot // LANES, slot % LANES
    return packet * PACKET_FLOATS + lane, packet * PACKET_INTS + lane


@inlined
def packets(count):  # type: ignore[no-untyped-def]
    """Packets that hold `count` slots.

    Parameters
    ----------
    count : int64

    Returns
    -------
    int64
    """
    return (count + LANES - 1) // LANES


@njit
def scramble(rays, count):  # type: ignore[no-untyped-def]
    """Owen scrambling: turn N0 to N2, a Sobol' point with reversed bits, into random numbers; see `sampling.scrambled`.

    Parameters
    ----------
    rays : Batch
        N0, N1 and N2 are read and written; CELL is read, the key of the point set.
    count : int64
        Slots 0, 1, ...; whole packets are worked on.
    """
    ints = rays.ints
    for p in range(packets(count)):
        c = p * PACKET_INTS
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
    """Cosine sampling: directions about the shading normal with pdf cos / pi (PBRT A.5.3).

    Parameters
    ----------
    rays : Batch
        N0, N1 (random numbers) and NX, NY, NZ are read; LX, LY, LZ are written: unit, world.
    count : int64
        Slots.
    """
    s, ints = rays
    for p in range(packets(count)):
        b, c = p * PACKET_FLOATS, p * PACKET_INTS
        for k in range(LANES):
            i = b + k
            x, y, z = _cosine_direction(s, i, unit(ints[c + k + N0]), unit(ints[c + k + N1]))
            s[i + LX], s[i + LY], s[i + LZ] = x, y, z


@njit
def ggx_directions(rays, count):  # type: ignore[no-untyped-def]
    """GGX sampling by visible normals (VNDF) about the normal of the specular lobe; see `brdf.sample_vndf`.

    Parameters
    ----------
    rays : Batch
        N0, N1 (random numbers), MX to MZ, VX to VZ and A2 are read; LX, LY, LZ are written: unit, world.
    count : int64
        Slots.
    """
    s, ints = rays
    for p in range(packets(count)):
        b, c = p * PACKET_FLOATS, p * PACKET_INTS
        for k in range(LANES):
            i = b + k
            x, y, z = _ggx_direction(s, i, unit(ints[c + k + N0]), unit(ints[c + k + N1]))
            s[i + LX], s[i + LY], s[i + LZ] = x, y, z


@njit
def brdf_directions(rays, count):  # type: ignore[no-untyped-def]
    """BRDF sampling: directions from the mixture of both lobes, cosine or GGX, picked by SHARE.

    Parameters
    ----------
    rays : Batch
        N0 to N2 (random numbers), SHARE and the surface are read; LX, LY, LZ (unit, world) are written, and CELL: the
        lobe, 1 diffuse, 0 specular.
    count : int64
        Slots.
    """
    s, ints = rays
    for p in range(packets(count)):
        b, c = p * PACKET_FLOATS, p * PACKET_INTS
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
    """Environment sampling: directions in proportion to luminance times cosine (`product_sampling`), with their pdf.

    Parameters
    ----------
    rays : Batch
        N0 to N2 (random numbers) and ROW are read. Written: LX, LY, LZ (unit, world), MU, MV (lat-long coordinates in
        [0, 1]), PE (pdf, sr^-1); N2, CELL, ER and the BRDF are overwritten.
    count : int64
        Slots.
    envmap : EnvMap
    """
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
        column, s[i + MV], s[i + LZ], s[i + QR], s[i + QG], s[i + QB], s[i + SR] = cell_at(ints[c + CELL], envmap)
        s[i + MU] = F(column)
    for p in range(packets(count)):
        b, c = p * PACKET_FLOATS, p * PACKET_INTS
        for k in range(LANES):
            i = b + k
            corners = s[i + QR], s[i + QG], s[i + QB], s[i + SR]
            s[i + LX], s[i + LY], s[i + LZ], s[i + MU], s[i + MV], density = direction_in_cell(
                s[i + MU], s[i + MV], s[i + LZ], corners, ints[c + k + N0], ints[c + k + N1], envmap
            )
            s[i + PE] = density * s[i + ER]


@njit
def light_directions(rays, count, lights, receiver):  # type: ignore[no-untyped-def]
    """Light sampling: directions towards lights and emitting triangles, see ``sample_light``.

    Parameters
    ----------
    rays : Batch
        N0 to N2 (random numbers) and OX, OY, OZ are read. Written: LX, LY, LZ (unit, world), ER, EG, EB (radiance,
        linear Rec.709), MU (distance, m), MV (pdf, sr^-1, pick included; negative where no other strategy finds the
        light), CELL (the light, for `light_flags`).
    count : int64
        Slots.
    lights : LightTables or LinkedTables
    receiver : int64
        Field that has the set of the surface, see `light_links`.
    """
    s, ints = rays
    for slot in range(count):
        i, c = at(slot)
        own = lights_of(lights, s[i + receiver])
        lx, ly, lz, distance, r, g, b, density, light = sample_light(
            ints[c + N2], ints[c + N0], ints[c + N1], s[i + OX], s[i + OY], s[i + OZ], own
        )
        s[i + LX], s[i + LY], s[i + LZ], s[i + MU], s[i + MV] = lx, ly, lz, distance, density
        s[i + ER], s[i + EG], s[i + EB] = r, g, b
        ints[c + CELL] = U(max(light, 0))


@njit
def look_up(rays, count, envmap):  # type: ignore[no-untyped-def]
    """Place in the environment map, and pdf of environment sampling, of directions that another strategy drew.

    Parameters
    ----------
    rays : Batch
        LX, LY, LZ, LIVE and ROW are read. Written: MU, MV (lat-long coordinates in [0, 1]), and where LIVE is not 0 PE
        (pdf, sr^-1).
    count : int64
        Slots.
    envmap : EnvMap
    """
    s, ints = rays
    for p in range(packets(count)):
        for i in range(p * PACKET_FLOATS, p * PACKET_FLOATS + LANES):
            s[i + MU], s[i + MV] = map_at(s[i + LX], s[i + LY], s[i + LZ], envmap)
    for slot in range(count):
        i, c = at(slot)
        if s[i + LIVE] > ZERO:
            z = height_in_map(s[i + LX], s[i + LY], s[i + LZ], envmap)
            s[i + PE] = envmap_pdf(s[i + MU], s[i + MV], z, ints[c + ROW], envmap)


@njit
def warm(rays, count, envmap):  # type: ignore[no-untyped-def]
    """Prefetch: fetch what `envmap_radiance` will read, all at once, long before it waits for it.

    Parameters
    ----------
    rays : Batch
        MU, MV and LIVE are read; ER is overwritten, so that the reads are not optimised away.
    count : int64
        Slots.
    envmap : EnvMap
    """
    s = rays.floats
    for slot in range(count):
        i, _ = at(slot)
        if s[i + LIVE] > ZERO:
            s[i + ER] = envmap_touch(s[i + MU], s[i + MV], envmap)


@njit
def evaluate(rays, count, shading_model):  # type: ignore[no-untyped-def]
    """BRDF of both lobes times cosine, pdfs of cosine and GGX sampling, and LIVE: whether any light can pass.

    Light passes only above both the geometric and the shading normal; of light samples `terminate` decides anew.

    Parameters
    ----------
    rays : Batch
        The surface and LX, LY, LZ are read. Written: QR, QG, QB and SR, SG, SB (diffuse and specular BRDF times cosine,
        sr^-1, linear Rec.709), PC, PG (pdf of cosine and of GGX sampling, sr^-1), LIVE (1 or 0).
    count : int64
        Slots.
    shading_model : int64
        One of `brdf.SHADING_MODELS`.
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * PACKET_FLOATS, p * PACKET_FLOATS + LANES):
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
            weights = s[i + KD], (s[i + FR], s[i + FG], s[i + FB]), s[i + FD]
            qr, qg, qb, sr, sg, sb, pg = brdf.evaluate(angles, albedo, weights, a2, norm, shading_model)
            s[i + QR], s[i + QG], s[i + QB] = qr * nl, qg * nl, qb * nl
            above = ml > ZERO
            s[i + SR] = sr * ml if above else ZERO
            s[i + SG] = sg * ml if above else ZERO
            s[i + SB] = sb * ml if above else ZERO
            s[i + PC], s[i + PG] = nl * INVERSE_PI, pg if above else ZERO
            out = min(s[i + GX] * lx + s[i + GY] * ly + s[i + GZ] * lz, max(nl, ml))
            s[i + LIVE] = ONE if out > ZERO else ZERO


@njit
def soften(rays, count):  # type: ignore[no-untyped-def]
    """Take light from the diffuse lobe where a normal or bump map sees what the smooth surface turns away from.

    The shadowing function of Estevez, Lecocq and Stein (2019), "A Microfacet-Based Shadowing Function to Solve the Bump
    Terminator Problem", as in Cycles.

    Parameters
    ----------
    rays : Batch
        N, U and LX, LY, LZ are read, QR, QG, QB are scaled.
    count : int64
        Slots.
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * PACKET_FLOATS, p * PACKET_FLOATS + LANES):
            ux, uy, uz = s[i + UX], s[i + UY], s[i + UZ]
            facing = s[i + NX] * ux + s[i + NY] * uy + s[i + NZ] * uz
            up = max(ux * s[i + LX] + uy * s[i + LY] + uz * s[i + LZ], F(1e-6))
            tilt, up = min(facing * facing, ONE), min(up * up, ONE)
            a2 = min(F(0.125) * (ONE - tilt) / max(tilt, F(1e-6)), ONE)
            g = TWO / (ONE + math.sqrt(ONE + a2 * (ONE - up) / up)) if facing > ZERO else ZERO
            g = g if ux * ux + uy * uy + uz * uz > ZERO else ONE
            s[i + QR], s[i + QG], s[i + QB] = s[i + QR] * g, s[i + QG] * g, s[i + QB] * g


@inlined
def moved_part(above, flat, limit):  # type: ignore[no-untyped-def]
    """Part of its terminator offset by which the start of a shadow ray is moved.

    Parameters
    ----------
    above, flat : float32
        Cosine between light and smooth normal, and between light and geometric normal.
    limit : float32
        Of `terminator.terminator_at`; 0: it is not moved.

    Returns
    -------
    float32
        In [0, 1].
    """
    inverse = ONE / max(limit, _TINY)
    part = TWO - (flat + above) * inverse if above < limit else ONE - flat * inverse
    return min(max(part, ZERO), ONE) if limit > ZERO and above > ZERO else ZERO


@inlined
def _heights(s, i):  # type: ignore[no-untyped-def]
    """Cosines of a slot's direction with the smooth normal and with the face's."""
    lx, ly, lz = s[i + LX], s[i + LY], s[i + LZ]
    ux, uy, uz = s[i + UX], s[i + UY], s[i + UZ]
    own = ux * ux + uy * uy + uz * uz > ZERO
    ux, uy, uz = ux if own else s[i + NX], uy if own else s[i + NY], uz if own else s[i + NZ]
    return ux * lx + uy * ly + uz * lz, s[i + GX] * lx + s[i + GY] * ly + s[i + GZ] * lz


@inlined
def grazing(s, i):  # type: ignore[no-untyped-def]
    """`moved_part` of light along the direction of the slot at i.

    Parameters
    ----------
    s : (packets * 60 * LANES,) float32 array
        `Batch.floats`.
    i : int64
        Index of the slot in it, see `at`.

    Returns
    -------
    float32
        In [0, 1].
    """
    nl, gl = _heights(s, i)
    return moved_part(nl, gl, s[i + LIMIT])


@njit
def terminate(rays, count):  # type: ignore[no-untyped-def]
    """Light samples of smooth meshes: where their shadow rays start, and whether there is light below the face.

    As in Cycles lobes get light that is above the smooth normal alone, as far as the shadow ray passes; the other
    strategies draw none of it. See `scene.terminator`.

    Parameters
    ----------
    rays : Batch
        G, N or U, LIMIT and LX, LY, LZ are read, and the results of `evaluate`. Written: MOVED, LIVE, and where light
        is below the face PC, PG.
    count : int64
        Slots.
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * PACKET_FLOATS, p * PACKET_FLOATS + LANES):
            limit = s[i + LIMIT]
            nl, gl = _heights(s, i)
            any_light = limit > ZERO and nl > ZERO
            s[i + MOVED] = moved_part(nl, gl, limit)
            below = any_light and gl <= ZERO
            s[i + PC] = ZERO if below else s[i + PC]
            s[i + PG] = ZERO if below else s[i + PG]
            bright = s[i + QR] + s[i + QG] + s[i + QB] + s[i + SR] + s[i + SG] + s[i + SB] > ZERO
            live = (ONE if bright else ZERO) if below else s[i + LIVE]
            s[i + LIVE] = ZERO if limit > ZERO and nl <= ZERO else live


@njit
def drop(rays, count, lobe):  # type: ignore[no-untyped-def]
    """Take a lobe out of the BRDF.

    Parameters
    ----------
    rays : Batch
        The three fields of the lobe are set to 0.
    count : int64
        Slots.
    lobe : int64
        First field of the lobe: QR (diffuse) or SR (specular).
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * PACKET_FLOATS + lobe, p * PACKET_FLOATS + lobe + 3 * LANES):
            s[i] = ZERO


@inlined
def diffuse_share(mv, albedo, weights, shading_model):  # type: ignore[no-untyped-def]
    """Probability of sampling the diffuse lobe, from the luminance that both lobes reflect towards the viewer.

    Parameters
    ----------
    mv : float32
        Cosine between viewer and normal of the specular lobe.
    albedo : tuple of float32
        Linear Rec.709.
    weights : tuple
        `multiscatter.lobe_weights`.
    shading_model : int64
        One of `brdf.SHADING_MODELS`.

    Returns
    -------
    float32
        From 0.1 to 0.8; 1 where the viewer is below the normal, 0 without a diffuse lobe.
    """
    kd, metal, dielectric = weights
    fr, fg, fb = brdf.fresnel(max(mv, ZERO), albedo, metal, dielectric, shading_model)
    diffuse = kd * luminance(albedo[0], albedo[1], albedo[2])
    share = min(max(diffuse / max(diffuse + luminance(fr, fg, fb), _TINY), F(0.1)), F(0.8))
    share = share if mv > ZERO else ONE
    return share if kd > ZERO else ZERO


@njit
def lobe_shares(rays, count, shading_model):  # type: ignore[no-untyped-def]
    """SHARE: the probability of sampling the diffuse lobe, see `diffuse_share`.

    Parameters
    ----------
    rays : Batch
        The surface is read, SHARE is written.
    count : int64
        Slots.
    shading_model : int64
        One of `brdf.SHADING_MODELS`.
    """
    s = rays.floats
    for p in range(packets(count)):
        for i in range(p * PACKET_FLOATS, p * PACKET_FLOATS + LANES):
            mv = s[i + MX] * s[i + VX] + s[i + MY] * s[i + VY] + s[i + MZ] * s[i + VZ]
            weights = s[i + KD], (s[i + FR], s[i + FG], s[i + FB]), s[i + FD]
            s[i + SHARE] = diffuse_share(mv, (s[i + AR], s[i + AG], s[i + AB]), weights, shading_model)


@inlined
def mixture_pdf(s, i):  # type: ignore[no-untyped-def]
    """Density of a slot's direction by the BRDF: of both lobes, mixed by SHARE.

    Parameters
    ----------
    s : float32 array
        `Batch.floats`: SHARE, PC and PG are read.
    i : int64
        The slot's field 0, of `at`.

    Returns
    -------
    float32
        sr^-1.
    """
    return s[i + SHARE] * s[i + PC] + (ONE - s[i + SHARE]) * s[i + PG]


@inlined
def brdf_pdf(s, i, cosine, ggx):  # type: ignore[no-untyped-def]
    """Counts times pdfs of cosine and GGX sampling for a slot's direction.

    Parameters
    ----------
    s : float32 array
        `Batch.floats`: WC, WG (counts), PC and PG (pdfs) are read.
    i : int64
        The slot's field 0, of `at`.
    cosine, ggx : float32
        1 or 0: whether the strategy takes part.

    Returns
    -------
    float32
        sr^-1.
    """
    return cosine * s[i + WC] * s[i + PC] + ggx * s[i + WG] * s[i + PG]


@njit
def fresh_numbers(rays, count, step):  # type: ignore[no-untyped-def]
    """Move on to the next key and hash three random numbers from it.

    Parameters
    ----------
    rays : Batch
        KEY is read and written; N0, N1, N2 are written.
    count : int64
        Slots.
    step : uint32
        Added to the keys.
    """
    ints = rays.ints
    for p in range(packets(count)):
        c = p * PACKET_INTS
        for i in range(c, c + LANES):
            key = U(ints[i + KEY] + step)
            ints[i + KEY] = key
            ints[i + N0] = mix(key)
            ints[i + N1] = mix(U(key + U(0x68E31DA4)))
            ints[i + N2] = mix(U(key + U(0xB5297A4D)))
