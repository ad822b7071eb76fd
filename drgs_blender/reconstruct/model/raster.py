"""Differentiable rasteriser of surfels: the maps of the paper's rasterisation equation, and their gradients.

Kernel and strengths are those of `render.surfels.raster` with one sample a pixel; here surfels are blended in the
order of their centres (one sort a view), which has gradients everywhere, and means are not divided by coverage.
With T_i = prod_{j<i} (1 - a_j) and w_i = T_i a_i the maps are

    features  sum w_i f_i         depth  sum w_i z_i         alpha  sum w_i
    distortion  sum_{j<i} w_i w_j (z_i - z_j)^2      (Huang et al. 2024, "2D Gaussian Splatting", of metres)
    median  z of the contribution at which T falls below one half; 0 where it never does

Backwards a pixel is walked front to back once more: dL/da_i = T_i g_i - (S - R_i) / (1 - a_i), where g_i is the
gradient of w_i, S the sum of all w_j g_j (known from the maps themselves) and R_i the part of it up to i. Gradients of
a surfel are summed within a tile, kept by (surfel, tile), then summed in the order of tiles: the same bits with any
number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ...core.errors import UsageError
from ...core.frame import Camera, RenderSettings
from ...render.camera import CLIP_END, CLIP_START, camera_parameters
from ...render.surfels.splats import TILE, depth_order, list_by_tile
from .blend import DISTORTION, FEATURES, MEDIAN, Splats, T, Tiles, Z, blend
from .blend_backward import BEFORE, SCREEN_GRADIENT, blend_backward, sum_slots
from .projection import OPACITY, RECORD, Projected, WorldSurfels, project, project_backward


@dataclass(slots=True)
class Maps:
    """Maps of a view: features (h, w, c), the others (h, w); see the module."""

    features: Tensor
    alpha: Tensor
    depth: Tensor
    median: Tensor
    distortion: Tensor


@dataclass(slots=True)
class GradientStatistics:
    """Gradient statistics of surfels, collected by backward passes for densification.

    Attributes
    ----------
    gradient : (n,) float32 tensor
        += sum over pixels of |dL/dx| + |dL/dy| of the projected centre (Ye et al. 2024, "AbsGS": absolute values, so
        that pixels that pull in opposite directions do not cancel).
    views : (n,) int32 tensor
        += 1 where the surfel was listed in a tile.
    """

    gradient: Tensor
    views: Tensor

    @classmethod
    def of(cls, n: int, place: torch.device | None = None) -> GradientStatistics:
        """Empty statistics of `n` surfels."""
        return cls(torch.zeros(n, device=place), torch.zeros(n, dtype=torch.int32, device=place))


def rasterise(
    centre: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    opacity: Tensor,
    features: Tensor,
    camera: Camera,
    statistics: GradientStatistics | None = None,
) -> Maps:
    """Blend surfels into the maps of a view; differentiable in all tensors.

    Parameters
    ----------
    centre, tangent_u, tangent_v : (n, 3) float32 tensor
        World space, tangents scaled by the standard deviations.
    opacity : (n,) float32 tensor
    features : (n, c) float32 tensor
        Of any kind.
    camera : Camera
        Perspective, the whole picture.
    statistics : GradientStatistics, optional
        Is added to when gradients are computed.

    Raises
    ------
    UsageError: the camera is orthographic or cannot take a picture.
    """
    parameters, size = view_of(camera)
    return Maps(*_Rasterise.apply(centre, tangent_u, tangent_v, opacity, features, parameters, size, statistics))


def view_of(camera: Camera) -> tuple[Array, tuple[int, int]]:
    """`camera_parameters` of a camera that photographs, and the picture's width and height; see `rasterise`."""
    if camera.orthographic:
        raise UsageError("camera", "is orthographic", "Photographs to learn from are perspective")
    return camera_parameters(camera, RenderSettings(subpixel_samples=1), 0), (camera.width, camera.height)


def arranged(
    surfels: WorldSurfels, features: Array, parameters: Array, size: tuple[int, int]
) -> tuple[Array, Splats, Tiles]:
    """Surfels as a view shows them: their rows in the order of the centres, the splats, and which each tile lists.

    Parameters
    ----------
    surfels : WorldSurfels
    features : (n, c) float array
    parameters : array
    size : tuple of int
        Both as of `view_of`.
    """
    n, (width, height) = len(surfels.opacity), size
    seen = Projected(np.empty((n, RECORD), np.float32), np.empty(n, np.float32), np.empty((n, 4), np.int32))
    project(surfels, parameters, size, seen)
    order = depth_order(seen.depth, seen.box)
    values = np.ascontiguousarray(features[order], np.float32)
    near, far = np.float32(parameters[CLIP_START]), np.float32(parameters[CLIP_END])
    splats = Splats(seen.record[order], values, seen.box[order], near, far)
    tiles_x, tiles_y = (width - 1) // TILE + 1, (height - 1) // TILE + 1
    start, listed = list_by_tile(splats.box, 0, 0, tiles_x, tiles_y)
    return order, splats, Tiles(start, listed, tiles_x)


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, centre: Tensor, tangent_u: Tensor, tangent_v: Tensor, opacity: Tensor, features: Tensor,
        parameters: Array, size: tuple[int, int], statistics: GradientStatistics | None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        given = centre, tangent_u, tangent_v, opacity
        surfels = WorldSurfels(*(np.ascontiguousarray(t.detach().numpy(), np.float32) for t in given))
        order, splats, tiles = arranged(surfels, features.detach().numpy(), parameters, size)
        width, height = size
        maps = np.zeros((height, width, FEATURES + splats.values.shape[1]), np.float32)
        blend(splats, tiles, maps)
        ctx.save = (surfels, parameters, order, splats, tiles, maps, statistics)
        ctx.set_materialize_grads(False)
        out = torch.from_numpy(maps)
        # Copies: the maps are needed as they are for the way back.
        return out[..., FEATURES:].clone(), 1 - out[..., T], *(out[..., k].clone() for k in (Z, MEDIAN, DISTORTION))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        surfels, parameters, order, splats, tiles, maps, statistics = ctx.save
        height, width, _ = maps.shape
        n, channels = len(surfels.opacity), splats.values.shape[1]
        incoming = np.zeros((height, width, 4 + channels), np.float32)
        g_features, *others = gradients
        for k, g in enumerate(others):
            if g is not None:
                incoming[..., k] = g.numpy()
        if g_features is not None:
            incoming[..., 4:] = g_features.numpy()
        slots = np.zeros((len(tiles.listed), BEFORE + channels), np.float32)
        blend_backward(splats, tiles, maps, incoming, slots)
        total = np.zeros((len(order), BEFORE + channels), np.float32)
        sum_slots(tiles.listed, slots, total)
        found = WorldSurfels(*(np.zeros(a.shape, np.float32) for a in surfels))
        project_backward(surfels, parameters, order, total, found)
        g_values = np.zeros((n, channels), np.float32)
        found.opacity[order], g_values[order] = total[:, OPACITY], total[:, BEFORE:]
        if statistics is not None:
            statistics.gradient.numpy()[order] += total[:, SCREEN_GRADIENT]
            statistics.views.numpy()[order] += 1
        return *(torch.from_numpy(g) for g in (*found, g_values)), None, None, None
