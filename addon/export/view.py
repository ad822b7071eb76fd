"""A 3D viewport -> frame.Camera: whatever it looks through, to the pixel of its region."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.frame import Camera
from .camera import export_camera, is_panoramic, picture_of, resolution

#: Part of the picture's side by which two cameras differ that are the same but for rounding.
_SAME = 1e-4


def view_camera(
    region: bpy.types.Region,
    space: bpy.types.SpaceView3D,
    rv3d: bpy.types.RegionView3D,
    scene: bpy.types.Scene,
    curved: bool = False,
) -> Camera | None:
    """The camera whose picture covers the region, border included; None where there is nothing to render.

    Zoom, offset, shift and lens of a camera view are in the viewport's own projection, which is read here. A panoramic
    camera fills its frame in the region where pictures may be `curved`; other engines show its view in perspective.
    """
    size = pixel_size(scene)
    width, height = max(1, round(region.width / size)), max(1, round(region.height / size))
    if curved and rv3d.view_perspective == "CAMERA" and is_panoramic(space.camera):
        return _panorama(space, rv3d, scene, width, height)
    projection = np.array(rv3d.window_matrix, np.float64)
    pose = np.array(rv3d.view_matrix.inverted().normalized(), np.float64)
    if not (np.isfinite(projection).all() and np.isfinite(pose).all()) or projection[0, 0] * projection[1, 1] <= 0:
        return None
    orthographic = not rv3d.is_perspective
    column, sign = (3, 1.0) if orthographic else (2, -1.0)
    near, far = _clip(projection, orthographic, space, rv3d)
    back = setback(rv3d)
    pose[:3, 3] += back * pose[:3, 2]
    window = _border(space, rv3d, scene, width, height)
    if window is not None and (window[2] <= window[0] or window[3] <= window[1]):
        return None
    found = Camera(
        matrix_world=pose,
        width=width,
        height=height,
        fx=width / 2 * projection[0, 0],
        fy=height / 2 * projection[1, 1],
        cx=width / 2 * (1 + sign * projection[0, column]),
        cy=height / 2 * (1 - sign * projection[1, column]),
        orthographic=orthographic,
        clip_start=max(near + back, 0.0) if orthographic else near,
        clip_end=far + back,
        region=window,
    )
    if rv3d.view_perspective == "CAMERA" and space.camera == scene.camera:
        return _final(found, scene) or found
    return found


def _panorama(
    space: bpy.types.SpaceView3D, rv3d: bpy.types.RegionView3D, scene: bpy.types.Scene, width: int, height: int
) -> Camera | None:
    """The picture of a panoramic camera, in its frame in a region of `width` x `height` pixels."""
    frame = _camera_frame(space.camera, rv3d, scene)
    if frame is None:
        return None
    render = picture_of(scene)
    final = export_camera(space.camera, render)
    if final.region is None and (width, height) == (final.width, final.height) and np.allclose(frame, (0, 0, 1, 1)):
        return final
    x0, y0, x1, y1 = frame[0] * width, (1 - frame[3]) * height, frame[2] * width, (1 - frame[1]) * height
    sx, sy = (x1 - x0) / final.width, (y1 - y0) / final.height
    left, top, right, bottom = final.window
    edges = (x0 + sx * left, y0 + sy * top, x0 + sx * right, y0 + sy * bottom)
    ends = (width, height, width, height)
    left, top, right, bottom = (min(max(round(edge), 0), end) for edge, end in zip(edges, ends))
    if right <= left or bottom <= top:
        return None
    return replace(
        final,
        width=width,
        height=height,
        fx=final.fx * sx,
        fy=final.fy * sy,
        cx=x0 + final.cx * sx,
        cy=y0 + final.cy * sy,
        region=(left, top, right, bottom),
    )


def _final(seen: Camera, scene: bpy.types.Scene) -> Camera | None:
    """The camera of the final picture where the region shows exactly that, pixel by pixel.

    The viewport's projection is rounded to single precision; with the same camera the pictures are the same.
    """
    render = picture_of(scene)
    if (seen.width, seen.height) != resolution(render):
        return None
    try:
        final = export_camera(scene.camera, render)
    except UsageError:
        return None
    if seen.orthographic != final.orthographic or (seen.region is None) != (final.region is None):
        return None
    names = ("fx", "fy", "cx", "cy")
    off = [abs(getattr(seen, n) - getattr(final, n)) / max(seen.width, seen.height) for n in names]
    return final if max(off) < _SAME and np.allclose(seen.matrix_world, final.matrix_world, atol=1e-4) else None


def pixel_size(scene: bpy.types.Scene) -> int:
    """Side of the viewport's pixels in those of the screen, as Render > Performance > Viewport says."""
    size = scene.render.preview_pixel_size
    if size == "AUTO":
        return 2 if bpy.context.preferences.system.pixel_size > 1.5 else 1
    return int(size)


def setback(rv3d: bpy.types.RegionView3D) -> float:
    """Metres by which a view is taken from farther behind: an orthographic one sees what is behind its own place.

    Not from behind everything that it could see, where single precision would be lost.
    """
    if rv3d.is_perspective:
        return 0.0
    near = (rv3d.window_matrix[2][3] + 1) / rv3d.window_matrix[2][2]
    return min(-near, 100 * rv3d.view_distance) if near < 0 else 0.0


def _clip(
    projection: np.ndarray, orthographic: bool, space: bpy.types.SpaceView3D, rv3d: bpy.types.RegionView3D
) -> tuple[float, float]:
    """Distances between which things are seen; negative ones are behind the view."""
    if orthographic:
        return (projection[2, 3] + 1) / projection[2, 2], (projection[2, 3] - 1) / projection[2, 2]
    lens = space.camera.data if rv3d.view_perspective == "CAMERA" and space.camera.type == "CAMERA" else space
    return lens.clip_start, lens.clip_end


def _border(
    space: bpy.types.SpaceView3D, rv3d: bpy.types.RegionView3D, scene: bpy.types.Scene, width: int, height: int
) -> tuple[int, int, int, int] | None:
    """(x0, y0, x1, y1) in pixels, row 0 at the top: what the user wants to see rendered; None for everything."""
    if rv3d.view_perspective == "CAMERA":
        used, owner, prefix = scene.render.use_border, scene.render, "border"
        frame = _camera_frame(space.camera, rv3d, scene)
    else:
        used, owner, prefix = space.use_render_border, space, "render_border"
        frame = (0.0, 0.0, 1.0, 1.0)
    if not used or frame is None:
        return None
    low_x, low_y, high_x, high_y = (getattr(owner, f"{prefix}_{name}") for name in ("min_x", "min_y", "max_x", "max_y"))
    x0, y0, x1, y1 = frame
    left, right = (round(width * (x0 + (x1 - x0) * x)) for x in (low_x, high_x))
    bottom, top = (round(height * (1 - (y0 + (y1 - y0) * y))) for y in (low_y, high_y))
    return max(left, 0), max(top, 0), min(right, width), min(bottom, height)


def _camera_frame(
    camera: bpy.types.Object | None, rv3d: bpy.types.RegionView3D, scene: bpy.types.Scene
) -> tuple[float, float, float, float] | None:
    """(x0, y0, x1, y1) of the camera's frame in the region, 0 to 1, y upwards."""
    if camera is None or camera.type != "CAMERA":
        return None
    place = rv3d.window_matrix @ rv3d.view_matrix @ Matrix(camera.matrix_world.normalized())
    corners = [place @ Vector((*corner, 1.0)) for corner in camera.data.view_frame(scene=scene)]
    points = np.array([(c.x / c.w, c.y / c.w) for c in corners if abs(c.w) > 1e-9]) / 2 + 0.5
    return (*points.min(axis=0), *points.max(axis=0)) if len(points) == 4 else None
