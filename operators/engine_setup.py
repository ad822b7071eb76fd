"""Set Up Engine: an environment for the engine, made here after a click, or one that exists already."""

from __future__ import annotations

import os
import re
import sys
import textwrap
import time
from pathlib import Path, PurePath

import bpy
from bpy.props import BoolProperty, StringProperty

from ..addon import blend_paths, engine_environment, engine_link, preferences, setup_job
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.ipc.locate import VARIABLE, locate_engine
from .base import DrgsOperator
from .engine_command import print_line

#: Parts that are added later -> what they are for.
_PURPOSES = {
    engine_environment.RECONSTRUCT: "PyTorch, which From Photographs needs",
    engine_environment.CAPTURE: "COLMAP, OpenCV and PyAV, which find the cameras of photographs and videos",
    engine_environment.FILES: "readers and writers of USD, 3MF and COLLADA",
}


class DRGS_OT_engine_setup(DrgsOperator, bpy.types.Operator):
    """Make an environment for the DR-GS engine, apart from Blender's own Python. Asks first; can be cancelled"""

    bl_idname = "drgs.engine_setup"
    bl_label = "Set Up Engine"

    python: StringProperty(
        name="Python",
        description=f"Python {engine_environment.PYTHONS} that makes the environment. Empty: the one that Blender "
        "brings, which stays as it is",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )

    afresh: BoolProperty(
        name="Reinstall",
        description="Take nothing of an earlier set-up: makes the environment and fetches the packages again",
        default=False,
        options={"SKIP_SAVE"},
    )

    reconstruct: BoolProperty(
        name="Reconstruction from Photographs",
        description="Also fetch PyTorch, which the engine needs for photographs and for nothing else",
        default=False,
        options={"SKIP_SAVE"},
    )
    capture: BoolProperty(
        name="Photographs without Cameras",
        description="Also fetch COLMAP, OpenCV and PyAV, which find the cameras of photographs and of videos",
        default=False,
        options={"SKIP_SAVE"},
    )
    gpu: BoolProperty(
        name="Graphics Card",
        description="Also fetch NVIDIA Warp, which the engine needs to trace on an NVIDIA card; its driver is enough",
        default=False,
        options={"SKIP_SAVE"},
    )
    files: BoolProperty(
        name="USD, 3MF and COLLADA",
        description="Also fetch OpenUSD, lxml and pycollada, which read splats in USD files, write USD sequences, and "
        "read meshes in 3MF and COLLADA files",
        default=False,
        options={"SKIP_SAVE"},
    )
    index: StringProperty(
        name="Extra Package Index",
        description="Address of a package index that is asked too. Empty: those that pip is configured with",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if setup_job.running():
            cls.poll_message_set("It is being set up")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        folder = engine_link.engine_folder()
        if engine_environment.state(folder) != "absent":
            self.reconstruct = self.reconstruct or not self._missing(engine_environment.RECONSTRUCT)
            self.capture = self.capture or not self._missing(engine_environment.CAPTURE)
            self.gpu = self.gpu or not self._missing(engine_environment.GPU)
            self.files = self.files or not self._missing(engine_environment.FILES)
        return context.window_manager.invoke_props_dialog(self, width=440, confirm_text="Set Up")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        folder = engine_link.engine_folder()
        state = engine_environment.state(folder)
        text = {
            "absent": "Makes a Python environment for the engine. The folder is",
            "partial": "Goes on with what was begun; what has been fetched is not fetched again. The folder is",
            "old": "Brings the engine to the version of the extension. The folder is",
            "ready": "Tries the engine and repairs it. The folder is",
        }[state]
        groups = [g for g in self._groups() if self._missing(g)]
        if state == "ready" and groups and all(group in _PURPOSES for group in groups):
            text = f"Adds {', and '.join(_PURPOSES[group] for group in groups)}. The folder is"
        column = layout.column(align=True)
        for line in textwrap.wrap(text, 70) + path_lines(folder, 70):
            column.label(text=line)
        layout.prop(self, "reconstruct")
        layout.prop(self, "capture")
        layout.prop(self, "gpu")
        layout.prop(self, "files")
        column = layout.column(align=True)
        if groups:
            fetch, disk = (sum(getattr(g, size) for g in groups) / 1e6 for size in ("download", "disk"))
            column.label(text=f"To fetch: about {fetch:.0f} MB from the Python package index; {disk:.0f} MB on disk")
        else:
            column.label(text="Nothing is fetched")
        if engine_environment.RECONSTRUCT in groups and sys.platform == "linux":
            more = f"{engine_environment.CUDA_BYTES / 1e9:.0f} GB more"
            column.label(text=f"Linux: PyTorch comes with CUDA, {more} and of no use here,")
            column.label(text="unless an index has a CPU-only build")
        layout.prop(self, "python")
        if groups:
            layout.prop(self, "index")
        if state != "absent":
            layout.prop(self, "afresh")

    def _groups(self) -> list[engine_environment.Group]:
        """What is wanted."""
        return [engine_environment.ENGINE, *self._extras()]

    def _extras(self) -> list[engine_environment.Group]:
        wanted = {
            engine_environment.RECONSTRUCT: self.reconstruct,
            engine_environment.CAPTURE: self.capture,
            engine_environment.GPU: self.gpu,
            engine_environment.FILES: self.files,
        }
        return [group for group, chosen in wanted.items() if chosen]

    def _missing(self, group: engine_environment.Group) -> bool:
        """Whether it is to be fetched."""
        return self.afresh or engine_environment.needs_network(engine_link.engine_folder(), group=group)

    def run(self, context: bpy.types.Context) -> set[str]:
        if any(map(self._missing, self._groups())) and not bpy.app.online_access:
            raise UsageError(
                "Engine set-up",
                "needs packages from the network, and Blender is offline",
                "Allow Online Access in Preferences > System, or choose an environment that has the engine",
            )
        python = Path(bpy.path.abspath(self.python) or sys.executable)
        if not os.path.isfile(python):
            raise UsageError(
                "Python", f"{python} does not exist", f"Choose a Python of version {engine_environment.PYTHONS}"
            )
        job = setup_job.start(python, self.afresh, self._extras(), self.index.strip())
        if os.environ.get(VARIABLE):
            self.warn(f"The variable {VARIABLE} names another engine, which is used as long as it is set")
        if bpy.app.background:
            printed = ""
            while setup_job.follow() is not None:
                if job.text != printed:
                    printed = job.text
                    print_line(f"Set Up Engine: {printed}")
                time.sleep(setup_job.INTERVAL)
            if job.error is not None:
                raise job.error
        return {"FINISHED"}


class DRGS_OT_engine_setup_cancel(DrgsOperator, bpy.types.Operator):
    """End the set-up under way. Set Up Engine goes on with it later"""

    bl_idname = "drgs.engine_setup_cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No engine is being set up")
        return setup_job.running()

    def run(self, context: bpy.types.Context) -> set[str]:
        setup_job.cancel()
        return {"FINISHED"}


class DRGS_OT_engine_choose(DrgsOperator, bpy.types.Operator):
    """Use an engine that is installed already: choose its environment's folder, its Python or its drgs program"""

    bl_idname = "drgs.engine_choose"
    bl_label = "Choose Engine"

    filepath: StringProperty(
        name="Engine",
        description="Folder of the environment, or of the checkout it is in, or its Python",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.filepath:
            self.filepath = os.path.join(os.path.expanduser("~"), "")  # not the name of the .blend
        context.window_manager.fileselect_add(self)
        bpy.app.timers.register(show_hidden, first_interval=0.1)  # when the browser is there
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        path = bpy.path.abspath(self.filepath)
        if not os.environ.get(VARIABLE):
            locate_engine(path)  # refused before anything is changed
        if not preferences.write("engine_python", path):
            raise UsageError("Preferences", "the extension is not enabled", "Enable it in Preferences > Add-ons")
        return bpy.ops.drgs.engine_test()


def show_hidden() -> None:
    """Show hidden files in the browser of *Choose Engine*: environments are often named .venv."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            ours = area.type == "FILE_BROWSER" and space.active_operator is not None
            if ours and space.active_operator.bl_idname == "DRGS_OT_engine_choose" and space.params is not None:
                space.params.show_hidden = True


def without_capture(subject: str, problem: str) -> UsageError:
    """The error of what needs *Photographs without Cameras* where that is not there; opens Set Up Engine with it."""
    if not bpy.app.background:
        bpy.ops.drgs.engine_setup("INVOKE_DEFAULT", capture=True)
    return UsageError(
        subject,
        f"{problem}, and the engine is without what finds them",
        "Press Set Up Engine with Photographs without Cameras",
    )


def path_lines(path: PurePath, width: int) -> list[str]:
    """A path in lines that end behind a folder, so that no name is torn apart that fits into one."""
    lines = [""]
    for name in re.split(r"(?<=[\\/])", str(path)):
        if lines[-1] and len(lines[-1] + name) > width:
            lines.append("")
        lines[-1] += name
    return [part for line in lines for part in textwrap.wrap(line, width, break_on_hyphens=False)]


CLASSES = (DRGS_OT_engine_setup, DRGS_OT_engine_setup_cancel, DRGS_OT_engine_choose)
