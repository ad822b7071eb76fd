"""File > Export: DR-GS objects as splats or meshes for other programs, posed, painted and lit as in the scene."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import assets, messages
from ..addon.export import export_frame
from ..addon.export.camera import NO_CAMERA
from ..drgs_blender.engine.frame_file import SUFFIX, write_frame_file
from ..drgs_blender.errors import UsageError
from ..drgs_blender.filetypes import WRITTEN
from ..drgs_blender.frame import Frame
from ..drgs_blender.sequence import frame_path
from .import_parts import UP_ITEMS
from .program import ProgramOperator

_HELD = {"splats": "Splats", "mesh": "Mesh with materials", "environment": "The World"}
_NUMBER = "####"
# Blender evaluates annotations apart from this module: no loops in them.
_FORMATS = tuple((name, f"{name} ({t.extensions[0]})", _HELD[t.kind]) for name, t in WRITTEN.items())
_ENDINGS = tuple(dict.fromkeys(e for t in WRITTEN.values() for e in t.extensions))
_GLOB = ";".join(f"*{e}" for e in _ENDINGS)


class DRGS_OT_export(ProgramOperator, bpy.types.Operator):
    """Write DR-GS objects as they are posed, painted and lit, as splats or meshes for other programs"""

    bl_idname = "drgs.export"
    bl_label = "Export DR-GS"
    bl_options = {"REGISTER", "UNDO", "PRESET"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    filter_glob: StringProperty(default=_GLOB, options={"HIDDEN"})
    format: EnumProperty(
        name="Format",
        description="What to write",
        items=_FORMATS,
        default="3DGS PLY",
    )
    use_selection: BoolProperty(
        name="Selected Only", description="The selected objects; the others still cast shadows", default=False
    )
    scale: FloatProperty(name="Scale", description="Factor on all lengths", default=1.0, min=1e-6, max=1e6)
    up: EnumProperty(
        name="Up",
        description="Axis that points up in the file, where its format leaves the choice",
        items=UP_ITEMS,
        default="auto",
    )
    colour: EnumProperty(
        name="Colour",
        description="What splats show",
        items=(
            ("captured", "Captured", "The captured colour, turned with the surface; else the albedo"),
            ("albedo", "Albedo", "The colour of the surface without light, as it is painted"),
            ("relit", "Light of the Scene", "The colour in the light of the World, lamps and surfaces that emit"),
        ),
        default="captured",
    )
    rays: IntProperty(name="Rays", description="Samples a splat of the scene's light", default=256, min=1, max=65536)
    use_animation: BoolProperty(
        name="Animation", description="A file for each frame of the scene; its number ends the name", default=False
    )
    frame_start: IntProperty(name="Frame Start", description="First frame", default=1)
    frame_end: IntProperty(name="End", description="Last frame", default=250)
    frame_step: IntProperty(name="Step", description="From frame to frame", default=1, min=1)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        scene = context.scene
        self.frame_start, self.frame_end, self.frame_step = scene.frame_start, scene.frame_end, scene.frame_step
        if not self.filepath:
            blend = bpy.data.filepath
            self.filepath = str(Path(blend).with_suffix("")) if blend else "untitled"
        self.check(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context: bpy.types.Context) -> bool:
        """Give the file the ending of the format; whether that changed anything."""
        path = Path(self.filepath)
        own = WRITTEN[self.format].extensions
        if path.suffix.lower() in own or not path.name:
            return False
        self.filepath = str(path.with_suffix(own[0]) if path.suffix.lower() in _ENDINGS else f"{path}{own[0]}")
        return True

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        kind = WRITTEN[self.format]
        layout.prop(self, "format")
        if kind.kind != "environment":
            layout.prop(self, "use_selection")
            layout.prop(self, "scale")
            if not kind.fixed:
                layout.prop(self, "up")
        if kind.kind == "splats":
            layout.prop(self, "colour")
            if self.colour == "relit":
                layout.prop(self, "rays")
        layout.prop(self, "use_animation")
        if self.use_animation:
            column = layout.column(align=True)
            column.prop(self, "frame_start")
            column.prop(self, "frame_end")
            column.prop(self, "frame_step")

    def run(self, context: bpy.types.Context) -> set[str]:
        if not self.filepath:
            raise UsageError("Export", "no file is given", "Choose one")
        self.check(context)
        kind = WRITTEN[self.format]
        target = Path(bpy.path.abspath(self.filepath)).absolute()
        frames = range(self.frame_start, self.frame_end + 1, self.frame_step) if self.use_animation else None
        if frames is not None and not frames:
            raise UsageError("Export", f"frames {self.frame_start} to {self.frame_end} are none", "Change the range")
        if frames is not None and "#" not in target.name:
            target = target.with_name(f"{target.stem}_{_NUMBER}{target.suffix}")
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        with self.folder("drgs-export-") as folder:
            numbers = self._write_frames(context, frames)
        arguments = ["convert", str(folder / f"{_NUMBER}{SUFFIX}"), str(target), "--as", kind.kind]
        arguments += [f"--frames={','.join(map(str, numbers))}"]
        if kind.kind != "environment":
            arguments.append(f"--scale={self.scale:.9g}")
        if not kind.fixed and self.up != "auto":
            arguments.append(f"--up={self.up}")
        if kind.kind == "splats":
            arguments += ["--colour", self.colour, "--rays", str(self.rays)]
        return self.start(context, arguments, target.name, f"Writing {target.name}", "could not be written")

    def _write_frames(self, context: bpy.types.Context, frames: Iterable[int] | None) -> list[int]:
        """Describe the scene at each frame, by default at the present one; return their numbers."""
        scene = context.scene
        if frames is None:
            self._write(context, scene.frame_current)
            return [scene.frame_current]
        numbers, now = list(frames), (scene.frame_current, scene.frame_subframe)
        window = context.window_manager
        window.progress_begin(0, len(numbers))
        try:
            for i, number in enumerate(numbers):
                window.progress_update(i)
                scene.frame_set(number)
                self._write(context, number)
        finally:
            scene.frame_set(now[0], subframe=now[1])
            window.progress_end()
        return numbers

    def _write(self, context: bpy.types.Context, number: int) -> None:
        warn = lambda text: messages.note("WARNING", text)  # noqa: E731
        frame = export_frame(context.evaluated_depsgraph_get(), str, warn, camera=NO_CAMERA, passes=("Combined",))
        if self.use_selection:
            chosen = {obj.name for obj in context.selected_objects if assets.is_drgs(obj)}
            _hide(frame, chosen)
        if WRITTEN[self.format].kind != "environment" and not any(o.visibility.camera for o in frame.objects):
            what = "selected object" if self.use_selection else "object of the scene"
            raise UsageError("Export", f"no {what} is a DR-GS object that can be seen", "Select or import one")
        if WRITTEN[self.format].kind == "environment":
            frame.objects = []
        if self.colour != "relit" or WRITTEN[self.format].kind != "splats":  # nothing lights or shadows anything
            frame.meshes, frame.lights, frame.images = [], [], []
        write_frame_file(frame_path(str(self._folder / f"{_NUMBER}{SUFFIX}"), number), frame)


def _hide(frame: Frame, chosen: set[str]) -> None:
    """Let the camera see the objects of these names alone."""
    for i, state in enumerate(frame.objects):
        if state.name not in chosen:
            frame.objects[i] = replace(state, visibility=replace(state.visibility, camera=False))


CLASSES = (DRGS_OT_export,)
