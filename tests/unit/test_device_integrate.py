"""The integrator on a device, on Warp's device "cpu": the same light as by Numba and Embree, from the same source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE

from drgs_blender.core.frame import Layer, Light, MeshState, ObjectState, RenderSettings, Visibility, World
from drgs_blender.core.materials import Image, Material, SurfaceDetail, Texture
from drgs_blender.render.backend import CPU
from drgs_blender.render.gpu.select_backend import Backends
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_links import link
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.lights.mesh_lights import Emitters
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.shading_points import CATCHER, Radiance, ShadingPoints

BALL = trimesh.creation.icosphere(subdivisions=3)
SETTINGS = RenderSettings(samples=16, bounces=3, subpixel_samples=2)
DARK = EnvironmentLight(World(colour=(0.0, 0.0, 0.0)))

pytestmark = pytest.mark.slow  # Warp compiles the whole integrator for them


@pytest.fixture(autouse=True)
def _not_optimised(device: WarpRenderBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiling takes longer than these small scenes: half as long without LLVM's optimisation."""
    import warp

    if DEVICE == "cpu":
        monkeypatch.setattr(warp.config, "optimization_level", 0)


def sky(size: tuple[int, int] = (32, 64)) -> EnvironmentLight:
    image = np.random.default_rng(2).random((*size, 3)).astype(np.float32)
    image[5, 9] = 80.0
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return EnvironmentLight(World(environment=image, rotation=turn * np.linalg.det(turn)))


def ball(centre: tuple, size: float, **changes: object) -> TraceObject:
    rng, n = np.random.default_rng(4), len(BALL.vertices)
    shades = rng.random((n, 3)), rng.random(n), (rng.random(n) > 0.5).astype(np.float32)
    vertices = (BALL.vertices * size + centre).astype(np.float32)
    return replace(TraceObject("ball", vertices, BALL.faces.astype(np.int32), *shades), **changes)  # type: ignore[arg-type]


def floor(*matrices: np.ndarray, **changes: object) -> MeshState:
    """A square of six metres at z = 0, checked, with corners of its own."""
    vertices = np.float32([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]])
    uvs = np.float32([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    state = MeshState(
        "floor", vertices, np.int32([[0, 1, 2], [0, 2, 3]]), np.array(matrices or [np.eye(4)]),
        np.zeros(max(len(matrices), 1), np.int32), uvs=uvs,
    )  # fmt: skip
    return replace(state, **changes)  # type: ignore[arg-type]


def seen(count: int = 1500) -> ShadingPoints:
    """Points on a unit sphere about (0, 0, 1.2), seen from outside, two a pixel."""
    rng = np.random.default_rng(7)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    view = normal + 0.8 * rng.normal(size=(count, 3))
    view *= np.sign((view * normal).sum(axis=1, keepdims=True)) / np.linalg.norm(view, axis=1, keepdims=True)
    return ShadingPoints(
        np.arange(count) // 2, np.arange(count) % 2, np.ones(count), normal + np.array([0, 0, 1.2]), normal, normal,
        view, rng.random((count, 3)), rng.random(count), rng.random(count),
    )  # fmt: skip


def placed(x: float, y: float, z: float, scale: float = 1.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix


def some_lights() -> Lights:
    """Every kind that shines in another way, more than one leaf of the tree."""
    down = placed(0.5, 0.4, 3.0)
    side = placed(2.5, -1.0, 2.0) @ np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    kinds = [
        Light("panel", "area", down, power=60.0),
        Light("disk", "area", side, power=40.0, shape="disk", size_x=0.6, spread=1.2),
        Light("point", "point", placed(-2.0, 1.0, 2.0), power=50.0),
        Light("bulb", "point", placed(-1.5, -2.0, 1.5), power=80.0, radius=0.3, soft_falloff=False, glossy=False),
        Light("soft", "point", placed(1.5, -2.5, 2.5), power=80.0, radius=0.3, cast_shadow=False),
        Light("spot", "spot", placed(0.0, 2.0, 4.0), power=300.0, radius=0.1, spot_size=1.2),
        Light("sun", "sun", side, power=1.5, angle=0.05),
        Light("laser", "sun", down, power=0.4),
    ]
    return Lights(kinds, np.array([0, 0, 1.2]), 1.0)


def under_sky() -> tuple:
    scene = TraceScene()
    scene.update([ball((1.4, 0.6, 1.9), 0.7), ball((-1.2, -1.0, 0.4), 0.5)])
    return scene, sky(), None, seen()


def under_lights() -> tuple:
    scene = TraceScene()
    scene.update([ball((1.6, 0.6, 1.9), 0.6)], [floor()])
    return scene, sky(), some_lights(), seen()


def lights_alone() -> tuple:
    return (*under_lights()[:1], DARK, *under_lights()[2:])


def among_meshes() -> tuple:
    """Textures on every channel, a mesh that emits, in several places, one mirrored, kinds of rays that differ."""
    rng = np.random.default_rng(5)
    images = [
        Image("checker", rng.integers(0, 255, (8, 8, 4), dtype=np.uint8), "srgb"),
        Image("grey", rng.random((4, 4, 4), np.float32), "linear"),
    ]
    checked = Material(
        "checked", base_colour_texture=Texture("checker", "rgb", interpolation="closest"),
        roughness_texture=Texture("grey", "g"), metallic_texture=Texture("grey", "r", extension="mirror"),
    )  # fmt: skip
    glowing = Material("glowing", emission=(3.0, 2.0, 1.0), emission_texture=Texture("checker", "rgb"))
    small = placed(0, 0, 0, 0.2)
    turned = np.eye(4)
    turned[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]
    lights = [
        placed(-2.0, 0.5, 1.0) @ turned @ small,
        placed(0.5, -2.2, 2.0) @ small,
        placed(0, 2.0, 3.0) @ np.diag([-0.2, 0.2, 0.2, 1]),
    ]
    shut = Visibility(glossy=False)
    meshes = [
        floor(materials=[checked]),
        floor(*lights, materials=[glowing], name="lights"),
        floor(placed(1.5, -1.5, 0.5) @ turned @ small, placed(-1.2, 1.8, 2.0, 0.3), name="plates"),
        floor(placed(0, 0, 4.5, 0.2), name="above", visibility=shut),
    ]
    scene = TraceScene()
    scene.update([ball((1.6, 0.6, 1.9), 0.6)], meshes, images)
    return scene, sky(), Lights([], np.array([0, 0, 1.2]), 1.0, Emitters(scene)), seen()


def hidden() -> tuple:
    """Twins in one place, each met by what does not meet the other; what no light meets; some stand in places."""
    lid, wall = placed(0, 0, 2.8), placed(0, -2.0, 1.0, 0.3)
    meshes = [
        floor(lid, name="shade", visibility=Visibility(diffuse=False, glossy=False)),
        floor(lid, name="lid", visibility=Visibility(shadow=False)),
        floor(name="seen only", visibility=Visibility(diffuse=False, glossy=False, shadow=False)),
        floor(wall, placed(1.9, 0, 0.7, 0.3), name="walls", visibility=Visibility(glossy=False)),
        floor(wall, placed(1.9, 0, 0.7, 0.3), name="mirrors", visibility=Visibility(diffuse=False, shadow=False)),
    ]
    scene = TraceScene()
    scene.update([ball((1.4, 0.6, 0.2), 0.4)], meshes)
    return scene, sky(), some_lights(), seen()


def detailed() -> tuple:
    """Normal and bump maps, layers, and surfaces that light may pass, with one instance and several."""
    rng = np.random.default_rng(6)
    images = [
        Image("normals", rng.integers(90, 165, (8, 8, 4), dtype=np.uint8)),
        Image("heights", rng.integers(0, 255, (8, 8, 4), dtype=np.uint8), "srgb"),
    ]
    layers = [
        Layer("other", rng.uniform(0, 1, (2, 3, 2)).astype(np.float32)),
        Layer("paint", rng.uniform(0, 1, (2, 3, 4)).astype(np.float32)),
    ]
    maps = [
        SurfaceDetail("tangent", Texture("normals", layer="other"), strength=0.8, tangents="other"),
        SurfaceDetail("bump", Texture("heights", "r", extension="mirror"), distance=0.2),
        SurfaceDetail("bump", Texture("", "g", layer="paint"), strength=0.5),
    ]
    painted = Material("painted", base_colour_texture=Texture("", layer="paint"), details=maps)
    veil = Material(
        "veil", alpha_texture=Texture("", "a", layer="paint"), details=[SurfaceDetail("object", Texture("normals"))]
    )
    glow = Material("glow", emission=(2.0, 1.0, 0.5), alpha=0.4)
    meshes = [
        floor(materials=[painted], layers=layers),
        floor(placed(1.5, 0, 1.5, 0.3), placed(-1.5, 0, 2.0, -0.3), name="veils", materials=[veil], layers=layers),
        floor(placed(0, 0, 3.5, 0.4), name="glow", materials=[glow]),
    ]
    scene = TraceScene()
    scene.update([ball((1.6, 0.6, 1.9), 0.3)], meshes, images)
    return scene, sky(), Lights([], np.array([0, 0, 1.2]), 1.0, Emitters(scene)), seen()


def caught() -> tuple:
    scene = TraceScene()
    scene.update([ball((0.6, 0.3, 0.8), 0.5)], [floor(visibility=Visibility(shadow_catcher=True))])
    points = seen(600)
    points.flags[:] = CATCHER
    return scene, sky(), some_lights(), points


SCENES: dict[str, Callable[[], tuple]] = {
    f.__name__: f for f in (under_sky, under_lights, lights_alone, among_meshes, hidden, detailed, caught)
}


def both(
    device: WarpRenderBackend, scene: tuple, settings: RenderSettings, part: tuple[int, int] = (0, 1)
) -> list[Radiance]:
    objects, light, shining, points = scene
    return [by(objects, light, points, settings, 3, shining, part) for by in (integrate, device.integrate)]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of pictures whose white is 1."""
    error = np.mean((np.minimum(a, 1.0) - np.minimum(b, 1.0)).astype(np.float64) ** 2)
    return float(-10 * np.log10(max(error, 1e-20)))


@pytest.mark.parametrize("shading_model", ["paper", "principled"])
@pytest.mark.parametrize("name", SCENES)
def test_a_device_finds_the_light_that_the_processor_finds(
    device: WarpRenderBackend, name: str, shading_model: str
) -> None:
    scene = SCENES[name]()
    here, there = both(device, scene, replace(SETTINGS, shading_model=shading_model))
    assert here.total.max() > 0.1
    assert psnr(here.total, there.total) > 60.0
    # Nearly all samples agree to rounding; a ray along an edge may meet the other face.
    apart = np.abs(here.components - there.components).max(axis=(1, 2)) > 1e-4 * (1.0 + here.total.max(axis=1))
    assert apart.mean() < 0.01
    np.testing.assert_array_equal(here.moments[:, 0], there.moments[:, 0])
    np.testing.assert_allclose(here.variance.mean(axis=0), there.variance.mean(axis=0), rtol=1e-2)
    if name == "caught":
        np.testing.assert_allclose(here.unshadowed, there.unshadowed, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("settings", [
    replace(SETTINGS, strategy_samples=(5, 5, 6), bounces=0),
    replace(SETTINGS, bounces=8, clamp_indirect=0.5, filter_glossy=1.0),
    replace(SETTINGS, strategy_samples=(0, 0, 8)),
])  # fmt: skip
def test_settings_mean_the_same_on_a_device(device: WarpRenderBackend, settings: RenderSettings) -> None:
    here, there = both(device, under_lights(), settings, (1, 2))
    assert here.total.max() > 0.1
    assert psnr(here.total, there.total) > 60.0


def test_points_give_the_same_bits_in_any_company(device: WarpRenderBackend) -> None:
    scene, light, shining, points = under_lights()
    whole = device.integrate(scene, light, points, SETTINGS, 0, shining)
    part = device.integrate(scene, light, points[100:300], SETTINGS, 0, shining)
    np.testing.assert_array_equal(part.components, whole.components[100:300])


def test_what_moves_is_followed(device: WarpRenderBackend) -> None:
    """The tree is refitted, places and materials are taken again."""
    scene, points, light = TraceScene(), seen(), sky()
    for shift, visibility in ((0.0, Visibility()), (0.4, Visibility()), (-0.3, Visibility(shadow=False))):
        objects = [ball((1.4 + shift, 0.6, 1.9), 0.7)]
        scene.update(objects, [floor(placed(0, 0, shift), placed(0, 0, 3.5 - shift, 0.2), visibility=visibility)])
        here, there = both(device, (scene, light, None, points), SETTINGS)
        assert psnr(here.total, there.total) > 60.0


def test_an_empty_scene_and_hopeless_points_are_survived(device: WarpRenderBackend) -> None:
    points = seen(50)
    points.origin[3] = np.nan
    points.normal[4] = np.inf
    here, there = both(device, (TraceScene(), sky(), None, points), SETTINGS)
    assert np.isfinite(there.components).all() and not there.components[3:5].any()
    np.testing.assert_allclose(here.components, there.components, rtol=1e-4, atol=1e-5)


# --- which device ----------------------------------------------------------------------------------------------------


def test_without_a_card_the_processor_does_all_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drgs_blender.compute.warp.runtime.cuda_devices", list)
    devices, settings = Backends(), replace(SETTINGS, device="cuda")
    assert devices.select("cuda") is CPU
    (warning,) = devices.warnings(settings)
    assert "no NVIDIA card" in warning and warning.endswith("Rendered on the CPU")
    assert devices.warnings(SETTINGS) == []


def test_a_device_that_fails_is_left_alone_and_its_work_done_here(device: WarpRenderBackend, monkeypatch) -> None:
    scene, light, shining, points = under_lights()
    broken = WarpRenderBackend(DEVICE)
    monkeypatch.setattr(
        broken.launcher, "_scratch_for", lambda *arguments: (_ for _ in ()).throw(RuntimeError("out of memory\nat 0"))
    )
    found = broken.integrate(scene, light, points, SETTINGS, 3, shining)
    np.testing.assert_array_equal(found.components, integrate(scene, light, points, SETTINGS, 3, shining).components)
    devices = Backends()
    devices._known["cuda"] = broken
    (warning,) = devices.warnings(replace(SETTINGS, device="cuda"))
    assert "out of memory" in warning and "at 0" not in warning and warning.endswith("Rendered on the CPU")
    assert devices.select("cuda") is broken and not broken.failed  # what comes next may fit
    for _ in range(2):
        broken.integrate(scene, light, points, SETTINGS, 3, shining)
        devices.select("cuda")
    assert broken.failed and devices.warnings(replace(SETTINGS, device="cuda")) == [warning]


def test_surfels_as_tracer_are_left_to_the_processor(device: WarpRenderBackend) -> None:
    devices = Backends()
    devices._known["cuda"] = device
    (warning,) = devices.warnings(replace(SETTINGS, device="cuda", rays_see="surfels"))
    assert "Rays See: Surfels" in warning


def test_linked_lights_are_left_to_the_processor(device: WarpRenderBackend) -> None:
    scene, light, _, points = under_lights()
    place = np.eye(4)
    place[2, 3] = 3.0
    lamp = Light("lamp", "point", place, power=100.0, radius=0.3, receivers=0)
    sphere, shapes = (np.zeros(3), 1.0), [ObjectState(str(i), "key") for i in range(len(scene.faults))]
    shining = Lights([lamp], *sphere)
    link(shining, [lamp], shapes, scene, sphere)
    expected = integrate(scene, light, points, SETTINGS, 3, shining)
    assert np.array_equal(device.integrate(scene, light, points, SETTINGS, 3, shining).components, expected.components)
    everywhere = integrate(scene, light, points, SETTINGS, 3, Lights([lamp]))
    assert not np.array_equal(expected.components, everywhere.components)
    devices = Backends()
    devices._known["cuda"] = device
    (warning,) = devices.warnings(replace(SETTINGS, device="cuda"), linked=True)
    assert "Light linking" in warning


def test_every_array_is_copied_to_a_card(monkeypatch: pytest.MonkeyPatch) -> None:
    """A card cannot read this memory: here it is spoilt once the copies are made. Its scratch memory is turned."""
    scene, light, shining, points = among_meshes()
    expected = integrate(scene, light, points, SETTINGS, 3, shining)
    apart = WarpRenderBackend(DEVICE)
    apart.launcher.apart = True
    apart.mirror.tables(scene, light, shining)
    materials = scene.mesh_materials
    spoilt = [
        scene.shading_faces, scene.shading, scene.normals, scene.face_object, materials.index, materials.uvs,
        scene._instance_normal, scene.instance_object, materials.addresses, scene.vertices, *materials.table.arrays,
        *(texels.texels for texels in materials.table._images.values()), light.texels, light.row_z, light.cells.runs,
        light.cells.guide, light.cells.block, light.product.starts, light.product.slices, light.product.ratio,
        light.product.first, shining.emitters.rows, shining.emitters.nodes, shining.emitters.sums,
        shining.emitters.faces, shining.emitters.slot, shining.emitters.first, shining.emitters.row,
        shining.emitters._tables,
    ]  # fmt: skip
    for array in spoilt:
        array.setflags(write=True)
        array.view(np.uint8)[...] = 0x7F
    found = apart.integrate(scene, light, points, SETTINGS, 3, shining)
    scratch = [scratch for own in apart.launcher._scratch.values() for scratch in own]
    assert not apart.failed and scratch and not any(scratch.is_contiguous for scratch in scratch)
    assert psnr(found.total, expected.total) > 60.0
