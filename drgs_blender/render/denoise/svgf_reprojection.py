"""Reprojection: another picture's light on this one's surfaces, over time and in windows.

Every pixel looks up where its surface was (`motion`); of the four pixels around that place those count that show the
same object, lie on the tangent plane there and are turned alike.
"""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from ..sampling import ONE, ZERO, F
from .demodulation import CERTAINTY, NORMAL, PAD, POSITION, ROUGHNESS, SOURCE, SURFACE, WIDTH, Signal

Array = np.ndarray

#: Distance from the tangent plane, in pixel widths, up to which a pixel of another frame shows the same surface.
SAME_PLANE = 2.0
#: Cosine of the angle by which its normal may differ; surfaces turn between frames.
SAME_NORMAL = 0.7
#: Widths of a lobe by which a reflection may turn with its surface until it counts 1/e, and least roughness of a lobe.
LOBES, LEAST_ROUGHNESS = 2.0, 0.05
#: Pixel widths up to which a surface has not moved in the world.
STOOD = 1e-2


def warp(other: Signal, signal: Signal, vector: Array, expected: Array) -> tuple[Array, Array]:
    """Reprojection of another picture's light to the surfaces of `signal`.

    Parameters
    ----------
    other, signal : Signal
    vector : (h, w, 2) float32 array
        Pixels: where the surfaces of `signal` are in the other picture, see `Motion.vector`.
    expected : (h, w, 3) float32 array
        World, m: the place of these surfaces then, see `Motion.previous`.

    Returns
    -------
    light : (h, planes, w + 2 PAD) float32 array
        0 where there is none; ``CERTAINTY`` is the part of a lobe's light that counts, see `part_kept`.
    source : (h, w + 2 PAD) float32 array
        Its ``SOURCE``, NaN where there is none.
    """
    light = np.zeros_like(signal.light)
    source = np.full((len(light), light.shape[2]), np.nan, np.float32)
    over_range(
        _look_up,
        len(light),
        signal.guide,
        signal.spans,
        vector,
        expected,
        other.guide,
        other.light,
        light,
        source,
        fewest=ROWS,
    )
    return light, source


@njit
def _look_up(y0, y1, guide, spans, vector, expected, other, other_light, out, source):  # type: ignore[no-untyped-def]
    for y in range(y0, y1):
        for x in range(spans[y, 0], spans[y, 1]):
            look_up_pixel(y, x, guide, vector, expected, other, other_light, out, source)


@inlined
def is_same_surface(other, y, c, px, py, pz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Whether a pixel of another frame shows a surface.

    Parameters
    ----------
    other : (h, GUIDES, w + 2 PAD) float32 array
        Guide of that frame.
    y, c : int64
        Row and padded column of the pixel.
    px, py, pz, nx, ny, nz : float32
        Place and normal of the surface, world space.

    Returns
    -------
    bool
    """
    ox, oy, oz = other[y, NORMAL, c], other[y, NORMAL + 1, c], other[y, NORMAL + 2, c]
    away = (
        ox * (px - other[y, POSITION, c])
        + oy * (py - other[y, POSITION + 1, c])
        + oz * (pz - other[y, POSITION + 2, c])
    )
    alike = ox * nx + oy * ny + oz * nz
    return abs(away) * other[y, WIDTH, c] < F(SAME_PLANE) and not alike < SAME_NORMAL


@inlined
def part_kept(turn, roughness):  # type: ignore[no-untyped-def]
    """Part of a surface's earlier glossy light that counts: less the further what it reflects turned.

    Reflections do not move with the surface: where dark and bright ones glide over it, the mean change around a pixel,
    which `svgf_temporal.find_change` measures, may be none.

    Parameters
    ----------
    turn : float32
        Square of the angle by which the reflected direction turned against the light, radians.
    roughness : float32
        Of the surface, whose square is the width of its lobe.

    Returns
    -------
    float32
    """
    width = F(LOBES) * max(roughness, F(LEAST_ROUGHNESS)) * max(roughness, F(LEAST_ROUGHNESS))
    kept = F(math.exp(-turn / (width * width)))
    return kept if kept > ZERO else ZERO  # a roughness that is no number keeps none


@njit
def look_up_pixel(y, x, guide, vector, expected, other, other_light, out, source):  # type: ignore[no-untyped-def]
    """Reprojection of a pixel: the other picture's light, bilinear over those of four pixels that show its surface.

    Parameters
    ----------
    y, x : int64
        Pixel.
    guide : (h, GUIDES, w + 2 PAD) float32 array
        Of this picture, see `Signal`.
    vector : (h, w, 2) float32 array
        `Motion.vector`, pixels.
    expected : (h, w, 3) float32 array
        `Motion.previous`: place of the surface in the other picture, world, m.
    other, other_light : (h, planes, w + 2 PAD) float32 array
        Guide and light of the other picture, see `Signal`.
    out : (h, planes, w + 2 PAD) float32 array
        The pixel, which is 0, is written.
    source : (h, w + 2 PAD) float32 array
        The pixel is written where it has a past: the surface, see `SURFACE`.
    """
    h, planes = out.shape[0], out.shape[1]
    w = out.shape[2] - 2 * PAD
    c = x + PAD
    surface = guide[y, SURFACE, c]
    px, py = F(x) + vector[y, x, 0], F(y) + vector[y, x, 1]
    # A comparison that NaN fails too.
    if not (px > -ONE and py > -ONE and px < F(w) and py < F(h)) or surface != surface:
        return
    left, top = math.floor(px), math.floor(py)
    fx, fy = px - F(left), py - F(top)
    total, there_x, there_y, there_z = ZERO, ZERO, ZERO, ZERO
    nx, ny, nz = guide[y, NORMAL, c], guide[y, NORMAL + 1, c], guide[y, NORMAL + 2, c]
    for j in range(2):
        for i in range(2):
            share = (fx if i else ONE - fx) * (fy if j else ONE - fy)
            yy, cc = top + j, left + i + PAD
            if share <= F(1e-3) or yy < 0 or yy >= h:
                continue
            if other[yy, SOURCE, cc] != surface:
                continue
            if not is_same_surface(other, yy, cc, expected[y, x, 0], expected[y, x, 1], expected[y, x, 2], nx, ny, nz):
                continue
            total += share
            there_x += share * other[yy, NORMAL, cc]
            there_y += share * other[yy, NORMAL + 1, cc]
            there_z += share * other[yy, NORMAL + 2, cc]
            for k in range(planes):
                out[y, k, c] += share * other_light[yy, k, cc]
    if total > ZERO:
        source[y, c] = surface
        inverse = ONE / total
        for k in range(planes):
            out[y, k, c] *= inverse
        moved = ZERO
        for k in range(3):
            step = (expected[y, x, k] - guide[y, POSITION + k, c]) * guide[y, WIDTH, c]
            moved += step * step
        here = nx * nx + ny * ny + nz * nz
        there = there_x * there_x + there_y * there_y + there_z * there_z
        both = nx * there_x + ny * there_y + nz * there_z
        # Reflections turn by twice a small angle t between normals, whose square is 8 (1 - cos t). Normals of what
        # stands, means over a pixel's samples, differ a little, too; so do moving bumps of a pixel's width, which lose
        # some of their history.
        turn = F(8.0) * max(ONE - both / F(math.sqrt(max(here * there, F(1e-12)))), ZERO)
        out[y, CERTAINTY, c] = ONE
        out[y, CERTAINTY + 1, c] = part_kept(turn, guide[y, ROUGHNESS, c]) if moved > F(STOOD * STOOD) else ONE
