"""What went wrong, for others: copy the messages, go to the object they name, write a report that can be sent."""

from __future__ import annotations

import platform
import subprocess
import time
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..addon import assets, blend_paths, engine_link, messages
from ..drgs_blender.core.errors import DrgsError, UsageError, WriteError
from ..drgs_blender.core.version import __version__
from ..drgs_blender.ipc.child_process import clean_environment
from . import selection
from .base import DrgsOperator

#: Seconds after which the engine's own diagnosis is given up.
PATIENCE = 60


class DRGS_OT_select_named(DrgsOperator, bpy.types.Operator):
    """Select the object that the message names"""

    bl_idname = "drgs.select_named"
    bl_label = "Select Object"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}  # noqa: RUF012 - read by Blender

    name: StringProperty(name="Object", description="Its name", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Go to Object Mode")
        return context.mode == "OBJECT"

    def run(self, context: bpy.types.Context) -> set[str]:
        obj = context.view_layer.objects.get(self.name)
        if obj is None:
            raise UsageError(f'Object "{self.name}"', "is not in this view layer", "It may have another name now")
        selection.select_only(context, [obj], obj)
        return {"FINISHED"}


class DRGS_OT_copy_messages(DrgsOperator, bpy.types.Operator):
    """Copy all messages to the clipboard"""

    bl_idname = "drgs.copy_messages"
    bl_label = "Copy"

    def run(self, context: bpy.types.Context) -> set[str]:
        context.window_manager.clipboard = message_log()
        return {"FINISHED"}


class DRGS_OT_report(DrgsOperator, bpy.types.Operator):
    """Examine Blender, the extension, the engine and the scene, and write what is found to a text file"""

    bl_idname = "drgs.report"
    bl_label = "Write Report"

    filepath: StringProperty(
        name="File",
        description="The text file to write",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.filepath = self.filepath or "drgs-report.txt"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.chosen("Report")))
        try:
            path.write_text(report(context), encoding="utf-8")
        except OSError as error:
            raise WriteError(str(path), f"cannot be written ({error})", "Choose another place") from error
        self.report({"INFO"}, f"Report: {path}")
        return {"FINISHED"}


def message_log() -> str:
    """All messages, one per line."""
    stamp = "%Y-%m-%d %H:%M:%S"
    return "\n".join(f"{time.strftime(stamp, time.localtime(m.time))} {m.level} {m.text}" for m in messages.history)


def report(context: bpy.types.Context) -> str:
    """Report of the installation for developers; takes a second or two."""
    scene, settings = context.scene, context.scene.drgs
    parts = {
        "Program": f"DR-GS {__version__}, Blender {bpy.app.version_string}, {platform.platform()}",
        "Engine": engine(),
        "Scene": f"{scene.render.engine}, {scene.render.resolution_x} x {scene.render.resolution_y}\n"
        + "\n".join(values(settings)),
        "Objects": "\n".join(map(described, filter(assets.is_drgs, scene.objects))) or "none",
        "Messages": message_log() or "none",
    }
    return "\n\n".join(f"== {title}\n{text}" for title, text in parts.items()) + "\n"


def values(group: bpy.types.PropertyGroup, prefix: str = "") -> list[str]:
    """Values of a property group and its nested groups, one line each."""
    lines = []
    for prop in group.bl_rna.properties:
        if prop.identifier in ("rna_type", "name"):
            continue
        value, name = getattr(group, prop.identifier), prefix + prop.identifier
        if isinstance(value, bpy.types.PropertyGroup):
            lines += values(value, f"{name}.")
        elif isinstance(value, bpy.types.ID):
            lines.append(f'{name} = "{value.name}"')
        else:
            lines.append(f"{name} = {value}")
    return lines


def described(obj: bpy.types.Object) -> str:
    """An object in one line."""
    modifiers = ", ".join(m.type for m in obj.modifiers) or "no modifiers"
    try:
        path = assets.file_of(obj)
        size = f"{path.stat().st_size:,} bytes"
    except DrgsError as error:
        path, size = obj.drgs.path, error.problem
    return f'"{obj.name}": {len(obj.data.vertices):,} vertices, {modifiers}; {path}, {size}'


def engine() -> str:
    """What the engine's interpreter finds in itself."""
    try:
        command = engine_link.command_line()
        done = subprocess.run(
            [*command[: command.index("-m")], "-m", "drgs_blender.cli.main", "doctor"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=clean_environment(),
            timeout=PATIENCE,
        )
    except DrgsError as error:
        return str(error)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{command[0]} cannot be asked: {error}"
    return done.stdout.decode(errors="replace").strip()


CLASSES = (DRGS_OT_select_named, DRGS_OT_copy_messages, DRGS_OT_report)
