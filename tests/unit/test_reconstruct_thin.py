"""Things thinner than the mesh can be, told from others, and how their surfels are shaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls  # noqa: E402

from drgs_blender.core.asset.model import Mesh  # noqa: E402
from drgs_blender.geometry.normals import rotation_matrices, unit  # noqa: E402
from drgs_blender.reconstruct import pipeline  # noqa: E402
from drgs_blender.reconstruct.backend import LearningBackend  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings as Decoupling  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.reconstruct.model.thin_structures import is_thin, normals_of  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.pipeline import Settings, reconstruct  # noqa: E402

RIBS = 12
QUICK = Settings(
    schedule=Schedule(iterations=60, surfels=1500),
    mesh_resolution=32,
    decoupling=Decoupling(iterations=5, pixels=64, cosine=2, ggx=2, light=2, environment=8, normals=True),
)


def surfels_on(points: np.ndarray, normals: np.ndarray) -> Gaussians:
    surfels = Gaussians.on_surface(points, normals, np.full(points.shape, 0.5), 0.05)
    opaque = surfels.parameters["opacity"].detach() + 5  # nothing shines through
    return surfels.like(surfels.parameters | {"opacity": opaque})


def ribbed() -> Mesh:
    """What marching cubes make of leaves side by side: a sheet with ribs, its faces up, slopes to 60 degrees."""
    n = 16 * RIBS
    x, y = np.meshgrid(*[np.linspace(-0.8, 0.8, n)] * 2, indexing="ij")
    waves = 2 * np.pi * RIBS / 1.6
    vertices = np.stack([x, y, 1.8 / waves * np.sin(waves * x)], -1).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = [np.stack([corner, corner + a, corner + b], -1) for a, b in ((n, n + 1), (n + 1, 1))]
    return plain_mesh(vertices, np.concatenate(faces))


@pytest.fixture(scope="module")
def views():
    return [replace(view, mask=None) for view in balls(size=96).views]


def test_leaves_are_thin_and_a_ball_is_not(views):
    from_above = [view for view in views if view.camera.matrix_world[2, 3] > 2]
    sheet = np.stack([*np.meshgrid(*[np.linspace(-0.9, 0.9, 90)] * 2), np.zeros((90, 90))], -1).reshape(-1, 3)
    assert is_thin(surfels_on(sheet, np.tile((0.0, 0.0, 1.0), (len(sheet), 1))), ribbed(), from_above)
    vertices, faces = sphere_mesh(4)
    assert not is_thin(surfels_on(vertices, unit(vertices.astype(np.float64))), plain_mesh(vertices, faces), views)


def test_what_surfels_show_faces_the_viewer(views):
    """Whichever way they were turned."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3)) * (1, 1, 0)
    for side in (1.0, -1.0):
        shown = normals_of(surfels_on(points, np.tile((0.0, 0.0, side), (300, 1))))(views[0])
        height = views[0].camera.matrix_world[2, 3]
        assert (np.sign(shown[np.abs(shown[..., 2]) > 0.1][:, 2]) == np.sign(height)).all()


@pytest.mark.parametrize("thin", [True, False])
def test_surfels_of_thin_things_are_shaded_by_their_own_normals(thin, monkeypatch):
    monkeypatch.setattr(pipeline, "is_thin", lambda *_: thin)
    asset = reconstruct(balls(), QUICK)
    assert asset.provenance["report"]["thin"] is thin
    own = rotation_matrices(asset.surfels.rotation.astype(np.float64))[..., 2]
    driven = pipeline.MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(asset.mesh.vertices)
    cosine = np.abs((own * driven.normal).sum(axis=1))
    assert (np.quantile(cosine, 0.02) > 0.999) == thin


@pytest.mark.parametrize("joint", [0.0, 0.5])
def test_assets_of_thin_things_have_the_materials_of_their_surfels(joint, monkeypatch):
    """Learned on them as they are, and where asked for together with them; the mesh takes what they show."""
    kept = []
    for name in ("decouple", "decouple_jointly"):
        learn = getattr(pipeline, name)
        monkeypatch.setattr(pipeline, name, lambda *given, learn=learn: kept.append(learn(*given)) or kept[-1])
    monkeypatch.setattr(pipeline, "is_thin", lambda *_: True)
    asset = reconstruct(balls(), replace(QUICK, decoupling=replace(QUICK.decoupling, joint=joint)))
    [found] = kept
    own = found.surfels
    assert own is not None and (own.mesh is not None) == (joint > 0)
    visible = own.gaussians.opacities().detach().numpy() >= pipeline.UNSEEN
    for channel in ("albedo", "roughness", "metallic"):
        assert np.array_equal(getattr(asset.surfels, channel), getattr(own, channel)[visible])
    assert np.array_equal(asset.surfels.centre, own.gaussians.arrays()["centre"][visible])
    assert len(asset.mesh.vertices) == asset.provenance["report"]["mesh"]["vertices"] == len(found.albedo)
    assert np.array_equal(asset.mesh.albedo, found.albedo)


@pytest.mark.parametrize(
    ("asked", "thin", "on_surfels"),
    [("auto", True, True), ("auto", False, False), ("mesh", True, False), ("surfels", False, True)],
)
def test_materials_are_learned_on_what_is_asked_for(asked, thin, on_surfels, monkeypatch):
    monkeypatch.setattr(pipeline, "is_thin", lambda *_: thin)
    kept, learn = [], pipeline.decouple
    monkeypatch.setattr(pipeline, "decouple", lambda *given: kept.append(learn(*given)) or kept[-1])
    asset = reconstruct(balls(), replace(QUICK, decoupling=replace(QUICK.decoupling, domain=asked)))
    assert (kept[0].surfels is not None) is on_surfels and asset.provenance["report"]["thin"] is thin


@pytest.mark.parametrize("domain", ["mesh", "surfels"])
def test_a_state_of_another_domain_is_not_gone_on_from(domain, tmp_path, monkeypatch, caplog):
    """As where the first part was learned anew, and is thin now."""
    for thin in (domain == "surfels", domain != "surfels"):
        monkeypatch.setattr(pipeline, "is_thin", lambda *_, thin=thin: thin)
        with caplog.at_level("INFO"):
            caplog.clear()
            reconstruct(balls(), QUICK, folder=tmp_path)
    assert "materials: going on" not in caplog.text and "starting over" in caplog.text


@pytest.mark.slow
def test_a_card_does_not_learn_surfels_with_materials_and_says_so(monkeypatch, caplog):
    """Asked for, they are learned on the CPU; else they are not."""
    used = []
    monkeypatch.setattr(pipeline, "is_thin", lambda *_: True)
    for name in ("decouple", "decouple_jointly"):
        learn = getattr(pipeline, name)
        monkeypatch.setattr(pipeline, name, lambda *given, name=name, learn=learn: used.append(name) or learn(*given))
    monkeypatch.setattr(pipeline, "select_backend", lambda _: LearningBackend())
    for joint in (0.0, 0.5):
        reconstruct(balls(), replace(QUICK, decoupling=replace(QUICK.decoupling, joint=joint)))
    assert used == ["decouple", "decouple_jointly"]
    assert "decoupling.joint: surfels, materials and light are learned on the CPU" in caplog.text
