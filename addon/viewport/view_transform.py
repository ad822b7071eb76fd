"""The scene's view transform (tone mapping) as a table, for pictures drawn where Blender expects display colours.

Blender does not give its colour management to scripts, except when it saves an image: a grid of colours is saved once
for every view transform and look, and read back. Exposure and gamma are applied by whoever uses the table.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np

Array = np.ndarray

#: Points a channel; with LOW and HIGH, 1 is one of them, where most view transforms have a corner.
SIZE = 61
#: Stops that the table spans: a channel x lies at (log2(x + 2 ** LOW) - LOW) / (HIGH - LOW).
LOW, HIGH = -10.0, 5.0

Key = tuple[str, str, str]


def key_of(scene: bpy.types.Scene) -> Key:
    """Key of a scene's table: its colour management settings."""
    view = scene.view_settings
    return scene.display_settings.display_device, view.view_transform, view.look


def grid() -> Array:
    """(SIZE ** 2, SIZE, 3) float32: the scene-linear colours of the table; red varies first, then green, then blue."""
    values = np.exp2(LOW + (HIGH - LOW) * np.linspace(0, 1, SIZE)) - np.exp2(LOW)
    blue, green, red = np.meshgrid(values, values, values, indexing="ij")
    return np.stack((red, green, blue), axis=-1).reshape(SIZE * SIZE, SIZE, 3).astype(np.float32)


def table(key: Key) -> Array:
    """(SIZE ** 2, SIZE, 4) float32 colours of the display for those of `grid`. Must not be called while drawing."""
    device, transform, look = key
    scene = bpy.data.scenes.new("DR-GS display")
    image = bpy.data.images.new("DR-GS display", SIZE, SIZE * SIZE, alpha=False, float_buffer=True)
    back = None
    with tempfile.TemporaryDirectory(prefix="drgs-") as folder:
        try:
            scene.display_settings.display_device = device
            scene.view_settings.view_transform = transform
            scene.view_settings.look = look
            settings = scene.render.image_settings
            if hasattr(settings, "media_type"):  # from Blender 5.0 on
                settings.media_type = "IMAGE"
            settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "16"
            settings.compression = 0
            colours = np.ones((SIZE * SIZE, SIZE, 4), np.float32)
            colours[..., :3] = grid()
            image.pixels.foreach_set(colours.ravel())
            path = Path(folder, "display.png")
            image.save_render(str(path), scene=scene)
            back = bpy.data.images.load(str(path))
            back.colorspace_settings.name = "Non-Color"
            found = np.empty(SIZE**3 * 4, np.float32)
            back.pixels.foreach_get(found)
        finally:
            for made in (image, back):
                if made is not None:
                    bpy.data.images.remove(made)
            bpy.data.scenes.remove(scene)
    return found.reshape(SIZE * SIZE, SIZE, 4)
