"""The reflection probe: a learned cube of light around the object, looked up along reflected rays.

A blurred mirror, deferred: each pixel's blended normal reflects the view, each surfel says how much and how blurred.
Values are display-encoded, like the colours that they are added to; Fresnel and occlusion are left to the materials'
own stage. It is less than the split-sum shading of Ref-Gaussian (Yao et al. 2025), whose other parts did not change
shapes: docs/decoupling.md has the figures.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ...core.arrays import Array
from .attributes import BLUR, NORMAL, TINT

#: Texels along an edge of the cube's faces, of the sharpest level.
SHARPEST = 32
LEVELS = 4
#: Pixels covered less than this mirror nothing.
BARE = np.float32(0.02)
#: Parts of a picture whose gradients are summed one after the other, whatever the number of threads.
_PARTS = 8


def dark_cube(value: float = 0.3) -> Tensor:
    """Logarithms (6, 3, 32, 32) of an even light."""
    return torch.full((6, 3, SHARPEST, SHARPEST), float(np.log(value)))


def pyramid(cube: Tensor) -> Tensor:
    """(texels, 3) of all levels, from the logarithms of the sharpest; each is the mean of the one before."""
    level, levels = cube.exp(), []
    for _ in range(LEVELS):
        levels.append(level.permute(0, 2, 3, 1).reshape(-1, 3))
        level = torch.nn.functional.avg_pool2d(level, 2)
    return torch.cat(levels)


def mirrored(features: Tensor, alpha: Tensor, rays: Array, texels: Tensor) -> Tensor:
    """(h, w, 3) what the pixels' surfaces mirror, weighted by coverage like any feature.

    Parameters
    ----------
    features : (h, w, 10) tensor
        Blended, see `attributes`: normals of any length, tint, and blur in 0..1, 0 a perfect mirror.
    alpha : (h, w) tensor
    rays : (h, w, 3) float32 array
        Viewer to surface, of any length.
    texels : tensor
        `pyramid` of the cube.
    """
    return _Mirrored.apply(features, alpha, rays, texels)


class _Mirrored(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, alpha: Tensor, rays: Array, texels: Tensor) -> Tensor:
        blended, cover, light = (np.ascontiguousarray(t.detach().numpy()) for t in (features, alpha, texels))
        seen = np.zeros((*cover.shape, 3), np.float32)
        over_range(_look_up_rows, len(cover), blended, cover, rays, light, seen, fewest=ROWS)
        ctx.save = (blended, cover, rays, light, seen)
        return torch.from_numpy(blended[..., TINT : TINT + 3] * seen)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        blended, cover, rays, light, seen = ctx.save
        to_features, to_alpha = np.zeros_like(blended), np.zeros_like(cover)
        to_texels = np.zeros((_PARTS, *light.shape), np.float32)
        incoming = np.ascontiguousarray(gradients[0].numpy())
        out = to_features, to_alpha, to_texels
        over_range(_look_up_backward, _PARTS, blended, cover, rays, light, seen, incoming, out)
        return torch.from_numpy(to_features), torch.from_numpy(to_alpha), None, torch.from_numpy(to_texels.sum(0))


@njit
def _face(d):  # type: ignore[no-untyped-def]
    """Axis of the face that a direction leaves through, the direction along it, the face's number, and place (a, b)."""
    x, y, z = d
    ax, ay, az = abs(x), abs(y), abs(z)
    axis, main, first, second = 2, z, x, y
    if ax >= ay and ax >= az:
        axis, main, first, second = 0, x, y, z
    elif ay >= az:
        axis, main, first, second = 1, y, z, x
    size = max(abs(main), np.float32(1e-12))
    return axis, main, 2 * axis + (1 if main < 0 else 0), first / size, second / size


@njit
def _texel(a, size):  # type: ignore[no-untyped-def]
    """First of the two texels that a place in -1..1 lies between, the part of the second, and its slope by place."""
    x = (a + np.float32(1.0)) * np.float32(0.5 * size) - np.float32(0.5)
    inside = (x > 0.0) & (x < size - 1)
    x = min(max(x, np.float32(0.0)), np.float32(size - 1))
    i = min(int(x), size - 2)
    return i, np.float32(x - i), np.float32(0.5 * size) if inside else np.float32(0.0)


@njit
def _start(level):  # type: ignore[no-untyped-def]
    """First texel of a level, and texels along its edges."""
    at, size = 0, SHARPEST
    for _ in range(level):
        at += 6 * size * size
        size //= 2
    return at, size


@njit
def _turned(pixel, ray):  # type: ignore[no-untyped-def]
    """Unit ray, unit normal, one over the normal's length, and the reflected direction."""
    one = np.float32(1.0)
    x, y, z = ray[0], ray[1], ray[2]
    r = one / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-12))
    x, y, z = x * r, y * r, z * r
    nx, ny, nz = pixel[NORMAL], pixel[NORMAL + 1], pixel[NORMAL + 2]
    r = one / max(np.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-12))
    nx, ny, nz = nx * r, ny * r, nz * r
    double = np.float32(2.0) * (x * nx + y * ny + z * nz)
    return (x, y, z), (nx, ny, nz), r, (x - double * nx, y - double * ny, z - double * nz)


@njit
def _levels(pixel, alpha):  # type: ignore[no-untyped-def]
    """Blur of a pixel, the sharper of the two levels that it lies between, and the share of the other."""
    blur = pixel[BLUR] / max(alpha, BARE)
    level = blur * np.float32(LEVELS - 1)
    low = min(max(int(level), 0), LEVELS - 2)
    return blur, low, level - np.float32(low)


@njit
def _look_up_rows(first, last, features, alpha, rays, texels, seen):  # type: ignore[no-untyped-def]
    """Light that comes from where each pixel reflects."""
    for y in range(first, last):
        for x in range(alpha.shape[1]):
            if alpha[y, x] > BARE:
                look_up(features[y, x], alpha[y, x], rays[y, x], texels, seen[y, x])


@njit
def look_up(pixel, alpha, ray, texels, seen):  # type: ignore[no-untyped-def]
    """Add the light that comes from where a pixel reflects.

    Parameters
    ----------
    pixel : (10,) float32 array
        Features.
    alpha : float32
    ray : (3,) float32 array
    texels : (texels, 3) float32 array
    seen : (3,) float32 array
        Added to.
    """
    _, _, _, direction = _turned(pixel, ray)
    _, _, face, a, b = _face(direction)
    _, low, mix = _levels(pixel, alpha)
    for k in range(2):
        start, size = _start(low + k)
        share = mix if k == 1 else np.float32(1.0) - mix
        i, s, _ = _texel(a, size)
        j, t, _ = _texel(b, size)
        at = start + (face * size + j) * size + i
        for c in range(3):
            top = texels[at, c] + s * (texels[at + 1, c] - texels[at, c])
            bottom = texels[at + size, c] + s * (texels[at + size + 1, c] - texels[at + size, c])
            seen[c] += share * (top + t * (bottom - top))


@njit
def texel_shares(pixel, alpha, ray, incoming, places, shares):  # type: ignore[no-untyped-def]
    """The eight texels that a pixel has looked up, and their gradients.

    Parameters
    ----------
    pixel, alpha, ray : array or float
        As of `look_up`.
    incoming : (3,) float32 array
        Gradient of what the pixel mirrors.
    places : (8,) int64 array
        Rows of the texels; written.
    shares : (8, 3) float32 array
        Gradients; written.
    """
    _, _, _, direction = _turned(pixel, ray)
    _, _, face, a, b = _face(direction)
    _, low, mix = _levels(pixel, alpha)
    one = np.float32(1.0)
    for k in range(2):
        start, size = _start(low + k)
        share = mix if k == 1 else one - mix
        i, s, _ = _texel(a, size)
        j, t, _ = _texel(b, size)
        for corner in range(4):
            right, below = corner % 2, corner // 2
            places[4 * k + corner] = start + (face * size + j + below) * size + i + right
            w = share * (s if right == 1 else one - s) * (t if below == 1 else one - t)
            for c in range(3):
                shares[4 * k + corner, c] = w * incoming[c] * pixel[TINT + c]


@njit
def _look_up_backward(first, last, features, alpha, rays, texels, seen, incoming, out):  # type: ignore[no-untyped-def]
    """A part's pixels in their order: many share a texel."""
    to_features, to_alpha, to_texels = out
    height = alpha.shape[0]
    for part in range(first, last):
        for y in range(part * height // _PARTS, (part + 1) * height // _PARTS):
            for x in range(alpha.shape[1]):
                if alpha[y, x] > BARE:
                    pixel = features[y, x], alpha[y, x], rays[y, x], seen[y, x], incoming[y, x]
                    pixel_gradients(pixel, texels, True, (to_features[y, x], to_alpha[y], x, to_texels[part]))


@njit
def pixel_gradients(given, texels, adds, out):  # type: ignore[no-untyped-def]
    """Gradients of a pixel's features and coverage, and of the texels that it has looked up.

    Parameters
    ----------
    given : tuple
        Features, coverage and ray as of `look_up`, what it has seen, and the gradient of what it mirrors.
    texels : (texels, 3) float32 array
    adds : bool
        Whether those of texels are added; `texel_shares` finds them otherwise.
    out : tuple
        Gradients of features (10,), written; coverages of a row of pixels, the pixel's place among them, written; and
        texels (texels, 3).
    """
    pixel, alpha, ray, seen, incoming = given
    to_pixel, to_alpha, x, to_texels = out
    one, two = np.float32(1.0), np.float32(2.0)
    view, normal, inverse, direction = _turned(pixel, ray)
    axis, main, face, a, b = _face(direction)
    blur, low, mix = _levels(pixel, alpha)
    g_a, g_b, g_mix = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(2):
        start, size = _start(low + k)
        share, sign = one - mix, -one
        if k == 1:
            share, sign = mix, one
        i, s, slope_a = _texel(a, size)
        j, t, slope_b = _texel(b, size)
        at = start + (face * size + j) * size + i
        for c in range(3):
            g = incoming[c] * pixel[TINT + c]
            q00, q10, q01, q11 = texels[at, c], texels[at + 1, c], texels[at + size, c], texels[at + size + 1, c]
            top, bottom = q00 + s * (q10 - q00), q01 + s * (q11 - q01)
            g_mix += sign * g * (top + t * (bottom - top))
            g_a += share * g * slope_a * ((one - t) * (q10 - q00) + t * (q11 - q01))
            g_b += share * g * slope_b * (bottom - top)
            if adds:
                w = share * g
                to_texels[at, c] += w * (one - s) * (one - t)
                to_texels[at + 1, c] += w * s * (one - t)
                to_texels[at + size, c] += w * (one - s) * t
                to_texels[at + size + 1, c] += w * s * t
    for c in range(3):
        to_pixel[TINT + c] = incoming[c] * seen[c]
    g_blur = g_mix * np.float32(LEVELS - 1)
    to_pixel[BLUR] = g_blur / alpha
    to_alpha[x] = -g_blur * blur / alpha
    # Of the direction, of the unit normal that it is reflected by, and of the normal as it was blended.
    length = max(abs(main), np.float32(1e-12))
    last = -(g_a * a + g_b * b) / (length if main >= 0 else -length)
    g_a, g_b = g_a / length, g_b / length
    gx, gy, gz = g_a, g_b, last
    if axis == 0:
        gx, gy, gz = last, g_a, g_b
    elif axis == 1:
        gx, gy, gz = g_b, last, g_a
    along = -two * (gx * normal[0] + gy * normal[1] + gz * normal[2])
    facing = -two * (view[0] * normal[0] + view[1] * normal[1] + view[2] * normal[2])
    hx, hy, hz = along * view[0] + facing * gx, along * view[1] + facing * gy, along * view[2] + facing * gz
    radial = hx * normal[0] + hy * normal[1] + hz * normal[2]
    to_pixel[NORMAL] = inverse * (hx - radial * normal[0])
    to_pixel[NORMAL + 1] = inverse * (hy - radial * normal[1])
    to_pixel[NORMAL + 2] = inverse * (hz - radial * normal[2])
