"""Losses of a view on a device: `shape` pixel by pixel as on the CPU, `photometric` and `patches` by tensor operations.

Their blur is a kernel of Warp: libraries of convolutions round otherwise, and not the same way each time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...compute.warp.kernels import WarpKernel
from ...render.sampling import ZERO, F
from ..losses.patches import DISPLACED, FAINT, GRAZING, REACH, Pair
from ..losses.photometric import C1, C2, DISSIMILARITY, SATURATED, WINDOW
from ..losses.shape import add_to_depth, disagree
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


def disagree_pixels(thread, stride, scratch, maps, counts, most, out):  # type: ignore[no-untyped-def]
    """`shape.disagree` of all inner pixels.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    maps, counts, most : tuple, array or float
        As of `shape.disagree`.
    out : tuple of array
        Slopes and gradients of normals as of `shape.disagree`, and disagreements (h, w); all of zeros; written.
    """
    slopes, to_normal, away = out
    h, w = away.shape
    for number in range(thread, h * w, stride):
        y, x = number // w, number % w
        if y > 0 and y < h - 1 and x > 0 and x < w - 1:
            away[y, x] = disagree(y, x, maps, counts, F(most), slopes, to_normal)


def add_to_depths(thread, stride, scratch, alpha, depth, rays, slopes, out):  # type: ignore[no-untyped-def]
    """`shape.add_to_depth` of all pixels.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    alpha, depth, rays, slopes : array
        As of `shape.add_to_depth`.
    out : tuple of array
        Gradients of coverage and depth; added to.
    """
    to_alpha, to_depth = out
    h, w = alpha.shape
    for number in range(thread, h * w, stride):
        add_to_depth(number // w, number % w, alpha, depth, rays, slopes, to_alpha, to_depth)


ROWS, COLUMNS = WarpKernel(blur_rows, (), {}), WarpKernel(blur_columns, (), {})
DISAGREE, TO_DEPTH = WarpKernel(disagree_pixels, (), {}), WarpKernel(add_to_depths, (), {})


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
    launcher: TensorLauncher, alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Tensor | None,
    rays: Tensor, counts: Tensor, weights: tuple[float, float, float],
) -> Tensor:  # fmt: skip
    """`shape.shape_loss`."""
    return _Shape.apply(alpha, depth, distortion, normal, mask, rays, counts, weights, launcher)


class _Shape(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Tensor | None, rays: Tensor,
        counts: Tensor, weights: tuple[float, float, float], launcher: TensorLauncher,
    ) -> Tensor:  # fmt: skip
        a, z, n = (t.detach().contiguous() for t in (alpha, depth, normal))
        by_mask, by_distortion, by_normals = weights
        to_alpha, to_depth, to_normal = torch.zeros_like(a), torch.zeros_like(z), torch.zeros_like(n)
        loss = by_distortion * distortion.detach().mean()
        if mask is not None and by_mask:
            error = a - mask
            loss = loss + by_mask * error.abs().mean()
            to_alpha += (by_mask / a.numel()) * error.sign()
        if by_normals and min(a.shape) > 2:
            inner = (a.shape[0] - 2) * (a.shape[1] - 2)
            slopes, away = n.new_zeros(2, *n.shape), torch.zeros_like(a)
            given = (a, z, n, rays), counts, float(by_normals / inner)
            launcher.launch(DISAGREE, a.numel(), given, (slopes, to_normal, away))
            launcher.launch(TO_DEPTH, a.numel(), (a, z, rays, slopes), (to_alpha, to_depth))
            loss = loss + by_normals / inner * away.sum()
        ctx.gradients = [to_alpha, to_depth, torch.full_like(a, by_distortion / a.numel()), to_normal]
        return loss

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        return *(gradients[0] * g for g in ctx.gradients), None, None, None, None, None


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
