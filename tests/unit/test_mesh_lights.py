"""Light of surfaces that emit: what it does must be what a light of the same shape and radiance does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_integrate import points, settings
from test_surface import mesh_state

from drgs_blender.core.frame import Light, MeshState, World
from drgs_blender.core.materials import Material
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.lights.mesh_lights import Emitters
from drgs_blender.render.scene.trace_scene import TraceScene

FACES = np.int32([[0, 1, 2], [0, 2, 3]])
RADIANCE = (2.0, 1.0, 0.5)


def panel() -> MeshState:
    """Two by two metres, one above the origin, black but for its light."""
    corners = np.float32([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    return mesh_state(corners, FACES, materials=[Material("glow", (0.0, 0.0, 0.0), 1.0, 1.0, RADIANCE)])


def area_light() -> Light:
    """The same light as one of Blender's: it shines down."""
    place = np.eye(4)
    place[2, 3] = 1.0
    return Light("light", "area", place, RADIANCE, math.pi * 4.0, size_x=2.0)


def wall() -> MeshState:
    """A wall and the floor on which the point lies; nothing is above the panel, which shines on both sides."""
    corners = np.float32([[1.5, -3, 0], [1.5, 3, 0], [1.5, 3, 1], [1.5, -3, 1], [-2, -3, 0], [-2, 3, 0]])
    return mesh_state(
        corners,
        np.concatenate([FACES, np.int32([[0, 1, 5], [0, 5, 4]])]),
        materials=[Material("wall", (0.9, 0.6, 0.3), 0.4)],
    )


def total(meshes: list[MeshState], lights: list[Light], bounces: int, strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean light of a point on the floor by kind, (4, 3), and its standard error."""
    scene = TraceScene()
    scene.update([], meshes)
    seen = points(4000, albedo=0.8, roughness=0.4, origin=(0.3, 0.1, 0.0))
    light = EnvironmentLight(World(strength=strength))
    how = settings(16, 8, 8, bounces=bounces, shading_model="principled")
    sampler = Lights(lights, emitters=Emitters(scene))
    found = integrate(scene, light, seen, how, 0, sampler).components.astype(float)
    return found.mean(0), found.std(0) / math.sqrt(len(found))


@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_a_panel_lights_as_a_light_does(bounces: int) -> None:
    """Direct and indirect light in a world without light, up to the last bounce."""
    (glow, a), (lit, b) = total([panel(), wall()], [], bounces, 0.0), total([wall()], [area_light()], bounces, 0.0)
    assert lit[0].min() > 0.2 and (bounces == 0 or lit[1].max() > 0.005)
    assert (np.abs(glow - lit) <= 4.5 * np.hypot(a, b) + 1e-4).all()
    assert (np.hypot(a, b)[:2] < 0.02 * lit[:2] + 2e-4).all()


def test_a_panel_adds_to_the_light_of_the_world() -> None:
    """Light is additive: panel and sky together are the panel alone and the sky that the panel leaves."""
    both, a = total([panel(), wall()], [], 1, 0.5)
    alone, b = total([panel(), wall()], [], 1, 0.0)
    dark = mesh_state(panel().vertices, FACES, materials=[Material("dark", (0.0, 0.0, 0.0), 1.0, 1.0)])
    sky, c = total([dark, wall()], [], 1, 0.5)
    assert (np.abs(both - alone - sky) <= 4.5 * np.sqrt(a**2 + b**2 + c**2) + 1e-4).all()
