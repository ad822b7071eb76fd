"""How many surfels viewports show while something moves."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, IntProperty

from ..drgs_blender.core.level_of_detail import MOST_SURFELS
from .property_limits import Limited


class LevelOfDetail:
    """Settings of a scene, which `DrgsSceneSettings` has."""

    level_of_detail: EnumProperty(
        name="Level of Detail",
        description="How many surfels viewports show while the view or the scene moves. Views at rest and final frames "
        "always show all",
        items=(
            (
                "AUTOMATIC",
                "Automatic",
                "No more than the picture's pixels can show and Viewport Surfels allows, enlarged to cover as much; "
                "where the mesh is as detailed, the mesh",
            ),
            ("FULL", "Full", "All of them, however long that takes"),
        ),
        default="AUTOMATIC",
        options=set(),
    )
    viewport_surfels: IntProperty(
        name="Viewport Surfels",
        description="Surfels that are shown at most while something moves, of all objects together, and by Splats",
        min=1000,
        soft_min=50_000,
        soft_max=5_000_000,
        max=1_000_000_000,
        default=MOST_SURFELS,
        options=set(),
    )


def most_surfels(scene: bpy.types.Scene) -> int:
    """Surfels that viewports of a scene show at most while something moves; 0: all."""
    own = Limited(scene.drgs, f'Scene "{scene.name}"', lambda text: None)
    return 0 if own.level_of_detail == "FULL" else int(own.viewport_surfels)
