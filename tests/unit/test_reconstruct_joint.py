"""Surfels, their materials and the light learned together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from capture_cases import balls
from shapes import plain_mesh, sphere_mesh

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from drgs_blender.core.errors import Cancelled  # noqa: E402
from drgs_blender.geometry.normals import unit  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering import joint, pixels, schedule  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.decoupled import Decoupled  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.domain import mesh_domain  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.joint import JointJob, LearnedSurfels, decouple_jointly  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.materials import levels  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.regularisers import fineness  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.run import decouple  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.surfel_domain import carried  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.settings import Settings as Run  # noqa: E402

torch.set_num_threads(1)

SMALL = Settings(iterations=8, pixels=128, cosine=4, ggx=4, light=4, environment=8, coarse=1, normals=True, joint=0.5)


@pytest.fixture(scope="module")
def capture():
    return balls(size=48)


@pytest.fixture(scope="module")
def mesh():
    vertices, faces = sphere_mesh(3)
    return plain_mesh((0.45 * vertices).astype(np.float32), faces)


def surfels(mesh) -> LearnedSurfels:
    points = mesh.vertices.astype(np.float64)
    gaussians = Gaussians.on_surface(points, unit(points), np.full(points.shape, 0.5), 0.04)
    return LearnedSurfels(gaussians, Schedule(), 1.0, lambda _: (mesh, {}))


def job_of(capture, mesh, settings: Settings) -> JointJob:
    domain, clock = mesh_domain(capture, mesh, settings), schedule.Schedule(settings, lambda: 0.0)
    return JointJob(capture, domain, mesh, surfels(mesh), settings, None, clock)


def arrays(found: Decoupled) -> list[np.ndarray]:
    assert found.surfels is not None
    shape = found.surfels
    own = [shape.albedo, shape.roughness, shape.metallic, *shape.gaussians.arrays().values()]
    return [found.albedo, found.roughness, found.metallic, found.environment, found.normals, *own]


def test_what_is_blended_beside_colours_is_the_mean_of_the_surfels(mesh, capture):
    """The same everywhere: the coverage times it; and nothing else changes."""
    gaussians, camera, behind = surfels(mesh).gaussians, capture.training[0].camera, torch.zeros(3)
    plain = gaussians.render(camera, behind)
    both = gaussians.render(camera, behind, materials=torch.full((len(gaussians), 2), 0.3))
    assert both.materials.detach().numpy() == pytest.approx(
        0.3 * plain.maps.alpha[..., None].detach().numpy().repeat(2, 2), abs=1e-5
    )
    for name in ("colour", "normal"):
        assert torch.equal(getattr(both, name), getattr(plain, name))


def test_surfels_are_learned_in_the_last_part_alone(mesh, capture):
    start = {name: values.copy() for name, values in surfels(mesh).gaussians.arrays().items()}
    frozen = decouple(capture, mesh, replace(SMALL, joint=0.0))
    assert frozen.surfels is None
    found = decouple_jointly(capture, mesh, surfels(mesh), SMALL)
    moved = found.surfels.gaussians.arrays()
    assert all(np.abs(moved[name] - start[name]).max() > 1e-5 for name in ("centre", "rotation", "scale", "opacity"))
    assert np.linalg.norm(moved["centre"] - start["centre"], axis=1).max() < 0.02
    assert found.report["iterations"] == 8 and found.albedo.shape == mesh.vertices.shape
    assert len(found.surfels.albedo) == len(found.surfels.gaussians) and found.surfels.albedo.std() > 0.01
    never = decouple_jointly(capture, mesh, surfels(mesh), replace(SMALL, iterations=1, joint=0.1))
    assert never.surfels is None


def test_surfels_begin_with_the_materials_of_the_mesh(mesh, capture):
    """One step of theirs hardly changes them."""
    settings = replace(SMALL, iterations=30, joint=0.05)
    found = decouple_jointly(capture, mesh, surfels(mesh), settings)
    before = decouple(capture, mesh, replace(settings, joint=0.0))
    assert np.abs(found.surfels.albedo - before.albedo).mean() < 0.02 < before.albedo.std()


def test_the_loss_of_lit_pixels_turns_surfels(mesh, capture):
    """With other directions of light at these pixels, of which the losses of stage (i) know nothing, otherwise."""
    turned = []
    for count in (4, 8):
        settings = replace(SMALL, joint=1.0, iterations=3, cosine=count)
        found = decouple_jointly(capture, mesh, surfels(mesh), settings)
        turned.append(found.surfels.gaussians.arrays()["rotation"])
    assert not np.array_equal(*turned)


@pytest.mark.parametrize("at", [3, 7])
def test_an_interrupted_run_ends_where_an_undisturbed_one_does(mesh, capture, tmp_path, at):
    """Before the surfels are learned, and while they are."""
    settings = replace(SMALL, exposure=True)
    whole = decouple_jointly(capture, mesh, surfels(mesh), settings)
    path, asked = tmp_path / "materials.state", []
    with pytest.raises(Cancelled):
        decouple_jointly(
            capture,
            mesh,
            surfels(mesh),
            settings,
            cancelled=lambda: asked.append(0) or len(asked) > at,
            checkpoint=path,
        )
    resumed = decouple_jointly(capture, mesh, surfels(mesh), settings, checkpoint=path)
    for a, b in zip(arrays(whole), arrays(resumed), strict=True):
        assert np.array_equal(a, b)


def test_a_checkpoint_of_other_surfels_is_not_gone_on_from(mesh, capture, tmp_path, caplog):
    path, steps, other = tmp_path / "materials.state", iter(range(9)), surfels(mesh)
    with pytest.raises(Cancelled):
        decouple_jointly(
            capture, mesh, surfels(mesh), SMALL, cancelled=lambda: next(steps) == 3, checkpoint=path
        )  # fmt: skip
    other.gaussians.parameters["opacity"].data += 1
    with caplog.at_level("INFO"):
        decouple_jointly(capture, mesh, other, SMALL, checkpoint=path)
    assert "going on" not in caplog.text


def test_materials_of_surfels_begin_with_steps_as_long_as_any(mesh, capture):
    """Adam steps by the rate where gradients stay, by twice that where it forgets that moments began at 0."""
    settings = replace(SMALL, iterations=240, joint=0.5)
    job = job_of(capture, mesh, settings)
    job.schedule.iteration = job._adam.steps = 120
    job._begin()
    learned, rates = job._learned(), job.schedule.rates(0.5, job._learned())
    before = {name: tensor.clone() for name, tensor in learned.items()}
    for _ in range(20):
        for tensor in learned.values():
            tensor.grad = torch.ones_like(tensor)
        job._descend(learned, rates)
    for name in ("detail", "grid0"):
        assert (before[name] - learned[name]).numpy() == pytest.approx(20 * rates[name], rel=0.01)
    assert job._adam.steps == 140 and job._adam.first.keys() == {"light"}


def test_each_round_of_steps_shows_every_view_once_and_surfels_have_pairs_of_their_own(mesh, capture, monkeypatch):
    every = surfels(mesh)
    few = replace(every, gaussians=every.gaussians.select(np.arange(0, len(mesh.vertices), 3)))
    monkeypatch.setattr(joint, "learned", lambda job, *_: job)
    job = decouple_jointly(capture, mesh, few, SMALL)
    job._begin()
    count = len(job._views)
    shown = []
    for job.schedule.iteration in range(2 * count):
        shown.append(job._view())
    assert sorted(shown[:count]) == sorted(shown[count:]) == list(job._views) and shown[:count] != shown[count:]
    pairs = job._like.draw(np.random.default_rng(0))
    assert int(pairs.ends.max()) < len(few.gaussians) and float(pairs.weight.mean()) > 0.05


def test_close_surfels_have_as_fine_grids_as_close_vertices(mesh, capture, monkeypatch):
    monkeypatch.setattr(joint, "fineness", lambda *_: 4.0)
    job = job_of(capture, mesh, SMALL)
    job._begin()
    assert sum(name.startswith("grid") for name in job._own.parameters) == levels(SMALL.coarse, 4.0) == 3


def test_surfels_without_neighbours_count_as_far_apart():
    assert fineness(np.zeros((3, 3)), np.zeros((0, 2), np.int64)) == 1.0


def test_pixels_beside_the_cut_photographs_are_left_out(capture):
    """Silhouettes told from a background may lack what the mesh has: such pixels were read from the other side."""
    vertices, faces = sphere_mesh(3)
    large = plain_mesh((0.95 * vertices).astype(np.float32), faces)
    views = [replace(view, mask=None, colour=shrunk(view.colour)) for view in capture.views]
    plain = replace(capture, views=views, background=(0.0, 0.0, 0.0))
    job = job_of(plain, large, replace(SMALL, joint=1.0))
    all_of_them = len(job._pixels)
    job.step()
    assert 0 < len(job._pixels) < all_of_them
    y, x = job._places(job._pixels)
    for k, target in enumerate(job._targets):
        mine = job._pixels.view == k
        assert mine.sum() == job._first[k + 1] - job._first[k]
        assert (y[mine] >= 0).all() and (y[mine] < target.camera.height).all()
        assert (x[mine] >= 0).all() and (x[mine] < target.camera.width).all()
        rows, columns = np.divmod(job._pixels.place[mine], plain.training[k].camera.width)
        found = target.colour.numpy()[y[mine], x[mine]]
        assert np.array_equal(found, plain.training[k].colour[rows, columns])


def shrunk(colour: np.ndarray) -> np.ndarray:
    """The middle of a picture alone, off which the rest is black."""
    found, (height, width) = np.zeros_like(colour), colour.shape[:2]
    middle = slice(height * 5 // 12, height * 7 // 12), slice(width * 5 // 12, width * 7 // 12)
    found[middle] = 0.5 + 0.5 * colour[middle]
    return found


def test_materials_are_carried_by_parts_of_the_photographs(mesh, capture, monkeypatch):
    """The same as from whole ones, fewer pixels."""
    job = job_of(capture, mesh, SMALL)
    job._begin()
    gaussians, drawn = job.learner.gaussians, []
    render = Gaussians.render
    monkeypatch.setattr(Gaussians, "render", lambda self, camera, *rest, **named: (
        drawn.append(camera.width * camera.height) or render(self, camera, *rest, **named)))  # fmt: skip
    with torch.no_grad():
        columns = job._columns().numpy()
        parts = carried(columns, mesh, gaussians, capture.training)
        fewer = sum(drawn)
        monkeypatch.setattr(pixels, "cropped_views", lambda views, _: views)
        whole = carried(columns, mesh, gaussians, capture.training)
    assert fewer < 0.6 * (sum(drawn) - fewer)
    for a, b in zip(parts, whole, strict=True):
        assert a == pytest.approx(b, abs=1e-4)


def test_photographs_are_cut_when_surfels_are_learned(mesh, capture, monkeypatch):
    made = []
    monkeypatch.setattr(joint, "full_targets", lambda given, known=joint.full_targets: made.append(0) or known(given))
    job = job_of(capture, mesh, SMALL)
    for _ in range(4):
        job.step()
    assert not made
    job.step()
    assert made


def test_surfels_on_the_mesh_are_not_learned_again():
    assert "decoupling.joint" in Run(variant="m", decoupling=SMALL).without_effect()
    assert "decoupling.joint" not in Run(decoupling=SMALL).without_effect()
    for variant, told in (("m", True), ("p", False)):
        run = Run(variant=variant, decoupling=Settings(domain="surfels"))
        assert ("decoupling.domain" in run.without_effect()) is told
