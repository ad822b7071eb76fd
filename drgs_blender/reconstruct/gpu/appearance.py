"""Appearance of a view on a device: `model.attributes` and `model.reflection_probe`, one thread per surfel or pixel.

The functions of a surfel and of a pixel are the CPU's. Texels that many pixels share sum their gradients as whole
numbers, in any order the same.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...compute.warp.kernels import WarpKernel
from ...core.arrays import Array
from ...formats.harmonics import polynomials
from ..model.attributes import BLUR, TINT, Attributes, Learned, write_colours, write_frames, write_gradients
from ..model.reflection_probe import BARE, look_up, pixel_gradients, texel_shares
from .launch import TensorLauncher

#: Bits of the largest of the whole numbers that gradients of texels are summed as; 2^27 pixels may share a texel.
_BITS = 36
#: Texels that a pixel looks up: four of each of two levels.
_TEXELS = 8


def attribute_rows(thread, stride, scratch, raw, away, values, out):  # type: ignore[no-untyped-def]
    """`attributes.frames` and `attributes.write_colours`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`; so of all kernels here.
    raw, away, values : Learned or array
        As of `attributes.write_colours`.
    out : tuple of array
        The fields of `Attributes`, and normals (n, 3); written.
    """
    u, v, alpha, features, normal = out
    for i in range(thread, len(away), stride):
        write_frames(i, i + 1, raw.scale, raw.rotation, u, v, normal)
        write_colours(i, i + 1, raw, normal, away, values, Attributes(u, v, alpha, features))


def attribute_gradient_rows(thread, stride, scratch, rotation, values, normal, found, incoming, out):  # type: ignore[no-untyped-def]
    """`attributes.write_gradients`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    rotation, values, normal, found, incoming, out : array or tuple
        As of `attributes.write_gradients`.
    """
    for i in range(thread, len(normal), stride):
        write_gradients(i, i + 1, rotation, values, normal, found, incoming, out)


def look_up_pixels(thread, stride, scratch, features, alpha, rays, texels, out):  # type: ignore[no-untyped-def]
    """`reflection_probe.look_up`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    features, alpha, rays, texels : array
        As of `reflection_probe.mirrored`.
    out : tuple of array
        Light (h, w, 3), of zeros; written.
    """
    (seen,) = out
    h, w = alpha.shape
    for number in range(thread, h * w, stride):
        y, x = number // w, number % w
        if alpha[y, x] > BARE:
            look_up(features[y, x], alpha[y, x], rays[y, x], texels, seen[y, x])


def pixel_gradient_rows(thread, stride, scratch, rows, maps, texels, seen, incoming, out):  # type: ignore[no-untyped-def]
    """`reflection_probe.pixel_gradients` and `reflection_probe.texel_shares`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    rows : (m,) int64 array
        Numbers of the pixels that mirror something.
    maps : tuple of array
        Features, coverage and rays, as of `reflection_probe.mirrored`.
    texels, seen, incoming : array
        As of `reflection_probe.pixel_gradients`.
    out : tuple of array
        Gradients of features and coverage, of zeros; rows of the texels (m, 8) and their gradients (m, 8, 3); written.
    """
    features, alpha, rays = maps
    to_features, to_alpha, places, shares = out
    w = alpha.shape[1]
    for number in range(thread, len(rows), stride):
        y, x = rows[number] // w, rows[number] % w
        pixel = features[y, x], alpha[y, x], rays[y, x], seen[y, x], incoming[y, x]
        pixel_gradients(pixel, texels, False, (to_features[y, x], to_alpha[y], x, shares[number]))
        texel_shares(features[y, x], alpha[y, x], rays[y, x], incoming[y, x], places[number], shares[number])


ATTRIBUTES, ATTRIBUTE_GRADIENTS = WarpKernel(attribute_rows, (), {}), WarpKernel(attribute_gradient_rows, (), {})
LOOK_UP, PIXEL_GRADIENTS = WarpKernel(look_up_pixels, (), {}), WarpKernel(pixel_gradient_rows, (), {})


def attributes(
    launcher: TensorLauncher, parameters: dict[str, Tensor], centre: Tensor, eye: Array, bands: int, reflections: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`attributes.attributes`."""
    away = normalize(centre.detach() - torch.tensor(eye, dtype=torch.float32, device=centre.device), dim=1)
    degree = min(bands, int(parameters["sh"].shape[1] ** 0.5) - 1)
    x, y, z = away.unbind(1)
    values = torch.stack(polynomials(x, y, z, torch.ones_like(x), degree), 1)
    return _Attributes.apply(launcher, away, values, reflections, *(parameters[name] for name in Learned._fields))


class _Attributes(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, launcher: TensorLauncher, away: Tensor, values: Tensor, reflections: bool, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        raw = Learned(*(p.detach().contiguous() for p in parameters))
        n, new = len(away), away.new_empty
        found = new(n, 3), new(n, 3), new(n), new(n, BLUR + 1 if reflections else TINT)
        normal = new(n, 3)
        launcher.launch(ATTRIBUTES, n, (raw, away, values), (*found, normal))
        # Detached: what is returned leads to `ctx`, and a cycle through it would keep each step's memory for good.
        ctx.save = (launcher, raw, values, normal, tuple(t.detach() for t in found))
        return found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        launcher, raw, values, normal, found = ctx.save
        incoming = tuple(
            torch.zeros_like(a) if g is None else g.contiguous() for g, a in zip(gradients, found, strict=True)
        )
        to = tuple(map(torch.zeros_like, raw))
        launcher.launch(ATTRIBUTE_GRADIENTS, len(normal), (raw.rotation, values, normal, found, incoming), to)
        return None, None, None, None, *to


def mirrored(launcher: TensorLauncher, features: Tensor, alpha: Tensor, rays: Tensor, texels: Tensor) -> Tensor:
    """`reflection_probe.mirrored`."""
    return _Mirrored.apply(features, alpha, rays, texels, launcher)


class _Mirrored(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, alpha: Tensor, rays: Tensor, texels: Tensor, launcher: TensorLauncher
    ) -> Tensor:
        blended, cover, light = (t.detach().contiguous() for t in (features, alpha, texels))
        seen = blended.new_zeros(*cover.shape, 3)
        launcher.launch(LOOK_UP, cover.numel(), (blended, cover, rays, light), (seen,))
        ctx.save = (launcher, blended, cover, rays, light, seen)
        return blended[..., TINT : TINT + 3] * seen

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        launcher, blended, cover, rays, light, seen = ctx.save
        to_features, to_alpha = torch.zeros_like(blended), torch.zeros_like(cover)
        rows = torch.nonzero(cover.flatten() > float(BARE))[:, 0]
        places = torch.empty((len(rows), _TEXELS), dtype=torch.int64, device=cover.device)
        shares = blended.new_empty(len(rows), _TEXELS, 3)
        given = rows, (blended, cover, rays), light, seen, gradients[0].contiguous()
        launcher.launch(PIXEL_GRADIENTS, len(rows), given, (to_features, to_alpha, places, shares))
        return to_features, to_alpha, None, sum_rows(places.flatten(), shares.flatten(0, 1), len(light)), None


def sum_rows(index: Tensor, values: Tensor, rows: int) -> Tensor:
    """(rows, k) float32 sums of the values (m, k) of each index (m,), as whole numbers; NaN and infinity count as 0."""
    given = torch.nan_to_num(values.double(), 0.0, 0.0, 0.0)
    total = torch.zeros(rows, given.shape[1], dtype=torch.int64, device=given.device)
    if not given.numel():
        return total.float()
    unit = torch.exp2(torch.frexp(given.abs().max()).exponent.double() - _BITS)
    total.index_add_(0, index, (given / unit).round().long())
    return (total * unit).float()
