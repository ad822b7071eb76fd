"""Normal integration: vertices move along their own normals until the surface has the learned normals.

Normals are better than positions where it is fine, positions where it is coarse (Nehab et al. 2005, "Efficiently
combining positions and normals for precise 3D geometry"). A mesh that has its normals by its vertices keeps them
through everything that bends it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

from ...core.arrays import Array
from ...core.asset.model import Binding, Mesh
from ...deform.binding import clamp_weights
from ...deform.face_frames import Faces, dot, shading_frames
from ...geometry.normals import VertexNormals, unit
from ..inverse_rendering.radiance_cache import edges_of

#: Weight of the positions against the slopes of edges.
HOLD = 0.02
#: Shorter edges count as this long, mean edges.
SHORTEST = 0.1
#: Farthest that a vertex may move, mean edges; least cosine between a face before and after.
FARTHEST, LEAST_COSINE = 1.5, 0.5


def follow_normals(mesh: Mesh, normals: Array, hold: float = HOLD) -> Array:
    """Vertices of `mesh` moved so that its smooth vertex normals become `normals`.

    What the present normals lack is integrated over the surface, so that nothing moves where they lack nothing.

    Parameters
    ----------
    mesh : Mesh
    normals : (v, 3) array
        Unit, of the vertices.
    hold : float
        Weight of the positions.

    Returns
    -------
    (v, 3) float32 array
        Where a face would turn by more than 60 degrees, the vertices stay.
    """
    old, faces = mesh.vertices.astype(np.float64), mesh.faces
    before = Faces.of(old, faces)
    edge = float(before.mean_edge.mean())
    pairs = edges_of(faces)
    i, j = pairs.T
    row = np.arange(len(pairs))
    place = (np.tile(row, 2), np.concatenate([i, j]))
    along = VertexNormals(faces, len(old))(mesh.vertices).astype(np.float64)
    lacking = normals - along
    # A height d over the surface tilts its normals by -grad d: d is integrated along the edges, in slopes. Edges that
    # hardly have a length have no slope.
    across = old[i] - old[j]
    length = np.maximum(np.linalg.norm(across, axis=1), SHORTEST * edge)
    rise = -dot(0.5 * (lacking[i] + lacking[j]), across) / length
    slopes = coo_matrix((np.concatenate([1 / length, -1 / length]), place), (len(row), len(old))).tocsr()
    system = slopes.T @ slopes + diags(np.full(len(old), hold / edge**2))
    height, _ = cg(system, slopes.T @ rise, maxiter=1000, M=diags(1 / system.diagonal()))
    return _within(old + height[:, None] * along, old, before, faces, FARTHEST * edge).astype(np.float32)


def _within(vertices: Array, old: Array, before: Faces, faces: Array, reach: float) -> Array:
    """`vertices` no farther than `reach` from the `old` ones, and back there where faces would turn over."""
    step = vertices - old
    step *= np.minimum(1, reach / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-30))
    for factor in (*[0.5] * 8, 0.0):
        after = Faces.of(old + step, faces)
        turned = (dot(after.normal, before.normal) < LEAST_COSINE) | after.degenerate
        turned &= ~before.degenerate
        if not turned.any():
            break
        step[np.unique(faces[turned])] *= factor
    return old + step


def shaded_by(binding: Binding, mesh: Mesh, normals: Array) -> Binding:
    """`binding` with shading normals (n, 3) of the surfels, object space, of any length."""
    return _shaded(binding, mesh, Faces.of(mesh.vertices, mesh.faces), normals)


def shaded_by_own(binding: Binding, mesh: Mesh, own: Array) -> Binding:
    """`binding` with the surfels' own normals (n, 3), on the side of their faces."""
    faces = Faces.of(mesh.vertices, mesh.faces)
    return _shaded(binding, mesh, faces, np.where(dot(own, faces.normal[binding.face])[:, None] < 0, -own, own))


def blended(binding: Binding, mesh: Mesh, values: Array) -> Array:
    """(n, ...) where surfels hang, of `values` (v, ...) of the vertices."""
    return np.einsum("nk,nk...->n...", clamp_weights(binding.barycentric), values[mesh.faces[binding.face]])


def _shaded(binding: Binding, mesh: Mesh, faces: Faces, normals: Array) -> Binding:
    """`binding` with `normals` (n, 3) of the surfels, object space, of any length."""
    weights = clamp_weights(binding.barycentric)
    frames = shading_frames(faces, mesh.faces, mesh.vertices, binding.face, weights)
    return replace(binding, normal=np.einsum("nij,ni->nj", frames, unit(normals)))
