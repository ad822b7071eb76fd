"""The light tree: which light to sample from a point, weighed by what each may send there.

Up to `_LEAF` lights are weighed one by one; more stand in a tree, and the pick walks down it by the estimates of its
branches (Conty Estevez and Kulla 2018). The probability of a pick can be had for any light and point, and the same tree
finds the lights that a ray meets. Suns, which are nowhere, stand outside the tree.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..sampling import HALF, ONE, ZERO, F
from .light_shapes import AXIS, BARE_SUN, BOUND, FLUX, INTENSITY, KIND, PLACE, REACH_COS, RECTANGLE, SUN

Array = np.ndarray

#: Lights in a leaf at most.
_LEAF = 32
#: Columns of a node: its box, the axis and cosine of a cone around all directions its lights send into, their mean
#: intensity over that cone, the rows of the table it holds, its second child (0: a leaf) and the node after all below.
_LOW, _HIGH, _CONE, _REACH, _POWER, FIRST, PAST, SECOND, NEXT = 0, 3, 6, 9, 10, 11, 12, 13, 14
_NODE_WIDTH = 16
#: Row 0 of the nodes is no node: how many nodes, where suns begin and end in the table, their irradiance.
COUNT, SUNS, END, _SUN_POWER = 0, 1, 2, 3
_TINY = F(1e-20)
#: What rounding may do to a cosine.
_SLACK = F(2e-6)


def is_sun(table: Array) -> Array:
    return (table[:, KIND] == BARE_SUN) | (table[:, KIND] == SUN)


def build(table: Array) -> tuple[Array, Array]:
    """(order of the rows, nodes): halves along the longest side of the box, until leaves are small."""
    suns = np.flatnonzero(is_sun(table))
    order = np.concatenate([np.flatnonzero(~is_sun(table)), suns])
    local = len(order) - len(suns)
    places = table[:, PLACE : PLACE + 3].astype(np.float64)
    bounds = table[:, BOUND : BOUND + 1].astype(np.float64)
    nodes: list[Array] = [np.zeros(_NODE_WIDTH)]

    def grow(first: int, past: int) -> None:
        node = np.zeros(_NODE_WIDTH)
        nodes.append(node)
        own = order[first:past]
        low, high = (places[own] - bounds[own]).min(axis=0), (places[own] + bounds[own]).max(axis=0)
        # Boxes must hold their lights after rounding too.
        pad = 1e-6 * np.maximum(np.abs(low), np.abs(high)).max() + 1e-12
        node[_LOW : _LOW + 3], node[_HIGH : _HIGH + 3] = low - pad, high + pad
        node[_CONE : _CONE + 3], node[_REACH] = _common_cone(table[own].astype(np.float64))
        # Mean intensity over the cone: what a light of unknown direction sends to a point in it.
        cone = 2.0 * np.pi * max(1.0 - node[_REACH], 1e-6)
        node[_POWER], node[FIRST], node[PAST] = table[own, FLUX].sum(dtype=np.float64) / cone, first, past
        if past - first > _LEAF:
            side = int(np.argmax(np.ptp(places[own], axis=0)))
            order[first:past] = own[np.argsort(places[own, side], kind="stable")]
            middle = (first + past) // 2
            grow(first, middle)
            node[SECOND] = len(nodes)
            grow(middle, past)
        node[NEXT] = len(nodes)

    if local:
        grow(0, local)
    nodes[0][:4] = len(nodes), local, len(order), table[suns, INTENSITY].sum(dtype=np.float64)
    return order, np.array(nodes, np.float32)


def _common_cone(table: Array) -> tuple[Array, float]:
    """Axis and cosine of a cone of directions that holds all that these lights send."""
    everywhere = np.zeros(3), -1.0
    if (table[:, REACH_COS] <= -1.0).any():
        return everywhere
    axes = table[:, AXIS : AXIS + 3]
    axis = axes.mean(axis=0)
    length = np.linalg.norm(axis)
    if length < 1e-3:
        return everywhere
    axis /= length
    angles = np.arctan2(np.linalg.norm(np.cross(axes, axis), axis=1), axes @ axis) + np.arccos(table[:, REACH_COS])
    return (axis, float(np.cos(angles.max()))) if angles.max() < np.pi else everywhere


@njit
def _reaches(x, y, z, square, bound, ax, ay, az, reach_cos):  # type: ignore[no-untyped-def]
    """(whether light may arrive, largest cosine to the axis) at an offset from the middle of a bounding sphere."""
    if square <= bound * bound:
        return True, ONE
    inverse = ONE / np.sqrt(square)
    cosine = min(max((x * ax + y * ay + z * az) * inverse, -ONE), ONE)
    sine_bound = bound * inverse
    cosine_bound = np.sqrt(ONE - sine_bound * sine_bound)
    if cosine >= cosine_bound:
        return True, ONE
    best = cosine * cosine_bound + np.sqrt(ONE - cosine * cosine) * sine_bound
    return best >= reach_cos - _SLACK, best


@njit
def _light_weight(i, px, py, pz, table):  # type: ignore[no-untyped-def]
    """Estimate of what light `i` sends to a point; 0 only where it sends nothing."""
    x, y, z = px - table[i, PLACE], py - table[i, PLACE + 1], pz - table[i, PLACE + 2]
    square, bound = x * x + y * y + z * z, table[i, BOUND]
    ax, ay, az = table[i, AXIS], table[i, AXIS + 1], table[i, AXIS + 2]
    weight = table[i, INTENSITY] / max(max(square, bound * bound), _TINY)
    if table[i, REACH_COS] <= -ONE:
        return weight
    lit, cosine = _reaches(x, y, z, square, bound, ax, ay, az, table[i, REACH_COS])
    if table[i, KIND] >= F(RECTANGLE):
        lit = lit and x * ax + y * ay + z * az > ZERO
        weight *= max(cosine, F(1e-3))
    return weight if lit else ZERO


@njit
def _node_weight(node, px, py, pz, table, pick):  # type: ignore[no-untyped-def]
    """Estimate of what the lights below a node send to a point; exactly the sum over the lights of a leaf."""
    weight = ZERO
    if pick[node, SECOND] == ZERO:
        for i in range(np.int64(pick[node, FIRST]), np.int64(pick[node, PAST])):
            weight += _light_weight(i, px, py, pz, table)
        return weight
    x = px - HALF * (pick[node, _LOW] + pick[node, _HIGH])
    y = py - HALF * (pick[node, _LOW + 1] + pick[node, _HIGH + 1])
    z = pz - HALF * (pick[node, _LOW + 2] + pick[node, _HIGH + 2])
    u, v = pick[node, _HIGH] - pick[node, _LOW], pick[node, _HIGH + 1] - pick[node, _LOW + 1]
    w = pick[node, _HIGH + 2] - pick[node, _LOW + 2]
    bound2 = F(0.25) * (u * u + v * v + w * w)
    square = x * x + y * y + z * z
    weight = pick[node, _POWER] / max(max(square, bound2), _TINY)
    if pick[node, _REACH] <= -ONE:
        return weight
    lit, _ = _reaches(
        x, y, z, square, np.sqrt(bound2), pick[node, _CONE], pick[node, _CONE + 1], pick[node, _CONE + 2],
        pick[node, _REACH],
    )  # fmt: skip
    return weight if lit else ZERO


@njit
def lights_weight(px, py, pz, table, pick):  # type: ignore[no-untyped-def]
    """Estimated luminance that arrives at a point from all lights, unshadowed; 0 only where nothing arrives.

    Parameters
    ----------
    px, py, pz : float32
        Point, world, m.
    table : (k, WIDTH) float32 array
        `Lights.table`.
    pick : (m, 16) float32 array
        `Lights.pick`.

    Returns
    -------
    float32
        From all directions together, as `Lights.power`.
    """
    weight = pick[0, _SUN_POWER]
    if pick[0, SUNS] > ZERO:
        weight += _node_weight(np.int64(1), px, py, pz, table, pick)
    return weight


@njit
def pick_light(n0, px, py, pz, table, pick):  # type: ignore[no-untyped-def]
    """Pick a light for a point by the light tree (Conty Estevez and Kulla 2018).

    Parameters
    ----------
    n0 : uint32
        Random number.
    px, py, pz : float32
        Point, world, m.
    table : (k, WIDTH) float32 array
        `Lights.table`.
    pick : (m, 16) float32 array
        `Lights.pick`.

    Returns
    -------
    index : int64
        Row of the table; -1 when the number falls on none.
    probability : float32
        Of the pick; 0 for none.
    """
    rest = np.float64(n0) * (1.0 / 4294967296.0)
    probability = 1.0
    first, past = np.int64(pick[0, SUNS]), np.int64(pick[0, END])
    total = np.float64(pick[0, _SUN_POWER])
    suns = True
    if first > 0:
        node = np.int64(1)
        here = np.float64(_node_weight(node, px, py, pz, table, pick))
        share = total / max(total + here, 1e-30)
        if rest >= share:
            suns = False
            rest, probability = (rest - share) / (1.0 - share), 1.0 - share
            while pick[node, SECOND] > ZERO:
                second = np.int64(pick[node, SECOND])
                one = np.float64(_node_weight(node + 1, px, py, pz, table, pick))
                two = np.float64(_node_weight(second, px, py, pz, table, pick))
                if not one + two > 0.0:
                    return np.int64(-1), ZERO
                share = one / (one + two)
                if rest < share:
                    rest, probability, node, here = rest / share, probability * share, node + 1, one
                else:
                    rest, probability = (rest - share) / (1.0 - share), probability * (1.0 - share)
                    node, here = second, two
            first, past, total = np.int64(pick[node, FIRST]), np.int64(pick[node, PAST]), here
        else:
            rest, probability = rest / share, share
    if not total > 0.0:
        return np.int64(-1), ZERO
    goal, sum_, chosen, own = rest * total, 0.0, np.int64(-1), 0.0
    for i in range(first, past):
        weight = np.float64(table[i, INTENSITY] if suns else _light_weight(i, px, py, pz, table))
        if weight > 0.0:
            # The last one that can be picked takes what rounding leaves.
            chosen, own = i, weight
            sum_ += weight
            if goal < sum_:
                break
    return chosen, F(probability * own / total)


@njit
def pick_probability(i, px, py, pz, table, pick):  # type: ignore[no-untyped-def]
    """Probability with which `pick_light` picks light `i` for a point.

    Parameters
    ----------
    i : int64
        Row of the table.
    px, py, pz : float32
        Point, world, m.
    table : (k, WIDTH) float32 array
        `Lights.table`.
    pick : (m, 16) float32 array
        `Lights.pick`.

    Returns
    -------
    float32
    """
    suns = np.float64(pick[0, _SUN_POWER])
    if F(i) >= pick[0, SUNS]:
        here = 0.0
        if pick[0, SUNS] > ZERO:
            here = np.float64(_node_weight(np.int64(1), px, py, pz, table, pick))
        return F(np.float64(table[i, INTENSITY]) / (suns + here))
    own = np.float64(_light_weight(i, px, py, pz, table))
    if not own > 0.0:
        return ZERO
    node = np.int64(1)
    here = np.float64(_node_weight(node, px, py, pz, table, pick))
    probability = here / max(suns + here, 1e-30)
    while pick[node, SECOND] > ZERO:
        second = np.int64(pick[node, SECOND])
        one = np.float64(_node_weight(node + 1, px, py, pz, table, pick))
        two = np.float64(_node_weight(second, px, py, pz, table, pick))
        if F(i) < pick[second, FIRST]:
            node, here = node + 1, one
        else:
            node, here = second, two
        if not here > 0.0:
            return ZERO
        probability *= here / (one + two)
    return F(probability * own / here)


@njit
def _slab(o, d, low, high, near, far):  # type: ignore[no-untyped-def]
    """Part of a ray's [near, far] between two planes."""
    if d == ZERO:
        return (near, far) if low <= o <= high else (ONE, ZERO)
    inverse = ONE / d
    a, b = (low - o) * inverse, (high - o) * inverse
    return max(near, min(a, b)), min(far, max(a, b))


@njit
def box_hit(node, ox, oy, oz, dx, dy, dz, tmax, pick):  # type: ignore[no-untyped-def]
    """Whether a ray meets the box of a node (slab test).

    Parameters
    ----------
    node : int64
        Row of the tree.
    ox, oy, oz : float32
        Origin, world, m.
    dx, dy, dz : float32
        Direction, unit, world.
    tmax : float32
        End of the ray, m.
    pick : (m, 16) float32 array
        `Lights.pick`.

    Returns
    -------
    bool
    """
    near, far = _slab(ox, dx, pick[node, _LOW], pick[node, _HIGH], ZERO, tmax)
    near, far = _slab(oy, dy, pick[node, _LOW + 1], pick[node, _HIGH + 1], near, far)
    near, far = _slab(oz, dz, pick[node, _LOW + 2], pick[node, _HIGH + 2], near, far)
    return near <= far * F(1.00001)


@njit
def leaf_along(node, origin, direction, tmax, pick):  # type: ignore[no-untyped-def]
    """The first leaf, from a node on, whose box a ray meets.

    Parameters
    ----------
    node : int64
        Row of the tree, from 1 on.
    origin, direction : tuple of float32
        World, m; the direction is of unit length.
    tmax : float32
        End of the ray, m.
    pick : (m, 16) float32 array
        `Lights.pick`.

    Returns
    -------
    int64
        Row of the tree; -1 where there is none any more.
    """
    ox, oy, oz = origin
    dx, dy, dz = direction
    count = np.int64(pick[0, COUNT])
    while node < count:
        if not box_hit(node, ox, oy, oz, dx, dy, dz, tmax, pick):
            node = np.int64(pick[node, NEXT])
        elif pick[node, SECOND] == ZERO:
            return node
        else:
            node += 1
    return np.int64(-1)
