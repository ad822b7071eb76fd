"""The surfels that are learned: raw parameters, what they mean, how they split and vanish."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ...core.asset.model import Surfels
from ...core.color import srgb_to_linear
from ...core.frame import Camera
from ...formats.harmonics import SH_C0
from ...geometry.normals import quaternions
from ..backend import CPU, LearningBackend
from ..capture.training_views import pixel_rays
from .attributes import COEFFICIENTS, COLOUR, NORMAL, frames
from .raster import GradientStatistics, Maps
from .reflection_probe import dark_cube, pyramid

#: Logit of the tint of surfels that nothing is known of.
MATT = -3.0


@dataclass(slots=True)
class RenderedView:
    """A rendered view of the surfels.

    Attributes
    ----------
    colour : (h, w, 3) tensor
        Over the background, sRGB-encoded.
    normal : (h, w, 3) tensor
        Sum of weighted normals that face the viewer, world space.
    maps : Maps
        Alpha, depth, median, distortion.
    materials : (h, w, c) tensor, optional
        Sum of weighted materials, where they were asked for.
    """

    colour: Tensor
    normal: Tensor
    maps: Maps
    materials: Tensor | None = None


class Gaussians:
    """Surfels as learned: every attribute a float32 tensor of `parameters`, free of bounds.

    ``centre`` (n, 3) world; ``scale`` (n, 2) logarithms; ``rotation`` (n, 4) quaternions wxyz of any length;
    ``opacity`` (n,) logits; ``sh`` (n, k, 3) harmonics of the colour less one half, as in 3D Gaussian splatting;
    ``tint`` (n, 3) and ``blur`` (n,) logits of how much of the `light` around is mirrored, and how blurred.

    Parameters
    ----------
    parameters : dict of str to tensor
    light : tensor, optional
        The cube of `reflection`; None: nothing is mirrored.
    backend : LearningBackend
        Backend that renders them and holds their tensors.
    """

    def __init__(
        self, parameters: dict[str, Tensor], light: Tensor | None = None, backend: LearningBackend = CPU
    ) -> None:
        self.parameters, self.light, self.backend = parameters, light, backend
        if light is not None:
            light.requires_grad_(True)
        for value in parameters.values():
            value.requires_grad_(True)

    @classmethod
    def on_surface(cls, points: Array, normals: Array, colours: Array, size: float, degree: int = 2) -> Gaussians:
        """Discs of standard deviation `size` at `points` (n, 3) with `normals` (n, 3) and sRGB `colours` (n, 3)."""
        n = len(points)
        helper = np.where(np.abs(normals[:, 2:]) < 0.9, (0.0, 0, 1), (1.0, 0, 0))
        u = np.cross(helper, normals)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        sh = np.zeros((n, COEFFICIENTS[degree], 3))
        sh[:, 0] = (colours - 0.5) / SH_C0
        values = {
            "centre": points,
            "scale": np.full((n, 2), math.log(size)),
            "rotation": quaternions(np.stack([u, np.cross(normals, u), normals], -1)),
            "opacity": np.full(n, math.log(0.5 / 0.5)),
            "sh": sh,
            "tint": np.full((n, 3), MATT),
            "blur": np.zeros(n),
        }
        return cls({k: torch.tensor(v, dtype=torch.float32) for k, v in values.items()}, dark_cube())

    def __len__(self) -> int:
        return len(self.parameters["opacity"])

    def frames(self) -> tuple[Array, Array, Array]:
        """Scaled tangents and the normal, (n, 3) each; not differentiated."""
        return frames(*(self.parameters[name].numpy(force=True) for name in ("scale", "rotation")))

    def centres(self) -> Tensor:
        """(n, 3) world positions."""
        return self.parameters["centre"]

    def opacities(self) -> Tensor:
        """(n,) in 0..1."""
        return torch.sigmoid(self.parameters["opacity"])

    def render(
        self,
        camera: Camera,
        background: Tensor,
        bands: int = 3,
        statistics: GradientStatistics | None = None,
        rays: Tensor | None = None,
        reflections: bool = True,
        materials: Tensor | None = None,
        turn: Array | None = None,
    ) -> RenderedView:
        """Render a view over `background`, (3,) or (h, w, 3).

        `rays` are `training_views.pixel_rays` where they are at hand, `materials` (n, c) values to blend as well,
        `turn` that of the view (`View.turn`).
        """
        reflections = reflections and self.light is not None
        centre, eye = self.centres(), np.asarray(camera.matrix_world)[:3, 3]
        u, v, opacity, features = self.backend.attributes(self.parameters, centre, eye, bands, reflections)
        known = features.shape[1]
        if materials is not None:
            features = torch.cat([features, materials], 1)
        maps = self.backend.rasterise(centre, u, v, opacity, features, camera, statistics)
        blended = None if materials is None else maps.features[..., known:]
        maps.features = maps.features[..., :known].contiguous()
        colour = maps.features[..., COLOUR : COLOUR + 3] + (1 - maps.alpha)[..., None] * background
        if reflections:
            assert self.light is not None
            rays = pixel_rays(camera, self.backend.device) if rays is None else rays
            features = maps.features
            if turn is not None:
                to_light = torch.as_tensor(turn, dtype=torch.float32, device=self.backend.device).T
                features, rays = _turned(features, to_light), (rays @ to_light).contiguous()
            colour = colour + self.backend.mirrored(features, maps.alpha, rays, pyramid(self.light))
        return RenderedView(colour, maps.features[..., NORMAL : NORMAL + 3], maps, blended)

    def select(self, rows: Array) -> Gaussians:
        """The surfels `rows`, in this order, as a set of their own."""
        index = torch.from_numpy(np.asarray(rows, np.int64)).to(self.backend.device)
        return self.like({k: v.detach()[index].clone() for k, v in self.parameters.items()})

    def like(self, parameters: dict[str, Tensor]) -> Gaussians:
        """Surfels of the same kind with other parameters."""
        return Gaussians(parameters, self.light, self.backend)

    def on(self, backend: LearningBackend) -> Gaussians:
        """The same surfels with tensors on another backend's device."""
        return Gaussians(*self._tensors_on(backend), backend)

    def _tensors_on(self, backend: LearningBackend) -> tuple[dict[str, Tensor], Tensor | None]:
        """Parameters and light as tensors on a backend's device."""
        light = None if self.light is None else self.light.detach().to(backend.device)
        return {k: v.detach().to(backend.device) for k, v in self.parameters.items()}, light

    def arrays(self) -> dict[str, Array]:
        """The raw parameters."""
        return {k: v.numpy(force=True) for k, v in self.parameters.items()}

    def surfels(self) -> Surfels:
        """Surfels as an asset holds them. The albedo is the mean colour as photographed, light included, decoded."""
        with torch.no_grad():
            raw = self.arrays()
            u, v, normal = self.frames()
            scale = np.exp(raw["scale"])
            frame = np.stack([u / scale[:, :1], v / scale[:, 1:], normal], -1)
            n = len(self)
            sh = raw["sh"].copy()
            if self.light is not None:
                # Harmonics know no mirrors: the mean of what is mirrored.
                sh[:, 0] += torch.sigmoid(self.parameters["tint"]).numpy() * self.light.exp().mean().item() / SH_C0
            albedo = srgb_to_linear(np.clip(0.5 + SH_C0 * sh[:, 0], 0, 1))
            return Surfels(
                self.centres().numpy().copy(), scale, quaternions(frame.astype(np.float64)),
                self.opacities().numpy(), albedo, np.full(n, 0.5), np.zeros(n), sh,
            )  # fmt: skip


def _turned(features: Tensor, turn: Tensor) -> Tensor:
    """Blended features (h, w, c) with normals in another frame."""
    normal = features[..., NORMAL : NORMAL + 3] @ turn
    return torch.cat([features[..., :NORMAL], normal, features[..., NORMAL + 3 :]], -1)
