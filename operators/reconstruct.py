"""Photographs to a DR-GS object: ``drgs reconstruct`` works for minutes while Blender goes on."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import assets, engine_link, reconstruction
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.core.file_types import CAMERAS
from .base import DrgsOperator
from .engine_command import CommandOperator
from .import_asset import import_assets


def _title(cameras: str) -> str:
    """As "OpenCV, Inverse"."""
    return cameras.replace("opencv", "OpenCV").replace("opengl", "OpenGL").replace("-inverse", ", Inverse")


#: Choices of what the cameras' matrices are.
_CAMERAS = (
    ("opengl", "Automatic", "What the layout of the files has by convention: COLMAP, NeRF, nerfstudio"),
    *((name, _title(name), meaning.capitalize()) for name, meaning in CAMERAS.items() if name != "opengl"),
)


class DRGS_OT_reconstruct(CommandOperator, bpy.types.Operator):
    """Make a DR-GS object of photographs, with cameras (COLMAP, NeRF, nerfstudio) or without. Blender goes on"""

    bl_idname = "drgs.reconstruct"
    bl_label = "Reconstruct from Photographs"
    bl_options = {"REGISTER", "UNDO", "PRESET"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        description="Folder of the photographs, with their cameras or without; or a video",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    out: StringProperty(
        name="Save As",
        description="The file to write; empty is beside the .blend, numbered where an object is made of that",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    minutes: FloatProperty(
        name="Time Budget (min)", description="About how long it may take", default=10.0, min=0.1, max=1e4
    )
    resolution: IntProperty(
        name="Resolution", description="Longer side of the photographs, reduced; 0 is as they are", default=400, min=0
    )
    variant: EnumProperty(
        name="Surfels",
        description="Which surfels the asset gets",
        items=(
            ("p", "Free", "Stay where they were learned, bound to the mesh"),
            ("m", "On the Mesh", "New ones hang on the mesh's faces"),
        ),
        default="p",
    )
    use_materials: BoolProperty(
        name="Materials", description="Separate the materials from the light of the photographs", default=True
    )
    test_every: IntProperty(
        name="Hold Out Every Nth Photo",
        description="Keep every nth photograph for measuring the quality; 0 uses the test photographs that the "
        "capture names",
        default=0,
        min=0,
    )
    axes: EnumProperty(
        name="Camera Convention",
        description="Axes of the cameras' matrices. Where another one fits better, a message names it (--axes)",
        items=_CAMERAS,
        default="opengl",
        options={"SKIP_SAVE"},
    )
    use_environment: BoolProperty(
        name="Set World", description="Light the scene with the light of the photographs", default=False
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("One is under way already")
        return reconstruction.job is None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if engine_link.lacks_reconstruction():
            bpy.ops.drgs.engine_setup("INVOKE_DEFAULT", reconstruct=True)
            return {"CANCELLED"}
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        if engine_link.lacks_reconstruction():
            raise UsageError(
                "Engine",
                "was set up without PyTorch, which reconstruction needs",
                "Press Set Up Engine with Reconstruction from Photographs",
            )
        capture = Path(bpy.path.abspath(self.filepath)).absolute()
        if not self.filepath or not capture.exists():
            raise UsageError(
                str(capture if self.filepath else "Photographs"),
                "is not there",
                "Choose the folder of the photographs, its transforms.json, or a video",
            )
        folder = capture if capture.is_dir() else capture.parent
        if not self.out and not bpy.data.filepath:
            raise UsageError(
                f'Capture "{folder.name}"', "has no place for its asset", "Save the .blend, or name the asset's file"
            )
        out = Path(bpy.path.abspath(self.out or f"//{bpy.path.clean_name(folder.name)}"))
        out = assets.chosen(out.absolute().with_suffix(".drgs"), bool(self.out))
        arguments = ["reconstruct", str(capture), "--out", str(out), "--time-budget", f"{self.minutes:g}"]
        arguments += ["--variant", self.variant, "--axes", self.axes, "--device", context.scene.drgs.device.lower()]
        if self.resolution:
            # Eight is the least that the program takes.
            arguments += ["--resolution", str(max(self.resolution, 8))]
        if self.test_every > 1:
            arguments += ["--test-every", str(self.test_every)]
        if not self.use_materials:
            arguments.append("--no-materials")
        reconstruction.job = reconstruction.Reconstruction(out)
        subject = f'Capture "{folder.name}"'
        return self.start(context, arguments, subject, f"Making {out.name}", "could not be reconstructed", [out])

    def stopped(self, event: bpy.types.Event) -> bool:
        return _job().cancelled  # Esc may be meant for anything else during these minutes

    def state(self, output: str) -> str:
        job = _job()
        job.follow(output)
        return f"{self._subject}: {job.text}, {job.part:.0%}"

    def follow(self, context: bpy.types.Context, output: str) -> None:
        context.workspace.status_text_set(f"{self.state(output)}. Cancel is in the sidebar")
        _redraw(context)

    def done(self, context: bpy.types.Context) -> set[str]:
        import_assets(context, [_job().out], self.use_environment)
        return {"FINISHED"}

    def clear(self) -> None:
        CommandOperator.clear(self)
        reconstruction.job = None
        _redraw(bpy.context)


class DRGS_OT_reconstruct_cancel(DrgsOperator, bpy.types.Operator):
    """End the reconstruction under way; another one with the same settings goes on where it stopped"""

    bl_idname = "drgs.reconstruct_cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No reconstruction is under way")
        return reconstruction.job is not None

    def run(self, context: bpy.types.Context) -> set[str]:
        _job().cancelled = True  # its own operator ends it
        return {"FINISHED"}


def _job() -> reconstruction.Reconstruction:
    assert reconstruction.job is not None, "none is under way"
    return reconstruction.job


def _redraw(context: bpy.types.Context) -> None:
    """Draw the sidebars again."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


CLASSES = (DRGS_OT_reconstruct, DRGS_OT_reconstruct_cancel)
