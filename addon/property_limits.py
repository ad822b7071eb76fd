"""Settings clamped to their limits, as old files and scripts may hold any value; changes tag the object."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy


class Limited:
    """The values of a property group; one that is out of its limits, or unknown, is replaced and warned of.

    Parameters
    ----------
    subject : whose settings they are
    """

    def __init__(self, group: bpy.types.PropertyGroup, subject: str, warn: Callable[[str], None]) -> None:
        self._group, self._subject, self._warn = group, subject, warn

    def __getattr__(self, name: str) -> Any:
        value, prop = getattr(self._group, name), self._group.bl_rna.properties[name]
        kept = value
        if prop.type == "ENUM":
            kept = value or prop.default  # Blender has no name for an unknown one
        elif prop.type in ("INT", "FLOAT"):
            parts = tuple(value) if prop.is_array else (value,)
            defaults = tuple(prop.default_array) if prop.is_array else (prop.default,)
            limited = tuple(_limited(part, default, prop) for part, default in zip(parts, defaults))
            if limited != parts:
                kept = limited if prop.is_array else limited[0]
        if kept is not value:
            shown = f"{value:g}" if isinstance(value, float) else "unknown" if value == "" else str(value)
            self._warn(
                f"{self._subject}: {prop.name} is {shown}, which this DR-GS cannot take; {kept} is used. Set it again"
            )
        return kept


def _limited(value: float, default: float, prop: bpy.types.Property) -> float:
    """`value` within the limits of a property; its default where it is no number."""
    if value != value:
        return default
    return value if prop.hard_min <= value <= prop.hard_max else min(max(value, prop.hard_min), prop.hard_max)


def tag_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Update callback: tag the object, so that viewports and exports see changes made by scripts, too."""
    settings.id_data.update_tag(refresh={"OBJECT"})
