"""The learned surface: materials and normals of the points of a domain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...render.reference.brdf import dot, normalise
from .blend import blend
from .materials import Materials
from .pixels import Pixels
from .settings import Settings

Array = np.ndarray


class Pairs(NamedTuple):
    """Pairs of vertices that photographs show alike.

    Attributes
    ----------
    ends : (p, 2) int64 tensor
    weight : (p,) float32 tensor
        In [0, 1]: how alike.
    """

    ends: Tensor
    weight: Tensor


@dataclass(frozen=True, slots=True)
class SurfaceSamples:
    """The surface at the n pixels and e edges of a step, with derivatives by what is learned.

    Attributes
    ----------
    materials : (n, c) float32 tensor
        Columns of `Materials` at the pixels.
    normal : (n, 3) float32 tensor
        Unit, world space.
    columns : (u, c) float32 tensor
        Of `Materials`, of the vertices that pixels and edges use.
    offsets : (u, 3) float32 tensor or None
        Learned offsets of their normals.
    ends : (e, 2) int64 tensor
        The ends of the edges among those vertices.
    pairs : Pairs, optional
        Of like ones among them.
    sides : (e, 1) float32 tensor, optional
        -1 where the normals of an edge's ends are on different sides of one surface.
    """

    materials: Tensor
    normal: Tensor
    columns: Tensor
    offsets: Tensor | None
    ends: Tensor
    pairs: Pairs | None = None
    sides: Tensor | None = None

    def at_ends(self, values: Tensor) -> Tensor:
        """Values (u, k) of the vertices at the ends of the edges, (e, 2, k)."""
        return at_both(values, self.ends)


def at_both(values: Tensor, pairs: Tensor) -> Tensor:
    """Rows of values (u, k) at pairs (p, 2) of their numbers, (p, 2, k)."""
    return values.index_select(0, pairs.flatten()).view(len(pairs), 2, values.shape[1])


class Surface:
    """Materials and normals of a mesh or of surfels as something to learn.

    Parameters
    ----------
    points : (v, 3) float32 array
        Places of what carries materials: vertices, or surfels.
    normals : (v, 3) float32 array
        Their unit normals to begin with.
    settings : Settings
    mean : (3,) float array
        Colour of the photographs.
    two_sided : bool
        See `Domain`.

    Attributes
    ----------
    materials : Materials
    parameters : dict
        Name to tensor: those of the materials, and "normals" (v, 3) where they are learned.
    """

    def __init__(self, points: Array, normals: Array, settings: Settings, mean: Array, two_sided: bool) -> None:
        self._normals, self._two_sided = torch.from_numpy(normals), two_sided
        self.materials = Materials(points, settings.parametrisation, settings.coarse, mean)
        self.parameters = dict(self.materials.parameters)
        if settings.normals:
            self.parameters["normals"] = torch.zeros(len(points), 3)

    def at(self, pixels: Pixels, edges: Array, pairs: Pairs | None = None) -> SurfaceSamples:
        """The surface at pixels, at edges (e, 2) of vertices, and at pairs of like ones."""
        corner = torch.from_numpy(pixels.index).long()
        ends = torch.from_numpy(edges)
        if pairs is not None:
            ends = torch.cat([ends, pairs.ends])
        used, index = torch.unique(torch.cat([corner.flatten(), ends.flatten()]), return_inverse=True)
        corner_index, end_index = index[: corner.numel()].view(corner.shape), index[corner.numel() :].view(-1, 2)
        shares = torch.from_numpy(pixels.share)

        columns = self.materials.at(used)
        materials = blend(columns, corner_index, shares)
        normals = self._normals[used]
        offsets = self.parameters["normals"].index_select(0, used) if "normals" in self.parameters else None
        if offsets is not None:
            normals = normals + offsets
        facing, sides = shares, None
        if self._two_sided:
            facing = shares * dot(self._normals[corner], torch.from_numpy(pixels.towards)[:, None]).sign()
            sides = dot(*self._normals[torch.from_numpy(edges)].unbind(1)).sign()[:, None]
        normal = normalise(blend(normals, corner_index, facing))
        like = None if pairs is None else Pairs(end_index[len(edges) :], pairs.weight)
        return SurfaceSamples(materials, normal, columns, offsets, end_index[: len(edges)], like, sides)

    def normals(self) -> Array:
        """(v, 3) float32 unit: those that learning began with, and what was learned on top."""
        normals = self._normals
        if "normals" in self.parameters:
            normals = normalise(normals + self.parameters["normals"])
        return normals.numpy().astype(np.float32)
