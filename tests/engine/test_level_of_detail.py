"""Level of detail of viewports: fewer surfels while something moves, all of them at rest and in final frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.deform.attach import attach
from drgs_blender.engine import level_of_detail
from drgs_blender.engine.session import Session
from drgs_blender.formats.registry import read_surfels

PLAYBOT = Path(__file__).resolve().parents[2] / "examples" / "playbot" / "playbot.ply"
MOST = 4000


@pytest.fixture(scope="module")
def dense_path(tmp_path_factory, mesh):
    """The ball with far more surfels than its mesh has vertices."""
    surfels, binding, _ = attach(mesh, density=120.0)
    path = tmp_path_factory.mktemp("dense") / "dense.drgs"
    write_asset(path, Asset(surfels, mesh, binding))
    return path


@pytest.fixture(scope="module")
def capture_path(tmp_path_factory):
    """A real capture without a mesh."""
    path = tmp_path_factory.mktemp("capture") / "playbot.drgs"
    write_asset(path, Asset(read_surfels(PLAYBOT).surfels, Mesh.empty()))
    return path


@pytest.fixture
def session(dense_path):
    made = Session()
    made.load_asset(dense_path)
    return made


@pytest.fixture
def frame_of_dense(make_frame, dense_path):
    def make(bend=0.0, **settings):
        frame = make_frame(bend, **settings)
        frame.objects[0].asset = str(dense_path.resolve())
        return frame

    return make


def of_capture(make_frame, path, captured):
    """The real capture from the front, in its captured colours or lit."""
    frame = make_frame(size=(120, 90), rays_see="mesh" if captured else "surfels", camera_sees="surfels")
    frame.objects[0] = replace(frame.objects[0], asset=str(path.resolve()), vertices=None, captured_colours=captured)
    places = read_surfels(PLAYBOT).surfels.centre
    low, high = np.percentile(places, [2, 98], axis=0)
    frame.camera.matrix_world[:3, 3] = (low + high) / 2
    frame.camera.matrix_world[1, 3] -= 1.6 * float((high - low).max())
    return frame


def sized(session, monkeypatch, size):
    """Have first pictures made of pixels of one size."""
    monkeypatch.setattr(session._pace, "size", lambda pixels: size)


def shown(passes):
    return passes.statistics["view.surfels"], passes.statistics["view.all"]


def test_a_view_at_rest_is_the_final_picture(session, frame_of_dense):
    frame = frame_of_dense(0.2)
    final = session.render(frame)
    found = [session.view("A", frame, most=MOST)]
    while found[-1].statistics["view.fraction"] < 1.0:
        found.append(session.refine("A"))
    assert 0 < shown(found[0])[0] <= MOST < shown(found[0])[1]
    assert shown(found[-1])[0] == shown(found[-1])[1]
    for name in final:
        np.testing.assert_allclose(found[-1][name], final[name], rtol=1e-4, atol=2e-6, err_msg=name)
    # What has all the samples has all the surfels: they are drawn together.
    assert all((p.statistics["view.fraction"] > 0) == (shown(p)[0] == shown(p)[1]) for p in found)


def test_final_frames_do_not_know_of_it(session, frame_of_dense, dense_path):
    fresh = Session()
    fresh.load_asset(dense_path)
    for bend in (0.0, 0.3):
        frame = frame_of_dense(bend)
        session.view("A", frame, most=MOST)
        after = session.render(frame)
        expected = fresh.render(frame)
        for name in expected:
            assert after[name].tobytes() == expected[name].tobytes(), name
        assert after.statistics["surfels"] == shown(session.view("A", frame, most=0))[1]


def test_pictures_are_the_same_whatever_was_before(session, frame_of_dense, dense_path, monkeypatch):
    frame, other = frame_of_dense(0.2), frame_of_dense(-0.1)
    fresh = Session()
    fresh.load_asset(dense_path)
    for each in (session, fresh):
        sized(each, monkeypatch, 2)
    session.render(other)
    session.view("A", other, most=50)
    session.view("A", frame, most=MOST // 3)
    again = session.view("A", frame, most=MOST)
    first = fresh.view("B", frame, most=MOST)
    for name in first:
        assert first[name].tobytes() == again[name].tobytes(), name


@pytest.mark.parametrize("size", [1, 2, 3])
def test_fewer_surfels_leave_no_holes(session, frame_of_dense, monkeypatch, size):
    frame = frame_of_dense(0.2, size=(144, 108))
    frame.passes = ("Combined", "Albedo")
    sized(session, monkeypatch, size)
    whole, few = session.view("A", frame, most=0), session.view("A", frame)
    assert_alike(whole, few, 28.0)
    # Surfels of less than a pixel widen the outline: fewer, by less.
    final, *made = (p["Combined"][..., 3].mean() for p in (session.render(frame), few, whole))
    assert abs(made[0] - final) <= abs(made[1] - final) + 0.005


@pytest.mark.parametrize("captured", [True, False])
@pytest.mark.parametrize("most", [20_000, 5000])
def test_a_real_capture_keeps_its_look(make_frame, capture_path, monkeypatch, captured, most):
    """Few surfels are left of few: what it loses is detail, not its shape or colour."""
    frame = of_capture(make_frame, capture_path, captured)
    frame.passes = ("Combined", "Depth") if captured else ("Combined", "Albedo")
    session = Session()
    session.load_asset(capture_path)
    sized(session, monkeypatch, 1)
    whole, few = session.view("A", frame, most=0), session.view("A", frame, most=most)
    assert shown(few)[0] <= most < shown(few)[1]
    assert_alike(whole, few, 20.0)


def assert_alike(whole, few, decibels):
    """Opaque where the whole is, but at its outline, and as near in colour."""
    assert shown(few)[0] < shown(whole)[0] == shown(whole)[1]
    alpha, own = whole["Combined"][..., 3], few["Combined"][..., 3]
    inside = minimum_filter(alpha, 3) > 0.98
    assert inside.mean() > 0.1
    assert (own[inside] > 0.9).mean() > 0.993
    assert -0.06 < own.mean() - alpha.mean() < 0.02
    name = "Albedo" if "Albedo" in whole else "Combined"
    error = whole[name][..., :3][inside] - few[name][..., :3][inside]
    assert -10 * np.log10(np.square(error).mean()) > decibels


def test_what_is_near_gets_more_of_its_object(session, frame_of_dense, monkeypatch):
    """Surfels that the picture does not show count no pixels; a limit holds whatever one looks at."""
    sized(session, monkeypatch, 3)
    monkeypatch.setattr(level_of_detail, "_LEAST", 100)
    counts = {}
    for distance in (40.0, 4.0, 1.6):
        frame = frame_of_dense(size=(192, 144))
        frame.camera.matrix_world[1, 3] = -distance
        counts[distance] = shown(session.view("A", frame))[0]
        assert shown(session.view("A", frame, most=3000))[0] <= 3000
    assert counts[40.0] < counts[4.0] < counts[1.6]
    frame.camera.matrix_world[1, 3], frame.camera.cx = -4.0, 0.0
    assert shown(session.view("A", frame))[0] >= counts[4.0], "half of it is no coarser than the whole"
    frame.camera.matrix_world[1, 3], frame.camera.cx = 40.0, 96.0  # it is behind the camera
    assert shown(session.view("A", frame))[0] <= counts[40.0]


def test_what_is_posed_counts_where_it_stands(session, frame_of_dense, monkeypatch):
    """An object that its matrix or its vertices bring near, not the camera."""
    sized(session, monkeypatch, 3)
    monkeypatch.setattr(level_of_detail, "_LEAST", 100)
    frame = frame_of_dense(size=(192, 144))
    frame.camera.matrix_world[1, 3] = -40.0
    far = shown(session.view("A", frame))[0]
    near = np.eye(4)
    near[1, 3] = -36.0
    by_matrix = replace(frame, objects=[replace(frame.objects[0], matrix_world=near)])
    vertices = frame.objects[0].vertices + np.float32([0, -36, 0])
    by_vertices = replace(frame, objects=[replace(frame.objects[0], vertices=vertices)])
    counts = [shown(session.view("A", each))[0] for each in (by_matrix, by_vertices)]
    assert counts[0] == counts[1] > far


def test_an_orthographic_view_counts_by_its_scale_not_by_the_distance(session, frame_of_dense, monkeypatch):
    sized(session, monkeypatch, 3)
    monkeypatch.setattr(level_of_detail, "_LEAST", 100)

    def count(distance, scale):
        frame = frame_of_dense(size=(192, 144))
        frame.camera.orthographic, frame.camera.fx, frame.camera.fy = True, scale, scale
        frame.camera.matrix_world[1, 3] = -distance
        return shown(session.view("A", frame))[0]

    assert count(4.0, 50.0) == count(40.0, 50.0) < count(4.0, 500.0)
    assert count(4.0, 5.0) < count(4.0, 50.0)


@pytest.mark.parametrize("most", [-1, 1.5, "many", True, None, float("nan")])
def test_a_limit_that_is_none_is_refused(session, frame_of_dense, most):
    with pytest.raises(UsageError, match="viewport surfels"):
        session.view("A", frame_of_dense(), most=most)


def test_a_limit_smaller_than_the_number_of_objects_shows_them_all(session, frame_of_dense):
    frame = frame_of_dense()
    frame.objects.append(replace(frame.objects[0], name="Other", matrix_world=np.diag([2.0, 2, 2, 1])))
    passes = session.view("A", frame, most=1)
    assert shown(passes)[0] == 2
    assert np.isfinite(passes["Combined"]).all()


def test_light_meets_fewer_surfels_too(session, frame_of_dense, monkeypatch):
    """Where rays see surfels their tree is of those of the picture; the final one of all again."""
    frame = frame_of_dense(0.1, rays_see="surfels")
    sized(session, monkeypatch, 1)
    final = session.render(frame)
    few, whole = session.view("A", frame, most=MOST), session.view("A", frame, most=0)
    assert shown(few)[0] <= MOST
    inside = minimum_filter(whole["Combined"][..., 3], 3) > 0.98
    ratio = few["Combined"][inside][:, :3].mean() / whole["Combined"][inside][:, :3].mean()
    assert 0.8 < ratio < 1.25, "no more shadow than of all"
    after = session.render(frame)
    assert after["Combined"].tobytes() == final["Combined"].tobytes()


def test_light_meets_the_fewer_surfels_of_this_pose_and_number(session, frame_of_dense, dense_path, monkeypatch):
    """Not those of the picture before."""
    fresh = Session()
    fresh.load_asset(dense_path)
    for each in (session, fresh):
        sized(each, monkeypatch, 1)
    frame = frame_of_dense(0.3, rays_see="surfels")
    session.view("A", frame_of_dense(-0.3, rays_see="surfels"), most=MOST)
    session.view("A", frame, most=MOST // 4)
    again, first = session.view("A", frame, most=MOST), fresh.view("A", frame, most=MOST)
    assert again["Combined"].tobytes() == first["Combined"].tobytes()


def test_cancelled_half_way_it_goes_on_where_it_was(session, frame_of_dense):
    """However far the work on all surfels has come."""
    frame = frame_of_dense(0.2)
    final = Session()
    final.load_asset(frame.objects[0].asset)
    expected = final.render(frame)["Combined"]
    passes = session.view("A", frame, most=MOST)
    asked = 0
    for patience in (*range(12), 40, 100, 250):
        asked = 0

        def cancelled(patience=patience):
            nonlocal asked
            asked += 1
            return asked > patience

        try:
            passes = session.refine("A", cancelled=cancelled) or passes
        except Cancelled:
            continue
    while passes.statistics["view.fraction"] < 1.0:
        passes = session.refine("A")
    np.testing.assert_allclose(passes["Combined"], expected, rtol=1e-4, atol=2e-6)


def test_a_mesh_as_detailed_stands_for_its_surfels(session, frame_of_dense, monkeypatch):
    monkeypatch.setattr(level_of_detail, "_SURFELS_A_VERTEX", 10_000)
    sized(session, monkeypatch, 2)
    assert shown(session.view("A", frame_of_dense()))[0] == 0
    assert shown(session.view("A", frame_of_dense(), most=0))[0] == shown(session.view("A", frame_of_dense()))[1]


def test_all_surfels_have_all_pixels_before_them(session, frame_of_dense, monkeypatch):
    """Where all take long, a picture of fewer, but sharp, comes between."""
    sized(session, monkeypatch, 6)
    frame = frame_of_dense()
    found = [session.view("A", frame, most=MOST), *(session.refine("A") for _ in range(3))]
    assert [p.statistics["view.pixel"] for p in found] == [6, 2, 1, 1]
    assert [p.statistics["view.fraction"] > 0 for p in found] == [False, False, False, True]
