"""The surfels' depth maps, as the training views see them, fused into one closed mesh.

Space that no view sees counts as inside, so that the mesh is closed there.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...core.frame import Camera
from ...geometry.tsdf import DepthMaps, SignedDistanceField
from ..capture.training_views import pixel_rays
from ..memory_budget import check_fits, fitting
from ..model.gaussians import Gaussians
from .crops import cropped
from .tangential_relaxation import relaxed
from .visual_hull import Region, world_to_pixel

log = logging.getLogger(__name__)

#: Views fused at once; bounds the memory of their maps.
TOGETHER = 32
#: Least side of a voxel, pixels.
PIXELS = 1.0
#: Voxels along the longest side where none are asked for, at most and at least.
MOST, FEWEST = 512, 16
#: Voxels around the region, on each side and along an axis in all.
_AROUND = 5
_BEYOND = 2 * _AROUND + 2
#: Bytes per voxel of `SignedDistanceField` at the most: sum, weight and count, the field, smoothed, and widened.
_BYTES_PER_VOXEL = 24
#: Standard deviation of the smoothing of the field, voxels: below it is the noise of the depth maps.
SMOOTH = 0.8


def fuse(
    gaussians: Gaussians, cameras: list[Camera], region: Region, resolution: int = MOST
) -> tuple[Mesh, dict[str, Any]]:
    """Mesh of what `cameras` see of the surfels.

    Parameters
    ----------
    gaussians : Gaussians
    cameras : list of Camera
    region : Region
        Its box, slightly widened, is divided.
    resolution : int
        Most voxels along the longest side, see `grid`.

    Returns
    -------
    mesh : Mesh
        Watertight, counter-clockwise seen from outside, of even triangles; neutral materials.
    report : dict
        "voxel" (metres), "components_dropped", "volume" (cubic metres), "vertices", "faces".

    Raises
    ------
    AssetError: no surface was found.
    UsageError: more voxels than the memory holds.
    """
    low, voxel, shape = grid(cameras, region, resolution)
    field = SignedDistanceField(low, voxel, shape)
    cameras = cropped(cameras, low, low + voxel * np.array(shape))
    for begin in range(0, len(cameras), TOGETHER):
        batch = cameras[begin : begin + TOGETHER]
        same_size = {(c.height, c.width) for c in batch}
        for height, width in sorted(same_size):
            group = [c for c in batch if (c.height, c.width) == (height, width)]
            field.add(_depth_maps(gaussians, group))
    mesh, report = field.mesh(1, SMOOTH, "Learn them for longer, or check masks and cameras")
    mesh.vertices = relaxed(mesh.vertices, mesh.faces)
    log.info("mesh: %s", report)
    return mesh, report


def voxels_that_fit(cameras: list[Camera], region: Region, wanted: int) -> int:
    """How many voxels of `grid` along the longest side the memory holds, at most those `wanted`; told if fewer.

    Raises
    ------
    UsageError: there is hardly any memory.
    """
    count, needed = _size(_voxels(cameras, region, wanted)[2])
    fewer = fitting(needed, count, 3, _BEYOND)
    if fewer >= count:
        return wanted
    if fewer < FEWEST:
        _check(count, needed)
    log.warning(
        "the mesh gets %d voxels along its longest side, of %d: more do not fit into the memory that is free. --voxels "
        "asks for others", fewer, count,
    )  # fmt: skip
    return fewer


def grid(cameras: list[Camera], region: Region, resolution: int = MOST) -> tuple[Array, float, tuple[int, ...]]:
    """First corner (3,) and side of the voxels of `fuse`, metres, and how many there are along each axis.

    None is smaller than `PIXELS` of the nearest quarter of views.

    Raises
    ------
    UsageError: more than the memory holds.
    """
    low, voxel, shape = _voxels(cameras, region, resolution)
    _check(*_size(shape))
    return low, voxel, shape


def _voxels(cameras: list[Camera], region: Region, resolution: int) -> tuple[Array, float, tuple[int, ...]]:
    pixel = [float(np.linalg.norm(np.asarray(c.matrix_world)[:3, 3] - region.centre)) / c.fx for c in cameras]
    side = float((region.high - region.low).max())
    voxel = max(side / resolution, PIXELS * float(np.quantile(pixel, 0.25)))
    low, high = region.low - _AROUND * voxel, region.high + _AROUND * voxel
    return low, voxel, tuple(int(n) for n in np.ceil((high - low) / voxel).astype(int) + 1)


def _size(shape: tuple[int, ...]) -> tuple[int, float]:
    """Voxels along the region's longest side, and bytes of all."""
    return max(shape) - _BEYOND, _BYTES_PER_VOXEL * float(np.prod(shape))


def _check(count: int, needed: float) -> None:
    check_fits(needed, "the mesh", "voxels", "--voxels", count, 3, _BEYOND)


def surface_maps(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """Depth (h, w), +inf where less than half is covered, and cosine between normal and view, 1 there."""
    with torch.no_grad():
        rendered = gaussians.render(camera, torch.zeros(3), 0)
        # The median: a mean is drawn backwards by the little that shines through from the far side.
        covered = rendered.maps.median.numpy() > 0
        depth = np.where(covered, rendered.maps.median.numpy(), np.inf)
        normal = rendered.normal.numpy()
    rays = pixel_rays(camera).numpy()
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1)
    cosine = -(normal * rays).sum(-1) / np.maximum(length, 1e-9)
    return depth.astype(np.float32), np.where(covered, np.clip(cosine, 0, 1), 1).astype(np.float32)


def _depth_maps(gaussians: Gaussians, cameras: list[Camera]) -> DepthMaps:
    """What cameras of one size see, fused in float32."""
    depth, cosine = (np.stack(maps) for maps in zip(*(surface_maps(gaussians, c) for c in cameras), strict=True))
    matrices = np.stack([world_to_pixel(camera) for camera in cameras])
    return DepthMaps(
        depth,
        cosine,
        origin=np.zeros((len(cameras), 3)),
        axes=np.ascontiguousarray(matrices[:, :, :3]),
        scale=np.ones((len(cameras), 3)),
        offset=np.ascontiguousarray(matrices[:, :, 3]),
        perspective=True,
        bilinear=True,
    )
