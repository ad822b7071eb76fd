"""One object of a frame: checked, brought into world space, as rays see it and as surfels."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..asset.model import MATERIAL_CHANNELS, Asset, PosedSurfels, as_float
from ..deform.mesh_driven import MeshDriven
from ..errors import AssetError, UsageError
from ..frame import ObjectState
from ..render.trace.scene import TraceObject

Array = np.ndarray

_MIRRORED = [0, 2, 1]  # order of the corners of a face whose object is mirrored


def _given(state: ObjectState, name: str, shape: tuple[int, ...], what: str) -> Array | None:
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


def traced_object(state: ObjectState, asset: Asset) -> TraceObject:
    """The object's mesh in world space with this frame's materials.

    Faces are counter-clockwise seen from outside also where the object's matrix mirrors it.

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
        raise AssetError(
            subject,
            f"its mesh has {len(state.vertices)} vertices, its asset has {n}",
            "Remove or disable modifiers that add or remove geometry, or bind the object again",
        )
    vertices = _given(state, "vertices", (n, 3), f"{n} vertices")
    vertices = mesh.vertices if vertices is None else vertices
    normals = _given(state, "corner_normals", (m, 3, 3), f"{m} faces")
    albedo = _given(state, "albedo", (n, 3), f"{n} vertices")
    roughness = _given(state, "roughness", (n,), f"{n} vertices")
    metallic = _given(state, "metallic", (n,), f"{n} vertices")
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    faces = mesh.faces
    with np.errstate(over="ignore", invalid="ignore"):  # bad vertices are counted by the scene
        world = (vertices @ linear.T + matrix[:3, 3]).astype(np.float32)
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
        albedo=mesh.albedo if albedo is None else albedo,
        roughness=mesh.roughness if roughness is None else roughness,
        metallic=mesh.metallic if metallic is None else metallic,
        corner_normals=normals,
        pass_index=state.pass_index,
        visibility=state.visibility,
    )


def _cofactors(matrix: Array) -> Array:
    """Cofactor matrix of a (3, 3) matrix: determinant times inverse transpose."""
    a, b, c = matrix
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])


def posed_surfels(state: ObjectState, index: int, driven: MeshDriven, traced: TraceObject) -> tuple[PosedSurfels, int]:
    """The object's surfels in this frame, and how many are hidden because their vertices are not finite."""
    matrix = np.asarray(state.matrix_world, np.float64)
    normals = traced.corner_normals
    if normals is not None and np.linalg.det(matrix[:3, :3]) < 0:
        normals = np.ascontiguousarray(normals[:, _MIRRORED])  # back to the order of the asset's corners
    materials = {name: getattr(state, name) for name in MATERIAL_CHANNELS}
    posed = driven.pose(traced.vertices, normals, materials, matrix_world=matrix, object_index=index)
    return posed, driven.lost


def join(parts: list[PosedSurfels]) -> PosedSurfels:
    """The surfels of all objects as one."""
    if len(parts) == 1:
        return parts[0]
    empty, flat = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    nothing = PosedSurfels(empty, empty, empty, empty, flat, empty, flat, flat, np.empty(0, np.int32))
    names = [f.name for f in dataclasses.fields(PosedSurfels)]
    return PosedSurfels(*(np.concatenate([getattr(part, name) for part in (nothing, *parts)]) for name in names))
