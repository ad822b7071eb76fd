"""View layer properties: the passes of the one table."""

from __future__ import annotations

from typing import Any

import bpy

from ...drgs_blender.core.passes import PASSES
from ..properties import switch_of
from ..view_layer_passes import label


class DRGS_PT_passes(bpy.types.Panel):
    bl_label = "Passes"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "view_layer"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        view_layer = context.view_layer
        layout.prop(view_layer.drgs, "others")
        column = layout.column(heading="Include")
        switches: dict[str, tuple[Any, str]] = {}  # one for all passes of a kind
        for p in PASSES:
            owner, name = (view_layer, p.blender) if p.blender else (view_layer.drgs, switch_of(p))
            switches.setdefault(name, (owner, label(p).removesuffix("00")))
        for name, (owner, text) in switches.items():
            column.prop(owner, name, text=text)


CLASSES = (DRGS_PT_passes,)
