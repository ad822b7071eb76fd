"""The surfels that are learned: raw parameters, what they mean, how they split and vanish."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..arrays import Array
from ..asset.model import Surfels
from ..colour import srgb_to_linear
from ..frame import Camera
from ..geometry import quaternions
from .raster import Maps, Tally, rasterise
from .reflection import dark_cube, pyramid, reflected
from .targets import pixel_rays

#: Value of the constant harmonic.
SH0 = 0.28209479177387814
#: Logit of the tint of surfels that nothing is known of.
MATT = -3.0
#: Pixels covered less than this mirror nothing.
BARE = 0.02
#: Bands of harmonics -> coefficients.
COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}


@dataclass(slots=True)
class Look:
    """One view of the surfels.

    Attributes
    ----------
    colour : (h, w, 3) over the background, sRGB-encoded
    normal : (h, w, 3) sum of weighted normals that face the viewer, world space
    maps : alpha, depth, median, distortion
    """

    colour: Tensor
    normal: Tensor
    maps: Maps


class Gaussians:
    """Surfels as learned: every attribute a float32 tensor of `parameters`, free of bounds.

    ``centre`` (n, 3) world; ``scale`` (n, 2) logarithms; ``rotation`` (n, 4) quaternions wxyz of any length;
    ``opacity`` (n,) logits; ``sh`` (n, k, 3) harmonics of the colour less one half, as in 3D Gaussian splatting;
    ``tint`` (n, 3) and ``blur`` (n,) logits of how much of the `light` around is mirrored, and how blurred.

    Parameters
    ----------
    light : the cube of `reflection`; None: nothing is mirrored
    """

    def __init__(self, parameters: dict[str, Tensor], light: Tensor | None = None) -> None:
        self.parameters, self.light = parameters, light
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
        sh[:, 0] = (colours - 0.5) / SH0
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

    def frames(self) -> tuple[Tensor, Tensor, Tensor]:
        """Scaled tangents and the normal, (n, 3) each."""
        w, x, y, z = torch.nn.functional.normalize(self.parameters["rotation"], dim=1).unbind(1)
        u = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
        v = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
        normal = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
        scale = self.parameters["scale"].exp()
        return u * scale[:, :1], v * scale[:, 1:], normal

    def centres(self) -> Tensor:
        """(n, 3) world positions."""
        return self.parameters["centre"]

    def opacities(self) -> Tensor:
        """(n,) in 0..1."""
        return torch.sigmoid(self.parameters["opacity"])

    def colours(self, away: Tensor, bands: int) -> Tensor:
        """(n, 3) sRGB seen from the unit directions `away` (n, 3), viewer to surfel; bands beyond `bands` are left out.

        The dependence of the direction on the centre is not differentiated.
        """
        sh = self.parameters["sh"]
        k = min(COEFFICIENTS[bands], sh.shape[1])
        value = 0.5 + (harmonics(away, k)[:, :, None] * sh[:, :k]).sum(1)
        return value.clamp(min=0)

    def look(
        self,
        camera: Camera,
        background: Tensor,
        bands: int = 3,
        tally: Tally | None = None,
        rays: Tensor | None = None,
        mirrors: bool = True,
    ) -> Look:
        """Render a view over `background` (3,); `rays` are `targets.pixel_rays` where they are at hand."""
        centre, (u, v, normal) = self.centres(), self.frames()
        eye = torch.as_tensor(np.asarray(camera.matrix_world)[:3, 3], dtype=torch.float32)
        with torch.no_grad():
            away = torch.nn.functional.normalize(centre - eye, dim=1)
            side = torch.where((away * normal).sum(1, keepdim=True) > 0, -1.0, 1.0)
        features = [self.colours(away, bands), side * normal]
        mirrors = mirrors and self.light is not None
        if mirrors:
            features += [torch.sigmoid(self.parameters["tint"]), torch.sigmoid(self.parameters["blur"])[:, None]]
        maps = rasterise(centre, u, v, self.opacities(), torch.cat(features, 1), camera, tally)
        colour = maps.features[..., :3] + (1 - maps.alpha)[..., None] * background
        if mirrors:
            colour = colour + self._mirrored(maps, pixel_rays(camera) if rays is None else rays)
        return Look(colour, maps.features[..., 3:6], maps)

    def _mirrored(self, maps: Maps, rays: Tensor) -> Tensor:
        """(h, w, 3) what the pixels' surfaces mirror."""
        assert self.light is not None
        covered = (maps.alpha.detach() > BARE).reshape(-1).nonzero()[:, 0]
        pixel = maps.features.reshape(-1, maps.features.shape[-1])[covered]
        blur = pixel[:, 9] / maps.alpha.reshape(-1)[covered].clamp(min=BARE)
        seen = reflected(
            pixel[:, 3:6], torch.nn.functional.normalize(rays.reshape(-1, 3)[covered], dim=1), blur, pyramid(self.light)
        )
        empty = torch.zeros(maps.alpha.numel(), 3)
        return empty.index_copy(0, covered, pixel[:, 6:9] * seen).reshape(*maps.alpha.shape, 3)

    def take(self, rows: Array) -> Gaussians:
        """The surfels `rows`, in this order, as a set of their own."""
        index = torch.from_numpy(np.asarray(rows, np.int64))
        return self.like({k: v.detach()[index].clone() for k, v in self.parameters.items()})

    def like(self, parameters: dict[str, Tensor]) -> Gaussians:
        """Surfels of the same kind with other parameters."""
        return Gaussians(parameters, self.light)

    def arrays(self) -> dict[str, Array]:
        """The raw parameters."""
        return {k: v.detach().numpy() for k, v in self.parameters.items()}

    def surfels(self) -> Surfels:
        """What an asset holds. The albedo is the mean colour as photographed, light included, decoded."""
        with torch.no_grad():
            raw = self.arrays()
            u, v, normal = (t.numpy() for t in self.frames())
            scale = np.exp(raw["scale"])
            frame = np.stack([u / scale[:, :1], v / scale[:, 1:], normal], -1)
            n = len(self)
            sh = raw["sh"].copy()
            if self.light is not None:
                # Harmonics know no mirrors: the mean of what is mirrored.
                sh[:, 0] += torch.sigmoid(self.parameters["tint"]).numpy() * self.light.exp().mean().item() / SH0
            albedo = srgb_to_linear(np.clip(0.5 + SH0 * sh[:, 0], 0, 1))
            return Surfels(
                self.centres().numpy().copy(), scale, quaternions(frame.astype(np.float64)),
                self.opacities().numpy(), albedo, np.full(n, 0.5), np.zeros(n), sh,
            )  # fmt: skip


def harmonics(direction: Tensor, count: int) -> Tensor:
    """(n, count) real spherical harmonics up to degree 3; see `formats.harmonics.basis`."""
    x, y, z = direction.unbind(1)
    columns: list[Any] = [torch.full_like(x, SH0)]
    if count > 1:
        a = 0.4886025119029199
        columns += [-a * y, a * z, -a * x]
    if count > 4:
        a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
        columns += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if count > 9:
        a, b, c, d = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154
        xx, yy, zz = x * x, y * y, z * z
        columns += [
            -a * y * (3 * xx - yy), b * x * y * z, -c * y * (5 * zz - 1), d * z * (5 * zz - 3), -c * x * (5 * zz - 1),
            0.5 * b * z * (xx - yy), -a * x * (xx - 3 * yy),
        ]  # fmt: skip
    return torch.stack(columns, 1)
