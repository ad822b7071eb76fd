"""Blender's force fields as the engine reads them (docs/simulation.md): which act on an object, and how in a frame."""

from __future__ import annotations

from typing import Any

import bpy

from .. import messages

#: Type of a field in Blender -> in the engine; the others play no part.
KINDS = {"FORCE": "force", "WIND": "wind", "VORTEX": "vortex", "TURBULENCE": "turbulence"}
_SHAPES = {"PLANE": "plane", "LINE": "line"}
_SIDES = {"BOTH": "both", "POSITIVE": "above", "NEGATIVE": "below"}


def fields_on(obj: bpy.types.Object, scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Objects whose fields act on `obj`; says which are of a type that the engine does not know."""
    physics = obj.drgs.physics
    if physics.fields == 0:
        return []
    among = physics.field_collection.all_objects if physics.field_collection else scene.objects
    found = []
    for other in among:
        field = other.field
        if other == obj or field is None or field.type == "NONE" or not field.apply_to_location:
            continue
        if not other.visible_get():  # Blender's own simulations leave hidden fields out as well
            continue
        if field.type in KINDS:
            found.append(other)
        else:
            known = ", ".join(name.title() for name in KINDS)
            subject = f'Object "{other.name}": its field ({field.type.title()})'
            messages.note("WARNING", f"{subject} has no effect in DR-GS Physics; {known} have")
    return found


def describe_field(other: bpy.types.Object) -> dict[str, Any]:
    """The settings of a force field that are the same in every frame."""
    field = other.field
    data: dict[str, Any] = {
        "kind": KINDS[field.type],
        "shape": _SHAPES.get(field.shape, "point"),
        "falloff": field.falloff_type.lower(),
        "side": _SIDES[field.z_direction],
        "power": _number(field.falloff_power),
        "radial": _number(field.radial_falloff),
        "size": _number(field.size) or 1.0,
    }
    limits = {
        "nearest": (field.use_min_distance, field.distance_min),
        "farthest": (field.use_max_distance, field.distance_max),
        "inner": (field.use_radial_min, field.radial_min),
        "outer": (field.use_radial_max, field.radial_max),
    }
    return data | {name: _number(value) for name, (used, value) in limits.items() if used}


def row_of(other: bpy.types.Object, share: float, depsgraph: bpy.types.Depsgraph) -> list[float]:
    """Place, axis, strength and flow as evaluated now, world."""
    evaluated = other.evaluated_get(depsgraph)
    matrix, field = evaluated.matrix_world, evaluated.field
    return [
        *map(_number, matrix.translation), *map(_number, matrix.to_3x3().col[2].normalized()),
        _number(share * field.strength), _number(field.flow),
    ]  # fmt: skip


def _number(value: float) -> float:
    return float(f"{value:.6g}")
