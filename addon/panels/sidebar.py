"""The DR-GS tab of the 3D viewport's sidebar: import, bind, engine, messages."""

from __future__ import annotations

import textwrap
import time

import bpy

from .. import assets, engine_link, messages
from .object_data import draw_asset

ICONS = {"INFO": "INFO", "WARNING": "ERROR", "ERROR": "CANCEL"}
SHOWN = 8


class _SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "DR-GS"


class DRGS_PT_objects(_SidebarPanel, bpy.types.Panel):
    bl_label = "Objects"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        column = layout.column(align=True)
        column.operator("import_scene.drgs", text="Import Asset", icon="IMPORT")
        column.operator("drgs.import_parts", icon="FILE_NEW")
        if assets.is_drgs(context.object):
            draw_asset(layout.box(), context.object)
        layout.operator("drgs.bind_to_rig", icon="ARMATURE_DATA")


class DRGS_PT_engine(_SidebarPanel, bpy.types.Panel):
    bl_label = "Engine"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        running = engine_link.is_running()
        layout.label(text="Running" if running else "Not running", icon="CHECKMARK" if running else "RADIOBUT_OFF")
        row = layout.row(align=True)
        row.operator("drgs.engine_test")
        row.operator("drgs.engine_stop", text="Stop")


class DRGS_PT_messages(_SidebarPanel, bpy.types.Panel):
    bl_label = "Messages"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        if not messages.history:
            layout.label(text="None")
            return
        column = layout.column(align=True)
        for message in list(messages.history)[: -SHOWN - 1 : -1]:
            stamp = time.strftime("%H:%M", time.localtime(message.time))
            lines = textwrap.wrap(
                f"{stamp} {message.text}", max(24, context.region.width // 8 if context.region else 40)
            )
            for i, line in enumerate(lines):
                column.label(text=line, icon="BLANK1" if i else ICONS[message.level])
        layout.operator("drgs.clear_messages", icon="X")


CLASSES = (DRGS_PT_objects, DRGS_PT_engine, DRGS_PT_messages)
