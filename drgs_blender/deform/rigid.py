"""Surfels without a mesh: they follow their object's matrix alone."""

from __future__ import annotations

import numpy as np

from ..core.asset.model import PosedSurfels, Surfels
from ..geometry.normals import rotation_matrices

Array = np.ndarray


def pose_by_matrix(surfels: Surfels, matrix_world: Array, object_index: int = 0) -> PosedSurfels:
    """Surfels of one frame, moved, stretched, sheared or mirrored by an affine map, exactly.

    With A the linear part, scaled tangents become A T and normals go through the cofactor matrix of A.

    Parameters
    ----------
    surfels : Surfels
        Object space.
    matrix_world : (4, 4) array
        Object-to-world.
    object_index : int
        Index into Frame.objects, copied to every surfel.
    """
    matrix = np.asarray(matrix_world, np.float64)
    linear = matrix[:3, :3]
    axes = rotation_matrices(surfels.rotation.astype(np.float64))
    tangents = linear @ (axes[..., :2] * surfels.scale[:, None, :])
    a, b, c = linear
    side = -1.0 if np.linalg.det(linear) < 0 else 1.0
    normal = side * axes[..., 2] @ np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)]).T
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # Where the matrix flattens everything there is no normal, and no area either.
    normal = np.where(length > 1e-300, normal / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
    centre, tangent_u, tangent_v, normal = (
        np.ascontiguousarray(array, np.float32)
        for array in (surfels.centre @ linear.T + matrix[:3, 3], tangents[..., 0], tangents[..., 1], normal)
    )
    owner = np.full(len(surfels), object_index, np.int32)
    materials = surfels.opacity, surfels.albedo, surfels.roughness, surfels.metallic
    return PosedSurfels(centre, tangent_u, tangent_v, normal, *materials, owner)
