"""Binding: which point of which face each existing surfel follows.

See `asset.model.Binding` for what is stored. `attach` (in `deform.attach`) makes surfels from the faces instead.
"""

from __future__ import annotations

import logging
from typing import Any

import igl
import numpy as np
from scipy.spatial import cKDTree

from ..core.asset.model import Binding, Mesh, Surfels
from ..core.errors import AssetError
from ..geometry.normals import rotation_matrices
from .face_frames import Faces, dot, shading_frames

Array = np.ndarray
log = logging.getLogger(__name__)

#: Faces looked at beyond the nearest one when a surfel faces the other way.
CANDIDATES = 16
#: Largest barycentric weight of a centre that lies beside its face; farther out that of the best face around, up to
#: `FARTHEST`.
REACH, FARTHEST = 4.0, 100.0
#: Normals of a capture are trusted when at least this part of the surfels agrees with the nearest face.
TRUST = 0.7
#: Cosine to its face below which a surfel's normal is noise: the axis a flattened splat lost was not its normal.
CREDIBLE = 0.5


def project(mesh: Mesh, faces: Faces, points: Array) -> tuple[Array, Array, Array]:
    """Closest points of the proper faces of `mesh`.

    Parameters
    ----------
    mesh : Mesh
    faces : Faces
    points : (n, 3) array
        Finite, object space.

    Returns
    -------
    face : (n,) int64 array
    barycentric : (n, 3) float64 array
        Clamped to the face, sums to 1.
    distance : (n,) float64 array
        Metres.
    """
    proper = np.flatnonzero(~faces.degenerate)
    if not len(proper):
        raise AssetError("mesh", "has no face with an area", "Surfels can only hang on a surface")
    square, hit, closest = igl.point_mesh_squared_distance(
        np.asarray(points, np.float64), mesh.vertices.astype(np.float64), mesh.faces[proper].astype(np.int64)
    )
    face = proper[hit]
    return face, clamp_weights(barycentric(faces.corners[face], closest)), np.sqrt(np.maximum(square, 0))


def barycentric(corners: Array, points: Array) -> Array:
    """Barycentric coordinates (n, 3) of `points` (n, 3), projected onto the planes of triangles (n, 3, 3)."""
    e1, e2, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    a, b, c, d, e = dot(e1, e1), dot(e1, e2), dot(e2, e2), dot(p, e1), dot(p, e2)
    determinant = a * c - b * b
    v, w = (c * d - b * e) / determinant, (a * e - b * d) / determinant
    return np.stack([1 - v - w, v, w], -1)


def clamp_weights(weights: Array) -> Array:
    """Barycentric weights (n, 3) without negative ones, summing to 1."""
    weights = np.clip(weights, 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def bind(mesh: Mesh, surfels: Surfels) -> tuple[Binding, dict[str, Any]]:
    """Hang existing surfels on the nearest faces, keeping where they are and how they are shaded.

    On thin walls the nearest face may be the one on the other side. Where the normals of the capture can be trusted
    (most agree with the nearest face) a surfel that faces away from its face moves to a nearby face of its own
    direction. Any that still disagrees is shaded with its normal flipped outwards; surfels have no inside. A normal
    more than 60 degrees off its face is not believed: such a surfel is shaded with the smooth normal of the mesh.

    Returns
    -------
    binding : Binding
    report : dict
        "surfels", "flipped" (normal turned outwards), "unsure_normals" (the mesh's are used),
        "other_side" (moved to a farther face of the same direction),
        "normals_agree" (part of the surfels, 0..1), "distance_median", "distance_max" (metres), "far" (farther than
        two mean edges from the mesh), "beside" (far beside the nearest face, and carried by the one around that has the
        smallest weights), "snapped" (moved because they lie too far beside any), "degenerate_faces".

    Examples
    --------
    A surfel a tenth of a metre above a triangle:

    >>> from drgs_blender.core.asset.model import Mesh, Surfels
    >>> mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], [[0.5] * 3] * 3, [1] * 3, [0] * 3)
    >>> surfels = Surfels([[0.5, 0.25, 0.1]], [[0.1, 0.1]], [[1, 0, 0, 0]], [1], [[0.5, 0.5, 0.5]], [1], [0])
    >>> binding, report = bind(mesh, surfels)
    >>> binding.face, binding.barycentric
    (array([0], dtype=int32), array([[0.25, 0.5 , 0.25]], dtype=float32))
    >>> mean_edge = (1 + 1 + 2**0.5) / 3
    >>> (binding.offset * mean_edge).round(3)
    array([0.1], dtype=float32)
    """
    if not len(surfels):
        raise AssetError("surfels", "are none", "Bind needs at least one surfel")
    bad = int((~np.isfinite(surfels.centre).all(axis=1)).sum())
    if bad:
        raise AssetError("surfels", f"have {bad} centres that are not finite", "Import drops them; bind what it made")
    faces = Faces.of(mesh.vertices, mesh.faces)
    face, weights, distance = project(mesh, faces, surfels.centre)
    normal = rotation_matrices(surfels.rotation.astype(np.float64))[..., 2]
    agreement = dot(normal, faces.normal[face])
    agree = float((agreement > 0).mean())
    moved = np.zeros(len(surfels), bool)
    if agree >= TRUST:
        moved = _prefer_own_side(faces, surfels.centre.astype(np.float64), normal, agreement, face, weights, distance)
        agreement = dot(normal, faces.normal[face])
    flipped = agreement < 0
    normal = np.where(flipped[:, None], -normal, normal)
    unsure = np.abs(agreement) < CREDIBLE

    # A centre beyond the rim of its face keeps its place through weights that leave 0..1. Far out, or on a sliver,
    # they magnify every motion of the face: then the face around that has the smallest ones carries it.
    free = barycentric(faces.corners[face], surfels.centre.astype(np.float64))
    beside = np.flatnonzero(~(np.abs(free).max(axis=1) <= REACH))
    if len(beside):
        face[beside], free[beside] = _least_magnified(faces, surfels.centre[beside].astype(np.float64), face[beside])
        agreement = dot(normal, faces.normal[face])
        weights[beside] = clamp_weights(free[beside])
    snapped = ~(np.abs(free).max(axis=1) <= FARTHEST)
    corners = faces.corners[face]
    height = dot(surfels.centre - corners[:, 0], faces.normal[face])
    frames = shading_frames(faces, mesh.faces, mesh.vertices, face, weights)
    weights = np.where(snapped[:, None], weights, free)
    binding = Binding(
        face=face,
        barycentric=weights,
        offset=height / faces.mean_edge[face],
        normal=np.where(unsure[:, None], (0.0, 0.0, 1.0), np.einsum("nij,ni->nj", frames, normal)),
    )
    report = {
        "surfels": len(surfels),
        "flipped": int(flipped.sum()),
        "unsure_normals": int(unsure.sum()),
        "other_side": int(moved.sum()),
        "normals_agree": agree,
        "distance_median": float(np.median(distance)),
        "distance_max": float(distance.max()),
        "far": int((distance > 2 * faces.mean_edge[face]).sum()),
        "beside": len(beside),
        "snapped": int(snapped.sum()),
        "degenerate_faces": int(faces.degenerate.sum()),
    }
    log.info("bound %d surfels to %d faces: %s", len(surfels), len(mesh.faces), report)
    return binding, report


def _least_magnified(faces: Faces, centre: Array, face: Array) -> tuple[Array, Array]:
    """Of the faces around each one of `face` (n,) that whose weights for `centre` (n, 3) are smallest; the weights."""
    proper = np.flatnonzero(~faces.degenerate)
    middles = faces.corners.mean(axis=1)
    _, near = cKDTree(middles[proper]).query(middles[face], k=min(CANDIDATES, len(proper)))
    near = np.column_stack([face, proper[near.reshape(len(face), -1)]])
    weights = barycentric(faces.corners[near].reshape(-1, 3, 3), np.repeat(centre, near.shape[1], axis=0))
    largest = np.nan_to_num(np.abs(weights).max(axis=1), nan=np.inf).reshape(near.shape)
    best = largest.argmin(axis=1)
    rows = np.arange(len(face))
    return near[rows, best], weights.reshape(*near.shape, 3)[rows, best]


def _prefer_own_side(
    faces: Faces, centre: Array, normal: Array, agreement: Array, face: Array, weights: Array, distance: Array
) -> Array:
    """Move surfels that face away from their face to a near face of their direction; edit in place, return which."""
    moved = np.zeros(len(centre), bool)
    wrong = np.flatnonzero(agreement < 0)
    if not len(wrong):
        return moved
    proper = np.flatnonzero(~faces.degenerate)
    tree = cKDTree(faces.corners[proper].mean(axis=1))
    _, near = tree.query(centre[wrong], k=min(CANDIDATES, len(proper)))
    near = proper[near.reshape(len(wrong), -1)]
    same = np.einsum("nc,nkc->nk", normal[wrong], faces.normal[near]) > 0.3
    row, column = np.nonzero(same)
    surfel, candidate = wrong[row], near[row, column]
    closest = closest_on_triangles(faces.corners[candidate], centre[surfel])
    gap = np.linalg.norm(closest - centre[surfel], axis=1)
    near_enough = gap <= np.maximum(2 * distance[surfel], 1.5 * faces.mean_edge[candidate])
    surfel, candidate, gap, closest = (x[near_enough] for x in (surfel, candidate, gap, closest))
    order = np.lexsort((candidate, gap, surfel))
    surfel, first = np.unique(surfel[order], return_index=True)
    pick = order[first]
    face[surfel], distance[surfel] = candidate[pick], gap[pick]
    weights[surfel] = barycentric(faces.corners[candidate[pick]], closest[pick])
    moved[surfel] = True
    return moved


def closest_on_triangles(corners: Array, points: Array) -> Array:
    """Closest point (n, 3) of each triangle (n, 3, 3) to its own point (n, 3).

    The foot in the plane where it lies inside the triangle, else the best of the closest points of the three edges.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = dot(normal, normal)
    height = dot(points - a, normal) / np.where(square > 0, square, 1)
    best = points - height[:, None] * normal
    inside = square > 0
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= dot(np.cross(q - p, best - p), normal) >= 0
    distance = np.where(inside, 0, np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        along = dot(points - p, q - p)
        length = dot(q - p, q - p)
        part = np.clip(along / np.where(length > 0, length, 1), 0, 1)
        candidate = p + part[:, None] * (q - p)
        gap = np.linalg.norm(candidate - points, axis=1)
        better = gap < distance
        best[better], distance[better] = candidate[better], gap[better]
    return best
