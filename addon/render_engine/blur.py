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

from ...drgs_blender.engine.protocol import Passes
from ...drgs_blender.frame import Camera, Frame, RenderSettings
from ...drgs_blender.passes import BY_NAME

Array = np.ndarray
Warn = Callable[[str], None]

#: Share of the open shutter that lies before the frame.
_BEFORE = {"START": 0.0, "CENTER": 0.5, "END": 1.0}
#: Passes that are not blurred: what they say of a surface has no mean.
SHARP = frozenset(name for name, p in BY_NAME.items() if p.kind != "COLOR" or p.exact or name == "Albedo")


@dataclass(frozen=True, slots=True)
class Step:
    """One of the pictures.

    Attributes
    ----------
    time : frames before (negative) or after the frame's own
    lens : where in the aperture its centre of projection is, metres to the right and up
    """

    time: float
    lens: tuple[float, float]


def steps(scene: bpy.types.Scene, camera: bpy.types.Object, warn: Warn) -> list[Step]:
    """The pictures that make one of an evaluated scene; none where nothing is blurred."""
    render, dof = scene.render, camera.data.dof
    radius = _radius(camera.data)
    if dof.use_dof and camera.data.type == "ORTHO":
        warn(f'Depth of field of the orthographic camera "{camera.name}" is not rendered by DR-GS')
        radius = 0.0
    shutter = render.motion_blur_shutter if render.use_motion_blur else 0.0
    if not (radius or shutter):
        return []
    count = scene.drgs.blur_steps
    start = -shutter * _BEFORE[render.motion_blur_position]
    # Times are even; places on the lens are of a low-discrepancy sequence (Roberts 2018, R2), new at each time.
    square = np.mod(0.5 + np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532), 1.0)
    lens = radius * np.array([on_lens(u, v, dof) for u, v in square])
    return [Step(start + shutter * (i + 0.5) / count, tuple(map(float, lens[i]))) for i in range(count)]


def _radius(camera: bpy.types.Camera) -> float:
    """Metres from the middle of the lens to the rim; 0 where everything is sharp."""
    if not camera.dof.use_dof or camera.type == "ORTHO":
        return 0.0
    return 0.5e-3 * camera.lens / max(camera.dof.aperture_fstop, 1e-5)


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


def through(camera: Camera, lens: tuple[float, float], distance: float) -> Camera:
    """`camera` from another place of its lens; what is at `distance` stays where it is in the picture."""
    x, y = lens
    pose = np.array(camera.matrix_world)
    pose[:3, 3] += x * pose[:3, 0] + y * pose[:3, 1]
    cx, cy = camera.cx + camera.fx * x / distance, camera.cy - camera.fy * y / distance
    return replace(camera, matrix_world=pose, cx=cx, cy=cy)


def shared(settings: RenderSettings, count: int, index: int) -> RenderSettings:
    """The settings of one of `count` pictures: its part of the samples, with noise of its own."""
    return replace(
        settings,
        cosine=-(-settings.cosine // count),
        ggx=-(-settings.ggx // count),
        environment=-(-settings.environment // count),
        aa=-(-settings.aa // count),
        noise_threshold=0.0,
        seed=(settings.seed + 0x9E3779B1 * index) % 2**31,
    )


def pictures(
    sharp: Frame,
    wanted: list[Step],
    depsgraph: bpy.types.Depsgraph,
    export: Callable[[], Frame],
    frame_set: Callable[[int, float], None],
) -> Iterator[Frame]:
    """The frames to render: one with the sharp passes where any is wanted, then those that are averaged.

    Parameters
    ----------
    sharp : the frame as it is without blur
    export : describes the scene at the time at which `frame_set` has evaluated it; at its own again afterwards
    """
    own = depsgraph.scene.frame_current, depsgraph.scene.frame_subframe
    now = sum(own)
    names = tuple(name for name in sharp.passes if name in SHARP)
    if names:
        cheap = replace(sharp.settings, cosine=1, ggx=1, environment=1, bounces=0, denoise="none", noise_threshold=0.0)
        yield replace(sharp, passes=names, settings=cheap)
    blurred = tuple(name for name in sharp.passes if name not in SHARP)
    moves = any(step.time for step in wanted)
    try:
        for index, step in enumerate(wanted):
            frame = sharp
            if moves:
                whole = math.floor(now + step.time)
                frame_set(whole, now + step.time - whole)
                frame = export()
            camera = depsgraph.scene_eval.camera.evaluated_get(depsgraph)
            yield replace(
                frame,
                number=sharp.number,
                camera=through(frame.camera, step.lens, focus_distance(camera, depsgraph)),
                settings=shared(frame.settings, len(wanted), index),
                passes=blurred,
                previous=None,
                next=None,
            )
    finally:
        if moves:
            frame_set(*own)


def averaged(parts: Iterator[Passes], count: int) -> Passes:
    """One picture of the sharp passes and `count` that are averaged; seconds and samples are added up."""
    sums: dict[str, Array] = {}
    sharp, warnings, statistics = {}, [], {}
    for part in parts:
        for name, values in part.items():
            if name in SHARP:
                sharp[name] = values
            else:
                sums[name] = values.astype(np.float64) if name not in sums else sums[name] + values
        warnings += [text for text in part.warnings if text not in warnings]
        for name, value in part.statistics.items():
            added = name.startswith("seconds.") or name == "samples"
            statistics[name] = statistics.get(name, 0.0) + value if added else value
    means = {name: (total / count).astype(np.float32) for name, total in sums.items()}
    return Passes(sharp | means, warnings, statistics)
