"""Blender's camera and render settings -> frame.Camera, with Blender's own framing to the pixel."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import bpy
import numpy as np
from mathutils import Matrix

from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.frame import Camera

#: For frames whose camera has no part in what is made of them.
NO_CAMERA = Camera(np.eye(4), 1, 1, 1.0, 1.0, 0.5, 0.5)
#: Types of cameras, and of the panoramas of one of type PANO, that can be rendered, with the engine's name of these.
TYPES = ("PERSP", "ORTHO", "PANO")
PANORAMAS: dict[str, Literal["equirectangular", "fisheye", "equisolid"]] = {
    "EQUIRECTANGULAR": "equirectangular",
    "FISHEYE_EQUIDISTANT": "fisheye",
    "FISHEYE_LENS_POLYNOMIAL": "fisheye",
    "FISHEYE_EQUISOLID": "equisolid",
}


def resolution(render: bpy.types.RenderSettings) -> tuple[int, int]:
    """Full picture in pixels, rounded as Blender rounds it."""
    percentage = render.resolution_percentage
    return max(1, render.resolution_x * percentage // 100), max(1, render.resolution_y * percentage // 100)


def picture_of(scene: bpy.types.Scene) -> bpy.types.RenderSettings:
    """Settings that say how large a scene's picture is: those of the scene over which it is laid, or its own."""
    return (scene.drgs.background_scene or scene).render


def border(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int] | None:
    """Render region as (x0, y0, x1, y1), row 0 at the top; None without one. Blender truncates single precision."""
    if not render.use_border:
        return None
    edges = (render.border_min_x, render.border_min_y, render.border_max_x, render.border_max_y)
    size = (width, height, width, height)
    x0, below, x1, above = (int(np.float32(e) * np.float32(s)) for e, s in zip(edges, size))
    if x1 <= x0 or above <= below:
        raise UsageError("Render Region", "contains no pixel", "Enlarge it or clear it with Ctrl Alt B")
    return x0, height - above, x1, height - below


def lens_of(data: bpy.types.Camera) -> Any:
    """What has the properties of a camera's panorama: before Blender 5.0 Cycles' settings; None where it is off."""
    return data if hasattr(data, "panorama_type") else getattr(data, "cycles", None)


def is_panoramic(camera: bpy.types.Object | None) -> bool:
    """Whether an object is a camera whose picture is curved."""
    return camera is not None and camera.type == "CAMERA" and camera.data.type == "PANO"


def check_lens(camera: bpy.types.Object) -> None:
    """UsageError where a camera is of a type that the engine has no rays for."""
    data = camera.data
    if data.type not in TYPES:
        raise UsageError(
            f'Camera "{camera.name}"',
            f"is of type {data.type.capitalize()}, which DR-GS cannot render",
            "Set Lens > Type to Perspective, Orthographic or Panoramic",
        )
    if data.type != "PANO":
        return
    lens = lens_of(data)
    if lens is None:
        raise UsageError(
            f'Camera "{camera.name}"', "is panoramic, and Cycles, which has the settings, is off", "Enable the add-on"
        )
    if lens.panorama_type not in PANORAMAS:
        kind = lens.panorama_type.replace("_", " ").title()
        raise UsageError(
            f'Camera "{camera.name}"',
            f"has the panorama type {kind}, which DR-GS cannot render",
            "Choose Equirectangular or one of the fisheyes",
        )


def export_camera(
    camera: bpy.types.Object,
    render: bpy.types.RenderSettings,
    matrix_world: Matrix | None = None,
    shift_x: float | None = None,
) -> Camera:
    """Describe an evaluated camera object.

    Parameters
    ----------
    matrix_world, shift_x : replace those of the camera (stereo views)

    Raises
    ------
    UsageError
        The object is no camera, or one of a type the engine has no rays for; its scale is zero or its transform not
        finite; or the render region is empty. Names the object.

    Notes
    -----
    As in Blender, the sensor spans the larger side of the (aspect-corrected) picture when the fit is AUTO, shifts
    are in units of the fitted side, and of the camera's matrix only rotation and position count.
    """
    if camera.type != "CAMERA":
        raise UsageError(
            f'Object "{camera.name}"',
            f"is the scene's camera, but of type {camera.type.capitalize()}",
            "Choose a camera in Scene > Camera",
        )
    check_lens(camera)
    data = camera.data
    orthographic = data.type == "ORTHO"
    width, height = resolution(render)
    aspect = render.pixel_aspect_y / render.pixel_aspect_x
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= aspect * height else "VERTICAL"
    # Pixels (of horizontal size) that the fitted side of the sensor spans.
    span = width if fit == "HORIZONTAL" else aspect * height
    if orthographic and not data.ortho_scale > 0:
        raise UsageError(
            f'Camera "{camera.name}"',
            f"has an Orthographic Scale of {data.ortho_scale:g}",
            "Make it larger than 0",
        )
    if orthographic:
        fx = span / data.ortho_scale
    else:
        fx = span * data.lens / (data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width)
    shift_x = data.shift_x if shift_x is None else shift_x
    flat = Camera(
        matrix_world=_pose(camera.name, matrix_world or camera.matrix_world),
        width=width,
        height=height,
        fx=fx,
        fy=fx / aspect,
        cx=width / 2 - shift_x * span,
        cy=height / 2 + data.shift_y * span / aspect,
        orthographic=orthographic,
        clip_start=data.clip_start,
        clip_end=data.clip_end,
        region=border(render, width, height),
    )
    return replace(flat, **_panorama(camera.name, data, flat, shift_x)) if data.type == "PANO" else flat


def _panorama(name: str, data: bpy.types.Camera, flat: Camera, shift_x: float) -> dict[str, Any]:
    """Fields of `flat`, the picture of the same camera in perspective, that differ in its panorama, as in Cycles."""
    lens = lens_of(data)
    panorama = PANORAMAS[lens.panorama_type]
    fields: dict[str, Any] = {"panorama": panorama}
    # Shifts are in units of either side.
    left, down = shift_x * flat.width, data.shift_y * flat.height
    if panorama == "equirectangular":
        across, along = lens.longitude_max - lens.longitude_min, lens.latitude_max - lens.latitude_min
        if not (across > 0 and along > 0):
            problem = "has longitudes or latitudes that end before they begin"
            raise UsageError(f'Camera "{name}"', problem, "Make the maxima larger than the minima")
        fx, fy = flat.width / across, flat.height / along
        return fields | {"fx": fx, "fy": fy, "cx": -lens.longitude_min * fx - left, "cy": lens.latitude_max * fy + down}
    fields |= {"fov": lens.fisheye_fov, "cx": flat.width / 2 - left, "cy": flat.height / 2 + down}
    if lens.panorama_type == "FISHEYE_EQUIDISTANT":
        return fields | {"fx": flat.width / lens.fisheye_fov, "fy": flat.height / lens.fisheye_fov}
    # Pixels per millimetre of the sensor, which is as that of the flat picture.
    per_mm, aspect = flat.fx / data.lens, flat.fx / flat.fy
    if panorama == "fisheye":
        angle = tuple(-getattr(lens, f"fisheye_polynomial_k{i}") for i in range(5))
        if not (np.isfinite(angle).all() and any(angle[1:])):
            problem = "has a Lens Polynomial that is no number, or the same everywhere"
            raise UsageError(f'Camera "{name}"', problem, "Check its coefficients, K1 to K4 are not all 0")
        return fields | {"fx": per_mm, "fy": per_mm / aspect, "lens": angle}
    fx = per_mm * lens.fisheye_lens
    return fields | {"fx": fx, "fy": fx / aspect, "fov": min(lens.fisheye_fov, 2 * math.pi)}


def _pose(name: str, matrix_world: Matrix) -> np.ndarray:
    """(4, 4) float64 without the scale; UsageError where nothing is left."""
    pose = np.array(matrix_world.normalized(), np.float64)
    if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3])) < 1e-6:
        raise UsageError(
            f'Camera "{name}"',
            "has a scale of 0 or a transform that is not finite",
            "Set its scale to 1, and check its parents, constraints and drivers",
        )
    return pose
