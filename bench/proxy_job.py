"""Runs inside Blender's Python: a capture without a mesh and the mesh that it shows, both bent by one lattice.

    .venv-blender/bin/python bench/proxy_job.py JOB.json

The job names the asset, the mesh (.npz of vertices and faces) and the checkout. Written are the bent mesh, and the
proxy that Add Proxy Mesh has made, at rest and bent.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

job = json.loads(Path(sys.argv[-1]).read_text())
sys.path.insert(0, str(Path(job["checkout"]) / "tools"))

import bpy  # noqa: E402
import extension  # noqa: E402
import numpy as np  # noqa: E402

archive = extension.build(Path(job["out"]).with_name("drgs.zip"))
bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)
proxies = sys.modules["bl_ext.user_default.drgs.addon.proxies"]
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.import_scene.drgs(filepath=job["asset"])
capture = bpy.context.object
bpy.ops.drgs.add_proxy(faces=job["faces"])
bpy.ops.drgs.bind_to_lattice(points=(3, 3, 4))
lattice = bpy.context.object
arrays = np.load(job["mesh"])
mesh = bpy.data.meshes.new("true")
mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
true = bpy.data.objects.new("true", mesh)
bpy.context.collection.objects.link(true)
true.modifiers.new("Lattice", "LATTICE").object = lattice
for point in lattice.data.points:  # of a unit cube: swept aside by the height, turned, and swollen
    x, y, z = point.co
    up = z + 0.5
    turn = 0.7 * up
    point.co_deform = (
        np.cos(turn) * x - np.sin(turn) * y + 0.55 * up**2,
        np.sin(turn) * x + np.cos(turn) * y,
        z - 0.18 * up**2 + 0.1 * up,
    )
bpy.context.view_layer.update()
depsgraph = bpy.context.evaluated_depsgraph_get()
bent = np.empty((len(mesh.vertices), 3), np.float32)
true.evaluated_get(depsgraph).data.vertices.foreach_get("co", bent.ravel())
proxy = proxies.read(capture.evaluated_get(depsgraph).data)
np.savez(job["out"], bent=bent, rest=proxy.rest, vertices=proxy.vertices, faces=proxy.faces)
