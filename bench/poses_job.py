"""Runs inside Blender's Python: meshes as Blender's importers number them, bent and rendered by Cycles.

    .venv-blender/bin/python bench/poses_job.py JOB.json

The job lists files; for each the bent vertices are written in the importer's order and the file's axes, and pictures of
the bent mesh in one grey, one per seed, see `cycles_job.render`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from cycles_job import add_camera, add_world, plain_shading, render, reset


def imported(path: Path) -> list[bpy.types.Object]:
    """Mesh objects of a file, in the order in which they were made."""
    if path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
    return [obj for obj in bpy.data.objects if obj.type == "MESH" and len(obj.data.polygons)]


def bent(points: np.ndarray) -> np.ndarray:
    """Twist around and bend along the longest axis."""
    low, high = points.min(0), points.max(0)
    size = float((high - low).max())
    axis = int((high - low).argmax())
    p, q = (axis + 1) % 3, (axis + 2) % 3
    x = (points - (low + high) / 2) / size
    turn = 0.9 * x[:, axis]
    moved = x.copy()
    moved[:, p] = np.cos(turn) * x[:, p] - np.sin(turn) * x[:, q] + 0.35 * x[:, axis] ** 2
    moved[:, q] = np.sin(turn) * x[:, p] + np.cos(turn) * x[:, q]
    return moved * size + (low + high) / 2


def main(path: str) -> None:
    for job in json.loads(Path(path).read_text()):
        scene = reset()
        objects = imported(Path(job["file"]))
        places = [np.array(obj.matrix_world) for obj in objects]
        local = []
        for obj in objects:
            own = np.empty((len(obj.data.vertices), 3), np.float32)
            obj.data.vertices.foreach_get("co", own.ravel())
            local.append(own)
        in_file = job["file"].endswith(".obj")  # of glTF nodes place the parts
        starts = np.cumsum([0, *map(len, local)])
        whole = np.concatenate([v if in_file else v @ m[:3, :3].T + m[:3, 3] for v, m in zip(local, places)]).astype(
            np.float64
        )
        np.save(job["rest"], whole.astype(np.float32))
        pose = bent(whole).astype(np.float32)
        np.save(job["pose"], pose)
        grey = bpy.data.materials.new("grey")
        grey.use_nodes = True
        inputs = grey.node_tree.nodes["Principled BSDF"].inputs
        inputs["Base Color"].default_value, inputs["Roughness"].default_value = (0.6, 0.6, 0.6, 1), 0.5
        for obj, matrix, start, stop in zip(objects, places, starts, starts[1:]):
            obj.animation_data_clear()
            for modifier in list(obj.modifiers):
                obj.modifiers.remove(modifier)
            inverse = np.eye(4) if in_file else np.linalg.inv(matrix)
            own = pose[start:stop] @ inverse[:3, :3].T + inverse[:3, 3]
            mesh = obj.data
            if mesh.shape_keys:
                obj.shape_key_clear()
            if "custom_normal" in mesh.attributes:
                mesh.attributes.remove(mesh.attributes["custom_normal"])
            mesh.vertices.foreach_set("co", np.ascontiguousarray(own, np.float32).ravel())
            mesh.shade_smooth()
            mesh.materials.clear()
            mesh.materials.append(grey)
            mesh.polygons.foreach_set("material_index", [0] * len(mesh.polygons))
            mesh.update()
        plain_shading()
        if job["renders"]:
            add_world(scene, job["environment"], 0.0, job["strength"])
            add_camera(scene, job["camera"])
        for picture in job["renders"]:
            pixels, _ = render(scene, job | picture)
            np.save(picture["out"], pixels)


if __name__ == "__main__":
    main(sys.argv[1])
