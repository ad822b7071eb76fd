"""Regularisers: what is expected of materials, normals and light, whatever the photographs show."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .environment import LearnedLight, colour_cast
from .losses import metal_albedo_prior, metal_smoothness_prior
from .settings import Settings
from .surface import Pairs, SurfaceSamples, at_both

Array = np.ndarray

#: How much smoother than albedo roughness and metallic are (of diffuse and specular colour: diffuse, roughness, rest).
_SMOOTH = (1.0, 1.0, 1.0, 2.0, 10.0, 10.0, 10.0)
#: The same between vertices that photographs show alike.
_ALIKE = (1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0)
#: Edges that are smoothed per step; how much photographed chroma may differ along one that is.
_EDGES, _CHROMA = 8192, 0.08
#: Mean edge, in parts of the extent, of the meshes that weights were chosen on; and the most that finer ones count.
EDGE, FINEST = 1 / 200, 8.0


class Regularisers:
    """Losses that hold what is learned, and the edges of the mesh along which they do.

    Parameters
    ----------
    edges : (e, 2) int64 array
        Pairs of vertices, or of surfels, that lie side by side.
    colours : (v, 3) float32 array
        Mean colour of the photographs there.
    settings : Settings
    finer : float
        Their `fineness`: the factor of differences along edges.
    """

    def __init__(self, edges: Array, colours: Array, settings: Settings, finer: float = 1.0) -> None:
        self._settings, self._finer = settings, finer
        self._edges = edges
        self._likeness = _likeness(self._edges, colours)

    def draw(self, generator: np.random.Generator) -> Array:
        """Numbers of the edges of a step, (e,) int64."""
        return generator.integers(0, max(len(self._edges), 1), min(_EDGES, len(self._edges)))

    def edges(self, edge: Array) -> Array:
        """Vertices (e, 2) of edges."""
        return self._edges[edge]

    def of_materials(self, samples: SurfaceSamples, edge: Array, has_metallic: bool, knows_metals: bool) -> Tensor:
        """Smooth where the photographs are alike; metals plain, bright and distinct from paint.

        Parameters
        ----------
        samples : SurfaceSamples
        edge : (e,) int array
            Numbers of its edges.
        has_metallic : bool
            Metallic is learned.
        knows_metals : bool
            Metallic is known well enough for priors on metals.
        """
        s = self._settings
        pair = samples.at_ends(samples.columns)
        differences = (pair[:, 0] - pair[:, 1]).abs()
        likeness = torch.from_numpy(self._likeness[edge])[:, None]
        weights = torch.tensor(_SMOOTH[: samples.columns.shape[1]])
        smoothness = s.smoothness * self._finer
        loss = smoothness * ((likeness * differences).mean(0) * weights).sum()
        has_metals = has_metallic and knows_metals
        if s.metal_smoothness > 0 and has_metals:
            loss = loss + s.metal_smoothness * smoothness * metal_smoothness_prior(
                differences[:, :3], pair[:, :, 4], likeness
            )
        if s.binary_metallic_prior > 0 and has_metallic:
            loss = loss + s.binary_metallic_prior * (samples.materials[:, 4] * (1 - samples.materials[:, 4])).mean()
        if s.metal_albedo_prior > 0 and has_metals:
            loss = loss + s.metal_albedo_prior * metal_albedo_prior(samples.materials[:, :3], samples.materials[:, 4])
        return loss

    def of_likeness(self, columns: Tensor, pairs: Pairs) -> Tensor:
        """Columns (u, c) of `Materials`, alike at pairs of points that photographs show alike."""
        pair = at_both(columns, pairs.ends)
        differences = pairs.weight[:, None] * (pair[:, 0] - pair[:, 1]).abs()
        weights = torch.tensor(_ALIKE[: columns.shape[1]])
        return self._settings.same_material * (differences.mean(0) * weights).sum()

    def of_light(self, light: LearnedLight, radiance: Tensor) -> Tensor:
        """Grey and smooth."""
        s, loss = self._settings, torch.zeros(())
        if s.grey_light_prior > 0:
            loss = loss + s.grey_light_prior * colour_cast(radiance)
        if s.light_smoothness > 0:
            loss = loss + s.light_smoothness * light.roughness()
        return loss

    def of_normals(self, samples: SurfaceSamples) -> Tensor:
        """Offsets small, and alike along edges."""
        if samples.offsets is None:
            return torch.zeros(())
        turned = samples.at_ends(samples.offsets)
        other = turned[:, 1] if samples.sides is None else samples.sides * turned[:, 1]
        alike = ((turned[:, 0] - other) ** 2).sum(1).mean()
        return self._settings.normal_smoothness * (self._finer * alike + 0.02 * (samples.offsets**2).sum(1).mean())


def fineness(points: Array, edges: Array) -> float:
    """How many times shorter edges (e, 2) of points (n, 3) are than those of which weights were chosen: 1 to `FINEST`.

    Along shorter edges the same materials differ less, and a vertex is seen by fewer pixels.
    """
    if not len(edges):
        return 1.0
    ends = points[edges]
    edge = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
    return min(max(EDGE * float(np.ptp(points, axis=0).max()) / max(edge, 1e-30), 1.0), FINEST)


def _likeness(edges: Array, colours: Array) -> Array:
    """How alike the ends of edges (e, 2) are in the photographs (e,): 1 the same chroma, 0 another."""
    chroma = colours / np.maximum(colours.sum(axis=1, keepdims=True), 1e-4)
    difference = np.linalg.norm(chroma[edges[:, 0]] - chroma[edges[:, 1]], axis=1)
    return np.exp(-((difference / _CHROMA) ** 2)).astype(np.float32)
