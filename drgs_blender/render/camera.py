"""Camera rays, through sub-pixel positions drawn from the pixel filter.

Both primary stages (surfels and mesh) look through the same positions, so their pictures can be compared pixel by
pixel. The positions of a pixel are a rank-1 lattice (k / n, k * golden ratio), shifted on the torus by a hash of
(seed, frame, pixel): evenly spread for every n, uniform one by one, hence an unbiased box filter of one pixel. Filters
of another shape warp them (`pixel_filter`).
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit
from ..core.errors import UsageError
from ..core.frame import Camera, RenderSettings
from .panorama import PANORAMA, PARAMETERS, fill_parameters, lens_problem, panorama_direction
from .pixel_filter import check_filter, filter_position
from .sampling import GOLDEN, mix

Array = np.ndarray

#: Offsets into the array of `camera_parameters`.
POSITION, FX, FY, CX, CY, ORTHOGRAPHIC, CLIP_START, CLIP_END, WIDTH, SEED, SUBPIXELS, LEAN, FILTER = (
    *(9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 24),
)
_GOLDEN_RATIO = 0.6180339887498949


def check_camera(camera: Camera) -> None:
    """Raise UsageError when no picture can be taken through `camera`."""

    def refuse(problem: str, remedy: str) -> None:
        raise UsageError("camera", problem, remedy)

    matrix = np.asarray(camera.matrix_world, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        refuse("its matrix is not a finite 4 x 4 matrix", "Check the camera's transform and its drivers")
    rotation = matrix[:3, :3].copy()
    if camera.orthographic:
        rotation[:, 2] -= rotation[:, :2] @ lean(camera)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3:
        refuse("its matrix scales or shears", "Apply the scale of the camera and of its parents")
    if camera.width < 1 or camera.height < 1:
        refuse(f"the picture has {camera.width} x {camera.height} pixels", "Choose a resolution of at least one pixel")
    if max(camera.width, camera.height) > 65536 or camera.width * camera.height > 2**31 - 1:
        refuse(f"the picture has {camera.width} x {camera.height} pixels", "Render it in several parts")
    if problem := lens_problem(camera):
        refuse(problem, "Check the camera's panorama type, field of view and lens")
    if not all(math.isfinite(focal) and focal > 0 for focal in (camera.fx, camera.fy)):
        refuse(
            f"its focal lengths are {camera.fx:g} and {camera.fy:g} pixels",
            "Check focal length, sensor size, orthographic scale and pixel aspect",
        )
    if not (math.isfinite(camera.cx) and math.isfinite(camera.cy)):
        refuse(f"its principal point is at {camera.cx:g}, {camera.cy:g} pixels", "Check the camera's shift")
    if not (math.isfinite(camera.clip_start) and camera.clip_end > camera.clip_start):
        refuse(f"it clips from {camera.clip_start:g} to {camera.clip_end:g}", "Let the clip end exceed the clip start")
    if camera.clip_start <= 0 and not camera.orthographic:
        refuse(f"its clip start is {camera.clip_start:g}", "Choose a clip start above zero")
    x0, y0, x1, y1 = camera.window
    if not (0 <= x0 < x1 <= camera.width and 0 <= y0 < y1 <= camera.height):
        refuse(f"the region {camera.window} is empty or leaves the picture", "Clear or redraw the render region")


def lean(camera: Camera) -> Array:
    """(2,) float64: how far rays go to the left and down per metre along the view axis.

    They leave it where an orthographic camera looks through one place of its lens (`ipc.blur.camera_on_lens`).
    """
    matrix = np.asarray(camera.matrix_world, dtype=np.float64)
    return matrix[:3, :2].T @ matrix[:3, 2] if camera.orthographic else np.zeros(2)


def camera_parameters(camera: Camera, settings: RenderSettings, noise_index: int) -> Array:
    """Flatten the camera, sub-pixel count and seed for kernels.

    Returns
    -------
    (PARAMETERS,) float64 array
        The camera-to-world matrix (row-major), then the fields named by this module's offsets.

    Raises
    ------
    UsageError: the camera cannot take a picture, ``settings.subpixel_samples`` is negative, or there is no such pixel
    filter.
    """
    check_camera(camera)
    if settings.subpixel_samples < 0:
        raise UsageError(
            "sub-pixel samples", f"are {settings.subpixel_samples}", "Choose some, or 0 for as many as suit the rays"
        )
    check_filter(settings.filter_width)
    matrix = np.asarray(camera.matrix_world, dtype=np.float64)
    out = np.empty(PARAMETERS)
    out[:9] = matrix[:3, :3].ravel()
    out[POSITION : POSITION + 3] = matrix[:3, 3]
    out[FX], out[FY], out[CX], out[CY] = camera.fx, camera.fy, camera.cx, camera.cy
    out[ORTHOGRAPHIC] = camera.orthographic
    out[CLIP_START], out[CLIP_END], out[WIDTH] = camera.clip_start, camera.clip_end, camera.width
    out[SEED] = mix(np.uint32(settings.seed & 0xFFFFFFFF) ^ np.uint32(mix(np.uint32(noise_index & 0xFFFFFFFF))))
    out[SUBPIXELS] = settings.subpixel_count
    out[LEAN : LEAN + 2] = lean(camera)
    out[FILTER] = settings.filter_width
    fill_parameters(camera, out)
    return out


def footprints(depth: Array, parameters: Array) -> Array:
    """(h, w) float32 metres: width of a pixel at `depth` (h, w) before the camera of `camera_parameters`."""
    per_metre = np.float32(1.0 / min(parameters[FX], parameters[FY]))
    return np.full_like(depth, per_metre) if parameters[ORTHOGRAPHIC] != 0.0 else depth * per_metre


@njit
def pixel_shift(parameters, pixel):  # type: ignore[no-untyped-def]
    """Toroidal shift of the sub-pixel lattice of a pixel.

    Parameters
    ----------
    parameters : (PARAMETERS,) float64 array
        `camera_parameters`.
    pixel : int64
        y * width + x in the full picture.

    Returns
    -------
    x, y : float64
        In [0, 1).
    """
    h = mix(np.uint32(pixel) ^ np.uint32(np.int64(parameters[SEED])))
    g = mix(h ^ GOLDEN)
    return np.float64(h) * 2.0**-32, np.float64(g) * 2.0**-32


@inlined
def lattice(shift_x, shift_y, sample, parameters):  # type: ignore[no-untyped-def]
    """Position of a pixel's sub-pixel sample: in [0, 1) inside the pixel, or `filter_reach` beyond it.

    Parameters
    ----------
    shift_x, shift_y : float64
        `pixel_shift` of the pixel.
    sample : int64
        Sub-pixel sample.
    parameters : (PARAMETERS,) float64 array
        `camera_parameters`.

    Returns
    -------
    x, y : float64
        Pixels, from the pixel's upper left corner.
    """
    x = shift_x + sample / parameters[SUBPIXELS]
    y = shift_y + sample * _GOLDEN_RATIO
    width = parameters[FILTER]
    return filter_position(x - math.floor(x), width), filter_position(y - math.floor(y), width)


@njit
def camera_ray(parameters, px, py):  # type: ignore[no-untyped-def]
    """Camera ray through a position in the picture, world space.

    Parameters
    ----------
    parameters : (PARAMETERS,) float64 array
        `camera_parameters`.
    px, py : float64
        Pixels, from the upper left corner of the full picture.

    Returns
    -------
    ox, oy, oz : float64
        Origin, world, m.
    dx, dy, dz : float64
        Direction, world, of length 1 along the view axis, so that the ray's parameter is the depth; of a panoramic
        camera of length 1, or 0 where its lens sees nothing.
    """
    p = parameters
    x = (px - p[CX]) / p[FX]
    y = -(py - p[CY]) / p[FY]
    ox, oy, oz = p[POSITION], p[POSITION + 1], p[POSITION + 2]
    if p[ORTHOGRAPHIC] != 0.0:
        return (
            ox + p[0] * x + p[1] * y,
            oy + p[3] * x + p[4] * y,
            oz + p[6] * x + p[7] * y,
            -p[2],
            -p[5],
            -p[8],
        )
    if p[PANORAMA] != 0.0:
        x, y, z = panorama_direction(p, x, y)
        return (
            ox,
            oy,
            oz,
            p[0] * x + p[1] * y + p[2] * z,
            p[3] * x + p[4] * y + p[5] * z,
            p[6] * x + p[7] * y + p[8] * z,
        )
    return (
        ox,
        oy,
        oz,
        p[0] * x + p[1] * y - p[2],
        p[3] * x + p[4] * y - p[5],
        p[6] * x + p[7] * y - p[8],
    )


@njit
def sample_ray(parameters, pixel, sample):  # type: ignore[no-untyped-def]
    """`camera_ray` through a sub-pixel sample.

    Parameters
    ----------
    parameters : (PARAMETERS,) float64 array
        `camera_parameters`.
    pixel : int64
        y * width + x in the full picture.
    sample : int64
        Sub-pixel sample.

    Returns
    -------
    ox, oy, oz, dx, dy, dz : float64
        As of `camera_ray`.
    """
    width = np.int64(parameters[WIDTH])
    shift_x, shift_y = pixel_shift(parameters, pixel)
    jx, jy = lattice(shift_x, shift_y, sample, parameters)
    return camera_ray(parameters, pixel % width + jx, pixel // width + jy)
