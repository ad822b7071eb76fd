"""The learned surface: its materials, and normals on top of those of the mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import Mesh
from ...geometry.normals import VertexNormals
from ...render.gbuffer.surfels import ALIKE
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
    """

    materials: Tensor
    normal: Tensor
    columns: Tensor
    offsets: Tensor | None
    ends: Tensor
    pairs: Pairs | None = None

    def at_ends(self, values: Tensor) -> Tensor:
        """Values (u, k) of the vertices at the ends of the edges, (e, 2, k)."""
        return at_both(values, self.ends)


def at_both(values: Tensor, pairs: Tensor) -> Tensor:
    """Rows of values (u, k) at pairs (p, 2) of their numbers, (p, 2, k)."""
    return values.index_select(0, pairs.flatten()).view(len(pairs), 2, -1)


class Surface:
    """Materials and normals of a mesh as something to learn.

    Parameters
    ----------
    mesh : Mesh
    settings : Settings
    mean : (3,) float array
        Colour of the photographs.
    given_normals : bool
        Whether pixels have normals from elsewhere than the mesh.
    start : (v, 3) float32 array, optional
        Unit normals of the vertices to begin with, in place of the mesh's smooth ones.

    Attributes
    ----------
    materials : Materials
    parameters : dict
        Name to tensor: those of the materials, and "normals" (v, 3) where they are learned.
    """

    def __init__(
        self, mesh: Mesh, settings: Settings, mean: Array, given_normals: bool, start: Array | None = None
    ) -> None:
        if start is None:
            start = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
        self._normals = torch.from_numpy(start)
        self._faces = torch.from_numpy(mesh.faces.astype(np.int64))
        self._given_normals = given_normals
        self.materials = Materials(mesh.vertices, settings.parametrisation, settings.coarse, mean)
        self.parameters = dict(self.materials.parameters)
        if settings.normals:
            self.parameters["normals"] = torch.zeros(len(mesh.vertices), 3)

    def at(self, pixels: Pixels, edges: Array, pairs: Pairs | None = None) -> SurfaceSamples:
        """The surface at pixels, at edges (e, 2) of vertices, and at pairs of like ones."""
        corner = self._faces[torch.from_numpy(pixels.face)]
        ends = torch.from_numpy(edges)
        if pairs is not None:
            ends = torch.cat([ends, pairs.ends])
        used, index = torch.unique(torch.cat([corner.flatten(), ends.flatten()]), return_inverse=True)
        corner_index, end_index = index[: corner.numel()].view(-1, 3), index[corner.numel() :].view(-1, 2)
        shares = torch.from_numpy(pixels.corners)

        columns = self.materials.at(used)
        materials = blend(columns, corner_index, shares)
        smooth = self._normals[used]
        offsets = self.parameters["normals"].index_select(0, used) if "normals" in self.parameters else None
        if offsets is not None:
            smooth = smooth + offsets
        normal = normalise(blend(smooth, corner_index, shares))
        if self._given_normals:
            normal = _with_detail(pixels, normal, None if offsets is None else blend(offsets, corner_index, shares))
        like = None if pairs is None else Pairs(end_index[len(edges) :], pairs.weight)
        return SurfaceSamples(materials, normal, columns, offsets, end_index[: len(edges)], like)

    def normals(self) -> Array:
        """(v, 3) float32 unit: those that learning began with, and what was learned on top."""
        normals = self._normals
        if "normals" in self.parameters:
            normals = normalise(normals + self.parameters["normals"])
        return normals.numpy().astype(np.float32)


def _with_detail(pixels: Pixels, normal: Tensor, offsets: Tensor | None) -> Tensor:
    """Normals (n, 3) from elsewhere than the mesh, with what is learned; its `normal` where they are far off."""
    detail, flat = torch.from_numpy(pixels.detail_normal), torch.from_numpy(pixels.flat)
    believed = dot(detail, flat)[:, None] >= ALIKE
    # The face's where they are not: nothing has no direction, and its derivative would spoil that of its vertices.
    own = torch.where(believed, detail, flat)
    return torch.where(believed, own if offsets is None else normalise(own + offsets), normal)
