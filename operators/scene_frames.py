"""The DR-GS objects of the scene, described a frame at a time for the command ``drgs convert``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from ..addon import assets, messages
from ..addon.export import export_baked
from ..addon.export.camera import NO_CAMERA
from ..drgs_blender.core.errors import UsageError, first_of
from ..drgs_blender.core.file_types import Held
from ..drgs_blender.core.frame import Frame
from ..drgs_blender.core.frame_sequences import frame_path
from ..drgs_blender.ipc.frame_file import SUFFIX, write_frame_file
from .engine_command import CommandOperator

#: Stands for the number of a frame in the names of files.
NUMBER = "####"


class SceneFrames(CommandOperator):
    """Base of operators that make something of DR-GS objects as they are posed, painted and lit in the scene."""

    use_selection: BoolProperty(
        name="Selected Only", description="The selected objects; the others still cast shadows", default=False
    )
    colour: EnumProperty(
        name="Colour",
        description="What splats show",
        items=(
            ("captured", "Captured", "The captured colour, turned with the surface; else the albedo"),
            ("albedo", "Albedo", "The colour of the surface without light, as it is painted"),
            ("relit", "Light of the Scene", "Lit by the World, lights and surfaces that emit"),
        ),
        default="captured",
    )
    samples: IntProperty(
        name="Samples", description="Samples per splat of the scene's light", default=256, min=1, max=65536
    )

    def describe(
        self, context: bpy.types.Context, target: Path, kind: Held, frames: Iterable[int] | None = None
    ) -> list[str]:
        """Describe the scene at each frame, by default at the present one, in files of the operator's folder.

        Returns the arguments of ``drgs`` that make `target` of them.
        """
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        if kind != "environment":
            self._tell_differences(context)
        template = str(self.work_folder / f"{NUMBER}{SUFFIX}")
        numbers = self._write_all(context, template, kind, frames)
        arguments = ["convert", template, str(target), "--as", kind, f"--frames={','.join(map(str, numbers))}"]
        if kind == "sequence":
            render = context.scene.render
            arguments.append(f"--fps={render.fps / render.fps_base:.9g}")
        if kind in ("splats", "sequence"):
            arguments += ["--colour", self.colour, "--samples", str(self.samples)]
        return arguments

    def _tell_differences(self, context: bpy.types.Context) -> None:
        """Name objects that are seen in renders alone, and in viewports alone: what is written follows viewports."""
        among = context.selected_objects if self.use_selection else context.scene.objects
        objects = [obj for obj in among if assets.is_drgs(obj)]
        for in_viewports in (False, True):
            text = "written, though renders do not show it" if in_viewports else "left out, though renders show it"
            names = [o.name for o in objects if o.visible_get() == in_viewports and o.hide_render == in_viewports]
            if names:
                self.warn(f"{first_of(names)}: {text}; exports have what viewports show")

    def _write_all(
        self, context: bpy.types.Context, template: str, kind: Held, frames: Iterable[int] | None
    ) -> list[int]:
        scene = context.scene
        if frames is None:
            self._write(context, template, kind, scene.frame_current)
            return [scene.frame_current]
        numbers, now = list(frames), (scene.frame_current, scene.frame_subframe)
        window = context.window_manager
        window.progress_begin(0, len(numbers))
        try:
            for i, number in enumerate(numbers):
                window.progress_update(i)
                scene.frame_set(number)
                self._write(context, template, kind, number)
        finally:
            scene.frame_set(now[0], subframe=now[1])
            window.progress_end()
        return numbers

    def _write(self, context: bpy.types.Context, template: str, kind: Held, number: int) -> None:
        warn = lambda text: messages.note("WARNING", text)  # noqa: E731
        given = context.evaluated_depsgraph_get(), str, warn, lambda text, part: None
        frame = export_baked(*given, camera=NO_CAMERA, passes=("Combined",))
        if self.use_selection:
            chosen = {obj.name for obj in context.selected_objects if assets.is_drgs(obj)}
            _hide(frame, chosen)
        if kind == "environment":
            frame.objects = []
        elif not any(o.visibility.camera for o in frame.objects):
            what = "selected object" if self.use_selection else "object of the scene"
            raise UsageError("Export", f"no {what} is a DR-GS object that can be seen", "Select or import one")
        elif kind == "mesh":
            self._check_meshes(frame, template)
        if self.colour != "relit" or kind not in ("splats", "sequence"):  # nothing lights or shadows anything
            frame.meshes, frame.lights, frame.images = [], [], []
        write_frame_file(frame_path(template, number), frame)

    def _check_meshes(self, frame: Frame, template: str) -> None:
        """Name objects that have no mesh. UsageError where none has one."""
        names: dict[bool, list[str]] = {True: [], False: []}
        for state in frame.objects:
            if state.visibility.camera:
                names[len(assets.load(Path(state.asset)).mesh.faces) > 0].append(state.name)
        if not names[True]:
            problem = f"has no mesh of its own that could be written: {first_of(names[False])}"
            raise UsageError("Export", problem, "Choose a format that holds splats, such as glTF splats or 3DGS PLY")
        if names[False]:
            self.warn(f"{first_of(names[False])}: has no mesh and is left out; formats that hold splats have it")


def draw_colour(layout: bpy.types.UILayout, operator: bpy.types.Operator) -> None:
    """What splats show."""
    layout.prop(operator, "colour")
    if operator.colour == "relit":
        layout.prop(operator, "samples")


def _hide(frame: Frame, chosen: set[str]) -> None:
    """Let the camera see the objects of these names alone."""
    for i, state in enumerate(frame.objects):
        if state.name not in chosen:
            frame.objects[i] = replace(state, visibility=replace(state.visibility, camera=False))
