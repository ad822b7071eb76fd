"""Objects whose matter flows: a surface around their particles, in the materials that these bring from the asset."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..compute.threads import checkpoint
from ..core.arrays import Array, same_bits
from ..core.frame import ObjectState
from ..geometry.particle_surface import ParticleSurface, particle_surface
from ..render.scene.trace_scene import ObjectMesh, TraceObject
from .broken_matter import LAYERED, check_particles, material_layers, of_layers
from .carrier_cache import still_used
from .loaded_assets import LoadedAsset

#: Particles whose materials a place of the surface has, and how far they count, in spacings.
_NEAR, _WIDTH = 8, 1.0


class _Known(NamedTuple):
    """Of particles at rest: at which vertex of the asset's mesh each is."""

    loaded: weakref.ref[LoadedAsset]
    rest: Array
    vertex: Array


class Skin(NamedTuple):
    """The surface of an object's particles.

    Attributes
    ----------
    surface : ParticleSurface
        Object space.
    vertex : (n, k) int32 array
        Vertices of the asset's mesh whose materials each of its vertices has.
    share : (n, k) float32 array
        How much of each.
    lost : int
        Particles that are not finite.
    """

    surface: ParticleSurface
    vertex: Array
    share: Array
    lost: int = 0


class ParticleSurfaces:
    """Makes surfaces of particles; keeps what it knows of those of the last frame at rest."""

    def __init__(self) -> None:
        self._known: list[_Known] = []

    def begin(self, states: Iterable[ObjectState]) -> None:
        """A frame begins: what none of its objects has is forgotten."""
        rests = [state.particles.rest for state in states if state.particles is not None and state.particles.skin]
        self._known = still_used(self._known, rests)

    def skin(self, loaded: LoadedAsset, state: ObjectState) -> Skin | None:
        """The surface of an object's particles; None where it is to be shown by its mesh.

        Raises
        ------
        AssetError
            Particles, or the lattice that they fill, are not what they must be; names the object.
        """
        particles = state.particles
        if particles is None or not particles.skin or particles.cells is None or not len(loaded.asset.mesh.faces):
            return None
        from scipy.spatial import cKDTree  # an engine starts without

        check_particles(state)
        linear = particles.cells[:3, :3]
        back = np.linalg.inv(linear)
        now = particles.points @ linear.T  # where they are a cube each
        made = particle_surface(now, 1.0)
        usable = np.isfinite(now).all(axis=1)
        if not len(made.vertices):
            return Skin(made, np.zeros((0, 1), np.int32), np.zeros((0, 1), np.float32), int((~usable).sum()))
        count = min(_NEAR, int(usable.sum()))
        checkpoint()
        distance, index = cKDTree(now[usable]).query(made.vertices, k=count, workers=-1)
        checkpoint()
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        share = np.exp(-((distance / _WIDTH) ** 2) / 2) + 1e-12
        share /= share.sum(axis=1, keepdims=True)
        normals = made.normals @ linear
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        faces = made.faces if np.linalg.det(linear) > 0 else made.faces[:, ::-1]
        surface = ParticleSurface(
            (made.vertices @ back.T).astype(np.float32), np.ascontiguousarray(faces), normals.astype(np.float32),
            made.coarse, made.far,
        )  # fmt: skip
        vertex = self._vertices_of(loaded, particles.rest)[np.flatnonzero(usable)[index]]
        return Skin(surface, vertex, share.astype(np.float32), int((~usable).sum()))

    def _vertices_of(self, loaded: LoadedAsset, rest: Array) -> Array:
        from scipy.spatial import cKDTree  # an engine starts without

        for known in self._known:
            if known.loaded() is loaded and same_bits(known.rest, rest):
                return known.vertex
        mesh = loaded.asset.mesh
        used = np.unique(mesh.faces)
        used = used[np.isfinite(mesh.vertices[used]).all(axis=1)]
        vertex: Array = used[cKDTree(mesh.vertices[used]).query(rest, workers=-1)[1]].astype(np.int32)
        self._known.append(_Known(weakref.ref(loaded), rest, vertex))
        return vertex


def skin_mesh(state: ObjectState, traced: TraceObject, skin: Skin, owner: int) -> ObjectMesh:
    """The surface as a mesh that stands for the object, in its materials, painted and adjusted."""
    surface = skin.surface
    values = np.concatenate([traced.albedo, traced.roughness[:, None], traced.metallic[:, None]], axis=1)
    own = np.einsum("nk,nkd->nd", skin.share, values[skin.vertex])
    return ObjectMesh(
        name=state.name,
        vertices=surface.vertices,
        faces=surface.faces,
        matrices=np.asarray(state.matrix_world, np.float64)[None],
        pass_indices=np.array([state.pass_index], np.int32),
        vertex_normals=surface.normals,
        materials=[of_layers(state, LAYERED)],
        layers=material_layers(own[surface.faces], np.ones(len(surface.faces), bool)),
        visibility=state.visibility,
        light_group=state.light_group,
        owner=owner,
        beside=True,
    )
