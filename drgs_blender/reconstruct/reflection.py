"""What mirrors: a learned cube of light around the object, looked up along reflected rays.

Deferred shading with the split-sum approximation (Karis 2013), as Ref-Gaussian (Yao et al. 2025) pre-trains: each
pixel's blended normal reflects the view, each surfel says how much and how blurred. Values are display-encoded, like
the colours that they are added to; occlusion is left to the materials' own stage.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..jit import njit, prange

#: Texels along an edge of the cube's faces, of the sharpest level.
SHARPEST = 32
LEVELS = 4


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


def reflected(normal: Tensor, rays: Tensor, blur: Tensor, texels: Tensor) -> Tensor:
    """Light (p, 3) that surfaces with normals (p, 3) of any length mirror along `rays` (p, 3), viewer to surface.

    Parameters
    ----------
    blur : (p,) in 0..1, 0 a perfect mirror
    texels : `pyramid` of the cube
    """
    n = torch.nn.functional.normalize(normal, dim=1)
    direction = rays - 2 * (rays * n).sum(1, keepdim=True) * n
    return _Lookup.apply(direction, blur * (LEVELS - 1), texels)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, direction: Tensor, level: Tensor, texels: Tensor) -> Tensor:
        arrays = [np.ascontiguousarray(t.detach().numpy(), np.float32) for t in (direction, level, texels)]
        value = np.empty((len(arrays[0]), 3), np.float32)
        _look_up(*arrays, value)
        ctx.arrays = arrays
        return torch.from_numpy(value)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        direction, level, texels = ctx.arrays
        to = [np.zeros_like(a) for a in ctx.arrays]
        _look_up_backward(direction, level, texels, np.ascontiguousarray(gradients[0].numpy()), *to)
        return tuple(torch.from_numpy(g) for g in to)


@njit
def _face(d: Any) -> Any:
    """Axis of the face that a direction leaves through, the face's number, and place (a, b) on it in -1..1."""
    x, y, z = abs(d[0]), abs(d[1]), abs(d[2])
    axis = 0 if x >= y and x >= z else 1 if y >= z else 2
    size = max(abs(d[axis]), np.float32(1e-12))
    return axis, 2 * axis + (d[axis] < 0), d[(axis + 1) % 3] / size, d[(axis + 2) % 3] / size


@njit
def _texel(a: Any, size: Any) -> Any:
    """First of the two texels that a place in -1..1 lies between, the part of the second, and its slope by place."""
    x = (a + np.float32(1.0)) * np.float32(0.5 * size) - np.float32(0.5)
    inside = (x > 0.0) & (x < size - 1)
    x = min(max(x, np.float32(0.0)), np.float32(size - 1))
    i = min(int(x), size - 2)
    return i, np.float32(x - i), np.float32(0.5 * size) if inside else np.float32(0.0)


@njit
def _start(level: Any) -> Any:
    """First texel of a level, and texels along its edges."""
    at, size = 0, SHARPEST
    for _ in range(level):
        at += 6 * size * size
        size //= 2
    return at, size


@njit(parallel=True)
def _look_up(direction: Any, level: Any, texels: Any, value: Any) -> None:
    for p in prange(len(direction)):
        _, face, a, b = _face(direction[p])
        low = min(max(int(level[p]), 0), LEVELS - 2)
        mix = level[p] - np.float32(low)
        for c in range(3):
            value[p, c] = np.float32(0.0)
        for k in range(2):
            start, size = _start(low + k)
            share = mix if k else np.float32(1.0) - mix
            i, s, _ = _texel(a, size)
            j, t, _ = _texel(b, size)
            at = start + (face * size + j) * size + i
            for c in range(3):
                top = texels[at, c] + s * (texels[at + 1, c] - texels[at, c])
                bottom = texels[at + size, c] + s * (texels[at + size + 1, c] - texels[at + size, c])
                value[p, c] += share * (top + t * (bottom - top))


@njit
def _look_up_backward(
    direction: Any, level: Any, texels: Any, gradient: Any, to_direction: Any, to_level: Any, to_texels: Any
) -> None:
    """In the order of pixels: many share a texel."""
    one = np.float32(1.0)
    for p in range(len(direction)):
        axis, face, a, b = _face(direction[p])
        low = min(max(int(level[p]), 0), LEVELS - 2)
        mix = level[p] - np.float32(low)
        g_a = g_b = g_mix = np.float32(0.0)
        for k in range(2):
            start, size = _start(low + k)
            share, sign = (mix, one) if k else (one - mix, -one)
            i, s, slope_a = _texel(a, size)
            j, t, slope_b = _texel(b, size)
            at = start + (face * size + j) * size + i
            for c in range(3):
                g = gradient[p, c]
                q00, q10, q01, q11 = texels[at, c], texels[at + 1, c], texels[at + size, c], texels[at + size + 1, c]
                top, bottom = q00 + s * (q10 - q00), q01 + s * (q11 - q01)
                g_mix += sign * g * (top + t * (bottom - top))
                g_a += share * g * slope_a * ((one - t) * (q10 - q00) + t * (q11 - q01))
                g_b += share * g * slope_b * (bottom - top)
                w = share * g
                to_texels[at, c] += w * (one - s) * (one - t)
                to_texels[at + 1, c] += w * s * (one - t)
                to_texels[at + size, c] += w * (one - s) * t
                to_texels[at + size + 1, c] += w * s * t
        to_level[p] = g_mix
        main = direction[p, axis]
        size = max(abs(main), np.float32(1e-12))
        to_direction[p, (axis + 1) % 3] += g_a / size
        to_direction[p, (axis + 2) % 3] += g_b / size
        to_direction[p, axis] -= (g_a * a + g_b * b) / (size if main >= 0 else -size)
