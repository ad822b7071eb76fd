"""Rays and hits, for compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, plain

Array = np.ndarray

Vector = tuple[np.float32, np.float32, np.float32]


class Ray(NamedTuple):
    """A piece of a straight line.

    Attributes
    ----------
    origin : tuple of float
        x, y and z in metres, world space, float32.
    direction : tuple of float
        World space, float32; distances count in its length.
    tnear, tfar : np.float32
        Distances between which things are met.
    mask : np.int32
        Ray mask: the ray meets groups that share a bit, see `ray_masks`.
    """

    origin: Vector
    direction: Vector
    tnear: np.float32
    tfar: np.float32
    mask: np.int32


class Rays(NamedTuple):
    """Many rays, and what all of them have in common; see `Ray`.

    Attributes
    ----------
    origins, directions : (n, 3) float32 array
    tnear, tfar : np.float32
    mask : np.int32
    """

    origins: Array
    directions: Array
    tnear: np.float32
    tfar: np.float32
    mask: np.int32

    @classmethod
    def of(cls, origins: Array, directions: Array, tnear: float, tfar: float, mask: int) -> Rays:
        """The ray for compiled code."""
        start, along = (plain(np.asarray(a, np.float32)) for a in (origins, directions))
        return cls(start, along, np.float32(tnear), np.float32(tfar), np.int32(mask))


@inlined
def ray_at(rays, i):  # type: ignore[no-untyped-def]
    """One `Ray` of many.

    Parameters
    ----------
    rays : Rays
    i : int64

    Returns
    -------
    Ray
    """
    origin = rays.origins[i, 0], rays.origins[i, 1], rays.origins[i, 2]
    direction = rays.directions[i, 0], rays.directions[i, 1], rays.directions[i, 2]
    return Ray(origin, direction, rays.tnear, rays.tfar, rays.mask)


class Hit(NamedTuple):
    """First hit of a ray: a face at (1 - u - v) v0 + u v1 + v v2.

    Attributes
    ----------
    t : np.float32
        Distance; the ray's `tfar` when nothing is hit.
    face : np.int32
        Of the scene; -1 when nothing is hit.
    instance : np.int32
        Instance index; -1 for geometry that is not instanced.
    u, v : np.float32
        Barycentric coordinates of the second and of the third corner.
    gx, gy, gz : np.float32
        Geometric normal, of any length; for `interaction.surface_at`.
    """

    t: np.float32
    face: np.int32
    instance: np.int32
    u: np.float32
    v: np.float32
    gx: np.float32
    gy: np.float32
    gz: np.float32
