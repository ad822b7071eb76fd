"""Losses of the shape: the mask, little distortion, surfels' normals as those of the depth map.

The last two are those of Huang et al. 2024, "2D Gaussian Splatting". Value and gradient come in one pass over the
pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from ...core.arrays import Array

#: Mean depths are those of pixels covered at least so much, and normals are compared where they are covered more.
THIN, COVERED = np.float32(1e-3), np.float32(0.5)


def shape_loss(
    alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Array | None, rays: Array,
    counts: Array, weights: tuple[float, float, float],
) -> Tensor:  # fmt: skip
    """Weighted sum of the pictures' means; differentiable in the maps.

    Parameters
    ----------
    alpha, depth, distortion : (h, w) tensor
        Of `raster.Maps`.
    normal : (h, w, 3) tensor
        Sum of weighted normals that face the viewer.
    mask : (h, w) float32 array or None
        In 0..1; None where nothing is known of it.
    rays : (h, w, 3) float32 array
        `training_views.pixel_rays`.
    counts : (h, w) float32 array
        How much the agreement of normals counts in each pixel.
    weights : tuple of float
        Of |alpha - mask|, of the distortion, and of alpha (1 - cosine) between `normal` and that of the mean depth by
        central differences, where alpha is over one half; alpha itself is not a variable there.
    """
    return _Shape.apply(alpha, depth, distortion, normal, mask, rays, counts, weights)


class _Shape(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Array | None, rays: Array,
        counts: Array, weights: tuple[float, float, float],
    ) -> Tensor:  # fmt: skip
        a, z, n = (np.ascontiguousarray(t.detach().numpy()) for t in (alpha, depth, normal))
        by_mask, by_distortion, by_normals = weights
        to_alpha, to_depth, to_normal = np.zeros_like(a), np.zeros_like(z), np.zeros_like(n)
        loss = 0.0
        if mask is not None and by_mask:
            error = a - mask
            loss += by_mask * float(np.abs(error).mean())
            to_alpha += np.float32(by_mask / a.size) * np.sign(error)
        if by_distortion:
            loss += by_distortion * float(distortion.detach().numpy().mean())
        if by_normals and min(a.shape) > 2:
            inner = (a.shape[0] - 2) * (a.shape[1] - 2)
            slopes, rows = np.zeros((2, *n.shape), np.float32), np.zeros(len(a))
            over_range(
                _disagreement,
                len(a),
                (a, z, n, rays),
                counts,
                np.float32(by_normals / inner),
                slopes,
                to_normal,
                rows,
                fewest=ROWS,
            )
            over_range(_to_depth, len(a), a, z, rays, slopes, to_alpha, to_depth, fewest=ROWS)
            loss += by_normals / inner * float(rows.sum())
        ctx.gradients = [to_alpha, to_depth, np.full_like(a, by_distortion / a.size), to_normal]
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        return *(gradients[0] * torch.from_numpy(g) for g in ctx.gradients), None, None, None, None


@inlined
def _difference(alpha, depth, rays, y1, x1, y0, x0):  # type: ignore[no-untyped-def]
    """From the point seen in pixel 0 to that in pixel 1."""
    far = depth[y1, x1] / max(alpha[y1, x1], THIN)
    near = depth[y0, x0] / max(alpha[y0, x0], THIN)
    return (
        far * rays[y1, x1, 0] - near * rays[y0, x0, 0],
        far * rays[y1, x1, 1] - near * rays[y0, x0, 1],
        far * rays[y1, x1, 2] - near * rays[y0, x0, 2],
    )


@njit
def disagree(y, x, maps, counts, most, slopes, to_normal):  # type: ignore[no-untyped-def]
    """Disagreement of an inner pixel's normals, times its count.

    Parameters
    ----------
    y, x : int
    maps : tuple of array
        Coverage, sums of depth and of normals, and rays, as of `shape_loss`.
    counts : (h, w) float32 array
        As of `shape_loss`.
    most : float32
        Factor of the gradients.
    slopes : (2, h, w, 3) float32 array
        Gradients of the two differences of neighbours; the pixel's are written.
    to_normal : (h, w, 3) float32 array
        Gradients of the normals; the pixel's is written.
    """
    alpha, depth, normal, rays = maps
    covered = alpha[y, x]
    if not covered > COVERED:
        return np.float32(0.0)
    ax, ay, az = _difference(alpha, depth, rays, y, x + 1, y, x - 1)
    dx, dy, dz = _difference(alpha, depth, rays, y + 1, x, y - 1, x)
    cx, cy, cz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
    r = np.float32(1.0) / max(np.sqrt(cx * cx + cy * cy + cz * cz), np.float32(1e-12))
    cx, cy, cz = cx * r, cy * r, cz * r
    nx, ny, nz = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
    cosine = cx * nx + cy * ny + cz * nz
    if not covered - cosine > 0:
        return np.float32(0.0)
    weight = most * counts[y, x]
    to_normal[y, x, 0], to_normal[y, x, 1], to_normal[y, x, 2] = -weight * cx, -weight * cy, -weight * cz
    scale = -weight * r
    gx, gy, gz = scale * (nx - cosine * cx), scale * (ny - cosine * cy), scale * (nz - cosine * cz)
    slopes[0, y, x, 0], slopes[0, y, x, 1] = gy * dz - gz * dy, gz * dx - gx * dz
    slopes[0, y, x, 2] = gx * dy - gy * dx
    slopes[1, y, x, 0], slopes[1, y, x, 1] = ay * gz - az * gy, az * gx - ax * gz
    slopes[1, y, x, 2] = ax * gy - ay * gx
    return counts[y, x] * (covered - cosine)


@njit
def _disagreement(first, last, maps, counts, most, slopes, to_normal, rows):  # type: ignore[no-untyped-def]
    """Sums of the rows, and gradients, as of `disagree`."""
    height, width = maps[0].shape
    for y in range(max(first, 1), min(last, height - 1)):
        total = 0.0
        for x in range(1, width - 1):
            total += disagree(y, x, maps, counts, most, slopes, to_normal)
        rows[y] = total


@njit
def add_to_depth(y, x, alpha, depth, rays, slopes, to_alpha, to_depth):  # type: ignore[no-untyped-def]
    """Add the gradients of a pixel's depth and coverage, from its four neighbours.

    Parameters
    ----------
    y, x : int
    alpha, depth, rays : array
        As of `shape_loss`.
    slopes : (2, h, w, 3) float32 array
        Of `disagree`.
    to_alpha, to_depth : (h, w) float32 array
        Added to.
    """
    height, width = alpha.shape
    g = np.float32(0.0)
    for c in range(3):
        p = np.float32(0.0)
        if x > 0:
            p += slopes[0, y, x - 1, c]
        if x < width - 1:
            p -= slopes[0, y, x + 1, c]
        if y > 0:
            p += slopes[1, y - 1, x, c]
        if y < height - 1:
            p -= slopes[1, y + 1, x, c]
        g += p * rays[y, x, c]
    inverse = np.float32(1.0) / max(alpha[y, x], THIN)
    to_depth[y, x] += g * inverse
    if alpha[y, x] >= THIN:
        to_alpha[y, x] -= g * depth[y, x] * inverse * inverse


@njit
def _to_depth(first, last, alpha, depth, rays, slopes, to_alpha, to_depth):  # type: ignore[no-untyped-def]
    """`add_to_depth` of rows of pixels."""
    for y in range(first, last):
        for x in range(alpha.shape[1]):
            add_to_depth(y, x, alpha, depth, rays, slopes, to_alpha, to_depth)
