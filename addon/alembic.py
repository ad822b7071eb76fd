"""DR-GS objects as Alembic: Blender's own exporter writes the evaluated meshes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

from ..drgs_blender.core.asset.archive import replace_by
from ..drgs_blender.core.errors import DeviceError, UsageError
from . import assets


def write_alembic(
    context: bpy.types.Context, path: Path, frames: Sequence[int], names: Sequence[str], scale: float
) -> list[str]:
    """Write DR-GS objects over consecutive frames; return their names.

    Parameters
    ----------
    context : bpy.types.Context
    path : Path
    frames : sequence of int
    names : sequence of str
        Of objects; none: all DR-GS objects that are rendered.
    scale : float
        Factor on all lengths.

    Raises
    ------
    DeviceError
        This Blender was built without Alembic.
    UsageError
        There is no such object, or frames are skipped.
    WriteError
        Blender's exporter refuses; says why.
    """
    if not bpy.app.build_options.alembic:
        problem = f"Blender {bpy.app.version_string} was built without Alembic"
        raise DeviceError(str(path), problem, "Use Blender of blender.org, or write USD (.usdc)")
    if list(frames) != list(range(frames[0], frames[0] + len(frames))):
        raise UsageError(str(path), "frames are skipped, which Alembic of Blender cannot", "Choose all of a range")
    layer = context.view_layer
    there = {obj.name: obj for obj in layer.objects if assets.is_drgs(obj) and not obj.hide_render}
    if missing := [name for name in names if name not in there]:
        known = ", ".join(there) or "none"
        problem = f"is no DR-GS object that is rendered; there are {known}"
        raise UsageError(f'object "{missing[0]}"', problem, "Choose one of them")
    chosen = [there[name] for name in names] or list(there.values())
    if not chosen:
        raise UsageError(str(path), "no DR-GS object is rendered in the scene", "Select or import one")
    selected, active = [obj for obj in layer.objects if obj.select_get()], layer.objects.active
    hidden = [obj for obj in chosen if obj.hide_get()]
    scene, now = context.scene, (context.scene.frame_current, context.scene.frame_subframe)
    try:
        for obj in hidden:
            obj.hide_set(False)
        for obj in layer.objects:
            obj.select_set(obj in chosen)
        if unselected := [obj.name for obj in chosen if not obj.select_get()]:
            problem = "is hidden in viewports, and Blender's exporter leaves such out"
            raise UsageError(f'object "{unselected[0]}"', problem, "Show it in viewports")

        def write(temporary: Path) -> None:
            bpy.ops.wm.alembic_export(
                filepath=str(temporary), check_existing=False, start=frames[0], end=frames[-1], selected=True,
                global_scale=scale, evaluation_mode="RENDER", as_background_job=False,
            )  # fmt: skip

        replace_by(path, write)
    finally:
        for obj in layer.objects:
            obj.select_set(obj in selected)
        layer.objects.active = active
        for obj in hidden:
            obj.hide_set(True)
        scene.frame_set(now[0], subframe=now[1])
    return [obj.name for obj in chosen]
