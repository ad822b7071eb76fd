"""Light linking of a scene -> numbers of lights and bits of objects, as `frame.Visibility` has them.

A collection of Blender's light linking says by each of its members whether that is included or excluded: with any
member included, these alone belong to it, else all objects but the excluded ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import bpy

from .instances import Visible

Warn = Callable[[str], None]

#: Collections of receivers and of blockers that a frame has room for, see `render.scene.ray_masks` in the engine.
_MOST = {"receiver": 62, "blocker": 6}
_WORDS = {"receiver": "light linking", "blocker": "shadow linking"}


@dataclass(frozen=True, slots=True)
class _Members:
    """Objects of a linking collection, by their addresses."""

    included: frozenset[int]
    excluded: frozenset[int]

    def __contains__(self, address: int) -> bool:
        return (not self.included or address in self.included) and address not in self.excluded


class LightLinks:
    """The light linking of all objects of a depsgraph."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, warn: Warn) -> None:
        #: Of each kind: number of a collection by its address, and the members by number.
        self._numbers: dict[str, dict[int, int]] = {"receiver": {}, "blocker": {}}
        self._members: dict[str, list[_Members]] = {"receiver": [], "blocker": []}
        for datablock in depsgraph.ids:
            if isinstance(datablock, bpy.types.Object):
                self._add(datablock.original, warn)

    def _add(self, obj: bpy.types.Object, warn: Warn) -> None:
        for kind, numbers in self._numbers.items():
            collection = getattr(obj.light_linking, f"{kind}_collection")
            if collection is None or collection.as_pointer() in numbers:
                continue
            if len(numbers) == _MOST[kind]:
                warn(f'"{obj.name}": more than {_MOST[kind]} collections of {_WORDS[kind]}; it is not rendered there')
                continue
            numbers[collection.as_pointer()] = len(numbers)
            members = _members(collection)
            self._members[kind].append(members)
            if kind == "blocker" and members.excluded and not members.included:
                warn(
                    f'"{obj.name}": mirrors and glass show the objects that its shadow linking excludes, where Cycles '
                    "shows the light behind them. Include those that block it instead, or keep them out of the way"
                )

    def __bool__(self) -> bool:
        return any(self._numbers.values())

    def numbers_of(self, item: Visible) -> dict[str, Any]:
        """Fields of `frame.Light` and `frame.MeshState` for what an instance sends out."""
        links = _linked(item).light_linking
        found = {}
        for kind, numbers in self._numbers.items():
            collection = getattr(links, f"{kind}_collection")
            found[f"{kind}s"] = -1 if collection is None else numbers.get(collection.as_pointer(), -1)
        return found

    def marked(self, item: Visible) -> Visible:
        """The instance with its bits."""
        if not self:
            return item
        address = _linked(item).as_pointer()
        lit_by, blocks = (
            sum(1 << i for i, members in enumerate(self._members[kind]) if address in members)
            for kind in ("receiver", "blocker")
        )
        return replace(item, visibility=replace(item.visibility, lit_by=lit_by, blocks=blocks))


def _linked(item: Visible) -> bpy.types.Object:
    """Whose linking counts: as in Cycles that of what makes the instance."""
    return item.parent if item.parent is not None else item.object.original


def _members(collection: bpy.types.Collection) -> _Members:
    included: set[int] = set()
    excluded: set[int] = set()
    for address, state in _states(collection):
        (included if state == "INCLUDE" else excluded).add(address)
    return _Members(frozenset(included), frozenset(excluded))


def _states(collection: bpy.types.Collection) -> Iterator[tuple[int, str]]:
    """Address and state of each object; those of a collection in it have the state of that."""
    for member, child in zip(collection.collection_children, collection.children):
        for obj in child.all_objects:
            yield obj.as_pointer(), member.light_linking.link_state
    for member, obj in zip(collection.collection_objects, collection.objects):
        yield obj.as_pointer(), member.light_linking.link_state
