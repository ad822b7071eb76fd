"""Assets as what other programs understand: posed splats in a chosen colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.asset.model import Asset, PosedSurfels, Surfels
from ..core.errors import UsageError
from ..deform.mesh_driven import MeshDriven
from ..formats.harmonics import rotate_harmonics, whole_bands
from ..geometry.normals import rotation_matrices

Array = np.ndarray


def posed_surfels(asset: Asset, vertices: Array) -> Surfels:
    """The surfels of `asset` with its mesh at `vertices` (n, 3), object space.

    Raises
    ------
    UsageError
        The asset has no mesh to pose.
    AssetError
        `vertices` are of another mesh.
    """
    if asset.binding is None:
        raise UsageError("pose", "is given, but the asset's surfels hang on no mesh", "Leave the pose out")
    return surfels_of_pose(asset.surfels, MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(vertices))


def surfels_of_pose(rest: Surfels, posed: PosedSurfels, *, mirrored: bool = False) -> Surfels:
    """Surfels as a pose has them, in its space.

    A tangent pair that shear has made oblique becomes the axes of the same ellipse; captured colours turn with the
    surface, and the thickness of splats grows as the others of their axes do in the mean. Other extras stay behind.

    Parameters
    ----------
    rest : Surfels
        The same surfels before they were posed.
    posed : PosedSurfels
    mirrored : bool
        The pose contains a matrix that mirrors.
    """
    tangents = np.stack([posed.tangent_u, posed.tangent_v], axis=-1).astype(np.float64)
    axes, scale, _ = np.linalg.svd(tangents, full_matrices=True)
    # A frame that agrees with the tangents' own side; its first axes are those of the ellipse.
    normal = np.cross(tangents[..., 0], tangents[..., 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-30, normal / np.maximum(length, 1e-30), axes[..., 2])
    frame = np.stack([axes[..., 0], np.cross(normal, axes[..., 0]), normal], axis=-1)
    sh = rest.sh
    if sh is not None:
        sh = rotate_harmonics(whole_bands(sh), _turns(rest, tangents, normal, mirrored))
    thickness = rest.extras.get("thickness")
    extras = {}
    if thickness is not None:
        grown = np.sqrt(scale.prod(axis=1) / np.maximum(rest.scale.astype(np.float64).prod(axis=1), 1e-30))
        extras["thickness"] = (thickness * grown).astype(np.float32)
    return Surfels(
        posed.centre,
        scale,
        _quaternions(frame),
        posed.opacity,
        posed.albedo,
        posed.roughness,
        posed.metallic,
        sh,
        extras,
    )


def faded(surfels: Surfels, asset: Asset, opacity: Array | None) -> Surfels:
    """`surfels` of `asset` with their opacity times that of the vertices around them, (n,); None: all of it."""
    if opacity is None or asset.binding is None:
        return surfels
    corners = opacity[asset.mesh.faces[asset.binding.face]]
    share = np.einsum("nk,nk->n", asset.binding.barycentric, corners).clip(0, 1)
    return replace(surfels, opacity=surfels.opacity * share.astype(np.float32))


def _turns(rest: Surfels, tangents: Array, normal: Array, mirrored: bool) -> Array:
    """(n, 3, 3) rotations, mirrored or not, that carry each surfel's frame at rest to its posed one.

    `normal` is that of the tangents: where they are mirrored, the other side is the one that `rest` has there.
    """
    first = tangents[..., 0]
    length = np.linalg.norm(first, axis=1, keepdims=True)
    before = rotation_matrices(rest.rotation.astype(np.float64))
    first = np.where(length > 1e-30, first / np.maximum(length, 1e-30), before[..., 0])
    first = first - normal * np.sum(first * normal, axis=1, keepdims=True)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-30)
    after = np.stack([first, np.cross(normal, first), -normal if mirrored else normal], axis=-1)
    return after @ before.transpose(0, 2, 1)


def _quaternions(matrices: Array) -> Array:
    """Unit quaternions wxyz (n, 4) of rotation matrices (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(matrices).as_quat() if len(matrices) else np.empty((0, 4))
    return xyzw[:, [3, 0, 1, 2]]
