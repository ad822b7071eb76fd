"""The denoiser: what it must leave alone, what it must remove, how much it gains."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from drgs_blender.compute.threads import use_threads
from drgs_blender.core import memory
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.render import pipeline
from drgs_blender.render.denoise.demodulation import CERTAINTY, LEVELS, LIGHT, demodulate
from drgs_blender.render.denoise.svgf_spatial import (
    FEW_TAPS,
    TAPS,
    _a_trous,
    _clamp_fireflies,
    _weigh,
    denoise,
    prepare,
    sigma_of,
    smooth,
)
from drgs_blender.render.film.film import Film
from drgs_blender.render.film.guides import Guides
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene

H, W = 40, 56


def wall(**changes: object) -> Guides:
    """A wall that faces the camera, a millimetre a pixel."""
    x, z = np.meshgrid(np.arange(W) * 1e-3, np.arange(H) * 1e-3)
    arrays: dict[str, np.ndarray] = {
        "coverage": np.ones((H, W)),
        "position": np.stack([x, np.zeros((H, W)), z], -1),
        "normal": np.broadcast_to([0.0, -1.0, 0.0], (H, W, 3)),
        "albedo": np.full((H, W, 3), 0.5),
        "roughness": np.full((H, W), 0.5),
        "metallic": np.zeros((H, W)),
        "object": np.zeros((H, W)),
        "footprint": np.full((H, W), 1e-3),
    }
    arrays |= changes  # type: ignore[arg-type]
    return Guides(**{k: np.array(v, np.float32) for k, v in arrays.items()})


def light_of(
    diffuse: np.ndarray, guides: Guides, noise: float | np.ndarray = 0.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Components and variance of irradiance (h, w) on the guides' surfaces, relative noise of the given deviation."""
    rng = np.random.default_rng(seed)
    value = diffuse * (1 + noise * rng.normal(size=(H, W)))
    shaded = value[..., None] * guides.albedo * guides.coverage[..., None]
    components = np.zeros((H, W, 4, 3), np.float32)
    components[:, :, 0], components[:, :, 1] = 0.75 * shaded, 0.25 * shaded
    components[:, :, 2] = 0.04 * value[..., None] * guides.coverage[..., None]
    variance = np.zeros((H, W, 2), np.float32)
    luminance = guides.albedo @ np.float32([0.2126, 0.7152, 0.0722])
    variance[..., 0] = (noise * diffuse * luminance * guides.coverage) ** 2
    variance[..., 1] = (noise * diffuse * 0.04 * guides.coverage) ** 2
    return components, variance


@pytest.mark.parametrize("split", [True, False])
def test_constants_stay_to_rounding(split: bool) -> None:
    rng = np.random.default_rng(1)
    guides = wall(albedo=rng.uniform(0.05, 1, (H, W, 3)), coverage=(rng.random((H, W)) < 0.9) * rng.random((H, W)))
    components, variance = light_of(np.full((H, W), 3.0), guides)
    for doubt in (0.0, 1.0):  # whether or not the variance invites blurring
        out = denoise(components, variance + np.float32(doubt), guides, split)
        expected = components.copy()
        if not split:
            expected[:, :, 0::2] += expected[:, :, 1::2]
            expected[:, :, 1::2] = 0
        assert np.allclose(out, expected, rtol=2e-5, atol=1e-7)


def tall(times: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, Guides]:
    """Light and guides of a picture of several walls one above the other, with pixels that nothing covers."""
    rng = np.random.default_rng(3)
    walls = [wall(coverage=(rng.random((H, W)) < 0.9) * rng.random((H, W))) for _ in range(times)]
    light = [light_of(np.full((H, W), 1.0 + i), each, noise, seed=i) for i, each in enumerate(walls)]
    components, variance = (np.concatenate(parts) for parts in zip(*light))
    guides = Guides(*(np.concatenate(parts) for parts in zip(*walls)))
    return components, variance, guides


def test_it_takes_the_memory_of_the_light_and_of_the_guide_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_LARGE", 1 << 60)  # NumPy's own arrays, which are counted
    given = tall(40)
    denoise(*given)  # compiles
    use_threads(1)
    try:
        signal = demodulate(*given)
        needed = signal.guide.nbytes + signal.light.nbytes
        tracemalloc.start()
        denoise(*given)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    finally:
        use_threads(0)
    assert peak < 1.3 * needed


@pytest.mark.parametrize(("levels", "taps"), [(LEVELS, TAPS), (3, FEW_TAPS)])
def test_bands_do_not_change_a_bit(levels: int, taps: np.ndarray) -> None:
    """As of whole pictures, one made of the other."""
    given = tall(9, noise=0.5)
    signal, found = demodulate(*given), prepare(*given)
    assert len(signal.light) > 3 * 96, "bands of the first levels are as high"
    whole = np.zeros_like(signal.light)
    _clamp_fireflies(0, len(whole), signal.guide, signal.spans, signal.light, whole)
    assert (whole != signal.light).any(), "no fireflies"
    np.testing.assert_array_equal(found.light, whole)
    found = smooth(found, levels=levels, taps=taps)
    for level in range(levels):
        out = np.zeros_like(whole)
        _weigh(0, len(whole), sigma_of(level), signal.guide, signal.spans, whole)
        _a_trous(0, len(whole), 1 << level, taps, signal.guide, signal.spans, whole, out)
        whole = out
    known = [*range(CERTAINTY), *range(LIGHT, whole.shape[1])]
    np.testing.assert_array_equal(found.light[:, known], whole[:, known])


def test_what_is_smoothed_stays_unless_it_may_be_overwritten() -> None:
    signal = prepare(*light_of(np.full((H, W), 2.0), wall(), noise=0.3), wall())
    before = signal.light.copy()
    out = smooth(signal).light
    np.testing.assert_array_equal(signal.light, before)
    assert smooth(signal, overwrite=True).light is signal.light
    np.testing.assert_array_equal(signal.light[:, LIGHT:], out[:, LIGHT:])


def test_noise_goes_and_energy_stays() -> None:
    guides = wall()
    truth, _ = light_of(np.full((H, W), 2.0), guides)
    components, variance = light_of(np.full((H, W), 2.0), guides, noise=0.3)
    out = denoise(components, variance, guides)
    before, after = np.abs(components - truth)[:, :, 0].mean(), np.abs(out - truth)[:, :, 0].mean()
    assert after < before / 4  # as sixteen times the rays would
    assert abs(out.sum() / truth.sum() - 1) < 0.01


@pytest.mark.parametrize("kind", ["texture", "object", "normal", "depth"])
def test_edges_stay_sharp(kind: str) -> None:
    left = np.arange(W)[None, :, None] < W // 2
    changes: dict[str, object] = {}
    diffuse = np.full((H, W), 1.0)
    if kind == "texture":
        changes["albedo"] = np.broadcast_to(np.where(left, 0.1, 0.9), (H, W, 3))
    else:
        diffuse = np.broadcast_to(np.where(left[..., 0], 0.5, 2.0), (H, W))
    if kind == "object":
        changes["object"] = np.broadcast_to(left[..., 0], (H, W))
    if kind == "normal":
        changes["normal"] = np.broadcast_to(np.where(left, [0, -1.0, 0], [-0.8, -0.6, 0]), (H, W, 3))
    if kind == "depth":
        position = wall().position
        position[:, W // 2 :, 1] += 0.05
        changes["position"] = position
    guides = wall(**changes)
    truth, _ = light_of(diffuse, guides)
    components, variance = light_of(diffuse, guides, noise=0.2)
    out = denoise(components, variance, guides)[:, :, 0, 0]
    for side in (W // 2 - 1, W // 2):
        assert abs(out[:, side].mean() / truth[:, side, 0, 0].mean() - 1) < 0.03, side


@pytest.mark.parametrize(("roughness", "glossy_mixes"), [(0.0, False), (1.0, True)])
def test_small_bumps_part_light_of_smooth_surfaces_alone(roughness: float, glossy_mixes: bool) -> None:
    """Columns turned 12 degrees against each other: what reflects as diffusely as that hardly shows it."""
    odd = (np.arange(W) % 2 == 1)[None, :, None]
    turn = np.radians(6)
    normal = np.where(odd, [np.sin(turn), -np.cos(turn), 0], [-np.sin(turn), -np.cos(turn), 0])
    guides = wall(normal=np.broadcast_to(normal, (H, W, 3)), roughness=np.full((H, W), roughness))
    components, _ = light_of(np.broadcast_to(np.where(odd[..., 0], 2.0, 1.0), (H, W)), guides)
    out = denoise(components, np.ones((H, W, 2), np.float32), guides)  # as if all of it were noise
    for lobe, mixes in ((0, True), (2, glossy_mixes)):
        before, after = (a[:, 1::2, lobe].mean() / a[:, ::2, lobe].mean() for a in (components, out))
        assert before == pytest.approx(2.0)
        assert after < 1.5 if mixes else after > 1.85, lobe


def test_light_that_a_dark_colour_does_not_explain_stays_where_it_is() -> None:
    """A nearly black line with a speck of light in it, as on an edge: divided by its colour it would be a firefly."""
    albedo = np.full((H, W, 3), 0.5)
    albedo[:, W // 2] = 1e-4
    guides = wall(albedo=albedo)
    components, _ = light_of(np.full((H, W), 1.0), guides)
    components[:, W // 2, 0] = 0.03
    out = denoise(components, np.full((H, W, 2), 1.0, np.float32), guides)[:, :, 0]
    beside = np.abs(np.arange(W) - W // 2) > 0
    np.testing.assert_allclose(out[:, beside], components[:, beside, 0], rtol=0.3)


def test_a_slanted_plane_is_one_surface() -> None:
    """Depth changes by ten pixel widths a pixel there; a test on depth alone would not blur at all."""
    position = wall().position
    position[..., 1] = 10 * position[..., 0]
    normal = np.broadcast_to(np.array([10, -1, 0]) / np.sqrt(101), (H, W, 3))
    guides = wall(position=position, normal=normal)
    truth, _ = light_of(np.full((H, W), 2.0), guides)
    components, variance = light_of(np.full((H, W), 2.0), guides, noise=0.3)
    slanted, flat = (np.abs(denoise(components, variance, g) - truth).mean() for g in (guides, wall()))
    assert slanted < 1.1 * flat


def test_silhouettes_do_not_bleed() -> None:
    coverage = np.zeros((H, W))
    coverage[:, : W // 2] = 1.0
    coverage[:, W // 2] = 0.3
    guides = wall(coverage=coverage)
    truth, _ = light_of(np.full((H, W), 2.0), guides)
    components, variance = light_of(np.full((H, W), 2.0), guides, noise=0.2)
    out = denoise(components, variance, guides)
    assert (out[:, W // 2 + 1 :] == 0).all()
    assert abs(out[:, W // 2, 0].mean() / truth[:, W // 2, 0].mean() - 1) < 0.02


def test_fireflies_are_clamped_but_sure_highlights_stay() -> None:
    guides = wall()
    components, variance = light_of(np.full((H, W), 1.0), guides, noise=0.05)
    components[20, 20, 0] *= 1000
    variance[20, 20, 0] = 500.0**2
    out = denoise(components, variance, guides)
    assert out[15:26, 15:26, 0].max() < 1.5 * 0.375
    components[20, 20, 0] /= 100
    variance[20, 20, 0] = 0.001**2  # ten times its neighbours, and certain of it
    out = denoise(components, variance * np.float32(1e-4), guides)
    assert out[20, 20, 0, 0] > 0.8 * components[20, 20, 0, 0]


def test_numbers_that_are_none_do_not_spread() -> None:
    guides = wall()
    components, variance = light_of(np.full((H, W), 1.0), guides, noise=0.1)
    components[5, 5, 0, 1] = np.nan
    components[9, 30, 2] = np.inf
    variance[30, 9, 1] = np.nan
    out = denoise(components, variance, guides)
    assert np.isfinite(out).all()
    for y, x in ((5, 5), (9, 30), (30, 9)):
        assert abs(out[y, x, 0, 0] / 0.375 - 1) < 0.2


def test_nothing_seen() -> None:
    guides = wall(coverage=np.zeros((H, W)))
    out = denoise(np.zeros((H, W, 4, 3), np.float32), np.zeros((H, W, 2), np.float32), guides)
    assert (out == 0).all()


def test_the_caller_can_stop_it() -> None:
    guides = wall()
    components, variance = light_of(np.full((H, W), 1.0), guides)

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        denoise(components, variance, guides, check=stop)


def scene() -> TraceScene:
    """A checkered ball on a floor."""
    import trimesh

    ball = trimesh.creation.icosphere(4)
    vertices = np.asarray(ball.vertices, np.float32)
    checks = (np.floor(4 * vertices).astype(int).sum(1) % 2)[:, None]
    floor = np.float32([[-6, -6, -1], [6, -6, -1], [6, 6, -1], [-6, 6, -1]])
    out = TraceScene()
    out.update(
        [
            TraceObject(
                "ball", vertices, np.asarray(ball.faces), np.float32([0.8, 0.5, 0.3]) * (0.4 + 0.6 * checks),
                np.full(len(vertices), 0.35), np.zeros(len(vertices)), pass_index=1,
            ),
            TraceObject(
                "floor", floor, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.6), np.full(4, 0.5), np.zeros(4),
                pass_index=2,
            ),
        ]
    )  # fmt: skip
    return out


def exposed(monkeypatch: pytest.MonkeyPatch, rays: int, seed: int) -> Film:
    """The film after rendering `scene` under a bright patch of sky."""
    matrix = np.eye(4)
    angle = np.radians(70)
    matrix[:3, :3] = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = matrix[:3, 2] * 5
    sky = np.full((16, 32, 3), 0.2, np.float32)
    sky[3:6, 4:8] = 12.0
    films: list[Film] = []

    class Kept(Film):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)  # type: ignore[arg-type]
            films.append(self)

    monkeypatch.setattr(pipeline, "Film", Kept)
    frame = Frame(
        1,
        Camera(matrix, 96, 80, 110.0, 110.0, 48.0, 40.0),
        [ObjectState("ball", "a"), ObjectState("floor", "a")],
        settings=RenderSettings(
            strategy_samples=(rays // 2, rays // 4, rays // 4), subpixel_samples=4, camera_sees="mesh", seed=seed
        ),
    )
    pipeline.render(PreparedScene(scene(), EnvironmentLight(World(environment=sky)), None), frame)  # type: ignore[arg-type]
    return films[0]


@pytest.mark.slow
def test_gain_at_32_rays_against_the_converged_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = exposed(monkeypatch, 2048, seed=5).pixels.components.sum(2)
    film = exposed(monkeypatch, 32, seed=1)

    def psnr(light: np.ndarray) -> float:
        tone = [np.clip(a, 0, 1) ** (1 / 2.2) for a in (light.sum(2), truth)]
        return float(-10 * np.log10(np.mean((tone[0] - tone[1]) ** 2)))

    gain = psnr(denoise(film.pixels.components, film.pixels.variance, film.guides())) - psnr(film.pixels.components)
    assert gain > 2.0, gain


def test_the_order_of_axes_compiles_nothing_anew(compiled):
    """A kernel of Numba's takes seconds for each order of the axes of what it is given."""
    for turned in (False, True):
        shape = (8, 9, 3)
        values = np.random.default_rng(3).random(shape).astype(np.float32)
        if turned:
            values = np.asfortranarray(values)
        flat = np.ascontiguousarray(values[..., 0])
        guides = Guides(flat, values, values, values, flat, flat, flat, flat)
        compiled.clear()
        demodulate(np.ones((8, 9, 4, 3), np.float32), np.ones((8, 9, 2), np.float32), guides)
    assert "_demodulate" not in compiled
