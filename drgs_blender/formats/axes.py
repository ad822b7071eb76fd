"""Y-up files to Z up, exactly as Blender's importers turn them: (x, y, z) -> (x, -z, y)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..asset import Surfels
from .files import MeshFile

Array = np.ndarray

#: Rotation by +90 degrees about X: Y up becomes Z up.
Y_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
#: The same as a quaternion, wxyz.
Y_TO_Z_UP_QUATERNION = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])


def vectors_to_z_up(vectors: Array) -> Array:
    """Turn (..., 3) positions or directions from Y up to Z up; same dtype."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.ascontiguousarray(np.stack([x, -z, y], axis=-1))


def surfels_to_z_up(surfels: Surfels) -> Surfels:
    """Turn surfels from Y up to Z up: centres and rotations.

    Spherical harmonics stay in the old axes (they are kept as captured, not shaded with).
    """
    return replace(
        surfels,
        centre=vectors_to_z_up(surfels.centre),
        rotation=multiply_quaternions(Y_TO_Z_UP_QUATERNION, surfels.rotation).astype(np.float32),
    )


def mesh_to_z_up(mesh: MeshFile) -> MeshFile:
    """Turn a mesh from Y up to Z up: vertices and normals."""
    normals = mesh.corner_normals
    return replace(
        mesh,
        vertices=vectors_to_z_up(mesh.vertices),
        corner_normals=None if normals is None else vectors_to_z_up(normals),
        up_axis="Z",
    )


def multiply_quaternions(a: Array, b: Array) -> Array:
    """Hamilton product of wxyz quaternions (..., 4): the rotation b, then a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
