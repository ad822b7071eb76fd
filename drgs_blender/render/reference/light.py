"""Distant light in torch: lat-long radiance, and directions drawn in proportion to it.

The mapping is Blender's (see asset.Environment): u = 0.5 - atan2(y, x) / 2 pi, v = acos(z) / pi, row 0 at +Z. Texel
centres are at +0.5; between them the lookup is bilinear, periodic in u and clamped in v.
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
            polar = torch.linspace(0, math.pi, self.height + 1, dtype=self.image.dtype, device=self.image.device)
            self._edges = torch.cos(polar)
            self.probability = self._texel_probability()
            self._cumulative = torch.cumsum(self.probability.flatten(), 0)

    @classmethod
    def from_world(cls, world: World, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Light:
        """The light that a frame's World describes."""

        def tensor(values: object) -> Tensor:
            return torch.as_tensor(np.asarray(values, dtype=np.float64), dtype=dtype, device=device)

        image = None if world.environment is None else tensor(world.environment)
        return cls(image, tensor(world.rotation), tensor(world.colour) * world.strength)

    def _texel_probability(self) -> Tensor:
        """Probability of each texel: luminance of the *interpolated* picture over the texel times its solid angle.

        The bilinear picture, integrated over a texel, weighs the neighbours (1/8, 3/4, 1/8) along either axis: light
        that leaks into a black texel is still found.
        """
        weights = torch.tensor(LUMINANCE, dtype=self.image.dtype, device=self.image.device)
        value = (self.image * self.colour) @ weights
        value = (torch.roll(value, 1, 1) + torch.roll(value, -1, 1)) / 8 + 0.75 * value
        padded = torch.cat([value[:1], value, value[-1:]])
        value = (padded[:-2] + padded[2:]) / 8 + 0.75 * value
        weight = value * (self._edges[:-1] - self._edges[1:]).unsqueeze(1)
        if not weight.sum() > 0:  # a black world: any density will do
            weight = weight + (self._edges[:-1] - self._edges[1:]).unsqueeze(1)
        return weight / weight.sum()

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
        """World directions (..., 3) of uniform numbers (..., 3): two place them in a texel, the third picks it."""
        index = torch.searchsorted(self._cumulative, u[..., 2].contiguous() * self._cumulative[-1], right=True)
        index = index.clamp(max=len(self._cumulative) - 1)
        row, column = index // self.width, index % self.width
        across = (column + u[..., 0]) / self.width
        # Uniform in the cosine, so that the density inside a texel is constant over solid angle.
        upper, lower = self._edges[row], self._edges[row + 1]
        down = torch.acos((upper + u[..., 1] * (lower - upper)).clamp(-1, 1)) / math.pi
        return directions_of(across, down) @ self.rotation

    def pdf(self, direction: Tensor) -> Tensor:
        """Density of `sample`, per steradian, at unit world directions (..., 3)."""
        u, v = coordinates_of(direction @ self.rotation.T)
        column = (u * self.width).long() % self.width
        row = (v * self.height).long().clamp(0, self.height - 1)
        solid_angle = 2 * math.pi / self.width * (self._edges[row] - self._edges[row + 1])
        return self.probability[row, column] / solid_angle
