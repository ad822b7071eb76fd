"""Captures without a mesh, as they are imported: rendered, and exported to what holds splats."""

from __future__ import annotations

import bpy
import pytest
from scenes import import_surfels_alone, part, read_exr


@pytest.fixture
def cloud(scene, tmp_path):
    """The ball's surfels alone."""
    return import_surfels_alone(tmp_path)


def test_it_is_rendered_without_any_setting(cloud, scene):
    """Light meets sheets of its surfels; no error, no warning."""
    bpy.ops.object.light_add(type="SUN")
    messages = part("addon.messages")
    messages.clear()
    bpy.ops.render.render(write_still=True)
    assert not [m.text for m in messages.history if m.level != "INFO"]
    assert read_exr(scene.render.filepath, 64, 48).max() > 0.1


def test_formats_of_meshes_say_what_has_no_mesh(cloud, ball_file, tmp_path):
    """Alone it is refused, in the words of the interface; beside others it is left out by name."""
    bpy.ops.object.select_all(action="DESELECT")
    with pytest.raises(RuntimeError, match=rf"no mesh.*{cloud.name}.*glTF splats"):
        bpy.ops.drgs.export(filepath=str(tmp_path / "a.glb"), format="glTF mesh")
    bpy.ops.import_scene.drgs(filepath=str(ball_file))
    messages = part("addon.messages")
    messages.clear()
    assert bpy.ops.drgs.export(filepath=str(tmp_path / "a.glb"), format="glTF mesh") == {"FINISHED"}
    assert any(m.level == "WARNING" and m.text.startswith(f"{cloud.name}: has no mesh") for m in messages.history)
