"""Make an asset from captured surfels, their mesh and their light, in the engine's process, then import it."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from typing import IO

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..addon import messages, preferences
from ..drgs_blender.engine.client import locate_engine
from ..drgs_blender.errors import AssetError, UsageError
from .base import DrgsOperator
from .import_asset import import_assets


class DRGS_OT_import_parts(DrgsOperator, bpy.types.Operator):
    """Make a .drgs asset from a file of surfels or splats, with its mesh and environment, and load it"""

    bl_idname = "drgs.import_parts"
    bl_label = "Import Surfels and Mesh"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    surfels: StringProperty(
        name="Surfels", description="PLY, SPZ, SOG, ... with surfels or splats", subtype="FILE_PATH"
    )
    mesh: StringProperty(name="Mesh", description="The mesh they were reconstructed with", subtype="FILE_PATH")
    environment: StringProperty(name="Environment", description="EXR or HDR image of the light", subtype="FILE_PATH")
    out: StringProperty(name="Asset", description="The file to write; empty is beside the surfels", subtype="FILE_PATH")
    up: EnumProperty(
        name="Up",
        description="Axis that points up in the files",
        items=(("z", "+Z", ""), ("y", "+Y", ""), ("-y", "-Y", "")),
        default="z",
    )
    use_environment: BoolProperty(name="Set World", description="Light the scene with the environment", default=False)

    _process: subprocess.Popen | None = None
    _log: IO[bytes] | None = None
    _timer: bpy.types.Timer | None = None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=420)

    def run(self, context: bpy.types.Context) -> set[str]:
        self._start()
        if bpy.app.background or context.window is None:
            self._process.wait()
            return self._finish(context)
        self._timer = context.window_manager.event_timer_add(0.25, window=context.window)
        context.window_manager.modal_handler_add(self)
        context.workspace.status_text_set(f"Making {self._target().name}: Esc cancels")
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER" or self._process.poll() is None:
            return {"PASS_THROUGH"}
        self._release(context)
        try:
            return self._finish(context)
        except AssetError as error:
            return self.fail(error)

    def cancel(self, context: bpy.types.Context) -> None:
        """End the process; called by Esc and when Blender closes."""
        self._process.terminate()
        self._process.wait()
        self._log.close()
        self._release(context)

    def _target(self) -> Path:
        if self.out:
            return Path(bpy.path.abspath(self.out)).with_suffix(".drgs")
        return Path(bpy.path.abspath(self.surfels)).with_suffix(".drgs")

    def _start(self) -> None:
        if not self.surfels:
            raise UsageError("Import", "no file of surfels is given", "Choose one under Surfels")
        command = locate_engine(preferences.read("engine_python", "") or None)
        python = command[: command.index("-m")]
        arguments = ["import", bpy.path.abspath(self.surfels), "--out", str(self._target()), f"--up={self.up}"]
        for option, value in (("--mesh", self.mesh), ("--environment", self.environment)):
            if value:
                arguments += [option, bpy.path.abspath(value)]
        self._log = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                [*python, "-m", "drgs_blender.cli.main", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                env={k: v for k, v in os.environ.items() if not k.startswith("PYTHON")},
            )
        except OSError as error:
            self._log.close()
            raise UsageError("Engine", f"{python[0]} cannot be started ({error})", "See the preferences") from error

    def _finish(self, context: bpy.types.Context) -> set[str]:
        """Load what was made, or say why it was not."""
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        self._log.close()
        if self._process.returncode:
            reason = lines[-1].removeprefix("drgs: ") if lines else f"exit code {self._process.returncode}"
            raise AssetError(Path(self.surfels).name, f"could not be made into an asset: {reason.rstrip('.')}")
        for line in lines:
            messages.note("INFO", line)
        import_assets(context, [self._target()], self.use_environment)
        return {"FINISHED"}

    def _release(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)


CLASSES = (DRGS_OT_import_parts,)
