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
from . import hair

T = TypeVar("T")
Warn = Callable[[str], None]

#: What has a surface that a picture without it would lack, by the type of the object.
UNRENDERED = {"VOLUME": "volume"}
#: What of it is rendered.
RENDERED = ("MESH", "LIGHT", "CURVES", "POINTCLOUD")
#: At the end of the number in an instance's key: the hair on it.
_HAIR = -1
_SPLATS = "splat"
#: What to do about a kind of them.
_REMEDIES = {_SPLATS: "; Object > Convert > DR-GS makes objects of them that are"}


#: Identifies an instance, at any time: its object, what makes it, its number there (and that of the hair on it).
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
    is_particle_hair : whether it is the hair on the object, not the object
    """

    key: Key
    object: bpy.types.Object
    matrix_world: np.ndarray
    visibility: Visibility
    parent: bpy.types.Object | None = None
    is_particle_hair: bool = False

    @property
    def is_hair(self) -> bool:
        """Whether it consists of strands, or of points."""
        return self.is_particle_hair or self.object.type in ("CURVES", "POINTCLOUD")

    @property
    def is_rendered(self) -> bool:
        """Whether it is something that can be rendered."""
        obj = self.object
        return obj.type not in UNRENDERED and not (obj.type == "POINTCLOUD" and splat_attributes.is_splats(obj.data))


def visible(depsgraph: bpy.types.Depsgraph) -> Iterator[Visible]:
    """Meshes, lights, hair and what cannot be rendered. Valid during the iteration only.

    Curves, texts, surfaces and metaballs appear twice, as themselves and as the mesh they were made into; only the
    mesh is given.
    """
    layer = depsgraph.view_layer
    known: dict[tuple[int, int], Visibility | None] = {}
    for instance in depsgraph.object_instances:
        obj = instance.object
        is_shown = instance.show_self and (obj.type in RENDERED or obj.type in UNRENDERED)
        is_furry = instance.show_particles and _is_furry(instance, depsgraph)
        if not (is_shown or is_furry):
            continue
        parent = instance.parent if instance.is_instance else None
        key = obj.original.as_pointer(), parent.original.as_pointer() if parent else 0
        if key not in known:
            known[key] = _visibility(obj, parent, layer)
        visibility = known[key]
        if visibility is not None:
            number = tuple(instance.persistent_id) if parent else ()
            matrix = np.array(instance.matrix_world, np.float64, order="C")
            maker = parent.original if parent else None
            if is_shown:
                yield Visible((*key, number), obj, matrix, visibility, maker)
            if is_furry:
                yield Visible((*key, (*number, _HAIR)), obj, matrix, visibility, maker, is_particle_hair=True)


def _is_furry(instance: bpy.types.DepsgraphObjectInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether hair grows on an instance: not on what Geometry Nodes make of its object."""
    obj = instance.object
    if next(hair.systems(obj, depsgraph.mode), None) is None:
        return False
    return not instance.is_instance or obj.data == obj.original.evaluated_get(depsgraph).data


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
        """Remember an object of a type in `UNRENDERED`, or splats as points or as vertices."""
        kind = None if assets.shows_anchor(obj) else UNRENDERED.get(obj.type)
        if obj.type == "POINTCLOUD" or (obj.type == "MESH" and not obj.data.polygons):
            kind = _SPLATS if splat_attributes.is_splats(obj.data) else kind
        if kind is not None:
            self._names.setdefault(kind, set()).add(obj.name)

    def report(self, warn: Warn) -> None:
        """One warning per kind."""
        for kind, found in self._names.items():
            objects = "object is" if len(found) == 1 else "objects are"
            names = first_of(sorted(found))
            warn(f"{len(found)} {kind} {objects} not rendered by DR-GS: {names}{_REMEDIES.get(kind, '')}")
