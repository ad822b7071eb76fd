"""Learned materials of the vertices: logits, on the vertices themselves and on nested grids around them.

A grid's cell carries what the many pixels around it agree on, so that large areas find their values in few steps; the
vertices keep the detail. The grids are interpolated linearly, so that they have no blocks.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...render.reference.brdf import layer_albedo
from .blend import blend

Array = np.ndarray

#: Cells along the longest side of the coarsest grid; each further one has twice as many.
_CELLS = 8
#: Least roughness that is learned.
_SMOOTHEST = 0.03
#: Where materials begin.
_ALBEDO, _ROUGHNESS, _METALLIC, _SPECULAR = 0.4, 0.5, 0.2, 0.1
_GREY, _WITHIN = np.ones(3), (0.05, 0.9)
_DIELECTRIC = 0.04
#: Given values are kept this far from 0 and 1, where logits have no end.
_MARGIN = 0.005


def levels(coarse: int, finer: float) -> int:
    """Number of grids of points `finer` times as close (`regularisers.fineness`) as those that have `coarse`."""
    return coarse and coarse + round(math.log2(finer))


class Grids:
    """Position of the vertices in nested grids: (v, 8) corners and shares of each, corners numbered without gaps."""

    def __init__(self, vertices: Array, count: int) -> None:
        low = vertices.min(axis=0)
        extent = max(float((vertices.max(axis=0) - low).max()), 1e-12)
        steps = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(8, 3)
        self.index: list[Tensor] = []
        self.share: list[Tensor] = []
        self.sizes: list[int] = []
        for level in range(count):
            cells = _CELLS << level
            place = (vertices - low) / extent * cells
            first = np.minimum(place.astype(np.int64), cells - 1)
            part = (place - first)[:, None]
            corner = first[:, None] + steps
            code = (corner[..., 0] * (cells + 1) + corner[..., 1]) * (cells + 1) + corner[..., 2]
            used, index = np.unique(code, return_inverse=True)
            share = np.where(steps == 1, part, 1 - part).prod(axis=-1).astype(np.float32)
            self.index.append(torch.from_numpy(index.reshape(-1, 8)))
            self.share.append(torch.from_numpy(share))
            self.sizes.append(len(used))


class Materials:
    """The learned materials of the surface.

    Attributes
    ----------
    parameters : dict of str to tensor
        Name -> tensor: "detail" (v, c), "grid0" ... (corners, c). With "metallic" the c = 5 columns are
        albedo, roughness, metallic; with "dielectric" c = 4, without the last; with "specular" c = 7: diffuse colour,
        roughness, specular colour.

    Parameters
    ----------
    points : (v, 3) float array
        Where the materials are: vertices, or centres of surfels.
    parametrisation : str
    coarse : int
    colour : (3,) array
        In the hue of which all begins: what all photographs together show. Light that is learned faster than albedo
        would take it on, and leave its complement to the albedo.
    """

    def __init__(self, points: Array, parametrisation: str, coarse: int, colour: Array = _GREY) -> None:
        self.specular, self.metallic = parametrisation == "specular", parametrisation == "metallic"
        more = [_SPECULAR] * 3 if self.specular else [_METALLIC] * self.metallic
        hue = np.asarray(colour) / max(float(np.mean(colour)), 1e-6)
        start = np.array([*np.clip(_ALBEDO * hue, *_WITHIN), _ROUGHNESS, *more])
        self._start = torch.from_numpy(np.log(start / (1 - start)).astype(np.float32))
        self._grids = Grids(points, coarse)
        self._count, columns = len(points), len(start)
        self.parameters = {"detail": torch.zeros(self._count, columns)}
        for level, size in enumerate(self._grids.sizes):
            self.parameters[f"grid{level}"] = torch.zeros(size, columns)

    def at(self, vertices: Tensor) -> Tensor:
        """Columns (k, c) of the points `vertices` (k,), activated: all within [0, 1]."""
        value = self._start + self.parameters["detail"].index_select(0, vertices)
        for level, (index, share) in enumerate(zip(self._grids.index, self._grids.share)):
            value = value + blend(self.parameters[f"grid{level}"], index[vertices], share[vertices])
        return torch.sigmoid(value)

    def reflect(self, columns: Tensor, sums: Tensor, nv: Tensor, shading_model: str) -> Tensor:
        """Radiance (n, 2, 3) of surfaces with `columns` (n, c), whose `sums` (n, 2, 4, 3) are those of `Gatherer`."""
        colour, roughness = columns[:, None, :3], self.roughness(columns)
        white, mirror, edge, dielectric = sums.unbind(2)
        if shading_model == "principled":
            white = white * (1 - layer_albedo(nv, roughness))[:, None, None]
        if self.specular:
            return colour * white + columns[:, None, 4:7] * mirror + edge
        metal = columns[:, None, 4:5] if self.metallic else torch.zeros(())
        if shading_model == "paper":
            f0 = _DIELECTRIC * (1 - metal) + colour * metal
            return (1 - metal) * colour * white + f0 * mirror + edge
        return (1 - metal) * (colour * white + dielectric) + metal * (colour * mirror + edge)

    def roughness(self, columns: Tensor) -> Tensor:
        """(n,) roughness of `columns`."""
        return _SMOOTHEST + (1 - _SMOOTHEST) * columns[:, 3]

    def values(self) -> tuple[Array, Array, Array]:
        """Albedo (v, 3), roughness (v,) and metallic (v,) of all points."""
        with torch.no_grad():
            return self.described(self.at(torch.arange(self._count)))

    def begin(self, columns: Tensor) -> None:
        """Begin with these columns (v, c) of the points."""
        inside = columns.clamp(_MARGIN, 1 - _MARGIN)
        self.parameters["detail"].copy_(torch.log(inside / (1 - inside)) - self._start)

    def described(self, columns: Tensor) -> tuple[Array, Array, Array]:
        """Albedo (n, 3), roughness (n,) and metallic (n,) of `columns` (n, c)."""
        roughness = self.roughness(columns).numpy()
        values = columns.numpy()
        if self.specular:
            albedo, metallic = from_specular(values[:, :3], values[:, 4:7])
            return albedo, roughness, metallic
        return values[:, :3].copy(), roughness, values[:, 4].copy() if self.metallic else np.zeros_like(roughness)


def from_specular(diffuse: Array, specular: Array) -> tuple[Array, Array]:
    """Albedo (n, 3) and metallic (n,) of surfaces with diffuse and specular colours (n, 3), float32.

    With x = 1 - metallic, diffuse = x a and specular = 0.04 x + (1 - x) a; the means of the channels give
    0.04 x^2 - (d + s) x + d = 0, of which the smaller root lies in [0, 1].
    """
    d, s = diffuse.astype(np.float64).mean(axis=1), specular.astype(np.float64).mean(axis=1)
    root = np.sqrt(np.maximum((d + s) ** 2 - 4 * _DIELECTRIC * d, 0))
    rest = np.clip(2 * d / np.maximum(d + s + root, 1e-9), 0, 1)
    albedo = np.clip(diffuse + specular - _DIELECTRIC * rest[:, None], 0, 1)
    return albedo.astype(np.float32), (1 - rest).astype(np.float32)
