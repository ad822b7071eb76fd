"""Materials carried between surfels and mesh vertices."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..core.asset.model import Binding, Mesh, Surfels
from ..deform.binding import clamp_weights
from ..deform.face_frames import Faces, dot
from ..geometry.normals import VertexNormals, rotation_matrices

Array = np.ndarray

#: Surfels that may contribute to a vertex.
NEAREST = 24
#: Thickness given to the kernel of a surfel, as a part of its larger standard deviation.
THICKNESS = 0.5


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
    vertices = mesh.vertices.astype(np.float64)
    k = min(NEAREST, len(surfels))
    distance, index = cKDTree(surfels.centre).query(vertices, k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    frames = rotation_matrices(surfels.rotation.astype(np.float64))
    inward = -dot(frames[..., 2], Faces.of(mesh.vertices, mesh.faces).normal[binding.face]) > 0
    outward = np.where(inward[:, None], -frames[..., 2], frames[..., 2])
    ray = vertices[:, None] - surfels.centre[index]
    scale = np.maximum(surfels.scale.astype(np.float64), 1e-12)
    size = np.stack([scale[:, 0], scale[:, 1], THICKNESS * scale.max(axis=1)], -1)
    square = np.sum((np.einsum("vkc,vkci->vki", ray, frames[index]) / size[index]) ** 2, axis=-1)
    normal = VertexNormals(mesh.faces, len(vertices))(mesh.vertices)
    facing = np.einsum("vkc,vc->vk", outward[index], normal) > 0
    weight = surfels.opacity[index] * np.exp(-0.5 * square) * facing
    lonely = weight.sum(axis=1) < 1e-3
    same_side = np.where(facing.any(axis=1, keepdims=True), facing, True)
    near = same_side / (distance**2 + (0.1 * scale[index].max(axis=-1)) ** 2)
    weight = np.where(lonely[:, None], near * (surfels.opacity[index] + 1e-3), weight)
    weight /= weight.sum(axis=1, keepdims=True)
    for name in ("albedo", "roughness", "metallic"):
        values = getattr(surfels, name)[index]
        setattr(mesh, name, np.einsum("vk,vk...->v...", weight, values).astype(np.float32).clip(0, 1))
    return int(lonely.sum())


def vertices_to_surfels(mesh: Mesh, surfels: Surfels, binding: Binding) -> None:
    """Give the surfels the materials of the points that they hang on; edit `surfels` in place."""
    weights = clamp_weights(binding.barycentric.astype(np.float64))
    corners = mesh.faces[binding.face]
    for name in ("albedo", "roughness", "metallic"):
        values = getattr(mesh, name)[corners]
        setattr(surfels, name, np.einsum("nk,nk...->n...", weights, values).astype(np.float32).clip(0, 1))
