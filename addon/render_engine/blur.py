"""Motion blur and depth of field: the mean of pictures at other times of the shutter and other places of the lens.

Each picture is a whole frame of the engine, with its share of the rays: whatever moves, armatures, simulations, lights
and cameras, is blurred as it moves, and whatever the camera sees has its depth of field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ...drgs_blender.core.frame import Frame
from ...drgs_blender.ipc import blur
from ..export.camera import is_panoramic
from ..property_limits import Limited

Warn = Callable[[str], None]

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


def steps(scene: bpy.types.Scene, camera: bpy.types.Object, warn: Warn) -> list[Step]:
    """The pictures that make one of an evaluated scene; none where nothing is blurred."""
    render, dof = scene.render, camera.data.dof
    radius = _radius(camera.data)
    if radius and is_panoramic(camera):
        warn(f'Camera "{camera.name}": panoramas have no depth of field in DR-GS; all is sharp')
        radius = 0.0
    shutter = render.motion_blur_shutter if render.use_motion_blur else 0.0
    if not (radius or shutter):
        return []
    count = Limited(scene.drgs, f'Scene "{scene.name}"', warn).blur_steps
    start = -shutter * _BEFORE[render.motion_blur_position]
    # Times are even; places on the lens are of a low-discrepancy sequence (Roberts 2018, R2), new at each time.
    square = np.mod(0.5 + np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532), 1.0)
    lens = radius * np.array([on_lens(u, v, dof) for u, v in square])
    return [Step(start + shutter * (i + 0.5) / count, (float(lens[i, 0]), float(lens[i, 1]))) for i in range(count)]


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
        return max(dof.focus_distance, 1e-4)
    target = dof.focus_object.evaluated_get(depsgraph)
    matrix = target.matrix_world
    if dof.focus_subtarget and target.type == "ARMATURE" and dof.focus_subtarget in target.pose.bones:
        matrix = matrix @ target.pose.bones[dof.focus_subtarget].matrix
    pose = camera.matrix_world.normalized()
    return max(abs((matrix.translation - pose.translation).dot(pose.col[2].xyz)), 1e-4)


def pictures(
    sharp: Frame,
    steps: list[Step],
    depsgraph: bpy.types.Depsgraph,
    export: Callable[[], Frame],
    frame_set: Callable[[int, float], None],
) -> Iterator[Frame]:
    """The frame `sharp` at each time and place on the lens, as yet with all of its passes and samples.

    Parameters
    ----------
    sharp : the frame as it is without blur
    export : describes the scene at the time at which `frame_set` has evaluated it; at its own again afterwards
    """
    own = depsgraph.scene.frame_current, depsgraph.scene.frame_subframe
    now = sum(own)
    moves = any(step.time for step in steps)
    try:
        for step in steps:
            frame = sharp
            if moves:
                whole = math.floor(now + step.time)
                frame_set(whole, now + step.time - whole)
                frame = export()
            camera = depsgraph.scene_eval.camera.evaluated_get(depsgraph)
            seen = blur.camera_on_lens(frame.camera, step.lens, focus_distance(camera, depsgraph))
            yield replace(frame, noise_index=sharp.noise_index, camera=seen, previous=None, next=None)
    finally:
        if moves:
            frame_set(*own)
