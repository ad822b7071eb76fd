"""The path tracer: analytic values, strategies that agree, pictures that do not depend on how they are computed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.color import LUMINANCE
from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import Light, RenderSettings, World
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.integrator.records import Sampler
from drgs_blender.render.integrator.sample_allocation import ALPHA, COUNTS, POINT_STATE, _allocate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.shading_points import DIFFUSE_DIRECT, DIFFUSE_INDIRECT, GLOSSY_DIRECT, Radiance, ShadingPoints

WHITE = EnvironmentLight(World())


def settings(
    cosine: int = 0, ggx: int = 0, environment: int = 0, *, auto: bool = False, **changes: object
) -> RenderSettings:
    """As many samples of each strategy, or (`auto`) as many in all."""
    counts = None if auto else (cosine, ggx, environment)
    plain = RenderSettings(cosine + ggx + environment, counts, 0, subpixel_samples=1, shading_model="paper")
    return replace(plain, **changes)  # type: ignore[arg-type]


def points(
    count: int,
    *,
    origin: tuple = (0, 0, 0),
    normal: tuple = (0, 0, 1),
    mu: float = 0.7,
    albedo: float = 1.0,
    roughness: float = 0.5,
    metallic: float = 0.0,
    **changes: object,
) -> ShadingPoints:
    """`count` pixels that see the same point of a plane under the cosine `mu`."""
    row = lambda *v: np.tile(np.float32(v), (count, 1))  # noqa: E731
    n = np.asarray(normal, float)
    tangent = np.cross(n, [0.3, 0.5, 0.8])
    view = mu * n + np.sqrt(1 - mu * mu) * tangent / np.linalg.norm(tangent)
    result = ShadingPoints(
        np.arange(count), np.zeros(count), np.ones(count), row(*origin), row(*n), row(*n), row(*view),
        row(albedo, albedo, albedo), np.full(count, roughness), np.full(count, metallic),
    )  # fmt: skip
    return replace(result, **changes)  # type: ignore[arg-type]


def scene_of(
    *meshes: tuple[np.ndarray, np.ndarray], albedo: float = 0.8, roughness: float = 0.6, metallic: float = 0.0
):
    scene = TraceScene()
    items = []
    for vertices, faces in meshes:
        n = len(vertices)
        shades = np.full((n, 3), albedo, np.float32), np.full(n, roughness), np.full(n, metallic)
        items.append(TraceObject("thing", np.asarray(vertices, np.float32), np.asarray(faces, np.int32), *shades))
    scene.update(items)
    return scene


def sun_picture() -> np.ndarray:
    image = np.random.default_rng(2).random((16, 32, 3)).astype(np.float32)
    image[3, 5] = 60.0
    return image


def luminance(radiance: Radiance) -> np.ndarray:
    return radiance.total @ LUMINANCE


EMPTY = TraceScene()


# --- a single surface under constant light -------------------------------------------------------------------------


def test_white_furnace_of_the_diffuse_lobe_is_exact() -> None:
    result = integrate(EMPTY, WHITE, points(200), settings(cosine=16), 0)
    np.testing.assert_allclose(result.components[:, DIFFUSE_DIRECT], 1.0, atol=1e-4)
    np.testing.assert_array_equal(result.components[:, DIFFUSE_INDIRECT], 0.0)


@pytest.mark.parametrize("shading_model", ["paper", "principled"])
def test_metals_have_no_diffuse_light_to_the_rounding_of_interpolation(shading_model: str) -> None:
    for metallic in np.nextafter(np.float32(1), np.float32([0, 1, 2])):
        result = integrate(
            EMPTY, WHITE, points(20, metallic=metallic), settings(8, 8, 8, shading_model=shading_model), 0
        )
        assert not result.components[:, :2].any() and result.components[:, 2].min() > 0


def directional_albedo(mu: float, roughness: float, metallic: float, shading_model: str) -> float:
    """The glossy lobe's share of reflected light for base colour 1, by quadrature over half vectors in float64."""
    alpha = max(roughness**2, 1e-3)
    view = np.array([np.sqrt(1 - mu * mu), 0, mu])
    # Uniform in GGX's own distribution of half vectors: the integrand is smooth for any alpha.
    s = (np.arange(2000) + 0.5) / 2000
    tan2 = alpha**2 * s / (1 - s)
    cos = 1 / np.sqrt(1 + tan2)
    phi = 2 * np.pi * (np.arange(720) + 0.5) / 720
    cos, phi = (a.ravel() for a in np.meshgrid(cos, phi, indexing="ij"))
    sin = np.sqrt(1 - cos * cos)
    h = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=1)
    vh = h @ view
    nl = 2 * vh * cos - mu
    ok = (vh > 0) & (nl > 0)
    vh, nl, cos = vh[ok], nl[ok], cos[ok]
    smith = lambda c: 0.5 * (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1)  # noqa: E731
    g = 1 / (1 + smith(mu) + smith(nl))
    schlick = (1 - vh) ** 5
    if shading_model == "paper":
        f0 = 0.04 * (1 - metallic) + metallic
        fresnel = f0 + (1 - f0) * schlick
    else:
        ct = np.sqrt(1 - (1 - vh**2) / 2.25)
        parallel, perpendicular = (1.5 * vh - ct) / (1.5 * vh + ct), (vh - 1.5 * ct) / (vh + 1.5 * ct)
        fresnel = (1 - metallic) * 0.5 * (parallel**2 + perpendicular**2) + metallic
    # f nl dl = D G F / (4 nl mu) nl 4 vh dh, and dh has density D cos.
    return float((fresnel * g * vh / (mu * cos)).sum() / (2000 * 720))


@pytest.mark.parametrize("shading_model", ["paper", "principled"])
@pytest.mark.parametrize("roughness", [0.05, 0.3, 1.0])
@pytest.mark.parametrize(("mu", "metallic"), [(0.9, 1.0), (0.3, 1.0), (0.3, 0.0), (0.7, 0.4)])
def test_the_glossy_lobe_reflects_its_directional_albedo(
    shading_model: str, roughness: float, mu: float, metallic: float
) -> None:
    seen = points(400, mu=mu, roughness=roughness, metallic=metallic)
    found = (
        integrate(EMPTY, WHITE, seen, settings(ggx=64, shading_model=shading_model), 0).components[:, 2].mean(axis=1)
    )
    expected = directional_albedo(mu, roughness, metallic, shading_model)
    assert expected <= 1.0001
    assert found.mean() == pytest.approx(expected, abs=4 * float(found.std()) / 20 + 1e-3)


#: Roughness -> one minus the Diffuse Color pass of a white sphere in Cycles 5.0 where n . v is 0.2053, 0.4994, 0.9.
CYCLES = {
    0 / 15: (0.3295, 0.0900, 0.0409),
    3 / 15: (0.3106, 0.0903, 0.0411),
    6 / 15: (0.2113, 0.0861, 0.0420),
    10 / 15: (0.1116, 0.0676, 0.0432),
    15 / 15: (0.0681, 0.0512, 0.0424),
}


@pytest.mark.parametrize("roughness", CYCLES)
def test_the_layer_takes_what_it_takes_in_cycles(roughness: float) -> None:
    for mu, taken in zip((0.2053, 0.4994, 0.9), CYCLES[roughness], strict=True):
        seen = points(50, mu=mu, roughness=roughness)
        found = integrate(EMPTY, WHITE, seen, settings(cosine=16, shading_model="principled"), 0).components[
            :, DIFFUSE_DIRECT
        ]
        np.testing.assert_allclose(1 - found, taken, atol=8e-4)


@pytest.mark.parametrize("shading_model", ["paper", "principled"])
def test_nothing_reflects_more_than_it_receives(shading_model: str) -> None:
    for mu in (0.15, 0.5, 0.95):
        for roughness in (0.05, 0.4, 0.9):
            for metallic in (0.0, 1.0):
                seen = points(200, mu=mu, roughness=roughness, metallic=metallic)
                total = integrate(EMPTY, WHITE, seen, settings(16, 32, 0, shading_model=shading_model), 0).total.mean()
                limit = (
                    1.01
                    if shading_model == "principled" or metallic == 1
                    else 1 + directional_albedo(mu, roughness, 0, shading_model)
                )
                assert total < limit + 0.01


# --- strategies ------------------------------------------------------------------------------------------------------


def agreement(scene: TraceScene, light: EnvironmentLight, seen: ShadingPoints, a: RenderSettings, b: RenderSettings):
    """Difference of two estimates of the mean radiance, per channel group, in standard errors."""
    first, second = (integrate(scene, light, seen, s, 3).components.mean(axis=2) for s in (a, b))
    error = np.sqrt((first.var(axis=0) + second.var(axis=0)) / len(seen))
    return np.abs(first.mean(axis=0) - second.mean(axis=0)) / (error + 1e-6)


@pytest.mark.parametrize("shading_model", ["paper", "principled"])
@pytest.mark.parametrize(
    "alone", [{"cosine": 64}, {"ggx": 64}, {"environment": 64}], ids=["cosine", "ggx", "environment"]
)
def test_each_strategy_alone_agrees_with_all_together(alone: dict, shading_model: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    scene = scene_of((ball.vertices * 0.8 + [1.0, 0.4, 1.0], ball.faces), metallic=0.3)
    light = EnvironmentLight(World(environment=sun_picture()))
    seen = points(3000, albedo=0.7, roughness=0.55, metallic=0.4)
    together = settings(32, 16, 16, bounces=2, shading_model=shading_model)
    found = agreement(scene, light, seen, settings(**alone, bounces=2, shading_model=shading_model), together)
    # Samples of the environment are shadow rays: they bring no light of surfaces.
    direct = [DIFFUSE_DIRECT, GLOSSY_DIRECT]
    assert (found[direct if "environment" in alone else slice(None)] < 4.5).all()


def test_a_shiny_surface_sees_the_sun_by_any_strategy() -> None:
    light = EnvironmentLight(World(environment=sun_picture()))
    seen = points(4000, albedo=0.9, roughness=0.15, metallic=1.0, mu=0.5)
    together = settings(8, 16, 16)
    for alone in (settings(ggx=64), settings(environment=64)):
        assert (agreement(EMPTY, light, seen, alone, together) < 4.5).all()


@pytest.mark.parametrize("counts", [(6, 0, 0), (1, 0, 0), (7, 3, 5), (16, 8, 8)])
def test_sub_samples_share_the_pixels_samples(counts: tuple[int, int, int]) -> None:
    subpixels, pixels = 4, 200
    seen = points(subpixels * pixels, mu=0.99, metallic=0.0)
    seen = replace(seen, pixel=np.repeat(np.arange(pixels), subpixels), sample=np.tile(np.arange(subpixels), pixels))
    # Where the light is constant, each cosine sample of a diffuse surface gives exactly the same.
    found = integrate(EMPTY, WHITE, seen, settings(counts[0], subpixel_samples=subpixels), 0).components[
        :, DIFFUSE_DIRECT, 0
    ]
    np.testing.assert_allclose(found.reshape(pixels, subpixels).mean(axis=1), 1.0, atol=1e-4)
    assert found.reshape(pixels, subpixels).mean(axis=0) == pytest.approx(np.ones(subpixels), abs=0.45)
    light = EnvironmentLight(World(environment=sun_picture()))
    split = (
        luminance(integrate(EMPTY, light, seen, settings(*counts, subpixel_samples=subpixels), 0))
        .reshape(pixels, subpixels)
        .mean(axis=1)
    )
    whole = luminance(integrate(EMPTY, light, points(pixels, mu=0.99), settings(64, 16, 64), 0))
    assert split.mean() == pytest.approx(whole.mean(), abs=4 * float(split.std()) / np.sqrt(pixels) + 0.01)


# --- visibility and bounces ------------------------------------------------------------------------------------------


def corner(size: float = 2000.0) -> tuple[np.ndarray, np.ndarray]:
    """A wall x = 0 on a floor z = 0, both very large: each sees the other under the form factor 1/2."""
    s = size
    vertices = [[0, -s, 0], [s, -s, 0], [s, s, 0], [0, s, 0], [0, -s, 0], [0, s, 0], [0, s, s], [0, -s, s]]
    return np.array(vertices), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])


def test_two_planes_light_each_other_as_the_form_factor_says() -> None:
    """Each diffuse plane sees half sky, half plane: rho / 2 straight from the sky and (rho / 2)^2 over the other."""
    rho = 0.9
    seen = points(4000, origin=(3, 0, 0), albedo=rho, roughness=1.0)
    how = settings(16, 0, 8, bounces=1)
    found, black = (
        integrate(scene_of(corner(), albedo=a, roughness=1.0), WHITE, seen, how, 0).components[:, :2].mean(axis=2)
        for a in (rho, 0.0)
    )
    assert found[:, 0].mean() == pytest.approx(rho / 2, abs=3e-3)
    # A black wall still has its glossy lobe, to which the diffuse one adds.
    indirect = found[:, 1] - black[:, 1]
    assert indirect.mean() == pytest.approx((rho / 2) ** 2, abs=4 * float(indirect.std()) / np.sqrt(len(seen)) + 1e-3)


@pytest.mark.parametrize("bounces", [2, 4, 10])
def test_many_bounces_lie_between_the_series_and_the_furnace(bounces: int) -> None:
    """Diffuse light alone gives sum over k of (rho / 2)^(k + 1); the glossy lobe, F0 = 0.04, adds its little."""
    rho = 0.9
    seen = points(3000, origin=(3, 0, 0), albedo=rho, roughness=1.0)
    lit = integrate(scene_of(corner(), albedo=rho, roughness=1.0), WHITE, seen, settings(16, 0, 8, bounces=bounces), 0)
    diffuse = lit.components[:, :2].sum(axis=1).mean(axis=1)
    error = 4 * float(diffuse.std()) / np.sqrt(len(diffuse))
    series = [sum((r / 2) ** (k + 1) for k in range(bounces + 1)) for r in (rho, rho + 0.05)]
    assert series[0] - error < diffuse.mean() < series[1] + error


@pytest.mark.parametrize("shading_model", ["paper", "principled"])
def test_a_furnace_of_mirrors_keeps_its_light(shading_model: str) -> None:
    """White metal of low roughness loses next to nothing: under a white sky everything looks white, at any bounce."""
    scene = scene_of(corner(), albedo=1.0, roughness=0.1, metallic=1.0)
    seen = points(3000, origin=(3, 0, 0), albedo=1.0, roughness=0.1, metallic=1.0)
    total = luminance(integrate(scene, WHITE, seen, settings(0, 16, 8, bounces=8, shading_model=shading_model), 0))
    assert total.mean() == pytest.approx(1.0, abs=0.01)


def test_roulette_takes_nothing_from_the_mean() -> None:
    """Paths end by their strongest channel. At the bottom of a shaft, green light must not depend on what red does."""
    box = trimesh.creation.box((1, 1, 3))
    faces = box.faces[~(box.face_normals[:, 2] > 0.5)]  # open above
    n = len(box.vertices)
    green = []
    for red in (0.8, 1.0):
        scene, rough, dielectric = TraceScene(), np.ones(n), np.zeros(n)
        albedo = np.tile([red, 0.8, 0.8], (n, 1))
        scene.update([TraceObject("shaft", box.vertices, faces, albedo, rough, dielectric)])
        seen = points(20_000, origin=(0.1, 0.2, -1.5), albedo=0.8, roughness=1.0)
        lit = integrate(scene, WHITE, seen, settings(16, 0, 4, bounces=12), 0).components[:, :2, 1].sum(axis=1)
        green.append((lit.mean(), lit.std() / np.sqrt(len(lit))))
    (few, a), (all_, b) = green
    assert abs(few - all_) < 4 * np.hypot(a, b)
    assert 4 * np.hypot(a, b) < 0.02 * all_  # roulette starts late: a loss of a fifth a bounce shows as some percent


def test_no_bounce_is_waited_for_after_the_last_path() -> None:
    """A thousand million bounces take no longer than those that paths live for."""
    scene, seen = scene_of(corner()), points(50, origin=(3, 0, 0))
    many, enough = (integrate(scene, WHITE, seen, settings(16, 0, 8, bounces=b), 0).total for b in (10**9, 400))
    np.testing.assert_array_equal(many, enough)


def test_a_closed_room_is_dark() -> None:
    box = trimesh.creation.box((2, 2, 2))
    scene = scene_of((box.vertices, box.faces))
    seen = points(500, origin=(0.2, 0.1, -1.0))
    result = integrate(scene, WHITE, seen, settings(8, 8, 8, bounces=3), 0)
    assert result.total.max() == 0


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("offset", [0.0, 20.0])
def test_a_convex_body_does_not_shadow_itself(size: float, offset: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = (ball.vertices + offset) * size
    scene = scene_of((vertices, ball.faces))
    corners = scene.vertices[scene.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    n = len(flat)
    seen = replace(points(n), origin=corners.mean(axis=1), normal=flat, geometric_normal=flat, view=flat)
    result = integrate(scene, WHITE, seen, settings(cosine=64, bounces=0), 0)
    assert result.components[:, DIFFUSE_DIRECT].mean() == pytest.approx(1.0, abs=2e-3)


def test_light_below_the_surface_does_not_leak_through() -> None:
    """A shading normal that leans over lets no light in from behind the geometry."""
    lean = np.float32([0.8, 0, 0.6])
    seen = replace(points(500, mu=1.0), normal=np.tile(lean, (500, 1)))
    image = np.zeros((16, 32, 3), np.float32)
    image[8:] = 1.0  # only the lower half shines
    light = EnvironmentLight(World(environment=image))
    result = integrate(EMPTY, light, seen, settings(16, 16, 16), 0)
    # The row above the horizon is lit by interpolation; nothing else is.
    assert result.total.mean() < 0.02


def test_both_sides_of_a_mesh_reflect() -> None:
    quad = np.array([[-50, -50, 1], [50, -50, 1], [50, 50, 1], [-50, 50, 1.0]])
    results = []
    for faces in ([[0, 1, 2], [0, 2, 3]], [[2, 1, 0], [3, 2, 0]]):
        scene = scene_of((quad, np.array(faces)), albedo=0.8)
        light = EnvironmentLight(World(environment=sun_picture()))
        seen = points(1000, origin=(49.5, 0, 0))
        results.append(integrate(scene, light, seen, settings(16, 8, 8, bounces=2), 0).components.mean(axis=0))
    assert results[0][DIFFUSE_INDIRECT].min() > 0
    np.testing.assert_allclose(results[0], results[1], rtol=1e-3)


# --- a picture is a function of its description ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def busy() -> tuple[TraceScene, EnvironmentLight, ShadingPoints, RenderSettings]:
    ball = trimesh.creation.icosphere(subdivisions=3)
    scene = scene_of((ball.vertices * 0.8 + [1.0, 0.4, 0.9], ball.faces), metallic=0.3)
    light = EnvironmentLight(World(environment=sun_picture()))
    seen = points(3000, albedo=0.7, metallic=0.4)
    seen = replace(seen, pixel=np.arange(3000) // 4, sample=np.arange(3000) % 4)
    return scene, light, seen, settings(7, 4, 4, bounces=5, subpixel_samples=4)


@pytest.mark.alone
def test_strips_threads_and_order_change_no_bit(busy: tuple) -> None:
    scene, light, seen, how = busy
    whole = integrate(scene, light, seen, how, 5)
    before = get_num_threads()
    try:
        use_threads(1)
        single = integrate(scene, light, seen, how, 5)
    finally:
        use_threads(before)
    np.testing.assert_array_equal(single.components, whole.components)
    parts = [
        integrate(scene, light, seen[rows], how, 5) for rows in (slice(0, 1000), slice(1000, None))
    ]  # whole pixels
    np.testing.assert_array_equal(np.concatenate([p.components for p in parts]), whole.components)
    np.testing.assert_array_equal(np.concatenate([p.variance for p in parts]), whole.variance)
    shuffled = np.random.default_rng(0).permutation(len(seen))
    np.testing.assert_array_equal(
        integrate(scene, light, seen[shuffled], how, 5).components, whole.components[shuffled]
    )


def test_seed_and_frame_change_the_noise_and_not_the_mean(busy: tuple) -> None:
    scene, light, seen, how = busy
    base = luminance(integrate(scene, light, seen, how, 5))
    for other in (integrate(scene, light, seen, how, 6), integrate(scene, light, seen, replace(how, seed=1), 5)):
        value = luminance(other)
        assert (value != base).mean() > 0.9
        assert abs(np.corrcoef(value, base)[0, 1]) < 0.1
        assert value.mean() == pytest.approx(base.mean(), abs=5 * base.std() / np.sqrt(len(base)))


def test_the_variance_is_that_of_repeated_renders(busy: tuple) -> None:
    scene, light, seen, _ = busy
    how = settings(16, 8, 8, bounces=1)
    runs = [integrate(scene, light, replace(seen, sample=np.zeros(3000)), how, k) for k in range(12)]
    values = np.stack([r.components.reshape(-1, 2, 2, 3).sum(axis=2) @ LUMINANCE for r in runs])
    measured = values.var(axis=0, ddof=1).mean(axis=0)
    estimated = np.mean([r.variance for r in runs], axis=(0, 1))
    # Stratification makes the truth smaller than the spread of the samples says; never larger by much.
    assert (estimated > 0.7 * measured).all()
    assert (estimated < 6 * measured).all()


# --- faults ----------------------------------------------------------------------------------------------------------


def test_no_fault_of_the_input_reaches_a_pixel() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices = ball.vertices * 0.8 + [1.0, 0.4, 1.0]
    vertices[3] = np.nan
    vertices[9, 0] = np.inf
    scene = scene_of((vertices, ball.faces), metallic=np.nan)
    image = sun_picture()
    image[2, 2], image[8, 8], image[9, 9] = np.nan, np.inf, -5.0
    light = EnvironmentLight(World(environment=image))
    seen = points(60, roughness=0.0, metallic=1.0, mu=0.001)
    for k, name in enumerate(("origin", "normal", "geometric_normal", "view", "albedo", "roughness", "metallic")):
        getattr(seen, name)[3 * k] = np.nan
        getattr(seen, name)[3 * k + 1] = np.inf
    seen.normal[30], seen.geometric_normal[31], seen.view[32] = 0.0, 0.0, 0.0
    seen.view[33] = [0, 0, -1]
    for shading_model in ("paper", "principled"):
        result = integrate(scene, light, seen, settings(8, 8, 8, bounces=4, shading_model=shading_model), 0)
        assert np.isfinite(result.components).all() and (result.components >= 0).all()
        assert np.isfinite(result.variance).all() and (result.variance >= 0).all()
        assert not result.components[:21].reshape(7, 3, -1)[:, :2].any()
        assert result.components[40:].sum() > 0


def test_nothing_to_do_is_done() -> None:
    black = EnvironmentLight(World(strength=0.0))
    assert not integrate(EMPTY, black, points(5), settings(4, 4, 4), 0).components.any()
    assert not integrate(EMPTY, WHITE, points(5), settings(), 0).components.any()
    assert integrate(EMPTY, WHITE, points(0), settings(4), 0).components.shape == (0, 4, 3)


@pytest.mark.parametrize(
    "wrong",
    [{"samples": -1, "strategy_samples": None}, {"bounces": -1}, {"subpixel_samples": -1}, {"shading_model": "toon"}],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict) -> None:
    with pytest.raises(UsageError, match="render settings"):
        integrate(EMPTY, WHITE, points(1), replace(settings(4), **wrong), 0)


# --- lights ---------------------------------------------------------------------------------------------------------


def area_light(**changes: object) -> Lights:
    """A square of one metre, two metres above the origin, shining down."""
    matrix = np.eye(4)
    matrix[:3, 3] = (0.3, 0.2, 2.0)
    return Lights([replace(Light("panel", "area", matrix, power=30.0), **changes)], radius=1.0)  # type: ignore[arg-type]


DARK = EnvironmentLight(World(colour=(0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    "strategies", [{"cosine": 512}, {"environment": 512}, {"cosine": 64, "ggx": 64, "environment": 64}]
)
def test_every_strategy_finds_the_same_light(strategies: dict) -> None:
    """Irradiance below a panel by quadrature over its area, against rays that meet it and samples drawn from it."""
    cells = (np.arange(200) + 0.5) / 200 - 0.5
    x, y = np.meshgrid(cells + 0.3, cells + 0.2)
    square = x**2 + y**2 + 4.0
    radiance = 30.0 / np.pi  # of one square metre, normalised
    expected = float(np.mean(radiance * 4.0 / square**2)) * 0.5 / np.pi
    got = integrate(EMPTY, DARK, points(400, albedo=0.5), settings(**strategies), 3, area_light())
    values = got.components[:, DIFFUSE_DIRECT, 0]
    assert values.mean() == pytest.approx(expected, abs=max(4 * float(values.std()) / 20, 1e-4 * expected))
    assert values.std() / 20 < 0.02 * expected


@pytest.mark.parametrize("auto", [False, True])
def test_sky_and_lights_share_the_light_samples_without_bias(auto: bool) -> None:
    sky, counts = EnvironmentLight(World(sun_picture())), settings(cosine=16, ggx=16, environment=64, auto=auto)
    some = points(3000, albedo=0.7, roughness=0.3)
    together, alone, lit = (
        luminance(integrate(EMPTY, light, some, counts, 8, one))
        for light, one in ((sky, area_light()), (sky, None), (DARK, area_light()))
    )
    noise = np.sqrt(sum(v.var() for v in (together, alone, lit)) / 3000)
    assert together.mean() == pytest.approx(alone.mean() + lit.mean(), abs=4 * noise)
    assert noise < 0.01 * together.mean()


def test_a_light_without_shadow_shines_through() -> None:
    wall = scene_of((np.float32([[-9, -9, 1], [9, -9, 1], [0, 9, 1]]), np.int32([[0, 1, 2]])))
    through = integrate(wall, DARK, points(50), settings(environment=64), 0, area_light(cast_shadow=False))
    free = integrate(EMPTY, DARK, points(50), settings(environment=64), 0, area_light(cast_shadow=False))
    blocked = integrate(wall, DARK, points(50), settings(environment=64), 0, area_light())
    np.testing.assert_allclose(through.components, free.components, rtol=1e-4)  # rays start a little higher
    assert free.components.max() > 0.1 and not blocked.components.any()


@pytest.mark.parametrize(
    "changes", [{"kind": "sun", "angle": 0.0}, {"cast_shadow": False, "size_x": 0.02, "size_y": 0.02}]
)
@pytest.mark.parametrize("rays", [(1, 1, 1), (16, 8, 8)])
def test_mirrors_reflect_lights_that_only_light_samples_find(changes: dict, rays: tuple[int, int, int]) -> None:
    """Where next to no light samples are allotted to a surface, some are left for them."""
    some = points(400, roughness=0.03, metallic=1.0)
    mirrored = 2 * some.view[0, 2] * some.normal[0] - some.view[0]
    matrix = np.eye(4)
    matrix[:3, 2], matrix[:3, 3] = mirrored, 2 * mirrored  # it shines along its own -Z
    matrix[:3, 0] = np.cross([0, 1, 0], mirrored) / np.linalg.norm(np.cross([0, 1, 0], mirrored))
    matrix[:3, 1] = np.cross(mirrored, matrix[:3, 0])
    sampler = Lights([replace(Light("light", "area", matrix, power=30.0), **changes)], radius=1.0)  # type: ignore[arg-type]
    found = {}
    for auto, counts in ((False, (16, 8, 64)), (True, rays)):
        value = luminance(integrate(EMPTY, DARK, some, settings(*counts, auto=auto), 0, sampler)).astype(float)
        found[auto] = value.mean(), value.std() / 20
    (whole, a), (allotted, b) = found[False], found[True]
    assert whole > 1.0 and abs(allotted - whole) < 4.5 * np.hypot(a, b) + 1e-3 * whole


def test_lobes_that_do_not_see_a_light_get_nothing_of_it() -> None:
    some, counts = points(50, roughness=0.4), settings(cosine=32, ggx=32, environment=32)
    both = integrate(EMPTY, DARK, some, counts, 0, area_light())
    diffuse = integrate(EMPTY, DARK, some, counts, 0, area_light(glossy=False))
    assert both.components[:, 2].any() and not diffuse.components[:, 2].any()
    np.testing.assert_allclose(diffuse.components[:, 0], both.components[:, 0], rtol=1e-5)


def test_the_clamp_bounds_every_indirect_sample_and_nothing_else() -> None:
    box = trimesh.creation.box((4, 4, 4))
    inside = scene_of((np.asarray(box.vertices), np.asarray(box.faces)[:10]), albedo=0.9)  # open to one side
    sky, counts = EnvironmentLight(World(sun_picture())), settings(cosine=32, environment=32, bounces=2)
    free = integrate(inside, sky, points(400), counts, 0)
    limit = 0.02
    clamped = integrate(inside, sky, points(400), replace(counts, clamp_indirect=limit), 0)
    np.testing.assert_array_equal(clamped.components[:, DIFFUSE_DIRECT], free.components[:, DIFFUSE_DIRECT])
    indirect = clamped.components[:, [1, 3]].sum(axis=(1, 2)) / 3
    assert indirect.max() <= limit * 1.001
    assert free.components[:, [1, 3]].sum(axis=(1, 2)).max() / 3 > 2 * limit


def test_the_clamp_is_the_same_in_parts() -> None:
    """A part of a position's samples is less than one sample, of which each weighs the more."""
    box = trimesh.creation.box((4, 4, 4))
    inside = scene_of((np.asarray(box.vertices), np.asarray(box.faces)[:10]), albedo=0.9)
    counts = settings(cosine=16, environment=16, bounces=2, subpixel_samples=16, clamp_indirect=0.05)
    some = replace(points(320), pixel=np.arange(320) // 16, sample=np.arange(320) % 16)
    sky = EnvironmentLight(World(sun_picture()))
    whole = integrate(inside, sky, some, counts, 0).components
    parts = [integrate(inside, sky, some, counts, 0, part=(i, 8)).components for i in range(8)]
    np.testing.assert_allclose(np.mean(parts, axis=0), whole, rtol=1e-4, atol=1e-6)
    assert (whole[:, DIFFUSE_INDIRECT] > 0).any()


@pytest.mark.parametrize(
    ("changes", "gain"),
    [
        ({"roughness": 0.5}, 1.5),
        ({"roughness": 0.2, "metallic": 1.0}, 1.5),
        ({"roughness": 0.02, "metallic": 1.0}, 1.5),
    ],
)
def test_samples_are_allotted_where_they_tell_most(changes: dict, gain: float) -> None:
    """The spread of pixels under a sky with a bright spot, next to that with the paper's 16 + 8 + 8."""
    sky, some = EnvironmentLight(World(sun_picture())), points(1000, albedo=0.7, **changes)
    spread = {}
    for auto in (False, True):
        value = luminance(integrate(EMPTY, sky, some, settings(16, 8, 8, auto=auto, shading_model="principled"), 0))
        spread[auto] = value.var()
    assert spread[False] > gain * spread[True]


def test_points_of_a_pixel_agree_on_their_samples() -> None:
    """Where a texture changes the lobes' shares, few steps of the allotment lie between points of one pixel."""
    counts = []
    sampler = Sampler._make([0, np.zeros((0, 3), np.uint32), 1, 0, 1, True, *np.float32([64, 32, 32, 1, 0, 1])])
    for share in np.linspace(0.1, 0.8, 141, dtype=np.float32):
        state = np.zeros((1, POINT_STATE), np.float32)
        state[0, ALPHA] = 0.2**4
        _allocate.py_func(state, 0, share, 1, sampler)
        counts.append(state[0, COUNTS:])
    assert (np.sum(counts, axis=1) == 128).all() and (np.round(counts) == counts).all()
    assert 4 < len(np.unique(counts, axis=0)) < 20


def test_surfaces_that_reflect_each_other_have_fewer_samples_of_the_light() -> None:
    """With bounces much noise is of other surfaces' light; among lamps only metals spare samples for it."""

    def of_light(share: float, bounces: int, lamps: float = 0.0) -> float:
        shares = np.float32([64, 32, 32, 1 - lamps, lamps, 1])
        sampler = Sampler._make([0, np.zeros((0, 3), np.uint32), 1, 0, 1, True, *shares])
        state = np.zeros((1, POINT_STATE), np.float32)
        state[0, ALPHA] = 0.5**4
        _allocate.py_func(state, 0, np.float32(share), bounces, sampler)
        return float(state[0, COUNTS + 2 :].sum())

    for share in (0.0, 0.8):
        assert 0 < of_light(share, 1) < of_light(share, 0)
    assert of_light(0.8, 1, lamps=0.5) == of_light(0.8, 0, lamps=0.5)


def test_no_bit_depends_on_the_neighbours_where_batches_overflow() -> None:
    """Samples of a point that fall into two batches of rays, paths too many for one, lights and sky at once."""
    box = trimesh.creation.box((4, 4, 4))
    room = scene_of((np.asarray(box.vertices), np.asarray(box.faces)[:10]), albedo=0.9)
    sky, counts = EnvironmentLight(World(sun_picture())), settings(cosine=40, ggx=12, environment=12, bounces=2)
    some = points(64)
    whole = integrate(room, sky, some, counts, 0, area_light())
    for first, last in ((37, 64), (10, 50)):
        cut = integrate(room, sky, some[first:last], counts, 0, area_light())
        np.testing.assert_array_equal(cut.components, whole.components[first:last])
        np.testing.assert_array_equal(cut.variance, whole.variance[first:last])


@pytest.mark.parametrize("subpixels", [1, 4, 16, 32])
def test_the_variance_of_a_pixel_does_not_depend_on_its_positions(subpixels: int) -> None:
    """Points of few samples, of one at last, are estimated together with those of their pixel."""
    pixels = 400
    sky = EnvironmentLight(World(np.random.default_rng(3).random((8, 16, 3)).astype(np.float32) ** 4))
    seen = points(subpixels * pixels, mu=0.8, metallic=0.0)
    seen = replace(seen, pixel=np.repeat(np.arange(pixels), subpixels), sample=np.tile(np.arange(subpixels), pixels))
    found = integrate(EMPTY, sky, seen, RenderSettings(bounces=0, subpixel_samples=subpixels), 0)
    light = (found.components.sum(axis=1) @ LUMINANCE).reshape(pixels, subpixels).mean(axis=1)
    estimated = found.variance.sum(axis=1).reshape(pixels, subpixels).sum(axis=1).mean() / subpixels**2
    assert 1.0 < estimated / light.var() < 4.0
