"""The surface of what particles fill: anisotropic kernels (Yu and Turk 2013), and the level at which they make a half.

Each particle is a blob of its volume, as wide along each axis as the particles around it are spread: flat next to a
surface, round inside, small where it is alone, with no threshold between these, so that nothing pops as they move.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import njit
from ..compute.threads import checkpoint, over_range

Array = np.ndarray

#: Spacings within which particles count as around one; share of their variance that a blob has, and what it has alone.
_AROUND, _SHARE, _ALONE = 3.0, 1.0, 0.12
#: Standard deviations at which a blob ends, and what (1 - q^2)^2 sums up to in a ball of radius 1.
_ENDS, _SUM = 3.0, 4.0 * np.pi * 8.0 / 105.0
#: By how much higher the blob of a particle alone is, of which the level would cut off too much otherwise, and how many
#: around it have this fade.
_DROP, _FEW = 1.4, 5.0
#: Nodes of the grid a spacing, at most; nodes in all; of a block along each axis.
_NODES, _MOST, _BLOCK = 2.0, 1 << 25, 8
#: Share of the particles, at each end of an axis, that may be left out where they are far off.
_STRAY = 0.002
#: Level of the surface: that at which the surface of a block of particles is where their volume ends.
LEVEL = 0.54


class ParticleSurface(NamedTuple):
    """A closed mesh.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        In the space of the particles.
    faces : (m, 3) int32 array
        Counter-clockwise seen from outside.
    normals : (n, 3) float32 array
        Unit.
    coarse : bool
        Whether the grid was made coarser, since the particles are spread too far.
    far : int
        Particles that are left out, as a few are much farther off than all others.
    """

    vertices: Array
    faces: Array
    normals: Array
    coarse: bool
    far: int = 0


def particle_surface(points: Array, spacing: float) -> ParticleSurface:
    """The surface of particles, each of which stands for a cube of side `spacing`.

    Parameters
    ----------
    points : (n, 3) float array
        Those that are not finite are left out.
    spacing : float
    """
    from skimage.measure import marching_cubes

    places = np.asarray(points, np.float64) / spacing
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return _nothing(False)
    reach = _ENDS * float(np.sqrt(_SHARE * 0.3 * _AROUND**2 + _ALONE))
    step = 1.0 / _NODES
    low, high = places.min(axis=0) - reach - 1, places.max(axis=0) + reach + 1
    far = 0
    if np.prod(np.ceil((high - low) / step) + 1) > _MOST:
        ends = np.quantile(places, (_STRAY, 1.0 - _STRAY), axis=0)
        near = (np.abs(places - ends.mean(axis=0)) <= 1.5 * np.ptp(ends, axis=0) + reach).all(axis=1)
        far, places = int((~near).sum()), places[near]
        low, high = places.min(axis=0) - reach - 1, places.max(axis=0) + reach + 1
    while np.prod(np.ceil((high - low) / step) + 1) > _MOST:
        step *= 1.25
    low = np.floor(low / step) * step  # the same nodes in all frames
    wide = max(1.0, float(np.prod((high - low) / _MOST ** (1 / 3))) ** (1 / 3))  # of cubes in which particles are found
    binned, start, bins = _binned(places, low, wide)
    blobs = np.empty((len(binned), 7))
    over_range(_blobs, len(binned), binned, start, bins, low, wide, blobs)
    blocks = np.ceil((high - low) / step / _BLOCK).astype(np.int64)
    field = np.zeros(blocks * _BLOCK, np.float32)
    over_range(_sum, int(blocks.prod()), binned, blobs, (start, bins), (low, step, reach, wide), blocks, field)
    if not field.max() > LEVEL:
        return _nothing(step > 1.0 / _NODES)
    checkpoint()
    vertices, faces, normals, _ = marching_cubes(field, LEVEL, gradient_direction="ascent")
    checkpoint()
    made = ((vertices * step + low) * spacing).astype(np.float32)
    return ParticleSurface(made, faces.astype(np.int32), normals.astype(np.float32), step > 1.0 / _NODES, far)


def _nothing(coarse: bool) -> ParticleSurface:
    none = np.zeros((0, 3), np.float32)
    return ParticleSurface(none, np.zeros((0, 3), np.int32), none, coarse)


def _binned(places: Array, low: Array, wide: float) -> tuple[Array, Array, Array]:
    """Particles in the order of cubes of some width, where each cube begins, and how many there are."""
    cell = np.floor((places - low) / wide).astype(np.int64)
    bins = cell.max(axis=0) + 1
    key = (cell[:, 0] * bins[1] + cell[:, 1]) * bins[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=int(bins.prod())))])
    return np.ascontiguousarray(places[order]), start.astype(np.int64, copy=False), bins


@njit
def _blobs(first, last, places, start, bins, low, wide, blobs):  # type: ignore[no-untyped-def]
    """Of each particle the inverse of its blob's variance (xx, yy, zz, xy, xz, yz), and its height."""
    span = np.int64(np.ceil(_AROUND / wide))
    for p in range(first, last):
        x, y, z = places[p, 0], places[p, 1], places[p, 2]
        i, j, k = np.int64((x - low[0]) / wide), np.int64((y - low[1]) / wide), np.int64((z - low[2]) / wide)
        total = mx = my = mz = xx = yy = zz = xy = xz = yz = 0.0
        for a in range(max(i - span, 0), min(i + span + 1, bins[0])):
            for b in range(max(j - span, 0), min(j + span + 1, bins[1])):
                row = (a * bins[1] + b) * bins[2]
                for q in range(start[row + max(k - span, 0)], start[row + min(k + span, bins[2] - 1) + 1]):
                    u, v, w = places[q, 0] - x, places[q, 1] - y, places[q, 2] - z
                    d = np.sqrt(u * u + v * v + w * w) / _AROUND
                    if d < 1.0:
                        g = 1.0 - d * d * d
                        total, mx, my, mz = total + g, mx + g * u, my + g * v, mz + g * w
                        xx, yy, zz = xx + g * u * u, yy + g * v * v, zz + g * w * w
                        xy, xz, yz = xy + g * u * v, xz + g * u * w, yz + g * v * w
        mx, my, mz = mx / total, my / total, mz / total
        xx = _SHARE * (xx / total - mx * mx) + _ALONE
        yy = _SHARE * (yy / total - my * my) + _ALONE
        zz = _SHARE * (zz / total - mz * mz) + _ALONE
        xy, xz, yz = _SHARE * (xy / total - mx * my), _SHARE * (xz / total - mx * mz), _SHARE * (yz / total - my * mz)
        a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        det = xx * a + xy * b + xz * c
        blobs[p, 0], blobs[p, 1], blobs[p, 2] = a / det, (xx * zz - xz * xz) / det, (xx * yy - xy * xy) / det
        blobs[p, 3], blobs[p, 4], blobs[p, 5] = b / det, c / det, (xy * xz - xx * yz) / det
        alone = 1.0 + _DROP * np.exp((1.0 - total) / _FEW)
        blobs[p, 6] = alone / (_SUM * _ENDS**3 * np.sqrt(det))


@njit
def _sum(first, last, places, blobs, found, grid, blocks, field):  # type: ignore[no-untyped-def]
    """What blobs sum up to at the nodes of some blocks, each in the same order on any number of threads."""
    start, bins = found
    low, step, reach, wide = grid
    side = _BLOCK * step
    most = 1.0 / (_ENDS * _ENDS)
    for n in range(first, last):
        bi, bj, bk = n // (blocks[1] * blocks[2]), (n // blocks[2]) % blocks[1], n % blocks[2]
        i0, j0, k0 = bi * _BLOCK, bj * _BLOCK, bk * _BLOCK
        x0, y0, z0 = low[0] + i0 * step, low[1] + j0 * step, low[2] + k0 * step
        ka, kb = (
            max(np.int64((z0 - low[2] - reach) / wide), 0),
            min(np.int64((z0 - low[2] + side + reach) / wide), bins[2] - 1),
        )
        if ka > kb:
            continue
        ia, ib = (
            max(np.int64((x0 - low[0] - reach) / wide), 0),
            min(np.int64((x0 - low[0] + side + reach) / wide), bins[0] - 1),
        )
        ja, jb = (
            max(np.int64((y0 - low[1] - reach) / wide), 0),
            min(np.int64((y0 - low[1] + side + reach) / wide), bins[1] - 1),
        )
        for a in range(ia, ib + 1):
            for b in range(ja, jb + 1):
                row = (a * bins[1] + b) * bins[2]
                for p in range(start[row + ka], start[row + kb + 1]):
                    xx, yy, zz = blobs[p, 0], blobs[p, 1], blobs[p, 2]
                    xy, xz, yz = blobs[p, 3], blobs[p, 4], blobs[p, 5]
                    height = np.float32(blobs[p, 6])
                    for i in range(_BLOCK):
                        u = x0 + i * step - places[p, 0]
                        if u < -reach or u > reach:
                            continue
                        for j in range(_BLOCK):
                            v = y0 + j * step - places[p, 1]
                            # zz w^2 + 2 (xz u + yz v) w + rest < 1 / most
                            half = xz * u + yz * v
                            rest = (xx * u * u + yy * v * v + 2.0 * xy * u * v) - 1.0 / most
                            inner = half * half - zz * rest
                            if inner <= 0.0:
                                continue
                            root = np.sqrt(inner)
                            down = (places[p, 2] - z0 + (-half - root) / zz) / step
                            up = (places[p, 2] - z0 + (-half + root) / zz) / step
                            for k in range(
                                max(np.int64(np.ceil(down)), 0), min(np.int64(np.floor(up)), _BLOCK - 1) + 1
                            ):
                                w = z0 + k * step - places[p, 2]
                                q = 1.0 - most * (rest + 1.0 / most + (2.0 * half + zz * w) * w)
                                if q > 0.0:
                                    field[i0 + i, j0 + j, k0 + k] += height * np.float32(q * q)
