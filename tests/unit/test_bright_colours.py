"""Base colours above 1, which nodes can give, and factors above 1 of textures, as Cycles of Blender 5.0.1 has them."""

from __future__ import annotations

import numpy as np
import pytest
from test_integrate import points, settings
from test_light_sampler import light

from drgs_blender.core.frame import World
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.scene.textures import MaterialTable
from drgs_blender.render.scene.trace_scene import TraceScene

BASES = (0.3, 0.6, 1.0, 1.6, 3.0)
#: A Principled plane (GGX) seen from straight above, under a sun of strength 1 that is tilted by 0.3, in Cycles: by
#: metallic and roughness.
CYCLES = {
    (0.0, 1.0): (0.09057, 0.17803, 0.29464, 0.46956, 0.8777),
    (0.0, 0.5): (0.11607, 0.2036, 0.3203, 0.49536, 0.90383),
    (1.0, 1.0): (0.02333, 0.04666, 0.07776, 0.07776, 0.07776),
    (1.0, 0.5): (0.21401, 0.42802, 0.71337, 0.71337, 0.71337),
}


@pytest.mark.parametrize("metallic, roughness", list(CYCLES))
def test_diffuse_light_grows_with_the_base_colour_and_that_of_metals_ends_at_white(metallic, roughness):
    sampler = Lights([light("sun", 0, 0, 0, tilt=0.3, power=1.0)])
    sky, how = EnvironmentLight(World(strength=0.0)), settings(0, 0, 1, shading_model="principled")
    found = [
        integrate(
            TraceScene(), sky, points(1, mu=1.0, albedo=a, roughness=roughness, metallic=metallic), how, 0, sampler
        ).components[0, :, 0].sum()
        for a in BASES
    ]  # fmt: skip
    np.testing.assert_allclose(found, CYCLES[metallic, roughness], rtol=2e-3)


def test_a_factor_above_1_brightens_its_texture():
    """What is limited is the product; of numbers to 1."""
    image = Image("i", np.array([[[0.2, 0.3, 0.9, 1.0]]], np.float32))
    names = ("base_colour_texture", "roughness_texture", "metallic_texture")
    textures = {name: Texture("i", "rgb" if name.startswith("base") else "g") for name in names}
    table = MaterialTable([Material("m", (2.0, 3.0, 2.0), 2.0, 4.0, **textures)], [image])
    np.testing.assert_allclose(table.lookup([0], [[0.5, 0.5]])[0, :5], [0.4, 0.9, 1.8, 0.6, 1.0], rtol=1e-6)
    assert table.warnings == []


def test_numbers_without_a_texture_end_at_1():
    table = MaterialTable([Material("m", (2.0, 0.5, 1e9), 2.0, 1.5)], [])
    np.testing.assert_allclose(table.lookup([0], [[0.5, 0.5]])[0, :5], [2.0, 0.5, 1000.0, 1.0, 1.0])
    assert [("base colour" in w, "roughness" in w, "metallic" in w) for w in table.warnings] == [
        (True, False, False), (False, True, False), (False, False, True),
    ]  # fmt: skip
