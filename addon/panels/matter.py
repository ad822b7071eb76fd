"""Physics properties: what a DR-GS object is made of, what acts on it, and its bake."""

from __future__ import annotations

import os

import bpy

from ...drgs_blender.core.errors import DrgsError
from ...drgs_blender.core.sim_materials import MATERIALS
from .. import assets
from ..matter import points, work
from ..matter.properties import DrgsMatterRegion, DrgsMatterSettings, numbers_of
from .tour import bar_text


class _Physics:
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "physics"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object)


class _Part(_Physics):
    bl_parent_id = "DRGS_PT_matter"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object) and context.object.drgs.matter.use


def _column(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    layout.use_property_split = True
    return layout.column()


def _draw_material(layout: bpy.types.UILayout, settings: DrgsMatterSettings | DrgsMatterRegion) -> None:
    layout.prop(settings, "material")
    for name in numbers_of(settings.material):
        layout.prop(settings, name)


def _draw_group(
    layout: bpy.types.UILayout, settings: DrgsMatterSettings | DrgsMatterRegion, name: str, obj: bpy.types.Object
) -> None:
    """A vertex group, or an attribute where there are no groups."""
    if obj.vertex_groups:
        layout.prop_search(settings, name, obj, "vertex_groups")
    else:
        layout.prop_search(settings, name, obj.data, "attributes")


def _draw_rows(layout: bpy.types.UILayout, rows: str, index: int) -> bpy.types.UILayout:
    """A box with a button that removes it."""
    box = layout.box()
    line = box.row()
    column = line.column()
    button = line.operator("drgs.matter_row", text="", icon="X", emboss=False)
    button.rows, button.remove = rows, index
    return column


def _draw_add(layout: bpy.types.UILayout, rows: str, text: str) -> None:
    button = layout.operator("drgs.matter_row", text=text, icon="ADD")
    button.rows, button.remove = rows, -1


class DRGS_PT_matter(_Physics, bpy.types.Panel):
    bl_label = "DR-GS Matter"

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.object.drgs.matter, "use", text="")

    def draw(self, context: bpy.types.Context) -> None:
        obj = context.object
        matter = obj.drgs.matter
        column = _column(self.layout)
        column.active = matter.use
        _draw_material(column, matter)
        column.prop(matter, "solver")
        column.prop(matter, "resolution")
        column.prop(matter, "tear")
        if MATERIALS[matter.material].grain:
            column.prop(matter, "grain")
        row = self.layout.row(align=True)
        row.operator("drgs.preview_matter", icon="POINTCLOUD_DATA")
        fill = points.of(obj)
        if fill is not None:
            row.operator("drgs.hide_preview", text="", icon="X")
            render = context.scene.render
            cores = render.threads if render.threads_mode == "FIXED" else os.cpu_count() or 1
            least = work.clock(work.estimate(matter, fill.counts, cores))
            column = self.layout.column(align=True)
            column.label(text=f"{fill.counts[0]:,} particles, {fill.counts[1]} steps a frame")
            column.label(text=f"At least {least} to bake")
        _draw_bake(self.layout, context)


def _draw_bake(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button that fits what is baked, or how far it is."""
    obj = context.object
    if not obj.drgs.matter.use:
        return
    now = work.of(obj)
    if now is not None:
        part, text = now.progress()
        text = bar_text(layout, context, text, part, percent=False)
        row = layout.row(align=True)
        row.progress(factor=part, text=text)
        row.operator("drgs.cancel_matter", text="", icon="CANCEL")
        return
    if work.is_waiting(obj):
        row = layout.row(align=True)
        row.label(text="Waits for the bakes before it", icon="TIME")
        row.operator("drgs.cancel_matter", text="", icon="CANCEL")
        for other in work.running.values():
            part, text = other.progress()
            text = bar_text(layout, context, f"{other.subject}: {text}", part, percent=False)
            layout.progress(factor=part, text=text)
        return
    try:
        found = work.cached(obj, context.scene)
    except DrgsError as error:
        layout.label(text=str(error), icon="ERROR")
        return
    row = layout.row(align=True)
    count = len(work.chosen(context))
    more = f" {count} Objects" if count > 1 else ""
    if not found.frames:
        row.operator("drgs.bake_matter", text=f"Bake{more}", icon="REC")
        return
    if found.changed:
        layout.label(text="Settings have changed: a bake begins anew", icon="INFO")
        text = "Bake Anew"
    else:
        text = "Bake Again" if found.frames >= found.wanted else f"Resume ({found.frames} of {found.wanted})"
    row.operator("drgs.bake_matter", text=f"Bake{more}" if more else text, icon="REC")
    row.operator("drgs.free_matter", text="", icon="TRASH")


class DRGS_PT_matter_regions(_Part, bpy.types.Panel):
    bl_label = "Regions"

    def draw(self, context: bpy.types.Context) -> None:
        obj = context.object
        for i, region in enumerate(obj.drgs.matter.regions):
            column = _column(_draw_rows(self.layout, "regions", i))
            _draw_group(column, region, "group", obj)
            _draw_material(column, region)
        _draw_add(self.layout, "regions", "Add Region")


class DRGS_PT_matter_forces(_Part, bpy.types.Panel):
    bl_label = "Forces and Pins"

    def draw(self, context: bpy.types.Context) -> None:
        matter = context.object.drgs.matter
        column = _column(self.layout)
        _draw_group(column, matter, "pin_group", context.object)
        column.prop(matter, "gravity")
        column.prop(matter, "fields")
        column.prop(matter, "field_collection")
        column.prop(matter, "wind")
        drag = column.column()
        drag.active = any(matter.wind)
        drag.prop(matter, "drag")
        column.prop(matter, "damping")
        column.prop(matter, "velocity")
        column.prop(matter, "spin")


class DRGS_PT_matter_colliders(_Part, bpy.types.Panel):
    bl_label = "Colliders"

    def draw(self, context: bpy.types.Context) -> None:
        matter = context.object.drgs.matter
        for i, collider in enumerate(matter.colliders):
            column = _column(_draw_rows(self.layout, "colliders", i))
            for name in ("object", "collection", "contact"):
                column.prop(collider, name)
            friction = column.column()
            friction.active = collider.contact == "separate"
            friction.prop(collider, "friction")
            column.prop(collider, "thickness")
        _draw_add(self.layout, "colliders", "Add Collider")
        column = _column(self.layout)
        column.prop(matter, "use_floor")
        if matter.use_floor:
            column.prop(matter, "floor")
            column.prop(matter, "floor_contact")
            friction = column.column()
            friction.active = matter.floor_contact == "separate"
            friction.prop(matter, "floor_friction")


class DRGS_PT_matter_cache(_Part, bpy.types.Panel):
    bl_label = "Space and Cache"

    def draw(self, context: bpy.types.Context) -> None:
        matter = context.object.drgs.matter
        column = _column(self.layout)
        for name in ("domain", "walls", "frame_start", "frame_end", "folder", "seed"):
            column.prop(matter, name)


CLASSES = (
    DRGS_PT_matter,
    DRGS_PT_matter_regions,
    DRGS_PT_matter_forces,
    DRGS_PT_matter_colliders,
    DRGS_PT_matter_cache,
)
