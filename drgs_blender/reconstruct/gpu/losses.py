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
from ..losses.patches import DISPLACED, FAINT, GRAZING, REACH, Pair
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


def patch_loss(
    depth: Tensor, normal: Tensor, counts: Tensor, rays: Tensor, greys: tuple[Tensor, Tensor], behind: Tensor,
    pair: Pair, spread: float,
) -> Tensor:  # fmt: skip
    """`patches.patch_loss`."""
    grey, other = greys
    place = depth.device
    there, back = (torch.from_numpy(m).to(depth) for m in pair)
    facing = (normal * rays).sum(-1)
    known = depth.detach()
    usable = (known > 0) & (counts > 0) & (facing < -float(GRAZING) * normal.norm(dim=-1) * rays.norm(dim=-1))
    usable[:REACH], usable[-REACH:], usable[:, :REACH], usable[:, -REACH:] = False, False, False, False
    y, x = torch.nonzero(usable, as_tuple=True)
    with torch.no_grad():
        seen = torch.cat([depth[y, x, None] * rays[y, x], torch.ones_like(depth[y, x, None])], -1) @ there.T
        at = seen[:, :2] / seen[:, 2:] - 0.5
        z, inside = _sample(behind, at)
        lowest = _corners(behind, at).amin(-1)
        returned = torch.cat([(at + 0.5) * z[:, None], z[:, None], torch.ones_like(z[:, None])], -1) @ back.T
        displaced = (returned[:, :2] / returned[:, 2:] - 0.5 - torch.stack([x, y], -1)).norm(dim=-1)
        keep = (seen[:, 2] > 0) & inside & (lowest > 0) & (returned[:, 2] > 0) & (displaced < float(DISPLACED))
    step = torch.arange(-REACH, REACH + 1, device=place)
    dy, dx = (t.reshape(-1) for t in torch.meshgrid(step, step, indexing="ij"))
    y, x, displaced = y[keep], x[keep], displaced[keep]

    def homography(y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Taps (m, taps, 3) in the other view, see `patches`, and on which side of the plane they are."""
        taps = rays[y[:, None] + dy, x[:, None] + dx]
        side = (taps * normal[y, x, None]).sum(-1, keepdim=True)
        return side * there[:, 3] + (depth[y, x] * facing[y, x])[:, None, None] * (taps @ there[:, :3].T), side[..., 0]

    with torch.no_grad():
        h, side = homography(y, x)
        _, inside = _sample(other, h[..., :2] / h[..., 2:] - 0.5)
        whole = (inside & (side < 0) & (h[..., 2] < 0) & (known[y[:, None] + dy, x[:, None] + dx] > 0)).all(-1)
    y, x, displaced = y[whole], x[whole], displaced[whole]
    h, _ = homography(y, x)
    ours, (theirs, _) = grey[y[:, None] + dy, x[:, None] + dx], _sample(other, h[..., :2] / h[..., 2:] - 0.5)
    weight = counts[y, x] * torch.exp(-displaced)
    if spread:
        weight = weight * torch.exp(-((ours.mean(-1) - theirs.detach().mean(-1)) / spread).square())
    ours, theirs = ours - ours.mean(-1, keepdim=True), theirs - theirs.mean(-1, keepdim=True)
    variances = (ours.square().mean(-1) + float(FAINT)) * (theirs.square().mean(-1) + float(FAINT))
    return (weight * (1 - (ours * theirs).mean(-1) / variances.sqrt())).sum() / depth.numel()


def _sample(picture: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear values of a picture (h, w) at places (..., 2) from the first pixel's centre, and which are inside."""
    h, w = picture.shape
    inside = ((at >= 0) & (at < torch.tensor([w - 1, h - 1], device=at.device))).all(-1)
    fraction = at - at.detach().floor()
    a, b, c, d = _corners(picture, at).unbind(-1)
    top, bottom = torch.lerp(a, b, fraction[..., 0]), torch.lerp(c, d, fraction[..., 0])
    return torch.lerp(top, bottom, fraction[..., 1]), inside


def _corners(picture: Tensor, at: Tensor) -> Tensor:
    """(..., 4) pixels around places."""
    h, w = picture.shape
    first = at.detach().nan_to_num(0, 0, 0).floor()
    x, y = first[..., 0].clamp(0, w - 2).long(), first[..., 1].clamp(0, h - 2).long()
    return torch.stack([picture[y, x], picture[y, x + 1], picture[y + 1, x], picture[y + 1, x + 1]], -1)
