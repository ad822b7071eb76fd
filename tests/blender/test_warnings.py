"""Warnings in the panel of messages: they come with their cause and leave with it."""

from __future__ import annotations

import bpy
import numpy as np
from scenes import new_world, part


def warned(start: str = "") -> list[str]:
    history = part("addon.messages").history
    return [m.text for m in history if m.level == "WARNING" and m.text.startswith(start)]


def test_a_scene_that_nothing_lights_says_so_until_it_is_lit(scene, ball):
    scene.world = None
    for _ in range(2):
        bpy.ops.render.render()
        assert len(warned("nothing lights the scene")) == 1
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "SUN"))
    scene.collection.objects.link(lamp)
    bpy.ops.render.render()
    assert not warned("nothing lights the scene"), "it leaves with its cause"
    lamp.hide_render = True
    bpy.ops.render.render()
    assert warned("nothing lights the scene")
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (0, 0, 0.1, 1)
    bpy.ops.render.render()
    assert not warned("nothing lights the scene")


def test_a_warning_of_one_frame_of_an_animation_stays(scene, ball):
    """Nothing is taken back by the frames after it: it holds of the animation."""
    scene.world = None
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "SUN"))
    scene.collection.objects.link(lamp)
    lamp.hide_render = True
    lamp.keyframe_insert("hide_render", frame=1)
    lamp.hide_render = False
    lamp.keyframe_insert("hide_render", frame=2)
    scene.frame_start, scene.frame_end = 1, 2
    bpy.ops.render.render(animation=True)
    assert warned("nothing lights the scene")


def test_a_viewport_takes_back_what_its_whole_picture_no_longer_says(monkeypatch):
    views, messages = part("addon.viewport.views"), part("addon.messages")
    monkeypatch.setattr(views.draw, "strip", lambda *_: None)
    messages.history.clear()
    viewport = views.ViewportState()

    def show(fraction: float, *texts: str) -> list[str]:
        passes = part("drgs_blender.ipc.protocol").Passes(
            {"Combined": np.zeros((2, 3, 4), np.float32)}, list(texts), {}
        )
        views._upload(viewport, part("addon.viewport.worker").Picture(object(), passes, fraction, 0.0))
        return warned()

    assert show(0.0, "dark", "coarse") == ["dark", "coarse"]
    assert show(0.0, "dark") == ["dark", "coarse"], "a coarse picture knows less"
    assert show(0.5, "dark") == ["dark"]
    assert show(1.0, "dark") == ["dark"]
    assert show(1.0) == []
    assert show(1.0, "dark") == ["dark"], "it may come again"
