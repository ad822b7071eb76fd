"""Operator on bakes: what Cycles makes of worlds and materials in the background."""

from __future__ import annotations

import bpy

from ..addon import bakes
from .base import DrgsOperator


class DRGS_OT_bakes_cancel(DrgsOperator, bpy.types.Operator):
    """Stop baking worlds and materials. They are approximated until they change, or a picture is rendered"""

    bl_idname = "drgs.bakes_cancel"
    bl_label = "Cancel Baking"

    def run(self, context: bpy.types.Context) -> set[str]:
        bakes.manager.cancel()
        return {"FINISHED"}


CLASSES = (DRGS_OT_bakes_cancel,)
