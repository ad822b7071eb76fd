"""Render presets: those that come with the extension, and the user's own."""

from __future__ import annotations

from pathlib import Path

import bpy

#: Below the folders in which Blender looks for presets.
FOLDER = "drgs/render"
#: What a preset sets, of `settings = bpy.context.scene.drgs`.
VALUES = (
    "samples",
    "use_strategy_samples",
    "cosine_samples",
    "ggx_samples",
    "environment_samples",
    "bounces",
    "use_noise_threshold",
    "noise_threshold",
    "clamp_indirect",
    "filter_glossy",
    "subpixel_samples",
    "denoise",
)
_ROOT = str(Path(__file__).parent)


def register() -> None:
    bpy.utils.register_preset_path(_ROOT)


def unregister() -> None:
    bpy.utils.unregister_preset_path(_ROOT)
