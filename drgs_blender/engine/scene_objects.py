"""One object of a frame: checked, brought into world space, as rays see it and as surfels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..compute.warp.posed_surfels import FIELDS, with_fields
from ..core.asset.model import BASE_CHANNELS, MATERIAL_CHANNELS, Asset, PosedSurfels, Surfels, as_float
from ..core.errors import AssetError, UsageError
from ..core.frame import ObjectState, Pose, RenderSettings
from ..core.material_adjustments import adjusted
from ..deform.fracture import torn_faces
from ..deform.granular import grainy
from ..deform.mesh_driven import MeshDriven
from ..deform.particle_driven import ParticleDriven
from ..deform.rigid import pose_by_matrix
from ..render.scene.texture_lookup import BRIGHTEST
from ..render.scene.trace_scene import TraceObject

Array = np.ndarray

_MIRRORED = [0, 2, 1]  # order of the corners of a face whose object is mirrored


def check_surface(state: ObjectState, asset: Asset, settings: RenderSettings, captured: bool) -> None:
    """Refuse an asset of which nothing would be seen; `captured` ones need no mesh."""
    subject = f"object {state.name}"
    if settings.camera_sees == "mesh" and not captured and not len(asset.mesh.faces):
        remedy = "Set Camera Sees to Surfels, or import a file whose mesh has faces"
        raise AssetError(subject, f"the mesh of {state.asset} has no faces", remedy)
    if "surfels" in (settings.camera_sees, settings.rays_see) and not len(asset.surfels):
        raise AssetError(subject, f"{state.asset} has no surfels", "Set Camera Sees and Rays See to Mesh")


def in_asset_order(state: ObjectState, asset: Asset) -> ObjectState:
    """An object whose vertices are in its asset's order, also where they were given in that of the asset's source."""
    if state.vertices is None:
        return state
    vertices = asset.mesh.in_own_order(state.vertices)
    return state if vertices is state.vertices else replace(state, vertices=vertices)


def _checked_array(state: ObjectState, name: str, shape: tuple[int, ...], what: str) -> Array | None:
    """Array `name` of the object, or None; AssetError when it does not fit the asset's mesh."""
    value = getattr(state, name)
    if value is None:
        return None
    array = as_float(value, tuple(-1 for _ in shape), f"{name.replace('_', ' ')} of object {state.name}")
    if array.shape != shape:
        raise AssetError(
            f"object {state.name}",
            f"its {name.replace('_', ' ')} have shape {array.shape}, its asset has {what} and needs {shape}",
            "Remove modifiers that add or remove geometry, or bind the object again",
        )
    return array


def world_vertices(vertices: Array, matrix: Array) -> Array:
    """(n, 3) float32 vertices in world space, moved by a (4, 4) float64 matrix."""
    return (vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


def moved_vertices(state: ObjectState, asset: Asset, pose: Pose) -> Array | None:
    """World-space vertices of an object at another time; None where its matrix is no matrix.

    Vertices of another number than now are taken as they are now.
    """
    now = asset.mesh.vertices if state.vertices is None else state.vertices
    if np.shape(pose.matrices) != (1, 4, 4):
        return None
    vertices = now if pose.vertices is None else asset.mesh.in_own_order(pose.vertices)
    vertices = now if vertices.shape != now.shape else vertices
    with np.errstate(over="ignore", invalid="ignore"):  # what is unusable, the scene leaves where it is
        return world_vertices(vertices, np.asarray(pose.matrices[0], np.float64))


def material(state: ObjectState, name: str, rest: Array, what: str) -> Array:
    """Material channel `name` within its limits; the asset's, `rest`, where there is none or it is not a number."""
    given = _checked_array(state, name, rest.shape, what)
    if given is None:
        return rest
    limit = min(MATERIAL_CHANNELS[name].limit, float(BRIGHTEST))
    if given.min(initial=0) >= 0 and given.max(initial=limit) <= limit:  # both are NaN where one value is
        return given
    return np.where(np.isnan(given), rest, np.clip(given, 0, np.float32(limit)))


def _mask(state: ObjectState, vertices: int) -> Array | None:
    """How much of the object's adjustment each vertex gets; AssetError where that is not one number a vertex."""
    mask = None if state.adjustment is None else state.adjustment.mask
    if mask is not None and mask.shape != (vertices,):
        raise AssetError(
            f"object {state.name}",
            f"the mask of its adjustments has shape {mask.shape}, its asset has {vertices} vertices",
            "Choose another mask",
        )
    return mask


def _adjusted_surfels(state: ObjectState, posed: PosedSurfels, driven: MeshDriven | Surfels) -> PosedSurfels:
    """Surfels with the object's adjustment; the mask is interpolated where they hang on the mesh."""
    if state.adjustment is None:
        return posed
    mask = None
    if isinstance(driven, MeshDriven):
        mask = _mask(state, len(driven.mesh.vertices))
        if mask is not None:
            corners = driven.mesh.faces[driven.binding.face]
            mask = np.einsum("nk,nk->n", driven.binding.barycentric, mask[corners])
    own = {name: getattr(posed, name) for name in BASE_CHANNELS}
    return with_fields(posed, adjusted(own, state.adjustment, mask))


def material_faults(state: ObjectState) -> list[str]:
    """Problems of the material channels of an object, in words for the user."""
    counts = {name: int(np.isnan(getattr(state, name)).sum()) for name in MATERIAL_CHANNELS if _has(state, name)}
    return [
        f"{state.name}: {count} values of its {name} are not numbers; the asset's are used there"
        for name, count in counts.items()
        if count
    ]


def _has(state: ObjectState, name: str) -> bool:
    return getattr(state, name) is not None


def traced_object(
    state: ObjectState, asset: Asset, seen_only: bool = False, sheeted: bool = False, cut: Array | None = None
) -> TraceObject:
    """The object's mesh in world space with this frame's materials.

    Faces are counter-clockwise seen from outside also where the object's matrix mirrors it. `seen_only`: light meets
    the object's surfels instead; `sheeted`: sheets of them. `cut` (m,) bool: faces that others replace; without
    it those that span a tear are left out.

    Raises
    ------
    AssetError, UsageError
        An array that does not fit the asset, a matrix that is not finite; names the object.
    """
    mesh = asset.mesh
    n, m = len(mesh.vertices), len(mesh.faces)
    subject = f"object {state.name}"
    matrix = np.asarray(state.matrix_world, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise UsageError(subject, "its matrix is not a finite 4 x 4 matrix", "Check its transform and its drivers")
    if state.vertices is not None and len(state.vertices) != n:
        made_from = "" if mesh.source is None else f", the mesh it was made from {mesh.source_count}"
        raise AssetError(
            subject,
            f"its mesh has {len(state.vertices)} vertices, its asset has {n}{made_from}",
            "Remove or disable modifiers that add or remove geometry, or bind the object again",
        )
    vertices = _checked_array(state, "vertices", (n, 3), f"{n} vertices")
    vertices = mesh.vertices if vertices is None else vertices
    normals = _checked_array(state, "corner_normals", (m, 3, 3), f"{m} faces")
    materials = {name: material(state, name, getattr(mesh, name), f"{n} vertices") for name in BASE_CHANNELS}
    if state.adjustment is not None:
        materials = adjusted(materials, state.adjustment, _mask(state, n))
    linear = matrix[:3, :3]
    faces = mesh.faces
    torn = cut
    if cut is None and state.tear > 0:
        torn = torn_faces(mesh.vertices, vertices, faces, state.tear)
    with np.errstate(over="ignore", invalid="ignore"):  # bad vertices are counted by the scene
        determinant = float(np.linalg.det(linear))
        world = world_vertices(vertices, matrix)
        if normals is not None:
            # Normals go through the cofactor matrix, which is defined for flattened objects too.
            turned = normals.reshape(-1, 3).astype(np.float64) @ _cofactors(linear).T
            turned *= -1.0 if determinant < 0 else 1.0
            turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-300)
            normals = turned.reshape(m, 3, 3).astype(np.float32)
    if determinant < 0:
        faces = np.ascontiguousarray(faces[:, _MIRRORED])
        normals = None if normals is None else np.ascontiguousarray(normals[:, _MIRRORED])
    return TraceObject(
        name=state.name,
        vertices=world,
        faces=faces,
        **materials,
        corner_normals=normals,
        pass_index=state.pass_index,
        visibility=state.visibility,
        seen_only=seen_only or sheeted,
        sheeted=sheeted,
        torn=torn if torn is not None and torn.any() else None,
        terminator_offset=state.terminator_offset,
    )


def _cofactors(matrix: Array) -> Array:
    """Cofactor matrix of a (3, 3) matrix: determinant times inverse transpose."""
    a, b, c = matrix
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])


def posed_surfels(
    state: ObjectState,
    index: int,
    driven: MeshDriven | Surfels,
    traced: TraceObject,
    pose: Callable[..., PosedSurfels] = MeshDriven.pose,
    carrier: ParticleDriven | None = None,
) -> tuple[PosedSurfels, int]:
    """The object's surfels in this frame, and how many are hidden because their vertices are not finite.

    Parameters
    ----------
    state : ObjectState
    index : int
    driven : MeshDriven or Surfels
        Binding that poses them; surfels without a mesh follow the object's matrix.
    traced : TraceObject
    pose : callable
        `MeshDriven.pose`, or another that does the same elsewhere.
    carrier : ParticleDriven, optional
        Binding to the particles that carry them.
    """
    matrix = np.asarray(state.matrix_world, np.float64)
    if isinstance(driven, Surfels):
        posed = pose_by_matrix(driven, matrix, index)
    elif carrier is None:
        pose = pose if state.grain <= 0 else MeshDriven.pose  # grains are made here
        posed = _posed_by_mesh(state, index, driven, traced, pose)
    else:
        way = MeshDriven.pose if carrier.on_mesh is not None else partial(MeshDriven.pose, placed=False)
        posed = _posed_by_mesh(state, index, driven, traced, way)
    if carrier is not None:
        own = driven.opacity if isinstance(driven, Surfels) else driven.surfels.opacity
        _carry(state, posed, carrier, matrix, own)  # which knows of tears by itself
    if state.grain > 0 and isinstance(driven, MeshDriven):
        larger = abs(float(np.linalg.det(matrix[:3, :3]))) ** (1 / 3)
        posed = grainy(posed, larger * driven.surfels.scale, state.grain)
    return _adjusted_surfels(state, posed, driven), driven.hidden_count if isinstance(driven, MeshDriven) else 0


def _posed_by_mesh(
    state: ObjectState, index: int, driven: MeshDriven, traced: TraceObject, pose: Callable[..., PosedSurfels]
) -> PosedSurfels:
    """Surfels as `pose` has them, with the materials of this frame."""
    matrix, mesh, normals = np.asarray(state.matrix_world, np.float64), driven.mesh, traced.corner_normals
    if normals is not None and np.linalg.det(matrix[:3, :3]) < 0:
        normals = np.ascontiguousarray(normals[:, _MIRRORED])  # back to the order of the asset's corners
    materials = {
        name: material(state, name, getattr(mesh, name), "a mesh") if _has(state, name) else None
        for name in BASE_CHANNELS
    }
    given = driven, traced.vertices, normals, materials
    return pose(*given, matrix_world=matrix, object_index=index, torn=traced.torn)


def _carry(state: ObjectState, posed: PosedSurfels, carrier: ParticleDriven, matrix: Array, opacity: Array) -> None:
    """Put surfels where the object's particles take them; AssetError where these are others than at rest."""
    particles = state.particles
    assert particles is not None
    wanted = (carrier.count, 3), (carrier.count, 3, 3)
    if (particles.points.shape, particles.gradients.shape) != wanted:
        raise AssetError(
            f"object {state.name}",
            f"its particles are {len(particles.points)} with {len(particles.gradients)} deformation gradients, and "
            f"were {carrier.count} at rest",
            "Bake it again, or set Driven By to Surface",
        )
    carrier.pose(posed, particles.points, particles.gradients, matrix, opacity)


def join(parts: list[PosedSurfels]) -> PosedSurfels:
    """The surfels of all objects as one."""
    if len(parts) == 1:
        return parts[0]
    empty, flat = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    nothing = PosedSurfels(empty, empty, empty, empty, flat, empty, flat, flat, np.empty(0, np.int32))
    return PosedSurfels(*(np.concatenate([getattr(part, name) for part in (nothing, *parts)]) for name in FIELDS))
