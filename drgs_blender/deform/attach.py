"""Algorithm 1: surfels made from the faces of a mesh.

What the paper leaves open or gets wrong is settled here: a surfel's shape is fitted to its face (a common isotropic
scale leaves cracks in uneven meshes and bleeds over silhouettes), large faces carry several surfels, and pretrained
surfels that project to an edge are counted rather than lost in silence.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from ..core.asset.model import MATERIAL_CHANNELS, SURFEL_CHANNELS, Binding, Mesh, Surfels
from ..core.errors import AssetError
from ..geometry.distinct_rows import distinct_row_indices
from ..geometry.normals import lengths, quaternions, unit
from .binding import project
from .face_frames import Faces, product

Array = np.ndarray
log = logging.getLogger(__name__)

#: Standard deviations of a fitted surfel over those of its triangle's area: opaque inside, little bleeding outside.
SPREAD = 1.8
#: The same across a sharp edge that the surfel's piece of face ends at: alpha is half on the edge itself, where a
#: triangle's centroid is 2^(1/2) deviations away.
RIM = 1.2
#: Cosine between the normals of two faces below which their common edge is sharp (30 degrees).
SHARP = 0.866
#: Opacity of surfels made from a mesh alone.
OPAQUE = 0.99
#: Opacity where pretrained surfels were given but none is near (paper's initial value).
UNSEEN = 0.1
#: Most surfels that `density` may ask for.
MOST = 2_000_000
#: Pieces are not cut for detail below this part of the mesh's diagonal.
FINEST = 1 / 2000


@dataclass(slots=True)
class _Patches:
    """Pieces of faces, one surfel each: (n,) face and (n, 3, 3) barycentric coordinates of the three corners."""

    face: Array
    weights: Array


class Detail(Protocol):
    """What is known of a surface between the vertices of its mesh.

    Pieces are (n, 3, 3) barycentric coordinates of the corners of pieces of faces (n,).
    """

    def hidden_by(self, face: Array, pieces: Array) -> Array:
        """(n,) how much a surfel for each piece would hide; 0 where it shows all."""

    def give(self, mesh: Mesh, surfels: Surfels, binding: Binding, pieces: Array) -> None:
        """Give the surfels of pieces, one each, what is known at their places."""


def attach(
    mesh: Mesh,
    pretrained: Surfels | None = None,
    tau: float = 0.02,
    *,
    scale: Literal["fitted", "paper"] = "fitted",
    density: float = 140.0,
    spread: float = SPREAD,
    opacity: float = OPAQUE,
    detail: Detail | None = None,
    most: int = MOST,
) -> tuple[Surfels, Binding, dict[str, Any]]:
    """Make surfels on the faces of a mesh (Algorithm 1 of the paper).

    Parameters
    ----------
    mesh : Mesh
    pretrained : Surfels, optional
        Surfels whose place on the faces and whose opacity are averaged per face.
    tau : float
        A pretrained surfel counts for the face it projects to only if its smallest barycentric coordinate is larger.
    scale : {"fitted", "paper"}
        "fitted" matches the second moments of the face, and cuts faces as `density` says; "paper" is the distance to
        the nearest other face centre in both directions, one surfel per face.
    density : float
        Longest edge of a fitted surfel's piece of face, as a part of the mesh's diagonal: diagonal / density.
    spread : float
        Factor on fitted standard deviations.
    opacity : float
        Where no pretrained surfels are given.
    detail : Detail, optional
        Of the surface: pieces are cut where it wants them smaller, and surfels take from it what they show.
    most : int
        Surfels that pieces cut for `detail` may reach.

    Returns
    -------
    surfels : Surfels
        Materials are those of the mesh at the surfel's centre; the shading normal is the smooth one.
    binding : Binding
    report : dict
        "surfels", "faces", "cut_faces", "degenerate_faces" (they get no surfel); with `detail` "hidden_pieces" (which
        show less than it knows, for want of surfels; -1: `density` alone asks for more than `most`); with `pretrained`
        also "pretrained",
        "interior", "on_edges" (projected to an edge or vertex and not used), "faces_with_pretrained",
        "faces_from_neighbours", "faces_unseen".
    """
    faces = Faces.of(mesh.vertices, mesh.faces)
    proper = np.flatnonzero(~faces.degenerate)
    if not len(proper):
        raise AssetError("mesh", "has no face with an area", "Surfels are made from faces")
    report: dict[str, Any] = {"faces": len(mesh.faces), "degenerate_faces": int(faces.degenerate.sum())}

    patches = _Patches(proper, np.tile(np.eye(3), (len(proper), 1, 1)))
    if scale == "fitted":
        used = np.unique(mesh.faces[proper])
        extent = mesh.vertices[used].max(axis=0) - mesh.vertices[used].min(axis=0)
        diagonal = float(np.linalg.norm(extent))
        patches = cut(patches, faces, diagonal / density)
        if detail is not None:
            patches, left = cut_for_detail(patches, faces, detail, most, FINEST * diagonal)
            report["hidden_pieces"] = left
    n = len(patches.face)
    report["surfels"] = n
    report["cut_faces"] = int((np.bincount(patches.face) > 1).sum())
    weights = patches.weights.mean(axis=1)
    alpha = np.full(n, opacity)
    if pretrained is not None:
        weights, alpha, counts = _aggregate(mesh, faces, patches, weights, pretrained, tau)
        report |= counts

    corners = faces.corners[patches.face]
    centre = np.einsum("nk,nkc->nc", weights, corners)
    frame = _face_frames(corners, faces.normal[patches.face])
    if scale == "paper":
        deviation = _nearest_centres(faces, patches.face)
    else:
        rims = _rims(patches, corners, faces.normal[patches.face], sharp_edges(mesh, faces))
        pieces = product(patches.weights, corners)
        frame, deviation = _fit(frame, centre, pieces, spread, rims)

    at = mesh.faces[patches.face]
    mix = lambda values, most=1: np.clip(np.einsum("nk,nk...->n...", weights, values[at]), 0, most)  # noqa: E731
    optional = [name for name in SURFEL_CHANNELS if getattr(mesh, name) is not None]
    surfels = Surfels(
        centre=centre,
        scale=deviation,
        rotation=quaternions(frame),
        opacity=alpha,
        albedo=mix(mesh.albedo),
        roughness=mix(mesh.roughness),
        metallic=mix(mesh.metallic),
        **{name: mix(getattr(mesh, name), MATERIAL_CHANNELS[name].limit) for name in optional},
    )
    binding = Binding(
        face=patches.face, barycentric=weights, offset=np.zeros(n), normal=np.tile([0.0, 0.0, 1.0], (n, 1))
    )
    if detail is not None:
        detail.give(mesh, surfels, binding, patches.weights)
    log.info("attached %d surfels to %d faces", n, len(proper))
    return surfels, binding, report


def cut(patches: _Patches, faces: Faces, longest: float) -> _Patches:
    """Bisect the longest edge of every patch until none is longer than `longest`, metres."""
    done_face: list[Array] = []
    done_weights: list[Array] = []
    face, weights, total = patches.face, patches.weights, 0
    while len(face):
        length, start = _longest_edges(face, weights, faces)
        split = length > longest
        done_face.append(face[~split])
        done_weights.append(weights[~split])
        total += int((~split).sum())
        face, weights, start = face[split], weights[split], start[split]
        if total + 2 * len(face) > MOST:
            log.warning("surfel density lowered: more than %d surfels would be needed", MOST)
            done_face.append(face)
            done_weights.append(weights)
            break
        face, weights = _bisected(face, weights, start)
    face, weights = np.concatenate(done_face), np.concatenate(done_weights)
    order = np.argsort(face, kind="stable")
    return _Patches(face[order], weights[order])


def cut_for_detail(patches: _Patches, faces: Faces, detail: Detail, most: int, finest: float) -> tuple[_Patches, int]:
    """Bisect the longest edge of patches that hide detail, those that hide most first, and what comes of them.

    Parameters
    ----------
    patches : _Patches
    faces : Faces
    detail : Detail
    most : int
        Patches in the end, at most.
    finest : float
        Metres: patches without a longer edge are left as they are.

    Returns
    -------
    patches : _Patches
    left : int
        Patches that still hide some; -1 where there were too many to begin with.
    """
    face, weights = patches.face, patches.weights
    if len(face) >= most:
        return patches, -1
    hidden, (length, start) = detail.hidden_by(face, weights), _longest_edges(face, weights, faces)
    while True:
        wanted = np.flatnonzero((hidden > 0) & (length > finest))
        room = most - len(face)
        if not len(wanted) or room <= 0:
            return _Patches(face, weights), int((hidden > 0).sum())
        wanted = wanted[np.argsort(-hidden[wanted], kind="stable")[:room]]
        split = np.zeros(len(face), bool)
        split[wanted] = True
        halves = _bisected(face[split], weights[split], start[split])
        known = face, weights, hidden, length, start
        new = *halves, detail.hidden_by(*halves), *_longest_edges(*halves, faces)
        joined = [np.concatenate([old[~split], more]) for old, more in zip(known, new, strict=True)]
        order = np.argsort(joined[0], kind="stable")
        face, weights, hidden, length, start = (values[order] for values in joined)


def _longest_edges(face: Array, weights: Array, faces: Faces) -> tuple[Array, Array]:
    """Length (n,) of the longest edge of each patch, metres, and the corner from which it runs to the next one."""
    corners = product(weights, faces.corners[face])
    edges = lengths(corners[:, [1, 2, 0]] - corners)
    return edges.max(axis=1), edges.argmax(axis=1)


def _bisected(face: Array, weights: Array, start: Array) -> tuple[Array, Array]:
    """Both halves of patches, the edge of each from corner `start` to the next one cut at its middle."""
    row = np.arange(len(face))
    a, b, c = (weights[row, (start + k) % 3] for k in range(3))
    middle = 0.5 * (a + b)
    halves = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate([face, face]), halves


def _face_frames(corners: Array, normal: Array) -> Array:
    """Rotations (n, 3, 3) [t_u, t_v, normal] with t_u along the first edge (any tangent where that is a point)."""
    first = corners[:, 1] - corners[:, 0]
    short = lengths(first) < 1e-12
    first[short] = corners[short, 2] - corners[short, 0]
    tangent = unit(first)
    return np.stack([tangent, np.cross(normal, tangent), normal], -1)


def sharp_edges(mesh: Mesh, faces: Faces) -> Array:
    """(m, 3) bool: whether the edge of a face opposite its corner k is an outline, a fold or a rim.

    Vertices at one place count as one, so that hard edges whose vertices are split are judged by their angle.
    """
    place = distinct_row_indices(*mesh.vertices.T)
    corner = place[mesh.faces]
    start, end = corner[:, [1, 2, 0]], corner[:, [2, 0, 1]]
    key = np.minimum(start, end) * len(place) + np.maximum(start, end)
    edge = np.unique(key.reshape(-1), return_inverse=True)[1]
    proper = np.repeat(~faces.degenerate, 3)
    count = np.bincount(edge[proper], minlength=edge.max() + 1)
    normal = np.repeat(faces.normal, 3, axis=0)
    # Two unit normals add up to a length of 2 cos(angle / 2).
    total = np.stack([np.bincount(edge[proper], normal[proper, c], len(count)) for c in range(3)], -1)
    smooth = (count == 2) & (np.einsum("ec,ec->e", total, total) >= 2 + 2 * SHARP)
    return ~smooth[edge].reshape(-1, 3)


def _rims(patches: _Patches, corners: Array, normal: Array, sharp: Array) -> Array:
    """(n, 3, 3): unit directions across the sharp edges that a patch lies on, by the corner opposite; 0 elsewhere."""
    on = (patches.weights == 0).sum(axis=1) == 2  # bisection keeps weights on an edge exactly zero
    on &= sharp[patches.face]
    rows = np.flatnonzero(on.any(axis=1))
    along = corners[rows][:, [2, 0, 1]] - corners[rows][:, [1, 2, 0]]
    result = np.zeros(corners.shape)
    result[rows] = unit(np.cross(normal[rows, None], along)) * on[rows, :, None]
    return result


def _fit(frame: Array, centre: Array, pieces: Array, spread: float, rims: Array) -> tuple[Array, Array]:
    """Frame turned to the principal axes of each piece (n, 3, 3), and its deviations (n, 2) about `centre`.

    A triangle's covariance is the sum of its corners' outer products about the centroid over 12; a centre moved by d
    adds d d^T, so that the surfel still covers its piece. Across `rims` the spread is at most `RIM`.
    """
    less = max(0.0, 1 - RIM / spread)
    plane = frame[:, :, :2]
    middle = pieces.mean(axis=1)
    rays = product(pieces - middle[:, None], plane)
    moved = np.einsum("nc,nci->ni", middle - centre, plane)
    covariance = product(rays.swapaxes(1, 2), rays) / 12 + moved[:, :, None] * moved[:, None, :]
    for k in range(3):
        rows = np.flatnonzero(rims[:, k].any(axis=1))
        across = np.einsum("nc,nci->ni", rims[rows, k], plane[rows])
        shrink = np.eye(2) - less * across[:, :, None] * across[:, None, :]
        covariance[rows] = shrink @ covariance[rows] @ shrink
    values, axes = np.linalg.eigh(covariance)
    values, axes = values[:, ::-1], axes[:, :, ::-1]  # longest first
    axes = axes.copy()
    mirrored = axes[:, 0, 0] * axes[:, 1, 1] < axes[:, 0, 1] * axes[:, 1, 0]
    axes[mirrored, :, 1] *= -1
    axes = axes * np.where(axes[:, :1, :1] < 0, -1, 1)  # at most 90 degrees from the first edge
    turned = np.concatenate([plane @ axes, frame[:, :, 2:]], -1)
    return turned, spread * np.sqrt(np.maximum(values, 0))


def _nearest_centres(faces: Faces, face: Array) -> Array:
    """The paper's scale (n, 2): distance from the centre of each face to the nearest other one."""
    centres = faces.corners[face].mean(axis=1)
    if len(centres) == 1:
        return np.repeat(np.sqrt(faces.area[face])[:, None], 2, axis=1)
    distance = cKDTree(centres).query(centres, k=2)[0][:, 1]
    return np.repeat(np.maximum(distance, 1e-9)[:, None], 2, axis=1)


def _aggregate(
    mesh: Mesh, faces: Faces, patches: _Patches, weights: Array, pretrained: Surfels, tau: float
) -> tuple[Array, Array, dict[str, int]]:
    """Weights (n, 3) and opacity (n,) of the patches from the pretrained surfels that project inside their faces.

    Only a face that is not cut takes over the mean weights; the pieces of a cut face stay where they cover it.
    """
    finite = np.isfinite(pretrained.centre).all(axis=1)
    face, omega, _ = project(mesh, faces, pretrained.centre[finite])
    inside = omega.min(axis=1) > tau
    m = len(faces.area)
    count = np.bincount(face[inside], minlength=m)
    seen = count > 0
    alpha = np.full(m, np.nan)
    alpha[seen] = np.bincount(face[inside], pretrained.opacity[finite][inside], m)[seen] / count[seen]
    mean = np.stack([np.bincount(face[inside], omega[inside, k], m) for k in range(3)], -1)
    mean = mean / np.maximum(mean.sum(axis=1, keepdims=True), 1e-12)

    whole = np.bincount(patches.face, minlength=m)[patches.face] == 1
    take = whole & seen[patches.face]
    weights = np.where(take[:, None], mean[patches.face], weights)
    from_neighbours = _spread_to_neighbours(mesh.faces, alpha)
    unseen = np.isnan(alpha) & ~faces.degenerate
    alpha[np.isnan(alpha)] = UNSEEN
    counts = {
        "pretrained": len(pretrained),
        "not_finite": int((~finite).sum()),
        "interior": int(inside.sum()),
        "on_edges": int((~inside).sum()),
        "faces_with_pretrained": int(seen.sum()),
        "faces_from_neighbours": from_neighbours,
        "faces_unseen": int(unseen.sum()),
    }
    return weights, alpha[patches.face], counts


def _spread_to_neighbours(indices: Array, alpha: Array) -> int:
    """Fill NaN of `alpha` (m,) in place with the mean over faces that share a vertex; return how many were filled."""
    m, missing = len(alpha), np.isnan(alpha)
    touches = coo_matrix((np.ones(3 * m), (np.repeat(np.arange(m), 3), indices.reshape(-1)))).tocsr()
    total = touches @ (touches.T @ np.where(missing, 0, alpha))
    count = touches @ (touches.T @ (~missing).astype(float))
    fill = missing & (count > 0)
    alpha[fill] = total[fill] / count[fill]
    return int(fill.sum())
