"""Open Image Denoise as an option: what it gains where it is installed, what is said where it is not."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from drgs_blender.core.errors import Cancelled, DeviceError
from drgs_blender.core.frame import RenderSettings
from drgs_blender.render import pipeline
from drgs_blender.render.denoise.oidn import (
    EMPTY_MARGIN,
    MARGIN,
    QUALITIES,
    _without_torch,
    available,
    denoise_oidn,
    require,
)
from drgs_blender.render.film.guides import Guides

SIZE = 64
installed = pytest.mark.skipif(not available(), reason="the wheel pyoidn is not installed")


def noisy() -> tuple[np.ndarray, np.ndarray, Guides]:
    """Truth, truth with noise, guides of a painted wall that covers the left three quarters."""
    rng = np.random.default_rng(0)
    x = np.broadcast_to(np.arange(SIZE), (SIZE, SIZE))
    coverage = (x < 48).astype(np.float32)
    albedo = np.repeat((0.2 + 0.6 * (x // 8 % 2))[..., None], 3, 2).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, -1, 0]), (SIZE, SIZE, 3))
    flat = np.zeros((SIZE, SIZE), np.float32)
    truth = np.zeros((SIZE, SIZE, 4, 3), np.float32)
    truth[:, :, 0], truth[:, :, 1] = (albedo * coverage[..., None]), 0.5 * (albedo * coverage[..., None])
    light = truth * (1 + 0.3 * rng.normal(size=(SIZE, SIZE, 4, 1))).astype(np.float32)
    return truth, light, Guides(coverage, np.zeros_like(albedo), normal, albedo, flat, flat, flat, flat + 1)


@installed
def test_noise_goes_and_each_component_stays_itself() -> None:
    truth, light, guides = noisy()
    light[3, 4, 0, 1] = np.nan
    split, whole = denoise_oidn(light, guides), denoise_oidn(light, guides, split=False)
    light[3, 4, 0, 1] = 0
    for k in (0, 1):
        before, after = np.abs(light - truth)[:, :, k].mean(), np.abs(split - truth)[:, :, k].mean()
        assert after < before / 3
    assert np.abs(whole.sum(2) - truth.sum(2)).mean() < np.abs(light.sum(2) - truth.sum(2)).mean() / 3
    assert (whole[:, :, 1:] == 0).all() and np.isfinite(split).all()


@installed
def test_a_texture_of_single_pixels_stays() -> None:
    """Guides are free of noise: what they show is texture, however much it looks like noise."""
    _, _, guides = noisy()
    rng = np.random.default_rng(2)
    guides.albedo[:] = rng.uniform(0.05, 0.9, (SIZE, SIZE, 1))
    truth = (guides.albedo * guides.coverage[..., None])[:, :, None] * np.float32([1, 0, 0, 0])[:, None]
    light = truth * (1 + 0.3 * rng.normal(size=(SIZE, SIZE, 1, 1))).astype(np.float32)
    before, after = (np.abs(a - truth).mean() for a in (light, denoise_oidn(light, guides)))
    assert after < 0.6 * before


@installed
def test_it_gives_the_same_bits_again() -> None:
    _, light, guides = noisy()
    assert (denoise_oidn(light, guides, split=False) == denoise_oidn(light, guides, split=False)).all()


def test_absence_is_an_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    _, light, guides = noisy()
    assert not available()
    with pytest.raises(DeviceError, match="pip install pyoidn"):
        denoise_oidn(light, guides)


@pytest.mark.parametrize("denoiser", QUALITIES)
def test_the_pipeline_says_so_before_it_renders(monkeypatch: pytest.MonkeyPatch, denoiser: str) -> None:
    from drgs_blender.core.frame import Camera, Frame
    from drgs_blender.render.prepared_scene import PreparedScene

    monkeypatch.setitem(sys.modules, "pyoidn", None)
    camera = Camera(np.eye(4), 8, 8, 8.0, 8.0, 4.0, 4.0)
    frame = Frame(1, camera, [], settings=RenderSettings(denoise=denoiser))  # type: ignore[arg-type]
    with pytest.raises(DeviceError, match="OIDN"):
        pipeline.render(PreparedScene(None, None, None), frame)  # type: ignore[arg-type]


@installed
def test_no_light_is_put_where_nothing_is_covered() -> None:
    """It would shine in a transparent film, over whatever is laid behind."""
    _, light, guides = noisy()
    for split in (True, False):
        found = denoise_oidn(light, guides, split)
        assert found[:, 46:48].sum() > 0 and not found[guides.coverage == 0].any()


@installed
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (90, 1), (2, 3), (17, 30), (64, 64)])
def test_even_light_stays_even_up_to_the_borders(shape: tuple[int, int]) -> None:
    grey, flat = np.full((*shape, 3), 0.5, np.float32), np.zeros(shape, np.float32)
    normal = np.broadcast_to(np.float32([0, -1, 0]), (*shape, 3))
    guides = Guides(flat + 1, 0 * grey, normal, grey, flat, flat, flat, flat + 1)
    light = np.full((*shape, 4, 3), 0.25, np.float32)
    np.testing.assert_allclose(denoise_oidn(light, guides), light, rtol=0.01)


def in_the_middle() -> tuple[np.ndarray, np.ndarray, Guides]:
    """Truth, noisy light and guides of a painted disc that covers the middle of an empty picture."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:160, :200]
    coverage = (np.hypot(x - 90, y - 70) < 30).astype(np.float32)
    albedo = np.repeat((0.2 + 0.6 * (x // 8 % 2))[..., None], 3, 2).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, -1, 0]), albedo.shape)
    truth = np.zeros((*coverage.shape, 4, 3), np.float32)
    truth[:, :, 0] = albedo * coverage[..., None]
    light = truth * (1 + 0.3 * rng.normal(size=(*coverage.shape, 1, 1))).astype(np.float32)
    return truth, light, Guides(coverage, 0 * albedo, normal, albedo, *([0 * coverage] * 3), coverage)


def sizes_of_images(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """A list to which the size of every picture goes that the network gets from now on."""
    found, own = [], require().Filter.set_image

    def set_image(self: object, name: str, image: np.ndarray, *more: int) -> None:
        found.append(image.shape[:2])
        own(self, name, image, *more)

    monkeypatch.setattr(require().Filter, "set_image", set_image)
    return found


@installed
def test_the_rectangle_of_what_is_covered_is_filtered_alone_and_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, light, guides = in_the_middle()
    cover = guides.coverage[..., None]
    whole = require().denoise(
        light.sum(2), guides.albedo * cover, np.ascontiguousarray(guides.normal * cover), hdr=True, clean_aux=True
    )
    sizes = sizes_of_images(monkeypatch)
    part = denoise_oidn(light, guides, split=False)[:, :, 0]
    side = 59 + 2 * EMPTY_MARGIN
    assert set(sizes) == {(side, side)}
    seen = guides.coverage > 0
    left, of_whole = (np.abs(picture - truth[:, :, 0])[seen].mean() for picture in (part, whole))
    assert left < 1.05 * of_whole and left < 0.3 * np.abs(light - truth).sum(2)[seen].mean()
    assert np.abs(part - whole)[seen].mean() < 0.5 * of_whole


@installed
def test_where_the_picture_cuts_the_object_off_it_is_mirrored(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = sizes_of_images(monkeypatch)
    _, light, guides = noisy()
    denoise_oidn(light, guides, split=False)
    assert set(sizes) == {(MARGIN + SIZE + MARGIN, MARGIN + 48 + EMPTY_MARGIN)}


@installed
def test_an_empty_picture_stays_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = sizes_of_images(monkeypatch)
    _, light, guides = noisy()
    guides.coverage[:] = 0
    assert not denoise_oidn(light, guides).any() and not sizes


@installed
def test_balanced_is_another_network_that_takes_noise_away() -> None:
    truth, light, guides = noisy()
    high, balanced = (denoise_oidn(light, guides, split=False, denoiser=name).sum(2) for name in QUALITIES)
    before, after = (np.abs(picture - truth.sum(2)).mean() for picture in (light.sum(2), balanced))
    assert after < before / 3 and (high != balanced).any()


def test_the_settings_know_every_network_and_the_pipeline_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(QUALITIES) < set(get_args(get_type_hints(RenderSettings)["denoise"]))
    monkeypatch.setattr(pipeline, "denoise_oidn", lambda *given: given[-2:])
    pixels = SimpleNamespace(components=None, catcher=None)
    film = SimpleNamespace(pixels=pixels, guides=lambda: None, catchers=SimpleNamespace(variance=None))
    for name in QUALITIES:
        frame = SimpleNamespace(settings=RenderSettings(denoise=name, threads=3), passes=())  # type: ignore[arg-type]
        assert pipeline.denoised(film, frame, lambda: None) == (name, 3)  # type: ignore[arg-type, comparison-overlap]


@installed
def test_it_has_the_threads_of_the_settings_and_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    _, light, guides = noisy()
    whole, found, commit = denoise_oidn(light, guides, split=False), [], require().Device.commit

    def committed(device: Any) -> None:
        commit(device)
        found.append(device.get_int("numThreads"))

    monkeypatch.setattr(require().Device, "commit", committed)
    assert (denoise_oidn(light, guides, split=False, threads=1) == whole).all() and found == [1]


@installed
@pytest.mark.parametrize("stopped", [False, True])
def test_nothing_of_it_is_kept(monkeypatch: pytest.MonkeyPatch, stopped: bool) -> None:
    """pyoidn's own function keeps the network's memory, .7 GB for a square of 1024 pixels, until the program ends."""
    pyoidn, there = require(), []
    for kind in (pyoidn.Device, pyoidn.Filter):
        begin, end = kind.__init__, kind.release

        def made(self: object, *given: object, begin: object = begin) -> None:
            there.append(self)
            begin(self, *given)  # type: ignore[operator]

        def released(self: object, end: object = end) -> None:
            there.remove(self)
            end(self)  # type: ignore[operator]

        monkeypatch.setattr(kind, "__init__", made)
        monkeypatch.setattr(kind, "release", released)
    counts = []

    def check() -> None:
        counts.append(len(there))
        if stopped:
            raise Cancelled

    _, light, guides = noisy()
    if stopped:
        with pytest.raises(Cancelled):
            denoise_oidn(light, guides, check=check)
    else:
        denoise_oidn(light, guides, check=check)
    assert counts == [2] * (1 if stopped else 4) and not there


@installed
def test_what_the_network_says_is_an_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(require().Device, "get_error", lambda self: "out of memory")
    _, light, guides = noisy()
    with pytest.raises(DeviceError, match=r"out of memory.*Choose SVGF"):
        denoise_oidn(light, guides)


@installed
@pytest.mark.parametrize("fault", [lambda: False, lambda: (_ for _ in ()).throw(OSError("no such library"))])
def test_libraries_that_do_not_work_are_named_before_the_work(monkeypatch: pytest.MonkeyPatch, fault: object) -> None:
    monkeypatch.setattr(require().Device, "is_cpu_available", fault)
    assert not available()
    with pytest.raises(DeviceError, match=r"(processor|no such library).*choose SVGF"):
        require()


@installed
@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
def test_torch_is_not_loaded_for_it_and_can_be_later() -> None:
    program = (
        "import importlib.util, sys; from drgs_blender.render.denoise.oidn import require; require();"
        "print('torch' in sys.modules, importlib.util.find_spec('torch') is not None)"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert run.stdout.split() == ["False", "True"]


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
def test_torch_is_hidden_from_one_thread_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    before = list(sys.meta_path)
    with ThreadPoolExecutor(1) as other, _without_torch():
        assert other.submit(importlib.util.find_spec, "torch").result() is not None
        with pytest.raises(ModuleNotFoundError):
            importlib.util.find_spec("torch")
    assert sys.meta_path == before and importlib.util.find_spec("torch") is not None
