"""Renderers of 3DGS and 2DGS in plain numpy, written from their papers and public code, as a reference.

Kerbl et al. 2023, "3D Gaussian Splatting"; Huang et al. 2024, "2D Gaussian Splatting". Every splat against every
position, in double precision; nothing of this project's renderer is used.
"""

from __future__ import annotations

import numpy as np

from drgs_blender.core.frame import Camera

Array = np.ndarray

#: Opacity below which a splat is skipped, that at which it is clamped, and transmittance at which blending stops.
LEAST, MOST, STOP = 1 / 255, 0.99, 1e-4
#: Dilation of 3DGS, and inverse square of the size of 2DGS' filter, pixels.
DILATION, FILTER = 0.3, 2.0


def view_colours(centre: Array, sh: Array, eye: Array) -> Array:
    """(n, 3) colours of the display, as `eval_sh` of 3DGS has them, up to degree 3."""
    d = centre - eye
    x, y, z = (d / np.linalg.norm(d, axis=1, keepdims=True)).T[:, :, None]
    one = np.ones_like(x)
    terms = [0.28209479177387814 * one, *(0.4886025119029199 * t for t in (-y, z, -x))]
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    terms += [1.0925484305920792 * xy, -1.0925484305920792 * yz, 0.31539156525252005 * (2 * zz - xx - yy)]
    terms += [-1.0925484305920792 * xz, 0.5462742152960396 * (xx - yy)]
    terms += [-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * xy * z]
    terms += [-0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)]
    terms += [-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)]
    terms += [-0.5900435899266435 * x * (xx - 3 * yy)]
    return np.maximum(sum(t * sh[:, k] for k, t in enumerate(terms[: sh.shape[1]])) + 0.5, 0.0)


def rotations(q: Array) -> Array:
    """(n, 3, 3) matrices of quaternions (r, x, y, z), as `build_rotation` of 3DGS."""
    r, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y)),
        (2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x)),
        (2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def render(
    centre: Array, scale: Array, rotation: Array, opacity: Array, sh: Array, camera: Camera, positions: Array
) -> tuple[Array, Array]:
    """Colours (p, 3) of the display over black, and opacities (p,), at positions (p, 2) in pixels.

    `scale` (n, 3) is of 3DGS, (n, 2) of 2DGS.
    """
    centre, scale, sh = (np.asarray(a, np.float64) for a in (centre, scale, sh))
    matrix = np.asarray(camera.matrix_world, np.float64)
    view, eye = (matrix[:3, :3] * [1, -1, -1]).T, matrix[:3, 3]  # x right, y down, z forward
    at, axes = (centre - eye) @ view.T, rotations(np.asarray(rotation, np.float64))
    colours = view_colours(centre, sh, eye)
    shown, left = np.zeros((len(positions), 3)), np.ones(len(positions))
    live = np.ones(len(positions), bool)
    for i in np.argsort(at[:, 2], kind="stable"):
        if at[i, 2] <= camera.clip_start:
            continue
        axes_seen = view @ (axes[i][:, : scale.shape[1]] * scale[i])
        square = _ellipsoid if scale.shape[1] == 3 else _disc
        q = square(at[i], axes_seen, camera, positions)
        alpha = np.minimum(opacity[i] * np.exp(-0.5 * q), MOST)
        alpha[(alpha < LEAST) | ~live] = 0.0
        live &= left * (1 - alpha) >= STOP
        alpha[~live] = 0.0
        shown += (left * alpha)[:, None] * colours[i]
        left *= 1 - alpha
    return shown, 1 - left


def _ellipsoid(at: Array, axes: Array, camera: Camera, positions: Array) -> Array:
    """Square radii by EWA splatting, `computeCov2D` of 3DGS."""
    fx, fy, z = camera.fx, camera.fy, at[2]
    limit = 1.3 * 0.5 * np.array([camera.width / fx, camera.height / fy])
    tx, ty = np.clip(at[:2] / z, -limit, limit) * z
    jacobian = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]]) @ axes
    inverse = np.linalg.inv(jacobian @ jacobian.T + DILATION * np.eye(2))
    d = positions - [fx * at[0] / z + camera.cx, fy * at[1] / z + camera.cy]
    return np.einsum("ni,ij,nj->n", d, inverse, d)


def _disc(at: Array, axes: Array, camera: Camera, positions: Array) -> Array:
    """Square radii where rays meet the disc, equations 8 to 11 of 2DGS."""
    pixels = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    a, b, c = pixels @ np.column_stack([axes, at])
    p = np.cross(positions[:, :1] * c - a, positions[:, 1:] * c - b)
    with np.errstate(divide="ignore", invalid="ignore"):
        met = ((p[:, :2] / p[:, 2:]) ** 2).sum(axis=1)
    d = positions - [a[2] / c[2], b[2] / c[2]]
    return np.fmin(np.where(np.isfinite(met), met, np.inf), FILTER * (d**2).sum(axis=1))
