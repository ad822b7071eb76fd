"""The parts of assets that objects of the last frame show, cut once."""

from __future__ import annotations

from ..core.asset.part import Part, part_of
from ..core.frame import ObjectState
from ..ipc.change_detection import reuse_equal
from .loaded_assets import LoadedAsset


class PartCache:
    """Cuts assets to what objects have left of them; kept from one frame to the next, shared by instances."""

    def __init__(self) -> None:
        self._last: list[tuple[LoadedAsset, Part, LoadedAsset]] = []
        self._used: list[tuple[LoadedAsset, Part, LoadedAsset]] = []

    def begin(self) -> None:
        """A frame begins: what the last one did not use is forgotten."""
        self._last, self._used = self._used, []

    def loaded(self, whole: LoadedAsset, state: ObjectState) -> LoadedAsset:
        """What is loaded for an object: `whole`, or the part of it that the object shows.

        Raises
        ------
        AssetError
            The part refers to what the asset does not have; names the object.
        """
        if state.part is None:
            return whole
        for entry in (*self._used, *self._last):
            if entry[0] is whole and reuse_equal(state.part, entry[1]) is entry[1]:
                break
        else:
            cut = part_of(whole.asset, state.part, f"object {state.name}")
            entry = whole, reuse_equal(state.part, None), LoadedAsset(cut, whole.stamp, faults=whole.faults)
        if all(entry is not used for used in self._used):
            self._used.append(entry)
        return entry[2]
