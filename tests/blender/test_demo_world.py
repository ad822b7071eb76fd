"""The demo's world: what the camera sees of it as it turns is not blown out, or outlines before it would be jagged.

Of a pixel that an object covers by nine tenths before a wall of radiance 20, white is left.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

DEMO = Path(__file__).resolve().parents[2] / "examples" / "demo_scene.py"


def test_the_background_of_the_demo_is_not_blown_out(scene):
    specification = importlib.util.spec_from_file_location("demo_scene", DEMO)
    demo = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(demo)
    demo.add_turning_world(demo.WORLD)
    demo.add_camera(Vector((0.25, 0.0, 1.9)), 16.5)
    bpy.context.view_layer.update()
    (image,) = [i for i in bpy.data.images if i.name == demo.WORLD]
    width, height = image.size
    radiance = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(radiance)
    radiance = radiance.reshape(height, width, 4)[..., :3].max(axis=2)  # from below upwards
    camera = scene.camera
    half = math.tan(camera.data.angle / 2)
    x, y = np.meshgrid(*[np.linspace(-half, half, 48)] * 2)
    rays = np.stack([x, y, -np.ones_like(x)], -1) @ np.array(camera.matrix_world.to_3x3()).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    row = ((np.arcsin(rays[..., 2]) / math.pi + 0.5) * height).astype(int)
    turn = np.arctan2(rays[..., 1], rays[..., 0]) / (2 * math.pi)
    for frame in range(demo.FRAMES):
        column = ((turn + frame / demo.FRAMES) % 1 * width).astype(int) % width
        seen = radiance[row, column]
        assert (seen > 1).mean() < 0.1 and np.percentile(seen, 99) < 3, frame
