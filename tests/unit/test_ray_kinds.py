"""What only diffuse or only glossy rays meet: each lobe of a seen surface reflects what its own rays meet."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_integrate import points, settings, sun_picture
from test_mesh_lights import area_light, panel, wall

from drgs_blender.core.frame import Light, MeshState, Visibility, World
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.scene.trace_scene import TraceScene

DARK = World(strength=0.0)


def light_of(
    meshes: list[MeshState], world: World, lights: list[Light], bounces: int, auto: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over pixels by kind of light, (4, 3), and its standard error."""
    scene = TraceScene()
    scene.update([], meshes)
    seen = points(6000, albedo=0.7, roughness=0.5, metallic=0.4, origin=(0.3, 0.1, 0.0))
    how = settings(8, 8, 8, bounces=bounces, shading_model="principled", auto=auto)
    found = integrate(scene, EnvironmentLight(world), seen, how, 0, Lights(lights)).components.astype(float)
    return found.mean(0), found.std(0) / math.sqrt(len(found))


@pytest.mark.parametrize("auto", [False, True])
@pytest.mark.parametrize(("hidden", "black", "kept"), [("diffuse", [0, 1], [2, 3]), ("glossy", [2, 3], [0, 1])])
def test_a_lobe_meets_what_its_own_rays_meet(hidden: str, black: list[int], kept: list[int], auto: bool) -> None:
    """A glowing panel is all there is; hidden to one kind of rays it leaves that lobe black."""
    glow = panel()
    whole, a = light_of([glow], DARK, [], 0, auto)
    glow.visibility = Visibility(**{hidden: False})
    part, b = light_of([glow], DARK, [], 0, auto)
    assert whole[[0, 2]].min() > 0.01 and not part[black].any()
    assert (np.abs(part - whole)[kept] <= 4.5 * np.hypot(a, b)[kept]).all()


@pytest.mark.parametrize("auto", [False, True])
def test_keeping_lobes_apart_changes_no_mean(auto: bool) -> None:
    """A thing under the floor that nothing sees decides how samples are weighed, not what light there is."""
    buried = wall()
    buried.matrices, buried.visibility = np.diag([0.2, 0.2, 0.2, 1.0])[None], Visibility(glossy=False)
    buried.matrices[0, 2, 3] = -0.5
    low = area_light()
    low.matrix_world[2, 3] = 0.6
    sky = World(sun_picture() * np.float32(0.05))
    (together, a), (apart, b) = (light_of([panel(), wall(), *more], sky, [low], 2, auto) for more in ([], [buried]))
    assert (np.abs(together - apart) <= 4.5 * np.hypot(a, b)).all()
    assert (np.hypot(a, b) < 0.04 * together).all() and not (a == b).all()


def test_sky_behind_what_shadow_rays_alone_meet_is_as_bright_as_in_cycles() -> None:
    """A matte floor under a roof that diffuse rays pass: what Cycles' weights of one ray and one light sample leave."""
    roof = panel()
    roof.matrices = np.diag([1e4, 1e4, 1.0, 1.0])[None]
    roof.visibility = Visibility(diffuse=False)
    white = World()
    (free, _), (roofed, _) = (light_of(meshes, white, [], 0, True) for meshes in ([], [roof]))
    # The mean over cosine-distributed rays of p / (p + 1 / (4 pi)), p being their density.
    cycles = 0.5 + math.log(5.0) / 8
    np.testing.assert_allclose(roofed[0] / free[0], cycles, atol=0.12)


def indirect(metallic: float, **seen: bool) -> np.ndarray:
    """Mean indirect light from a wall that a light just before it lights, by kind, (2, 3)."""
    shiny = wall()
    shiny.materials[0].metallic = metallic
    low = area_light()
    low.matrix_world[:3, 3] = 1.4, 0.0, 0.6
    low.matrix_world[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # it shines along +X
    return light_of([shiny], DARK, [replace(low, size_x=1.5, **seen)], 1)[0][[1, 3]]


def test_lights_shine_at_further_surfaces_on_the_lobes_that_see_them() -> None:
    both, hidden, kept = indirect(1.0), indirect(1.0, glossy=False), indirect(1.0, diffuse=False)
    assert both.min() > 1e-3 and not hidden.any()  # a metal has no diffuse lobe
    np.testing.assert_allclose(kept, both, rtol=1e-5)
    both, diffuse, glossy = indirect(0.0), indirect(0.0, glossy=False), indirect(0.0, diffuse=False)
    np.testing.assert_allclose(diffuse + glossy, both, rtol=1e-4)
    assert (diffuse > 0.8 * both).all() and (glossy > 0.005 * both).all()
