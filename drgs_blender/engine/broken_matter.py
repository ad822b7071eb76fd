"""Objects whose matter has broken: their pieces closed, with the inside's material, and surfels on their own side."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, same_bits
from ..core.asset.model import PosedSurfels
from ..core.errors import AssetError
from ..core.frame import Inside, Layer, ObjectState
from ..core.materials import Material, Texture
from ..deform.closed_matter import Breakable, ClosedMatter
from ..deform.mesh_driven import MeshDriven
from ..deform.particle_driven import Frames, place
from ..geometry.normals import VertexNormals
from ..render.scene.trace_scene import ObjectMesh, TraceObject
from .carrier_cache import still_used
from .loaded_assets import LoadedAsset

#: Layers of faces that replace others: albedo; roughness and metallic.
LAYERED = "albedo", "roughness, metallic"
#: What has broken is no smoother than this, unless it is said.
_ROUGH = 0.5
#: Where a surfel ends, in parts of its scale; of how many, in percent, the extent counts; the least that is shown.
_ENDS, _MOST, _LEAST = 3.4, 90, 0.3


def can_break(state: ObjectState) -> bool:
    """Whether an object is of particles that are known to be neighbours, until they are apart."""
    particles = state.particles
    return particles is not None and particles.cells is not None and state.tear > 0 and not particles.skin


class _Known(NamedTuple):
    """What is known of an asset's mesh, and the particles in it, at rest."""

    loaded: weakref.ref[LoadedAsset]
    rest: Array
    cells: Array
    began: Array
    matter: Breakable


class BrokenMatter:
    """Closes what has broken; keeps what it knows of the objects of the last frame at rest."""

    def __init__(self) -> None:
        self._known: list[_Known] = []
        self._frames: list[tuple[weakref.ref[LoadedAsset], Array, Frames]] = []

    def begin(self, states: Iterable[ObjectState]) -> None:
        """A frame begins: what none of its objects has is forgotten."""
        rests = [state.particles.rest for state in states if state.particles is not None and state.tear > 0]
        self._known = still_used(self._known, rests)
        begun = [known.began for known in self._known]
        self._frames = [
            frames for frames in self._frames if frames[0]() is not None and any(same_bits(frames[1], b) for b in begun)
        ]

    def closed(self, loaded: LoadedAsset, state: ObjectState) -> ClosedMatter | None:
        """The object's mesh with closed pieces; None where it shows nothing that has broken.

        Raises
        ------
        AssetError
            Particles, or the lattice that they fill, are not what they must be; names the object.
        """
        particles, mesh = state.particles, loaded.asset.mesh
        if particles is None or particles.cells is None or not can_break(state) or not len(mesh.faces):
            return None
        check_particles(state)
        vertices = mesh.vertices if state.vertices is None else state.vertices
        if vertices.shape != mesh.vertices.shape:
            return None  # told when the object is traced
        rest = particles.rest, particles.cells, _began(loaded, state)
        for known in self._known:
            both = zip(rest, (known.rest, known.cells, known.began))
            if known.loaded() is loaded and all(same_bits(a, b) for a, b in both):
                matter = known.matter
                break
        else:
            matter = Breakable(rest[2], mesh.faces, *rest[:2])
            self._known.append(_Known(weakref.ref(loaded), *rest, matter))
        given = vertices, particles.points, particles.gradients, state.tear
        try:
            return matter.closed(*given, 2 * _extent(loaded), particles.broken)
        except ValueError as error:
            problem = f"what has broken of it is not of its particles ({error})"
            raise AssetError(f"object {state.name}", problem, "Bake it again") from error

    def carry(
        self, loaded: LoadedAsset, state: ObjectState, driven: MeshDriven, closed: ClosedMatter, posed: PosedSurfels
    ) -> None:
        """Put surfels of faces that are cut, or near, where the matter on their own side takes them."""
        whole, near = self._at_rest(loaded, state, driven), closed.near[driven.binding.face]
        keep = _shrunk(whole.centre, driven.surfels.scale, closed.crack, closed.opening)
        rows = np.flatnonzero(near | (keep < 1))
        if not len(rows):
            return
        known, centre, gradients = closed.sides.carried(whole.centre[rows])
        rows = rows[known]
        if not len(rows):
            return
        rest, keep = Frames(*(array[rows] for array in whole)), keep[rows]
        found = place(rest, centre, gradients, np.asarray(state.matrix_world, np.float64))
        for name, values in zip(Frames._fields, found):
            getattr(posed, name)[rows] = values * keep[:, None] if name.startswith("tangent") else values
        opacity = np.array(posed.opacity)
        there = np.isfinite(centre).all(axis=1) & np.isfinite(gradients).all(axis=(1, 2))
        opacity[rows] = np.where((keep > _LEAST) & there, driven.surfels.opacity[rows], 0.0)
        posed.opacity = opacity

    def _at_rest(self, loaded: LoadedAsset, state: ObjectState, driven: MeshDriven) -> Frames:
        began = _began(loaded, state)
        for known, places, frames in self._frames:
            if known() is loaded and same_bits(places, began):
                return frames
        frames = Frames.of(driven.pose(began))
        self._frames.append((weakref.ref(loaded), began, frames))
        return frames


def _began(loaded: LoadedAsset, state: ObjectState) -> Array:
    """(n, 3) vertices of the object's mesh when its particles were at rest; AssetError where these are others."""
    mesh, particles = loaded.asset.mesh, state.particles
    if particles is None or particles.began is None:
        return mesh.vertices
    began = mesh.in_own_order(particles.began)
    if began.shape != mesh.vertices.shape or not np.isfinite(began[np.unique(mesh.faces)]).all():
        problem = f"its mesh began with {len(began)} vertices and has {len(mesh.vertices)}, or some are not finite"
        raise AssetError(f"object {state.name}", problem, "Bake it again")
    return began


def _extent(loaded: LoadedAsset) -> float:
    """Metres from their centres to where most surfels of an asset end."""
    scale = loaded.asset.surfels.scale
    return _ENDS * float(np.percentile(scale.max(axis=1), _MOST)) if len(scale) else 0.0


def _shrunk(centre: Array, scale: Array, crack: Array, opening: Array) -> Array:
    """(n,) float32 factors by which surfels, given at rest, end at a crack that is open instead of hanging over it."""
    from scipy.spatial import cKDTree  # an engine starts without

    if not len(crack):
        return np.ones(len(centre), np.float32)
    reach = _ENDS * scale.max(axis=1)
    distance, nearest = cKDTree(crack).query(centre, distance_upper_bound=float(reach.max()))
    over = 1.0 - np.minimum(distance / np.maximum(reach, 1e-30), 1.0)
    return (1.0 - np.append(opening, 0.0)[nearest] * over).astype(np.float32)


def check_particles(state: ObjectState) -> None:
    """Refuse particles that do not fit each other or their lattice; AssetError names the object."""
    particles = state.particles
    assert particles is not None and particles.cells is not None
    n = len(particles.rest)
    shapes = particles.points.shape, particles.gradients.shape, particles.cells.shape
    if shapes != ((n, 3), (n, 3, 3), (4, 4)) or not n:
        problem = f"its particles have shapes {shapes} and were {n} at rest"
        raise AssetError(f"object {state.name}", problem, "Bake it again")
    det = float(np.linalg.det(particles.cells[:3, :3]))
    if not (np.isfinite(particles.cells).all() and np.isfinite(particles.rest).all() and det != 0):
        raise AssetError(f"object {state.name}", "the lattice of its particles is not finite", "Bake it again")


def crack_meshes(state: ObjectState, traced: TraceObject, closed: ClosedMatter, owner: int) -> list[ObjectMesh]:
    """What replaces faces that are cut: what is left of them, in the object's materials, and the faces inside, if any.

    Where cracks are open the camera sees it between surfels; where they are shut surfels hide it, as all of the mesh.
    Surfels are tied to all but the faces inside.

    Parameters
    ----------
    state : ObjectState
    traced : TraceObject
        The same with materials at its vertices, painted and adjusted.
    closed : ClosedMatter
    owner : int
        Index of the object.
    """
    count = len(closed.walls) if state.inside is not None else 0
    walls = np.ascontiguousarray(closed.walls[:count], np.int32)
    faces = np.concatenate([closed.rim, walls])
    smooth = np.zeros(closed.points.shape, np.float32)
    VertexNormals(walls, len(closed.points)).into(closed.points, walls, smooth)
    normals = np.concatenate([closed.rim_normals, smooth[walls]])
    a, b, c = closed.points[faces].transpose(1, 0, 2)
    there: Array = np.asarray(np.cross(b - a, c - a).any(axis=1))
    shut = closed.shut[: len(faces)]
    index = np.repeat(np.array([1, 0], np.int32), [len(closed.rim), len(walls)])
    values = np.concatenate([traced.albedo, traced.roughness[:, None], traced.metallic[:, None]], axis=1)
    corners = np.einsum("rck,rkd->rcd", closed.rim_share, values[traced_corners(state, traced)[closed.rim_face]])
    corners = np.concatenate([corners, np.zeros((len(walls), 3, 5))])
    materials = [_inside(state, traced), of_layers(state, LAYERED)]
    return [
        ObjectMesh(
            name=state.name,
            vertices=closed.points,
            faces=faces[which],
            matrices=np.asarray(state.matrix_world, np.float64)[None],
            pass_indices=np.array([state.pass_index], np.int32),
            corner_normals=normals[which],
            material_index=index[which],
            materials=materials,
            layers=material_layers(corners, which),
            visibility=state.visibility,
            light_group=state.light_group,
            owner=owner,
            seen_only=tied and traced.seen_only,
            beside=beside,
            tied=tied,
        )
        for beside, tied, which in (
            (True, False, there & ~shut & (index == 0)),
            (True, True, there & ~shut & (index == 1)),
            (False, True, there & shut),
        )
        if which.any()
    ]


def traced_corners(state: ObjectState, traced: TraceObject) -> Array:
    """(m, 3) faces in the order of the asset's corners, also where a mirrored object has turned them."""
    mirrored = np.linalg.det(np.asarray(state.matrix_world, np.float64)[:3, :3]) < 0
    return traced.faces[:, [0, 2, 1]] if mirrored else traced.faces


def _inside(state: ObjectState, traced: TraceObject) -> Material:
    given = state.inside or Inside()
    used = np.unique(traced.faces)
    colour = traced.albedo[used].mean(axis=0, dtype=np.float64).tolist()
    roughness = max(float(traced.roughness[used].mean()), _ROUGH)
    metallic = float(traced.metallic[used].mean())
    return Material(
        f"{state.name}, inside",
        tuple(colour) if given.base_colour is None else given.base_colour,
        roughness if given.roughness is None else given.roughness,
        metallic if given.metallic is None else given.metallic,
        pass_index=state.material_pass_index,
    )


def material_layers(values: Array, there: Array) -> list[Layer]:
    """Layers of albedo, roughness and metallic (m, 3, 5) at the corners of faces, of those that are `there`."""
    layers = []
    for name, columns in zip(LAYERED, (values[..., :3], values[..., 3:])):
        layer = np.zeros((*values.shape[:2], 4), np.float32)
        layer[..., 3] = 1.0
        layer[..., : columns.shape[-1]] = columns
        layers.append(Layer(name, layer[there]))
    return layers


def of_layers(state: ObjectState, names: tuple[str, str]) -> Material:
    """An object's own material, with values of its layers."""
    return Material(
        state.name, (1.0, 1.0, 1.0), 1.0, 1.0,
        base_colour_texture=Texture("", layer=names[0]),
        roughness_texture=Texture("", channel="r", layer=names[1]),
        metallic_texture=Texture("", channel="g", layer=names[1]),
        pass_index=state.material_pass_index,
    )  # fmt: skip
