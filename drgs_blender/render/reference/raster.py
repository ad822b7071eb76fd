"""Surfels to a G-buffer in torch: every surfel against every pixel, differentiable in all of a surfel's parameters.

The ray of a pixel meets the plane of a surfel at centre + u tangent_u + v tangent_v, where the Gaussian is
exp(-(u^2 + v^2) / 2) (Huang et al. 2024, "2D Gaussian Splatting", with the intersection solved for tangents of any
length and angle). A screen-space Gaussian around the projected centre keeps surfels that are small or seen edge-on
from vanishing between pixels. Contributions are blended front to back.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import PosedSurfels
from ...core.frame import Camera
from .brdf import dot, normalise

#: Variance of the screen-space filter, square pixels.
FILTER_VARIANCE = 0.5
#: Alpha of a contribution: fainter ones are skipped, stronger ones clamped.
MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.99
#: Blending stops once no more than this part of the background is left.
MIN_TRANSMITTANCE = 1e-4
#: Least part of the filter's area that a surfel fills.
LEAST_SHARE = 1e-4
#: Behind the depth where coverage is full, pixels times the root of the samples per pixel, and contributions at most.
BEHIND, MOST_BEHIND = 9.4, 512
#: Sine of the angle between ray and plane below which the intersection is not used.
MIN_SINE = 1e-6


@dataclass
class Splats:
    """The tensors of PosedSurfels: world space, tangents scaled, see there."""

    centre: Tensor
    tangent_u: Tensor
    tangent_v: Tensor
    normal: Tensor
    opacity: Tensor
    albedo: Tensor
    roughness: Tensor
    metallic: Tensor

    @classmethod
    def from_posed(cls, posed: PosedSurfels, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Splats:
        """Copy of `posed` as tensors."""
        values = {
            f.name: torch.as_tensor(np.asarray(getattr(posed, f.name)), dtype=dtype, device=device) for f in fields(cls)
        }
        return cls(**values)


@dataclass
class ReferenceGBuffer:
    """One row a pixel position. Empty pixels have coverage 0 and zeros elsewhere.

    Attributes
    ----------
    coverage : (p,) tensor
        1 - prod(1 - alpha_i).
    depth : (p,) tensor
        Metres along the view axis, mean of the contributions by weight.
    position : (p, 3) tensor
        World: the point of the pixel's ray at that depth.
    normal : (p, 3) tensor
        Unit, world, facing the viewer.
    albedo : (p, 3) tensor
        Means by weight.
    roughness, metallic : (p,) tensor
        Means by weight.
    """

    coverage: Tensor
    depth: Tensor
    position: Tensor
    normal: Tensor
    albedo: Tensor
    roughness: Tensor
    metallic: Tensor


def pixel_centres(camera: Camera, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    """(h * w, 2) positions of the centres of the pixels in the camera's window, row by row."""
    x0, y0, x1, y1 = camera.window
    x = torch.arange(x0, x1, dtype=dtype, device=device) + 0.5
    y = torch.arange(y0, y1, dtype=dtype, device=device) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def camera_rays(camera: Camera, position: Tensor) -> tuple[Tensor, Tensor]:
    """World-space rays of pixel positions (p, 2): origins and directions (p, 3); a direction has unit depth."""
    matrix = torch.as_tensor(np.asarray(camera.matrix_world), dtype=position.dtype, device=position.device)
    x = (position[:, 0] - camera.cx) / camera.fx
    y = -(position[:, 1] - camera.cy) / camera.fy
    zero, minus = torch.zeros_like(x), -torch.ones_like(x)
    start = torch.stack([x, y, zero], -1) if camera.orthographic else torch.stack([zero, zero, zero], -1)
    along = torch.stack([zero, zero, minus], -1) if camera.orthographic else torch.stack([x, y, minus], -1)
    return start @ matrix[:3, :3].T + matrix[:3, 3], along @ matrix[:3, :3].T


def project(camera: Camera, point: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel position (n, 2) and view depth (n,) of world points (n, 3)."""
    matrix = torch.as_tensor(np.asarray(camera.matrix_world), dtype=point.dtype, device=point.device)
    x, y, z = ((point - matrix[:3, 3]) @ matrix[:3, :3]).unbind(-1)
    depth = -z
    scale = torch.ones_like(depth) if camera.orthographic else torch.where(depth == 0, torch.ones_like(depth), depth)
    return torch.stack([camera.cx + camera.fx * x / scale, camera.cy - camera.fy * y / scale], -1), depth


def intersect(splats: Splats, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Squared Gaussian radius u^2 + v^2, ray parameter and validity (p, n) of each ray in each surfel's plane."""
    across = torch.linalg.cross(splats.tangent_u, splats.tangent_v)
    area2 = (across**2).sum(-1)
    area2 = torch.where(area2 > 0, area2, torch.ones_like(area2))  # of no area: never valid
    slope = direction @ across.T
    length = torch.linalg.vector_norm(direction, dim=-1)
    valid = slope.abs() > MIN_SINE * torch.sqrt(area2) * length[:, None]
    towards = splats.centre[None] - origin[:, None]
    t = (towards * across).sum(-1) / torch.where(valid, slope, torch.ones_like(slope))
    offset = t.unsqueeze(-1) * direction[:, None] - towards
    # Dual basis of the tangents in their plane: u = offset . dual_u, v = offset . dual_v.
    dual_u = torch.linalg.cross(splats.tangent_v, across) / area2.unsqueeze(-1)
    dual_v = torch.linalg.cross(across, splats.tangent_u) / area2.unsqueeze(-1)
    return dot(offset, dual_u) ** 2 + dot(offset, dual_v) ** 2, t, valid


def rasterise(
    splats: Splats,
    camera: Camera,
    position: Tensor | None = None,
    gap: float | None = None,
    samples: int = 1,
    batch_size: int = 1 << 18,
) -> ReferenceGBuffer:
    """G-buffer of surfels at pixel positions.

    Contribution i covers c_i = opacity_i max(G_3d, G_2d cosine), with the cosine at which it is seen, at most
    `MAX_ALPHA`, skipped below `MIN_ALPHA`. Its depth is that of the ray's intersection where G_3d is the larger, else
    that of the centre; there its strength a_i is c_i times the part of the filter's area that it fills, else c_i.
    Sorted by depth, T_i = prod_{j<i} (1 - a_j) and the weights of the means are T_i a_i / sum; coverage is
    1 - prod (1 - c_i). A contribution counts while T_i is at least `MIN_TRANSMITTANCE`, and so is what those before
    leave uncovered, or it is not `BEHIND` that depth nor beyond `MOST_BEHIND`. Normals are turned to agree with the
    nearest contribution's, their mean to the viewer.

    Parameters
    ----------
    splats : Splats
    camera : Camera
    position : (p, 2) tensor, optional
        Pixel positions; the pixel centres of the camera's window by default.
    gap : float, optional
        Split the contributions where the depth jumps by more than this many times the mean size of the surfels on both
        sides (the larger standard deviation, at least a pixel), and describe the heaviest part alone; coverage is that
        of all. None blends all contributions.
    samples : int
        Positions a pixel; the low-pass filter is that much narrower in variance.
    batch_size : int
        Surfel-pixel pairs held at once.
    """
    if position is None:
        position = pixel_centres(camera, splats.centre.dtype, str(splats.centre.device))
    step = max(1, batch_size // max(1, len(splats.centre)))
    parts = [_blend(splats, camera, p, gap, samples) for p in position.split(step)]
    return ReferenceGBuffer(
        **{f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(ReferenceGBuffer)}
    )


def _heaviest_part(depth: Tensor, weight: Tensor, size: Tensor, gap: float) -> Tensor:
    """Mask (p, n) of the contributions, sorted by depth, in the heaviest run without a jump of the depth."""
    counts, n = weight > 0, weight.shape[1]
    place = torch.arange(n, device=weight.device).expand_as(weight)
    last = torch.cummax(torch.where(counts, place, torch.zeros_like(place)), 1).values
    previous = torch.cat([torch.zeros_like(last[:, :1]), last[:, :-1]], 1)
    jump = depth - depth.gather(1, previous) > 0.5 * gap * (size + size.gather(1, previous))
    follows = torch.cumsum(counts, 1) > 1  # the first contribution begins the first run
    run = torch.cumsum(jump & counts & follows, 1)
    total = torch.zeros_like(weight).scatter_add(1, run, weight)
    return (run == total.argmax(1, keepdim=True)) & counts


def _facing(splats: Splats, camera: Camera) -> Tensor:
    """(n,) cosine at which each surfel is seen; 1 for one without area."""
    matrix = torch.as_tensor(np.asarray(camera.matrix_world), dtype=splats.centre.dtype, device=splats.centre.device)
    towards = matrix[:3, 2].expand_as(splats.centre) if camera.orthographic else matrix[:3, 3] - splats.centre
    normal = torch.linalg.cross(splats.tangent_u, splats.tangent_v)
    cosine = (dot(normal, towards) / (normal.norm(dim=1) * towards.norm(dim=1)).clamp(min=1e-30)).abs()
    return torch.where(normal.norm(dim=1) > 0, cosine, torch.ones_like(cosine))


def _share(splats: Splats, camera: Camera, depth: Tensor, samples: int) -> Tensor:
    """(n,) part of the area of the low-pass filter that each surfel, seen face-on, fills."""
    scale = (samples * camera.fx * camera.fy / FILTER_VARIANCE) ** 0.5
    scale = scale if camera.orthographic else scale / depth.abs().clamp(min=1e-30)
    along_u = (scale * torch.linalg.vector_norm(splats.tangent_u, dim=-1)).clamp(max=1)
    along_v = (scale * torch.linalg.vector_norm(splats.tangent_v, dim=-1)).clamp(max=1)
    return (along_u * along_v).clamp(min=LEAST_SHARE)


def _left_before(alpha: Tensor) -> Tensor:
    """(p, n) what the contributions before each leave."""
    left = torch.cumprod(1 - alpha, 1)
    return torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)


def _blend(splats: Splats, camera: Camera, position: Tensor, gap: float | None, samples: int) -> ReferenceGBuffer:
    if not len(splats.centre):
        empty, rows = position.new_zeros(len(position)), position.new_zeros(len(position), 3)
        return ReferenceGBuffer(empty, empty, rows, rows, rows, empty, empty)
    origin, direction = camera_rays(camera, position)
    radius2, t, valid = intersect(splats, origin, direction)
    in_range = (t > camera.clip_start) & (t < camera.clip_end)
    inside = torch.exp(-0.5 * torch.where(valid & in_range, radius2, torch.inf))
    centre, centre_depth = project(camera, splats.centre)
    distance2 = ((position[:, None] - centre) ** 2).sum(-1)
    seen = (centre_depth > camera.clip_start) & (centre_depth < camera.clip_end)
    around = torch.exp(-0.5 * samples / FILTER_VARIANCE * torch.where(seen, distance2, torch.inf))
    around = around * _facing(splats, camera)

    depth = torch.where(inside >= around, t, centre_depth.expand_as(t))
    cover = (splats.opacity * torch.maximum(inside, around)).clamp(max=MAX_ALPHA)
    cover = torch.where(cover >= MIN_ALPHA, cover, torch.zeros_like(cover))
    alpha = torch.where(inside >= around, cover, cover * _share(splats, camera, centre_depth, samples))
    order = torch.argsort(depth.detach(), dim=1, stable=True)
    alpha, cover, depth = alpha.gather(1, order), cover.gather(1, order), depth.gather(1, order)
    before, uncovered = _left_before(alpha), _left_before(cover)
    with torch.no_grad():
        pixel = (1.0 if camera.orthographic else depth) / min(camera.fx, camera.fy)
        full = (uncovered * (1 - cover) < MIN_TRANSMITTANCE) & (cover > 0)
        end = torch.where(full, depth + BEHIND / samples**0.5 * pixel, torch.inf)
        end = torch.where(full.any(1), end.gather(1, full.to(torch.int8).argmax(1, keepdim=True))[:, 0], torch.inf)
        among = (depth <= end[:, None]) & (torch.cumsum(cover > 0, 1) <= MOST_BEHIND)
        counts = (before >= MIN_TRANSMITTANCE) & ((uncovered >= MIN_TRANSMITTANCE) | among)
    alpha = torch.where(counts, alpha, torch.zeros_like(alpha))
    weight = before * alpha
    coverage = 1 - torch.where(counts, 1 - cover, torch.ones_like(cover)).prod(1)
    depth = torch.where(weight > 0, depth, torch.zeros_like(depth))
    if gap is not None:
        with torch.no_grad():
            size = torch.linalg.vector_norm(torch.stack([splats.tangent_u, splats.tangent_v]), dim=-1).amax(0)
            pixel = (1.0 if camera.orthographic else depth) / min(camera.fx, camera.fy)
            part = _heaviest_part(depth, weight, torch.maximum(size[order], torch.as_tensor(pixel)), gap)
        weight = torch.where(part, weight, torch.zeros_like(weight))
    total = weight.sum(1, keepdim=True)
    weight = weight / torch.where(total > 0, total, torch.ones_like(total))

    normals = splats.normal[order]
    with torch.no_grad():
        nearest = (weight > 0).to(weight.dtype).argmax(1)
        opposed = dot(normals, normals[torch.arange(len(normals)), nearest].unsqueeze(1)) < 0
        sign = torch.where(opposed, -1.0, 1.0).to(weight.dtype)
    normal = ((weight * sign).unsqueeze(-1) * normals).sum(1)
    normal = torch.where((dot(normal, direction) > 0).unsqueeze(-1), -normal, normal)
    mean_depth = (weight * depth).sum(1)
    covered = (coverage > 0).unsqueeze(-1)
    upright = normalise(torch.where(covered, normal, torch.ones_like(normal)))
    point = origin + mean_depth.unsqueeze(-1) * direction
    return ReferenceGBuffer(
        coverage=coverage,
        depth=mean_depth,
        position=torch.where(covered, point, torch.zeros_like(point)),
        normal=torch.where(covered, upright, torch.zeros_like(upright)),
        albedo=(weight.unsqueeze(-1) * splats.albedo[order]).sum(1),
        roughness=(weight * splats.roughness[order]).sum(1),
        metallic=(weight * splats.metallic[order]).sum(1),
    )
