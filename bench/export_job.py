"""Runs inside Blender's Python, for bench_export.py: the same object in frame after frame, timed stage by stage."""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

PACKAGE = "bl_ext.user_default.drgs"


def part(name: str):
    return importlib.import_module(f"{PACKAGE}.{name}")


def build(asset: str) -> bpy.types.Scene:
    """The object with a shape key that bends it, all attributes painted; a picture of few pixels."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.import_scene.drgs(filepath=asset)
    obj = bpy.context.object
    write = part("addon.mesh_arrays").write_channel
    n = len(obj.data.vertices)
    rng = np.random.default_rng(1)
    for channel, width in (("albedo", (n, 3)), ("roughness", (n,)), ("metallic", (n,))):
        write(obj.data, channel, rng.random(width, np.float32))
    obj.shape_key_add(name="Basis")
    bent = obj.shape_key_add(name="Bent")
    places = np.empty(3 * n, np.float32)
    bent.points.foreach_get("co", places)
    places[2::3] = 0.2 * np.sin(6 * places[0::3])
    bent.points.foreach_set("co", places)
    for frame, value in ((1, 0.0), (1000, 1.0)):
        bent.value = value
        bent.keyframe_insert("value", frame=frame)
    scene = bpy.context.scene
    scene.render.engine = "DRGS"
    scene.render.resolution_x = scene.render.resolution_y = 8
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location.z = 3
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.drgs.samples, scene.drgs.denoise = 3, "none"
    return scene


def frames(scene: bpy.types.Scene, repeats: int, viewport: bool) -> dict[str, list[float]]:
    """Seconds of each stage of each frame."""
    export_frame, link = part("addon.export").export_frame, part("addon.engine_link")
    scenes, export_camera = part("addon.viewport.scenes"), part("addon.export.camera").export_camera
    found: dict[str, list[float]] = {name: [] for name in ("evaluation", "export", "transfer", "both")}
    for i in range(repeats + 1):
        clock = [time.perf_counter()]
        scene.frame_set(20 + i)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        clock.append(time.perf_counter())
        if viewport:
            camera = export_camera(scene.camera, scene.render)
            frame = replace(scenes.exported(depsgraph).frame, camera=camera)
        else:
            frame = export_frame(depsgraph, link.load_asset, lambda text: None)
        clock.append(time.perf_counter())
        passes = link.render(frame)
        clock.append(time.perf_counter())
        assert all(getattr(frame.objects[0], name) is not None for name in ("albedo", "roughness", "metallic"))
        if i == 0:  # the engine starts, and maps the asset
            continue
        evaluation, export, render = np.diff(clock)
        transfer = render - passes.statistics["seconds.total"]
        for name, value in zip(found, (evaluation, export, transfer, export + transfer)):
            found[name].append(float(value))
    return found


def main() -> None:
    path = Path(sys.argv[-1])
    job = json.loads(path.read_text())
    importlib.import_module("addon_utils").extensions_refresh()
    bpy.ops.preferences.addon_enable(module=PACKAGE)
    scene = build(job["asset"])
    found = {"blender": bpy.app.version_string}
    found |= {kind: frames(scene, job["repeats"], kind == "viewport") for kind in ("final", "viewport")}
    path.with_suffix(".result").write_text(json.dumps(found))
    part("addon.engine_link").stop()
    sys.stdout.flush()
    os._exit(0)  # some Blenders crash while they unload


main()
