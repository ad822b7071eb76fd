"""Final frames with motion blur and depth of field: the scene at each of the times, seen from each place of the lens.

Each picture is a whole frame of the engine, with its share of the rays: whatever moves, armatures, simulations, lights
and cameras, is blurred as it moves, and whatever the camera sees has its depth of field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import bpy

from ...drgs_blender.core.frame import Frame
from ...drgs_blender.ipc import blur
from ..export.blur_steps import Step, focus_distance


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
