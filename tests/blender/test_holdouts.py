"""The Holdout shader: it cuts its object out where it is all of it, and is named where it is a part."""

from __future__ import annotations

import bpy
import pytest
from scenes import mesh_object
from test_materials import add, material, output_of

pytestmark = pytest.mark.blender_api


def holdout(name: str = "hole") -> bpy.types.Material:
    tree, _ = material(name)
    tree.links.new(add(tree, "Holdout"), output_of(tree).inputs["Surface"])
    return bpy.data.materials[name]


@pytest.fixture
def shape(scene):
    """Two triangles in two slots; the second is a Holdout."""
    obj = mesh_object("shape", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], [(0, 1, 2), (1, 3, 2)])
    material("matter")
    for data in (bpy.data.materials["matter"], holdout()):
        obj.data.materials.append(data)
    return obj


@pytest.mark.parametrize("used", [(0, 0), (0, 1), (1, 1)])
def test_an_object_is_a_holdout_where_all_its_faces_are(shape, export, used):
    shape.data.polygons.foreach_set("material_index", used)
    shape.data.update()
    frame, warnings = export()
    mesh = next(m for m in frame.meshes if m.name == "shape")
    assert mesh.visibility.holdout == (used == (1, 1))
    if used == (0, 1):
        (text,) = warnings
        assert '"shape"' in text and '"hole"' in text and "Separate" in text
        assert mesh.materials[1].base_colour == (0, 0, 0)
    else:
        assert not warnings


def test_dr_gs_objects_are_holdouts_too(ball, export):
    assert not export()[0].objects[0].visibility.holdout
    ball.data.materials.clear()
    ball.data.materials.append(holdout())
    frame, warnings = export()
    assert frame.objects[0].visibility.holdout and not warnings


def test_a_mixed_holdout_is_named(shape, export):
    tree = bpy.data.materials["hole"].node_tree
    both = add(tree, "MixShader", 0.5, add(tree, "Holdout"), add(tree, "BsdfDiffuse"))
    tree.links.new(both, output_of(tree).inputs["Surface"])
    shape.data.polygons.foreach_set("material_index", (1, 1))
    frame, (text,) = export()
    assert not frame.meshes[0].visibility.holdout
    assert '"hole"' in text and "Holdout" in text and "Visibility" in text
