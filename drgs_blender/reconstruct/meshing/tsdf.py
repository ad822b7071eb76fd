"""The surfels' depth maps fused into one closed mesh (Curless and Levoy 1996, "A volumetric method...").

Each view says of the points along its rays how far before or behind its surface they are, and that what it sees
through is free. What no view sees is inside: the mesh is closed where nobody photographed.
"""

from __future__ import annotations

import logging

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from ...build.proxy import main_parts
from ...compute.jit import njit, prange
from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...core.errors import AssetError, DeviceError
from ...core.frame import Camera
from ..capture.training_views import pixel_rays
from ..memory_budget import check_fits
from ..model.gaussians import Gaussians
from .visual_hull import Region, world_to_pixel

log = logging.getLogger(__name__)

#: Half width of the band around a seen surface, voxels.
BAND = 3.0
#: Views fused at once; bounds the memory of their maps.
TOGETHER = 32
#: Least side of a voxel, pixels.
PIXELS = 1.0
#: Voxels around the region.
_AROUND = 5
#: Bytes a voxel takes on the way: sum and weight, the field, smoothed, widened, and what marching cubes make of it.
_BYTES_A_VOXEL = 24
#: Deviation of the smoothing of the field, voxels: below it is the noise of the depth maps.
SMOOTH = 0.8


def fuse(gaussians: Gaussians, cameras: list[Camera], region: Region, resolution: int = 256) -> tuple[Mesh, dict]:
    """Mesh of what `cameras` see of the surfels.

    Parameters
    ----------
    region : its box, slightly widened, is divided
    resolution : most voxels along the longest side; none is smaller than `PIXELS` of the nearest quarter of views

    Returns
    -------
    mesh : Mesh
        Watertight, counter-clockwise seen from outside; neutral materials.
    report : dict
        "voxel" (metres), "components_dropped", "volume" (cubic metres), "vertices", "faces".

    Raises
    ------
    AssetError: no surface was found.
    UsageError: more voxels than the memory holds.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise DeviceError("a mesh", "needs scikit-image", "Install it: pip install scikit-image") from error
    low, voxel, shape = grid(cameras, region, resolution)
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for begin in range(0, len(cameras), TOGETHER):
        batch = cameras[begin : begin + TOGETHER]
        same_size = {(c.height, c.width) for c in batch}
        for height, width in sorted(same_size):
            group = [c for c in batch if (c.height, c.width) == (height, width)]
            depth, cosine = (np.stack(maps) for maps in zip(*(surface_maps(gaussians, c) for c in group), strict=True))
            matrices = np.stack([world_to_pixel(c) for c in group])
            _fuse(total, weight, low, voxel, matrices, depth, cosine, np.float32(BAND * voxel))
    field = np.where(weight > 0, total / np.maximum(weight, 1e-6), -1.0)
    field = np.pad(gaussian_filter(field, SMOOTH), 1, constant_values=1.0)
    if not field.min() < 0 < field.max():
        raise AssetError("surfels", "enclose no volume", "Learn them for longer, or check masks and cameras")
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    vertices, faces, dropped, volume = main_parts((vertices - 1) * voxel + low, faces)
    n = len(vertices)
    report = {"voxel": voxel, "components_dropped": dropped, "volume": volume, "vertices": n, "faces": len(faces)}
    log.info("mesh: %s", report)
    return Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n)), report


def grid(cameras: list[Camera], region: Region, resolution: int = 256) -> tuple[Array, float, tuple[int, ...]]:
    """First corner (3,) and side of the voxels of `fuse`, metres, and how many there are along each axis.

    Raises
    ------
    UsageError: more than the memory holds.
    """
    side = float((region.high - region.low).max())
    pixel = [float(np.linalg.norm(np.asarray(c.matrix_world)[:3, 3] - region.centre)) / c.fx for c in cameras]
    voxel = max(side / resolution, PIXELS * float(np.quantile(pixel, 0.25)))
    low, high = region.low - _AROUND * voxel, region.high + _AROUND * voxel
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel).astype(int) + 1)
    around = 2 * _AROUND + 2
    needed = _BYTES_A_VOXEL * float(np.prod(shape))
    check_fits(needed, "the mesh", "voxels", "--voxels", max(shape) - around, 3, around)
    return low, voxel, shape


def surface_maps(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """Depth (h, w), +inf where less than half is covered, and cosine between normal and view, 1 there."""
    with torch.no_grad():
        look = gaussians.look(camera, torch.zeros(3), 0)
        # The median: a mean is drawn backwards by the little that shines through from the far side.
        covered = look.maps.median.numpy() > 0
        depth = np.where(covered, look.maps.median.numpy(), np.inf)
        normal = look.normal.numpy()
    rays = pixel_rays(camera).numpy()
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1)
    cosine = -(normal * rays).sum(-1) / np.maximum(length, 1e-9)
    return depth.astype(np.float32), np.where(covered, np.clip(cosine, 0, 1), 1).astype(np.float32)


@njit
def _sample(depth, x, y):  # type: ignore[no-untyped-def]
    """Depth at pixel position (x, y): bilinear where its four pixels lie on one surface, else the nearest pixel's.

    NaN on a silhouette, of which a pixel says too little to carve by it.
    """
    height, width = depth.shape
    px, py = int(x), int(y)
    u, v = x - 0.5, y - 0.5
    if u < 0.0 or v < 0.0 or u >= width - 1 or v >= height - 1:
        return depth[py, px]
    i, j = int(u), int(v)
    a, b, c, d = depth[j, i], depth[j, i + 1], depth[j + 1, i], depth[j + 1, i + 1]
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not most - least < np.float32(0.03) * least:
        return depth[py, px] if least == most or most < np.inf else np.float32(np.nan)
    s, t = np.float32(u - i), np.float32(v - j)
    top, bottom = a + s * (b - a), c + s * (d - c)
    return top + t * (bottom - top)


@njit(parallel=True)
def _fuse(total, weight, low, voxel, matrices, depth, cosine, band):  # type: ignore[no-untyped-def]
    """Add views to the field: +1 before the surface, falling to -1 behind it within the band.

    A pixel counts with the cosine at which it sees the surface; the same cosine turns distance along the ray into
    distance from the surface.
    """
    height, width = depth.shape[1], depth.shape[2]
    for i in prange(total.shape[0]):
        for j in range(total.shape[1]):
            for k in range(total.shape[2]):
                x, y, z = low[0] + i * voxel, low[1] + j * voxel, low[2] + k * voxel
                value, counted = np.float32(0.0), np.float32(0.0)
                for view in range(len(matrices)):
                    p = matrices[view]
                    away = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                    if away <= 0.0:
                        continue
                    px = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / away
                    py = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / away
                    if px < 0.0 or py < 0.0 or px >= width or py >= height:
                        continue
                    w = cosine[view, int(py), int(px)]
                    if w < np.float32(0.1):
                        continue
                    gap = (_sample(depth[view], px, py) - np.float32(away)) / band
                    if gap > np.float32(-1.0):
                        value += w * min(w * gap, np.float32(1.0))
                        counted += w
                total[i, j, k] += value
                weight[i, j, k] += counted
