"""Depth maps fused into a truncated signed distance field (TSDF), and the closed mesh of its zero level.

Each view gives the voxels along its rays their signed distance to its surface, and marks what it sees through as free.
What too few views see counts as inside, so the mesh is closed there too (Curless and Levoy 1996, "A volumetric method
for building complex models from range images"; Lorensen and Cline 1987, marching cubes).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..compute.jit import njit
from ..compute.threads import over_range
from ..core.asset.model import Mesh
from ..core.errors import AssetError

Array = np.ndarray

#: Half width of the band around a seen surface, in voxels.
BAND = 3.0
#: Components smaller than this part of the largest one's area are dropped.
CRUMB = 0.01


class DepthMaps(NamedTuple):
    """Depth maps of views of one size, and where in them a point is seen.

    With ``q = scale * (axes @ (point - origin)) + offset``, ``q[2]`` is the depth of a point and ``q[:2]`` its
    position in pixels, in a perspective view multiplied by the depth.

    Attributes
    ----------
    depth : (v, h, w) float32 or float64 array
        Metres along the axis of view, +inf where nothing is seen. Its precision is that of the fusion's arithmetic.
    cosine : (v, h, w) float32 or float64 array
        Of the angle between the surface's normal and the view, 0..1: the weight of a pixel. Below 0.1 a pixel does not
        count; where nothing is seen, 1 says that space is free. Of the dtype of `depth`.
    origin : (v, 3) float64 array
        Metres, in the frame of the field.
    axes : (v, 3, 3) float64 array
        Rows towards the right and down in the picture and along the view.
    scale, offset : (v, 3) float64 array
    perspective : bool
        Whether positions are to be divided by the depth; else the views are orthographic.
    bilinear : bool
        Whether depth is interpolated between pixels that lie on one surface, and silhouettes are left out; else it is
        that of the pixel in which a point lies.
    """

    depth: Array
    cosine: Array
    origin: Array
    axes: Array
    scale: Array
    offset: Array
    perspective: bool
    bilinear: bool


class Voxels(NamedTuple):
    """The sums of a field, voxel by voxel, and where the voxels are.

    Attributes
    ----------
    total, weight : (nx, ny, nz) float32 array
        Of weighted distances in bands, and of the weights.
    views : (nx, ny, nz) int32 array
        How many views have seen it.
    low : (3,) float64 array
        Centre of voxel (0, 0, 0), metres.
    size : float
        Distance between the centres of neighbours, metres.
    """

    total: Array
    weight: Array
    views: Array
    low: Array
    size: float


class SignedDistanceField:
    """Mean truncated signed distance at the voxels of a grid: +1 before a surface, -1 behind it, 0 on it.

    Parameters
    ----------
    low : (3,) float64 array
        Centre of voxel (0, 0, 0), metres, in the frame of the mesh to be made.
    voxel : float
        Distance between the centres of neighbours, metres.
    shape : tuple of int
        Voxels along each axis.
    """

    def __init__(self, low: Array, voxel: float, shape: tuple[int, ...]) -> None:
        total, weight, views = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.int32)
        self._voxels = Voxels(total, weight, views, np.ascontiguousarray(low, np.float64), voxel)

    def add(self, maps: DepthMaps) -> None:
        """Take depth maps in, in the order of their views.

        Sums over the views of one call have the precision of their depth, those over calls are float32.
        """
        over_range(_fuse, len(self._voxels.total), self._voxels, maps, BAND * self._voxels.size)

    def mesh(
        self, witnesses: int, smoothing: float, advice: str, name: str = "mesh from surfels"
    ) -> tuple[Mesh, dict[str, Any]]:
        """The zero level, as a watertight mesh of the components that matter.

        Parameters
        ----------
        witnesses : int
            Views, one at least, that must see a voxel before it counts as seen; others are inside.
        smoothing : float
            Standard deviation of the filter of the field, in voxels.
        advice : str
            Advice where no mesh can be made, for the message.
        name : str
            What the surfels are called there.

        Returns
        -------
        mesh : Mesh
            In the frame of the grid; counter-clockwise seen from outside, neutral materials.
        report : dict
            "voxel" (metres), "components_dropped", "volume" (cubic metres), "vertices", "faces".

        Raises
        ------
        AssetError
            The field has no zero level.
        """
        from skimage.measure import marching_cubes  # takes long to import, and most jobs make no mesh

        total, weight, views, low, voxel = self._voxels
        field = np.full_like(total, -1.0)
        np.divide(total, weight, out=field, where=views >= witnesses)
        field = np.pad(gaussian_filter(field, smoothing), 1, constant_values=1.0)
        if not field.min() < 0 < field.max():
            raise AssetError(name, "surfels enclose no volume", advice)
        vertices, faces, _, _ = marching_cubes(field, 0.0)
        vertices, faces, dropped, volume = main_parts((vertices - 1) * voxel + low, faces)
        n = len(vertices)
        report = {
            "voxel": voxel, "components_dropped": dropped, "volume": volume, "vertices": n, "faces": len(faces),
        }  # fmt: skip
        return Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n)), report


def main_parts(vertices: Array, faces: Array) -> tuple[Array, Array, int, float]:
    """Keep the connected components that matter: neither crumbs nor cavities.

    Parameters
    ----------
    vertices : (n, 3) float array
        Metres.
    faces : (f, 3) int array
        All of the same orientation, whichever.

    Returns
    -------
    vertices : (m, 3) float array
    faces : (g, 3) int32 array
        Counter-clockwise seen from outside.
    dropped : int
        Components left out.
    volume : float
        Of those kept, cubic metres.
    """
    n = len(vertices)
    links = coo_matrix((np.ones(2 * len(faces)), (faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1))), (n, n))
    _, label = connected_components(links, directed=False)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    of_face = label[faces[:, 0]]
    area = np.bincount(of_face, 0.5 * np.linalg.norm(cross, axis=1), label.max() + 1)
    volume = np.bincount(of_face, np.einsum("fc,fc->f", cross, corners[:, 0]) / 6, label.max() + 1)
    side = np.sign(volume[area.argmax()]) or 1.0
    keep = (area >= CRUMB * area.max()) & (side * volume > 0)
    faces = faces[keep[of_face]]
    if side < 0:
        faces = faces[:, ::-1]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32), int((~keep).sum()), float(side * volume[keep].sum())


@njit
def _sample(depth: Any, x: Any, y: Any) -> Any:
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
        return depth[py, px] if least == most or most < np.inf else depth.dtype.type(np.nan)
    s, t = depth.dtype.type(u - i), depth.dtype.type(v - j)
    top, bottom = a + s * (b - a), c + s * (d - c)
    return top + t * (bottom - top)


@njit
def _fuse(first: int, last: int, voxels: Voxels, maps: DepthMaps, band: float) -> None:
    """Add views to layers of the sums along X: +1 before the surface, falling to -1 behind it within the band (metres).

    A pixel counts with the cosine at which it sees the surface: the rim of a silhouette says little. The same cosine
    turns distance along the view into distance from the surface. Literals of the maps' type keep all in its precision.
    """
    total, weight, views, low, voxel = voxels
    depth, cosine, origin, axes, scale, offset, perspective, bilinear = maps
    height, width, layers = depth.shape[1], depth.shape[2], total.shape[2]
    zero, one = depth.dtype.type(0), depth.dtype.type(1)
    # A column of voxels along Z at a time: what depends on X and Y alone is found once for each view. Pixels are read
    # in a loop of their own, so that those before and after it become vector code.
    value, weights = np.empty(layers, depth.dtype), np.empty(layers, depth.dtype)
    px, py = np.empty(layers), np.empty(layers)
    gap, share = np.empty(layers, depth.dtype), np.empty(layers, depth.dtype)
    heights = low[2] + np.arange(layers) * voxel
    for i in range(first, last):
        for j in range(total.shape[1]):
            value[:], weights[:] = 0, 0
            for m in range(len(depth)):
                x, y = low[0] + i * voxel - origin[m, 0], low[1] + j * voxel - origin[m, 1]
                right, down, ahead = axes[m, 0], axes[m, 1], axes[m, 2]
                right_xy, down_xy = right[0] * x + right[1] * y, down[0] * x + down[1] * y
                ahead_xy = ahead[0] * x + ahead[1] * y
                for k in range(layers):
                    z = heights[k] - origin[m, 2]
                    far = (ahead_xy + ahead[2] * z) * scale[m, 2] + offset[m, 2]
                    qx = (right_xy + right[2] * z) * scale[m, 0] + offset[m, 0]
                    qy = (down_xy + down[2] * z) * scale[m, 1] + offset[m, 1]
                    if perspective:
                        qx, qy = qx / far, qy / far
                    inside = (far > 0.0) & (qx >= 0.0) & (qy >= 0.0) & (qx < width) & (qy < height)
                    px[k], py[k], gap[k] = qx if inside else -1.0, qy, far
                for k in range(layers):
                    share[k] = 0
                    if px[k] < 0.0:
                        continue
                    row, column = np.uintp(np.int64(py[k])), np.uintp(np.int64(px[k]))
                    share[k] = cosine[m, row, column]
                    seen = _sample(depth[m], px[k], py[k]) if bilinear else depth[m, row, column]
                    gap[k] = seen - gap[k]
                for k in range(layers):
                    w, distance = share[k], gap[k] / depth.dtype.type(band)
                    counts = (w >= 0.1) & (distance > -one)
                    share[k] = w if counts else zero
                    gap[k] = w * min(w * distance, one) if counts else zero
                for k in range(layers):
                    value[k] += gap[k]
                    weights[k] += share[k]
                for k in range(layers):
                    views[i, j, k] += np.int32(share[k] > zero)
            for k in range(layers):
                total[i, j, k] += value[k]
                weight[i, j, k] += weights[k]
