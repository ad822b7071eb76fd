"""The mesh made to fill the masks: vertices move along their normals until its outlines are those of the photographs.

Surfels that look right together are a layer about a pixel thick, and its outermost ones draw the outline. Its median
lies inside by a quarter of a pixel, and the smoothed field of `tsdf` by another sixth, because many views that see past
a convex surface make the field steeper outside. The masks say by how much, wherever an outline passes.
"""

from __future__ import annotations

import logging

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, uniform_filter
from scipy.sparse import diags
from scipy.sparse.linalg import cg

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...core.frame import Camera
from ...geometry.normals import VertexNormals
from ...render.scene.triangle_bvh import TriangleBVH
from ..capture.training_views import pixel_rays
from ..inverse_rendering.radiance_cache import adjacency, edges_of
from .visual_hull import world_to_pixel

log = logging.getLogger(__name__)

#: Half width of the band around the mesh's outlines in which pictures are compared, and side of the square over which
#: they are, pixels. What is farther away is no error of a surface but a part that one of both lacks.
BAND, WINDOW = 2, 7
#: A vertex at an outline is seen at a smaller cosine.
RIM = 0.15
#: Weights of the differences between neighbours, and of the mean of all where no outline passes, against one sight.
SMOOTH, HOLD = 30.0, 0.05
#: Farthest that vertices move, pixels.
FARTHEST = 1.5
ROUNDS = 3
#: Rays along the side of a pixel in the band.
FINE = 3


def fill_silhouettes(mesh: Mesh, cameras: list[Camera], masks: list[Array], rounds: int = ROUNDS) -> Array:
    """Vertices of `mesh`, moved so that `cameras` see it where the `masks` are.

    Parameters
    ----------
    mesh : Mesh
    cameras : list of Camera
        Perspective.
    masks : list of array
        (h, w) float32 each, coverage in 0..1.
    rounds : int

    Returns
    -------
    (v, 3) float32 array
        Those of `mesh` where no outline is seen.
    """
    matrices = [world_to_pixel(camera) for camera in cameras]
    near = adjacency(edges_of(mesh.faces), len(mesh.vertices))
    spread = SMOOTH * (diags(np.asarray(near.sum(axis=1)).ravel()) - near)
    normals = VertexNormals(mesh.faces, len(mesh.vertices))
    tree = TriangleBVH()
    vertices, height = mesh.vertices.astype(np.float64), np.zeros(len(mesh.vertices))
    for _ in range(rounds):
        moved = vertices
        along = normals(moved.astype(np.float32)).astype(np.float64)
        tree.build(moved.astype(np.float32), mesh.faces)
        total, sights, size = np.zeros(len(moved)), np.zeros(len(moved)), []
        for camera, matrix, mask in zip(cameras, matrices, masks, strict=True):
            row, gap, away = _lacking(moved, along, tree, camera, matrix, mask)
            total[row] += gap * away / camera.fx
            sights[row] += 1
            size.append(away / camera.fx)
        if not sights.any():
            return mesh.vertices
        mean = total.sum() / sights.sum()
        system = spread + diags(sights + HOLD)
        step, _ = cg(system, total + HOLD * mean, x0=np.full(len(moved), mean), rtol=1e-4, maxiter=500)
        most = FARTHEST * float(np.median(np.concatenate(size)))
        step = np.clip(height + step, -most, most) - height
        height += step
        vertices = moved + step[:, None] * along
    log.info("mesh moved outwards by %.3g on average to fill the masks", float(height.mean()))
    return vertices.astype(np.float32)


def _lacking(
    vertices: Array, along: Array, tree: TriangleBVH, camera: Camera, matrix: Array, mask: Array
) -> tuple[Array, Array, Array]:
    """Vertices at the outline that `camera` sees: their indices, how many pixels they lack outwards, their depth."""
    eye = np.asarray(camera.matrix_world)[:3, 3].astype(np.float32)
    position = vertices @ matrix[:, :3].T + matrix[:, 3]
    away = position[:, 2]
    x, y = (np.floor(position[:, k] / np.maximum(away, 1e-9)).astype(int) for k in (0, 1))
    shown = (away > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    if not shown.any():
        return np.zeros(0, int), np.zeros(0, np.float32), np.zeros(0)
    left, top, around = _around(x[shown], y[shown])
    rays = pixel_rays(camera).numpy()[around]
    seen = _coverage(tree, camera, eye, rays) > 0.5
    band = binary_dilation(seen, iterations=BAND) & ~binary_erosion(seen, iterations=BAND, border_value=1)
    outline = uniform_filter(band.astype(np.float32), WINDOW) / (2 * BAND)
    gap = np.zeros(seen.shape, np.float32)
    gap[band] = mask[around][band] - _coverage(tree, camera, eye, rays[band], FINE)
    gap = uniform_filter(gap, WINDOW)
    towards = eye - vertices
    cosine = np.abs((towards * along).sum(1)) / np.linalg.norm(towards, axis=1)
    row = np.flatnonzero((cosine < RIM) & shown)
    row = row[band[y[row] - top, x[row] - left]]
    at = y[row] - top, x[row] - left
    return row, gap[at] / outline[at], away[row]


def _around(x: Array, y: Array) -> tuple[int, int, tuple[slice, slice]]:
    """First column and row of the part of the picture that outlines of what covers pixels (x, y) can reach; the part.

    Slices may go beyond the picture's end.
    """
    margin = BAND + WINDOW
    left, top = max(int(x.min()) - margin, 0), max(int(y.min()) - margin, 0)
    return left, top, np.s_[top : int(y.max()) + margin + 1, left : int(x.max()) + margin + 1]


def _coverage(tree: TriangleBVH, camera: Camera, eye: Array, rays: Array, fine: int = 1) -> Array:
    """(...) part of each pixel with its centre on `rays` (..., 3), of unit depth, that the mesh covers."""
    right, up = np.asarray(camera.matrix_world, np.float32)[:3, :2].T
    step = (np.arange(fine, dtype=np.float32) + 0.5) / fine - 0.5
    total = np.zeros(rays.shape[:-1], np.float32)
    for x in step:
        for y in step:
            aimed = (rays + x / camera.fx * right + y / camera.fy * up).reshape(-1, 3).astype(np.float32)
            face = tree.intersect(np.tile(eye, (len(aimed), 1)), aimed)[1]
            total += (face >= 0).reshape(total.shape)
    return total / fine**2
