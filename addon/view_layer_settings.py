"""Settings of a view layer, stored in the .blend."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..drgs_blender.core.passes import PASSES, Pass


def switch_of(render_pass: Pass) -> str:
    """Property of `DrgsViewLayerSettings` that switches on a pass Blender does not know."""
    return "use_pass_" + render_pass.name.lower().replace(" ", "_")


class DrgsViewLayerSettings(bpy.types.PropertyGroup):
    """Passes that Blender's own view layer has no switch for."""

    __annotations__ = {  # Blender reads properties from here; they follow the one table
        switch_of(p): BoolProperty(name=p.name, description=p.about, default=False) for p in PASSES if not p.blender
    }
    __annotations__["others"] = EnumProperty(
        name="Other Objects",
        description="What the camera sees of objects that are not DR-GS objects",
        items=(
            ("SEEN", "Visible", "The objects themselves"),
            (
                "CATCHER",
                "Shadow Catchers",
                "Only the shadows on them, and that they hide what is behind; for laying over another engine's picture",
            ),
            ("HOLDOUT", "Holdouts", "Only that they hide what is behind"),
        ),
        default="SEEN",
    )
