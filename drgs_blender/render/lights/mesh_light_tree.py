"""The light tree over emitting triangles, in Morton order.

The tree is complete and binary, node i has children 2 i and 2 i + 1, and its leaves hold equal runs of the rows: it is
made again in linear time when triangles move. A branch is weighed as by Conty Estevez and Kulla (2018): power over
squared distance, times the mean cosine of its triangles, which shine on both sides, by the moments of their normals. Of
closed surfaces the side that is turned away counts little.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ..memory import load_double, load_float
from ..sampling import HALF, ZERO, F
from .triangle_light import AREA, BACK, BITS, CLOSED, CORNER, EDGE, LUMINANCE, NORMAL, SIDE, triangle_weight

Array = np.ndarray


class Tree(NamedTuple):
    """A tree for compiled code: addresses of rows, nodes and sums, how many rows, how many leaves."""

    rows: int
    nodes: int
    sums: int
    size: int
    leaves: int


#: Triangles of a leaf on average at most.
_LEAF = 4
#: Columns of a node: middle and squared radius of its sphere, mean normal, mean of the squares x x, y y, z z and twice
#: that of the products x y, y z, z x of its normals' components, power, whether all its triangles are of closed
#: surfaces, whether all normals are alike. Row 0 is no node; its first number is the scale of the powers.
_MIDDLE, _RADIUS2, _MEAN, _SQUARES, _PRODUCTS, _POWER, _CLOSED, _FLAT = 0, 3, 4, 7, 10, 13, 14, 15
_NODE_WIDTH = 16
#: Power, then the same sums of the normals, times power.
_SUMS = 10
_TINY, _LEAST_COSINE = F(1e-30), F(1e-3)
#: A branch beyond four times its radius whose normals are alike (an angle of 25 degrees about them) is not followed:
#: power alone decides.
_FAR2, _ALIKE = F(16.0), 0.83
#: Mean square by which the cosine spreads over a branch, in squares of its radius.
_SPREAD = F(1.0 / 6.0)


def depth_of(count: int) -> int:
    """Levels below the root of a tree of `count` triangles."""
    return max(0, math.ceil(math.log2(max(count, 1) / _LEAF)))


def morton_order(rows: Array) -> Array:
    """Order of (n, WIDTH) rows along a Morton curve through their centres."""
    centre = rows[:, CORNER : CORNER + 3] + (rows[:, EDGE : EDGE + 3] + rows[:, SIDE : SIDE + 3]) / 3.0
    low = centre.min(axis=0)
    cell = ((centre - low) * (1023.0 / max(float(np.ptp(centre, axis=0).max()), 1e-30))).astype(np.uint32)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cell = (cell | cell << np.uint32(shift)) & np.uint32(mask)
    return np.argsort(cell[:, 0] | cell[:, 1] << np.uint32(1) | cell[:, 2] << np.uint32(2), kind="stable")


def build(rows: Array, scale: float) -> tuple[Array, Array]:
    """A tree over (n, WIDTH) rows, whose ``LUMINANCE`` is to be multiplied with `scale`.

    Returns
    -------
    nodes : (k, 16) float32 array
        With k = 2^(depth + 1).
    sums : (n + 1,) float64 array
        Of the power of all rows before each.
    """
    nodes = np.zeros((2 << depth_of(len(rows)), _NODE_WIDTH), np.float32)
    power = rows[:, LUMINANCE].astype(np.float64) * rows[:, AREA]
    if len(rows):
        nodes[0, 0] = scale
        _build(rows, nodes, np.empty((len(nodes), 6), np.float32))
    return nodes, np.concatenate([[0.0], np.cumsum(power)])


@njit
def _build(rows, nodes, boxes):  # type: ignore[no-untyped-def]
    n, leaves = len(rows), len(nodes) // 2
    sums = np.zeros((len(nodes), _SUMS))
    for node in range(2 * leaves - 1, 0, -1):
        boxes[node, :3], boxes[node, 3:] = np.inf, -np.inf
        closed = True
        if node >= leaves:
            for i in range((node - leaves) * n // leaves, (node - leaves + 1) * n // leaves):
                closed = closed and np.int32(rows[i, BITS]) & CLOSED != 0
                power = np.float64(rows[i, LUMINANCE]) * np.float64(rows[i, AREA])
                sums[node, 0] += power
                for k in range(3):
                    a = rows[i, CORNER + k]
                    b, c = a + rows[i, EDGE + k], a + rows[i, SIDE + k]
                    boxes[node, k] = min(boxes[node, k], min(a, min(b, c)))
                    boxes[node, 3 + k] = max(boxes[node, 3 + k], max(a, max(b, c)))
                    one, two = np.float64(rows[i, NORMAL + k]), np.float64(rows[i, NORMAL + (k + 1) % 3])
                    sums[node, 1 + k] += power * one
                    sums[node, 4 + k] += power * one * one
                    sums[node, 7 + k] += power * one * two
        else:
            for child in (2 * node, 2 * node + 1):
                closed = closed and nodes[child, _CLOSED] > ZERO
                sums[node] += sums[child]
                boxes[node, :3] = np.minimum(boxes[node, :3], boxes[child, :3])
                boxes[node, 3:] = np.maximum(boxes[node, 3:], boxes[child, 3:])
        square, mean, alike, power = 0.0, 0.0, 0.0, sums[node, 0]
        for k in range(3):
            nodes[node, _MIDDLE + k] = 0.5 * (boxes[node, k] + boxes[node, 3 + k])
            square += (0.5 * (np.float64(boxes[node, 3 + k]) - np.float64(boxes[node, k]))) ** 2
            nodes[node, _MEAN + k] = sums[node, 1 + k] / power
            nodes[node, _SQUARES + k] = sums[node, 4 + k] / power
            nodes[node, _PRODUCTS + k] = 2.0 * sums[node, 7 + k] / power
            mean += (sums[node, 1 + k] / power) ** 2
            alike += (sums[node, 4 + k] / power) ** 2 + 2.0 * (sums[node, 7 + k] / power) ** 2
        nodes[node, _RADIUS2], nodes[node, _POWER], nodes[node, _CLOSED] = square, power, closed
        nodes[node, _FLAT] = (mean if closed else alike) > _ALIKE


@njit
def _rows_of(node, tree):  # type: ignore[no-untyped-def]
    """(first, past) of the rows below a node."""
    first, past = node, node + 1
    while first < tree.leaves:
        first, past = 2 * first, 2 * past
    return (first - tree.leaves) * tree.size // tree.leaves, (past - tree.leaves) * tree.size // tree.leaves


@njit
def _node_weight(node, px, py, pz, tree):  # type: ignore[no-untyped-def]
    """Estimate of what arrives at a point from the triangles below a node, and whether power decides among these.

    Of leaves it is exactly the sum over them.
    """
    if node >= tree.leaves:
        weight = ZERO
        first, past = _rows_of(node, tree)
        for i in range(first, past):
            weight += triangle_weight(i, px, py, pz, tree.rows)
        return weight, False
    nodes, k = tree.nodes, _NODE_WIDTH * np.int64(node)
    x, y, z = px - load_float(nodes, k), py - load_float(nodes, k + 1), pz - load_float(nodes, k + 2)
    square, radius2 = x * x + y * y + z * z, load_float(nodes, k + _RADIUS2)
    weight = load_float(nodes, k + _POWER) / max(max(square, radius2), _TINY)
    if square <= radius2:
        return HALF * weight, False
    flat = square > _FAR2 * radius2 and load_float(nodes, k + _FLAT) > ZERO
    # Of max(0, cosine) = (cosine + |cosine|) / 2 the mean, by that of the squares; these spread with the place.
    m, p = k + _SQUARES, k + _PRODUCTS
    across = x * x * load_float(nodes, m) + y * y * load_float(nodes, m + 1) + z * z * load_float(nodes, m + 2)
    across += x * y * load_float(nodes, p) + y * z * load_float(nodes, p + 1) + z * x * load_float(nodes, p + 2)
    size = math.sqrt(max(across, ZERO) + _SPREAD * radius2)
    if load_float(nodes, k + _CLOSED) > ZERO:
        along = x * load_float(nodes, k + _MEAN) + y * load_float(nodes, k + _MEAN + 1)
        along += z * load_float(nodes, k + _MEAN + 2)
        size = max(HALF * (size + along), BACK * size)
    return weight * max(size / math.sqrt(square), _LEAST_COSINE), flat


@njit
def emitters_weight(px, py, pz, tree):  # type: ignore[no-untyped-def]
    """Estimated luminance that arrives at a point from all triangles, unshadowed; float64.

    Parameters
    ----------
    px, py, pz : float32
        Point, world, m.
    tree : Tree

    Returns
    -------
    float64
        From all directions together, as `Lights.power`.
    """
    weight, _ = _node_weight(np.int64(1), px, py, pz, tree)
    return np.float64(load_float(tree.nodes, 0)) * np.float64(weight)


@njit
def _pick_by_power(rest, first, past, tree):  # type: ignore[no-untyped-def]
    low = load_double(tree.sums, first)
    total = load_double(tree.sums, past) - low
    goal = low + rest * total
    while past - first > 1:
        middle = (first + past) // 2
        if load_double(tree.sums, middle) > goal:
            past = middle
        else:
            first = middle
    return first, _power(first, tree) / total


@njit
def _power(i, tree):  # type: ignore[no-untyped-def]
    return load_double(tree.sums, i + 1) - load_double(tree.sums, i)


@njit
def pick_emitter(rest, px, py, pz, tree):  # type: ignore[no-untyped-def]
    """Pick an emitting triangle for a point by the light tree.

    Parameters
    ----------
    rest : float64
        Random number in [0, 1).
    px, py, pz : float32
        Point, world, m.
    tree : Tree

    Returns
    -------
    row : int64
        -1 when the number falls on none.
    probability : float64
        Of the pick; 0 for none.
    """
    node, probability = np.int64(1), 1.0
    here, flat = _node_weight(node, px, py, pz, tree)
    while node < tree.leaves and not flat:
        one, one_flat = _node_weight(2 * node, px, py, pz, tree)
        two, two_flat = _node_weight(2 * node + 1, px, py, pz, tree)
        both = np.float64(one) + np.float64(two)
        if not both > 0.0:
            return np.int64(-1), 0.0
        share = np.float64(one) / both
        if rest < share:
            rest, probability, node, here, flat = rest / share, probability * share, 2 * node, one, one_flat
        else:
            rest, probability = (rest - share) / (1.0 - share), probability * (1.0 - share)
            node, here, flat = 2 * node + 1, two, two_flat
    first, past = _rows_of(node, tree)
    if flat:
        i, share = _pick_by_power(rest, first, past, tree)
        return i, probability * share
    total = np.float64(here)
    if not total > 0.0:
        return np.int64(-1), 0.0
    goal, sum_, own, i = rest * total, 0.0, 0.0, first
    while True:
        own = np.float64(triangle_weight(i, px, py, pz, tree.rows))
        sum_ += own
        # The last one takes what rounding leaves.
        if goal < sum_ or i + 1 == past:
            return i, probability * own / total
        i += 1


@njit
def emitter_probability(i, px, py, pz, tree):  # type: ignore[no-untyped-def]
    """Probability with which `pick_emitter` picks row `i` for a point.

    Parameters
    ----------
    i : int64
        Row of the triangle.
    px, py, pz : float32
        Point, world, m.
    tree : Tree

    Returns
    -------
    float64
    """
    leaf = tree.leaves + ((i + 1) * tree.leaves - 1) // tree.size
    level = 0
    while leaf >> level > 1:
        level += 1
    probability = 1.0
    here, flat = _node_weight(np.int64(1), px, py, pz, tree)
    while level > 0 and not flat:
        level -= 1
        own = leaf >> level
        here, flat = _node_weight(own, px, py, pz, tree)
        other, _ = _node_weight(own ^ 1, px, py, pz, tree)
        if not here > ZERO:
            return 0.0
        probability *= np.float64(here) / (np.float64(here) + np.float64(other))
    if flat:
        first, past = _rows_of(leaf >> level, tree)
        return probability * _power(i, tree) / (load_double(tree.sums, past) - load_double(tree.sums, first))
    if not here > ZERO:
        return 0.0
    return probability * np.float64(triangle_weight(i, px, py, pz, tree.rows)) / np.float64(here)
