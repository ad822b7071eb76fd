"""A closed mesh made from surfels alone: depth maps from all around, fused into a signed distance field (TSDF).

Space that is never seen is inside. Surfels do not say reliably which way they face, so this is found first: a surfel
faces the directions from which it is seen. Back sides, seen through holes of an open capture, then carve nothing.
(Curless and Levoy 1996, "A volumetric method for building complex models from range images".)
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..core.asset.model import Mesh, PosedSurfels, Surfels
from ..core.errors import AssetError
from ..core.frame import Camera, RenderSettings
from ..formats.axes import scaled_surfels
from ..formats.mesh import check_extent
from ..geometry.normals import rotation_matrices
from ..geometry.tsdf import DepthMaps, SignedDistanceField
from ..render.camera import camera_parameters
from ..render.surfel_columns import NORMAL
from ..render.surfels.raster import rasterise
from ..render.surfels.splats import prepare

Array = np.ndarray
log = logging.getLogger(__name__)

#: Views that must see a voxel before it counts as seen.
WITNESSES = 3
#: Standard deviation of the smoothing of the field, voxels.
SMOOTH = 0.7
#: Surfels fainter than this do not shape the mesh.
FAINT = 0.05
#: Sizes in metres at which cameras are set up around surfels; others are scaled for it.
SIZES = 0.01, 1e5


def mesh_from_surfels(
    surfels: Surfels, name: str = "surfels", *, resolution: int = 192, views: int = 64
) -> tuple[Mesh, dict[str, Any]]:
    """Build a watertight mesh around surfels.

    Parameters
    ----------
    surfels : Surfels
        Object space.
    name : str
        For messages.
    resolution : int
        Voxels along the longest side.
    views : int
        Orthographic depth maps, spread evenly over the sphere.

    Returns
    -------
    mesh : Mesh
        Counter-clockwise seen from outside; materials are neutral.
    report : dict
        "resolution", "voxel" (metres), "components_dropped", "volume" (cubic metres), "vertices", "faces".
    """
    low, high = _bounds(surfels, name)
    check_extent(np.stack([low, high]), name)
    size = float((high - low).max())
    if not SIZES[0] <= size <= SIZES[1]:
        mesh, report = mesh_from_surfels(scaled_surfels(surfels, 1 / size), name, resolution=resolution, views=views)
        mesh.vertices = mesh.vertices * np.float32(size)
        return mesh, report | {"voxel": report["voxel"] * size, "volume": report["volume"] * size**3}
    posed = _as_posed(surfels)
    voxel = float((high - low).max()) / resolution
    low, high = low - 4 * voxel, high + 4 * voxel
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel) + 1)
    cameras = [_camera(direction, low, high, voxel) for direction in _directions(views)]

    covered, seen = [], np.zeros((len(posed), 3))
    for camera, direction in zip(cameras, _directions(views)):
        pixels = _rasterise(posed, camera, direction)
        depth, _ = pixels.maps(camera)
        seen += _visible(posed.centre, surfels.scale.max(axis=1), camera, depth, voxel)[:, None] * direction
        covered.append(pixels)
    outward = np.where((np.einsum("nc,nc->n", seen, posed.normal) < 0)[:, None], -posed.normal, posed.normal)
    known = seen.any(axis=1)  # others, large ones whose centre is hidden, may face either way

    field = SignedDistanceField(low, voxel, shape)
    for camera, direction, pixels in zip(cameras, _directions(views), covered):
        back = known & (outward @ direction <= 0)
        pixels.cosine[back[pixels.surfel]] = 0  # says nothing about what is before it
        field.add(_depth_maps(camera, *pixels.maps(camera)))
    mesh, report = field.mesh(WITNESSES, SMOOTH, "Give the mesh that they were captured with", name)
    report = {"resolution": resolution} | report
    log.info("mesh from surfels: %s", report)
    return mesh, report


def _as_posed(surfels: Surfels) -> PosedSurfels:
    """Surfels as they are, ready for the raster; faint ones are hidden."""
    frames = rotation_matrices(surfels.rotation)
    n = len(surfels)
    return PosedSurfels(
        surfels.centre,
        np.ascontiguousarray(frames[..., 0] * surfels.scale[:, :1]),
        np.ascontiguousarray(frames[..., 1] * surfels.scale[:, 1:]),
        np.ascontiguousarray(frames[..., 2]),
        np.where(surfels.opacity < FAINT, 0, surfels.opacity).astype(np.float32),
        surfels.albedo,
        surfels.roughness,
        surfels.metallic,
        np.zeros(n, np.int32),
    )


def _bounds(surfels: Surfels, name: str) -> tuple[Array, Array]:
    """Box of the surfels that matter, without the outermost thousandth (stray ones)."""
    solid = surfels.opacity >= FAINT
    if not solid.any():
        raise AssetError(name, "has only transparent surfels", "Give the mesh that they were captured with")
    reach = surfels.scale[solid].max(axis=1, keepdims=True)
    low = np.quantile(surfels.centre[solid] - reach, 0.001, axis=0)
    high = np.quantile(surfels.centre[solid] + reach, 0.999, axis=0)
    return low.astype(np.float64), np.maximum(high, low + 1e-9).astype(np.float64)


def _directions(count: int) -> Array:
    """Unit vectors (count, 3) on a Fibonacci sphere, from the object to the camera."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


def _camera(direction: Array, low: Array, high: Array, voxel: float) -> Camera:
    """Orthographic camera that sees the whole box, with pixels of a voxel's size."""
    side = np.cross([0.0, 0, 1] if abs(direction[2]) < 0.9 else [0.0, 1, 0], direction)
    side /= np.linalg.norm(side)
    diagonal = float(np.linalg.norm(high - low))
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([side, np.cross(direction, side), direction], -1)
    matrix[:3, 3] = 0.5 * (low + high) + direction * diagonal
    size = int(np.ceil(diagonal / voxel)) + 2
    return Camera(
        matrix, size, size, 1 / voxel, 1 / voxel, size / 2, size / 2, orthographic=True, clip_end=2 * diagonal + voxel
    )


def _depth_maps(camera: Camera, depth: Array, cosine: Array) -> DepthMaps:
    """One orthographic view, fused in float64."""
    right, up, back = camera.matrix_world[:3, :3].T
    return DepthMaps(
        depth[None].astype(np.float64),
        cosine[None].astype(np.float64),
        origin=camera.matrix_world[None, :3, 3].copy(),
        axes=np.stack([right, -up, -back])[None],
        scale=np.array([[camera.fx, camera.fx, 1.0]]),
        offset=np.array([[camera.cx, camera.cy, 0.0]]),
        perspective=False,
        bilinear=False,
    )


class _CoveredPixels(NamedTuple):
    """The pixels of a view that surfels cover by half or more; of the others nothing is kept.

    Attributes
    ----------
    place : (p,) int32 array
        Index in the flattened picture.
    depth : (p,) float32 array
        Along the view, metres.
    cosine : (p,) float32 array
        Between surface and view.
    surfel : (p,) int32 array
        The one that covers most of the pixel.
    """

    place: Array
    depth: Array
    cosine: Array
    surfel: Array

    def maps(self, camera: Camera) -> tuple[Array, Array]:
        """Depth and cosine of all pixels, (height, width) float32; +inf and 1 where less than half is covered."""
        shape = camera.height, camera.width
        depth, cosine = np.full(shape, np.inf, np.float32), np.ones(shape, np.float32)
        depth.reshape(-1)[self.place], cosine.reshape(-1)[self.place] = self.depth, self.cosine
        return depth, cosine


def _rasterise(posed: PosedSurfels, camera: Camera, direction: Array) -> _CoveredPixels:
    """Rasterise a view, with all normals on the side of the camera."""
    away = posed.normal @ direction < 0
    number = np.arange(len(posed), dtype=np.int32)
    towards = replace(posed, normal=np.where(away[:, None], -posed.normal, posed.normal), object_index=number)
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=1), 0)
    samples = rasterise(prepare(towards, camera, parameters), 0, camera.height)
    covered = samples.alpha[..., 0] >= 0.5
    normal = samples.surface[..., 0, NORMAL : NORMAL + 3][covered]
    return _CoveredPixels(
        np.flatnonzero(covered).astype(np.int32),
        samples.depth[..., 0][covered],
        np.abs(normal @ direction.astype(np.float32)),
        samples.object_index[..., 0][covered],
    )


def _visible(centre: Array, size: Array, camera: Camera, depth: Array, voxel: float) -> Array:
    """Which surfels lie on what the view sees, (n,) bool."""
    local = (centre - camera.matrix_world[:3, 3]) @ camera.matrix_world[:3, :3]
    x = np.floor(local[:, 0] * camera.fx + camera.cx).astype(int)
    y = np.floor(-local[:, 1] * camera.fy + camera.cy).astype(int)
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    return inside & (np.abs(-local[:, 2] - depth[y, x]) < voxel + 0.5 * size)
