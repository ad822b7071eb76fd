"""Surfels of objects without a mesh at two times, for motion vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..core.asset.model import PosedSurfels
from ..core.frame import ObjectState, Pose
from ..render.film.surfel_motion import SurfelState
from .cached_objects import CachedObject
from .carrier_cache import CarrierCache
from .level_of_detail import grown
from .loaded_assets import LoadedAsset
from .proxy_meshes import ProxyMeshes
from .scene_objects import posed_surfels


def _unmeshed(objects: Sequence[CachedObject]) -> list[tuple[int, CachedObject, PosedSurfels]]:
    return [
        (index, item, item.posed)
        for index, item in enumerate(objects)
        if item.posed is not None and not len(item.loaded.asset.mesh.faces)
    ]


def state_now(objects: Sequence[CachedObject]) -> SurfelState | None:
    """Surfels of a frame's objects that have no mesh; None where all have one."""
    found = [posed for _, _, posed in _unmeshed(objects)]
    return SurfelState(found) if found else None


def state_at(
    objects: Sequence[CachedObject],
    poses: Sequence[Pose | None],
    assets: Mapping[str, LoadedAsset],
    proxies: ProxyMeshes,
    carriers: CarrierCache,
) -> SurfelState | None:
    """The same at another time; what has no pose then, or one that fits nothing, is as it is now.

    Parameters
    ----------
    objects : sequence of CachedObject
    poses : sequence of (Pose or None)
        One for each object.
    assets : mapping of str to LoadedAsset
        By their keys.
    proxies : ProxyMeshes
    carriers : CarrierCache
    """
    found = []
    for index, item, posed in _unmeshed(objects):
        pose = poses[index]
        state = None if pose is None else _moved(item.state, pose, assets[item.state.asset], proxies)
        if state is not None:
            carrier = carriers.carrier(item.loaded, state)
            posed, _ = posed_surfels(state, index, item.loaded.surfels_of(state), item.traced, carrier=carrier)
            posed = posed if item.detail is None else grown(posed, item.detail)
        found.append(posed)
    return SurfelState(found) if found else None


def _moved(state: ObjectState, pose: Pose, loaded: LoadedAsset, proxies: ProxyMeshes) -> ObjectState | None:
    """An object as it is in another pose; None where that fits nothing."""
    if np.shape(pose.matrices) != (1, 4, 4) or not np.isfinite(pose.matrices).all():
        return None
    particles = state.particles if pose.particles is None else pose.particles
    if pose.proxy is not None:
        particles = proxies.particles(state.name, pose.proxy, loaded.asset)
    if particles is not None and particles.points.shape != particles.rest.shape:
        return None
    return replace(state, matrix_world=pose.matrices[0], particles=particles)
