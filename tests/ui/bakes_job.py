"""Runs inside Blender with a window, for test_bakes.py: a procedural world and material in the viewport and in F12."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import found, key, move, part, photograph, settled, where

#: Bytes that only a map of 8192 pixels has.
_LARGE = 200 << 20
#: Results are kept by content: every run has noise of its own.
_SCALE = 3 + time.time() % 1000 / 1000


def procedural(tree: bpy.types.NodeTree, target: bpy.types.NodeSocket, first, second) -> bpy.types.Node:
    """Two colours by a noise with sharp edges into a socket; the noise."""
    noise, sharp, mix = (tree.nodes.new(f"ShaderNode{name}") for name in ("TexNoise", "Math", "Mix"))
    noise.inputs["Scale"].default_value = _SCALE
    sharp.operation, sharp.inputs[1].default_value = "GREATER_THAN", 0.5
    mix.data_type = "RGBA"
    tree.links.new(noise.outputs[0], sharp.inputs[0])
    tree.links.new(sharp.outputs[0], mix.inputs["Factor"])
    inputs = [s for s in mix.inputs if s.type == "RGBA"]
    inputs[0].default_value, inputs[1].default_value = (*first, 1), (*second, 1)
    tree.links.new(next(s for s in mix.outputs if s.type == "RGBA"), target)
    return noise


def build() -> tuple[bpy.types.Node, bpy.types.Node]:
    """A large cube in a world of two blues; the noises of both."""
    scene = bpy.context.scene
    for obj in list(bpy.data.objects):
        if obj.type != "CAMERA":
            bpy.data.objects.remove(obj)
    with hands.context_of():
        bpy.ops.mesh.primitive_cube_add(size=2)
    cube = bpy.context.object
    material = bpy.data.materials.new("Patches")
    material.use_nodes = True
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Roughness"].default_value = 1.0
    cube.data.materials.append(material)
    surface = procedural(material.node_tree, shader.inputs["Base Color"], (0.9, 0.02, 0.02), (0.02, 0.9, 0.02))
    world = scene.world or bpy.data.worlds.new("World")
    scene.world, world.use_nodes = world, True
    background = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND")
    sky = procedural(world.node_tree, background.inputs["Color"], (0.1, 0.2, 1), (0.8, 0.9, 1))
    settings, render = scene.drgs, scene.render
    render.engine = "DRGS"
    settings.bake_world_size, settings.bake_texture_size = "2048", "1024"
    settings.use_strategy_samples, settings.samples = False, 16
    render.resolution_x, render.resolution_y = 480, 270
    scene.view_settings.view_transform = "Standard"
    space = where()[1].spaces.active
    space.overlay.show_overlays, space.show_gizmo = False, False
    return surface, sky


def baking() -> str:
    return part("addon.bakes").manager.status()[0]


def facts() -> list[object]:
    """What of the file bakes could touch."""
    data = bpy.data
    names = [sorted(d.name for d in group) for group in (data.objects, data.images, data.materials, data.worlds)]
    links = [len(tree.links) for tree in (data.materials["Patches"].node_tree, bpy.context.scene.world.node_tree)]
    return [*names, *links, bpy.context.scene.frame_current, data.meshes[0].uv_layers.keys()]


def saved(name: str) -> str:
    path = str(hands.FOLDER / f"{name}.png")
    bpy.data.images["Render Result"].save_render(path)
    return path


def viewport() -> list[str]:
    """What the viewport says now: line of text and messages."""
    views = part("addon.viewport.views")
    return [views.status(views.name_of(where()[2]))[0], *(m.text for m in part("addon.messages").history)]


def wide() -> set[str]:
    """Kept results as large as the map that F12 is not left the time for."""
    folder = part("addon.bakes.store").cache_folder()
    return {path.name for path in folder.iterdir() if path.stat().st_size > _LARGE} if folder.exists() else set()


def rendering() -> bool:
    return bpy.app.is_job_running("RENDER")


def work() -> Iterator[float]:
    surface, sky = build()
    yield 0.5
    before = facts()
    window, _, r = where()
    found["viewport"] = [r.x, window.height - r.y - r.height + 120, r.x + r.width, window.height - r.y]
    where("PROPERTIES")[1].spaces.active.context = "RENDER"
    yield from move(hands.middle())
    with hands.context_of():
        bpy.ops.view3d.view_camera()
    where()[1].spaces.active.shading.type = "RENDERED"
    yield from hands.until(lambda: bool(baking()), "a bake", 60)
    yield from hands.until(lambda: "Baking" in viewport()[0], "the viewport's line", 300)
    found["line"] = viewport()[0]
    yield from photograph("bakes-1-baking")
    yield from hands.until(lambda: not baking(), "the bakes")
    yield from settled()
    yield from photograph("bakes-2-baked")
    yield from cancel(sky)
    yield from final(sky, surface)
    found["same"] = facts() == before
    yield from settled()
    yield from photograph("bakes-5-after")
    found["errors"] = [m.text for m in part("addon.messages").history if m.level == "ERROR"]


def cancel(sky: bpy.types.Node) -> Iterator[float]:
    """Another world; its bake is stopped by the panel's operator."""
    sky.inputs["Scale"].default_value *= 1.1
    yield from hands.until(lambda: bool(baking()), "another bake", 60)
    with hands.context_of("PROPERTIES"):
        found["cancel"] = list(bpy.ops.drgs.bakes_cancel())
    yield from hands.until(lambda: not baking(), "the end of the bake", 30)
    yield from settled()
    found["cancelled"] = [text for text in viewport() if "cancelled" in text]
    yield from photograph("bakes-3-cancelled")


def final(sky: bpy.types.Node, surface: bpy.types.Node) -> Iterator[float]:
    """F12, ended while it bakes, then F12 to its end."""
    large = wide()
    surface.inputs["Scale"].default_value *= 1.1
    bpy.context.scene.drgs.bake_world_size = "8192"  # long enough to be ended
    where()[1].spaces.active.shading.type = "SOLID"
    yield 0.5
    yield from key("F12")
    yield from hands.until(rendering, "F12", 60)
    yield from hands.until(lambda: bool(baking()), "its bake", 60)
    found["waits"] = rendering()
    yield 0.5
    yield from hands.until(lambda: hands.there("IMAGE_EDITOR"), "the window of the picture", 60)
    yield from photograph("bakes-4-waits")
    yield from hands.stop_job(rendering)
    yield from hands.until(lambda: not rendering(), "the end of F12", 30)
    yield from hands.until(lambda: not baking(), "the end of the bake", 30)
    found["left"] = sorted(wide() - large)
    bpy.context.scene.drgs.bake_world_size = "2048"
    yield 0.5
    with hands.context_of("IMAGE_EDITOR"):
        bpy.ops.render.render("INVOKE_DEFAULT")
    yield from hands.until(rendering, "F12 again", 60)
    waited = 0
    while rendering():
        waited += bool(baking())
        yield 0.1
    found["waited"] = waited
    found["final"] = saved("final")
    where()[1].spaces.active.shading.type = "RENDERED"


hands.run(work())
