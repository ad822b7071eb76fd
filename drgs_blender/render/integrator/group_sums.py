"""Light of light groups: columns beside the sums of points and the light of paths.

What `direct` and `indirect` add to a point or a path is added a second time to the columns of the group it is of, as
red, green and blue of both lobes together. Points keep the kinds of light apart (`direct._add`), for the same reason.
Where lights have no groups (`light_groups`), there are no columns, and the functions here do nothing and are gone from
the machine code.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit, overload
from ..lights.light_groups import first_lamp, is_grouped
from ..lights.light_sampler import light_along
from ..lights.light_tree import END, FIRST, PAST, SUNS, leaf_along
from ..sampling import ZERO, F
from . import wavefront as w

#: Kinds of light that points keep apart, and columns of each for all groups together.
KINDS, KIND = 3, 10
#: Columns of a path before those of the groups.
FOUND = 10
#: Columns of moments before those of the groups.
MOMENTS = 5


def group_columns(lights):  # type: ignore[no-untyped-def]
    """Columns that the groups of a path need.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables

    Returns
    -------
    int64
    """
    return 0


@overload(group_columns)
def _group_columns(lights):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights: 0
    return lambda lights: 3 * lights.number


@njit
def _add(row, column, r, g, b):  # type: ignore[no-untyped-def]
    row[column] += r
    row[column + 1] += g
    row[column + 2] += b


def credit_point(lights, sums, rays, slot, kind, group, diffuse, glossy):  # type: ignore[no-untyped-def]
    """Add what `direct._reflect` adds to the sums of a slot's point to its group.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    sums : (points, columns) float32 array
    rays : Batch
    slot, kind, group : int64
    diffuse, glossy : tuple of float32
        Light that either lobe gets.
    """


@overload(credit_point)
def _credit_point(lights, sums, rays, slot, kind, group, diffuse, glossy):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, sums, rays, slot, kind, group, diffuse, glossy: None

    def add(lights, sums, rays, slot, kind, group, diffuse, glossy):  # type: ignore[no-untyped-def]
        s, ints = rays
        i, c = w.at(slot)
        (dr, dg, db), (gr, gg, gb) = diffuse, glossy
        r, g, b = s[i + w.QR] * dr, s[i + w.QG] * dg, s[i + w.QB] * db
        r, g, b = r + s[i + w.SR] * gr, g + s[i + w.SG] * gg, b + s[i + w.SB] * gb
        _add(sums[np.int64(ints[c + w.OWNER])], KINDS * KIND + 3 * (kind * lights.number + group), r, g, b)

    return add


def credit_path(lights, found, owner, group, r, g, b):  # type: ignore[no-untyped-def]
    """Add light of a path to its group.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    found : (capacity, columns) float32 array
    owner, group : int64
    r, g, b : float32
    """


@overload(credit_path)
def _credit_path(lights, found, owner, group, r, g, b):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, found, owner, group, r, g, b: None
    return lambda lights, found, owner, group, r, g, b: _add(found[owner], FOUND + 3 * group, r, g, b)


@njit
def _lamp(row, base, i, first, scale, ray, lights, own):  # type: ignore[no-untyped-def]
    """Add one lamp that a ray meets to the columns of its group."""
    origin, direction, reach, others, share, seen_by = ray
    r, g, b = light_along(i, origin, direction, reach, others, share, seen_by, own)
    _add(row, base + 3 * lights.lamps[first + i], scale[0] * r, scale[1] * g, scale[2] * b)


@njit
def _lamps(row, base, first, scale, ray, lights, own):  # type: ignore[no-untyped-def]
    """`lights_along`, lamp by lamp to the columns of their groups, times a scale per channel."""
    pick = own.pick
    node = np.int64(0)
    while node >= 0:
        node = leaf_along(node + 1, ray[0], ray[1], ray[2], pick)
        if node > 0:
            for i in range(np.int64(pick[node, FIRST]), np.int64(pick[node, PAST])):
                _lamp(row, base, i, first, scale, ray, lights, own)
    for i in range(np.int64(pick[0, SUNS]), np.int64(pick[0, END])):
        _lamp(row, base, i, first, scale, ray, lights, own)


def credit_lamps_of_point(lights, own, sums, rays, slot, ray, glossy):  # type: ignore[no-untyped-def]
    """Add the lamps that a slot's ray meets, of kind 2, to their groups: `lights_along` for one lobe.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    own : LightTables
        Of the surface.
    sums : (points, columns) float32 array
    rays : Batch
    slot : int64
    ray : tuple
        Origin, direction, reach, others, share and kind of ray, as of `lights_along`.
    glossy : bool
        The lobe.
    """


@overload(credit_lamps_of_point)
def _credit_lamps_of_point(lights, own, sums, rays, slot, ray, glossy):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, own, sums, rays, slot, ray, glossy: None

    def add(lights, own, sums, rays, slot, ray, glossy):  # type: ignore[no-untyped-def]
        s, ints = rays
        i, c = w.at(slot)
        lobe = i + (w.SR if glossy else w.QR)
        scale = s[lobe], s[lobe + w.LANES], s[lobe + 2 * w.LANES]
        first = first_lamp(lights, s[i + w.POINT_SET])
        row = sums[np.int64(ints[c + w.OWNER])]
        _lamps(row, KINDS * KIND + 6 * lights.number, first, scale, ray, lights, own)

    return add


def credit_lamps_of_path(lights, own, found, owner, receiver, scale, ray):  # type: ignore[no-untyped-def]
    """Add the lamps that a path's ray meets to their groups.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    own : LightTables
        Of the surface.
    found : (capacity, columns) float32 array
    owner : int64
    receiver : float32
        Set of the surface, see `light_links`.
    scale : tuple of float32
        Throughput times BRDF and cosine.
    ray : tuple
        As of `credit_lamps_of_point`.
    """


@overload(credit_lamps_of_path)
def _credit_lamps_of_path(lights, own, found, owner, receiver, scale, ray):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, own, found, owner, receiver, scale, ray: None

    def add(lights, own, found, owner, receiver, scale, ray):  # type: ignore[no-untyped-def]
        _lamps(found[owner], FOUND, first_lamp(lights, receiver), scale, ray, lights, own)

    return add


def clear_groups(lights, found, owner):  # type: ignore[no-untyped-def]
    """Begin a path without light of any group.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    found : (capacity, columns) float32 array
    owner : int64
    """


@overload(clear_groups)
def _clear_groups(lights, found, owner):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, found, owner: None

    def clear(lights, found, owner):  # type: ignore[no-untyped-def]
        found[owner, FOUND:] = ZERO

    return clear


def deliver_groups(lights, found, path, sums, point, scale):  # type: ignore[no-untyped-def]
    """Add a path's light, times a scale per channel, to the groups of its point, as light of kind 1.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    found : (capacity, columns) float32 array
    path : int64
    sums : (points, columns) float32 array
    point : int64
    scale : tuple of float32
    """


@overload(deliver_groups)
def _deliver_groups(lights, found, path, sums, point, scale):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, found, path, sums, point, scale: None

    def deliver(lights, found, path, sums, point, scale):  # type: ignore[no-untyped-def]
        base = KINDS * KIND + 3 * lights.number
        for group in range(lights.number):
            k = FOUND + 3 * group
            r, g, b = found[path, k], found[path, k + 1], found[path, k + 2]
            _add(sums[point], base + 3 * group, scale[0] * r, scale[1] * g, scale[2] * b)

    return deliver


def finish_groups(lights, sums, point, moments, i):  # type: ignore[no-untyped-def]
    """Write out the light of a point's groups behind its moments.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    sums : (points, columns) float32 array
    point : int64
        Row of the sums.
    moments : (n, columns) float32 array
        Row `i` is written.
    i : int64
    """


@overload(finish_groups)
def _finish_groups(lights, sums, point, moments, i):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, sums, point, moments, i: None

    def finish(lights, sums, point, moments, i):  # type: ignore[no-untyped-def]
        width = 3 * lights.number
        for k in range(width):
            c = KINDS * KIND + k
            moments[i, MOMENTS + k] = F(sums[point, c] + sums[point, c + 2 * width]) + sums[point, c + width]

    return finish
