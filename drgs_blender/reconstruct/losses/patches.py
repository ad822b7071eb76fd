"""Multi-view patch consistency: what a patch of the surface shows in two photographs is the same.

Chen et al. 2024, "PGSR". A pixel's depth and normal are a plane, by which its patch of the photograph is found in a
neighbouring one (a homography); the loss is 1 - NCC, normalised cross-correlation of grey. Value and gradient come in
one pass over the pixels.

With r the ray of a pixel, N and d normal and depth of the patch's centre p, c from the other eye to this one and M the
other camera, pixel q of the patch is seen at h(q) = (N . r_q) M c + d (N . r_p) M r_q, up to a factor: linear in d, and
in N for any length of it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from ...core.arrays import Array
from ...core.frame import Camera
from ..meshing.visual_hull import world_to_pixel

#: Pixels from the centre of a patch to its edge, and how many it has.
REACH = 3
TAPS = (2 * REACH + 1) ** 2
#: Added to the variance of patches, of greys of 0..1: what is fainter is noise.
FAINT = np.float32(1e-4)
#: Least cosine at which a patch is seen.
GRAZING = np.float32(0.17)
#: Pixels by which a point may come back displaced from the other view.
DISPLACED = np.float32(1.0)


class Pair(NamedTuple):
    """Two views of one place.

    Attributes
    ----------
    there : (3, 4) float32 array
        From a point relative to this eye to x z, y z and z in the other view, metres.
    back : (3, 4) float32 array
        From x z, y z, z of the other view to the same in this one.
    """

    there: Array
    back: Array

    @classmethod
    def of(cls, camera: Camera, other: Camera) -> Pair:
        """The pair of two cameras."""
        ours, theirs = world_to_pixel(camera), world_to_pixel(other)
        eye = np.append(np.asarray(camera.matrix_world, np.float64)[:3, 3], 1)
        there = np.column_stack([theirs[:, :3], theirs @ eye])
        turn = ours[:, :3] @ np.linalg.inv(theirs[:, :3])
        return cls(there.astype(np.float32), np.column_stack([turn, -turn @ there[:, 3]]).astype(np.float32))


def patch_loss(
    depth: Tensor, normal: Tensor, counts: Array, rays: Array, greys: tuple[Array, Array], behind: Array, pair: Pair,
    spread: float,
) -> Tensor:  # fmt: skip
    """Mean over the picture of weight (1 - NCC); differentiable in depth and normal.

    Parameters
    ----------
    depth : (h, w) tensor
        Metres along the view, 0 where nothing is seen.
    normal : (h, w, 3) tensor
        Facing the viewer, of any length.
    counts : (h, w) float32 array
        Weight of each pixel.
    rays : (h, w, 3) float32 array
        `training_views.pixel_rays`.
    greys : tuple of array
        Photographs of this view (h, w) and of the other (k, l), float32 grey in 0..1, sRGB-encoded.
    behind : (k, l) float32 array
        Depth that the other view, of k x l pixels, has, 0 where nothing is seen.
    pair : Pair
    spread : float
        Difference of a patch's mean grey between both at which its weight has fallen to 1 / e: what mirrors looks
        different from elsewhere. 0: all count alike.
    """
    return _Patches.apply(depth, normal, counts, rays, greys, behind, pair, spread)


class _Patches(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, depth: Tensor, normal: Tensor, counts: Array, rays: Array, greys: tuple[Array, Array],
        behind: Array, pair: Pair, spread: float,
    ) -> Tensor:  # fmt: skip
        z, n = (np.ascontiguousarray(t.detach().numpy()) for t in (depth, normal))
        to_depth, to_normal, rows = np.zeros_like(z), np.zeros_like(n), np.zeros(len(z))
        maps, damping = (z, n, counts, rays), np.float32(1 / spread**2 if spread else 0)
        over_range(_compare, len(z), maps, greys, behind, pair, damping, to_depth, to_normal, rows, fewest=ROWS // 4)
        ctx.gradients = [to_depth, to_normal]
        return torch.tensor(rows.sum() / z.size, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        size = ctx.gradients[0].size
        return *(gradients[0] / size * torch.from_numpy(g) for g in ctx.gradients), *6 * (None,)


@inlined
def _transform(m, x, y, z, w):  # type: ignore[no-untyped-def]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] * w,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] * w,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] * w,
    )


@inlined
def _displacement(depth, ray, x, y, behind, pair):  # type: ignore[no-untyped-def]
    """Pixels by which the surface in the other view, where a pixel's is seen, comes back displaced; 1e9 if unseen."""
    nowhere, half, one = np.float32(1e9), np.float32(0.5), np.float32(1.0)
    hx, hy, hz = _transform(pair.there, depth * ray[0], depth * ray[1], depth * ray[2], one)
    if not hz > 0:
        return nowhere
    u, v = hx / hz - half, hy / hz - half
    if not (u >= 0 and v >= 0 and u < behind.shape[1] - 1 and v < behind.shape[0] - 1):
        return nowhere
    i, j = int(v), int(u)
    a, b = v - np.float32(i), u - np.float32(j)
    z00, z01, z10, z11 = behind[i, j], behind[i, j + 1], behind[i + 1, j], behind[i + 1, j + 1]
    if not min(min(z00, z01), min(z10, z11)) > 0:
        return nowhere
    z = (one - a) * ((one - b) * z00 + b * z01) + a * ((one - b) * z10 + b * z11)
    hx, hy, hz = _transform(pair.back, (u + half) * z, (v + half) * z, z, one)
    if not hz > 0:
        return nowhere
    dx, dy = hx / hz - half - np.float32(x), hy / hz - half - np.float32(y)
    return np.sqrt(dx * dx + dy * dy)


@njit
def _compare(first, last, maps, greys, behind, pair, damping, to_depth, to_normal, rows):  # type: ignore[no-untyped-def]
    depth, normal, counts, rays = maps
    grey, other = greys
    height, width = depth.shape
    one, half = np.float32(1.0), np.float32(0.5)
    patch = np.empty((6, TAPS), np.float32)  # this grey, the other, its slopes, place and scale of the tap
    there = pair.there
    for y in range(max(first, REACH), min(last, height - REACH)):
        total = 0.0
        for x in range(REACH, width - REACH):
            d, weight = depth[y, x], counts[y, x]
            if not (d > 0 and weight > 0):
                continue
            nx, ny, nz = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
            ray = rays[y, x]
            facing = nx * ray[0] + ny * ray[1] + nz * ray[2]
            length = np.sqrt((nx * nx + ny * ny + nz * nz) * (ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2))
            if not facing < -GRAZING * length:
                continue
            displaced = _displacement(d, ray, x, y, behind, pair)
            if not displaced < DISPLACED:
                continue
            weight *= np.exp(-displaced)
            scale = d * facing
            k, usable, mean, other_mean = 0, True, np.float32(0.0), np.float32(0.0)
            for i in range(y - REACH, y + REACH + 1):
                for j in range(x - REACH, x + REACH + 1):
                    q = rays[i, j]
                    s = nx * q[0] + ny * q[1] + nz * q[2]
                    hx, hy, hz = _transform(there, scale * q[0], scale * q[1], scale * q[2], s)
                    # Before the other camera, on the same side of the plane, and where the surface is.
                    if not (s < 0 and hz < 0 and depth[i, j] > 0):
                        usable = False
                        break
                    u, v = hx / hz - half, hy / hz - half
                    if not (u >= 0 and v >= 0 and u < other.shape[1] - 1 and v < other.shape[0] - 1):
                        usable = False
                        break
                    b, a = int(v), int(u)
                    fy, fx = v - np.float32(b), u - np.float32(a)
                    g00, g01, g10, g11 = other[b, a], other[b, a + 1], other[b + 1, a], other[b + 1, a + 1]
                    top, bottom = g00 + fx * (g01 - g00), g10 + fx * (g11 - g10)
                    g = top + fy * (bottom - top)
                    gx, gy = (g01 - g00) + fy * ((g11 - g10) - (g01 - g00)), bottom - top
                    patch[0, k], patch[1, k] = grey[i, j], g
                    # Derivatives of the other grey by hx, hy, hz.
                    patch[2, k], patch[3, k] = gx / hz, gy / hz
                    patch[4, k] = -(gx * (u + half) + gy * (v + half)) / hz
                    mean += grey[i, j]
                    other_mean += g
                    k += 1
                if not usable:
                    break
            if not usable:
                continue
            mean, other_mean = mean / np.float32(TAPS), other_mean / np.float32(TAPS)
            weight *= np.exp(-damping * (mean - other_mean) ** 2)
            both, ours, theirs = np.float32(0.0), np.float32(TAPS) * FAINT, np.float32(TAPS) * FAINT
            for t in range(TAPS):
                f, g = patch[0, t] - mean, patch[1, t] - other_mean
                both, ours, theirs = both + f * g, ours + f * f, theirs + g * g
            inverse = one / np.sqrt(ours * theirs)
            ncc = both * inverse
            total += weight * (one - ncc)
            by_scale, by_nx, by_ny, by_nz = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            k = 0
            for i in range(y - REACH, y + REACH + 1):
                for j in range(x - REACH, x + REACH + 1):
                    f, g = patch[0, k] - mean, patch[1, k] - other_mean
                    slope = -weight * (f * inverse - ncc * g / theirs)
                    q = rays[i, j]
                    px, py, pz = _transform(there, q[0], q[1], q[2], np.float32(0.0))
                    by_scale += slope * (patch[2, k] * px + patch[3, k] * py + patch[4, k] * pz)
                    by_s = slope * (patch[2, k] * there[0, 3] + patch[3, k] * there[1, 3] + patch[4, k] * there[2, 3])
                    by_nx, by_ny, by_nz = by_nx + by_s * q[0], by_ny + by_s * q[1], by_nz + by_s * q[2]
                    k += 1
            to_depth[y, x] = by_scale * facing
            to_normal[y, x, 0] = by_nx + by_scale * d * ray[0]
            to_normal[y, x, 1] = by_ny + by_scale * d * ray[1]
            to_normal[y, x, 2] = by_nz + by_scale * d * ray[2]
        rows[y] = total
