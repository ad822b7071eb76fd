"""Proxy meshes: what a bent mesh does to the surfels of an asset that has none, as particles say it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..core.arrays import Array, same_bits
from ..core.asset.model import Asset
from ..core.errors import AssetError
from ..core.frame import ObjectState, Particles, ProxyMesh
from .loaded_assets import LoadedAsset

if TYPE_CHECKING:
    from ..deform.lattice_fit import LatticeFit

_REMEDY = "Delete its vertices, then choose Add Proxy Mesh"


class _Known(NamedTuple):
    """What is known of a proxy at rest and the surfels in it."""

    proxy: ProxyMesh
    centre: Array
    fit: LatticeFit

    def is_of(self, proxy: ProxyMesh, centre: Array) -> bool:
        """Whether it is of this proxy, wherever its vertices are now."""
        own = self.proxy
        return self.centre is centre and same_bits(own.rest, proxy.rest) and same_bits(own.faces, proxy.faces)


class ProxyMeshes:
    """Turns proxies into particles; keeps what is known of those of the last frame."""

    def __init__(self) -> None:
        self._known: list[_Known] = []

    def carried(self, states: Iterable[ObjectState], assets: Mapping[str, LoadedAsset]) -> list[ObjectState]:
        """The objects of a frame, those with a proxy carried by particles in its place.

        Parameters
        ----------
        states : iterable of ObjectState
        assets : mapping of str to LoadedAsset
            By their keys.

        Raises
        ------
        AssetError
            A proxy is no mesh, not finite at rest, or of an asset that has a mesh; names the object.
        """
        used: dict[int, _Known] = {}
        found = []
        for state in states:
            proxy, loaded = state.proxy, assets.get(state.asset)
            if proxy is not None and loaded is not None:
                known = self._bound(state.name, proxy, loaded.asset)
                used[id(known)] = known
                state = replace(state, proxy=None, particles=known.fit.particles(proxy.vertices))
            found.append(state)
        self._known = list(used.values())
        return found

    def particles(self, name: str, proxy: ProxyMesh, asset: Asset) -> Particles:
        """What a proxy of the object `name` does at any time, as `carried`; it is known until the next frame."""
        return self._bound(name, proxy, asset).fit.particles(proxy.vertices)

    def _bound(self, name: str, proxy: ProxyMesh, asset: Asset) -> _Known:
        rest, faces, subject = proxy.rest, proxy.faces, f"object {name}"
        if len(asset.mesh.faces):
            raise AssetError(subject, "has a proxy beside the mesh of its asset", "Import it again")
        if rest.ndim != 2 or rest.shape[1] != 3 or not len(rest) or proxy.vertices.shape != rest.shape:
            raise AssetError(subject, f"its proxy is of {proxy.vertices.shape}, and at rest of {rest.shape}", _REMEDY)
        for known in self._known:
            if known.is_of(proxy, asset.surfels.centre):
                return known
        if not np.isfinite(rest).all():
            raise AssetError(subject, "its proxy is not finite at rest", _REMEDY)
        if faces.ndim != 2 or faces.shape[1] != 3 or (len(faces) and not 0 <= faces.min() <= faces.max() < len(rest)):
            raise AssetError(subject, f"its proxy has no faces of its {len(rest)} vertices", _REMEDY)
        from ..deform.lattice_fit import LatticeFit  # with SciPy, without which an engine starts

        known = _Known(proxy, asset.surfels.centre, LatticeFit(rest, faces, asset.surfels.centre))
        self._known.append(known)  # for the next object that has it
        return known
