"""Runs inside Blender's Python: what edits of a large capture take. Arguments: a JSON file of `bench_clean.py`."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

job = json.loads(Path(sys.argv[-1]).read_text())
sys.path.insert(0, str(Path(job["checkout"]) / "tools"))

import bpy  # noqa: E402
import extension  # noqa: E402

PACKAGE = "bl_ext.user_default.drgs"
times: dict[str, float] = {}


def timed(name: str, work: Callable[[], object]) -> None:
    begun = time.perf_counter()
    work()
    times[name] = round(time.perf_counter() - begun, 3)


def export() -> object:
    module = sys.modules[f"{PACKAGE}.addon.export"]
    return module.export_frame(bpy.context.evaluated_depsgraph_get(), str, lambda text: None)


def delete() -> None:
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.ed.undo_push(message="deleted")


archive = extension.build(Path(job["out"]).with_name("drgs.zip"))
bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)
bpy.ops.wm.read_homefile(use_empty=True)
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
bpy.context.scene.collection.objects.link(camera)
bpy.context.scene.camera = camera
bpy.context.scene.render.engine = "DRGS"
timed("import", lambda: bpy.ops.import_scene.drgs(filepath=job["asset"]))
obj = bpy.context.object
timed("export, whole", export)
bpy.ops.ed.undo_push(message="begin")
timed("Edit Surfels: points, Edit Mode", lambda: bpy.ops.drgs.edit_surfels())
bpy.ops.ed.undo_push(message="points")
timed("Select Surfels: floaters", lambda: bpy.ops.drgs.select_surfels(criterion="FLOATERS"))
timed("Select Surfels: size", lambda: bpy.ops.drgs.select_surfels(criterion="SIZE", size=1.0))
timed("Blender's Select Random, a tenth", lambda: bpy.ops.mesh.select_random(ratio=0.1))
timed("Blender's Delete", delete)
timed("undo", lambda: bpy.ops.ed.undo())
bpy.ops.mesh.select_random(ratio=0.1)
bpy.ops.mesh.delete(type="VERT")
timed("Finish, with faces", lambda: bpy.ops.drgs.finish_surfels())
timed("export, without those", export)
Path(job["out"]).write_text(json.dumps(times))
bpy.ops.preferences.addon_disable(module=PACKAGE)
sys.stdout.flush()
os._exit(0)
