"""Light on a mesh for programs that cannot compute it: at its vertices, or in the texels of its UV map."""

from __future__ import annotations

import numpy as np

from ..compute.jit import njit
from ..core.errors import UsageError
from ..geometry.normals import VertexNormals
from ..render.scene.trace_scene import TraceObject
from ..render.shading_points import ShadingPoints
from .relit import points_along

Array = np.ndarray

#: Texels by which what is baked goes on beyond its edges, so that filtered lookups find nothing else.
MARGIN = 16


def vertex_points(mesh: TraceObject) -> ShadingPoints:
    """The vertices of a posed mesh, seen along their normals; world space."""
    normal = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    return points_along(mesh.vertices, normal, normal, mesh.albedo, mesh.roughness, mesh.metallic)


def texel_points(mesh: TraceObject, uvs: Array, size: int) -> tuple[ShadingPoints, Array]:
    """The centres of the texels that a UV map covers, on the posed mesh, seen along its normals.

    Parameters
    ----------
    mesh : TraceObject
    uvs : (m, 3, 2) array
        Of the corners of the mesh's faces; v = 0 is the bottom edge of the image, which repeats.
    size : int
        Texels along a side.

    Returns
    -------
    points : ShadingPoints
    texel : (n,) int64 array
        The texel of each, into size * size, row 0 at the top.

    Raises
    ------
    UsageError
        The UV map covers no texel.
    """
    face = np.full(size * size, -1, np.int32)
    weights = np.zeros((size * size, 3), np.float32)
    _cover(np.ascontiguousarray(uvs, np.float64), size, face, weights)
    texel = np.flatnonzero(face >= 0)
    if not len(texel):
        raise UsageError(
            f"object {mesh.name}", "has a UV map that covers no texel", "Unwrap it, or make the image larger"
        )
    corners, share = mesh.faces[face[texel]], weights[texel]

    def mean(values: Array) -> Array:
        return np.einsum("nk,nk...->n...", share, values[corners])

    edges = mesh.vertices[corners].astype(np.float64)
    geometric = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    smooth = mean(VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices))
    normal, geometric = _unit(smooth, geometric), _unit(geometric, smooth)
    origin = mean(mesh.vertices)
    return points_along(origin, normal, geometric, mean(mesh.albedo), mean(mesh.roughness), mean(mesh.metallic)), texel


def picture(colours: Array, texel: Array, size: int) -> Array:
    """(size, size, 4) float32 image of the `colours` (n, 3) of texels; their margin has the nearest one's, alpha 1."""
    from scipy.ndimage import distance_transform_edt

    pixels = np.zeros((size, size, 4), np.float32)
    flat = pixels.reshape(-1, 4)
    flat[texel, :3], flat[texel, 3] = colours, 1
    distance, (rows, columns) = distance_transform_edt(pixels[..., 3] == 0, return_indices=True)
    return np.where((distance <= MARGIN)[..., None], pixels[rows, columns], 0).astype(np.float32)


def _unit(vectors: Array, other: Array) -> Array:
    """Unit vectors; those of `other` where there are none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors = np.where(length > 1e-30, vectors, other)
    return (vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)).astype(np.float32)


@njit
def _cover(uvs, size, face, weights):  # type: ignore[no-untyped-def]
    """Find the face under the centre of every texel, the first of several, and where on it the centre lies."""
    for f in range(len(uvs)):
        ax, ay = uvs[f, 0, 0] * size, (1.0 - uvs[f, 0, 1]) * size
        bx, by = uvs[f, 1, 0] * size - ax, (1.0 - uvs[f, 1, 1]) * size - ay
        cx, cy = uvs[f, 2, 0] * size - ax, (1.0 - uvs[f, 2, 1]) * size - ay
        area = bx * cy - by * cx
        reach = max(abs(bx), abs(by), abs(cx), abs(cy), abs(ax), abs(ay))
        if area == 0.0 or not reach < 64.0 * size:  # nothing, not finite, or repeated without end
            continue
        left, right = ax + min(0.0, bx, cx), ax + max(0.0, bx, cx)
        top, bottom = ay + min(0.0, by, cy), ay + max(0.0, by, cy)
        for y in range(int(np.ceil(top - 0.5)), int(np.floor(bottom - 0.5)) + 1):
            for x in range(int(np.ceil(left - 0.5)), int(np.floor(right - 0.5)) + 1):
                px, py = x + 0.5 - ax, y + 0.5 - ay
                b, c = (px * cy - py * cx) / area, (bx * py - by * px) / area
                if b < -1e-9 or c < -1e-9 or b + c > 1.0 + 1e-9:
                    continue
                i = (y % size) * size + x % size
                if face[i] < 0:
                    face[i] = f
                    weights[i, 0], weights[i, 1], weights[i, 2] = 1.0 - b - c, b, c
