"""Objects in captured colours in whole pictures: beside lit ones, in passes and reflections, and what is said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pictures import assert_same_bits, with_meshes

from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.cryptomatte import name_hash
from drgs_blender.core.frame import Adjustment, Frame, MeshState, MotionStep, ObjectState, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.render.gbuffer.surfels import snap_windows

#: Colour of the display that the plain ball has from all sides, and the constant harmonic.
COLOUR, CONSTANT = (0.6, 0.3, 0.8), 0.28209479177387814


@pytest.fixture(scope="module")
def captured_path(tmp_path_factory: pytest.TempPathFactory, asset_path: Path) -> Path:
    """The ball with one colour from all sides."""
    return with_harmonics(asset_path, tmp_path_factory.mktemp("captured") / "plain.drgs", 0.0)


@pytest.fixture(scope="module")
def shiny_path(tmp_path_factory: pytest.TempPathFactory, asset_path: Path) -> Path:
    """The ball with colours that depend on the view."""
    return with_harmonics(asset_path, tmp_path_factory.mktemp("captured") / "shiny.drgs", 0.2)


def with_harmonics(source: Path, path: Path, change: float) -> Path:
    asset = read_asset(source)
    sh = np.random.default_rng(1).normal(size=(len(asset.surfels), 9, 3)).astype(np.float32) * change
    sh[:, 0] = (np.array(COLOUR) - 0.5) / CONSTANT
    surfels = replace(asset.surfels, sh=sh)
    surfels.opacity = np.ones_like(surfels.opacity)
    write_asset(path, Asset(surfels, asset.mesh, asset.binding))
    return path


def session_of(*paths: Path) -> Session:
    made = Session()
    for path in paths:
        made.load_asset(path)
    return made


@pytest.fixture
def frame_of(make_frame: Callable[..., Frame]) -> Callable[..., Frame]:
    """Function that makes a frame with a captured ball."""

    def make(path: Path, passes: tuple[str, ...] = ("Combined", "Emit", "DiffDir", "GlossDir"), **settings) -> Frame:
        frame = make_frame(**settings)
        frame.objects[0].asset, frame.objects[0].captured_colours = str(path.resolve()), True
        frame.passes = passes
        return frame

    return make


def beside(frame: Frame, path: Path, x: float = 0.9, y: float = 0.0) -> ObjectState:
    """A lit ball that is half in front of the captured one; added to the frame."""
    lit = ObjectState("Lit", str(path.resolve()))
    lit.matrix_world[:3, :3] *= 0.7
    lit.matrix_world[:3, 3] = x, y, 0.2
    frame.objects.append(lit)
    return lit


def test_it_is_seen_in_its_own_colour_under_any_light(captured_path, frame_of):
    frame = frame_of(captured_path)
    session = session_of(captured_path)
    picture = session.render(frame)
    alpha = picture["Combined"][..., 3]
    inside = alpha > 0.999
    assert inside.sum() > 200 and not picture.warnings
    assert np.allclose(picture["Combined"][inside, :3], srgb_to_linear(np.array(COLOUR)), atol=2e-3)
    assert not picture["DiffDir"].any() and not picture["GlossDir"].any()
    dark = frame_of(captured_path)
    dark.world = World(strength=0.0)
    assert_same_bits(session.render(dark), picture)


def test_passes_add_up_beside_a_lit_object(captured_path, asset_path, frame_of):
    passes = ("Combined", "DiffDir", "DiffInd", "DiffCol", "GlossDir", "GlossInd", "GlossCol", "Env", "Emit")
    passes += ("IndexOB", "CryptoObject00")
    frame = frame_of(captured_path, passes, size=(64, 48), samples=8)
    beside(frame, asset_path).pass_index = 3
    frame.objects[0].pass_index = 5
    picture = session_of(captured_path, asset_path).render(frame)
    total = picture["Env"] + picture["Emit"]
    for lobe in ("Diff", "Gloss"):
        total = total + (picture[f"{lobe}Dir"] + picture[f"{lobe}Ind"]) * picture[f"{lobe}Col"]
    np.testing.assert_allclose(picture["Combined"][..., :3], total, rtol=1e-5, atol=1e-6)
    index, light = picture["IndexOB"][..., 0], (picture["DiffDir"] + picture["GlossDir"]).sum(axis=2)
    assert set(np.unique(index)) == {0, 3, 5}
    matte, share = (picture["CryptoObject00"][..., k] for k in (0, 1))
    ball, lit = np.array([name_hash("Ball"), name_hash("Lit")], np.uint32).view(np.float32)
    whole = share > 0.999
    assert (matte[whole & (index == 5)] == ball).all() and (matte[whole & (index == 3)] == lit).all()
    colour = (picture["DiffCol"] + picture["GlossCol"]).sum(axis=2)  # of what emits alone it is black
    assert not colour[whole & (matte == ball)].any() and (colour[whole & (matte == lit)] > 0).all()
    assert not light[whole & (matte == ball)].any() and (light[whole & (matte == lit)] > 0).all()


def test_it_is_in_front_of_and_behind_others(captured_path, asset_path, frame_of):
    """Half of the lit ball hides it; moved behind, none does."""
    session = session_of(captured_path, asset_path)
    for y, hidden in ((-1.2, True), (2.5, False)):
        frame = frame_of(captured_path, ("Combined", "IndexOB"))
        beside(frame, asset_path, 0.5, y).pass_index = 3
        frame.objects[0].pass_index = 5
        index = session.render(frame)["IndexOB"][..., 0]
        alone = frame_of(captured_path, ("Combined", "IndexOB"))
        alone.objects[0].pass_index = 5
        own = session.render(alone)["IndexOB"][..., 0] == 5
        assert bool((index[own] == 3).mean() > 0.1) == hidden, y


def test_meshes_and_holdouts_cut_it(captured_path, frame_of):
    frame = with_meshes(frame_of(captured_path))
    session = session_of(captured_path)
    whole, cut = session.render(frame_of(captured_path)), session.render(frame)
    assert (whole["Emit"].sum(axis=2) > 0).sum() > (cut["Emit"].max(axis=2) > 0.1).sum() > 100
    frame.objects[0].visibility.holdout = True
    assert not (session.render(frame)["Emit"][..., 2] > 0.31).any()  # what is left is of the small squares
    frame.objects[0].visibility = Visibility(camera=False)
    assert not (session.render(frame)["Emit"][..., 2] > 0.31).any()


def test_a_lit_object_beside_it_has_the_light_it_has_beside_a_glowing_mesh(captured_path, asset_path, frame_of):
    """What rays meet is its mesh, which shines in the mean of its colours; nothing else lights this scene."""
    session = session_of(captured_path, asset_path)
    frame = frame_of(captured_path, ("DiffDir", "CryptoObject00"), size=(96, 72), samples=32, bounces=1)
    frame.world = World(strength=0.0)
    beside(frame, asset_path, 1.3)
    own = session.render(frame)
    mesh, radiance = read_asset(captured_path).mesh, tuple(map(float, srgb_to_linear(np.array(COLOUR))))
    glow = MeshState(
        "Glow", frame.objects[0].vertices, mesh.faces, np.eye(4)[None], np.zeros(1, np.int32),
        materials=[Material("glow", (0.0, 0.0, 0.0), 1.0, 1.0, radiance)], visibility=Visibility(camera=False),
    )  # fmt: skip
    frame.objects, frame.meshes = frame.objects[1:], [glow]
    other = session.render(frame)
    lit = np.uint32([name_hash("Lit")]).view(np.float32)
    there = (own["CryptoObject00"][..., 0] == lit) & (own["CryptoObject00"][..., 1] > 0.999)
    a, b = own["DiffDir"][there], other["DiffDir"][there]
    assert there.sum() > 100 and a.mean() > 0.01
    assert np.abs(a - b).mean() < 0.02 * b.mean()


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
def test_a_mirror_shows_its_colour(captured_path, frame_of, rays_see):
    passes = "GlossDir", "GlossInd", "Emit"
    frame = with_meshes(frame_of(captured_path, passes, samples=32, rays_see=rays_see))
    frame.world = World(strength=0.0)
    floor = frame.meshes[0]
    floor.materials = [Material("mirror", (1.0, 1.0, 1.0), 0.0, 1.0)]
    frame.meshes = [floor]
    frame.camera.matrix_world = np.array([[1, 0, 0, 0], [0, 0.8, -0.6, -4.2], [0, 0.6, 0.8, 3.4], [0, 0, 0, 1.0]])
    floor.matrices[0, 2, 3] = -1.0
    picture = session_of(captured_path).render(frame)
    seen = picture["GlossDir"] + picture["GlossInd"]
    bright = seen[seen[..., 2] > 0.9 * seen[..., 2].max()]
    assert len(bright) > 20
    assert np.allclose(np.median(bright, axis=0), srgb_to_linear(np.array(COLOUR)), rtol=0.04)


def test_colours_turn_with_object_and_camera(shiny_path, frame_of):
    """Both turned alike: the same picture; the object turned alone: another one."""
    session = session_of(shiny_path)
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    before, both, alone = (frame_of(shiny_path, samples=8) for _ in range(3))
    for frame in (both, alone):
        frame.objects[0].matrix_world = turn
    both.camera.matrix_world = turn @ both.camera.matrix_world
    a, b, c = (session.render(frame)["Combined"] for frame in (before, both, alone))
    assert np.abs(a - b).mean() < 1e-3 < 0.02 < np.abs(a - c).mean()


def test_colours_turn_with_the_mesh_that_is_bent(shiny_path, frame_of):
    """Vertices turned in place of the object: the same picture."""
    session = session_of(shiny_path)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    by_matrix, by_vertices = frame_of(shiny_path), frame_of(shiny_path)
    by_matrix.objects[0].matrix_world[:3, :3] = turn
    by_vertices.objects[0].vertices = (by_vertices.objects[0].vertices @ turn.T).astype(np.float32)
    a, b = session.render(by_matrix)["Combined"], session.render(by_vertices)["Combined"]
    assert np.abs(a - b).max() < 1e-3


def test_a_mirrored_object_is_seen_as_in_a_mirror(shiny_path, frame_of):
    session = session_of(shiny_path)
    plain, mirrored = (frame_of(shiny_path, samples=64, subpixel_samples=32) for _ in range(2))
    mirrored.objects[0].matrix_world = np.diag([-1.0, 1.0, 1.0, 1.0])
    a, b = (session.render(frame)["Combined"] for frame in (plain, mirrored))
    assert np.abs(a - b[:, ::-1]).mean() < 2e-3 < 0.02 < np.abs(a - b).mean()


def test_its_points_are_tied_to_its_mesh(shiny_path, frame_of, monkeypatch):
    """Light meets a mesh of it, no sheets: its passes are those of windows without a sign, and not of negative ones."""
    passes = "Combined", "Emit", "Normal", "Depth", "Position"
    frame, pictures = frame_of(shiny_path, passes, size=(96, 72)), []
    for windows in (snap_windows, lambda *of: abs(snap_windows(*of)), lambda *of: -abs(snap_windows(*of))):
        monkeypatch.setattr("drgs_blender.render.pipeline.snap_windows", windows)
        pictures.append(session_of(shiny_path).render(frame))
    assert_same_bits(*pictures[:2])
    assert (pictures[0]["Normal"] != pictures[2]["Normal"]).any()


def test_steps_end_in_the_whole_picture(shiny_path, asset_path, frame_of):
    for threshold in (0.0, 0.1):
        frame = frame_of(shiny_path, ("Combined", "Emit"), samples=32, noise_threshold=threshold)
        beside(frame, asset_path)
        session = session_of(shiny_path, asset_path)
        whole = session.render(frame)
        picture = session.view("view", frame)
        while picture.statistics["view.fraction"] < 1.0:
            picture = session.refine("view")
        assert np.allclose(picture["Combined"], whole["Combined"], atol=1e-5)
        assert np.array_equal(picture["Emit"], whole["Emit"])


def test_a_first_picture_has_captured_colours_too(captured_path, asset_path, frame_of):
    """Not the mesh, which stands for the surfels of lit objects there."""
    frame = frame_of(captured_path, ("Combined",), size=(480, 360))
    picture = session_of(captured_path).view("view", frame)["Combined"]
    inside = picture[..., 3] > 0.999
    assert np.allclose(np.median(picture[inside, :3], axis=0), srgb_to_linear(np.array(COLOUR)), atol=2e-3)


def test_it_needs_no_light_and_shines_on_others(captured_path, asset_path, frame_of):
    """So that no message says that nothing lights the scene."""
    frame, session = frame_of(captured_path), session_of(captured_path, asset_path)
    frame.world = World(colour=(0.0, 0.0, 0.0))
    assert session.render(frame).warnings == []
    beside(frame, asset_path)
    assert session.render(frame).warnings == []
    frame.objects[0].captured_colours = False
    (text,) = session.render(frame).warnings
    assert text.startswith("nothing lights the scene")


def test_the_denoiser_brings_no_light_to_it(tmp_path, frame_of):
    """Beside a lit wall in one plane with it, where nothing else tells one from the other."""
    corners = np.float32([[0, 0, -1], [1, 0, -1], [1, 0, 1], [0, 0, 1]])
    wall = Mesh(corners, np.int32([[0, 1, 2], [0, 2, 3]]), [[0.8] * 3] * 4, [0.5] * 4, [0] * 4)
    surfels, binding, _ = attach(wall, density=60.0)
    write_asset(tmp_path / "wall.drgs", Asset(surfels, wall, binding))
    path = with_harmonics(tmp_path / "wall.drgs", tmp_path / "captured.drgs", 0.0)
    pictures = []
    for denoise in ("none", "svgf"):
        frame = frame_of(path, ("Emit", "DiffDir", "IndexOB"), samples=4, denoise=denoise)
        frame.objects[0].vertices = None
        other = MeshState("Lit", corners - np.float32([1, 0, 0]), wall.faces, np.eye(4)[None], np.zeros(1, np.int32))
        pictures.append(session_of(path).render(replace(frame, meshes=[other])))
    noisy, smooth = pictures
    own = (noisy["Emit"].sum(axis=2) > 0) & (noisy["DiffDir"].sum(axis=2) == 0)  # shows nothing of the wall
    assert np.array_equal(noisy["Emit"], smooth["Emit"]) and own.sum() > 100
    assert smooth["DiffDir"][own].max() == 0.0 < 0.1 < smooth["DiffDir"].max()
    assert not smooth["IndexOB"].any()


def test_history_does_not_show(captured_path, asset_path, frame_of):
    """Switched on and off, by other settings and with motion: the bits of a session that has seen nothing else."""
    frames = [frame_of(captured_path, ("Combined", "Emit", "Vector"), samples=4) for _ in range(6)]
    frames[1].objects[0].captured_colours = False
    frames[2].settings.rays_see = "surfels"
    frames[3].settings.camera_sees = "mesh"
    frames[4].objects[0].vertices[:] += 0.1
    frames[5].meshes = with_meshes(frame_of(captured_path)).meshes[:1]
    for frame in frames:
        beside(frame, asset_path)
        frame.previous = MotionStep(frame.camera, [None, None], [None] * len(frame.meshes))
    session = session_of(captured_path, asset_path)
    for frame in (*frames, frames[0]):
        assert_same_bits(session.render(frame), session_of(captured_path, asset_path).render(frame))


def test_an_asset_without_harmonics_is_lit_and_says_so(asset_path, frame_of):
    session, frame = session_of(asset_path), frame_of(asset_path)
    picture = session.render(frame)
    (warning,) = picture.warnings
    assert "Ball" in warning and "no captured colours" in warning and "lit as usual" in warning
    frame.objects[0].captured_colours = False
    assert_same_bits(session.render(frame), picture)


def test_what_cannot_be_shown_is_named_and_no_longer(captured_path, frame_of):
    session = session_of(captured_path)
    (warning,) = session.render(frame_of(captured_path, camera_sees="mesh")).warnings
    assert warning.startswith("Ball: ") and "Camera Sees is Mesh" in warning
    assert not session.render(frame_of(captured_path)).warnings
    curved = frame_of(captured_path)
    curved.camera.panorama, curved.camera.fx, curved.camera.fy = "fisheye", 20.0, 20.0
    (warning,) = session.render(curved).warnings
    assert "panoramic" in warning
    (warning,) = session.render(frame_of(captured_path, camera_sees="mesh")).warnings  # of the same state
    assert "Camera Sees is Mesh" in warning
    caught = frame_of(captured_path)
    caught.objects[0].visibility.shadow_catcher = True
    assert "shadow catcher" in session.render(caught).warnings[0]


def test_without_a_mesh_it_is_seen_by_the_camera_alone(tmp_path, captured_path, frame_of):
    """A capture of which no mesh was made needs none to be shown; lit, sheets of its surfels cast its shadow."""
    asset = read_asset(captured_path)
    path = tmp_path / "bare.drgs"
    write_asset(path, Asset(asset.surfels, Mesh.empty(), None))
    frame, session = frame_of(path), session_of(path)
    frame.objects[0].vertices = None
    picture = session.render(frame)
    (warning,) = picture.warnings
    assert "has no mesh" in warning and "no shadow" in warning
    inside = picture["Combined"][..., 3] > 0.999
    assert np.allclose(np.median(picture["Combined"][inside, :3], axis=0), srgb_to_linear(np.array(COLOUR)), atol=2e-3)
    frame.settings.rays_see = "surfels"
    (warning,) = session.render(frame).warnings
    assert "has no mesh" in warning and "its materials" in warning
    frame.settings.rays_see = "mesh"
    frame.objects[0].visibility = Visibility(diffuse=False, glossy=False, shadow=False)
    assert not session.render(frame).warnings
    frame.objects[0].captured_colours = False
    assert not session.render(frame).warnings


def test_materials_and_adjustments_do_not_show_on_it(captured_path, frame_of):
    session, frame = session_of(captured_path), frame_of(captured_path)
    plain = session.render(frame)
    changed = frame_of(captured_path)
    changed.objects[0].albedo = np.full_like(changed.objects[0].vertices, 0.9)
    changed.objects[0].adjustment = Adjustment(tint=(1.0, 0.0, 0.0))
    assert_same_bits(session.render(changed), plain)


@pytest.mark.slow
def test_a_device_shows_the_same(shiny_path, asset_path, frame_of, monkeypatch):
    """Warp's processor as the card: posed, blended and lit there."""
    pytest.importorskip("warp", reason="warp-lang is not installed")
    pictures = []
    for device in ("cpu", "cuda"):
        frame = frame_of(shiny_path, samples=8, device=device)
        frame.objects[0].vertices[:, 0] += 0.2 * frame.objects[0].vertices[:, 2]
        beside(frame, asset_path)
        pictures.append(session_of(shiny_path, asset_path).render(frame))
        monkeypatch.setattr("drgs_blender.render.gpu.select_backend.name_of", lambda device: "cpu")
    here, there = pictures
    assert here.warnings == there.warnings
    for name in ("Combined", "Emit", "DiffDir"):
        assert here[name].any() and np.mean((here[name] - there[name]) ** 2) < 1e-6
