"""Render properties of other engines: DR-GS over their picture."""

from __future__ import annotations

import bpy

from .. import compositing
from .text_layout import wrapped


class DRGS_PT_compositing(bpy.types.Panel):
    bl_label = "DR-GS"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.engine == compositing.ENGINE:  # after the engine was another one
            return compositing.partner_of(context.scene) is not None or compositing.bereft(context.scene)
        return context.engine in ("CYCLES", "BLENDER_EEVEE", "BLENDER_EEVEE_NEXT")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        partner = compositing.partner_of(context.scene)
        if context.engine == compositing.ENGINE:
            wrapped(layout, context, "DR-GS is composited over this scene, which it renders itself now", "ERROR")
            layout.operator("drgs.clear_compositing", icon="X")
            return
        if partner is None and not compositing.bereft(context.scene):
            wrapped(layout, context, "DR-GS objects rendered by DR-GS, everything else by this engine")
            layout.operator("drgs.set_up_compositing", icon="NODE_COMPOSITING")
            return
        row = layout.row(align=True)
        row.operator("drgs.set_up_compositing", text="Set Up Again", icon="FILE_REFRESH")
        row.operator("drgs.clear_compositing", text="", icon="X")
        if partner is None:
            wrapped(layout, context, "The DR-GS scene was deleted: DR-GS objects are not in the picture", "ERROR")
            return
        if changed := compositing.differences(partner):
            wrapped(layout, context, f"Not in the DR-GS scene yet: {', '.join(changed)}", "ERROR")
        settings = partner.drgs
        for name in ("samples", "denoise", "bounces", "camera_sees", "rays_see"):
            layout.prop(settings, name)
        layout.prop(partner.view_layers[0].drgs, "others")


CLASSES = (DRGS_PT_compositing,)
