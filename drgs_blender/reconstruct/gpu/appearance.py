"""Appearance of a view in tensor operations, for any device: `attributes` and `reflection` without compiled code."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...core.arrays import Array
from ...formats.harmonics import polynomials
from ..model.attributes import BLUR, NORMAL, TINT
from ..model.reflection_probe import BARE, LEVELS, SHARPEST

#: Bits of the largest of the whole numbers that gradients of texels are summed as; 2^27 pixels may share a texel.
_BITS = 36


def attributes(
    parameters: dict[str, Tensor], centre: Tensor, eye: Array, bands: int, reflections: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`attributes.attributes`."""
    away = normalize(centre.detach() - torch.tensor(eye, dtype=torch.float32, device=centre.device), dim=1)
    u, v, normal = frames(parameters["scale"], parameters["rotation"])
    sh = parameters["sh"]
    degree = min(bands, int(sh.shape[1] ** 0.5) - 1)
    x, y, z = away.unbind(1)
    values = torch.stack(polynomials(x, y, z, torch.ones_like(x), degree), 1)
    colour = (0.5 + (values[:, :, None] * sh[:, : values.shape[1]]).sum(1)).clamp(min=0)
    back = (away * normal).sum(1, keepdim=True) > 0
    features = [colour, torch.where(back, -normal, normal)]
    if reflections:
        features += [torch.sigmoid(parameters["tint"]), torch.sigmoid(parameters["blur"])[:, None]]
    return u, v, torch.sigmoid(parameters["opacity"]), torch.cat(features, 1)


def frames(scale: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`attributes.frames`."""
    w, x, y, z = normalize(rotation, dim=1).unbind(1)
    u = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    v = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
    normal = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    size = scale.exp()
    return u * size[:, :1], v * size[:, 1:], normal


def mirrored(features: Tensor, alpha: Tensor, rays: Tensor, texels: Tensor) -> Tensor:
    """`reflection_probe.mirrored`."""
    rows = torch.nonzero(alpha.detach().flatten() > float(BARE))[:, 0]
    pixel = features.flatten(0, 1).index_select(0, rows)
    blur = pixel[:, BLUR] / alpha.flatten().index_select(0, rows)
    ray, normal = normalize(rays.flatten(0, 1)[rows], dim=1), normalize(pixel[:, NORMAL : NORMAL + 3], dim=1)
    direction = ray - 2 * (ray * normal).sum(1, keepdim=True) * normal
    face, a, b = _places(direction)
    level = blur * (LEVELS - 1)
    low = level.detach().long().clamp(0, LEVELS - 2)
    mix = (level - low)[:, None]
    seen = (1 - mix) * _look_up(texels, low, face, a, b) + mix * _look_up(texels, low + 1, face, a, b)
    out = features.new_zeros(alpha.numel(), 3)
    return out.index_copy(0, rows, pixel[:, TINT : TINT + 3] * seen).reshape(*alpha.shape, 3)


def _places(direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Number (n,) of the cube's face that each direction leaves through, and place (a, b) on it in -1..1."""
    x, y, z = direction.detach().abs().unbind(1)
    axis = torch.where((x >= y) & (x >= z), 0, torch.where(y >= z, 1, 2))
    main, first, second = (direction.gather(1, ((axis + k) % 3)[:, None])[:, 0] for k in range(3))
    size = main.abs().clamp(min=1e-12)
    return 2 * axis + (main.detach() < 0), first / size, second / size


def _look_up(texels: Tensor, level: Tensor, face: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """(n, 3) light of the levels (n,) at places on faces, between four texels."""
    sizes = SHARPEST >> level
    (i, s), (j, t) = (_between(place, sizes) for place in (a, b))
    # Before a level lie 6 (SHARPEST^2 + ... + (2 size)^2) texels.
    at = 8 * (SHARPEST**2 - sizes**2) + (face * sizes + j) * sizes + i
    first, right, below, opposite = _Rows.apply(texels, torch.stack([at, at + 1, at + sizes, at + sizes + 1])).unbind(0)
    top, bottom = first + s * (right - first), below + s * (opposite - below)
    return top + t * (bottom - top)


def _between(place: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """First of the two texels that a place in -1..1 lies between, and the part (n, 1) of the second."""
    x = ((place + 1) * (0.5 * sizes) - 0.5).clamp(min=0).minimum((sizes - 1).to(place))
    first = torch.minimum(x.detach().long(), sizes - 2)
    return first, (x - first)[:, None]


class _Rows(torch.autograd.Function):
    """Rows of a table. Many may be one; their gradients are summed as whole numbers: in any order the same."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.rows = len(table)
        return table[index]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        (index,) = ctx.saved_tensors
        given = torch.nan_to_num(gradients[0].flatten(0, -2).double(), 0.0, 0.0, 0.0)
        total = torch.zeros(ctx.rows, given.shape[1], dtype=torch.int64, device=given.device)
        if not given.numel():
            return total.float(), None
        unit = torch.exp2(torch.frexp(given.abs().max()).exponent.double() - _BITS)
        total.index_add_(0, index.flatten(), (given / unit).round().long())
        return (total * unit).float(), None
