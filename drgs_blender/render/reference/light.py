"""Distant light in torch: lat-long radiance, and directions drawn in proportion to it.

The mapping is Blender's (see asset.Environment): u = 0.5 - atan2(y, x) / 2 pi, v = acos(z) / pi, row 0 at +Z. Texel
centres are at +0.5; between them the lookup is bilinear, periodic in u and clamped in v. Directions are drawn in cells
between the centres of four texels, in proportion to the blend of their luminance, bilinear in azimuth and z.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...core.color import LUMINANCE
from ...core.frame import World


def directions_of(u: Tensor, v: Tensor) -> Tensor:
    """Unit directions (..., 3) of lat-long coordinates in [0, 1]."""
    phi, theta = (0.5 - u) * 2 * math.pi, v * math.pi
    return torch.stack([torch.sin(theta) * torch.cos(phi), torch.sin(theta) * torch.sin(phi), torch.cos(theta)], -1)


def coordinates_of(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Lat-long coordinates (u, v) in [0, 1] of unit directions (..., 3)."""
    x, y, z = direction.unbind(-1)
    return 0.5 - torch.atan2(y, x) / (2 * math.pi), torch.atan2(torch.hypot(x, y), z) / math.pi


class Light:
    """The light of a World.

    Parameters
    ----------
    image : (h, w, 3) tensor or None
        Linear Rec.709 radiance; may require a gradient. None is white.
    rotation : (3, 3) tensor
        Rotation from world directions to the image's.
    colour : (3,) tensor
        Factor, strength included.
    """

    def __init__(self, image: Tensor | None, rotation: Tensor, colour: Tensor) -> None:
        self.image = torch.ones(1, 1, 3, dtype=colour.dtype, device=colour.device) if image is None else image
        self.rotation, self.colour = rotation, colour
        self.height, self.width = self.image.shape[:2]
        with torch.no_grad():
            rows = torch.arange(self.height + 2, dtype=self.image.dtype, device=self.image.device) - 0.5
            self._edges = torch.cos(math.pi * (rows / self.height).clamp(0, 1))
            weights = torch.tensor(LUMINANCE, dtype=self.image.dtype, device=self.image.device)
            value = (self.image * self.colour) @ weights
            if not value.sum() > 0:  # a black world: any density will do
                value = torch.ones_like(value)
            right = torch.cat([value[:1], value, value[-1:]])
            left = torch.roll(right, 1, 1)
            #: Luminance at the corners of each cell: upper left, upper right, lower left, lower right.
            self._corners = torch.stack([left[:-1], right[:-1], left[1:], right[1:]])
            solid = 2 * math.pi / self.width * (self._edges[:-1] - self._edges[1:])
            power = self._corners.mean(0) * solid.unsqueeze(1)
            self._power = power.sum()
            self._cumulative = torch.cumsum(power.flatten() / self._power, 0)

    @classmethod
    def from_world(cls, world: World, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Light:
        """The light that a frame's World describes."""

        def tensor(values: object) -> Tensor:
            return torch.as_tensor(np.asarray(values, dtype=np.float64), dtype=dtype, device=device)

        image = None if world.environment is None else tensor(world.environment)
        return cls(image, tensor(world.rotation), tensor(world.colour) * world.strength)

    def radiance(self, direction: Tensor) -> Tensor:
        """Radiance (..., 3) that arrives from unit world directions (..., 3)."""
        u, v = coordinates_of(direction @ self.rotation.T)
        x, y = u * self.width - 0.5, (v * self.height - 0.5).clamp(0, self.height - 1)
        i, j = torch.floor(x), torch.floor(y).clamp(max=max(self.height - 2, 0))
        s, t = (x - i).unsqueeze(-1), (y - j).unsqueeze(-1)
        left, top = i.long() % self.width, j.long()
        right, bottom = (left + 1) % self.width, (top + 1).clamp(max=self.height - 1)
        upper = (1 - s) * self.image[top, left] + s * self.image[top, right]
        lower = (1 - s) * self.image[bottom, left] + s * self.image[bottom, right]
        return ((1 - t) * upper + t * lower) * self.colour

    def sample(self, u: Tensor) -> Tensor:
        """World directions (..., 3) of uniform numbers (..., 3): two place them in a cell, the third picks it."""
        index = torch.searchsorted(self._cumulative, u[..., 2].contiguous() * self._cumulative[-1], right=True)
        index = index.clamp(max=len(self._cumulative) - 1)
        row, column = index // self.width, index % self.width
        a, b, c, d = self._corners[:, row, column]
        t = _on_slope(u[..., 1], a + b, c + d)
        s = _on_slope(u[..., 0], (1 - t) * a + t * c, (1 - t) * b + t * d)
        across = (column + s - 0.5) / self.width
        upper, lower = self._edges[row], self._edges[row + 1]
        down = torch.acos((upper + t * (lower - upper)).clamp(-1, 1)) / math.pi
        return directions_of(across, down) @ self.rotation

    def pdf(self, direction: Tensor) -> Tensor:
        """Density of `sample`, per steradian, at unit world directions (..., 3)."""
        local = direction @ self.rotation.T
        u, v = coordinates_of(local)
        x = u * self.width + 0.5
        column, row = torch.floor(x).long(), (v * self.height + 0.5).long().clamp(0, self.height)
        s, column = x - column, column % self.width
        upper, lower = self._edges[row], self._edges[row + 1]
        t = ((upper - local[..., 2]) / (upper - lower)).clamp(0, 1)
        a, b, c, d = self._corners[:, row, column]
        return ((1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d)) / self._power


def _on_slope(number: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Places in [0, 1] of random numbers, in proportion to what goes from `start` to `end` there."""
    root = torch.sqrt(start * start + number * (end * end - start * start))
    return (number * (start + end) / (start + root).clamp(min=1e-300)).clamp(max=1)
