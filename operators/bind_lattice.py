"""Bind to Lattice: a lattice around the selected objects, or a selected one, bends them."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import IntVectorProperty

from ..addon import assets
from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator

#: The lattice is larger than what it bends: a point on its border would be bent on one side only.
MARGIN = 1.05


class DRGS_OT_bind_to_lattice(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Let a lattice bend the selected DR-GS objects: the one that is selected too, or a new one around them all"""

    bl_idname = "drgs.bind_to_lattice"
    bl_label = "Add Lattice"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    points: IntVectorProperty(
        name="Points",
        description="Points of a new lattice along each axis; more bend finer",
        size=3,
        min=2,
        max=64,
        default=(3, 3, 3),
        subtype="XYZ",
    )

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context))
        lattices = list(selection.of_type(context.selected_objects, "LATTICE"))
        if len(lattices) > 1:
            raise UsageError("Selection", f"holds {len(lattices)} lattices", "Select one, or none for a new one")
        lattice = lattices[0] if lattices else new_lattice(context, objects, tuple(self.points))
        for obj in objects:
            selection.add_modifier(obj, "LATTICE", "DR-GS Lattice", object=lattice)
        selection.select_only(context, [lattice], lattice)
        return {"FINISHED"}


def new_lattice(
    context: bpy.types.Context, objects: list[bpy.types.Object], points: tuple[int, int, int]
) -> bpy.types.Object:
    """A lattice around the undeformed `objects`, with `points` along each axis, in their collection."""
    low, high = selection.bounds(objects)
    data = bpy.data.lattices.new("DR-GS Lattice")
    data.points_u, data.points_v, data.points_w = points
    data.use_outside = False
    lattice = bpy.data.objects.new("DR-GS Lattice", data)
    lattice.location = (low + high) / 2
    lattice.scale = np.maximum((high - low) * MARGIN, 1e-4)
    assets.collection(context).objects.link(lattice)
    return lattice


CLASSES = (DRGS_OT_bind_to_lattice,)
