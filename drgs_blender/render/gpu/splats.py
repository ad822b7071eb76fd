"""Surfels projected, sorted and listed by tile on a device, where they stay.

What `surfels.splats.prepare` makes, from the same source. The functions here are translated and never run as they
stand.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.posed_surfels import arrays_of
from ...compute.warp.runtime import warp
from ...compute.warp.search import first_of
from ...core.asset.model import PosedSurfels
from ...core.frame import Camera
from ..surfel_columns import SPLAT
from ..surfels.splats import (
    RECORD,
    TILE,
    ZC,
    Posed,
    Splats,
    depth_key,
    pack_surface,
    project_surfel,
    tiles_of,
)

Array = np.ndarray

#: Key of what is not seen: behind that of every depth.
_CULLED = 0xFFFFFFFF
#: Places in tiles that Warp's sort, which counts twice as many by 31 bits, can hold.
_MOST = (1 << 30) - 1


class DeviceSplats(Splats):
    """`Splats` whose arrays are a device's, but for ``parameters``.

    Attributes
    ----------
    on_cpu : callable
        The same on the CPU, made when that is asked for.
    """

    on_cpu: Callable[[], Splats]


def project_surfels(thread: Any, stride: Any, scratch: Any, posed: Any, p: Any, window: Any, out: Any) -> None:
    """`splats._project`, and the depths of the centres."""
    screen, box, nearest, depth = out
    for i in range(thread, len(box), stride):
        project_surfel(i, posed, p, window, screen, box, nearest)
        depth[i] = screen[i, ZC]


def key_depths(thread: Any, stride: Any, scratch: Any, bits: Any, box: Any, out: Any) -> None:
    """Sort keys of surfels: depth; culled ones go last."""
    keys, order = out
    for i in range(thread, len(box), stride):
        keys[i] = depth_key(bits[i]) if box[i, 2] > box[i, 0] else np.uint32(_CULLED)
        order[i] = np.int32(i)


def find_starts(thread: Any, stride: Any, scratch: Any, keys: Any, count: Any, first: Any, out: Any) -> None:
    """Numbers of `count` sorted keys that are less than `first`, `first` + 1, ..."""
    (start,) = out
    for t in range(thread, len(start), stride):
        start[t] = first_of(keys, count, first + t)


def gather_splats(
    thread: Any, stride: Any, scratch: Any, order: Any, found: Any, posed: Any, owner: Any, out: Any
) -> None:
    """Records of surfels in order of depth, and the number of tiles of each."""
    screen, box, nearest = found
    out_screen, out_surface, out_box, out_nearest, out_owner, tiles = out
    for k in range(thread, len(out_box), stride):
        i = np.int64(order[k])
        for c in range(RECORD):
            out_screen[k, c] = screen[i, c]
        for c in range(4):
            out_box[k, c] = box[i, c]
        out_nearest[k], out_owner[k] = nearest[i], owner[i]
        pack_surface(i, k, posed, out_surface)
        x0, y0, x1, y1 = tiles_of(box, i)
        tiles[k] = (x1 - x0) * (y1 - y0)


def list_tiles(thread: Any, stride: Any, scratch: Any, box: Any, ends: Any, grid: Any, out: Any) -> None:
    """Every splat's tiles, splat by splat; `ends` are those of their rows."""
    first_x, first_y, columns = grid
    keys, splat = out
    for k in range(thread, len(box), stride):
        x0, y0, x1, y1 = tiles_of(box, k)
        row = ends[k] - (x1 - x0) * (y1 - y0)
        for y in range(y0 - first_y, y1 - first_y):
            for x in range(x0 - first_x, x1 - first_x):
                keys[row], splat[row] = np.uint32(y * columns + x), np.int32(k)
                row += 1


PROJECT = WarpKernel(project_surfels, (), {})
KEY = WarpKernel(key_depths, (), {})
FIND = WarpKernel(find_starts, (), {})
GATHER = WarpKernel(gather_splats, (), {})
LIST = WarpKernel(list_tiles, (), {})


def prepare(
    launcher: Launcher, posed: PosedSurfels, camera: Camera, parameters: Array, on_cpu: Callable[[], Splats]
) -> Splats:
    """`surfels.splats.prepare` on a device; where no surfel is seen, there is nothing that could stay there.

    Parameters
    ----------
    on_cpu : callable
        Makes the same on the CPU.
    launcher : Launcher
    posed : PosedSurfels
    camera : Camera
    parameters : array
    on_cpu : callable
    """
    n, zeros = len(posed), launcher.zeros
    with launcher.failures("copying surfels"):
        given = arrays_of(posed, launcher)
        found = zeros((n, RECORD)), zeros((n, 4), "int32"), zeros((n,))
        depth, keys, order = zeros((n,)), zeros((2 * n,), "uint32"), zeros((2 * n,), "int32")
    arrays = Posed(*(given[name] for name in Posed._fields))
    launcher.launch(PROJECT, n, (arrays, parameters, tuple(map(int, camera.window))), (*found, depth))
    launcher.launch(KEY, n, (depth.view(warp().uint32), found[1]), (keys, order))
    m = np.zeros(1, np.int64)
    with launcher.failures("sorting surfels"):
        warp().utils.radix_sort_pairs(keys, order, n)
    launcher.launch(FIND, 1, (keys, n, _CULLED), (m,))
    seen = int(m[0])
    if not seen:
        return on_cpu()
    with launcher.failures("sorting surfels"):
        made = zeros((seen, RECORD)), zeros((seen, SPLAT)), zeros((seen, 4), "int32"), zeros((seen,))
        owner, tiles = zeros((seen,), "int32"), zeros((seen,), "int64")
    launcher.launch(GATHER, seen, (order, found, arrays, given["object_index"]), (*made, owner, tiles))
    lists = _listed(launcher, made[2], tiles, camera.window)
    splats = DeviceSplats(*made, owner, *lists, *camera.window, parameters)
    splats.on_cpu = on_cpu
    return splats


def _listed(launcher: Launcher, box: Any, tiles: Any, window: tuple[int, int, int, int]) -> tuple[Any, Any]:
    """(tile_start, tile_list) of `Splats` from the boxes and how many tiles each lies in."""
    x0, y0, x1, y1 = (window[0] // TILE, window[1] // TILE, (window[2] - 1) // TILE + 1, (window[3] - 1) // TILE + 1)
    columns, rows = x1 - x0, y1 - y0
    zeros, m = launcher.zeros, len(box)
    with launcher.failures("listing surfels"):
        start = zeros((columns * rows + 1,), "int64")
        warp().utils.array_scan(tiles, tiles)
        total = int(tiles[m - 1 :].numpy()[0])
        if total > _MOST:
            raise MemoryError(f"{total} places in tiles")
        keys, splat = zeros((2 * total,), "uint32"), zeros((2 * total,), "int32")
    launcher.launch(LIST, m, (box, tiles, (x0, y0, columns)), (keys, splat))
    with launcher.failures("listing surfels"):
        warp().utils.radix_sort_pairs(keys, splat, total, 0, (columns * rows).bit_length())
    launcher.launch(FIND, columns * rows + 1, (keys, total, 0), (start,))
    return start, splat[:total]
