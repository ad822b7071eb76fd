"""Times of the shutter and places of the lens whose pictures make motion blur and depth of field, by their mean."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ...drgs_blender.core.errors import first_of
from ..property_limits import Limited
from .camera import is_panoramic

Warn = Callable[[str], None]

#: Metres at which a lens focuses at least.
_NEAREST = 1e-4
#: Share of the open shutter that lies before the frame.
_BEFORE = {"START": 0.0, "CENTER": 0.5, "END": 1.0}


@dataclass(frozen=True, slots=True)
class Step:
    """One of the pictures.

    Attributes
    ----------
    time : frames before (negative) or after the frame's own
    lens : position of its centre of projection in the aperture, metres to the right and up
    """

    time: float
    lens: tuple[float, float]


def steps(
    scene: bpy.types.Scene,
    layer: bpy.types.ViewLayer,
    camera: bpy.types.Object | None,
    warn: Warn,
    moving: bool = True,
) -> list[Step]:
    """The pictures that make one of a scene's view layer; none where nothing is blurred.

    Parameters
    ----------
    camera : evaluated; None: no lens, all is in focus
    moving : whether motion is blurred where scene and view layer say so
    """
    render = scene.render
    radius = 0.0 if camera is None else _radius(camera.data)
    if camera is not None and radius and is_panoramic(camera):
        warn(f'Camera "{camera.name}": panoramas have no depth of field in DR-GS; all is sharp')
        radius = 0.0
    moving = moving and render.use_motion_blur and layer.use_motion_blur
    shutter = render.motion_blur_shutter if moving else 0.0
    if not (radius or shutter):
        return []
    if shutter:
        _warn_of_cycles_own(scene, layer, warn)
    count = Limited(scene.drgs, f'Scene "{scene.name}"', warn).blur_steps
    start = -shutter * _BEFORE[render.motion_blur_position]
    # Times are even; places on the lens are of a low-discrepancy sequence (Roberts 2018, R2), new at each time.
    square = np.mod(0.5 + np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532), 1.0)
    lens = np.zeros((count, 2))
    if camera is not None and radius:
        lens = radius * np.array([on_lens(u, v, camera.data.dof) for u, v in square])
    return [Step(start + shutter * (i + 0.5) / count, (float(lens[i, 0]), float(lens[i, 1]))) for i in range(count)]


def _warn_of_cycles_own(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, warn: Warn) -> None:
    """What Cycles blurs otherwise: every moment of the open shutter counts the same here, and everything is blurred."""
    if any(
        point.location.y < 0.99 for curve in scene.render.motion_blur_shutter_curve.curves for point in curve.points
    ):
        warn("Shutter Curve is not rendered: the shutter opens and shuts at once")
    own = [
        f'"{obj.name}"' for obj in layer.objects if not getattr(getattr(obj, "cycles", None), "use_motion_blur", True)
    ]
    if own:
        warn(f"Motion Blur cannot be off for single objects in DR-GS; blurred like all: {first_of(own)}")


def _radius(camera: bpy.types.Camera) -> float:
    """Metres from the middle of the lens to the rim, as in Cycles; 0 where everything is sharp."""
    if not camera.dof.use_dof:
        return 0.0
    focal = 1.0 if camera.type == "ORTHO" else 1e-3 * camera.lens
    return 0.5 * focal / max(camera.dof.aperture_fstop, 1e-5)


def on_lens(u: float, v: float, dof: bpy.types.CameraDOFSettings) -> tuple[float, float]:
    """A place in the aperture, of radius 1, for two numbers in [0, 1)."""
    blades = dof.aperture_blades
    if blades < 3:
        r, angle = math.sqrt(u), 2 * math.pi * v
        x, y = r * math.cos(angle), r * math.sin(angle)
    else:
        corner = int(u * blades)
        r = math.sqrt(u * blades - corner)
        half = math.pi / blades
        x, y = r * math.cos(half), r * (2 * v - 1) * math.sin(half)  # in the triangle of one blade
        turn = dof.aperture_rotation + 2 * half * corner
        x, y = x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)
    return x / max(dof.aperture_ratio, 1e-3), y


def focus_distance(camera: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> float:
    """Metres along the view axis of an evaluated camera at which things are sharp."""
    dof = camera.data.dof
    if dof.focus_object is None:
        return max(dof.focus_distance, _NEAREST)
    target = dof.focus_object.evaluated_get(depsgraph)
    matrix = target.matrix_world
    if dof.focus_subtarget and target.type == "ARMATURE" and dof.focus_subtarget in target.pose.bones:
        matrix = matrix @ target.pose.bones[dof.focus_subtarget].matrix
    return depth_of(matrix, camera.matrix_world.normalized())


def depth_of(target: Matrix, pose: Matrix) -> float:
    """Metres along the view axis of a camera at `pose`, without scale, at which the focus on `target` is."""
    return max(abs((target.translation - pose.translation).dot(pose.col[2].xyz)), _NEAREST)
