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


def test_what_holds_of_a_whole_animation_is_told_once(scene, ball):
    """Also where it is of another number of things in every frame; of other objects it is another message."""
    messages = part("addon.messages")
    messages.clear()
    messages.begin_render()
    printed = []
    for frame in range(3):
        warn = messages.Warnings(messages.warned, printed.append)
        for text in (f"ball: {frame + 7} faces have no area", f"Cube.00{frame}: 2 faces", f'"A 1": image {frame}.png'):
            warn(text)
        messages.end_picture()
    told = ["ball: 7 faces have no area", *(f"Cube.00{i}: 2 faces" for i in range(3))]
    told += [f'"A 1": image {i}.png' for i in range(3)]
    assert sorted(printed) == sorted(warned()) == sorted(told)
    # A picture by itself says all that it has, and a loop of pictures leaves one line of each in the panel.
    for _ in range(3):
        messages.begin_render()
        warn = messages.Warnings(messages.warned)
        for text in ("ball: 3 images", "ball: 4 images", "ball: shown by its particles"):
            warn(text)
        messages.end_picture()
        assert sorted(warned()) == ["ball: 3 images", "ball: 4 images", "ball: shown by its particles"]


def test_a_viewport_takes_back_what_its_whole_picture_no_longer_says(monkeypatch):
    views, messages = part("addon.viewport.views"), part("addon.messages")
    monkeypatch.setattr(views.draw, "strip", lambda *_: None)
    messages.clear()
    viewport, other = views.ViewportState(), views.ViewportState()

    def show(fraction: float, *texts: str, viewport=viewport) -> list[str]:
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
    assert show(1.0, "dark", viewport=other) == ["dark"], "it is said once"
    assert show(1.0) == ["dark"], "another viewport has it still"
    assert show(1.0, viewport=other) == []
    show(1.0, "dark")
    monkeypatch.setitem(views._viewports, "gone", viewport)
    views.forget()
    assert warned() == [], "with its viewport"


def test_a_render_takes_back_only_what_no_viewport_has():
    messages = part("addon.messages")
    messages.clear()
    messages.begin_render()
    messages.Warnings(messages.warned)("dark")
    messages.end_picture()
    messages.own("viewport", ["dark"])
    messages.begin_render()
    messages.end_picture()
    assert warned() == ["dark"]
    messages.own("viewport", [])
    assert warned() == []


def test_what_an_export_of_the_viewport_warns_of_leaves_when_it_is_mended(scene, ball):
    scenes = part("addon.viewport.scenes")
    light = bpy.data.lights.new("Bad", "POINT")
    light.energy = float("nan")
    obj = bpy.data.objects.new("Bad", light)
    scene.collection.objects.link(obj)

    def export() -> list[str]:
        graph = bpy.context.evaluated_depsgraph_get()
        scenes.changed(graph)
        scenes.exported(graph)
        return warned('Light "Bad"')

    assert len(export()) == 1 and len(export()) == 1
    bpy.data.objects.remove(obj)
    assert export() == []
