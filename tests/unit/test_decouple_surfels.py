"""Materials that are learned on surfels, of a leaf that is seen and lit from both sides."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import plain_mesh

torch = pytest.importorskip("torch")

from capture_cases import camera  # noqa: E402

from drgs_blender.core.asset.model import Mesh  # noqa: E402
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear  # noqa: E402
from drgs_blender.core.errors import Cancelled  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture, View  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering import run  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.regularisers import Regularisers  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.run import decouple  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.surface import Pairs, Surface  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.surfel_domain import _keep_heaviest, neighbours, surfel_domain  # noqa: E402
from drgs_blender.reconstruct.model.contributors import strongest  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.reconstruct.model.raster import WorldSurfels  # noqa: E402

#: Half a side of the leaf, the light from above and below, and the albedos of its halves.
HALF, ABOVE, BELOW, DARK, PALE = 0.8, 1.0, 0.25, 0.2, 0.6
SMALL = Settings(iterations=150, pixels=256, environment=8, coarse=1, normals=True, parametrisation="dielectric")


def albedo_at(points: np.ndarray) -> np.ndarray:
    return np.where(points[..., 0] < 0, DARK, PALE)


@pytest.fixture(scope="module")
def capture() -> Capture:
    """Photographs of a leaf in the plane z = 0, matte: each side shows the light of its own."""
    views = []
    for k in range(16):
        view = camera(k, 16, 48)
        x, y = np.meshgrid(np.arange(48) + 0.5, np.arange(48) + 0.5)
        rays = np.stack([(x - view.cx) / view.fx, -(y - view.cy) / view.fy, np.full_like(x, -1.0)], -1)
        rays = rays @ view.matrix_world[:3, :3].T
        eye = view.matrix_world[:3, 3]
        place = eye - rays * (eye[2] / rays[..., 2:])
        inside = (np.abs(place[..., :2]) < HALF).all(-1)
        shown = albedo_at(place) * (ABOVE if eye[2] > 0 else BELOW) * inside
        colour = linear_to_srgb(np.repeat(shown[..., None], 3, -1)).astype(np.float32)
        views.append(View(f"{k:02d}", view, colour, inside.astype(np.float32)))
    return Capture(Path("leaf"), views, (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def leaf() -> Gaussians:
    """Surfels of the leaf, each on a side of its own choice."""
    step = np.linspace(-HALF, HALF, 33)
    points = np.stack([*np.meshgrid(step, step), np.zeros((33, 33))], -1).reshape(-1, 3)
    sides = np.random.default_rng(0).choice([-1.0, 1.0], len(points))
    found = Gaussians.on_surface(points, sides[:, None] * (0.0, 0, 1), np.full(points.shape, 0.5), 0.03)
    return found.like(found.parameters | {"opacity": found.parameters["opacity"].detach() + 5})


def tube() -> Mesh:
    """What marching cubes make of the leaf: it has thickness, and round edges."""
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    across = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.5 * (HALF + 0.05)
    along = np.linspace(-HALF - 0.05, HALF + 0.05, 40)
    height = 0.08 * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.5
    vertices = np.stack(np.broadcast_arrays(across[:, None], along, height[:, None]), -1).reshape(-1, 3)
    corner = np.arange(48)[:, None] * 40 + np.arange(39)
    after = np.roll(np.arange(48), -1)[:, None] * 40 + np.arange(39)
    faces = [np.stack(f, -1).reshape(-1, 3) for f in ((corner, after + 1, after), (corner, corner + 1, after + 1))]
    return plain_mesh(vertices, np.concatenate(faces))


def error(albedo: np.ndarray, points: np.ndarray) -> float:
    """Root mean square of the albedo, scaled to the true one, away from the border of the halves."""
    clear = np.abs(points[:, 0]) > 0.1
    found, true = albedo[clear].mean(1), albedo_at(points[clear])
    return float(np.sqrt(((found * (found @ true) / (found @ found) - true) ** 2).mean()))


def test_the_strongest_surfels_of_a_pixel_are_those_that_its_colour_blends(capture, leaf):
    values = torch.rand(len(leaf), 3, generator=torch.Generator().manual_seed(1))
    for view in capture.views[:3]:
        with torch.no_grad():
            shown = leaf.render(view.camera, torch.zeros(3), 0, reflections=False, materials=values)
        surfels = WorldSurfels(leaf.centres().detach().numpy(), *leaf.frames()[:2], leaf.opacities().detach().numpy())
        index, weight, depth = strongest(surfels, view.camera, 64)
        assert (np.diff(weight, axis=-1) <= 0).all()
        assert weight.sum(-1) == pytest.approx(shown.maps.alpha.numpy(), abs=1e-5)
        blended = (weight[..., None] * values.numpy()[index]).sum(2)
        assert blended == pytest.approx(shown.materials.numpy(), abs=1e-5)
        assert (weight * depth).sum(-1) == pytest.approx(shown.maps.depth.numpy(), abs=1e-4)
        for few, all_ in zip(strongest(surfels, view.camera, 4), (index, weight, depth), strict=True):
            assert np.array_equal(few, all_[..., :4])


def test_a_leaf_is_learned_with_the_light_of_either_side(capture, leaf):
    found = decouple(capture, tube(), SMALL, surfels=leaf)
    assert found.surfels is not None
    centres = leaf.centres().detach().numpy()
    assert error(found.surfels.albedo, centres) < 0.02
    above, below = (part.mean() for part in np.split(found.environment, 2))
    assert above / below == pytest.approx(ABOVE / BELOW, rel=0.15)
    assert np.abs(found.surfels.normals[:, 2]).min() > 0.98
    # The mesh takes what views show of them.
    assert found.normals is None and error(found.albedo, tube().vertices) < 0.03


def test_rays_of_a_leaf_start_on_the_side_that_is_seen(capture, leaf):
    domain = surfel_domain(capture, leaf, SMALL)
    pixels = domain.pixels
    eye = np.array([view.camera.matrix_world[2, 3] for view in capture.views])[pixels.view]
    assert (np.sign(pixels.origin[:, 2]) == np.sign(eye)).all() and (np.sign(pixels.flat[:, 2]) == np.sign(eye)).all()
    assert pixels.share.sum(axis=1) == pytest.approx(1, abs=1e-5)
    shown = np.stack([view.colour.reshape(-1, 3) for view in capture.training])  # views are cropped to the leaf
    assert np.array_equal(pixels.colour, srgb_to_linear(shown[pixels.view, pixels.place]))
    facing = Surface(domain.points, domain.normals, SMALL, np.ones(3), True).at(pixels, domain.edges[:5])
    assert (facing.normal.numpy() * pixels.towards).sum(1).min() > 0


def test_each_corner_of_a_sheet_belongs_to_its_surfel(capture, leaf):
    domain = surfel_domain(capture, leaf, SMALL)
    assert len(np.unique(domain.owner)) == len(domain.points)
    away = np.linalg.norm(domain.occluder.vertices - domain.points[domain.owner], axis=1)
    assert away.max() < 5 * 0.03


def test_surfels_that_photographs_show_alike_are_held_more_than_vertices(capture, leaf, monkeypatch):
    monkeypatch.setattr(run, "learned", lambda job, *_: job)
    columns, pair = torch.tensor([[0.2] * 4, [0.6] * 4]), Pairs(torch.tensor([[0, 1]]), torch.ones(1))
    weights = [
        float(run.decouple(capture, tube(), SMALL, surfels=surfels)._regularisers.of_likeness(columns, pair))
        for surfels in (leaf, None)
    ]
    assert weights[0] == pytest.approx(3 * weights[1], rel=1e-5)


def leaves(share: float) -> Gaussians:
    """Two leaves, .3 apart, the upper one of some opacity."""
    step = np.linspace(-HALF, HALF, 17)
    sheet = np.stack([*np.meshgrid(step, step), np.zeros((17, 17))], -1).reshape(-1, 3)
    points = np.concatenate([sheet, sheet - (0, 0, 0.3)])
    found = Gaussians.on_surface(points, np.tile((0.0, 0, 1), (len(points), 1)), np.full(points.shape, 0.5), 0.06)
    opacity = torch.full((len(points),), 6.0)
    opacity[: len(sheet)] = float(np.log(share / (1 - share)))
    return found.like(found.parameters | {"opacity": opacity})


@pytest.mark.parametrize("share", [0.9, 0.3, 0.03])
def test_pixels_show_the_heaviest_of_two_leaves_and_nothing_in_between(capture, share):
    domain = surfel_domain(capture, leaves(share), SMALL)
    above = [k for k, view in enumerate(capture.training) if view.camera.matrix_world[2, 3] > 3]
    pixels = domain.pixels.select(np.flatnonzero(np.isin(domain.pixels.view, above)))
    upper = pixels.index < len(domain.points) // 2
    counts = pixels.share > 0
    assert (counts & upper).any(1).mean() > 0.95 if share > 0.2 else (counts & upper).any(1).mean() < 0.05
    # Either leaf alone, and rays start above it: 4 standard deviations of .06.
    assert not ((counts & upper).any(1) & (counts & ~upper).any(1)).any()
    height = np.where((counts & upper).any(1), 0.0, -0.3) + 0.24
    assert pixels.origin[:, 2] == pytest.approx(height, abs=0.02)


def test_surfels_that_cover_nothing_whole_are_learned_from_all_the_same(capture, leaf):
    faint = leaf.like(leaf.parameters | {"opacity": torch.full((len(leaf),), -1.5)})
    assert len(surfel_domain(capture, faint, SMALL).pixels) > 100


def test_a_single_surfel_and_two_in_one_place_have_no_neighbours():
    up = np.array([[0.0, 0, 1], [0, 0, 1]])
    assert len(neighbours(np.zeros((1, 3)), up[:1])) == 0
    assert neighbours(np.zeros((2, 3)), up).tolist() in ([[0, 1]], [])


def test_surfels_on_either_side_of_an_edge_are_no_neighbours():
    line = np.linspace(0, 1, 20)[:, None]
    floor, wall = line * (1.0, 0, 0), line * (0, 0, 1.0)
    normals = np.repeat([[0.0, 0, 1], [1.0, 0, 0]], 20, axis=0)
    edges = neighbours(np.concatenate([floor, wall]), normals)
    assert len(edges) and ((edges < 20).all(1) | (edges >= 20).all(1)).all()


def test_normals_of_neighbours_on_either_side_are_alike_when_they_turn_alike(capture, leaf):
    """Offsets of surfels that look up and down are opposite where the leaf bends."""
    domain = surfel_domain(capture, leaf, SMALL)
    surface = Surface(domain.points, domain.normals, SMALL, np.ones(3), True)
    held = Regularisers(domain.edges, np.full((len(domain.points), 3), 0.5), SMALL)
    few = domain.pixels.select(np.arange(8))

    def loss(offsets: np.ndarray) -> float:
        surface.parameters["normals"] = torch.from_numpy(offsets.astype(np.float32))
        with torch.no_grad():
            return float(held.of_normals(surface.at(few, domain.edges)))

    bent = 0.1 * np.sign(domain.normals[:, 2:]) * (1.0, 0, 0)
    straight = 0.1 * np.ones((len(bent), 1)) * (1.0, 0, 0)
    assert loss(bent) < 0.1 * loss(straight)


def test_a_stopped_run_on_surfels_goes_on_to_the_same_result(capture, leaf, tmp_path):
    settings, mesh, path = replace(SMALL, iterations=12), tube(), tmp_path / "a.state"
    whole = decouple(capture, mesh, settings, surfels=leaf)
    steps = iter(range(99))
    with pytest.raises(Cancelled):
        decouple(capture, mesh, settings, surfels=leaf, cancelled=lambda: next(steps) == 5, checkpoint=path)
    resumed = decouple(capture, mesh, settings, surfels=leaf, checkpoint=path)
    for name in ("albedo", "roughness", "metallic", "normals"):
        assert np.array_equal(getattr(resumed.surfels, name), getattr(whole.surfels, name))
    assert np.array_equal(resumed.albedo, whole.albedo)


def test_a_surfel_without_neighbours_is_learned(capture, leaf):
    found = decouple(capture, tube(), replace(SMALL, iterations=2), surfels=leaf.select(torch.tensor([544])))
    assert found.surfels is not None and np.isfinite(found.surfels.albedo).all()


def test_a_mesh_that_no_photograph_shows_takes_the_materials_of_the_nearest_surfels(capture, leaf):
    mesh = tube()
    mesh.vertices = mesh.vertices + np.float32([100.0, 0, 0])
    found = decouple(capture, mesh, replace(SMALL, iterations=2), surfels=leaf)
    assert found.surfels is not None
    assert found.albedo.min() >= found.surfels.albedo.min() > 0.05


def test_the_heaviest_surface_is_where_most_weight_lies_within_reach():
    rng = np.random.default_rng(0)
    weight, depth, size = (rng.random((500, 16)).astype(np.float32) for _ in range(3))
    size *= 0.3
    beside = np.abs(depth[:, :, None] - depth[:, None]) <= size[..., None]
    heaviest = np.einsum("nij,nj->ni", beside, weight).argmax(axis=1)
    wanted = np.where(beside[np.arange(500), heaviest], weight, 0)
    _keep_heaviest(weight, depth, size)
    np.testing.assert_array_equal(weight, wanted)
