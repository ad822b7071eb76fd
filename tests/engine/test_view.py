"""Pictures of viewports: they grow to the final picture, whatever happens on the way."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from drgs_blender.core.errors import Cancelled
from drgs_blender.core.frame import Light, ObjectState, Visibility
from drgs_blender.engine.progressive_view import FIRST_SECONDS, Pace
from drgs_blender.engine.session import Session
from drgs_blender.render import progressive
from drgs_blender.render.progressive import coarse, parts_of

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


@pytest.fixture
def session(asset_path):
    made = Session()
    made.load_asset(asset_path)
    return made


def pictures(session, frame, name="A"):
    """All pictures of a view, from the first to the last."""
    found = [session.view(name, frame)]
    while found[-1].statistics["view.fraction"] < 1.0:
        found.append(session.refine(name))
    return found


def assert_close(a, b):
    """Same passes up to the rounding of sums."""
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_allclose(a[name], b[name], rtol=1e-4, atol=2e-6, err_msg=name)


def lit(frame):
    """The frame with a light that the camera sees, and a second object that only catches shadows."""
    matrix = np.eye(4)
    matrix[:3, 3] = 0.6, -1.5, 1.2
    frame.lights = [Light("Light", "point", matrix, power=60.0, radius=0.2, camera=True)]
    place = np.diag([3.0, 3.0, 0.1, 1.0])
    place[2, 3] = -1.3
    frame.objects.append(
        ObjectState("Floor", frame.objects[0].asset, place, visibility=Visibility(shadow_catcher=True))
    )
    return frame


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"camera_sees": "mesh", "bounces": 2},
        pytest.param({"samples": 12, "subpixel_samples": 3}, marks=pytest.mark.slow),
        {"samples": 3, "subpixel_samples": 2},  # not divisible: one part a sub-pixel sample
        {"denoise": "svgf", "samples": 4},
        {"film_transparent": False},
    ],
)
def test_last_picture_is_the_final_one(session, make_frame, settings):
    frame = lit(make_frame(0.2, **settings))
    frame.passes = ("Combined", "Depth", "Normal", "Albedo", "DiffDir", "GlossInd", "Env", "Emit", "IndexOB")
    found = pictures(session, frame)
    assert_close(found[-1], session.render(frame))
    fractions = [p.statistics["view.fraction"] for p in found]
    assert fractions[0] == 0.0 and fractions == sorted(fractions)


@pytest.mark.parametrize(
    "settings",
    [
        {"samples": 64, "subpixel_samples": 4},
        {"samples": 128, "subpixel_samples": 2, "denoise": "svgf"},
        pytest.param({"samples": 32, "subpixel_samples": 3, "strategy_samples": (32, 32, 32)}, marks=pytest.mark.slow),
        {"samples": 64, "camera_sees": "mesh"},
    ],
)
def test_noise_threshold_stops_where_the_final_frame_does(session, make_frame, settings, monkeypatch):
    """To the last bit: a pixel that stopped elsewhere would differ visibly. It ends as soon as nobody needs more."""
    monkeypatch.setattr("drgs_blender.engine.progressive_view.STEP_SECONDS", 0.0)
    frame = lit(make_frame(0.2, noise_threshold=0.05, **settings))
    final = session.render(frame)
    found = pictures(session, frame)
    for name in final:
        assert found[-1][name].tobytes() == final[name].tobytes(), name
    frame.settings.noise_threshold = 0.0
    assert np.abs(session.render(frame)["Combined"] - final["Combined"]).max() > 1e-4  # it made a difference
    frame.settings.noise_threshold = 100.0
    assert len(pictures(session, frame)) < len(found)


def test_region_is_the_final_one_too(session, make_frame):
    frame = make_frame(0.2)
    frame.camera.region = (7, 5, 31, 29)
    found = pictures(session, frame)
    assert found[-1]["Combined"].shape == (24, 24, 4)
    assert_close(found[-1], session.render(frame))


def test_every_picture_is_as_bright_as_the_last(session, make_frame, monkeypatch):
    """Sub-pixel samples that have no light yet borrow it, so that no picture is darker, nor its edges."""
    monkeypatch.setattr("drgs_blender.engine.progressive_view.STEP_SECONDS", 0.0)
    found = pictures(session, make_frame(0.2, samples=64, subpixel_samples=4))
    assert len(found) > 10
    mean = [p["Combined"].mean(axis=(0, 1)) for p in found]
    np.testing.assert_allclose(mean[0], mean[-1], rtol=0.15)  # surfels are never smaller than a sample
    for early in mean[1:]:
        np.testing.assert_allclose(early, mean[-1], rtol=0.05)


def test_samples_kept_or_found_again_are_the_same(session, make_frame, monkeypatch):
    monkeypatch.setattr("drgs_blender.engine.progressive_view.STEP_SECONDS", 0.0)
    frame = lit(make_frame(0.2, samples=4))
    kept = pictures(session, frame)
    monkeypatch.setattr(progressive, "KEPT_BYTES", 0)
    monkeypatch.setattr("drgs_blender.render.pipeline.STRIP_BYTES", 1 << 17)  # some rows a strip
    again = pictures(session, frame)
    assert len(kept) == len(again)
    for a, b in zip(kept, again):
        for name in a:
            assert a[name].tobytes() == b[name].tobytes(), name


def test_views_in_turn_do_not_show_in_each_other(session, make_frame):
    first, second = make_frame(0.0), make_frame(0.4, size=(30, 20))
    second.world.rotation = np.diag([-1.0, -1.0, 1.0])
    expected = session.render(first), session.render(second)
    session.view("A", first)
    session.view("B", second)
    states = {"A": {}, "B": {}}
    while any(s.get("view.fraction", 0) < 1 for s in states.values()):
        for name in states:
            passes = session.refine(name)
            states[name] = passes.statistics
            if passes.statistics["view.fraction"] == 1:
                assert_close(passes, expected["AB".index(name)])


def test_array_changed_by_its_owner_does_not_show(session, make_frame):
    frame = make_frame(0.2)
    expected = session.render(frame)
    session.view("A", frame)
    frame.objects[0].vertices[:] = 0
    frame.camera.matrix_world[:] = 0
    while (passes := session.refine("A")).statistics["view.fraction"] < 1:
        pass
    assert_close(passes, expected)


def test_unknown_view_cannot_be_refined(session, make_frame):
    assert session.refine("nobody") is None
    for i in range(6):
        session.view(f"view {i}", make_frame())
    assert session.refine("view 0") is None  # only the latest are kept
    assert session.refine("view 5") is not None


@pytest.mark.parametrize("size", [1, 2, 3, 8, 100])
def test_coarse_pixels_cover_the_window(make_frame, size):
    """The rays through the corners of the picture are those of the window's corners."""
    frame = make_frame(size=(47, 31))
    frame.camera.region = (3, 4, 40, 30)
    frame.camera.cx += 5
    small, big = coarse(frame, size).camera, frame.camera
    for x, y, px, py in ((0, 0, 3, 4), (small.width, small.height, 40, 30)):
        assert np.isclose((x - small.cx) / small.fx, (px - big.cx) / big.fx)
        assert np.isclose((y - small.cy) / small.fy, (py - big.cy) / big.fy)


def test_coarse_pictures_are_like_the_last(session, make_frame, monkeypatch):
    """Whatever the size of their pixels: of the detailed mesh, and of the surfels where the mesh is not."""
    frame = make_frame(0.2, size=(192, 144), samples=16)
    final = session.render(frame)["Combined"]

    def error(size):
        monkeypatch.setattr(session._pace, "size", lambda pixels: size)
        first = session.view("A", frame)["Combined"]
        assert first.shape == (144 // size, 192 // size, 4)
        return np.abs(first - final.reshape(144 // size, size, 192 // size, size, 4).mean(axis=(1, 3))).mean()

    of_mesh = {size: error(size) for size in (2, 4)}
    monkeypatch.setattr("drgs_blender.engine.level_of_detail._SURFELS_A_VERTEX", 0)
    of_surfels = {size: error(size) for size in (2, 4)}
    assert max(of_mesh.values()) < 0.1
    assert max(of_surfels.values()) < 0.1
    assert of_mesh != of_surfels


@pytest.mark.parametrize(
    ("counts", "subpixels", "steps"),
    [((16, 8, 8), 4, 8), ((2, 1, 1), 4, 4), ((6, 6, 6), 3, 3), ((512, 0, 0), 1, 32)],
)
def test_parts_draw_every_sample_once(make_frame, counts, subpixels, steps):
    settings = replace(make_frame().settings, strategy_samples=counts, subpixel_samples=subpixels)
    parts = parts_of(settings)
    assert len(parts) == len(set(parts)) == steps
    assert {sample for sample, _ in parts} == set(range(subpixels))


@pytest.mark.parametrize(("fixed", "each"), [(0.15, 1e-7), (0.01, 2e-6), (0.05, 2e-5), (0.3, 1e-8)])
def test_pace_tells_the_fixed_part_from_that_of_a_pixel(fixed, each):
    pace, window = Pace(), 640 * 360
    pace.note(window // 4, 30.0)  # kernels were compiled
    for _ in range(150):
        n = pace.size(window)
        pace.note(window // n**2, fixed + each * window / n**2)
        if n == 8:  # as a view goes on
            pace.note(window // 4, fixed + each * window / 4)
    cost = each * window / pace.size(window) ** 2
    finer = 1e9 if pace.size(window) == 1 else each * window / (pace.size(window) / 2) ** 2
    assert cost < 2 * FIRST_SECONDS or pace.size(window) == 8
    assert finer > 0.5 * FIRST_SECONDS


def test_pace_does_not_swing_between_two_sizes():
    """A history of pictures ends with their size: noise of the measured times must not change it."""
    pace, window, random = Pace(), 640 * 480, np.random.default_rng(5)
    for edge in (3, 4):
        each = FIRST_SECONDS / (window / edge**2)  # just between two sizes
        found = []
        for _ in range(300):
            found.append(pace.size(window))
            pixels = window // found[-1] ** 2
            pace.note(pixels, (0.01 + each * pixels) * random.uniform(0.95, 1.05))
        late = found[150:]
        assert sum(a != b for a, b in pairwise(late)) <= 6


# --- through the process -------------------------------------------------------------------------------------------


@pytest.fixture
def client(make_client, asset_path):
    made = make_client()
    made.load_asset(str(asset_path))
    return made


def test_process_gives_the_pictures_of_the_library(client, make_frame, session):
    frame = make_frame(0.2)
    passes = client.view("A", frame)
    sent = client.bulk_bytes[0]
    while passes.statistics["view.fraction"] < 1:
        passes = client.view("A", frame, go_on=True)
    assert client.bulk_bytes[0] == sent  # to go on, nothing is sent
    assert_close(passes, session.render(frame))


@pytest.mark.slow
@posix
def test_new_engine_begins_the_view_again(client, make_frame):
    frame = make_frame(0.2)
    client.view("A", frame)
    os.kill(client.pid, signal.SIGKILL)
    assert client.view("A", frame, go_on=True).statistics["view.fraction"] == 0.0
    assert client.view("A", frame, go_on=True).statistics["view.fraction"] > 0.0


@pytest.mark.alone
@pytest.mark.slow
def test_newer_frame_interrupts_within_tens_of_milliseconds(client, make_frame):
    """From the moment something newer is there until the engine is free, with `wake`; median of some."""
    endless = make_frame(size=(400, 300), samples=4096)
    client.view("A", endless)
    client.view("A", endless, go_on=True)
    stop, waits = threading.Event(), []
    for _ in range(7):
        stop.clear()
        moment = []

        def interrupt(moment=moment):
            moment.append(time.monotonic())
            stop.set()
            client.wake()

        timer = threading.Timer(0.25, interrupt)
        timer.start()
        with pytest.raises(Cancelled):
            while True:
                client.view("A", endless, go_on=True, cancelled=stop.is_set)
        waits.append(time.monotonic() - moment[0])
        timer.join()
    assert sorted(waits)[3] < 0.15, waits  # 20-40 ms where no other program wants the processor
    assert client.view("A", make_frame())["Combined"].shape == (36, 48, 4)


def test_cancelled_step_leaves_the_view_as_it_was(session, make_frame, monkeypatch):
    """The world behind included, of which some strips are known by then."""
    monkeypatch.setattr("drgs_blender.engine.progressive_view.STEP_SECONDS", 0.0)
    monkeypatch.setattr(progressive, "strip_height", lambda *_: 8)
    frame = lit(make_frame(0.2, samples=16, threads=1, film_transparent=False))  # it is always asked as often
    session.view("A", frame)
    before = session.refine("A").statistics["view.fraction"]
    for asked in range(1, 400):
        left = iter([False] * asked)
        with pytest.raises(Cancelled):
            session.refine("A", cancelled=lambda left=left: next(left, True))
        if session._views["A"].fraction != before:  # cancelled while the picture was developed: the part is drawn
            break
    else:
        pytest.fail("no step was ever drawn")
    while (passes := session.refine("A")).statistics["view.fraction"] < 1:
        pass
    assert_close(passes, session.render(frame))


def test_passes_of_a_view_may_be_written_into(session, make_frame, monkeypatch):
    monkeypatch.setattr("drgs_blender.engine.progressive_view.STEP_SECONDS", 0.0)
    frame = make_frame(0.2, samples=16, film_transparent=False)
    frame.passes = ("Combined", "Env")
    passes = session.view("A", frame)
    while passes.statistics["view.fraction"] < 1.0:
        for values in passes.values():
            values[:] = -1.0
        passes = session.refine("A")
    assert_close(passes, session.render(frame))
