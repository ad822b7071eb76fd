"""Instances: the object-to-world matrices of a mesh, checked, for points and for normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import UsageError
from ...core.frame import MeshState

Array = np.ndarray

#: Matrices whose axes span less than this part of the box of their lengths are flat: rays cannot be brought into them.
_FLAT = 1e-7
#: Lengths beyond these (in units of a metre) leave float32's range when they are multiplied.
_SMALLEST, _LARGEST = 1e-12, 1e12


@dataclass(slots=True)
class Instances:
    """The usable instances of one mesh.

    Attributes
    ----------
    matrices : (k, 3, 4) float64 array
        Object-to-world.
    pass_index : (k,) int32 array
    usable : (instances of the mesh,) bool array
        Which of them are usable.
    bad : int
        How many instances were left out.
    instanced : bool
        Whether the mesh has a BVH of its own, with several instances; otherwise it is part of the world's.
    """

    matrices: Array
    pass_index: Array
    usable: Array
    bad: int
    instanced: bool


def usable_instances(mesh: MeshState) -> Instances:
    """Check the matrices of `mesh`.

    A single instance may be flattened (a face is a face from any side); one of several may not, as rays go
    through the inverse matrix. Matrices that are not finite are left out always.

    Raises
    ------
    UsageError
        When matrices or pass indices have the wrong shape.
    """
    matrices = np.asarray(mesh.matrices, np.float64)
    index = np.asarray(mesh.pass_indices)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or index.shape != (len(matrices),):
        raise UsageError(
            f"object {mesh.name}",
            f"its matrices have shape {matrices.shape} and its pass indices {index.shape}",
            "Give one 4 x 4 matrix and one index an instance",
        )
    usable = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    if len(matrices) > 1:
        with np.errstate(all="ignore"):
            linear = matrices[:, :3, :3]
            lengths = np.linalg.norm(linear, axis=1)
            usable &= ((lengths > _SMALLEST) & (lengths < _LARGEST)).all(axis=1)
            usable &= (np.abs(matrices[:, :3, 3]) < _LARGEST).all(axis=1)
            usable &= np.abs(np.linalg.det(linear / np.where(lengths > 0, lengths, 1)[:, None])) > _FLAT
    kept = np.ascontiguousarray(matrices[usable, :3])
    bad = len(matrices) - len(kept)
    return Instances(kept, index[usable].astype(np.int32), usable, bad, len(kept) > 1)


def other_matrices(matrices: Array, instances: Instances) -> Array:
    """(k, 3, 4) float64: matrices of the usable `instances` at another time; as now where unknown or not finite."""
    given = np.asarray(matrices, np.float64)
    if given.shape != (len(instances.usable), 4, 4):
        return instances.matrices
    chosen = given[instances.usable, :3]
    return np.where(np.isfinite(chosen).all(axis=(1, 2), keepdims=True), chosen, instances.matrices)


def flattens(matrix: Array) -> bool:
    """Whether faces may lose their area in a (3, 4) matrix: it is flat, or too small for float32."""
    linear = matrix[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(linear, axis=0)
        return bool(lengths.min() < _SMALLEST or abs(np.linalg.det(linear / lengths)) < _FLAT)


def normal_matrices(matrices: Array) -> Array:
    """(k, 3, 3) float32 matrices of normals for (k, 3, 4) object-to-world: cofactors, outwards also when mirrored.

    Defined for flattened shapes too. Scaled so that the largest entry is one: only directions matter.
    """
    linear = matrices[:, :, :3]
    largest = np.abs(linear).max(axis=(1, 2), keepdims=True, initial=1e-300)
    a, b, c = np.moveaxis(linear / largest, 1, 0)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    mirrored = (a * cofactors[:, 0]).sum(axis=1) < 0
    cofactors[mirrored] *= -1
    return (cofactors / np.abs(cofactors).max(axis=(1, 2), keepdims=True, initial=1e-300)).astype(np.float32)
