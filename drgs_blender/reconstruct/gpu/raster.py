"""`reconstruct.raster` on a device: torch sorts, kernels of Warp blend, forwards and backwards, on torch's tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ...core.errors import DeviceError
from ...core.frame import Camera
from ...render.camera import CLIP_END, CLIP_START
from ...render.surfels.splats import TILE
from ..model.blend_backward import BEFORE, SCREEN_GRADIENT
from ..model.projection import OPACITY, RECORD
from ..model.raster import GradientStatistics, Maps, view_of
from .kernels import (
    BLEND,
    CHANNELS,
    DISTORTION,
    FEATURES,
    G_FEATURES,
    LIST,
    MEDIAN,
    PROJECT,
    PROJECT_BACKWARD,
    PULL,
    SUM_PIXELS,
    SUM_TILES,
    T,
    Z,
)
from .launch import TensorLauncher

#: Rows of an array that Warp counts.
_MOST = 2**31 - 1


def rasterise(
    launcher: TensorLauncher, centre: Tensor, tangent_u: Tensor, tangent_v: Tensor, opacity: Tensor, features: Tensor,
    camera: Camera, statistics: GradientStatistics | None = None,
) -> Maps:  # fmt: skip
    """`raster.rasterise` of tensors on the launcher's device; so are those of the `statistics`.

    Raises
    ------
    UsageError: as there.
    DeviceError: the device fails, or a view needs more numbers than it counts.
    """
    parameters, size = view_of(camera)
    return Maps(
        *_Rasterise.apply(centre, tangent_u, tangent_v, opacity, features, launcher, parameters, size, statistics)
    )


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, centre: Tensor, tangent_u: Tensor, tangent_v: Tensor, opacity: Tensor, features: Tensor,
        launcher: TensorLauncher, parameters: Array, size: tuple[int, int], statistics: GradientStatistics | None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        (width, height), n = size, len(opacity)
        assert features.shape[1] <= CHANNELS
        new = centre.new_empty
        p = torch.from_numpy(parameters).to(centre.device)
        surfels = tuple(t.detach().contiguous() for t in (centre, tangent_u, tangent_v, opacity))
        record, depth, box = new(n, RECORD), new(n), new((n, 4), dtype=torch.int32)
        launcher.launch(PROJECT, n, (surfels, p, size), (record, depth, box))
        seen = torch.nonzero(box[:, 2] > box[:, 0])[:, 0]
        order = seen[torch.sort(depth[seen], stable=True)[1]]
        record, box, values = record[order], box[order], features.detach()[order]
        near, far = (np.float32(parameters[k]) for k in (CLIP_START, CLIP_END))
        tiles_x, tiles_y = (width - 1) // TILE + 1, (height - 1) // TILE + 1
        pairs = _Pairs(launcher, box, tiles_x, tiles_y)
        maps = new(height, width, FEATURES + values.shape[1])
        splats, tiles = (record, values, box, near, far), (pairs.start, pairs.surfel, tiles_x)
        launcher.launch(BLEND, tiles_x * tiles_y * TILE * TILE, (splats, tiles), (maps,))
        ctx.save = (launcher, surfels, p, order, splats, tiles, pairs, maps, statistics)
        ctx.set_materialize_grads(False)
        # Copies: the maps are needed as they are for the way back.
        return maps[..., FEATURES:].clone(), 1 - maps[..., T], *(maps[..., k].clone() for k in (Z, MEDIAN, DISTORTION))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        launcher, surfels, p, order, splats, tiles, pairs, maps, statistics = ctx.save
        _, values, box, _, _ = splats
        start, listed, tiles_x = tiles
        (m, channels), n = values.shape, len(surfels[0])
        new = maps.new_zeros
        incoming = new(*maps.shape[:2], G_FEATURES + channels)
        g_features, *others = gradients
        for k, g in enumerate(others):
            if g is not None:
                incoming[..., k] = g
        if g_features is not None:
            incoming[..., G_FEATURES:] = g_features
        first, pixels = starts((box[:, 2] - box[:, 0]).long() * (box[:, 3] - box[:, 1]))
        pulls = new(pixels, 2)
        pixel_lanes = (len(start) - 1) * TILE * TILE
        launcher.launch(PULL, pixel_lanes, (splats, tiles, first, maps, incoming), (pulls,))
        slots = new(len(listed), BEFORE + channels)
        entries = listed, pairs.tile, pairs.number, tiles_x
        launcher.launch(SUM_PIXELS, len(listed), (splats, entries, first, maps, incoming, pulls), (slots,))
        total = new(m, BEFORE + channels)
        launcher.launch(SUM_TILES, total.numel(), (slots, pairs.first), (total,))
        found = tuple(new(t.shape) for t in surfels)
        launcher.launch(PROJECT_BACKWARD, m, (surfels, p, order, total), found)
        g_values = new(n, channels)
        found[3][order], g_values[order] = total[:, OPACITY], total[:, BEFORE:]
        if statistics is not None:
            statistics.gradient[order] += total[:, SCREEN_GRADIENT]
            statistics.views[order] += 1
        return *found, g_values, None, None, None, None


class _Pairs:
    """Surfels, in their order, in the tiles that their boxes (m, 4) touch.

    Attributes
    ----------
    first : (m + 1,) int64 array
        First pair of each surfel, as they are numbered.
    start : (tiles + 1,) int64 array
        First entry of each tile.
    surfel, tile, number : (k,) array
        Of the entries, int32, int32 and int64: pairs in the order of tiles, then of surfels.
    """

    def __init__(self, launcher: TensorLauncher, box: Tensor, tiles_x: int, tiles_y: int) -> None:
        low, high = box[:, :2] // TILE, (box[:, 2:] - 1) // TILE
        self.first, count = starts((high - low + 1).long().prod(1))
        tile, surfel = (box.new_empty(count) for _ in range(2))
        launcher.launch(LIST, len(box), (box, self.first, tiles_x), (tile, surfel))
        self.tile, self.number = torch.sort(tile, stable=True)
        self.surfel = surfel[self.number]
        every = torch.arange(tiles_x * tiles_y + 1, device=box.device, dtype=tile.dtype)
        self.start = torch.searchsorted(self.tile, every)


def starts(counts: Tensor) -> tuple[Tensor, int]:
    """Prefix sum of the lengths of runs (m,): (m + 1,) int64, and its last value as a number.

    Raises
    ------
    DeviceError
        When that is beyond what Warp counts.
    """
    ends = torch.nn.functional.pad(torch.cumsum(counts, 0), (1, 0))
    last = int(ends[-1])
    if last > _MOST:
        raise DeviceError("a view", f"shows {last} pixels of surfels", "Use smaller photographs or the CPU")
    return ends, last
