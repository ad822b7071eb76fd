"""The backend that executes the steps of learning on the CPU; `reconstruct.gpu` has another for a card.

How surfels look, how far that is from a photograph, and the optimiser's step: every iteration goes through a backend,
and so do previews. Tensors are the backend's own: `LearningBackend.device` says where.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..core.arrays import Array
from ..core.asset.model import Mesh
from ..core.frame import Camera
from ..render.scene.triangle_bvh import TriangleBVH
from .capture.training_views import Target
from .inverse_rendering.gatherer import Gatherer
from .losses.patches import Pair, patch_loss
from .losses.photometric import difference
from .losses.shape import shape_loss
from .model.attributes import attributes
from .model.raster import GradientStatistics, Maps, rasterise
from .model.reflection_probe import mirrored
from .optim.adam import descend


class LearningBackend:
    """The CPU, by all threads: numpy's arrays and compiled code behind torch's tensors.

    Attributes
    ----------
    device : torch.device
        Where its tensors are.
    """

    device = torch.device("cpu")

    def bring(self, target: Target) -> Target:
        """Copy a training view to the backend's memory."""
        return target

    def attributes(
        self, parameters: dict[str, Tensor], centre: Tensor, eye: Array, bands: int, reflections: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`attributes.attributes`."""
        return attributes(parameters, centre, eye, bands, reflections)

    def rasterise(
        self, centre: Tensor, tangent_u: Tensor, tangent_v: Tensor, opacity: Tensor, features: Tensor, camera: Camera,
        statistics: GradientStatistics | None = None,
    ) -> Maps:  # fmt: skip
        """`raster.rasterise`."""
        return rasterise(centre, tangent_u, tangent_v, opacity, features, camera, statistics)

    def mirrored(self, features: Tensor, alpha: Tensor, rays: Tensor, texels: Tensor) -> Tensor:
        """`reflection_probe.mirrored`."""
        return mirrored(features, alpha, rays.numpy(), texels)

    def difference(self, picture: Tensor, photograph: Any) -> Tensor:
        """`photometric.difference`; the photograph of what `bring` returned."""
        return difference(picture, photograph)

    def shape_loss(
        self, alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Tensor | None, rays: Tensor,
        counts: Tensor, weights: tuple[float, float, float],
    ) -> Tensor:  # fmt: skip
        """`shape.shape_loss`."""
        known = None if mask is None else mask.numpy()
        return shape_loss(alpha, depth, distortion, normal, known, rays.numpy(), counts.numpy(), weights)

    def patch_loss(
        self, depth: Tensor, normal: Tensor, counts: Tensor, rays: Tensor, greys: tuple[Tensor, Tensor],
        behind: Tensor, pair: Pair, spread: float,
    ) -> Tensor:  # fmt: skip
        """`patches.patch_loss`."""
        grey, other = (g.numpy() for g in greys)
        return patch_loss(depth, normal, counts.numpy(), rays.numpy(), (grey, other), behind.numpy(), pair, spread)

    def descend(self, value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: Array) -> None:
        """`adam.descend`."""
        descend(value, gradient, first, second, rate)

    def gatherer(
        self, mesh: Mesh, tree: TriangleBVH, cache: Array | None, counts: tuple[int, int, int], normals: bool
    ) -> Gatherer:
        """`inverse_rendering.gatherer.Gatherer`."""
        return Gatherer(mesh, tree, cache, counts, normals)


CPU = LearningBackend()
