"""Make an asset from captured surfels, their mesh and their light, by the command ``drgs``, then import it."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import IO

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..addon import engine_link, messages
from ..drgs_blender.errors import AssetError, UsageError
from .base import DrgsOperator
from .import_asset import import_assets


class DRGS_OT_import_parts(DrgsOperator, bpy.types.Operator):
    """Make a .drgs asset from surfels or splats and their mesh, or from a textured mesh alone, and load it"""

    bl_idname = "drgs.import_parts"
    bl_label = "Import Surfels and Mesh"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    surfels: StringProperty(
        name="Surfels", description="PLY, SPZ, SOG, ... with surfels or splats", subtype="FILE_PATH"
    )
    mesh: StringProperty(
        name="Mesh",
        description="The mesh they were reconstructed with; or, without surfels, any textured mesh",
        subtype="FILE_PATH",
    )
    environment: StringProperty(name="Environment", description="EXR or HDR image of the light", subtype="FILE_PATH")
    out: StringProperty(
        name="Asset", description="The file to write; empty is beside the first file", subtype="FILE_PATH"
    )
    up: EnumProperty(
        name="Up",
        description="Axis that points up in the files",
        items=(
            ("auto", "Automatic", "As the file formats say"),
            ("z", "Z", ""),
            ("y", "Y", ""),
            ("-y", "-Y", "Most photogrammetry"),
            ("-z", "-Z", ""),
        ),
        default="auto",
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
        """The asset to write."""
        return Path(bpy.path.abspath(self.out or self.surfels or self.mesh)).with_suffix(".drgs")

    def _arguments(self) -> list[str]:
        """Arguments of the command ``drgs``."""
        surfels, mesh, light = (bpy.path.abspath(p) for p in (self.surfels, self.mesh, self.environment))
        if not surfels and not mesh:
            raise UsageError("Import", "neither surfels nor a mesh are given", "Choose at least one file")
        arguments = ["import", surfels] if surfels else ["make", mesh]
        if surfels and mesh:
            arguments += ["--mesh", mesh]
        if light:
            arguments += ["--env", light]
        if self.up != "auto":
            arguments.append(f"--up={self.up}")
        return [*arguments, "--out", str(self._target())]

    def _start(self) -> None:
        arguments = self._arguments()
        command = engine_link.command_line()
        python = command[: command.index("-m")]
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        try:
            self._process = subprocess.Popen(
                [*python, "-m", "drgs_blender.cli.main", "--no-progress", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
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
            raise AssetError(
                Path(self.surfels or self.mesh).name, f"could not be made into an asset: {reason.rstrip('.')}"
            )
        for line in lines:
            messages.note("INFO", line)
        import_assets(context, [self._target()], self.use_environment)
        return {"FINISHED"}

    def _release(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)


CLASSES = (DRGS_OT_import_parts,)
