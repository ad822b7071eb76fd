"""The surfel update: rotation and scale of a surfel under a deformation gradient.

A surfel is the image of the unit Gaussian under T = [s_u t_u, s_v t_v] (3 x 2). Under a deformation gradient F it is
the image under T' = F T, exactly: its covariance becomes F Sigma F^T. `surfel_update` brings T' back to orthogonal
tangents and scales; `paper_update` is the rule printed in the DR-GS paper, kept for comparison in the benchmarks.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def surfel_update(gradient: Array, rotation: Array, scale: Array) -> tuple[Array, Array]:
    """Deform surfels exactly.

    The thin SVD T' = U S V^T is found with one Jacobi rotation of the two columns of T', which is as accurate as the
    input is. That rotation is at most 45 degrees, so the new tangents are the ones closest to the images of the old
    ones and do not swap or flip from frame to frame while the surfel is clearly elongated.

    Parameters
    ----------
    gradient : (n, 3, 3) array
        Deformation gradients F; may be singular or mirror.
    rotation : (n, 3, 3) array
        Rotations [t_u, t_v, n].
    scale : (n, 2) array
        Standard deviations along t_u and t_v.

    Returns
    -------
    rotation : (n, 3, 3) array
        Of the dtype of the inputs. Right-handed; the third column is the normal of the image plane, on the same side of
        the matter as before: normalised sign(det F) cof(F) n. A tangent is flipped where F mirrors.
    scale : (n, 2) array
        Of the dtype of the inputs. 0 in a direction that F collapses; never NaN for finite input.
    """
    dtype = np.result_type(gradient, rotation, scale)
    tiny = np.finfo(dtype).tiny ** 0.5
    image = gradient @ (rotation[..., :2] * scale[..., None, :])
    u, v = image[..., 0], image[..., 1]
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    # tan(2 angle) = 2 uv / (uu - vv), taken in [-45, 45] degrees.
    angle = 0.5 * np.arctan2(2 * uv * np.where(uu < vv, -1, 1), np.abs(uu - vv))
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    u, v = c * u + s * v, c * v - s * u
    scale = np.stack([np.linalg.norm(u, axis=-1), np.linalg.norm(v, axis=-1)], -1).astype(dtype)

    # Where a direction collapsed (or a scale is 0) the images of the unit tangents and the old frame stand in.
    images = gradient @ rotation
    side = np.where(np.linalg.det(gradient) < 0, -1, 1)[..., None]
    cofactor = np.cross(images[..., 0], images[..., 1])  # cof(F) n
    spread = np.linalg.norm(images[..., 0], axis=-1) * np.linalg.norm(images[..., 1], axis=-1)
    flat = np.linalg.norm(cofactor, axis=-1) <= 64 * np.finfo(dtype).eps * spread
    cofactor = np.where(flat[..., None], 0, side * cofactor)
    normal = _first_direction(cofactor, images[..., 2], rotation[..., 2])
    tangent = _first_direction(u, images[..., 0], rotation[..., 0], rotation[..., 1], off=normal)
    # The longer image defines the plane best; rebuild the other as its right-handed partner.
    second = _first_direction(v, images[..., 1], rotation[..., 1], rotation[..., 0], off=normal)
    longer_u = (scale[..., 0] >= scale[..., 1])[..., None]
    tangent_u = np.where(longer_u, tangent, np.cross(second, normal))
    tangent_v = np.where(longer_u, np.cross(normal, tangent), second)
    scale = np.where(scale > tiny, scale, 0).astype(dtype)
    return np.stack([tangent_u, tangent_v, normal], -1).astype(dtype), scale


def paper_update(gradient: Array, rotation: Array, scale: Array, *, descending: bool = True) -> tuple[Array, Array]:
    """The update printed in the paper (equations 9 and 10): R' = polar(F) R, S' = diag(|l_2|, |l_1|) S.

    l_k are the eigenvalues of the symmetric factor of F in `descending` or ascending order, which the paper leaves
    open. Exact only where F is a rotation times a uniform scale. Shapes as in `surfel_update`; F must be invertible.
    """
    left, stretch, right = np.linalg.svd(gradient)  # descending
    polar = left @ right
    eigenvalues = stretch if descending else stretch[..., ::-1]
    return polar @ rotation, np.abs(eigenvalues[..., 1::-1]) * scale


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)


def _first_direction(*candidates: Array, off: Array | None = None) -> Array:
    """The first of `candidates` (n, 3) that has a direction (after projection off the unit vectors `off`)."""
    dtype = candidates[0].dtype
    result = np.zeros_like(candidates[0])
    missing = np.ones(result.shape[:-1], bool)
    for candidate in candidates:
        vector = candidate if off is None else candidate - off * _dot(candidate, off)[..., None]
        length = np.linalg.norm(vector, axis=-1)
        whole = np.linalg.norm(candidate, axis=-1)
        use = missing & (length > 64 * np.finfo(dtype).eps * whole) & (length > np.finfo(dtype).tiny ** 0.5)
        result[use] = vector[use] / length[use, None]
        missing &= ~use
    return result
