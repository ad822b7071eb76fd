"""Light gathered at pixels, differentiable in radiance, roughness and normals: `estimator` for torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import Mesh
from ...core.frame import World
from ...render.lights.environment import EnvironmentLight
from ...render.sampling import F, point_set
from ...render.scene.triangle_bvh import TriangleBVH
from .estimator import SUMS, Lobes, Occluder, Plan, Points, Samples, Sky, Sums, gather, scatter

Array = np.ndarray

#: Part of the scene's size by which rays start above the surface: more than facets stand off the smooth shape.
_LIFT = 5e-4
#: Parts in which texel gradients are summed: a fixed number, so that threads do not change the result.
_PARTS = 8


class Gatherer:
    """Draws directions at pixels and sums what arrives along them.

    Parameters
    ----------
    mesh : Mesh
        Mesh that rays are traced against.
    tree : TriangleBVH
        Of its triangles, or of nothing where nothing is in the way.
    cache : (v, 4, 3) float32 array or None
        See `radiance_cache.radiance_cache`; None: what hits the mesh is black.
    counts : tuple of int
        Even numbers of cosine, GGX and light samples a pixel.
    normals : bool
        Whether derivatives by the normals are wanted.
    """

    def __init__(
        self, mesh: Mesh, tree: TriangleBVH, cache: Array | None, counts: tuple[int, int, int], normals: bool = False
    ) -> None:
        self._tree, self._normals = tree, normals
        self._plan = Plan(np.array(counts, np.int64), point_set(max(counts) + 1))
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        lift = F(_LIFT * float(np.linalg.norm(high - low)))
        own = np.zeros((1, 4, 3), np.float32) if cache is None else np.ascontiguousarray(cache, np.float32)
        self._occluder = Occluder(tree.intersect_address, tree.scene, mesh.faces, own, cache is not None, lift)
        self._light: EnvironmentLight | None = None

    def aim(self, radiance: Array) -> None:
        """Draw light samples in proportion to (h, w, 3) `radiance` from now on."""
        self._light = EnvironmentLight(World(environment=np.ascontiguousarray(radiance, np.float32)))

    def __call__(self, points: Points, normal: Tensor, alpha2: Tensor, radiance: Tensor) -> Tensor:
        """The sums of `points`.

        Parameters
        ----------
        points : Points
        normal : (n, 3) tensor
            Unit shading normals.
        alpha2 : (n,) tensor
            Square of GGX's alpha.
        radiance : (h, w, 3) tensor
            Lat-long, of the size given to `aim`.

        Returns
        -------
        (n, 2, 4, 3) tensor
            D, S, P, E from either half of the samples, each an estimate of its own.
        """
        return _Gather.apply(normal, alpha2, radiance, self, points)

    def run(self, points: Points, normal: Array, alpha2: Array, radiance: Array) -> tuple[Array, Array, Array, Samples]:
        """Sums, their derivatives by alpha2 and by the normal (n, 2, 4, 3[, 3]), and the samples."""
        if self._light is None:
            self.aim(radiance)
        assert self._light is not None
        n, s = len(alpha2), int(self._plan.counts.sum())
        by_normal = np.zeros((n if self._normals else 0, 2, SUMS, 9), np.float32)
        values, by_a2 = np.zeros((2, n, 2, SUMS, 3), np.float32)
        sums = Sums(values, by_a2, by_normal)
        samples = Samples(
            np.empty((n, s, 4), np.int32), np.empty((n, s, 4), np.float32), np.empty((n, s, 4), np.float32)
        )
        height, width = radiance.shape[:2]
        lobes = Lobes(np.ascontiguousarray(normal), np.ascontiguousarray(alpha2))
        flat = np.ascontiguousarray(radiance).reshape(-1, 3)
        sky = Sky(flat, np.int32(height), np.int32(width))
        self._gather(points, lobes, sky, self._light, sums, samples)
        # Weights are of all samples together: either half alone has half of the sum.
        for array in sums:
            array *= 2
        return sums.values, sums.by_a2, by_normal.reshape(*by_normal.shape[:3], 3, 3), samples

    def _gather(
        self, points: Points, lobes: Lobes, sky: Sky, light: EnvironmentLight, sums: Sums, samples: Samples
    ) -> None:
        """`gather_point` of all points."""
        gather(points, lobes, self._plan, self._occluder, sky, light.envmap, sums, samples)


class _Gather(torch.autograd.Function):
    """`Gatherer.run` with its derivatives."""

    @staticmethod
    def forward(
        ctx: Any, normal: Tensor, alpha2: Tensor, radiance: Tensor, gatherer: Gatherer, points: Points
    ) -> Tensor:
        sums, by_a2, by_normal, samples = gatherer.run(
            points, normal.detach().numpy(), alpha2.detach().numpy(), radiance.detach().numpy()
        )
        ctx.kept = by_a2, by_normal, samples, tuple(radiance.shape)
        return torch.from_numpy(sums)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        by_a2, by_normal, samples, shape = ctx.kept
        gradient = gradients[0]
        for_alpha2 = (gradient * torch.from_numpy(by_a2)).sum((1, 2, 3))
        for_normal = None
        if len(by_normal):
            for_normal = (gradient.unsqueeze(-1) * torch.from_numpy(by_normal)).sum((1, 2, 3))
        for_radiance = None
        if ctx.needs_input_grad[2]:
            parts = np.zeros((_PARTS, shape[0] * shape[1], 3), np.float32)
            # The factor two of either half, as in `Gatherer.run`.
            scatter(samples, np.ascontiguousarray((2 * gradient).numpy()), parts)
            for_radiance = torch.from_numpy(parts.sum(axis=0).reshape(shape))
        return for_normal, for_alpha2, for_radiance, None, None
