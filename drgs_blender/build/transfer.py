"""Materials carried between surfels and mesh vertices."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..core.asset.model import BASE_CHANNELS, MATERIAL_CHANNELS, SURFEL_CHANNELS, Binding, Mesh, Surfels
from ..deform.binding import clamp_weights
from ..deform.face_frames import Faces, dot
from ..geometry.normals import VertexNormals, rotation_matrices

Array = np.ndarray

#: Surfels that may contribute to a vertex.
NEAREST = 24
#: Thickness given to the kernel of a surfel, as a part of its larger standard deviation.
THICKNESS = 0.5
#: Vertices worked on at a time: what is found on the way stays in the processor's cache.
_TOGETHER = 2048


def surfels_to_vertices(mesh: Mesh, surfels: Surfels, binding: Binding) -> int:
    """Give the mesh the materials of the surfels around each vertex; edit `mesh` in place.

    A surfel weighs opacity x exp(-(u^2 + v^2 + h^2) / 2), with u and v in its standard deviations and h, its distance
    from the vertex along its normal, in half the larger one. Surfels that hang on faces turned away from the vertex
    (the other side of a thin wall) weigh nothing. A vertex that no surfel reaches takes the nearest ones.

    Returns
    -------
    int
        Vertices that took the nearest surfels.
    """
    frames = rotation_matrices(surfels.rotation.astype(np.float64))
    inward = -dot(frames[..., 2], Faces.of(mesh.vertices, mesh.faces).normal[binding.face]) > 0
    outward = np.where(inward[:, None], -frames[..., 2], frames[..., 2])
    scale = np.maximum(surfels.scale.astype(np.float64), 1e-12)
    size = np.stack([scale[:, 0], scale[:, 1], THICKNESS * scale.max(axis=1)])
    neighbours = _SurfelNeighbours(
        surfels, frames.transpose(1, 2, 0).copy(), outward.T.copy(), size, 0.1 * scale.max(axis=1)
    )
    normal = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    tree, k, lonely = cKDTree(surfels.centre), min(NEAREST, len(surfels)), 0
    found = {name: np.empty_like(getattr(mesh, name)) for name in BASE_CHANNELS}
    for first in range(0, len(mesh.vertices), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        vertices = mesh.vertices[rows].astype(np.float64)
        distance, index = tree.query(vertices, k=k)
        index = index.reshape(-1, k)
        weight, alone = neighbours.weights(vertices, normal[rows], distance.reshape(-1, k), index)
        lonely += int(alone.sum())
        for name in found:
            values = getattr(surfels, name)[index]
            found[name][rows] = np.einsum("vk,vk...->v...", weight, values).astype(np.float32).clip(0, 1)
    for name, values in found.items():
        setattr(mesh, name, values)
    return lonely


class _SurfelNeighbours(NamedTuple):
    """Surfels as a vertex weighs those near it, with n last in each array.

    Attributes
    ----------
    surfels : Surfels
    frames : (3, 3, n) array
        Axes of the surfels in their second dimension.
    outward : (3, n) array
        Normals on the side on which they hang.
    size : (3, n) array
        Standard deviations along the axes.
    softening : (n,) array
        Length whose square is added to squared distances, so that a surfel at a vertex does not take all the weight.
    """

    surfels: Surfels
    frames: Array
    outward: Array
    size: Array
    softening: Array

    def weights(self, vertices: Array, normal: Array, distance: Array, index: Array) -> tuple[Array, Array]:
        """Weights (v, k), whose sum is 1, of the surfels `index` (v, k) at vertices; which no surfel reaches (v,)."""
        ray = [vertices[:, c, None] - centre.take(index) for c, centre in enumerate(self.surfels.centre.T)]
        square = 0.0
        for axis in range(3):
            along = 0.0
            for c in range(3):
                along = along + ray[c] * self.frames[c, axis].take(index)
            square = square + (along / self.size[axis].take(index)) ** 2
        side = 0.0
        for c in range(3):
            side = side + self.outward[c].take(index) * normal[:, c, None]
        facing = np.greater(side, 0)
        opacity = self.surfels.opacity[index]
        weight = opacity * np.exp(-0.5 * square) * facing
        lonely = weight.sum(axis=1) < 1e-3
        alone = np.flatnonzero(lonely)
        same_side = np.where(facing[alone].any(axis=1, keepdims=True), facing[alone], True)
        near = same_side / (distance[alone] ** 2 + self.softening[index[alone]] ** 2)
        weight[alone] = near * (opacity[alone] + 1e-3)
        return weight / weight.sum(axis=1, keepdims=True), lonely


def vertices_to_surfels(
    mesh: Mesh, surfels: Surfels, binding: Binding, names: Collection[str] = (*BASE_CHANNELS, *SURFEL_CHANNELS)
) -> None:
    """Give the surfels the channels `names`, those that `mesh` has, of the points that they hang on; edit in place."""
    weights = clamp_weights(binding.barycentric.astype(np.float64))
    corners = mesh.faces[binding.face]
    for name in mesh.channels:
        if name in names:
            values = np.einsum("nk,nk...->n...", weights, getattr(mesh, name)[corners]).astype(np.float32)
            setattr(surfels, name, values.clip(0, MATERIAL_CHANNELS[name].limit))
