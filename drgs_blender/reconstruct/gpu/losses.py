"""Losses of a view, for any device: `photometric` and `shape` in plain tensor operations.

The blur alone is a kernel of Warp: libraries of convolutions round otherwise, and not the same way each time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...compute.warp.kernels import WarpKernel
from ...render.sampling import ZERO
from ..losses.photometric import C1, C2, DISSIMILARITY, SATURATED, WINDOW
from ..losses.shape import COVERED, THIN
from .launch import TensorLauncher


def blur_rows(thread, stride, scratch, window, pictures, out):  # type: ignore[no-untyped-def]
    """Weighted means of eleven rows, as `photometric._blur_row` has them; black beyond the edges.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`.
    window : (11,) float32 array
        Weights, symmetric, of sum 1.
    pictures : (m, h, w) float32 array
        Channels side by side along the last axis.
    out : tuple of array
        The same shape; written.
    """
    (blurred,) = out
    m, h, w = pictures.shape
    for number in range(thread, m * h * w, stride):
        k, y, x = number // (h * w), number // w % h, number % w
        total = ZERO
        for tap in range(11):
            row = y + tap - 5
            if row >= 0 and row < h:
                total += window[tap] * pictures[k, row, x]
        blurred[k, y, x] = total


def blur_columns(thread, stride, scratch, window, channels, pictures, out):  # type: ignore[no-untyped-def]
    """The same of eleven columns; a pixel has `channels` of them.

    Parameters
    ----------
    thread, stride, scratch, window, pictures, out : int64, tuple or array
        As of `blur_rows`.
    channels : int
        Columns of a pixel.
    """
    (blurred,) = out
    m, h, w = pictures.shape
    for number in range(thread, m * h * w, stride):
        k, y, x = number // (h * w), number // w % h, number % w
        total = window[5] * pictures[k, y, x]
        for tap in range(5):
            low, high = x - (5 - tap) * channels, x + (5 - tap) * channels
            before = pictures[k, y, low] if low >= 0 else ZERO
            after = pictures[k, y, high] if high < w else ZERO
            total += window[tap] * (before + after)
        blurred[k, y, x] = total


ROWS, COLUMNS = WarpKernel(blur_rows, (), {}), WarpKernel(blur_columns, (), {})


def blur(launcher: TensorLauncher, pictures: Tensor) -> Tensor:
    """`photometric.blur` of (m, h, w, c); differentiable."""
    return _Blur.apply(pictures, launcher)


class _Blur(torch.autograd.Function):
    """The window is symmetric: the blur is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, pictures: Tensor, launcher: TensorLauncher) -> Tensor:
        ctx.launcher = launcher
        m, h, w, c = pictures.shape
        flat = pictures.detach().reshape(m, h, w * c).contiguous()
        window = torch.from_numpy(np.array(WINDOW)).to(flat.device)
        between, out = torch.empty_like(flat), torch.empty_like(flat)
        launcher.launch(ROWS, flat.numel(), (window, flat), (between,))
        launcher.launch(COLUMNS, flat.numel(), (window, c, between), (out,))
        return out.reshape(pictures.shape)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        return _Blur.apply(gradients[0], ctx.launcher), None


def difference(launcher: TensorLauncher, picture: Tensor, photograph: Tensor) -> Tensor:
    """`photometric.difference` from a photograph (h, w, 3) on the device."""
    # Where the photograph is saturated, brighter is as good.
    beyond = (photograph >= SATURATED) & (picture.detach() > photograph)
    values = torch.where(beyond, photograph, picture)
    with torch.no_grad():
        my, other_square = blur(launcher, torch.stack([photograph, photograph * photograph]))
    mx, square, product = blur(launcher, torch.stack([values, values * values, values * photograph]))
    covariance, variances = product - mx * my, square - mx * mx + other_square - my * my
    similar = (2 * mx * my + C1) * (2 * covariance + C2) / ((mx * mx + my * my + C1) * (variances + C2))
    return (1 - DISSIMILARITY) * (values - photograph).abs().mean() + DISSIMILARITY * (1 - similar.mean())


def shape_loss(
    alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Tensor | None, rays: Tensor,
    counts: Tensor, weights: tuple[float, float, float],
) -> Tensor:  # fmt: skip
    """`shape.shape_loss`."""
    by_mask, by_distortion, by_normals = weights
    loss = by_distortion * distortion.mean()
    if mask is not None and by_mask:
        loss = loss + by_mask * (alpha - mask).abs().mean()
    if by_normals and min(alpha.shape) > 2:
        points = (depth / alpha.clamp(min=float(THIN)))[..., None] * rays
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        slope = normalize(torch.linalg.cross(down, across), dim=-1)
        covered = alpha.detach()[1:-1, 1:-1]
        away = (covered - (slope * normal[1:-1, 1:-1]).sum(-1)).clamp(min=0)
        inner = torch.where(covered > float(COVERED), counts[1:-1, 1:-1] * away, torch.zeros_like(away))
        loss = loss + by_normals * inner.mean()
    return loss
