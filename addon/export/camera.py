"""Blender's camera and render settings -> frame.Camera, with Blender's own framing to the pixel."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.frame import Camera

#: For frames whose camera has no part in what is made of them.
NO_CAMERA = Camera(np.eye(4), 1, 1, 1.0, 1.0, 0.5, 0.5)
#: Camera type -> orthographic? What is not here cannot be rendered.
SUPPORTED = {"PERSP": False, "ORTHO": True}


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


def check_lens(camera: bpy.types.Object) -> None:
    """UsageError where a camera is of a type that the engine has no rays for."""
    if camera.data.type not in SUPPORTED:
        raise UsageError(
            f'Camera "{camera.name}"',
            f"is of type {camera.data.type.capitalize()}, which DR-GS cannot render",
            "Set Lens > Type to Perspective or Orthographic",
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
    orthographic = SUPPORTED[data.type]
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
    return Camera(
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
