"""Light groups: their parts add up to the picture, which has the same samples with and without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_light_links import Scene, at, scene, slab  # noqa: F401  a fixture

from drgs_blender.core.frame import Light, World
from drgs_blender.core.materials import Material

GROUPS = ("Combined_lamps", "Combined_sky", "Combined_glow", "Combined_rest")


@pytest.fixture(scope="module")
def grouped(scene: Scene) -> Scene:  # noqa: F811
    """Two lamps of two groups (one seen by the camera), a sun, a glowing slab, a sky; two bounces."""
    session, frame = scene
    key, fill = frame.lights
    lights = [
        replace(key, light_group="lamps", radius=0.5),
        replace(fill, light_group="rest", size_x=2.0),
        Light("sun", "sun", at(0, 0, 1), power=0.7, angle=0.3, light_group="rest"),
        replace(fill, name="seen", matrix_world=at(0, 0, 4), power=5.0, light_group="lamps", camera=True),
    ]
    meshes = [*frame.meshes, slab("glow", 5, 0, -0.4, 0.5, emission=(1.0, 2.0, 3.0), light_group="glow")]
    world = World(np.random.default_rng(1).random((8, 16, 3), np.float32), light_group="sky")
    settings = replace(frame.settings, bounces=2, clamp_indirect=0.5, samples=64)
    return session, replace(frame, lights=lights, meshes=meshes, world=world, settings=settings)


def passes_of(grouped: Scene, names: tuple[str, ...], **changes: object) -> dict[str, np.ndarray]:
    session, frame = grouped
    return session.render(replace(frame, passes=("Combined", *names), **changes))  # type: ignore[arg-type]


def test_groups_add_up_and_change_no_sample(grouped: Scene) -> None:
    plain = passes_of(grouped, ())["Combined"]
    found = passes_of(grouped, GROUPS)
    assert np.array_equal(plain, found["Combined"])
    total = sum(found[name] for name in GROUPS)
    assert np.abs(total - plain[..., :3]).max() < 1e-4 * plain.max()
    assert all(found[name].max() > 0.01 for name in GROUPS)
    some = passes_of(grouped, GROUPS[1:3])
    assert all(np.array_equal(some[name], found[name]) for name in GROUPS[1:3])


#: Those that have the integrator compiled once more.
COMPILED = [pytest.param(parts, marks=pytest.mark.slow) for parts in ("linked", "glass")]


@pytest.mark.parametrize("parts", ["adaptive", "surfels", "transparent", *COMPILED])
def test_groups_add_up_everywhere(grouped: Scene, parts: str) -> None:
    settings, changes = grouped[1].settings, {}
    if parts == "linked":
        linked = [replace(light, receivers=i, blockers=i) for i, light in enumerate(grouped[1].lights)]
        bits = [replace(mesh.visibility, lit_by=k, blocks=k) for k, mesh in enumerate(grouped[1].meshes)]
        meshes = [replace(mesh, visibility=own) for mesh, own in zip(grouped[1].meshes, bits, strict=True)]
        changes = {"lights": linked, "meshes": meshes}
    elif parts == "glass":
        clear = Material("glass", (0.9, 0.9, 0.9), 0.2, transmission=0.9)
        meshes = [*grouped[1].meshes]
        meshes[0] = replace(meshes[0], materials=[clear])
        changes = {"meshes": [*meshes, replace(slab("pane", 0, 0, 1.5, 1.0), materials=[clear])]}
    elif parts == "adaptive":
        settings = replace(settings, noise_threshold=0.05)
    elif parts == "surfels":
        settings = replace(settings, rays_see="surfels", camera_sees="surfels")
    else:
        settings = replace(settings, film_transparent=True)
    plain = passes_of(grouped, (), settings=settings, **changes)["Combined"]
    found = passes_of(grouped, GROUPS, settings=settings, **changes)
    assert np.array_equal(plain, found["Combined"])
    total = sum(found[name] for name in GROUPS)
    assert np.abs(total - plain[..., :3]).max() < 1e-4 * max(plain.max(), 1.0)


def test_a_group_is_the_picture_of_its_light_alone(grouped: Scene) -> None:
    """In the mean: samples are drawn otherwise where other lights are missing."""
    session, frame = grouped
    frame = replace(frame, settings=replace(frame.settings, samples=512, clamp_indirect=0.0, subpixel_samples=16))
    found = passes_of((session, frame), GROUPS)
    dark = World(colour=(0.0, 0.0, 0.0))
    black = (0.0, 0.0, 0.0)
    unlit = [replace(mesh, materials=[replace(m, emission=black) for m in mesh.materials]) for mesh in frame.meshes]
    lamps = [light for light in frame.lights if light.light_group == "lamps"]
    for name, alone in (
        ("Combined_lamps", replace(frame, lights=lamps, world=dark, meshes=unlit)),
        ("Combined_sky", replace(frame, lights=[], meshes=unlit)),
        ("Combined_glow", replace(frame, lights=[], world=dark)),
    ):
        one = passes_of((session, alone), ())["Combined"][..., :3]
        assert found[name].mean() == pytest.approx(one.mean(), rel=0.01), name
        error = (found[name] - one).reshape(5, 4, 10, 4, 3).mean(axis=(1, 3))  # over 4 x 4 pixels: less noise
        assert np.abs(error).mean() < 0.1 * one.mean(), name


def test_groups_do_not_depend_on_threads(grouped: Scene) -> None:
    settings = grouped[1].settings
    one, two = (passes_of(grouped, GROUPS, settings=replace(settings, threads=n)) for n in (1, 2))
    assert all(np.array_equal(one[name], two[name]) for name in GROUPS)
