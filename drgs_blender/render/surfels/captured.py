"""Surfels shown as captured: unlit, in the view-dependent colours of their harmonics, blended as they were trained.

What the renderers of 3DGS (Kerbl et al. 2023) and 2DGS (Huang et al. 2024) show, at the sub-pixel positions of the
picture:

- The colour of a surfel is max(0, 1/2 + sum of its harmonics in the direction from the camera to its centre). A surfel
  that was bent or turned is asked in its frame at rest, which is exact. These are values of the display (sRGB).
- A surfel with a thickness is an ellipsoid: its image is that of EWA splatting, widened by 0.3 square pixels. Others
  are discs, met exactly, with the screen-space filter of 2DGS. Both filters are of a pixel, however many samples it
  has.
- All contributions are blended, in the order of the depths of their centres; not those of the heaviest surface alone.
- The blended colour is decoded to linear light for each sub-pixel sample.

Depth, normals, materials and objects are those of the heaviest surface, as for other surfels. Both pictures are made
by the one rasteriser: a splat's record says on which ellipse and at which depth it is met.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit, plain
from ...compute.threads import ELEMENTS, ROWS, over_range
from ...core.asset.model import PosedSurfels, Surfels
from ...core.frame import Camera
from ..camera import CLIP_END, CLIP_START, CX, CY, FILTER, FX, FY, ORTHOGRAPHIC, POSITION, SUBPIXELS
from ..pixel_filter import filter_reach
from ..surfel_columns import ALBEDO, OPACITY, SAMPLE, SIZE, SPLAT
from .harmonics import BANDS, harmonics
from .raster import SurfelSamples
from .splats import (
    CUT,
    DIM,
    LOW,
    MIN_ALPHA,
    RECORD,
    RX,
    RY,
    SHARE,
    ZC,
    A,
    B,
    D,
    N,
    Posed,
    Splats,
    arranged,
    project_surfel,
    to_camera,
)

Array = np.ndarray
Rasterise = Callable[[Splats, int, int], SurfelSamples]

#: Variance that 3DGS adds to the image of an ellipsoid, square pixels.
DILATION = 0.3
#: How far outside the picture, in its half widths, the projection is still linearised at the place itself.
_MARGIN = 0.3
#: Size at which no jump of depth is large enough to begin another surface.
_ONE_SURFACE = 1e30


@dataclass(slots=True)
class CapturedObject:
    """The surfels of an object that is shown as captured.

    Attributes
    ----------
    posed : PosedSurfels
        In this frame.
    rest : Surfels
        As captured, object space; with harmonics.
    mirrored : bool
        Whether the object's matrix mirrors.
    """

    posed: PosedSurfels
    rest: Surfels
    mirrored: bool


class RestSurfels(NamedTuple):
    """Surfels as captured, as kernels take them.

    Attributes
    ----------
    rotation, scale : array
        As of `Surfels`.
    thickness : (n,) float32 array
        Standard deviation along the normal, metres; 0: a disc.
    sh : (n, k, 3) float32 array
        Harmonics of whole bands.
    """

    rotation: Array
    scale: Array
    thickness: Array
    sh: Array

    @classmethod
    def of(cls, surfels: Surfels) -> RestSurfels:
        """The arrays of `surfels`."""
        assert surfels.sh is not None
        whole = next(k for k in BANDS if k <= surfels.sh.shape[1])
        thickness = surfels.extras.get("thickness")
        if thickness is None:
            thickness = np.zeros(len(surfels), np.float32)
        return cls(*map(plain, (surfels.rotation, surfels.scale, thickness, surfels.sh[:, :whole])))


class CapturedSplats(NamedTuple):
    """Captured surfels of a frame on the screen.

    Attributes
    ----------
    surfaces : Splats
        Met where they are, with their materials.
    colours : Splats
        The same, met at the depths of their centres, with the colours of the display as albedo; one surface.
    """

    surfaces: Splats
    colours: Splats


class CapturedSamples(NamedTuple):
    """Samples of some rows with captured objects in them.

    Attributes
    ----------
    samples : SurfelSamples
        Of all surfels.
    captured : (rows, width, subpixels) bool array
        Whether a sample shows a captured object.
    radiance : (rows, width, subpixels, 3) float32 array
        Linear Rec.709, what it shows there; elsewhere undefined.
    """

    samples: SurfelSamples
    captured: Array
    radiance: Array


def project(objects: Sequence[CapturedObject], camera: Camera, parameters: Array) -> CapturedSplats:
    """Project captured surfels and colour them for the camera.

    Parameters
    ----------
    objects : sequence of CapturedObject
        At least one.
    camera : Camera
    parameters : array
        `camera.camera_parameters`.
    """
    parts = [Posed.of(item.posed) for item in objects]
    posed = parts[0] if len(parts) == 1 else Posed(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    n = len(posed.centre)
    colour, third = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    first = 0
    for item, own in zip(objects, parts, strict=True):
        rows, sign = slice(first, first + len(item.posed)), -1.0 if item.mirrored else 1.0
        given = own.centre, own.tangent_u, own.tangent_v, RestSurfels.of(item.rest), sign, parameters
        over_range(_colour, len(item.posed), *given, colour[rows], third[rows], fewest=ELEMENTS // 8)
        first = rows.stop
    per_pixel = parameters.copy()
    per_pixel[SUBPIXELS] = 1.0
    screen, box, nearest = np.empty((n, RECORD), np.float32), np.empty((n, 4), np.int32), np.empty(n, np.float32)
    view = camera.window, (float(camera.width), float(camera.height)), per_pixel
    over_range(_project, n, posed, third, *view, screen, box, nearest, fewest=ELEMENTS // 8)
    surfaces, order = arranged(posed, (screen, box, nearest), camera.window, parameters)
    flat = surfaces.screen.copy()
    flat[:, D : D + 3] = flat[:, ZC, None] * flat[:, N : N + 3]
    shown = np.zeros((len(order), SPLAT), np.float32)
    shown[:, ALBEDO : ALBEDO + 3], shown[:, SIZE] = colour[order], _ONE_SURFACE
    shown[:, OPACITY] = surfaces.surface[:, OPACITY]
    return CapturedSplats(surfaces, surfaces._replace(screen=flat, surface=shown))


def blend(captured: CapturedSplats, others: Splats, y0: int, y1: int, rasterise: Rasterise) -> CapturedSamples:
    """Blend captured surfels and the others for the rows ``y0 .. y1`` (full-picture pixels, inside the window).

    What is nearer hides the other as far as it is opaque; of the two, the one that shows more is the sample's.

    Parameters
    ----------
    captured : CapturedSplats
    others : Splats
        Of objects that are lit.
    y0, y1 : int
    rasterise : callable
        As `raster.rasterise`.
    """
    samples = rasterise(others, y0, y1)
    own, colours = rasterise(captured.surfaces, y0, y1), rasterise(captured.colours, y0, y1)
    shape = samples.alpha.shape
    shows, radiance = np.zeros(shape, np.bool_), np.empty((*shape, 3), np.float32)
    given = SurfelSamples(*samples), SurfelSamples(*own), colours.alpha, colours.surface
    over_range(_merge, len(shows), *given, shows, radiance, fewest=ROWS)
    return CapturedSamples(given[0], shows, radiance)


@njit
def _merge(y0, y1, samples, own, alphas, colours, shows, radiance):  # type: ignore[no-untyped-def]
    """Put the captured surfels `own` into `samples` where they show more, with their radiance."""
    zero, one = np.float32(0.0), np.float32(1.0)
    _, columns, subpixels = alphas.shape
    for y in range(y0, y1):
        for x in range(columns):
            for k in range(subpixels):
                a, s = alphas[y, x, k], samples.alpha[y, x, k]
                if not (a > zero and own.alpha[y, x, k] > zero):
                    continue
                samples.alpha[y, x, k] = a + s - a * s
                if s > zero:
                    before = own.depth[y, x, k] < samples.depth[y, x, k]
                    mine, other = (a, (one - a) * s) if before else ((one - s) * a, s)
                    if other >= mine:
                        continue
                shows[y, x, k] = True
                samples.depth[y, x, k] = own.depth[y, x, k]
                samples.object_index[y, x, k] = own.object_index[y, x, k]
                for c in range(SAMPLE):
                    samples.surface[y, x, k, c] = own.surface[y, x, k, c]
                for c in range(3):
                    value = np.float64(colours[y, x, k, ALBEDO + c])
                    linear = value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
                    radiance[y, x, k, c] = np.float32(linear)


@njit
def _colour(first, last, centre, tangent_u, tangent_v, rest, sign, p, colour, third):  # type: ignore[no-untyped-def]
    """Colours of surfels towards the camera, and their third axes in the world."""
    values = np.empty(BANDS[0])
    count = rest.sh.shape[1]
    for i in range(first, last):
        if p[ORTHOGRAPHIC] != 0.0:
            dx, dy, dz = -p[2], -p[5], -p[8]
        else:
            dx, dy, dz = centre[i, 0] - p[POSITION], centre[i, 1] - p[POSITION + 1], centre[i, 2] - p[POSITION + 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        length = 1.0 / length if length > 1e-300 else 0.0
        dx, dy, dz = dx * length, dy * length, dz * length
        w, x, y, z = (
            np.float64(rest.rotation[i, 0]), np.float64(rest.rotation[i, 1]),
            np.float64(rest.rotation[i, 2]), np.float64(rest.rotation[i, 3]),
        )  # fmt: skip
        u0, u1, u2 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
        v0, v1, v2 = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)
        n0, n1, n2 = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        (px, py, pz), (qx, qy, qz), growth = _turned(tangent_u, tangent_v, rest.scale, i)
        if growth > 0.0:
            nx, ny, nz = sign * (py * qz - pz * qy), sign * (pz * qx - px * qz), sign * (px * qy - py * qx)
        else:  # it has collapsed
            px, py, pz, qx, qy, qz, nx, ny, nz = u0, u1, u2, v0, v1, v2, n0, n1, n2
        thick = np.sqrt(growth) * rest.thickness[i]
        third[i, 0], third[i, 1], third[i, 2] = thick * nx, thick * ny, thick * nz
        along_u, along_v, along_n = (
            dx * px + dy * py + dz * pz, dx * qx + dy * qy + dz * qz, dx * nx + dy * ny + dz * nz,
        )  # fmt: skip
        harmonics(
            along_u * u0 + along_v * v0 + along_n * n0,
            along_u * u1 + along_v * v1 + along_n * n1,
            along_u * u2 + along_v * v2 + along_n * n2,
            count, values,
        )  # fmt: skip
        for c in range(3):
            total = 0.5
            for k in range(count):
                total += values[k] * rest.sh[i, k, c]
            colour[i, c] = max(total, 0.0)


@njit
def _turned(tangent_u, tangent_v, scale, i):  # type: ignore[no-untyped-def]
    """A surfel's unit tangents, turned as its deformation turns them, and by how much that made its area grow.

    The polar decomposition of what its deformation gradient does in its plane: with G = M^T M of the 3 x 2 matrix M
    and s the root of its determinant, the root of G is (G + s) / t with t^2 = trace G + 2 s.
    """
    su, sv = 1.0 / max(np.float64(scale[i, 0]), 1e-30), 1.0 / max(np.float64(scale[i, 1]), 1e-30)
    ax, ay, az = tangent_u[i, 0] * su, tangent_u[i, 1] * su, tangent_u[i, 2] * su
    bx, by, bz = tangent_v[i, 0] * sv, tangent_v[i, 1] * sv, tangent_v[i, 2] * sv
    p, q, r = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
    determinant = p * r - q * q
    if not determinant > 1e-12 * (p + r) * (p + r):
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    s = np.sqrt(determinant)
    k = 1.0 / (s * np.sqrt(p + r + 2.0 * s))
    e, f, g = k * (r + s), k * q, k * (p + s)
    return (
        (e * ax - f * bx, e * ay - f * by, e * az - f * bz),
        (g * bx - f * ax, g * by - f * ay, g * bz - f * az),
        s,
    )


@njit
def _project(first, last, posed, third, window, size, p, screen, box, nearest):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        if third[i, 0] == 0.0 and third[i, 1] == 0.0 and third[i, 2] == 0.0:
            project_surfel(i, posed, p, window, screen, box, nearest)
            screen[i, DIM], screen[i, SHARE] = 0.0, 1.0
        else:
            _project_ellipsoid(i, posed, third, p, window, size, screen, box, nearest)


@njit
def _project_ellipsoid(i, posed, third, p, window, size, screen, box, nearest):  # type: ignore[no-untyped-def]
    """The record of a surfel with three axes: `splats.project_surfel`, by EWA splatting (Zwicker et al. 2001).

    `size` is that of the full picture, pixels.
    """
    for side in range(4):
        box[i, side] = 0
    near, far, ortho, fx, fy = p[CLIP_START], p[CLIP_END], p[ORTHOGRAPHIC] != 0.0, p[FX], p[FY]
    x, y, depth = to_camera(
        p, posed.centre[i, 0] - p[POSITION], posed.centre[i, 1] - p[POSITION + 1], posed.centre[i, 2] - p[POSITION + 2]
    )  # fmt: skip
    alpha = np.float64(posed.opacity[i])
    if not (alpha > MIN_ALPHA and depth > near and depth < far):
        return
    cut = 2.0 * np.log(alpha / MIN_ALPHA)
    scale_x, scale_y, lean_x, lean_y = fx, fy, 0.0, 0.0
    rx, ry = p[CX] + fx * x, p[CY] + fy * y
    if not ortho:
        rx, ry, scale_x, scale_y = p[CX] + fx * x / depth, p[CY] + fy * y / depth, fx / depth, fy / depth
        wide, high = _MARGIN * 0.5 * size[0] / fx, _MARGIN * 0.5 * size[1] / fy
        lean_x = min(max(x / depth, -p[CX] / fx - wide), (size[0] - p[CX]) / fx + wide)
        lean_y = min(max(y / depth, -p[CY] / fy - high), (size[1] - p[CY]) / fy + high)
    xx, xy, yy = DILATION, 0.0, DILATION
    for axis in (posed.tangent_u, posed.tangent_v, third):
        ax, ay, az = to_camera(p, np.float64(axis[i, 0]), np.float64(axis[i, 1]), np.float64(axis[i, 2]))
        ax, ay = scale_x * (ax - lean_x * az), scale_y * (ay - lean_y * az)
        xx, xy, yy = xx + ax * ax, xy + ax * ay, yy + ay * ay
    determinant = xx * yy - xy * xy
    if not (determinant > 0.0 and determinant < 1e30):
        return
    for column in range(RECORD):
        screen[i, column] = 0.0
    screen[i, RX], screen[i, RY], screen[i, ZC], screen[i, CUT], screen[i, LOW] = rx, ry, depth, cut, 1e30
    # u^2 + v^2 is the quadratic form of the inverse covariance, by its Cholesky factor.
    screen[i, A + 1], screen[i, A + 2] = np.sqrt(yy / determinant), -xy / np.sqrt(yy * determinant)
    screen[i, B + 2] = 1.0 / np.sqrt(yy)
    screen[i, N], screen[i, D], screen[i, SHARE] = 1.0, depth, 1.0
    reach = filter_reach(p[FILTER])
    wide, high = np.sqrt(cut * xx) + reach, np.sqrt(cut * yy) + reach
    wx0, wy0, wx1, wy1 = window
    if not (rx - wide < wx1 and rx + wide > wx0 and ry - high < wy1 and ry + high > wy0):
        return
    box[i, 0] = np.int32(np.floor(max(rx - wide, float(wx0))))
    box[i, 1] = np.int32(np.floor(max(ry - high, float(wy0))))
    box[i, 2] = np.int32(min(np.floor(rx + wide), wx1 - 1.0)) + 1
    box[i, 3] = np.int32(min(np.floor(ry + high), wy1 - 1.0)) + 1
    nearest[i] = depth
