"""Pictures as other methods make them, of our surfels: colours of each surfel blended, from baked light or split sums.

`baked` is the driving of GSP and PhysGaussian: particles inside the object carry each surfel, whose rotation and scales
follow the polar decomposition of their deformation gradient, and colours with their harmonics come along. `split_sum`
shades each surfel on its own, before they are blended (*forward*), by an environment prefiltered for GGX and the table
of Karis 2013 in his fit for mobile devices, without shadows and inter-reflection.
"""

from __future__ import annotations

import numpy as np
import torch
from bench_recovered_light import directions, reduced

from drgs_blender.core.asset import Asset
from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.frame import Camera, Particles, World
from drgs_blender.deform.gmls import Weights, bind_points, carry
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.deform.sources import MeshSource
from drgs_blender.deform.surfel_update import paper_update
from drgs_blender.formats.harmonics import basis
from drgs_blender.geometry.normals import rotation_matrices, unit
from drgs_blender.reconstruct.model.raster import rasterise
from drgs_blender.render.reference.light import Light
from drgs_blender.simulation.fill import fill

Array = np.ndarray

#: Particles along the longest side of an object.
ALONG = 64
#: Rows of prefiltered environments, and roughness of each.
ROWS, ROUGHNESS = 32, (0.1, 0.25, 0.4, 0.6, 0.8, 1.0)
#: Rows of the light that they are made of.
SOURCE = 128
DIELECTRIC = 0.04


def blended(surfels: PosedSurfels, colour: Array, camera: Camera) -> Array:
    """(h, w, 4) colours (n, 3) of surfels, blended, and coverage."""
    tensors = (surfels.centre, surfels.tangent_u, surfels.tangent_v, surfels.opacity, colour)
    with torch.no_grad():
        maps = rasterise(*(torch.tensor(np.asarray(t), dtype=torch.float32) for t in tensors), camera)
    return np.concatenate([maps.features.numpy(), maps.alpha.numpy()[..., None]], axis=-1)


def towards(surfels: PosedSurfels, camera: Camera) -> Array:
    """(n, 3) unit directions to the viewer."""
    return unit(np.asarray(camera.matrix_world)[:3, 3] - surfels.centre)


class Baked:
    """An asset with the colours that it was captured in, carried by particles inside it."""

    def __init__(self, asset: Asset) -> None:
        assert asset.binding is not None
        self._asset, mesh = asset, asset.mesh
        self._rest = MeshDriven(mesh, asset.surfels, asset.binding).pose(mesh.vertices)
        side = float(np.ptp(mesh.vertices, axis=0).max())
        self._particles = fill(mesh.vertices, mesh.faces, side / ALONG).points
        self._source = MeshSource(mesh.vertices, mesh.faces)
        self._by_mesh = bind_points(self._particles, mesh.vertices)
        self._by_particles: Weights = bind_points(self._rest.centre, self._particles)
        self._simulated: tuple[Array, Weights] | None = None

    def pose(self, vertices: Array | None, simulated: Particles | None = None) -> tuple[PosedSurfels, Array]:
        """Surfels, and what has turned each (n, 3, 3); by `simulated` particles in place of those in the mesh."""
        rest = self._rest
        if simulated is not None:
            if self._simulated is None or self._simulated[0] is not simulated.rest:
                self._simulated = simulated.rest, bind_points(rest.centre, simulated.rest)
            centre, gradient, _ = carry(self._simulated[1], simulated.points, simulated.gradients)
        elif vertices is None:
            return rest, np.tile(np.eye(3), (len(rest), 1, 1))
        else:
            x, gradients, _ = carry(self._by_mesh, vertices.astype(np.float64), self._source.gradients(vertices))
            centre, gradient, _ = carry(self._by_particles, x, gradients)
        left, _, right = np.linalg.svd(gradient.astype(np.float64))
        turned = left @ right
        surfels = self._asset.surfels
        rotation, scale = paper_update(gradient, rotation_matrices(surfels.rotation), surfels.scale)
        posed = PosedSurfels(
            centre.astype(np.float32), rotation[..., 0] * scale[:, :1], rotation[..., 1] * scale[:, 1:],
            rotation[..., 2], rest.opacity, rest.albedo, rest.roughness, rest.metallic, rest.object_index,
        )  # fmt: skip
        return posed, turned

    def __call__(self, camera: Camera, vertices: Array | None, simulated: Particles | None = None) -> Array:
        """(h, w, 4) linear, premultiplied."""
        posed, turned = self.pose(vertices, simulated)
        at_rest = np.einsum("nji,nj->ni", turned, -towards(posed, camera))
        sh = self._asset.surfels.sh
        assert sh is not None
        degree = round(sh.shape[1] ** 0.5) - 1
        encoded = 0.5 + np.einsum("nk,nkc->nc", basis(at_rest, degree), sh)
        picture = blended(posed, np.clip(encoded, 0, 1), camera)
        alpha = picture[..., 3:]
        linear = srgb_to_linear(np.clip(picture[..., :3] / np.maximum(alpha, 1e-6), 0, 1)) * alpha
        return np.concatenate([linear, alpha], axis=-1)


class Prefiltered:
    """A light (h, w, 3) as a diffuse surface and mirrors of several roughnesses see it, view along the normal."""

    def __init__(self, radiance: Array) -> None:
        radiance = reduced(radiance, SOURCE)
        source, angle = directions(SOURCE)
        light, out = radiance.reshape(-1, 3) * angle[:, None], directions(ROWS)[0]
        self.levels = []
        for roughness in ROUGHNESS:
            a2 = roughness**4
            rows = []
            for part in np.array_split(out, 16):
                cosine = part @ source.T
                # Of the half vector of view = normal and light.
                nh2 = np.clip((1 + cosine) / 2, 0, 1)
                weight = np.where(cosine > 0, cosine * a2 / (nh2 * (a2 - 1) + 1) ** 2, 0)
                rows.append(weight @ light / np.maximum((weight * angle).sum(1, keepdims=True), 1e-12))
            self.levels.append(np.concatenate(rows).reshape(ROWS, 2 * ROWS, 3))
        self.diffuse = np.concatenate(
            [np.maximum(part @ source.T, 0) @ light / np.pi for part in np.array_split(out, 16)]
        ).reshape(ROWS, 2 * ROWS, 3)

    def mirrored(self, direction: Array, roughness: Array) -> Array:
        """(n, 3) what mirrors of `roughness` (n,) show."""
        place = np.interp(roughness, ROUGHNESS, np.arange(len(ROUGHNESS)))
        low = np.minimum(place.astype(int), len(ROUGHNESS) - 2)
        seen = np.stack([look_up(level, direction) for level in self.levels])
        index, part = np.arange(len(direction)), (place - low)[:, None]
        return (1 - part) * seen[low, index] + part * seen[low + 1, index]


def look_up(picture: Array, direction: Array) -> Array:
    """(n, 3) of a lat-long map, between its pixels."""
    return Light.from_world(World(picture)).radiance(torch.from_numpy(direction).double()).numpy()


def split_sum(surfels: PosedSurfels, light: Prefiltered, camera: Camera) -> Array:
    """(h, w, 4) linear, premultiplied: surfels shaded one by one, then blended."""
    view, normal = towards(surfels, camera), surfels.normal
    facing = (view * normal).sum(1, keepdims=True)
    normal = np.where(facing < 0, -normal, normal)
    facing = np.clip(np.abs(facing), 1e-3, 1)
    metallic, roughness = surfels.metallic[:, None], surfels.roughness
    f0 = DIELECTRIC * (1 - metallic) + surfels.albedo * metallic
    # Karis' fit of the table: scale and bias of F0.
    r = roughness[:, None] * np.array([-1, -0.0275, -0.572, 0.022]) + np.array([1, 0.0425, 1.04, -0.04])
    a = np.minimum(r[:, :1] ** 2, 2 ** (-9.28 * facing)) * r[:, :1] + r[:, 1:2]
    scale, bias = -1.04 * a + r[:, 2:3], 1.04 * a + r[:, 3:4]
    mirror = light.mirrored(2 * facing * normal - view, roughness)
    colour = (1 - metallic) * surfels.albedo * look_up(light.diffuse, normal) + mirror * (f0 * scale + bias)
    return blended(surfels, np.maximum(colour, 0), camera)
