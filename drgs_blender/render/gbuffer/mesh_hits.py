"""First hits of meshes by camera rays: the arrays, and how a hit is written into them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...compute.jit import njit

Array = np.ndarray

#: Samples or points of a block: whole packets of `camera_packets`.
BLOCK = 256


@dataclass(slots=True)
class MeshHits:
    """First hits of meshes by camera rays through the sub-pixel samples of some rows.

    Attributes
    ----------
    depth : (rows, width, subpixels) float32 array
        Metres along the view axis.
    owner : (rows, width, subpixels) int32 array
        Object, or -1 where nothing is met; the other arrays are undefined there.
    face, instance : (rows, width, subpixels) int32 array
    where : (rows, width, subpixels, 5) float32 array
        The hit's u and v, and its geometric normal as `surface_at` wants it.
    """

    depth: Array
    owner: Array
    face: Array
    instance: Array
    where: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All of them."""
        return self.depth, self.owner, self.face, self.instance, self.where


@njit
def put_hit(at, hit, owners, out):  # type: ignore[no-untyped-def]
    """Write what a sample's ray meets.

    Parameters
    ----------
    at : tuple of int64
        Row, column and number of the sample.
    hit : Hit
    owners, out : tuple
        As of `camera_hits.trace_samples`.

    Returns
    -------
    int32
        The object, or -1.
    """
    y, x, k = at
    face_object, instance_object = owners
    depth, owner, face, instance, where = out
    depth[y, x, k], face[y, x, k], instance[y, x, k] = hit.t, hit.face, hit.instance
    where[y, x, k, 0], where[y, x, k, 1] = hit.u, hit.v
    where[y, x, k, 2], where[y, x, k, 3], where[y, x, k, 4] = hit.gx, hit.gy, hit.gz
    who = np.int32(-1)
    if hit.face >= 0 and hit.instance >= 0:
        who = instance_object[hit.instance]
    elif hit.face >= 0:
        who = face_object[hit.face]
    owner[y, x, k] = who
    return who
