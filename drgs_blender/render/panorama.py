"""Panoramic cameras: directions of places on a curved picture, and the way back (`core.frame.Camera`).

The formulas are those of Cycles, whose cameras look along their own +X; ours look along -Z as all of Blender's. Places
are in radians, or focal lengths, from the principal point; x to the right, y upwards.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import njit
from ..core.frame import Camera

Array = np.ndarray

#: Number of each kind for kernels; 0: the picture is flat.
KINDS = {"": 0, "equirectangular": 1, "fisheye": 2, "equisolid": 3}
EQUIRECTANGULAR, _FISHEYE = 1, 2
#: Offsets into the array of `camera.camera_parameters`: kind; the end of the picture (angle of a fisheye from the axis,
#: distance of an equisolid's place); coefficients of the lens.
PANORAMA, END, LENS, PARAMETERS = 25, 26, 27, 32
#: Newton's steps of the way back through a fisheye lens.
_STEPS = 12


def lens_problem(camera: Camera) -> str | None:
    """What is wrong with the lens of a panoramic camera; None where nothing is."""
    if camera.panorama not in KINDS:
        return f"its panorama is {camera.panorama!r}"
    if camera.panorama and camera.orthographic:
        return "it is both panoramic and orthographic"
    if camera.panorama and not (math.isfinite(camera.fov) and camera.fov > 0):
        return f"its field of view is {camera.fov:g} radians"
    if camera.panorama == "fisheye" and not (np.isfinite(camera.lens).all() and any(camera.lens[1:])):
        return f"its lens polynomial has the coefficients {camera.lens}"
    return None


def fill_parameters(camera: Camera, out: Array) -> None:
    """Write the fields at this module's offsets into the array of `camera.camera_parameters`."""
    out[PANORAMA] = KINDS[camera.panorama]
    half = 0.5 * camera.fov
    out[END] = 2 * math.sin(0.5 * min(half, math.pi)) if camera.panorama == "equisolid" else half
    out[LENS:PARAMETERS] = camera.lens


@njit
def panorama_direction(p, x, y):  # type: ignore[no-untyped-def]
    """Direction of a place in a panorama.

    Parameters
    ----------
    p : (PARAMETERS,) float64 array
        `camera.camera_parameters`.
    x, y : float64
        Place, see the module's head.

    Returns
    -------
    x, y, z : float64
        Unit, in the camera's own frame; 0 where the lens sees nothing.
    """
    if p[PANORAMA] == EQUIRECTANGULAR:
        level = math.cos(y)
        return level * math.sin(x), math.sin(y), -level * math.cos(x)
    r = math.sqrt(x * x + y * y)
    angle = _angle(p, r)
    if p[PANORAMA] == _FISHEYE:
        seen = abs(angle) <= p[END]
    else:
        seen = r <= p[END]
    if not seen:
        return 0.0, 0.0, 0.0
    side = math.sin(angle) / r if r > 0.0 else 0.0
    return side * x, side * y, -math.cos(angle)


@njit
def _angle(p, r):  # type: ignore[no-untyped-def]
    """Angle from the axis at a distance from the principal point of a fisheye."""
    if p[PANORAMA] != _FISHEYE:
        return 2.0 * math.asin(min(0.5 * r, 1.0))
    return p[LENS] + r * (p[LENS + 1] + r * (p[LENS + 2] + r * (p[LENS + 3] + r * p[LENS + 4])))


@njit
def panorama_place(p, right, up, depth):  # type: ignore[no-untyped-def]
    """Place of a direction in a panorama: the inverse of `panorama_direction`.

    Parameters
    ----------
    p : (PARAMETERS,) float64 array
        `camera.camera_parameters`.
    right, up, depth : float64
        Along the camera's +X, +Y and -Z, of any length but 0.

    Returns
    -------
    x, y : float64
        Place, see the module's head.
    """
    aside = math.sqrt(right * right + up * up)
    if p[PANORAMA] == EQUIRECTANGULAR:
        return math.atan2(right, depth), math.atan2(up, math.sqrt(right * right + depth * depth))
    angle = math.atan2(aside, depth)
    if p[PANORAMA] == _FISHEYE:
        r = angle
        for _ in range(_STEPS):
            slope = p[LENS + 1] + r * (2.0 * p[LENS + 2] + r * (3.0 * p[LENS + 3] + r * 4.0 * p[LENS + 4]))
            r -= (_angle(p, r) - angle) / slope if slope != 0.0 else 0.0
    else:
        r = 2.0 * math.sin(0.5 * angle)
    scale = r / aside if aside > 0.0 else 0.0
    return scale * right, scale * up
