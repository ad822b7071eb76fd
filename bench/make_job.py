"""Runs inside Blender's Python: glTF files as Blender imports them, with all their materials, rendered by Cycles.

    .venv-blender/bin/python bench/make_job.py JOB.json

The job lists pictures as of `cycles_job.render`, each with the file, a camera and an environment.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from cycles_job import add_camera, add_world, plain_shading, render, reset


def main(path: str) -> None:
    for job in json.loads(Path(path).read_text()):
        scene = reset()
        bpy.ops.import_scene.gltf(filepath=job["file"])
        plain_shading()
        add_world(scene, job["environment"], 0.0, job["strength"])
        add_camera(scene, job["camera"])
        pixels, _ = render(scene, job)
        np.save(job["out"], pixels)


if __name__ == "__main__":
    main(sys.argv[1])
