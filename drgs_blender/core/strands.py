"""Strands of hair as tubes of triangles, which everything that meets meshes meets: numpy alone.

A strand is a uniform Catmull-Rom spline through its points with the ends doubled, as Cycles draws it, radius included.
Cycles' strands are round; ours have few sides, and are as thick in the mean over all directions: by Cauchy's formula
the mean width of a convex section is its circumference / pi. They are shaded flat across: as every strand is turned
another way, flat sides have the normals of round ones in the same shares. With smooth normals so few sides would lose
the light that is above the normal and below the side: white fur of four sides was 5 % too dark.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

Array = np.ndarray

#: Pieces that a strand has at least, if it is curved.
SEGMENTS = 12
SIDES = 4
#: Of more triangles than that, strands are as coarse as they are given, then with three sides.
MOST_TRIANGLES = 4_000_000
#: Turns a strand is rotated about itself more than the one before, so that corners of neighbours do not face one way.
_GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, slots=True)
class Tubes:
    """A mesh of strands: for each, rings from root to tip of two vertices a side, which have its normal.

    How many vertices there are, and which is which, depends on the numbers of points alone, so that strands that move
    keep theirs.

    Attributes
    ----------
    vertices, normals : (2 * r * sides, 3) float32 array
        Ring by ring, side by side; normals are unit, away from the strand.
    faces : (m, 3) int32 array
        Counter-clockwise from outside. Strands that cannot be drawn have none.
    sides : int
    strand : (r,) int32 array
        Of each ring.
    point, part : (r,) int32 array, (r,) float32 array
        Between which points a ring is: this one and the next, at that part of the way.
    bad : (k,) bool array
        Strands with a number that is not finite.
    """

    vertices: Array
    normals: Array
    faces: Array
    sides: int
    strand: Array
    point: Array
    part: Array
    bad: Array

    @property
    def ring(self) -> Array:
        """(m,) int32: a ring of each face."""
        return self.faces[:, 0] // (2 * self.sides)

    def blend(self, values: Array) -> Array:
        """(r, c) values at the rings, of (n, c) at the points."""
        return _linear(values, self.point, self.part)


def triangle_count(offsets: Array, segments: int = SEGMENTS, sides: int = SIDES) -> int:
    """How many triangles `tubes` would make, at most."""
    points = np.diff(offsets)
    pieces = (points - 1) * _divisions(points, segments)
    return int(2 * sides * pieces[points > 1].sum()) + 2 * (sides - 2) * int((points > 1).sum())


def tubes(
    points: Array,
    offsets: Array,
    radii: Array,
    *,
    linear: bool = False,
    segments: int = SEGMENTS,
    sides: int = SIDES,
) -> Tubes:
    """Make a mesh of strands.

    Parameters
    ----------
    points : (n, 3) float array
    offsets : (k + 1,) int array
        First point of each strand, and `n`. Strands of one point are left out, and those without length.
    radii : (n,) float array
        Of the round strand, in the unit of the points; negative ones are 0.
    linear : bool
        Straight between the points, and no finer than they are.
    segments : int
        Pieces that each strand has at least; 1: as many as it is given with.
    sides : int

    Returns
    -------
    Tubes
    """
    points, radii, offsets = np.asarray(points, np.float32), np.asarray(radii, np.float32), np.asarray(offsets)
    bad = _not_finite(points, radii, offsets)
    control = np.column_stack((points, np.maximum(radii, 0)))
    control[~np.isfinite(control).all(axis=1)] = 0
    count = np.diff(offsets)
    division = np.where(count > 1, 1 if linear else _divisions(count, segments), 0)
    rings = np.where(count > 1, (count - 1) * division + 1, 0)
    start = np.concatenate(([0], np.cumsum(rings)))
    strand = np.repeat(np.arange(len(count), dtype=np.int32), rings)
    number = np.arange(start[-1]) - start[strand]  # of a ring on its strand
    piece = np.minimum(number // np.maximum(division[strand], 1), count[strand] - 2)
    part = ((number - piece * division[strand]) / np.maximum(division[strand], 1)).astype(np.float32)
    point = offsets[strand] + piece
    placed = _linear(control, point, part) if linear else _spline(control, offsets, strand, point, part)
    centres, thick = placed[:, :3], np.maximum(placed[:, 3], 0)
    along, length = _tangents(centres, start, rings, strand)
    across = _frames(along, start, rings)
    other = np.cross(along, across)
    half = math.pi / sides
    widened = (thick * np.float32(half / math.sin(half)))[:, None]
    vertices, normals = (np.empty((len(strand), sides, 2, 3), np.float32) for _ in range(2))
    for side in range(sides):
        cos, sin = (np.float32(part(2 * side * half)) for part in (math.cos, math.sin))
        vertices[:, side, 0] = vertices[:, side - 1, 1] = centres + widened * (cos * across + sin * other)
        cos, sin = (np.float32(part((2 * side + 1) * half)) for part in (math.cos, math.sin))
        normals[:, side] = (cos * across + sin * other)[:, None]
    drawn = (count > 1) & ~bad & (length > 0)
    faces = _faces(start, rings, strand, thick, drawn, sides)
    return Tubes(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        faces,
        sides,
        strand,
        point.astype(np.int32),
        part,
        bad,
    )


def _divisions(points: Array, segments: int) -> Array:
    """(k,) int: into how many pieces those between the points of a strand are cut; two points are a straight line."""
    pieces = np.maximum(points - 1, 1)
    return np.where(pieces == 1, 1, -(-segments // pieces))


def _not_finite(points: Array, radii: Array, offsets: Array) -> Array:
    """(k,) bool: strands with a number that is none."""
    wrong = ~(np.isfinite(points).all(axis=1) & np.isfinite(radii))
    found = np.zeros(len(offsets) - 1, bool)
    if wrong.any():
        found[np.searchsorted(offsets, np.flatnonzero(wrong), side="right") - 1] = True
    return found


def _linear(control: Array, point: Array, part: Array) -> Array:
    t = part[:, None]
    return control[point] * (1 - t) + control[np.minimum(point + 1, max(len(control) - 1, 0))] * t


def _spline(control: Array, offsets: Array, strand: Array, point: Array, part: Array) -> Array:
    """(r, 4) float32: the spline through the control points, with radius."""
    last = offsets[strand + 1] - 1
    p1, p2 = control[point], control[np.minimum(point + 1, last)]
    p0, p3 = control[np.maximum(point - 1, offsets[strand])], control[np.minimum(point + 2, last)]
    t = part[:, None]
    a, b, c = p2 - p0, 2 * p0 - 5 * p1 + 4 * p2 - p3, 3 * (p1 - p2) + p3 - p0
    return np.where(t < 1, p1 + np.float32(0.5) * t * (a + t * (b + t * c)), p2)  # a tip of no radius has none


def _unit(vectors: Array, otherwise: Array) -> Array:
    """Unit vectors; `otherwise` where one is too short to say."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), otherwise)


def _tangents(centres: Array, start: Array, rings: Array, strand: Array) -> tuple[Array, Array]:
    """(r, 3) unit directions towards the tip, and the length of each strand."""
    step = np.zeros_like(centres)
    step[:-1] = centres[1:] - centres[:-1]
    some = rings > 0
    step[start[1:][some] - 1] = 0
    size = np.linalg.norm(step, axis=1)
    length = np.bincount(strand, size, len(rings))
    whole = np.zeros((len(rings), 3), np.float32)
    whole[some] = centres[start[1:][some] - 1] - centres[start[:-1][some]]
    whole = _unit(whole, np.array((0, 0, 1), np.float32))
    unit = _unit(step, np.zeros(3, np.float32))
    both = unit.copy()
    both[1:] += unit[:-1]  # of the last ring of the strand before it is 0
    return _unit(both, whole[strand]).astype(np.float32), length


def _frames(along: Array, start: Array, rings: Array) -> Array:
    """(r, 3) unit vectors across the strands, each its own way, transported from ring to ring without a twist."""
    across = np.zeros_like(along)
    order = np.argsort(-rings, kind="stable")
    order = order[rings[order] > 0]
    if not len(order):
        return across
    rows = start[order]
    now, turn = _across(along[rows]), (2 * math.pi * _GOLDEN * order[:, None]) % (2 * math.pi)
    now = (np.cos(turn) * now + np.sin(turn) * np.cross(along[rows], now)).astype(np.float32)
    across[rows] = now
    longer = rings[order]
    for number in range(1, int(longer[0])):
        now = now[: np.searchsorted(-longer, -number, side="left")]  # of strands with more rings
        rows = start[order[: len(now)]] + number
        t = along[rows]
        flat = now - (now * t).sum(axis=1, keepdims=True) * t
        now = _unit(flat, _across(t)) if (np.abs(flat).max(axis=1) < 1e-3).any() else flat
        now = now / np.linalg.norm(now, axis=1, keepdims=True)
        across[rows] = now
    return across


def _across(along: Array) -> Array:
    """(k, 3) unit vectors across unit ones."""
    least = np.eye(3, dtype=np.float32)[np.argmin(np.abs(along), axis=1)]
    return _unit(np.cross(along, least), np.array((1, 0, 0), np.float32)).astype(np.float32)


def _faces(start: Array, rings: Array, strand: Array, thick: Array, drawn: Array, sides: int) -> Array:
    """(m, 3) int32: two triangles between neighbours of each side, one where a ring is a point, and closed ends."""
    around = 2 * np.arange(sides, dtype=np.int32)
    after = around + 1
    has_next = np.ones(len(strand), bool)
    has_next[start[1:][rings > 0] - 1] = False
    low = np.flatnonzero(has_next & drawn[strand]).astype(np.int32)
    low = low[(thick[low] > 0) | (thick[low + 1] > 0)]

    def triangles(which: Array, *corners: tuple[int, Array]) -> Array:
        rows = [((which + ring) * np.int32(2 * sides))[:, None] + side for ring, side in corners]
        return np.stack(rows, axis=-1).reshape(-1, 3)

    first = triangles(low[thick[low] > 0], (0, around), (0, after), (1, after))
    second = triangles(low[thick[low + 1] > 0], (0, around), (1, after), (1, around))
    fan = around[1:-1], after[1:-1]
    roots, tips = (ends[drawn & (rings > 0)].astype(np.int32) for ends in (start[:-1], start[1:] - 1))
    zero = np.zeros(sides - 2, np.int32)
    root = triangles(roots[thick[roots] > 0], (0, zero), (0, fan[1]), (0, fan[0]))
    tip = triangles(tips[thick[tips] > 0], (0, zero), (0, fan[0]), (0, fan[1]))
    return np.ascontiguousarray(np.concatenate((first, second, root, tip)), np.int32)
