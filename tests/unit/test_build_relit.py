"""Light baked into surfels: what a point of the mesh would show."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.build.relit import relit_colours
from drgs_blender.core.asset import Asset, Mesh, Surfels
from drgs_blender.core.frame import RenderSettings, World
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.render.lights.environment import EnvironmentLight

SETTINGS = RenderSettings(samples=256, subpixel_samples=1, bounces=0, shading_model="paper")


def plate(albedo: float = 0.6, flip: bool = False) -> Asset:
    """Surfels facing +Z on a square; `flip` turns every second one over."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), albedo), np.ones(4), np.zeros(4))
    rng = np.random.default_rng(3)
    n = 64
    centre = np.concatenate([rng.uniform(-0.9, 0.9, (n, 2)), np.zeros((n, 1))], axis=1)
    rotation = np.tile([1.0, 0, 0, 0], (n, 1))
    if flip:
        rotation[::2] = [0, 1, 0, 0]
    surfels = Surfels(
        centre, np.full((n, 2), 0.05), rotation, np.ones(n), np.full((n, 3), albedo), np.ones(n), np.zeros(n)
    )
    return Asset(surfels, mesh, bind(mesh, surfels)[0])


def lit_half() -> np.ndarray:
    """Radiance 1 where x > 0, else 0."""
    picture = np.zeros((32, 64, 3), np.float32)
    picture[:, 16:48] = 1  # +X is in the middle
    return picture


@pytest.mark.parametrize("flip", [False, True])
def test_a_plate_under_half_a_sky(flip: bool) -> None:
    """Half of the sky sends half of the light, whichever way the surfels face; a rough surface adds little to it."""
    asset = plate(flip=flip)
    colour = relit_colours(asset, asset.surfels, asset.mesh.vertices, World(lit_half()), SETTINGS)
    whole = relit_colours(asset, asset.surfels, asset.mesh.vertices, World(np.ones((8, 16, 3))), SETTINGS)
    np.testing.assert_allclose(colour.mean(axis=0), whole.mean(axis=0) / 2, rtol=0.03)
    assert 0.55 < whole.mean() < 0.75
    assert EnvironmentLight(World(lit_half())).bad_texels == 0


def test_a_lid_keeps_the_light_out() -> None:
    asset = plate()
    lid = np.array([[-9, -9, 0.1], [9, -9, 0.1], [9, 9, 0.1], [-9, 9, 0.1]], np.float32)
    mesh = asset.mesh
    covered = Mesh(
        np.concatenate([mesh.vertices, lid]), np.concatenate([mesh.faces, mesh.faces + 4]),
        np.tile(mesh.albedo, (2, 1)), np.tile(mesh.roughness, 2), np.tile(mesh.metallic, 2),
    )  # fmt: skip
    under = Asset(asset.surfels, covered, asset.binding)
    world = World(np.ones((8, 16, 3)))
    assert relit_colours(under, asset.surfels, covered.vertices, world, SETTINGS).max() < 0.05


def shell(n: int = 800) -> Surfels:
    """Surfels without a mesh on a sphere, every second one with its normal inwards."""
    golden = np.arange(n) * np.pi * (3 - np.sqrt(5))
    z = 1 - 2 * (np.arange(n) + 0.5) / n
    centre = np.stack([np.sqrt(1 - z**2) * np.cos(golden), np.sqrt(1 - z**2) * np.sin(golden), z], axis=1)
    towards = np.where(np.arange(n)[:, None] % 2, centre, -centre)
    rotation = np.concatenate([1 + towards[:, 2:], -towards[:, 1:2], towards[:, :1], np.zeros((n, 1))], axis=1)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Surfels(
        centre, np.full((n, 2), 0.06), rotation, np.full(n, 0.95), np.full((n, 3), 0.6), np.ones(n), np.zeros(n)
    )


def test_without_a_mesh_the_lit_side_of_each_surfel_counts() -> None:
    """Surfels of a closed shell show its bright outside, whichever way they face, and shade each other."""
    surfels = shell()
    asset, world = Asset(surfels, Mesh.empty()), World(np.ones((8, 16, 3)))
    colour = relit_colours(asset, surfels, asset.mesh.vertices, world, SETTINGS)[:, 0]
    square = plate()
    free = relit_colours(square, square.surfels, square.mesh.vertices, world, SETTINGS).mean()
    assert 0.85 * free < colour.min() and colour.max() < 1.1 * free
    half = relit_colours(asset, surfels, asset.mesh.vertices, World(lit_half()), SETTINGS)[:, 0]
    away = surfels.centre[:, 0] < -0.9
    assert half[away].max() < 0.15 * half[surfels.centre[:, 0] > 0.9].mean()


def test_arrays_that_are_read_only_as_those_of_files_compile_nothing_anew(compiled) -> None:
    """The integrator's kernel takes half a minute for each kind of array that it is given."""
    for frozen in (False, True):
        asset = plate()
        vertices = asset.mesh.vertices.copy()
        for array in [
            vertices,
            *(getattr(part, n) for part in (asset.mesh, asset.surfels, asset.binding) for n in part.__slots__),
        ]:
            if isinstance(array, np.ndarray):
                array.setflags(write=not frozen)
        compiled.clear()
        posed = MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(
            vertices, materials={"albedo": asset.mesh.albedo / 2}
        )
        assert np.isfinite(posed.centre).all()
        relit_colours(asset, asset.surfels, vertices, World(lit_half()), SETTINGS)
    assert not compiled
