"""The export cache: what earlier exports made, for as long as nothing that it was made of changes.

A viewport exports after every change; only what changed is read again. What is remembered is frozen, so that the
engine's client sees by identity that it need not be sent.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any, TypeVar

import bpy

T = TypeVar("T")

#: Types of datablocks that say how surfaces and the world look; what else changes has no part in that.
SHADING_DATABLOCKS = (bpy.types.Material, bpy.types.NodeTree, bpy.types.Image, bpy.types.Texture, bpy.types.World)
#: First item of the keys of what is made of such datablocks.
SHADED = ("mesh", "world")


def uid(datablock: bpy.types.ID | None) -> int:
    """Identity of a datablock in this run of Blender, the same for its evaluated copies."""
    return 0 if datablock is None else datablock.original.session_uid


class ExportCache:
    """Results by key, each with the datablocks it depends on. An empty one remembers nothing to begin with."""

    def __init__(self) -> None:
        self._known: dict[tuple[Hashable, ...], tuple[frozenset[int], Any]] = {}
        self._used: set[tuple[Hashable, ...]] = set()

    def get(self, key: tuple[Hashable, ...], owners: Iterable[int], make: Callable[[], T]) -> T:
        """The result known under `key`, else that of `make`.

        Parameters
        ----------
        key : starts with the kind of the result
        owners : `uid` of every datablock whose geometry it depends on
        """
        if key not in self._known:
            self._known[key] = frozenset(owners), make()
        self._used.add(key)
        return self._known[key][1]

    def note(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Forget what the changes that `depsgraph` was updated for make wrong."""
        looks, shapes = False, set()
        for update in depsgraph.updates:
            if isinstance(update.id, SHADING_DATABLOCKS):
                looks = True
            elif update.is_updated_geometry:
                shapes.add(uid(update.id))
        if looks or shapes:
            self._known = {
                key: entry
                for key, entry in self._known.items()
                if not (looks and key[0] in SHADED) and shapes.isdisjoint(entry[0])
            }

    def clear(self) -> None:
        """Forget everything."""
        self._known = {}

    def end(self) -> None:
        """An export is over: drop what it did not use."""
        self._known = {key: entry for key, entry in self._known.items() if key in self._used}
        self._used = set()
