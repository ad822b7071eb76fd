"""Visible objects of the view layer: surfaces and lights, instances included, with their ray visibility."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

import bpy
import numpy as np

from ...drgs_blender.core.errors import Cancelled, first_of
from ...drgs_blender.core.frame import Visibility
from .. import assets, splat_attributes

T = TypeVar("T")
Warn = Callable[[str], None]

#: What has a surface that a picture without it would lack, by the type of the object.
UNRENDERED = {"CURVES": "hair", "POINTCLOUD": "point cloud", "VOLUME": "volume"}
_SPLATS = "splat"
#: What to do about a kind of them.
_REMEDIES = {_SPLATS: "; Object > Convert > DR-GS makes objects of them that are"}


#: Identifies an instance, at any time: its object, what makes it, its number there.
Key = tuple[int, int, tuple[int, ...]]


@dataclass(slots=True)
class Keys:
    """Which instance each part of an exported frame is: its objects, each place of its meshes, its lights in front."""

    objects: list[Key] = field(default_factory=list)
    meshes: list[list[Key]] = field(default_factory=list)
    lights: list[Key] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Visible:
    """One visible instance: an evaluated object, where it stands and which rays meet it.

    Attributes
    ----------
    parent : the original object that makes the instance; None for an object itself
    """

    key: Key
    object: bpy.types.Object
    matrix_world: np.ndarray
    visibility: Visibility
    parent: bpy.types.Object | None = None


def visible(depsgraph: bpy.types.Depsgraph) -> Iterator[Visible]:
    """Meshes, lights and what cannot be rendered. Valid during the iteration only.

    Curves, texts, surfaces and metaballs appear twice, as themselves and as the mesh they were made into; only the
    mesh is given.
    """
    layer = depsgraph.view_layer
    known: dict[tuple[int, int], Visibility | None] = {}
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self or not (obj.type in ("MESH", "LIGHT") or obj.type in UNRENDERED):
            continue
        parent = instance.parent if instance.is_instance else None
        key = obj.original.as_pointer(), parent.original.as_pointer() if parent else 0
        if key not in known:
            known[key] = _visibility(obj, parent, layer)
        visibility = known[key]
        if visibility is not None:
            number = tuple(instance.persistent_id) if parent else ()
            matrix = np.array(instance.matrix_world, np.float64, order="C")
            yield Visible((*key, number), obj, matrix, visibility, parent.original if parent else None)


def uncancelled(items: Iterable[T], cancelled: Callable[[], bool] | None) -> Iterator[T]:
    """The `items`, for as long as nobody says `cancelled`; then `Cancelled` is raised."""
    for item in items:
        if cancelled is not None and cancelled():
            raise Cancelled
        yield item


def _visibility(
    obj: bpy.types.Object, parent: bpy.types.Object | None, layer: bpy.types.ViewLayer
) -> Visibility | None:
    """As Cycles reads it: of an instance and of what makes the instances. None where no ray meets it."""
    both = [obj.original] + ([parent.original] if parent is not None else [])
    rays = {
        name: all(getattr(o, f"visible_{name}") for o in both) for name in ("camera", "diffuse", "glossy", "shadow")
    }
    holdout = any(o.holdout_get(view_layer=layer) for o in both)
    if not holdout and both[-1].indirect_only_get(view_layer=layer):
        rays["camera"] = False
    if not any(rays.values()):
        return None
    return Visibility(**rays, holdout=holdout, shadow_catcher=any(o.is_shadow_catcher for o in both))


def terminator_offset(obj: bpy.types.Object, warn: Warn = lambda text: None) -> float:
    """Shadow Terminator Geometry Offset of an object, which before Blender 5.0 was Cycles' own; 0.1 without Cycles."""
    owners = obj, getattr(obj.original, "cycles", None)  # whose changes alone do not evaluate the object again
    for owner in owners:
        if getattr(owner, "shadow_terminator_shading_offset", 0.0) or getattr(owner, "shadow_terminator_offset", 0.0):
            warn(f'"{obj.name}": its Shadow Terminator Shading Offset is not rendered; its Geometry Offset is')
    names = (getattr(owner, "shadow_terminator_geometry_offset", None) for owner in owners)
    return float(next((value for value in names if value is not None), 0.1))


class Unrendered:
    """Counts what is visible and cannot be rendered."""

    def __init__(self) -> None:
        self._names: dict[str, set[str]] = {}

    def add(self, obj: bpy.types.Object) -> None:
        """Remember an object of a type in `UNRENDERED`, splats as points or as vertices, or the hair on another."""
        kind = None if assets.shows_anchor(obj) else UNRENDERED.get(obj.type)
        if obj.type == "POINTCLOUD" or (obj.type == "MESH" and not obj.data.polygons):
            kind = _SPLATS if splat_attributes.is_splats(obj.data) else kind
        if kind is not None:
            self._names.setdefault(kind, set()).add(obj.name)
        elif any(p.settings.type == "HAIR" and p.settings.render_type == "PATH" for p in obj.particle_systems):
            self._names.setdefault("hair", set()).add(obj.name)

    def report(self, warn: Warn) -> None:
        """One warning per kind."""
        for kind, found in self._names.items():
            objects = "object is" if len(found) == 1 else "objects are"
            names = first_of(sorted(found))
            warn(f"{len(found)} {kind} {objects} not rendered by DR-GS: {names}{_REMEDIES.get(kind, '')}")
