"""From photographs of known shapes to an asset."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls, colour_of_balls, distance_to_balls, write  # noqa: E402

from drgs_blender.core.asset.container import read_asset, write_asset  # noqa: E402
from drgs_blender.core.color import linear_to_srgb  # noqa: E402
from drgs_blender.core.errors import AssetError, Cancelled, UsageError, WriteError  # noqa: E402
from drgs_blender.core.frame import Frame, ObjectState, RenderSettings  # noqa: E402
from drgs_blender.deform.binding import clamp_weights  # noqa: E402
from drgs_blender.engine.session import Session  # noqa: E402
from drgs_blender.geometry.normals import VertexNormals  # noqa: E402
from drgs_blender.reconstruct import pipeline  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture  # noqa: E402
from drgs_blender.reconstruct.checkpoint import fingerprint  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings as Decoupling  # noqa: E402
from drgs_blender.reconstruct.meshing.visual_hull import find_region  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.optim.train import Training  # noqa: E402
from drgs_blender.reconstruct.pipeline import Progress, Settings, reconstruct  # noqa: E402

QUICK = Schedule(iterations=240, surfels=2500)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return balls()


@pytest.fixture(scope="module")
def settings() -> Settings:
    return Settings(schedule=QUICK, mesh_resolution=64, materials=False)


@pytest.fixture(scope="module")
def asset(capture, settings):
    return reconstruct(capture, settings)


def closed(faces: np.ndarray) -> bool:
    """Whether every edge has two faces that run along it in opposite directions."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = {tuple(e) for e in edges}, {tuple(e) for e in edges[:, ::-1]}
    return len(forth) == len(edges) and forth == back


def test_hull_holds_the_object_and_touches_it(capture):
    region = find_region(capture)
    distance, outward = distance_to_balls(region.points)
    assert distance.min() > -2.5 * region.spacing
    assert np.median(np.abs(distance)) < region.spacing
    assert np.einsum("nc,nc->n", outward, region.normals).mean() > 0.8
    assert (region.low < (-0.85, -0.5, -0.45)).all() and (region.high > (0.8, 0.5, 0.6)).all()


@pytest.mark.slow
def test_mesh_is_closed_faces_outwards_and_lies_on_the_surface(asset, capture):
    mesh = asset.mesh
    assert closed(mesh.faces)
    distance, outward = distance_to_balls(mesh.vertices)
    pixel = 4.0 / capture.views[0].camera.fx
    assert np.median(np.abs(distance)) < 0.5 * pixel and np.quantile(np.abs(distance), 0.95) < pixel
    normals = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    angle = np.degrees(np.arccos(np.clip(np.einsum("nc,nc->n", normals, outward), -1, 1)))
    assert np.median(angle) < 8  # turned inside out it would be 180


@pytest.mark.slow
def test_views_left_out_are_predicted(asset):
    report = asset.provenance["report"]
    assert report["left_out"] == 3 and report["psnr"] > 27 and report["ssim"] > 0.93


@pytest.mark.slow
def test_captured_colours_are_what_was_photographed(asset, capture, tmp_path):
    """The renderer shows views that were left out: what differs is little of what the object has of colours."""
    write_asset(tmp_path / "balls.drgs", asset)
    session = Session()
    session.load_asset(tmp_path / "balls.drgs")
    shown = ObjectState("Balls", str(tmp_path / "balls.drgs"), captured_colours=True)
    for view in capture.testing:
        settings = RenderSettings(samples=16, subpixel_samples=16, film_transparent=True)
        picture = session.render(Frame(1, view.camera, [shown], settings=settings))
        assert not picture.warnings
        inside = view.mask > 0.999
        colour, seen = linear_to_srgb(picture["Combined"][inside, :3]), view.colour[inside]
        assert np.mean((colour - seen) ** 2) < np.mean((seen - seen.mean(0)) ** 2) / 8


def test_the_views_that_were_learned_from_are_recorded(asset, capture):
    learned = asset.provenance["learned_from"]
    assert len(learned) == 21 and set(learned) == {v.name for v in capture.views} - {v.name for v in capture.testing}


def test_asset_is_whole(asset, tmp_path):
    write_asset(tmp_path / "a.drgs", asset)
    again = read_asset(tmp_path / "a.drgs")
    assert len(again.surfels) == len(asset.surfels) == len(again.binding.face)
    assert np.abs(distance_to_balls(again.surfels.centre)[0]).mean() < 0.05
    # The colour was carried to the mesh, in linear values.
    error = np.abs(linear_to_srgb(again.mesh.albedo) - colour_of_balls(again.mesh.vertices))
    assert np.median(error) < 0.04


@pytest.mark.slow
def test_surfels_on_the_mesh_lie_where_their_binding_says(capture, settings):
    asset = reconstruct(capture, replace(settings, variant="m", schedule=replace(QUICK, iterations=150)))
    corners = asset.mesh.vertices[asset.mesh.faces[asset.binding.face]].astype(np.float64)
    on_face = np.einsum("nk,nkc->nc", asset.binding.barycentric, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    edge = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).mean(1)
    expected = on_face + (asset.binding.offset * edge)[:, None] * normal
    assert np.abs(expected - asset.surfels.centre).max() < 1e-5
    assert np.abs(asset.binding.offset).max() > 1e-3  # it was learned
    assert asset.provenance["report"]["psnr"] > 24


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stop", "step"), [(5, 6), (11, 4), (25, 18)], ids=["in the first start's trial", "in the second's", "after it"]
)
def test_a_run_that_was_stopped_goes_on_bit_for_bit(capture, tmp_path, stop, step, caplog):
    short = Settings(schedule=replace(QUICK, iterations=40, surfels=1500), mesh_resolution=32, materials=False)
    whole = reconstruct(capture, short)
    steps = iter(range(1000))
    with pytest.raises(Cancelled):
        reconstruct(capture, short, cancelled=lambda: next(steps) == stop, folder=tmp_path)
    with caplog.at_level("INFO"):
        resumed = reconstruct(capture, short, folder=tmp_path)
    assert f"surfels: going on at step {step}" in caplog.text
    for name in ("centre", "scale", "rotation", "opacity", "sh"):
        assert np.array_equal(getattr(whole.surfels, name), getattr(resumed.surfels, name)), name
    assert np.array_equal(whole.mesh.vertices, resumed.mesh.vertices)


@pytest.mark.slow
def test_materials_and_light_come_with_the_asset(capture, tmp_path):
    quick = Decoupling(iterations=30, pixels=256, cosine=4, ggx=4, light=4, environment=8, normals=True)
    short = Settings(schedule=replace(QUICK, iterations=60, surfels=1500), mesh_resolution=32, decoupling=quick)
    told = []
    asset = reconstruct(capture, short, told.append, folder=tmp_path)
    assert asset.environment.radiance.shape == (8, 16, 3) and asset.environment.radiance.min() > 0
    assert asset.provenance["report"]["decoupling"]["iterations"] == 30
    assert asset.provenance["materials"] == "hardly separated from the lighting, in 30 of 30 steps: unreliable"
    assert told[-1].phase == "materials" and told[-1].part == 1.0
    # A surfel has the mean of its face's corners, which have learned something; of colours what blends to it.
    corners = asset.mesh.faces[asset.binding.face]
    shares = clamp_weights(asset.binding.barycentric)
    expected = np.einsum("nk,nk->n", shares, asset.mesh.roughness[corners])
    assert np.abs(asset.surfels.roughness - np.clip(expected, 0, 1)).max() < 1e-5
    colour = np.einsum("nk,nkc->nc", shares, asset.mesh.albedo[corners])
    assert 0 < np.abs(asset.surfels.albedo - colour).mean() < 0.5 * asset.mesh.albedo.std()
    # It is shaded by what was learned on the mesh, not by its own normal, which 60 steps have hardly turned.
    assert np.median(asset.binding.normal[:, 2]) > 0.95 and asset.binding.normal[:, 2].min() > 0.4


@pytest.mark.slow
def test_a_run_that_is_stopped_after_its_materials_learns_none_again(capture, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(pipeline, "is_thin", lambda *_: False)  # nothing is done after materials on surfels
    quick = Decoupling(iterations=6, pixels=64, cosine=2, ggx=2, light=2, environment=8)
    short = Settings(schedule=replace(QUICK, iterations=20, surfels=500), mesh_resolution=24, decoupling=quick)
    told: list[Progress] = []
    with pytest.raises(Cancelled):
        reconstruct(capture, short, told.append, lambda: bool(told) and told[-1].part > 0.97, tmp_path)
    first, told[:] = len(told), []
    with caplog.at_level("INFO"):
        asset = reconstruct(capture, short, told.append, folder=tmp_path)
    assert first > 0 and "materials: going on at step 6" in caplog.text and told[-1].part == 1.0
    assert asset.provenance["report"]["steps"]["materials"] == [6, 6]


def test_surfels_of_too_few_steps_are_called_rough(capture, caplog):
    short = Settings(
        schedule=replace(QUICK, iterations=500, surfels=300), mesh_resolution=24, materials=False, minutes=1e-3
    )
    reconstruct(capture, short)
    assert re.search(r"surfels got \d+ of 500 steps in their part of 0.001 minutes", caplog.text)


@pytest.mark.slow
def test_surfels_on_the_mesh_take_what_blends_to_it_as_well(capture):
    quick = Decoupling(iterations=6, pixels=64, cosine=2, ggx=2, light=2, environment=8, normals=True)
    schedule = replace(QUICK, iterations=20, surfels=500)
    asset = reconstruct(capture, Settings(schedule=schedule, mesh_resolution=24, decoupling=quick, variant="m"))
    colour = np.einsum(
        "nk,nkc->nc", clamp_weights(asset.binding.barycentric), asset.mesh.albedo[asset.mesh.faces[asset.binding.face]]
    )
    assert 0 < np.abs(asset.surfels.albedo - colour).mean() < 0.1
    assert np.isfinite(asset.binding.normal).all() and asset.binding.normal[:, 2].min() > 0.3


def test_materials_of_too_few_steps_are_called_unreliable(capture, caplog):
    """In the log with what to do, and in the asset: a budget that is over after the first step separates nothing."""
    hurried = Decoupling(iterations=400, seconds=1e-6, pixels=64, cosine=2, ggx=2, light=2, environment=8)
    short = Settings(schedule=replace(QUICK, iterations=3, surfels=500), mesh_resolution=24, decoupling=hurried)
    asset = reconstruct(capture, short)
    assert asset.provenance["report"]["steps"] == {"surfels": [3, 3], "materials": [1, 400]}
    assert asset.provenance["materials"] == "hardly separated from the lighting, in 1 of 400 steps: unreliable"
    (told,) = [r.getMessage() for r in caplog.records if "of 400 steps" in r.getMessage()]
    assert "unreliable" in told and "--set decoupling.seconds" in told


def test_settings_of_later_phases_leave_surfels_as_they_are(capture, tmp_path, caplog):
    short = Settings(schedule=replace(QUICK, iterations=3, surfels=500), mesh_resolution=32, materials=False)
    reconstruct(capture, short, folder=tmp_path)
    with caplog.at_level("INFO"):
        reconstruct(capture, replace(short, mesh_resolution=24), folder=tmp_path)
    assert "surfels: going on at step 3" in caplog.text


def test_a_damaged_or_foreign_checkpoint_is_not_used(capture, tmp_path, caplog):
    short = Settings(schedule=replace(QUICK, iterations=3, surfels=500), mesh_resolution=32, materials=False)
    (tmp_path / "surfels.state").write_bytes(b"\x08\0\0\0\0\0\0\0{broken")
    reconstruct(capture, short, folder=tmp_path)
    assert "starting over" in caplog.text
    caplog.clear()
    reconstruct(capture, replace(short, schedule=replace(short.schedule, seed=1)), folder=tmp_path)
    assert "other photographs or settings" in caplog.text


def test_a_run_with_masks_drawn_anew_a_retouched_pixel_or_another_program_is_another(capture, monkeypatch):
    before = fingerprint(capture)
    retouched = replace(capture, views=[replace(view, colour=view.colour.copy()) for view in capture.views])
    assert fingerprint(retouched) == before
    retouched.views[4].colour[20, 25] *= 0.9
    assert fingerprint(retouched) != before
    other = replace(capture, views=[replace(view, mask=view.mask.copy()) for view in capture.views])
    assert fingerprint(other) == before
    other.views[4].mask[20, 25] = 1 - other.views[4].mask[20, 25].round()
    assert fingerprint(other) != before
    layer = np.ones_like(capture.views[0].colour)
    bright, normal, linear = (
        replace(capture, views=[replace(capture.views[0], **changed), *capture.views[1:]])
        for changed in ({"above_white": layer}, {"normals": layer}, {"linear": True})
    )
    cut = replace(capture, background=None), replace(capture, points=np.zeros((9, 3), np.float32))
    assert len({before, *map(fingerprint, (bright, normal, linear, *cut))}) == 6
    monkeypatch.setattr("drgs_blender.reconstruct.checkpoint.__version__", "0.0.9")
    assert fingerprint(capture) != before


def test_a_file_where_checkpoints_should_be_is_told_by_name(capture, tmp_path):
    (tmp_path / "a.reconstruct").write_text("mine")
    with pytest.raises(WriteError, match=r"a\.reconstruct"):
        reconstruct(capture, folder=tmp_path / "a.reconstruct")
    assert (tmp_path / "a.reconstruct").read_text() == "mine"


def test_progress_tells_phases_and_shows_pictures(capture):
    told = []
    short = Settings(schedule=replace(QUICK, iterations=5, surfels=500), mesh_resolution=32, materials=False)
    reconstruct(capture, short, told.append)
    assert [p.phase for p in told][:2] == ["surfels", "mesh"]
    assert all(a.part <= b.part for a, b in pairwise(told))
    assert told[0].psnr > 0 and told[1].psnr is None
    assert Training(capture, find_region(capture), short.schedule).psnr is None
    picture = told[0].picture
    assert picture.shape == (48, 96, 3) and 0 <= picture.min() <= picture.max() <= 1


def test_without_masks_the_background_says_where_the_object_is():
    region = find_region(balls(masks=False))
    assert np.median(np.abs(distance_to_balls(region.points)[0])) < region.spacing


def test_without_any_silhouette_the_user_is_told_and_points_are_used(caplog):
    capture = balls(12, 24, masks=False)
    capture.background = None
    capture.points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    region = find_region(capture)
    assert "masks" in caplog.text
    assert np.array_equal(region.points, capture.points)
    capture.points = None
    spread = find_region(capture)
    assert np.linalg.norm(spread.points - spread.centre, axis=1).max() <= spread.radius * 1.001


@pytest.mark.parametrize("case", ["two views", "one direction", "no mask", "other cameras", "mask size", "black"])
def test_what_cannot_be_reconstructed_is_refused_by_name(case):
    capture = balls(12, 24)
    text = ""
    if case == "two views":
        capture.views, text = capture.views[1:3], "2 views"
    elif case == "one direction":
        for k, view in enumerate(capture.views):
            matrix = capture.views[0].camera.matrix_world.copy()
            matrix[0, 3] += 0.01 * k
            view.camera = replace(view.camera, matrix_world=matrix)
        text = "one direction"
    elif case == "no mask":
        for view in capture.views:
            view.mask[:] = 0
        text = "no object"
    elif case == "other cameras":
        for view in capture.views:  # the camera looks the other way
            view.camera = replace(view.camera, matrix_world=view.camera.matrix_world @ np.diag([1.0, -1, -1, 1]))
        text = "no common point"
    elif case == "mask size":
        capture.views[3].mask = capture.views[3].mask[:-1]
        text = "mask of 24 x 23"
    elif case == "black":
        for view in capture.views:
            view.colour[:] = 0
        text = "black"
    with pytest.raises(AssetError, match=text):
        reconstruct(capture, Settings(schedule=Schedule(iterations=2)))


def test_few_views_are_told_before_anything_is_learned(caplog, monkeypatch):
    def stop(*_):
        raise Cancelled

    monkeypatch.setattr("drgs_blender.reconstruct.pipeline.find_region", lambda _: None)
    monkeypatch.setattr("drgs_blender.reconstruct.pipeline._voxels", stop)
    for count in (4, 5):
        caplog.clear()
        capture = balls(count, 24, test_every=1000)
        capture.views[0].test = False
        with pytest.raises(Cancelled):
            reconstruct(capture, Settings(schedule=Schedule(iterations=2)))
        assert ("only 4 views" in caplog.text) == (count == 4)


def test_more_voxels_than_memory_are_refused_before_anything_is_learned(capture, monkeypatch):
    monkeypatch.setattr("drgs_blender.reconstruct.memory_budget.total_memory", lambda: 1024.0)
    told = []
    with pytest.raises(UsageError, match="--voxels"):
        reconstruct(capture, Settings(schedule=Schedule(iterations=2), materials=False), told.append)
    assert not told


def test_the_command_writes_an_asset_and_its_preview(tmp_path, capsys, monkeypatch):
    """Without a card too, though one was asked for."""
    from PIL import Image

    from drgs_blender.cli.main import main

    write(balls(10, 32), tmp_path)
    out = tmp_path / "made" / "balls.drgs"
    options = ["--iterations", "30", "--surfels", "800", "--voxels", "32", "--test-every", "5", "--no-materials"]
    monkeypatch.setattr("drgs_blender.compute.warp.runtime.cuda_devices", list)
    monkeypatch.setenv("DRGS_PROGRESS", "1")
    code = main(["reconstruct", str(tmp_path), "--out", str(out), *options, "--device", "cuda"])
    said, warned = capsys.readouterr()
    assert "device cuda" in warned and "Learned on the CPU" in warned
    assert code == 0 and "DRGS_PROGRESS" in said and "views left out: PSNR" in said
    assert "  steps: surfels 30 of 30\n" in said
    assert len(read_asset(out).surfels) > 100
    assert Image.open(out.with_name("balls.preview.png")).size == (64, 32)
    assert not Path(out.with_name("balls.reconstruct")).exists()
    assert main(["reconstruct", str(tmp_path / "none"), "--out", str(out)]) == 65
    assert main(["reconstruct", str(tmp_path), "--out", str(tmp_path / "a.blend")]) == 64
