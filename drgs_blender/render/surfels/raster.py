"""The rasteriser: surfels to sub-pixel samples by exact ray-splat intersection, blended front to back, on the CPU.

The splats of a frame come from `splats`, their alpha blending from `blending`. A splat's alpha at a sample is opacity
times its kernel G = max(exp(-(u^2 + v^2) / 2), c exp(-n d^2)), d the distance in pixels between the sample and the
projected centre, n the samples per pixel: the low-pass filter of 2DGS (Huang et al. 2024) at the rate at which the
picture is sampled, so that silhouettes do not grow by a pixel where there are sub-samples. c is the cosine at which
the surfel is seen (`splats.DIM` is -2 ln c): it weakens the filter of surfels edge-on. A sample that the low-pass
decides has the centre's depth. Alphas below 1/255 are skipped, others clamped to 0.99 and blended until the
transmittance is below 1e-4.

Surfels smaller than the filter. Where the low-pass decides, a surfel's weight in the means is its alpha times the part
of the filter's area that it fills (`splats.SHARE`; Yu et al. 2024, "Mip-Splatting", equation 9): else many small
surfels would count for more than the few large ones beside them, and the nearest would be all that is seen of a slope.
Coverage is of the alphas without that part, so that no object fades with its distance; a little behind the depth where
it is full, blending ends (`blending.BEHIND`).

Order. Contributions are blended by the depth at which the ray meets them, not by that of the surfels' centres: every
sample lists its contributions and sorts them once all are there. A list that is full is sorted early and cut where the
sample is opaque, and only when that does not make room it grows; as 1/255 is the least coverage, and
`blending.MOST_BEHIND` contributions the most once that is full, it stays short.

Depth gaps. Where a ray passes the edge of one surface and meets another, the mean of both would be a point between
them. Contributions are therefore split into clusters where the depth jumps by more than `GAP` standard deviations of
the surfels on both sides (or of the pixel, when that is larger). Position, normal and material are those of the
heaviest cluster alone; coverage is that of all.

Work is divided in tiles and these in blocks of samples that are neighbours in a row; a sample's result depends neither
on them nor on the rows rendered together. Kernels that take many arrays are functions of their own, never inlined in
Numba's sense: in a loop that would count references of every array at every turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import over_strided
from ..camera import CLIP_END, CLIP_START, FX, FY, ORTHOGRAPHIC, SUBPIXELS, WIDTH, lattice, pixel_shift
from ..surfel_columns import OPACITY, SAMPLE, SPLAT
from .blending import (
    BEHIND,
    GAP,
    LANES,
    MIN_TRANSMITTANCE,
    behind_of,
    contributions,
    mean,
    prune,
    scratch_for,
    sort,
    weigh,
    widen,
)
from .splats import (
    CUT,
    DIM,
    LOW,
    MAX_ALPHA,
    RECORD,
    RX,
    RY,
    SHARE,
    TILE,
    ZC,
    A,
    B,
    D,
    N,
    Splats,
)

Array = np.ndarray

__all__ = ["GAP", "SurfelSamples", "rasterise"]

# Rows of the state of a block, `LANES` samples that vector code works on at a time: position; transmittance of all
# contributions gathered, by strength and by coverage; the depth of the farthest, and that behind which none counts;
# strength, coverage and depth of the splat at hand.
_X, _Y, _LEFT, _CLEAR, _FARTHEST, _BEHIND, _ALPHA, _COVER, _DEPTH, _BLOCK = (np.uintp(LANES * k) for k in range(10))
# Columns of a splat's record that are free on the screen: opacity and nearest depth.
_STRENGTH, _NEAREST = RECORD - 2, RECORD - 1
#: Contributions of a sample there is room for at first.
ROOM = 64
#: Splats between two looks at which blocks are opaque.
_CHECK = 32


class SurfelSamples(NamedTuple):
    """Dense samples of some rows; where ``alpha`` is 0 the other arrays are undefined.

    Attributes
    ----------
    alpha : (rows, width, subpixels) float32 array
        Coverage, 1 - transmittance.
    depth : (rows, width, subpixels) float32 array
        Metres along the view axis.
    surface : (rows, width, subpixels, SAMPLE) float32 array
        See `columns`. World normals are unit vectors on the surfels' own side, which may face away from the viewer,
        or 0 where they cancel; the size is the mean standard deviation.
    object_index : (rows, width, subpixels) int32 array
    """

    alpha: Array
    depth: Array
    surface: Array
    object_index: Array


class View(NamedTuple):
    """Camera parameters for blending.

    Attributes
    ----------
    parameters : array
        `camera.camera_parameters`.
    width, subpixels : int
        Of the full picture; of a pixel.
    near, far : float
        Clip range, metres.
    pixel_base, pixel : float
        A pixel at depth z is ``pixel_base + pixel * z`` metres wide.
    behind : float
        `blending.BEHIND` for these samples, pixels.
    """

    parameters: Array
    width: int
    subpixels: int
    near: np.float32
    far: np.float32
    pixel_base: np.float32
    pixel: np.float32
    behind: np.float32


class Tile(NamedTuple):
    """A tile in full-picture pixels.

    Attributes
    ----------
    x, y : int
        Its first pixel.
    left, top, right, bottom : int
        Its rendered part, half-open.
    """

    x: int
    y: int
    left: int
    top: int
    right: int
    bottom: int


class TileSplats(NamedTuple):
    """Splats of a tile for blending, gathered in contiguous memory.

    Attributes
    ----------
    screen : (n, RECORD) float32 array
        With strength and nearest depth in the columns that are free.
    surface : (n, SPLAT) float32 array
    span : (n, 4) int32 array
        First sample of the tile's rows, first row, last sample + 1, last row + 1.
    object_index : (n,) int32 array
    """

    screen: Array
    surface: Array
    span: Array
    object_index: Array


def rasterise(splats: Splats, y0: int, y1: int) -> SurfelSamples:
    """Blend the splats for the rows ``y0 .. y1`` (full-picture pixels, inside the window)."""
    shape = (y1 - y0, splats.x1 - splats.x0, int(splats.parameters[SUBPIXELS]))
    samples = SurfelSamples(
        np.zeros(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty((*shape, SAMPLE), np.float32),
        np.empty(shape, np.int32),
    )
    if splats.number:
        over_strided(_blend, len(splats.tile_start) - 1, splats, y0, y1, samples)
    return samples


@inlined
def gaussian(q):  # type: ignore[no-untyped-def]
    """exp(-q / 2) for 0 <= q <= 12, relative error below 4e-6: Taylor's series of exp(-q / 32) to the 16th power.

    Branch-free, so that a loop over samples becomes vector code.

    Parameters
    ----------
    q : float32
        Square radius in standard deviations.

    Returns
    -------
    float32
    """
    t = q * np.float32(-1.0 / 32.0)
    y = np.float32(1.0 / 720.0)
    y = y * t + np.float32(1.0 / 120.0)
    y = y * t + np.float32(1.0 / 24.0)
    y = y * t + np.float32(1.0 / 6.0)
    y = y * t + np.float32(0.5)
    y = y * t + np.float32(1.0)
    y = y * t + np.float32(1.0)
    y = y * y
    y = y * y
    y = y * y
    return y * y


@njit
def _meet(screen, i, opacity, view, state, first, last):  # type: ignore[no-untyped-def]
    """Splat i at the lanes first .. last of a block: strength (0 where it has no part), coverage and depth.

    Returns how many have a part.

    One array, constant distances, no branch: the loop becomes vector code.
    """
    big, zero, one, stop = np.float32(1e30), np.float32(0.0), np.float32(1.0), np.float32(MIN_TRANSMITTANCE)
    near, far = view.near, view.far
    rx, ry, zc = screen[i, RX], screen[i, RY], screen[i, ZC]
    cut, low, dim, share = screen[i, CUT], screen[i, LOW], screen[i, DIM], screen[i, SHARE]
    a0, a1, a2 = screen[i, A], screen[i, A + 1], screen[i, A + 2]
    b0, b1, b2 = screen[i, B], screen[i, B + 1], screen[i, B + 2]
    n0, n1, n2 = screen[i, N], screen[i, N + 1], screen[i, N + 2]
    d0, d1, d2 = screen[i, D], screen[i, D + 1], screen[i, D + 2]
    hits = np.int32(0)
    for j in range(LANES):
        at = np.uintp(j)
        ex, ey = state[at + _X] - rx, state[at + _Y] - ry
        inverse = one / (n0 + n1 * ex + n2 * ey)
        u = (a0 + a1 * ex + a2 * ey) * inverse
        v = (b0 + b1 * ex + b2 * ey) * inverse
        z = (d0 + d1 * ex + d2 * ey) * inverse
        # NaN and points outside the clip range leave the low-pass alone.
        exact = u * u + v * v if (z > near) & (z < far) else big
        filtered = low * (ex * ex + ey * ey) + dim
        take = exact <= filtered
        q = exact if take else filtered
        z = z if take else zc
        before, clear = state[at + _LEFT], state[at + _CLEAR]
        farthest, behind = state[at + _FARTHEST], state[at + _BEHIND]
        inside = (np.int32(j) >= first) & (np.int32(j) < last)
        counts = ((before >= stop) | (z < farthest)) & (z < behind)
        seen = inside & (q < cut) & (z > near) & (z < far) & counts
        cover = min(opacity * gaussian(q), np.float32(MAX_ALPHA)) if seen else zero
        alpha = cover if take else share * cover
        farthest = z if seen & (z > farthest) else farthest
        clear = clear * (one - cover)
        state[at + _ALPHA] = alpha
        state[at + _COVER] = cover
        state[at + _DEPTH] = z
        state[at + _LEFT] = before * (one - alpha)
        state[at + _CLEAR] = clear
        state[at + _FARTHEST] = farthest
        state[at + _BEHIND] = behind_of(clear, behind, farthest, view.pixel_base, view.pixel, view.behind)
        hits = np.int32(hits + np.int32(seen))
    return hits


@njit
def _tile_splats(n):  # type: ignore[no-untyped-def]
    """Memory for n splats of a tile."""
    screen, surface = np.empty((n, RECORD), np.float32), np.empty((n, SPLAT), np.float32)
    return TileSplats(screen, surface, np.empty((n, 4), np.int32), np.empty(n, np.int32))


@njit
def _collect(splats, begin, end, tile, subpixels, own):  # type: ignore[no-untyped-def]
    """Bring together what blending reads of a tile's splats, the entries begin .. end of the list, in `own`."""
    screen, surface, span, box = own.screen, own.surface, own.span, splats.box
    for entry in range(begin, end):
        i, e = np.uintp(splats.tile_list[entry]), np.uintp(entry - begin)
        for c in range(RECORD):
            screen[e, c] = splats.screen[i, c]
        for c in range(SPLAT):
            surface[e, c] = splats.surface[i, c]
        screen[e, _STRENGTH], screen[e, _NEAREST] = splats.surface[i, OPACITY], splats.nearest[i]
        span[e, 0] = (max(box[i, 0], tile.left) - tile.x) * subpixels
        span[e, 2] = (min(box[i, 2], tile.right) - tile.x) * subpixels
        span[e, 1], span[e, 3] = max(box[i, 1], tile.top) - tile.y, min(box[i, 3], tile.bottom) - tile.y
        own.object_index[e] = splats.object_index[i]


@njit
def _count(spans, n, blocks_row, start):  # type: ignore[no-untyped-def]
    """start[b + 1] .. start[b + 2]: how many of the tile's splats touch the blocks before, and b as well."""
    start[:] = 0
    for e in range(n):
        first, last = spans[e, 0] // LANES, (spans[e, 2] - 1) // LANES
        for y in range(spans[e, 1], spans[e, 3]):
            for block in range(y * blocks_row + first, y * blocks_row + last + 1):
                start[np.uintp(block + 2)] += 1
    for b in range(2, len(start)):
        start[b] += start[b - 1]


@njit
def _bin(spans, n, blocks_row, start, binned):  # type: ignore[no-untyped-def]
    """Counting sort of the tile's splats by block, in order; afterwards start[b] .. start[b + 1] are those of b."""
    for e in range(n):
        first, last = spans[e, 0] // LANES, (spans[e, 2] - 1) // LANES
        for y in range(spans[e, 1], spans[e, 3]):
            for block in range(y * blocks_row + first, y * blocks_row + last + 1):
                to = start[np.uintp(block + 1)]
                binned[np.uintp(to)] = e
                start[np.uintp(block + 1)] = to + 1


@njit
def _limit(state):  # type: ignore[no-untyped-def]
    """Depth from which on a block takes no contribution, as all its samples are opaque."""
    limit = np.float32(-1e30)
    for lane in range(LANES):
        k = np.uintp(lane)
        is_open = state[_LEFT + k] >= np.float32(MIN_TRANSMITTANCE)
        limit = max(limit, min(np.float32(1e30) if is_open else state[_FARTHEST + k], state[_BEHIND + k]))
    return limit


@njit
def _place(view, tile, y, first, state):  # type: ignore[no-untyped-def]
    """Start a block: positions of its samples, nothing gathered. Those outside the window count as opaque."""
    zero = np.float32(0.0)
    for lane in range(LANES):
        k = np.uintp(lane)
        x = tile.x + (first + lane) // view.subpixels
        state[_X + k] = state[_Y + k] = state[_LEFT + k] = zero
        state[_CLEAR + k], state[_BEHIND + k] = np.float32(1.0), np.float32(np.inf)
        state[_FARTHEST + k] = np.float32(-1e30)
        if tile.left <= x < tile.right:
            shift_x, shift_y = pixel_shift(view.parameters, y * view.width + x)
            jx, jy = lattice(shift_x, shift_y, (first + lane) % view.subpixels, view.parameters)
            state[_X + k], state[_Y + k], state[_LEFT + k] = x + jx, y + jy, np.float32(1.0)


@njit
def _gather(own, binned, begin, end, first, view, state, count, lists):  # type: ignore[no-untyped-def]
    """List the contributions of the splats begin .. end to a block's samples.

    Returns the splat to go on with: it is less than `end` when a sample's list is full.
    """
    screen, span, capacity = own.screen, own.span, lists.capacity
    depth, cover, strength, splat = lists.depth, lists.cover, lists.strength, lists.splat
    limit = np.float32(1e30)
    for entry in range(begin, end):
        i = np.uintp(binned[np.uintp(entry)])
        if (entry - begin) % _CHECK == _CHECK - 1:
            limit = _limit(state)
        if screen[i, _NEAREST] >= limit:
            continue
        hits = _meet(
            screen, i, screen[i, _STRENGTH], view, state,
            np.int32(span[i, 0] - first), np.int32(span[i, 2] - first),
        )  # fmt: skip
        if hits == 0:
            continue
        most = np.int32(0)
        for lane in range(LANES):
            k = np.uintp(lane)
            n = count[k]
            to = k * np.uintp(capacity) + np.uintp(n)
            depth[to], cover[to] = state[_DEPTH + k], state[_COVER + k]
            strength[to], splat[to] = state[_ALPHA + k], i
            n += np.int32(state[_ALPHA + k] > np.float32(0.0))
            count[k] = n
            most = max(most, n)
        if most == capacity:
            return entry + 1
    return end


@njit
def _finish(own, lists, count, scratch, view, y, x, first, samples):  # type: ignore[no-untyped-def]
    """Resolve the samples of a block and write them; y, x: row, and first column of the tile, of the samples."""
    for lane in range(LANES):
        n = np.int64(count[lane])
        if n == 0:
            continue
        base = lane * lists.capacity
        sort(lists, base, n, scratch)
        column, k = x + (first + lane) // view.subpixels, (first + lane) % view.subpixels
        clear, total, depth, owner, begin, end = weigh(own.surface, lists, base, n, scratch, view)
        values = mean(own.surface, lists, base, scratch, total, begin, end)
        for c in range(SAMPLE):
            samples.surface[y, column, k, c] = values[c]
        samples.alpha[y, column, k] = np.float32(1.0) - clear
        samples.depth[y, column, k] = depth * (np.float32(1.0) / total)
        samples.object_index[y, column, k] = own.object_index[owner]


@njit
def _view(p):  # type: ignore[no-untyped-def]
    ortho = p[ORTHOGRAPHIC] != 0.0
    pixel = np.float32(0.0 if ortho else 1.0 / min(p[FX], p[FY]))
    pixel_base = np.float32(1.0 / min(p[FX], p[FY]) if ortho else 0.0)
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    behind = np.float32(BEHIND / np.sqrt(p[SUBPIXELS]))
    return View(p, np.int64(p[WIDTH]), np.int64(p[SUBPIXELS]), near, far, pixel_base, pixel, behind)


@njit
def _blend(first_part, last_part, parts, splats, y0, y1, samples):  # type: ignore[no-untyped-def]
    """Blend tiles that meet the rows y0 .. y1: a part is every `parts`-th one, since neighbours cost alike."""
    x0, x1 = splats.x0, splats.x1
    tile_x0, tile_y0 = x0 // TILE, splats.y0 // TILE
    tiles_x = (x1 - 1) // TILE - tile_x0 + 1
    first_row, last_row = y0 // TILE, (y1 - 1) // TILE
    view = _view(splats.parameters)
    blocks_row = TILE * view.subpixels // LANES
    state, count = np.empty(_BLOCK, np.float32), np.empty(LANES, np.int32)
    lists, scratch = contributions(ROOM), scratch_for(ROOM)
    start, binned = np.empty(TILE * blocks_row + 2, np.int64), np.empty(0, np.int32)
    own = _tile_splats(0)
    for task in range(tiles_x * (last_row - first_row + 1)):
        if not first_part <= task % parts < last_part:
            continue
        tx, ty = tile_x0 + task % tiles_x, first_row + task // tiles_x
        number = (ty - tile_y0) * tiles_x + task % tiles_x
        listed, n = splats.tile_start[number], splats.tile_start[number + 1] - splats.tile_start[number]
        if n == 0:
            continue
        left, right = max(tx * TILE, x0), min(tx * TILE + TILE, x1)
        tile = Tile(tx * TILE, ty * TILE, left, max(ty * TILE, y0), right, min(ty * TILE + TILE, y1))
        if n > len(own.screen):
            own = _tile_splats(2 * n)
        _collect(splats, listed, listed + n, tile, view.subpixels, own)
        _count(own.span, n, blocks_row, start)
        if start[-1] > len(binned):
            binned = np.empty(2 * start[-1], np.int32)
        _bin(own.span, n, blocks_row, start, binned)
        for block in range(TILE * blocks_row):
            begin, end = start[block], start[block + 1]
            if begin == end:
                continue
            y = tile.y + block // blocks_row
            first = block % blocks_row * LANES  # of the samples of the tile's row
            _place(view, tile, y, first, state)
            count[:] = 0
            while True:
                begin = _gather(own, binned, begin, end, first, view, state, count, lists)
                if begin == end:
                    break
                most = 0
                for lane in range(LANES):
                    if count[lane] == lists.capacity:
                        kept = prune(lists, lane * lists.capacity, lists.capacity, scratch, view)
                        if kept < lists.capacity:
                            last = lists.depth[lane * lists.capacity + kept - 1]
                            state[_FARTHEST + np.uintp(lane)] = state[_BEHIND + np.uintp(lane)] = last
                        count[lane] = kept
                    most = max(most, count[lane])
                if most > lists.capacity // 2:
                    lists = widen(lists)
                    scratch = scratch_for(lists.capacity)
            _finish(own, lists, count, scratch, view, y - y0, tile.x - x0, first, samples)
