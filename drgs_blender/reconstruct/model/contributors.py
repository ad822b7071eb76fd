"""Which surfels show in each pixel of a view, how much and where: the weights of `raster`, strongest first."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_strided
from ...core.arrays import Array
from ...core.frame import Camera
from ...render.surfels.blending import MIN_TRANSMITTANCE
from ...render.surfels.raster import gaussian
from ...render.surfels.splats import MAX_ALPHA, TILE
from .blend import strength
from .projection import splat_of
from .raster import WorldSurfels, arranged, view_of


def strongest(surfels: WorldSurfels, camera: Camera, most: int) -> tuple[Array, Array, Array]:
    """The `most` surfels that cover most of each pixel of a view.

    Parameters
    ----------
    surfels : WorldSurfels
    camera : Camera
    most : int

    Returns
    -------
    index : (h, w, most) int32 array
        Rows of the surfels, by descending weight; 0 where there are fewer.
    weight : (h, w, most) float32 array
        As in `raster`; 0 where there are fewer.
    depth : (h, w, most) float32 array
        Metres along the view.
    """
    parameters, (width, height) = view_of(camera)
    none = np.zeros((len(surfels.opacity), 0), np.float32)
    order, splats, tiles = arranged(surfels, none, parameters, (width, height))
    index = np.zeros((height, width, most), np.int32)
    weight, depth = np.zeros((2, height, width, most), np.float32)
    over_strided(_list_tiles, len(tiles.start) - 1, splats, tiles, order, index, weight, depth)
    return index, weight, depth


@njit
def _list_tiles(first, last, workers, splats, tiles, order, index, weight, depth):  # type: ignore[no-untyped-def]
    height, width, most = index.shape
    rest = np.empty((TILE, TILE), np.float32)
    for worker in range(first, last):
        for tile in range(worker, len(tiles.start) - 1, workers):
            left, top = tile % tiles.across * TILE, tile // tiles.across * TILE
            rest[:] = np.float32(1.0)
            for entry in range(tiles.start[tile], tiles.start[tile + 1]):
                i = tiles.listed[entry]
                splat = splat_of(splats.record, i)
                for y in range(max(top, splats.box[i, 1]), min(top + TILE, splats.box[i, 3], height)):
                    for x in range(max(left, splats.box[i, 0]), min(left + TILE, splats.box[i, 2], width)):
                        t = rest[y - top, x - left]
                        if t < MIN_TRANSMITTANCE:
                            continue
                        ex, ey = np.float32(x + 0.5) - splat.rx, np.float32(y + 0.5) - splat.ry
                        q, z, _, _, _ = strength(ex, ey, splat, splats.near, splats.far)
                        if q >= splat.cut:
                            continue
                        w = t * min(splat.opacity * gaussian(q), np.float32(MAX_ALPHA))
                        rest[y - top, x - left] = t - w
                        place = most
                        while place > 0 and weight[y, x, place - 1] < w:
                            place -= 1
                        for k in range(most - 1, place, -1):
                            weight[y, x, k], index[y, x, k] = weight[y, x, k - 1], index[y, x, k - 1]
                            depth[y, x, k] = depth[y, x, k - 1]
                        if place < most:
                            weight[y, x, place], index[y, x, place], depth[y, x, place] = w, order[i], z
