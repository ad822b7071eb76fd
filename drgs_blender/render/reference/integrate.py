"""The rendering equation in torch: a Monte Carlo estimator like the kernel's, and a quadrature that needs no luck.

Light reaches a point along each of the drawn directions either from the distant light (direct) or from a surface the
ray meets (indirect). All strategies of a point are combined by the balance heuristic, at the first point and at every
further one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from .brdf import alpha_of, dot, evaluate, normalise
from .light import Light, directions_of
from .sampling import balance, pdf_cosine, pdf_ggx, sample_cosine, sample_ggx


@dataclass
class SurfacePoints:
    """Points to light, structure of arrays.

    Attributes
    ----------
    origin : (n, 3) tensor
        Where rays start, safe from self-shadowing.
    normal, geometric_normal : (n, 3) tensor
        Unit, on the viewer's side.
    view : (n, 3) tensor
        Unit, towards the viewer.
    albedo : (n, 3) tensor
    roughness, metallic : (n,) tensor
    """

    origin: Tensor
    normal: Tensor
    geometric_normal: Tensor
    view: Tensor
    albedo: Tensor
    roughness: Tensor
    metallic: Tensor

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, index: Tensor) -> SurfacePoints:
        """The points at `index` (a mask or indices)."""
        return SurfacePoints(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


class Tracer(Protocol):
    """Interface of ray tracers: the surface along a ray; anything with this method can replace `TriangleTracer`."""

    def closest(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, SurfacePoints]:
        """Mask (n,) of the rays that hit, and the k points they hit, in order, ready to be lit."""


class EmptyTracer:
    """Tracer of an empty scene: rays hit nothing."""

    def closest(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, SurfacePoints]:
        """See `Tracer`."""
        none = origin[:0]
        hit = torch.zeros(len(origin), dtype=torch.bool, device=origin.device)
        return hit, SurfacePoints(none, none, none, none, none, none[:, 0], none[:, 0])


class TriangleTracer:
    """Every ray against every triangle, in chunks: for small scenes.

    The ray meets the plane of a triangle at corner + v edge1 + w edge2; v and w are linear in the point, so that the
    whole is a few matrix products.

    Parameters
    ----------
    vertices : (n, 3) tensor
        World space.
    faces : (m, 3) tensor
    albedo : (n, 3) tensor
        Per vertex; may require gradients.
    roughness, metallic : (n,) tensor
        Per vertex; may require gradients.
    corner_normals : (m, 3, 3) tensor, optional
        Unit, or None for flat shading.
    offset : float
        Metres by which points are lifted off the surface they lie on.
    batch_size : int
        Ray-face pairs tested at once.
    """

    def __init__(
        self,
        vertices: Tensor,
        faces: Tensor,
        albedo: Tensor,
        roughness: Tensor,
        metallic: Tensor,
        corner_normals: Tensor | None = None,
        offset: float = 1e-5,
        batch_size: int = 1 << 18,
    ) -> None:
        self.faces = faces.long()
        with torch.no_grad():
            corner, b, c = vertices[self.faces].unbind(1)
            edge1, edge2 = b - corner, c - corner
            across = torch.linalg.cross(edge1, edge2)
            area2 = (across**2).sum(-1, keepdim=True)
            # Plane normal and dual basis of the edges, each with its value at the corner.
            self.planes = [across, torch.linalg.cross(edge2, across) / area2, torch.linalg.cross(across, edge1) / area2]
            self.levels = [dot(plane, corner) for plane in self.planes]
            self.face_normal = across / torch.sqrt(area2)
        self.albedo, self.roughness, self.metallic = albedo, roughness, metallic
        self.corner_normals, self.offset, self.batch_size = corner_normals, offset, batch_size

    @torch.no_grad()
    def _search(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distance (inf where nothing is hit), face and barycentric coordinates (v, w) of the nearest hits."""
        start, v, w = (origin @ plane.T - level for plane, level in zip(self.planes, self.levels))
        slope, v_slope, w_slope = (direction @ plane.T for plane in self.planes)
        t = -start / slope
        v, w = v + t * v_slope, w + t * w_slope
        inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (t > 0)
        t, face = torch.where(inside, t, torch.inf).min(1)
        rows = torch.arange(len(t), device=t.device)
        return t, face, torch.stack([v[rows, face], w[rows, face]], -1)

    def closest(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, SurfacePoints]:
        """See `Tracer`."""
        step = max(1, self.batch_size // max(1, len(self.faces)))
        if not len(origin) or not len(self.faces):
            return EmptyTracer().closest(origin, direction)
        found = [self._search(o, d) for o, d in zip(origin.split(step), direction.split(step))]
        t, face, vw = (torch.cat(part) for part in zip(*found))
        hit = torch.isfinite(t)
        t, face, vw, origin, direction = t[hit], face[hit], vw[hit], origin[hit], direction[hit]
        weights = torch.cat([1 - vw.sum(-1, keepdim=True), vw], -1)
        corners = self.faces[face]
        facing = self.face_normal[face]
        facing = torch.where((dot(facing, direction) > 0).unsqueeze(-1), -facing, facing)
        normal = facing
        if self.corner_normals is not None:
            normal = normalise((weights.unsqueeze(-1) * self.corner_normals[face]).sum(1))
            normal = torch.where((dot(normal, facing) < 0).unsqueeze(-1), -normal, normal)
        points = SurfacePoints(
            origin=origin + t.unsqueeze(-1) * direction + self.offset * facing,
            normal=normal,
            geometric_normal=facing,
            view=-direction,
            albedo=(weights.unsqueeze(-1) * self.albedo[corners]).sum(1),
            roughness=(weights * self.roughness[corners]).sum(1),
            metallic=(weights * self.metallic[corners]).sum(1),
        )
        return hit, points


@dataclass(frozen=True)
class Counts:
    """Directions drawn at a point by each strategy."""

    cosine: int = 16
    ggx: int = 8
    environment: int = 8


#: Products of points and grid cells that the quadrature holds at once.
_CELLS_AT_ONCE = 1 << 17
#: What is drawn at every point after the first.
SECONDARY = Counts(1, 1, 1)


@torch.no_grad()
def draw(points: SurfacePoints, light: Light, counts: Counts, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Directions (n, s, 3) of all strategies and 1 / balance (n, s), zero for those below the surface."""
    n, dtype, device = len(points), points.origin.dtype, points.origin.device

    def uniform(count: int, width: int) -> Tensor:
        return torch.rand(n, count, width, dtype=dtype, device=device, generator=generator)

    normal, view = points.normal[:, None], points.view[:, None]
    alpha = alpha_of(points.roughness)[:, None]
    directions = torch.cat(
        [
            sample_cosine(normal, uniform(counts.cosine, 2)),
            sample_ggx(normal, view, alpha, uniform(counts.ggx, 2)),
            light.sample(uniform(counts.environment, 3)),
        ],
        1,
    )
    densities = [pdf_cosine(normal, directions), pdf_ggx(normal, view, directions, alpha), light.pdf(directions)]
    numbers = torch.tensor([counts.cosine, counts.ggx, counts.environment], dtype=dtype, device=device)
    total = balance(torch.stack(densities, -1), numbers)
    above = (dot(normal, directions) > 0) & (dot(points.geometric_normal[:, None], directions) > 0) & (total > 0)
    return directions, torch.where(above, 1 / total, torch.zeros_like(total))


def integrate(
    tracer: Tracer,
    light: Light,
    points: SurfacePoints,
    counts: Counts = Counts(),
    bounces: int = 1,
    shading_model: str = "principled",
    generator: torch.Generator | None = None,
    samples: bool = False,
) -> Tensor:
    """Estimate the light that leaves `points` towards their viewers.

    Directions and densities carry no gradient; radiance, materials and normals do.

    Parameters
    ----------
    tracer : Tracer
    light : Light
    points : SurfacePoints
    counts : Counts
    bounces : int
        Surfaces between the point and the light source that are followed; 0 is direct light only.
    shading_model : str
    generator : iterator, optional
    samples : bool
        Return what each drawn direction contributes instead of the sum.

    Returns
    -------
    (n, 4, 3) tensor
        Diffuse direct, diffuse indirect, glossy direct, glossy indirect; (n, s, 4, 3) with `samples`.
    """
    generator = generator or torch.Generator(device=points.origin.device).manual_seed(0)
    directions, weight = draw(points, light, counts, generator)

    def follow(met: SurfacePoints) -> Tensor:
        return integrate(tracer, light, met, SECONDARY, bounces - 1, shading_model, generator).sum(1)

    result = _gather(tracer, light, points, directions, weight, shading_model, follow if bounces > 0 else None)
    return result if samples else result.sum(1)


def integrate_quadrature(
    tracer: Tracer,
    light: Light,
    points: SurfacePoints,
    rows: int = 256,
    shading_model: str = "principled",
    bounces: int = 0,
) -> Tensor:
    """`integrate` without chance: the midpoint rule on a lat-long grid of `rows` x 2 `rows` cells of the sphere.

    The grid is that of the light's picture, so with a multiple of its rows the radiance is integrated to second
    order. Indirect light takes a grid of an eighth at the next surface; a bounce multiplies the cost by that many
    cells. Returns (n, 4, 3).
    """
    dtype, device = points.origin.dtype, points.origin.device
    v = (torch.arange(rows, dtype=dtype, device=device) + 0.5) / rows
    u = (torch.arange(2 * rows, dtype=dtype, device=device) + 0.5) / (2 * rows)
    grid = directions_of(*torch.meshgrid(u, v, indexing="xy")).reshape(-1, 3) @ light.rotation
    edges = torch.cos(torch.linspace(0, math.pi, rows + 1, dtype=dtype, device=device))
    solid_angle = ((edges[:-1] - edges[1:]) * math.pi / rows).repeat_interleave(2 * rows)

    def follow(met: SurfacePoints) -> Tensor:
        return integrate_quadrature(tracer, light, met, max(rows // 8, 8), shading_model, bounces - 1).sum(1)

    parts = [torch.zeros(0, 4, 3, dtype=dtype, device=device)]
    block = max(1, _CELLS_AT_ONCE // len(grid))
    for first in range(0, len(points), block):
        some = points.select(torch.arange(first, min(first + block, len(points)), device=device))
        above = (some.normal @ grid.T > 0) & (some.geometric_normal @ grid.T > 0)
        weight = torch.where(above, solid_angle, torch.zeros_like(solid_angle))
        directions = grid.expand(len(some), -1, 3)
        parts.append(
            _gather(tracer, light, some, directions, weight, shading_model, follow if bounces > 0 else None).sum(1)
        )
    return torch.cat(parts)


def _gather(
    tracer: Tracer,
    light: Light,
    points: SurfacePoints,
    directions: Tensor,
    weight: Tensor,
    shading_model: str,
    follow: Callable[[SurfacePoints], Tensor] | None,
) -> Tensor:
    """What arrives along `directions` (n, s, 3), reflected and weighted: (n, s, 4, 3)."""
    n, s = weight.shape
    diffuse, glossy = evaluate(
        points.normal[:, None],
        points.view[:, None],
        directions,
        points.albedo[:, None],
        points.roughness[:, None],
        points.metallic[:, None],
        shading_model,
    )
    reflected = torch.stack([diffuse, glossy], 2) * weight[..., None, None]
    # Only what can carry light is traced.
    live = (weight > 0).flatten().nonzero().squeeze(1)
    origin = points.origin[:, None].expand(n, s, 3).reshape(-1, 3)[live]
    ray = directions.reshape(-1, 3)[live]
    hit, met = tracer.closest(origin, ray)
    blank = torch.zeros(n * s, 3, dtype=weight.dtype, device=weight.device)
    direct = blank.index_put((live[~hit],), light.radiance(ray[~hit]))
    indirect = blank
    if follow is not None and len(met):
        indirect = blank.index_put((live[hit],), follow(met))
    arriving = torch.stack([direct, indirect], 1).reshape(n, s, 1, 2, 3)
    return (reflected.unsqueeze(3) * arriving).reshape(n, s, 4, 3)


def tracer_from_arrays(
    vertices: np.ndarray,
    faces: np.ndarray,
    albedo: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    corner_normals: np.ndarray | None = None,
    dtype: torch.dtype = torch.float64,
) -> TriangleTracer:
    """A `TriangleTracer` of numpy arrays (see asset.Mesh)."""

    def tensor(values: np.ndarray) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=dtype)

    normals = None if corner_normals is None else tensor(corner_normals)
    indices = torch.as_tensor(np.asarray(faces))
    return TriangleTracer(tensor(vertices), indices, tensor(albedo), tensor(roughness), tensor(metallic), normals)
