"""Level of detail: an order of surfels of which every beginning stands for all of them.

Along a space-filling curve (Morton's) each surfel gets an interval as long as its share of all area, weighted by
opacity. The points of van der Corput's sequence fall into these intervals one after the other; a surfel comes as early
as the first point that meets it. So any number of first surfels lies evenly over the object, and what covers more comes
before what covers less: systematic sampling by importance, see Cochran, "Sampling Techniques", 1977, chapter 8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .asset.model import Surfels

Array = np.ndarray

#: Surfels that moving pictures show at most, where nothing else is said.
MOST_SURFELS = 500_000
#: A surfel counts at least this part of the mean, so that faint and tiny ones have their turn, and do not grow huge.
_LEAST = 1 / 16
#: By how much more a beginning covers than all: its surfels do not lie as evenly, and gaps show more than blur.
_OVERLAP = np.float32(1.5)
#: Bits of a coordinate, and of a place on the curve: a float64 holds it exactly.
_COORDINATE_BITS, _PLACE_BITS = 21, 52


@dataclass(slots=True)
class Detail:
    """The order of an asset's surfels.

    Attributes
    ----------
    order : (n,) int32 array
        Surfels, the most needed first.
    share : (n,) float32 array
        Of each in that order, its part of what all cover; the sum is 1.
    points : (n,) float32 array
        How many points of the sequence the surfels up to each stand for.
    """

    order: Array
    share: Array
    points: Array

    @classmethod
    def of(cls, surfels: Surfels, check: Callable[[], None] = lambda: None) -> Detail:
        """Order `surfels`; the same for the same ones. What `check` raises, asked several times, ends it.

        Examples
        --------
        Of eight in a row the first two are of different halves:

        >>> places = [[x, 0, 0] for x in range(8)]
        >>> ones = [1] * 8
        >>> row = Surfels(places, [[1, 1]] * 8, [[1, 0, 0, 0]] * 8, ones, [[1, 1, 1]] * 8, ones, ones)
        >>> Detail.of(row).order
        array([0, 4, 2, 6, 1, 5, 3, 7], dtype=int32)
        """
        count = len(surfels)
        if not count:
            return cls(np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0, np.float32))
        code = _morton(surfels.centre)
        check()
        curve = np.argsort(code, kind="stable").astype(np.int32)
        check()
        weight = surfels.scale[:, 0].astype(np.float64) * surfels.scale[:, 1] * surfels.opacity
        weight = np.nan_to_num(weight, nan=0.0, posinf=0.0, neginf=0.0)
        mean = float(weight.mean())
        weight = np.maximum(weight, _LEAST * mean if mean > 0 else 1.0)[curve]
        ends = np.cumsum(weight)
        # At least two places each, so that no interval is empty.
        room = 2**_PLACE_BITS - 2 * count
        ends = (ends * (room / ends[-1])).astype(np.int64) + 2 * np.arange(1, count + 1, dtype=np.int64)
        check()
        index = _first_points(np.concatenate([[0], ends[:-1]]), ends)
        check()
        turn = np.argsort(index, kind="stable")
        share = (weight / weight.sum()).astype(np.float32)
        return cls(curve[turn], share[turn], (index[turn] + 1).astype(np.float32))

    def growth(self, count: int) -> Array:
        """(count,) float32: by how much the area of each of the first `count` surfels grows to stand for all."""
        return np.maximum(_OVERLAP / (self.points[count - 1] * self.share[:count]), np.float32(1.0))


def enlarged(tangent_u: Array, tangent_v: Array, growth: Array) -> tuple[Array, Array]:
    """Surfels that cover `growth` times their area: first the shorter tangent grows as long as the other, then both.

    Long thin ones become round, so that they do not stick out of the object.

    Parameters
    ----------
    tangent_u, tangent_v : (n, 3) float32 array
        Scaled tangents.
    growth : (n,) float32 array
        1 or more.
    """
    u, v = (np.sqrt(np.einsum("ij,ij->i", t, t)) for t in (tangent_u, tangent_v))
    longer, shorter = np.maximum(u, v), np.minimum(u, v)
    alone = np.clip(longer / np.maximum(shorter, np.float32(1e-30)), np.float32(1.0), growth)
    both = np.sqrt(growth / alone)
    is_u = u < v
    return (
        tangent_u * np.where(is_u, alone * both, both)[:, None],
        tangent_v * np.where(is_u, both, alone * both)[:, None],
    )


def _morton(centre: Array) -> Array:
    """(n,) uint64 places along Morton's curve through a cube around all finite `centre` (n, 3)."""
    finite = np.where(np.isfinite(centre), centre, 0.0)
    low = finite.min(axis=0)
    size = max(float((finite.max(axis=0) - low).max()), 1e-30)
    scale = (2**_COORDINATE_BITS - 1) / size
    code = np.zeros(len(centre), np.uint64)
    for axis in range(3):
        x = ((finite[:, axis].astype(np.float64) - low[axis]) * scale).astype(np.uint64)
        for shift, mask in (
            (32, 0x001F00000000FFFF),
            (16, 0x001F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            x = (x | (x << np.uint64(shift))) & np.uint64(mask)
        code |= x << np.uint64(axis)
    return code


def _first_points(begin: Array, end: Array) -> Array:
    """(n,) uint64: the first point of van der Corput's sequence in each interval ``begin .. end`` of places."""
    low, last = begin - 1, end - 1
    # The multiple of the highest power of two: there is just one in the interval.
    power = np.frexp((low ^ last).astype(np.float64))[1].astype(np.int64) - 1
    first = (last >> np.maximum(power, 0)) << np.maximum(power, 0)
    place = np.where(begin == 0, 0, first).astype(np.uint64)
    reverse = place << np.uint64(64 - _PLACE_BITS)
    for shift, mask in (
        (1, 0x5555555555555555),
        (2, 0x3333333333333333),
        (4, 0x0F0F0F0F0F0F0F0F),
        (8, 0x00FF00FF00FF00FF),
        (16, 0x0000FFFF0000FFFF),
        (32, 0x00000000FFFFFFFF),
    ):
        some = np.uint64(mask)
        reverse = ((reverse >> np.uint64(shift)) & some) | ((reverse & some) << np.uint64(shift))
    return reverse
