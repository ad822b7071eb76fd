"""Preferences of the extension: where the engine is, and how many threads it uses."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, IntProperty, StringProperty

from .. import preferences
from .engine_setup import draw_engine


class DrgsPreferences(bpy.types.AddonPreferences):
    """Settings of this computer."""

    bl_idname = preferences.ROOT

    engine_python: StringProperty(
        name="Engine Python",
        description=(
            "Python interpreter of the environment in which the DR-GS engine is installed. Empty: the one that Set Up "
            "Engine made, else the engine that came with the extension. The variable DRGS_ENGINE comes first"
        ),
        subtype="FILE_PATH",
    )
    threads: IntProperty(
        name="Threads", description="CPU threads that the engine uses; 0 is all of them", min=0, soft_max=64, default=0
    )

    knows_sidebar: BoolProperty(
        name="Knows the Sidebar",
        description="The headers of 3D viewports need not say any more where DR-GS is",
        default=False,
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "engine_python")
        layout.prop(self, "threads")
        draw_engine(layout, context, always=True)
        row = layout.row()
        row.operator("drgs.engine_test", icon="CHECKMARK")
        row.operator("drgs.engine_stop", icon="CANCEL")


CLASSES = (DrgsPreferences,)
