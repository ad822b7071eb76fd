"""The DR-GS tab of the 3D viewport's sidebar, below the steps: object, engine, messages."""

from __future__ import annotations

import os
import time

import bpy

from ...drgs_blender.core.version import __version__
from .. import assets, engine_link, messages, preferences
from .object_data import draw_asset
from .text_layout import POPOVER, wrapped

ICONS = {"INFO": "INFO", "WARNING": "ERROR", "ERROR": "CANCEL"}
SHOWN = 8


class _SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "DR-GS"


class DRGS_PT_object(_SidebarPanel, bpy.types.Panel):
    bl_label = "Object"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        draw_asset(self.layout, context.object)
        row = self.layout.row(align=True)
        row.operator_menu_enum("drgs.set_material", "preset", icon="MATERIAL")
        row.operator("drgs.restore_material", text="", icon="LOOP_BACK")
        row.operator("drgs.copy_material", text="", icon="COPYDOWN")
        self.layout.operator_menu_enum("drgs.paint", "channel", icon="BRUSH_DATA")
        column = self.layout.column(align=True)
        column.prop(context.object.drgs, "show_captured", toggle=True, icon="HIDE_OFF")
        column.prop(context.object.drgs, "captured_colours", toggle=True, icon="POINTCLOUD_DATA")
        column = self.layout.column(align=True)
        column.operator("drgs.save_asset", icon="FILE_TICK")
        column.operator("drgs.save_shape", icon="MESH_DATA")
        column.operator("drgs.swap_mesh", icon="MOD_REMESH")
        column.operator("drgs.bake_light", icon="RENDER_RESULT")


class DRGS_PT_engine(_SidebarPanel, bpy.types.Panel):
    bl_label = "Engine"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        running = engine_link.is_running()
        state = "Running" if running else "Not running"
        layout.label(text=f"{state}, version {__version__}", icon="CHECKMARK" if running else "RADIOBUT_OFF")
        threads = preferences.read("threads", 0) or os.cpu_count()
        layout.label(text=f"CPU, {threads} threads", icon="BLANK1")
        last = engine_link.statistics
        if last:
            seconds, samples = last.get("seconds.total", 0.0), last.get("samples", 0.0) / 1e6
            wrapped(layout, context, f"Last picture: {seconds:.1f} s, {samples:.1f} million samples", "BLANK1")
        row = layout.row(align=True)
        row.operator("drgs.engine_test")
        row.operator("drgs.engine_stop", text="Stop")


class DRGS_PT_messages(_SidebarPanel, bpy.types.Panel):
    bl_label = "Messages"
    bl_order = 2
    bl_ui_units_x = POPOVER // 20

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        if not messages.history:
            layout.label(text="None")
            return
        column = layout.column(align=True)
        for message in list(messages.history)[: -SHOWN - 1 : -1]:
            stamp = time.strftime("%H:%M", time.localtime(message.time))
            wrapped(column, context, f"{stamp} {message.text}", ICONS[message.level])
            name = messages.named_in(message.text, context.view_layer.objects)
            if name:
                button = column.operator("drgs.select_named", text=f"Select {name}", icon="RESTRICT_SELECT_OFF")
                button.name = name
        row = layout.row(align=True)
        row.operator("drgs.copy_messages", icon="COPYDOWN")
        row.operator("drgs.clear_messages", icon="X")
        layout.operator("drgs.report", icon="TEXT")


CLASSES = (DRGS_PT_object, DRGS_PT_engine, DRGS_PT_messages)
