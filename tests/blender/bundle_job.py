"""In a Blender of its own, with a fresh profile and offline: install a zip, import an asset, render it.

    python bundle_job.py '{"zip": ..., "asset": ..., "picture": ..., "denoise": "none"}'

Prints a line of JSON: which engine was used, what the panel said of it, and the seconds of each step.
"""

import importlib
import json
import sys
import time

import bpy

PACKAGE = "bl_ext.user_default.drgs"


def main() -> None:
    job = json.loads(sys.argv[1])
    assert not bpy.app.online_access
    seconds, begin = {}, time.perf_counter()

    def lap(name: str) -> None:
        nonlocal begin
        seconds[name], begin = time.perf_counter() - begin, time.perf_counter()

    bpy.ops.extensions.package_install_files(filepath=job["zip"], repo="user_default", enable_on_install=True)
    lap("install")
    link, bundle, workflow = (
        importlib.import_module(f"{PACKAGE}.addon.{n}") for n in ("engine_link", "engine_bundle", "workflow")
    )
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    bpy.ops.import_scene.drgs(filepath=job["asset"])
    scene.world = bpy.data.worlds.new("World")
    scene.world.color = 0.5, 0.6, 0.7
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.location, scene.camera.rotation_euler = (0, -5, 0), (1.5707963, 0, 0)
    scene.collection.objects.link(scene.camera)
    scene.render.engine = "DRGS"
    scene.render.resolution_x, scene.render.resolution_y = 96, 64
    scene.drgs.denoise = job["denoise"]
    if bpy.app.version >= (5, 0, 0):
        scene.render.image_settings.media_type = "IMAGE"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = job["picture"]
    lap("import")
    problem = link.problem()
    if not problem:
        bpy.ops.render.render(write_still=True)
        lap("render")
    found = {
        "origin": link.origin(),
        "described": link.described(),
        "problem": problem,
        "fault": bundle.fault(),
        "command": [] if problem else link.command_line(),
        "doctor": "" if problem else importlib.import_module(f"{PACKAGE}.operators.report").engine(),
        "open": [step.key for step in workflow.steps(bpy.context) if step.needed and not step.done],
        "seconds": seconds,
    }
    print("JOB " + json.dumps(found), flush=True)
    bpy.ops.preferences.addon_disable(module=PACKAGE)
    sys.stdout.flush()
    importlib.import_module("os")._exit(0)  # Blender 4.2 as a module crashes when Python tidies up after it


if __name__ == "__main__":
    main()
