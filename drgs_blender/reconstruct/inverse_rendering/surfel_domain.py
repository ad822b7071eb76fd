"""Surfels as the domain of materials: of thin things, of which a mesh makes tubes.

A pixel shows the blend of the surfels that cover most of it, those of its heaviest surface. Rays meet their sheets
(`render.surfels.sheets`) and start above them, as when the asset is rendered.
"""

from __future__ import annotations

import logging

import numpy as np
import torch
from scipy.spatial import cKDTree

from ...compute.jit import njit
from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...geometry.normals import unit
from ...render.gbuffer.surfels import WINDOW_SCALES
from ...render.reference.raster import camera_rays, pixel_centres
from ...render.scene.triangle_bvh import TriangleBVH
from ...render.surfels.sheets import sheets
from ..capture.capture import Capture, View
from ..meshing.crops import corner_of, cropped_views
from ..model.contributors import strongest
from ..model.gaussians import Gaussians
from ..model.raster import WorldSurfels
from .domain import Domain
from .pixels import Pixels, check_size, of_training_views, onto_vertices, photographed, within_mask
from .radiance_cache import edges_of, filled
from .settings import Settings

log = logging.getLogger(__name__)

#: Neighbours of a surfel along which its materials are smooth, and the least cosine between their planes.
_NEIGHBOURS, _COPLANAR = 6, 0.5
#: Surfels that a pixel shows, at most, and how much of it all surfels cover, at least.
_MOST, _COVERED = 16, 0.9


def surfel_domain(capture: Capture, gaussians: Gaussians, settings: Settings) -> Domain:
    """Surfels that stay as they are.

    Parameters
    ----------
    capture : Capture
    gaussians : Gaussians
        On the CPU.
    settings : Settings

    Raises
    ------
    UsageError
        As of `pixels.of_training_views`; a picture and its camera of different sizes.
    """
    centres, opacities = (x.numpy(force=True) for x in (gaussians.centres(), gaussians.opacities()))
    u, v, normals = gaussians.frames()
    vertices, faces = sheets(centres, u, v, opacities)
    blank = np.zeros(len(vertices), np.float32)
    occluder = Mesh(vertices, faces, np.zeros_like(vertices), blank, blank)
    scale = np.sqrt(np.maximum((u * u).sum(1), (v * v).sum(1)))
    parts = cropped_views(capture.training, vertices)
    shown = WorldSurfels(*(np.ascontiguousarray(a, np.float32) for a in (centres, u, v, opacities)))
    pixels = of_training_views(
        capture, settings, lambda k, view: _surfel_pixels(k, view, parts[k], shown, normals, scale)
    )
    owner = np.repeat(np.arange(len(centres)), len(vertices) // max(len(centres), 1))
    edges = neighbours(centres, normals)
    tree = TriangleBVH(vertices, faces)
    return Domain(centres, normals.astype(np.float32), edges, pixels, occluder, tree, owner, gaussians)


def carried(values: Array, mesh: Mesh, gaussians: Gaussians, views: list[View]) -> tuple[Array, Array]:
    """Values (v, c) in [0, 1] of a mesh's vertices, means of what views show of the surfels', and who is seen (v,)."""
    columns = torch.from_numpy(np.asarray(values, np.float32))

    def shown(view: View) -> Array:
        with torch.no_grad():
            rendered = gaussians.render(view.camera, torch.zeros(3), 0, reflections=False, materials=columns)
        assert rendered.materials is not None
        return torch.cat([rendered.materials, rendered.maps.alpha[..., None]], 2).numpy()

    total = onto_vertices(mesh, views, shown)
    seen = total[:, -1] > 1e-3
    if not seen.any():  # as of rods of two pixels: a pixel away from the outline nothing is left
        log.warning("no photograph shows the mesh of the surfels: it takes the materials of the nearest")
        return columns.numpy()[cKDTree(gaussians.centres().numpy(force=True)).query(mesh.vertices)[1]], seen
    return np.clip(filled(total[:, :-1] / np.maximum(total[:, -1:], 1e-9), seen, edges_of(mesh.faces)), 0, 1), seen


def neighbours(centres: Array, normals: Array) -> Array:
    """Pairs (e, 2) of surfels that lie side by side on one surface, each once."""
    _, near = cKDTree(centres).query(centres, min(_NEIGHBOURS + 1, len(centres)))
    near = near.reshape(len(centres), -1)
    pairs = np.stack([np.repeat(np.arange(len(centres)), near.shape[1]), near.ravel()], 1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    coplanar = np.abs(np.einsum("nc,nc->n", normals[pairs[:, 0]], normals[pairs[:, 1]])) > _COPLANAR
    return np.unique(np.sort(pairs[coplanar], axis=1), axis=0).astype(np.int64)


@njit
def _keep_heaviest(weight, depth, size):  # type: ignore[no-untyped-def]
    """Of the heaviest surface alone, as when the asset is rendered: others would be lit in between.

    Sets the weights (n, k) of what is farther than `size` from the depth at which most weight is to 0, in place.
    """
    for pixel in range(len(weight)):
        place, most = 0, np.float32(-1.0)
        for i in range(weight.shape[1]):
            total = np.float32(0.0)
            for j in range(weight.shape[1]):
                if abs(depth[pixel, i] - depth[pixel, j]) <= size[pixel, i]:
                    total += weight[pixel, j]
            if total > most:
                place, most = i, total
        for j in range(weight.shape[1]):
            if abs(depth[pixel, place] - depth[pixel, j]) > size[pixel, place]:
                weight[pixel, j] = 0


def _surfel_pixels(number: int, view: View, part: View, surfels: WorldSurfels, axes: Array, scale: Array) -> Pixels:
    """The pixels of the view `number` that show surfels, found in its cropped `part`.

    `axes` (n, 3) and `scale` (n,) are the surfels' normals and larger standard deviations.
    """
    check_size(view)
    camera = part.camera
    index, weight, depth = strongest(surfels, camera, _MOST)
    alpha = weight.sum(axis=-1)
    # Surfels of few steps may cover nothing whole.
    seen = (alpha > min(_COVERED, _COVERED * float(alpha.max()))) & within_mask(part)
    row = np.flatnonzero(seen)
    index, weight, depth = (array.reshape(-1, _MOST)[row] for array in (index, weight, depth))
    size = WINDOW_SCALES * scale[index]
    _keep_heaviest(weight, depth, size)
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    origin, direction = (a.numpy().astype(np.float32)[row] for a in camera_rays(camera, pixel_centres(camera)))
    towards = -direction / np.linalg.norm(direction, axis=1, keepdims=True)
    own = axes[index]
    facing = np.sign(np.einsum("nkc,nc->nk", own, towards))
    normal = unit(np.einsum("nk,nkc->nc", share * facing, own), (0, 0, 0)).astype(np.float32)
    place = origin + (share * depth).sum(axis=1, keepdims=True) * direction  # of unit depth
    left, top = corner_of(camera, view.camera)
    y, x = np.divmod(row, camera.width)
    found = Pixels(
        np.full(len(row), number, np.int32),
        ((y + top) * view.camera.width + x + left).astype(np.int32),
        index,
        share,
        (place + (share * size).sum(axis=1, keepdims=True) * normal).astype(np.float32),
        normal,
        towards,
        *photographed(part, seen, row),
    )
    return found.select(found.usable())
