"""Render presets: use one, keep the present settings as one."""

from __future__ import annotations

from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bpy.props import StringProperty

from ..addon import presets
from ..drgs_blender.core.errors import UsageError
from .base import DrgsOperator


class DRGS_OT_render_preset(DrgsOperator, bpy.types.Operator):
    """Render with these settings"""

    bl_idname = "drgs.render_preset"
    bl_label = "Render Preset"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        description="File of the preset, in a folder of presets", subtype="FILE_PATH", options={"SKIP_SAVE", "HIDDEN"}
    )
    menu_idname: StringProperty(options={"SKIP_SAVE", "HIDDEN"})

    def run(self, context: bpy.types.Context) -> set[str]:
        path = Path(self.chosen("Render preset"))
        folders = [Path(p).resolve() for p in bpy.utils.preset_paths(presets.FOLDER)]
        if path.suffix != ".py" or path.resolve().parent not in folders:
            raise UsageError(str(path), "is no render preset", "Choose one of the list")
        if not context.scene.is_editable:
            raise UsageError(f'Scene "{context.scene.name}"', "comes from a library", "Make it local")
        try:
            bpy.utils.execfile(str(path))
        except Exception as error:  # whatever a program may raise; of another version, or edited
            problem, remedy = f"cannot be used ({type(error).__name__}: {error})", "Remove it, or keep it once more"
            raise UsageError(str(path), problem, remedy) from error
        text = path.read_text(encoding="utf-8", errors="replace")
        for name in presets.VALUES:
            if f"settings.{name} " not in text:  # the version that kept the preset did not know it
                context.scene.drgs.property_unset(name)
        return {"FINISHED"}


class DRGS_OT_render_preset_add(AddPresetBase, bpy.types.Operator):
    """Keep the present settings as a preset, or remove one"""

    bl_idname = "drgs.render_preset_add"
    bl_label = "Add Render Preset"
    preset_menu = "DRGS_PT_presets"
    preset_subdir = presets.FOLDER
    preset_defines = ("settings = bpy.context.scene.drgs",)
    preset_values = tuple(f"settings.{name}" for name in presets.VALUES)


CLASSES = (DRGS_OT_render_preset, DRGS_OT_render_preset_add)
