"""The parts of assets that objects of the last frame show, cut once."""

from __future__ import annotations

from ..core.asset.part import Part, part_of
from ..core.frame import ObjectState
from .derived_assets import DerivedAssets
from .loaded_assets import LoadedAsset


class PartCache(DerivedAssets[Part]):
    """Cuts assets to what objects have left of them."""

    def loaded(self, whole: LoadedAsset, state: ObjectState) -> LoadedAsset:
        """What is loaded for an object: `whole`, or the part of it that the object shows.

        Raises
        ------
        AssetError
            The part refers to what the asset does not have; names the object.
        """
        part = state.part
        if part is None:
            return whole
        subject = f"object {state.name}"
        return self.of(
            whole, part, lambda: LoadedAsset(part_of(whole.asset, part, subject), whole.stamp, faults=whole.faults)
        )
