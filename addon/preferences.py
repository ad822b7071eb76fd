"""Preferences: where the engine is."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import IntProperty, StringProperty

#: Root package of the extension, the key of its preferences.
ROOT = __package__.rpartition(".")[0]


class DrgsPreferences(bpy.types.AddonPreferences):
    """Settings of this computer."""

    bl_idname = ROOT

    engine_python: StringProperty(
        name="Engine Python",
        description=(
            "Python interpreter of the environment in which the DR-GS engine is installed. "
            "Empty: the one that Set Up Engine made. The variable DRGS_ENGINE comes first"
        ),
        subtype="FILE_PATH",
    )
    threads: IntProperty(
        name="Threads", description="Processor threads the engine uses; 0 is all of them", min=0, soft_max=64, default=0
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "engine_python")
        layout.prop(self, "threads")
        from .panels.tour import draw_engine

        draw_engine(layout, context, always=True)
        row = layout.row()
        row.operator("drgs.engine_test", icon="CHECKMARK")
        row.operator("drgs.engine_stop", icon="CANCEL")


def read(name: str, default: Any) -> Any:
    """One preference; `default` where the extension runs without stored preferences (a test, a bare script)."""
    addon = bpy.context.preferences.addons.get(ROOT)
    return getattr(addon.preferences, name, default) if addon and addon.preferences else default


def write(name: str, value: Any) -> bool:
    """Set one preference; return whether there are any."""
    addon = bpy.context.preferences.addons.get(ROOT)
    if addon is None or addon.preferences is None:
        return False
    setattr(addon.preferences, name, value)
    return True


def register() -> None:
    bpy.utils.register_class(DrgsPreferences)


def unregister() -> None:
    bpy.utils.unregister_class(DrgsPreferences)
