"""Bindings of surfels to the particles that carry them, made once for all objects that share asset and particles."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from ..core.arrays import Array, same_bits
from ..core.asset.model import Surfels
from ..core.errors import UsageError
from ..core.frame import ObjectState, Particles
from ..deform.particle_driven import Frames, ParticleDriven, on_the_mesh
from ..deform.rigid import pose_by_matrix
from .loaded_assets import LoadedAsset


class _Known(NamedTuple):
    """A binding: of which asset, to particles with which rest, whether they carry all."""

    loaded: weakref.ref[LoadedAsset]
    rest: Array
    all: bool
    carrier: ParticleDriven


class _Bound(Protocol):
    """What is known of an asset and of particles at rest."""

    @property
    def loaded(self) -> weakref.ref[LoadedAsset]: ...

    @property
    def rest(self) -> Array: ...


_B = TypeVar("_B", bound=_Bound)


def still_used(known: Iterable[_B], rests: Sequence[Array]) -> list[_B]:
    """Those of `known` whose asset is loaded, and whose particles at rest are among `rests`."""
    return [one for one in known if one.loaded() is not None and any(same_bits(rest, one.rest) for rest in rests)]


class CarrierCache:
    """Binds surfels to particles; keeps what objects of the frame can use, at any level of detail."""

    def __init__(self) -> None:
        self._known: list[_Known] = []

    def begin(self, states: Iterable[ObjectState]) -> None:
        """A frame begins: bindings to particles that none of its objects has are forgotten."""
        rests = [state.particles.rest for state in states if state.particles is not None and state.particles.surfels]
        self._known = still_used(self._known, rests)

    def carrier(self, loaded: LoadedAsset, state: ObjectState) -> ParticleDriven | None:
        """What carries an object's surfels besides its faces; None where it has no particles.

        Raises
        ------
        UsageError
            The particles are none, or not finite at rest; names the object.
        """
        particles = state.particles
        if particles is None or not particles.surfels:
            return None
        for known in self._known:
            if known.loaded() is loaded and known.all == particles.all and same_bits(known.rest, particles.rest):
                return known.carrier
        if loaded.larger is not None:
            whole = self.carrier(loaded.larger, state)
            assert whole is not None
            found = whole.first(len(loaded.asset.surfels))
        else:
            found = _bound(loaded, state, particles)
        self._known.append(_Known(weakref.ref(loaded), particles.rest, particles.all, found))
        return found


def _bound(loaded: LoadedAsset, state: ObjectState, particles: Particles) -> ParticleDriven:
    asset, rest = loaded.asset, particles.rest
    if rest.ndim != 2 or rest.shape[1] != 3 or not len(rest) or not np.isfinite(rest).all():
        problem = f"its particles at rest are no (n, 3) finite places, but of shape {rest.shape}"
        raise UsageError(f"object {state.name}", problem, "Bake it again, or set Driven By to Surface")
    driven = loaded.surfels_of(state)
    if isinstance(driven, Surfels):
        return ParticleDriven(Frames.of(pose_by_matrix(driven, np.eye(4))), rest)
    carrier = ParticleDriven(Frames.of(driven.pose(asset.mesh.vertices)), rest)
    if not particles.all:
        carrier.on_mesh = on_the_mesh(asset.mesh, driven.binding, carrier.rest.centre, carrier.spacing)
    return carrier
