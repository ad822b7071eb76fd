"""The photometric loss: L1 and structural similarity (SSIM), with their gradient, in compiled code.

SSIM is that of Wang et al. 2004 (Gaussian window of 11 pixels, deviation 1.5, black beyond the edges, each channel on
its own). All its terms are blurred pictures, the blur is separable and its own adjoint, and what depends on the
photograph alone is computed once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ...core.arrays import Array

#: Part of dissimilarity (1 - SSIM) in the loss; the rest is L1.
DISSIMILARITY = 0.2
#: Photographs are saturated from this value on.
SATURATED = 0.998
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
_TAPS = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
WINDOW = tuple(np.float32(x) for x in _TAPS / _TAPS.sum())


@dataclass(slots=True)
class Photograph:
    """Target of the loss: colour (h, w, 3) float32, and its blurred values and squares (2, h, w, 3) where kept."""

    colour: Array
    kept: Array | None = None

    @classmethod
    def of(cls, colour: Array, keep: bool = True) -> Photograph:
        """Prepare a photograph (h, w, 3); what is not kept is computed at each comparison, and takes no memory."""
        photograph = cls(np.ascontiguousarray(colour, np.float32))
        if keep:
            photograph.kept = photograph.blurred()
        return photograph

    def blurred(self) -> Array:
        """Blurred values and squares, (2, h, w, 3)."""
        return blur(np.stack([self.colour, self.colour * self.colour])) if self.kept is None else self.kept


def blur(pictures: Array) -> Array:
    """The window's mean of each of the pictures (m, h, w, c) float32."""
    out = np.empty_like(pictures)
    m, h, w, c = pictures.shape
    over_range(
        _blur, m * h, np.ascontiguousarray(pictures).reshape(m, h, w * c), c, out.reshape(m, h, w * c), fewest=ROWS
    )
    return out


def difference(picture: Tensor, photograph: Photograph) -> Tensor:
    """Loss of a rendered picture (h, w, 3): L1 and dissimilarity in the ratio of 3D Gaussian splatting."""
    return _Difference.apply(picture, photograph)


def structural_similarity(picture: Array, photograph: Photograph) -> float:
    """Mean SSIM of a picture (h, w, 3)."""
    return float(_similarity(np.ascontiguousarray(picture, np.float32), photograph)[0])


def _similarity(picture: Array, photograph: Photograph) -> tuple[float, Array]:
    """Mean SSIM and its gradient (h, w, 3)."""
    target = photograph.colour
    mean, square, product = blur(np.stack([picture, picture * picture, picture * target]))
    slopes = np.empty((3, *picture.shape), np.float32)
    rows = np.empty(len(picture))
    other, other_square = photograph.blurred()
    over_range(_ssim, len(mean), mean, square, product, other, other_square, slopes, rows, fewest=ROWS)
    by_mean, by_square, by_product = blur(slopes)
    gradient = by_mean + 2 * picture * by_square + target * by_product
    return rows.sum() / picture.size, gradient / np.float32(picture.size)


class _Difference(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, picture: Tensor, photograph: Photograph) -> Tensor:
        values = np.ascontiguousarray(picture.detach().numpy(), np.float32)
        # Where the photograph is saturated, brighter is as good.
        beyond = (photograph.colour >= SATURATED) & (values > photograph.colour)
        values = np.where(beyond, photograph.colour, values)
        similarity, gradient = _similarity(values, photograph)
        error = values - photograph.colour
        ctx.gradient = np.sign(error) * np.float32((1 - DISSIMILARITY) / values.size)
        ctx.gradient -= np.float32(DISSIMILARITY) * gradient
        ctx.gradient[beyond] = 0
        loss = (1 - DISSIMILARITY) * np.abs(error).mean() + DISSIMILARITY * (1 - similarity)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        return gradients[0] * torch.from_numpy(ctx.gradient), None


@njit
def _blur_row(pictures, m, y, channels, padded, out):  # type: ignore[no-untyped-def]
    """One row: the column of eleven rows into a padded buffer, then along it."""
    height, width = pictures.shape[1], pictures.shape[2]
    margin = 5 * channels
    padded[:] = np.float32(0.0)
    for k in range(11):
        row = y + k - 5
        if 0 <= row < height:
            weight = WINDOW[k]
            for x in range(width):
                padded[np.uintp(margin + x)] += weight * pictures[m, row, np.uintp(x)]
    for x in range(width):
        out[m, y, np.uintp(x)] = WINDOW[5] * padded[np.uintp(margin + x)]
    for k in range(5):
        weight, low, high = WINDOW[k], k * channels, (10 - k) * channels
        for x in range(width):
            out[m, y, np.uintp(x)] += weight * (padded[np.uintp(low + x)] + padded[np.uintp(high + x)])


@njit
def _blur(first, last, pictures, channels, out):  # type: ignore[no-untyped-def]
    rows = pictures.shape[1]
    for task in range(first, last):
        padded = np.empty(pictures.shape[2] + 10 * channels, np.float32)
        _blur_row(pictures, task // rows, task % rows, channels, padded, out)


@njit
def _ssim(first, last, mean, square, product, other, other_square, slopes, rows):  # type: ignore[no-untyped-def]
    """SSIM summed by rows, and its derivatives by the three blurred pictures."""
    two = np.float32(2.0)
    for y in range(first, last):
        total = 0.0
        for x in range(mean.shape[1]):
            for c in range(mean.shape[2]):
                mx, my = mean[y, x, c], other[y, x, c]
                a1, b1 = two * mx * my + C1, mx * mx + my * my + C1
                a2 = two * (product[y, x, c] - mx * my) + C2
                b2 = square[y, x, c] - mx * mx + other_square[y, x, c] - my * my + C2
                inverse = np.float32(1.0) / (b1 * b2)
                s = a1 * a2 * inverse
                total += s
                slopes[0, y, x, c] = two * inverse * (my * (a2 - a1) + mx * s * (b1 - b2))
                slopes[1, y, x, c] = -s * b1 * inverse
                slopes[2, y, x, c] = two * a1 * inverse
        rows[y] = total
