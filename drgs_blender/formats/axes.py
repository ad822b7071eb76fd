"""Other up axes to Z up, as Blender's importers turn them: a rotation about X, (x, y, z) -> (x, -z, y) for Y up.

Photogrammetry often has -Y up (the cameras' own axes).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.asset import Mesh, Surfels
from ..core.errors import UsageError
from .files import MeshFile
from .harmonics import rotate_harmonics, whole_bands

Array = np.ndarray

#: A centre beyond this is damage: squares of distances would leave the range of 32-bit floats soon.
FARTHEST = 1e15
#: Up axis of a file -> (3, 3) rotation that brings it to Z up; entries are exact.
UP_AXES: dict[str, Array] = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
_HALF = np.sqrt(0.5)
#: The same rotations as quaternions, wxyz.
_QUATERNIONS = {
    "z": np.array([1.0, 0.0, 0.0, 0.0]),
    "y": np.array([_HALF, _HALF, 0.0, 0.0]),
    "-z": np.array([0.0, 1.0, 0.0, 0.0]),
    "-y": np.array([_HALF, -_HALF, 0.0, 0.0]),
}


def vectors_to_z_up(vectors: Array, up: str = "y") -> Array:
    """Turn (..., 3) positions or directions from `up` (a key of `UP_AXES`) to Z up; same dtype.

    Examples
    --------
    >>> vectors_to_z_up(np.array([[0, 1, 0], [0, 0, 1]]), up="y")
    array([[ 0,  0,  1],
           [ 0, -1,  0]])
    """
    turn = UP_AXES[up]
    source = np.abs(turn).argmax(axis=1)
    sign = turn[np.arange(3), source].astype(vectors.dtype)
    return np.ascontiguousarray(vectors[..., source] * sign)


def vectors_from_z_up(vectors: Array, up: str = "y") -> Array:
    """Turn (..., 3) positions or directions from Z up to `up`; same dtype."""
    return vectors_to_z_up(vectors, {"y": "-y", "-y": "y"}.get(up, up))  # the turns about X undo each other


def from_z_up(up: str) -> tuple[Array, Array]:
    """The rotation from Z up to `up`: (3, 3) matrix and wxyz quaternion."""
    return UP_AXES[up].T, _QUATERNIONS[up] * np.array([1.0, -1.0, -1.0, -1.0])


def surfels_to_z_up(surfels: Surfels, up: str = "y") -> Surfels:
    """Turn surfels from `up` to Z up: centres, rotations and captured colours."""
    sh = surfels.sh
    return replace(
        surfels,
        centre=vectors_to_z_up(surfels.centre, up),
        rotation=multiply_quaternions(_QUATERNIONS[up], surfels.rotation).astype(np.float32),
        sh=sh if sh is None or up == "z" else rotate_harmonics(whole_bands(sh, 4), UP_AXES[up]),
    )


def scaled_surfels(surfels: Surfels, factor: float) -> Surfels:
    """Surfels with all lengths times `factor`. Raises UsageError, see `scaled_lengths`."""
    if factor == 1:
        return surfels
    centre, scale = scaled_lengths(surfels.centre, surfels.scale, factor)
    by = np.float32(factor)
    extras = {name: v * by if name == "thickness" else v for name, v in surfels.extras.items()}
    return replace(surfels, centre=centre, scale=scale, extras=extras)


def scaled_lengths(centre: Array, scale: Array, factor: float) -> tuple[Array, Array]:
    """Centres and scales times `factor`.

    Raises
    ------
    UsageError
        That is more, or less, than numbers of 32 bits hold, or farther away than splats are read.
    """
    with np.errstate(all="ignore"):
        by = np.float32(factor)
        far, scales = centre * by, scale * by
        largest = np.abs(far).max(initial=0)
    if not largest <= FARTHEST or not np.isfinite(scales).all() or not ((scales > 0) | (scale <= 0)).all():
        problem = f"makes lengths that numbers of 32 bits do not hold, or places beyond {FARTHEST:g} m"
        raise UsageError(f"--scale {factor:g}", problem, "Choose another")
    return far, scales


def mesh_to_z_up(mesh: MeshFile, up: str = "y") -> MeshFile:
    """Turn a mesh from `up` to Z up: vertices and normals."""
    normals = mesh.corner_normals
    return replace(
        mesh,
        vertices=vectors_to_z_up(mesh.vertices, up),
        corner_normals=None if normals is None else vectors_to_z_up(normals, up),
        up_axis="Z",
    )


def mesh_from_z_up(mesh: Mesh, up: str = "y") -> Mesh:
    """Turn an asset's mesh from Z up to `up`: vertices, and the normals of its textures."""
    textures = mesh.textures
    if textures is not None and textures.normals is not None:
        textures = replace(textures, normals=vectors_from_z_up(textures.normals, up))
    return replace(mesh, vertices=vectors_from_z_up(mesh.vertices, up), textures=textures)


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
