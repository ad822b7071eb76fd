"""The whole way from surfels to passes: independence of strips and batches, cancelling, odd scenes, refusals."""

from __future__ import annotations

import ctypes
import os
import sys
import time
import weakref

import numpy as np
import pytest
from shapes import look_along_y, scene_of, sphere_mesh, sphere_surfels

from drgs_blender.core import memory
from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.core.passes import BY_NAME
from drgs_blender.render import pipeline
from drgs_blender.render.film.cryptomatte import CryptoFilm
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceScene

ALL = tuple(BY_NAME)


def frame(camera: Camera, passes: tuple[str, ...] = ALL, objects: int = 1, **settings: object) -> Frame:
    defaults: dict[str, object] = {"subpixel_samples": 2, "samples": 8}
    states = [ObjectState(f"object {i}", "key") for i in range(objects)]
    return Frame(3, camera, states, settings=RenderSettings(**(defaults | settings)), passes=passes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def ball() -> tuple[TraceScene, PosedSurfels, EnvironmentLight]:
    rng = np.random.default_rng(0)
    world = World(environment=rng.random((8, 16, 3)).astype(np.float32))
    return scene_of(sphere_mesh(3)), sphere_surfels(1.0, 3000), EnvironmentLight(world)


@pytest.mark.parametrize("camera_sees", ["surfels", "mesh"])
def test_strips_and_batches_do_not_change_a_bit(
    ball: tuple[TraceScene, PosedSurfels, EnvironmentLight], monkeypatch: pytest.MonkeyPatch, camera_sees: str
) -> None:
    scene, posed, light = ball
    this = frame(look_along_y(52), camera_sees=camera_sees, denoise="svgf", threads=1)
    whole = pipeline.render(PreparedScene(scene, light, posed), this)
    for height, batch in ((1, 400), (7, 3333), (52, 10**7)):
        monkeypatch.setattr(pipeline, "strip_height", lambda width, subpixels, h=height: h)
        monkeypatch.setattr(pipeline, "FIRST_SAMPLES", batch)
        monkeypatch.setattr(pipeline, "BATCH_SECONDS", 1e-9)  # batches shrink as fast as they can
        again = pipeline.render(PreparedScene(scene, light, posed), this)
        for name in ALL:
            assert np.array_equal(again[name], whole[name]), (height, name)


def pages(array: np.ndarray) -> int:
    """Bytes of a mapped array that were written or read."""
    size, library = os.sysconf("SC_PAGE_SIZE"), ctypes.CDLL(None)
    there = np.zeros(-(-array.nbytes // size), np.uint8)
    given = ctypes.c_void_p(array.ctypes.data), ctypes.c_size_t(array.nbytes), ctypes.c_void_p(there.ctypes.data)
    assert library.mincore(*given) == 0
    return int((there & 1).sum()) * size


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux which pages are there")
def test_pixels_that_show_nothing_take_no_memory(
    ball: tuple[TraceScene, PosedSurfels, EnvironmentLight], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ball that fills a tenth of a picture's height, and passes of it large enough to have pages of their own."""
    scene, posed, light = ball
    this = frame(look_along_y(192, focal=30.0), camera_sees="surfels", denoise="svgf")
    monkeypatch.setattr(pipeline, "strip_height", lambda width, subpixels: 4)
    monkeypatch.setattr(memory, "_LARGE", 1 << 60)
    expected = pipeline.render(PreparedScene(scene, light, posed), this)
    monkeypatch.setattr(memory, "_LARGE", 1 << 14)
    found = pipeline.render(PreparedScene(scene, light, posed), this)
    seen = np.flatnonzero(expected["Coverage"].any(axis=(1, 2)))
    rows = (seen[-1] - seen[0] + 1) / 192
    assert rows < 0.15
    for name in ("Normal", "Albedo", "Variance", "UV", "CryptoObject00"):
        assert 0 < pages(found[name]) <= rows * found[name].nbytes + (1 << 15), name
    assert 0 < pages(found["DiffDir"]) < found["DiffDir"].nbytes / 2  # made in bands of rows
    for name in ("TransDir", "CryptoObject01", "CryptoMaterial02"):
        assert pages(found[name]) == 0, name
    for name in ALL:
        assert found[name].tobytes() == expected[name].tobytes(), name


def test_what_strips_take_is_given_back_before_light_is_denoised(
    ball: tuple[TraceScene, PosedSurfels, EnvironmentLight], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, posed, light = ball
    made: list[weakref.ref[pipeline.VisibleSurfaces]] = []
    denoised, kept = pipeline.denoised, []

    class Watched(pipeline.VisibleSurfaces):
        def __init__(self, *given: object) -> None:
            super().__init__(*given)  # type: ignore[arg-type]
            made.append(weakref.ref(self))

    monkeypatch.setattr(pipeline, "VisibleSurfaces", Watched)
    monkeypatch.setattr(pipeline, "denoised", lambda *given: (kept.append(made[0]()), denoised(*given))[1])
    pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(16), denoise="svgf"))
    assert len(made) == 1 and kept == [None]


def test_passes_of_cryptomatte_are_written_once(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    film = CryptoFilm("object", ball[0], frame(look_along_y(16)))
    passes = film.passes()
    assert all(np.shares_memory(pixels, passes[name]) for name, pixels in film.passes().items())


@pytest.mark.alone
def test_threads_do_not_change_a_bit(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, light = ball
    one = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(40), denoise="svgf", threads=1))
    all_of_them = pipeline.render(
        PreparedScene(scene, light, posed), frame(look_along_y(40), denoise="svgf", threads=0)
    )
    assert all(np.array_equal(one[n], all_of_them[n]) for n in ALL)


def test_a_region_is_a_crop(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, light = ball
    whole = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(48)))
    part = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(48, region=(11, 5, 40, 31))))
    for name in ALL:
        assert part[name].shape[:2] == (26, 29)
        assert np.array_equal(part[name], whole[name][5:31, 11:40]), name


def test_surfels_and_mesh_of_one_ball_look_alike(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, _, light = ball
    settings = {"samples": 128, "film_transparent": True}
    camera = look_along_y(48)
    a = pipeline.render(
        PreparedScene(scene, light, sphere_surfels(1.0, 30000)), frame(camera, camera_sees="surfels", **settings)
    )
    b = pipeline.render(
        PreparedScene(scene, light, sphere_surfels(1.0, 10)), frame(camera, camera_sees="mesh", **settings)
    )
    inside = b["Coverage"][..., 0] == 1
    inside[1:-1, 1:-1] &= inside[2:, 1:-1] & inside[:-2, 1:-1] & inside[1:-1, 2:] & inside[1:-1, :-2]
    difference = np.abs(a["Combined"] - b["Combined"])[inside]
    assert difference.mean() < 0.01 and b["Combined"][inside].mean() > 0.2
    # Surfels smaller than a pixel are seen through the low-pass, nearest first: up to a pixel (0.043 m) on a slope.
    facing = inside & (b["Normal"][..., 1] < -0.8)
    assert np.abs(a["Depth"] - b["Depth"])[facing].max() < 0.06


@pytest.mark.parametrize("camera_sees", ["surfels", "mesh"])
@pytest.mark.parametrize("denoise", ["none", "svgf"])
def test_an_empty_scene_is_the_world(camera_sees: str, denoise: str) -> None:
    nothing = PosedSurfels(
        *(np.empty((0, 3), np.float32) for _ in range(4)), np.empty(0, np.float32), np.empty((0, 3), np.float32),
        *(np.empty(0, np.float32) for _ in range(2)), np.empty(0, np.int32),
    )  # fmt: skip
    light = EnvironmentLight(World(colour=(0.25, 0.5, 1.0)))
    this = frame(look_along_y(8), objects=0, camera_sees=camera_sees, denoise=denoise)
    passes = pipeline.render(PreparedScene(scene_of(), light, nothing), this)
    assert np.allclose(passes["Combined"], (0.25, 0.5, 1.0, 1.0))
    assert (passes["Depth"] == 1e10).all() and (passes["Coverage"] == 0).all()


def test_a_black_world_is_black(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, _ = ball
    light = EnvironmentLight(World(strength=0.0))
    passes = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(16), denoise="svgf"))
    assert (passes["Combined"][..., :3] == 0).all() and (passes["Combined"][..., 3] == 1).all()


def test_only_the_passes_asked_for_come_back(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, light = ball
    passes = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(16), ("Normal", "Combined")))
    assert list(passes) == ["Normal", "Combined"]


def test_the_sum_of_denoised_passes_is_combined(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, light = ball
    p = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(40), denoise="svgf"))
    total = (p["DiffDir"] + p["DiffInd"]) * p["DiffCol"] + (p["GlossDir"] + p["GlossInd"]) * p["GlossCol"] + p["Env"]
    assert np.allclose(p["Combined"][..., :3], total, rtol=1e-6, atol=1e-7)
    assert np.abs(p["Combined"] - p["Noisy Image"]).mean() > 1e-4
    fast = pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(40), ("Combined",), denoise="svgf"))
    assert np.allclose(fast["Combined"], p["Combined"], atol=1e-5)


def test_progress_rises_to_one(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, light = ball
    told: list[tuple[float, str]] = []
    pipeline.render(
        PreparedScene(scene, light, posed),
        frame(look_along_y(32), denoise="svgf"),
        lambda part, phase: told.append((part, phase)),
    )
    parts = [part for part, _ in told]
    assert parts == sorted(parts) and parts[0] == 0 and parts[-1] == 1
    assert {phase for _, phase in told} == {"Projecting", "Rendering", "Denoising", "Done"}


def test_cancel_is_seen_soon(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    """The time between two questions stays short even when a whole strip would take many seconds."""
    scene, posed, light = ball
    this = frame(look_along_y(200, focal=300.0), subpixel_samples=4, samples=8192)
    pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(16)))  # compile
    asked: list[float] = [time.process_time()]

    def cancelled() -> bool:
        asked.append(time.process_time())
        return asked[-1] - asked[0] > 1.0

    with pytest.raises(Cancelled):
        pipeline.render(PreparedScene(scene, light, posed), this, cancelled=cancelled)
    assert len(asked) > 4
    # CPU time of both threads, so that a busy machine does not matter.
    assert max(np.diff(asked)) < 0.8


def test_cancel_at_once(ball: tuple[TraceScene, PosedSurfels, EnvironmentLight]) -> None:
    scene, posed, light = ball
    with pytest.raises(Cancelled):
        pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(16)), cancelled=lambda: True)


@pytest.mark.parametrize(
    ("settings", "passes", "message"),
    [
        ({"subpixel_samples": -1}, ALL, "sub-pixel"),
        ({"camera_sees": "voxels"}, ALL, "voxels"),
        ({"denoise": "blur"}, ALL, "oidn"),
        ({}, ("Combined", "Shadow"), "Shadow"),
    ],
)
def test_refusals(
    ball: tuple[TraceScene, PosedSurfels, EnvironmentLight],
    settings: dict[str, object],
    passes: tuple[str, ...],
    message: str,
) -> None:
    scene, posed, light = ball
    with pytest.raises(UsageError, match=message):
        pipeline.render(PreparedScene(scene, light, posed), frame(look_along_y(8), passes, **settings))
