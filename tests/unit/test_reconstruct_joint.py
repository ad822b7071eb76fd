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
from drgs_blender.reconstruct.inverse_rendering.joint import LearnedSurfels, decouple_jointly  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.run import Decoupled, decouple  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings  # noqa: E402
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


def arrays(found: Decoupled) -> list[np.ndarray]:
    assert found.shape is not None
    shape = found.shape
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
    assert frozen.shape is None
    found = decouple_jointly(capture, mesh, surfels(mesh), SMALL)
    moved = found.shape.gaussians.arrays()
    assert all(np.abs(moved[name] - start[name]).max() > 1e-5 for name in ("centre", "rotation", "scale", "opacity"))
    assert np.linalg.norm(moved["centre"] - start["centre"], axis=1).max() < 0.02
    assert found.report["iterations"] == 8 and found.albedo.shape == mesh.vertices.shape
    assert len(found.shape.albedo) == len(found.shape.gaussians) and found.shape.albedo.std() > 0.01
    never = decouple_jointly(capture, mesh, surfels(mesh), replace(SMALL, iterations=1, joint=0.1))
    assert never.shape is None


def test_surfels_begin_with_the_materials_of_the_mesh(mesh, capture):
    """One step of theirs hardly changes them."""
    settings = replace(SMALL, iterations=30, joint=0.05)
    found = decouple_jointly(capture, mesh, surfels(mesh), settings)
    before = decouple(capture, mesh, replace(settings, joint=0.0))
    assert np.abs(found.shape.albedo - before.albedo).mean() < 0.02 < before.albedo.std()


def test_the_loss_of_lit_pixels_turns_surfels(mesh, capture):
    """With other directions of light at these pixels, of which the losses of stage (i) know nothing, otherwise."""
    turned = []
    for count in (4, 8):
        settings = replace(SMALL, joint=1.0, iterations=3, cosine=count)
        found = decouple_jointly(capture, mesh, surfels(mesh), settings)
        turned.append(found.shape.gaussians.arrays()["rotation"])
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


def test_surfels_on_the_mesh_are_not_learned_again():
    assert "decoupling.joint" in Run(variant="m", decoupling=SMALL).without_effect()
    assert "decoupling.joint" not in Run(decoupling=SMALL).without_effect()
