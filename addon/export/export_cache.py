"""The export cache: results of earlier exports, until the datablocks that they depend on change.

A viewport exports after every change; only changed datablocks are read again. Cached arrays are frozen, so that the
engine's client recognises by identity what it need not send again.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any, TypeVar

import bpy

from .instances import Keys

T = TypeVar("T")

#: Types of datablocks on which the shading of surfaces and of the world depends.
SHADING_MODELS = (bpy.types.Material, bpy.types.NodeTree, bpy.types.Image, bpy.types.Texture, bpy.types.World)
#: First items of the keys of entries that depend on such datablocks.
SHADED = ("mesh", "world")
#: On what painted images depend, and the first item of their keys: they are slow to read, so not of a World's slider.
_SHOWING, PAINTED = (bpy.types.Material, bpy.types.Image), "painted"


def uid(datablock: bpy.types.ID | None) -> int:
    """Identity of a datablock in this run of Blender, the same for its evaluated copies."""
    return 0 if datablock is None else datablock.original.session_uid


class ExportCache:
    """Results by key, each with the datablocks it depends on. An empty one remembers nothing to begin with."""

    def __init__(self) -> None:
        self._known: dict[tuple[Hashable, ...], tuple[frozenset[int], Any]] = {}
        self._used: set[tuple[Hashable, ...]] = set()
        self._frame, self._moving = 0, False
        #: Of the last frame.
        self.keys = Keys()

    def begin(self, frame: int) -> None:
        """An export at a frame of the scene begins; pictures that move are other ones in each."""
        if self._moving and frame != self._frame:
            self.forget_shading()
            self._moving = False
        self._frame = frame

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
        """Drop entries that the depsgraph's updates invalidate."""
        stale, shapes = set(), set()
        for update in depsgraph.updates:
            if isinstance(update.id, SHADING_MODELS):
                stale |= {*SHADED, PAINTED} if isinstance(update.id, _SHOWING) else set(SHADED)
            elif update.is_updated_geometry:
                shapes.add(uid(update.id))
        if stale or shapes:
            self._known = {
                key: entry for key, entry in self._known.items() if key[0] not in stale and shapes.isdisjoint(entry[0])
            }

    def forget_shading(self) -> None:
        """Drop what depends on materials and worlds."""
        self._known = {key: entry for key, entry in self._known.items() if key[0] not in SHADED}

    def clear(self) -> None:
        """Forget everything."""
        self._known = {}

    def end(self, moving: bool = False) -> None:
        """An export is over, which read images that move or did not: drop what it did not use."""
        self._moving |= moving
        self._known = {key: entry for key, entry in self._known.items() if key in self._used}
        self._used = set()
