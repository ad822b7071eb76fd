"""Objects of numbered files, each shown in its frame."""

from __future__ import annotations

import bpy

from ..addon import assets


def play(objects: list[bpy.types.Object], frames: list[int], name: str) -> bpy.types.Object:
    """Show each object from its frame to the next one's, in viewports and pictures; return the Empty above them."""
    carrier = bpy.data.objects.new(name, None)
    assets.collection(bpy.context).objects.link(carrier)
    for i, (obj, frame) in enumerate(zip(objects, frames)):
        obj.parent = carrier
        keys = {frame: False}
        if i:
            keys[frames[0] - 1] = True
        if i + 1 < len(frames):
            keys[frames[i + 1]] = True
        for at, hidden in sorted(keys.items()):
            for prop in ("hide_viewport", "hide_render"):
                setattr(obj, prop, hidden)
                obj.keyframe_insert(prop, frame=at)
    scene = bpy.context.scene
    scene.frame_set(scene.frame_current)
    return carrier
