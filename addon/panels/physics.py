"""Physics properties: what a DR-GS object is made of, what acts on it, and its bake."""

from __future__ import annotations

import os

import bpy

from ...drgs_blender.core.errors import DrgsError
from ...drgs_blender.core.sim_materials import MATERIALS
from .. import assets
from ..physics import bake_job, bake_time, cache_state, coupling, particle_display, settings_export
from ..physics_materials import numbers_of
from ..physics_settings import DrgsPhysicsRegion, DrgsPhysicsSettings
from .text_layout import bar_text, wrapped


class _Physics:
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "physics"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object)


class _Part(_Physics):
    bl_parent_id = "DRGS_PT_physics"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object) and context.object.drgs.physics.use


def _column(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    layout.use_property_split = True
    return layout.column()


def _draw_material(layout: bpy.types.UILayout, settings: DrgsPhysicsSettings | DrgsPhysicsRegion) -> None:
    layout.prop(settings, "material")
    for name in numbers_of(settings.material):
        layout.prop(settings, name)


def _draw_group(
    layout: bpy.types.UILayout, settings: DrgsPhysicsSettings | DrgsPhysicsRegion, name: str, obj: bpy.types.Object
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
    button = line.operator("drgs.physics_row", text="", icon="X", emboss=False)
    button.rows, button.remove = rows, index
    return column


def _draw_add(layout: bpy.types.UILayout, rows: str, text: str) -> None:
    button = layout.operator("drgs.physics_row", text=text, icon="ADD")
    button.rows, button.remove = rows, -1


class DRGS_PT_physics(_Physics, bpy.types.Panel):
    bl_label = "DR-GS Physics"

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.object.drgs.physics, "use", text="")

    def draw(self, context: bpy.types.Context) -> None:
        obj = context.object
        physics = obj.drgs.physics
        column = _column(self.layout)
        column.active = physics.use
        _draw_material(column, physics)
        column.prop(physics, "solver")
        column.prop(physics, "resolution")
        column.prop(physics, "surface")
        column.prop(physics, "driven_by")
        column.prop(physics, "tear")
        if MATERIALS[physics.material].keeps_shape:
            inside = column.column()
            inside.active = physics.tear
            inside.prop(physics, "inside")
            if physics.inside == "own":
                for name in ("inside_colour", "inside_roughness", "inside_metallic"):
                    inside.prop(physics, name)
        if MATERIALS[physics.material].grain:
            column.prop(physics, "grain")
        row = self.layout.row(align=True)
        row.operator("drgs.show_particles", icon="POINTCLOUD_DATA")
        fill = particle_display.of(obj)
        if fill is not None:
            row.operator("drgs.hide_particles", text="", icon="X")
            render = context.scene.render
            cores = render.threads if render.threads_mode == "FIXED" else os.cpu_count() or 1
            least = bake_time.clock(bake_time.estimate(physics, fill.counts, cores))
            column = self.layout.column(align=True)
            column.label(text=f"{fill.counts[0]:,} particles, {fill.counts[1]} steps per frame")
            column.label(text=f"At least {least} to bake")
        _draw_bake(self.layout, context)


def _draw_bake(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button that fits what is baked, or how far it is."""
    obj = context.object
    if not obj.drgs.physics.use:
        return
    now = bake_job.of(obj)
    if now is not None:
        part, text = now.progress()
        text = bar_text(layout, context, text, part, percent=False)
        row = layout.row(align=True)
        row.progress(factor=part, text=text)
        row.operator("drgs.cancel_physics", text="", icon="CANCEL")
        return
    if bake_job.is_waiting(obj):
        row = layout.row(align=True)
        row.label(text="Waits for the bakes before it", icon="TIME")
        row.operator("drgs.cancel_physics", text="", icon="CANCEL")
        for other in bake_job.running.values():
            part, text = other.progress()
            text = bar_text(layout, context, f"{other.subject}: {text}", part, percent=False)
            layout.progress(factor=part, text=text)
        return
    try:
        found = cache_state.cached(obj, context.scene)
        together = coupling.members(obj)[1:]
    except DrgsError as error:
        layout.label(text=str(error), icon="ERROR")
        return
    if together and (problem := coupling.problem_of(obj)):
        wrapped(layout, context, problem, "ERROR")
    for name in found.missing:
        layout.label(text=f'"{name}" has no frames', icon="ERROR")
    elsewhere = settings_export.played_elsewhere(obj)
    if elsewhere is not None:
        wrapped(layout, context, f"Plays the frames of {elsewhere} until it is baked", "INFO")
    row = layout.row(align=True)
    count = sum(coupling.count_of(other) for other in bake_job.chosen(context))
    more = f" {count} Objects" if count > 1 else ""
    if not found.frames and not found.missing:
        row.operator("drgs.bake_physics", text=f"Bake{more}", icon="REC")
        if elsewhere is not None:
            row.operator("drgs.free_physics", text="", icon="TRASH")
        return
    if found.changed:
        layout.label(text="Settings have changed since", icon="INFO")
    if found.changed or found.missing:
        text = "Rebake"
    else:
        text = "Bake" if found.frames >= found.expected else f"Resume ({found.frames} of {found.expected})"
    row.operator("drgs.bake_physics", text=f"Bake{more}" if more else text, icon="REC")
    row.operator("drgs.free_physics", text="", icon="TRASH")


class DRGS_PT_physics_regions(_Part, bpy.types.Panel):
    bl_label = "Regions"

    def draw(self, context: bpy.types.Context) -> None:
        obj = context.object
        for i, region in enumerate(obj.drgs.physics.regions):
            column = _column(_draw_rows(self.layout, "regions", i))
            _draw_group(column, region, "group", obj)
            _draw_material(column, region)
        _draw_add(self.layout, "regions", "Add Region")


class DRGS_PT_physics_forces(_Part, bpy.types.Panel):
    bl_label = "Forces and Pins"

    def draw(self, context: bpy.types.Context) -> None:
        physics = context.object.drgs.physics
        column = _column(self.layout)
        _draw_group(column, physics, "pin_group", context.object)
        column.prop(physics, "gravity")
        column.prop(physics, "fields")
        column.prop(physics, "field_collection", text="Collection")
        column.prop(physics, "wind")
        drag = column.column()
        drag.active = any(physics.wind)
        drag.prop(physics, "drag")
        column.prop(physics, "damping")
        column.prop(physics, "velocity")
        column.prop(physics, "spin")


class DRGS_PT_physics_colliders(_Part, bpy.types.Panel):
    bl_label = "Colliders"

    def draw(self, context: bpy.types.Context) -> None:
        physics = context.object.drgs.physics
        for i, collider in enumerate(physics.colliders):
            column = _column(_draw_rows(self.layout, "colliders", i))
            for name in ("object", "collection", "contact"):
                column.prop(collider, name)
            friction = column.column()
            friction.active = collider.contact == "separate"
            friction.prop(collider, "friction")
            column.prop(collider, "thickness")
        _draw_add(self.layout, "colliders", "Add Collider")
        column = _column(self.layout)
        column.prop(physics, "use_floor")
        if physics.use_floor:
            column.prop(physics, "floor")
            column.prop(physics, "floor_contact")
            friction = column.column()
            friction.active = physics.floor_contact == "separate"
            friction.prop(physics, "floor_friction")


class DRGS_PT_physics_coupling(_Part, bpy.types.Panel):
    bl_label = "Coupled Bodies"

    def draw(self, context: bpy.types.Context) -> None:
        obj = context.object
        physics = obj.drgs.physics
        column = _column(self.layout)
        column.prop(physics, "coupling")
        column.prop(physics, "contact")
        friction = column.column()
        friction.active = physics.contact == "separate"
        friction.prop(physics, "friction")
        try:
            others = [other for other in coupling.members(obj) if other != obj]
        except DrgsError as error:
            wrapped(self.layout, context, str(error), "ERROR")
            return
        column = self.layout.column(align=True)
        if others:
            column.label(text="Baked together with:")
        for other in others:
            column.label(text=other.name, icon="PHYSICS")
        for other in coupling.idle(obj):
            wrapped(column, context, f"{other.name} has no DR-GS Physics; it can be a collider", "INFO")


class DRGS_PT_physics_cache(_Part, bpy.types.Panel):
    bl_label = "Domain and Cache"

    def draw(self, context: bpy.types.Context) -> None:
        physics = context.object.drgs.physics
        column = _column(self.layout)
        for name in ("domain", "walls", "frame_start", "frame_end", "folder", "seed"):
            column.prop(physics, name)


CLASSES = (
    DRGS_PT_physics,
    DRGS_PT_physics_regions,
    DRGS_PT_physics_forces,
    DRGS_PT_physics_colliders,
    DRGS_PT_physics_coupling,
    DRGS_PT_physics_cache,
)
