"""A closed mesh made from surfels alone: depth maps from all around, fused into a signed distance field (TSDF).

Space that is never seen is inside. Surfels do not say reliably which way they face, so this is found first: a surfel
faces the directions from which it is seen. Back sides, seen through holes of an open capture, then carve nothing.
(Curless and Levoy 1996, "A volumetric method for building complex models from range images".)
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..compute.jit import njit, prange
from ..core.asset.model import Mesh, PosedSurfels, Surfels
from ..core.errors import AssetError, DeviceError
from ..core.frame import Camera, RenderSettings
from ..formats.axes import scaled_surfels
from ..formats.mesh import check_extent
from ..geometry.normals import rotation_matrices
from ..render.camera import camera_parameters
from ..render.surfels.raster import rasterise
from ..render.surfels.splats import prepare

Array = np.ndarray
log = logging.getLogger(__name__)

#: Half width of the band around a seen surface, in voxels.
BAND = 3.0
#: Views that must see a voxel before it counts as seen.
WITNESSES = 3
#: Surfels fainter than this do not shape the mesh.
FAINT = 0.05
#: Sizes in metres at which cameras are set up around surfels; others are scaled for it.
SIZES = 0.01, 1e5
#: Components smaller than this part of the largest one's area are dropped.
CRUMB = 0.01


def mesh_from_surfels(surfels: Surfels, *, resolution: int = 192, views: int = 64) -> tuple[Mesh, dict[str, Any]]:
    """Build a watertight mesh around surfels.

    Parameters
    ----------
    surfels : Surfels
        Object space.
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
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise DeviceError(
            "a mesh from surfels", "needs scikit-image", "Install it: pip install scikit-image; or give a mesh"
        ) from error
    low, high = _bounds(surfels)
    check_extent(np.stack([low, high]), "surfels")
    size = float((high - low).max())
    if not SIZES[0] <= size <= SIZES[1]:
        mesh, report = mesh_from_surfels(scaled_surfels(surfels, 1 / size), resolution=resolution, views=views)
        mesh.vertices = mesh.vertices * np.float32(size)
        return mesh, report | {"voxel": report["voxel"] * size, "volume": report["volume"] * size**3}
    posed = _as_posed(surfels)
    voxel = float((high - low).max()) / resolution
    low, high = low - 4 * voxel, high + 4 * voxel
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    cameras = [_camera(direction, low, high, voxel) for direction in _directions(views)]

    seen = np.zeros((len(posed), 3))
    for camera, direction in zip(cameras, _directions(views)):
        alpha, depth, _, _ = _look(posed, camera, direction)
        seen += _visible(posed.centre, surfels.scale.max(axis=1), camera, alpha, depth, voxel)[:, None] * direction
    outward = np.where((np.einsum("nc,nc->n", seen, posed.normal) < 0)[:, None], -posed.normal, posed.normal)

    total, weight = np.zeros(tuple(shape), np.float32), np.zeros(tuple(shape), np.float32)
    count = np.zeros(tuple(shape), np.int32)
    for camera, direction in zip(cameras, _directions(views)):
        front = (outward @ direction > 0).astype(np.float32)
        flagged = replace(posed, normal=outward.astype(np.float32), albedo=np.repeat(front[:, None], 3, axis=1))
        alpha, depth, cosine, facing = _look(flagged, camera, direction)
        cosine[facing < 0.5] = 0  # a back side: says nothing about what is before it
        depth[alpha < 0.5], cosine[alpha < 0.5] = np.inf, 1
        _fuse(
            total, weight, count, low, voxel, camera.matrix_world, camera.fx, camera.cx, camera.cy,
            depth, cosine, BAND * voxel,
        )  # fmt: skip
    field = np.where(count >= WITNESSES, total / np.maximum(weight, 1e-6), -1.0)
    field = gaussian_filter(field, 0.7)
    field = np.pad(field, 1, constant_values=1.0)
    if not (field.min() < 0 < field.max()):
        raise AssetError("surfels", "enclose no volume", "Give the mesh that they were captured with")
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    vertices = (vertices - 1) * voxel + low
    vertices, faces, dropped, volume = main_parts(vertices, faces)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
    report = {
        "resolution": resolution, "voxel": voxel, "components_dropped": dropped, "volume": volume,
        "vertices": n, "faces": len(faces),
    }  # fmt: skip
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


def _bounds(surfels: Surfels) -> tuple[Array, Array]:
    """Box of the surfels that matter, without the outermost thousandth (stray ones)."""
    solid = surfels.opacity >= FAINT
    if not solid.any():
        raise AssetError("surfels", "are all transparent", "Give the mesh that they were captured with")
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


def _look(posed: PosedSurfels, camera: Camera, direction: Array) -> tuple[Array, Array, Array, Array]:
    """Coverage, depth, cosine between surface and view, and red albedo (size, size) of a view."""
    samples = rasterise(
        prepare(posed, camera, camera_parameters(camera, RenderSettings(subpixel_samples=1), 0)), 0, camera.height
    )
    alpha, surface = samples.alpha[..., 0], samples.surface[..., 0, :]
    surface = np.where(alpha[..., None] > 0, surface, 0)
    cosine = np.abs(surface[..., :3] @ direction.astype(np.float32))
    return alpha, samples.depth[..., 0].copy(), cosine, surface[..., 3]


def _visible(centre: Array, size: Array, camera: Camera, alpha: Array, depth: Array, voxel: float) -> Array:
    """Which surfels lie on what the view sees, (n,) bool."""
    local = (centre - camera.matrix_world[:3, 3]) @ camera.matrix_world[:3, :3]
    x = np.floor(local[:, 0] * camera.fx + camera.cx).astype(int)
    y = np.floor(-local[:, 1] * camera.fy + camera.cy).astype(int)
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    near = np.abs(-local[:, 2] - depth[y, x]) < voxel + 0.5 * size
    return inside & (alpha[y, x] >= 0.5) & near


@njit(parallel=True)
def _fuse(
    total: Array, weight: Array, count: Array, low: Array, voxel: float, matrix: Array, scale: float,
    cx: float, cy: float, depth: Array, cosine: Array, band: float,
) -> None:  # fmt: skip
    """Add a depth map to the field: +1 before the surface, falling to -1 behind it within the band.

    `depth` is +inf where nothing was seen. A pixel counts with the `cosine` at which it sees the surface: the rim of
    a silhouette, widened by the raster's filter, says little. The same cosine turns distance along the ray into
    distance from the surface.
    """
    size = depth.shape[0]
    for i in prange(total.shape[0]):
        for j in range(total.shape[1]):
            for k in range(total.shape[2]):
                x = low[0] + i * voxel - matrix[0, 3]
                y = low[1] + j * voxel - matrix[1, 3]
                z = low[2] + k * voxel - matrix[2, 3]
                px = int(np.floor((matrix[0, 0] * x + matrix[1, 0] * y + matrix[2, 0] * z) * scale + cx))
                py = int(np.floor(cy - (matrix[0, 1] * x + matrix[1, 1] * y + matrix[2, 1] * z) * scale))
                if px < 0 or py < 0 or px >= size or py >= size or cosine[py, px] < 0.1:
                    continue
                away = -(matrix[0, 2] * x + matrix[1, 2] * y + matrix[2, 2] * z)
                gap = (depth[py, px] - away) / band
                if gap > -1.0:
                    w = cosine[py, px]
                    total[i, j, k] += w * min(w * gap, 1.0)
                    weight[i, j, k] += w
                    count[i, j, k] += 1


def main_parts(vertices: Array, faces: Array) -> tuple[Array, Array, int, float]:
    """Keep the components that matter, facing outwards; (vertices, faces, components dropped, volume)."""
    n = len(vertices)
    links = coo_matrix((np.ones(2 * len(faces)), (faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1))), (n, n))
    _, label = connected_components(links, directed=False)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    of_face = label[faces[:, 0]]
    area = np.bincount(of_face, 0.5 * np.linalg.norm(cross, axis=1), label.max() + 1)
    volume = np.bincount(of_face, np.einsum("fc,fc->f", cross, corners[:, 0]) / 6, label.max() + 1)
    side = np.sign(volume[area.argmax()]) or 1.0
    keep = (area >= CRUMB * area.max()) & (side * volume > 0)  # the others are crumbs and cavities
    faces = faces[keep[of_face]]
    if side < 0:
        faces = faces[:, ::-1]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32), int((~keep).sum()), float(side * volume[keep].sum())
