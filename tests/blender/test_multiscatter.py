"""Multiscatter GGX, the default distribution of Blender's shaders, is rendered as GGX: told where that shows."""

from __future__ import annotations

import bpy
import pytest
from scenes import mesh_object

pytestmark = pytest.mark.blender_api


@pytest.fixture
def shader(scene):
    """The Principled BSDF of a triangle."""
    obj = mesh_object("metal", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    material = bpy.data.materials.new("metal")
    if material.node_tree is None:
        material.use_nodes = True
    obj.data.materials.append(material)
    return next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")


@pytest.mark.parametrize(
    ("distribution", "roughness", "metallic", "said"),
    [("MULTI_GGX", 0.8, 1.0, "34%"), ("MULTI_GGX", 0.8, 0.5, "17%"), ("GGX", 0.8, 1.0, ""),
     ("MULTI_GGX", 0.3, 1.0, ""), ("MULTI_GGX", 1.0, 0.0, "")],
)  # fmt: skip
def test_rough_metals_are_named(shader, export, distribution, roughness, metallic, said):
    shader.distribution = distribution
    shader.inputs["Roughness"].default_value, shader.inputs["Metallic"].default_value = roughness, metallic
    _, warnings = export()
    found = [text for text in warnings if "Multiscatter GGX" in text]
    assert len(found) == bool(said) and all('"metal"' in text and said in text for text in found)
