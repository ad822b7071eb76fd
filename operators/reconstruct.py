"""Photographs to a DR-GS object: ``drgs reconstruct`` works for minutes while Blender goes on."""

from __future__ import annotations

import contextlib
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..addon import assets, engine_link, reconstruction
from ..drgs_blender.core.errors import AssetError, UsageError
from .base import DrgsOperator
from .engine_command import CommandOperator, redraw_sidebars
from .engine_setup import without_capture
from .import_asset import import_assets
from .reconstruct_fields import NO_CAPTURE, ReconstructFields, is_video, options_of, settings_file


class DRGS_OT_reconstruct(ReconstructFields, CommandOperator, bpy.types.Operator):
    """Make a DR-GS object of photographs, with cameras (COLMAP, NeRF, nerfstudio) or without. Blender goes on"""

    bl_idname = "drgs.reconstruct"
    bl_label = "Reconstruct from Photographs"
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012 - read by Blender

    shows_progress = False  # the step Import does

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("One is under way already")
        return reconstruction.job is None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if engine_link.lacks_reconstruction():
            bpy.ops.drgs.engine_setup("INVOKE_DEFAULT", reconstruct=True, capture=engine_link.lacks_capture())
            return {"CANCELLED"}
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        if engine_link.lacks_reconstruction():
            raise UsageError(
                "Engine",
                "is without PyTorch, which reconstruction needs",
                "Press Set Up Engine with Reconstruction from Photographs",
            )
        capture = Path(bpy.path.abspath(self.filepath)).absolute()
        if not self.filepath or not capture.exists():
            raise UsageError(
                str(capture if self.filepath else "Photographs"),
                "is not there",
                "Choose the folder of the photographs, its transforms.json, or a video",
            )
        if engine_link.lacks_capture() and _has_no_cameras(capture, self.axes):
            raise without_capture(str(capture), "has no cameras")
        name = capture.stem if is_video(capture) else (capture if capture.is_dir() else capture.parent).name
        if not self.out and not bpy.data.filepath:
            raise UsageError(
                f'Capture "{name}"', "has no place for its asset", "Save the .blend, or name the asset's file"
            )
        out = Path(bpy.path.abspath(self.out or f"//{bpy.path.clean_name(name)}"))
        out = assets.chosen(out.absolute().with_suffix(".drgs"), bool(self.out))
        arguments = ["reconstruct", str(capture), "--out", str(out), "--device", context.scene.drgs.device.lower()]
        with self.folder("drgs-reconstruct-") as work:
            file = settings_file(self.settings, self.config, work)
            arguments += options_of(self, str(capture)) if file is None else ["--config", str(file)]
        reconstruction.job = reconstruction.Reconstruction(out, capture)
        subject = f'Capture "{name}"'
        return self.start(context, arguments, subject, f"Making {out.name}", "could not be reconstructed", [out])

    def stopped(self, event: bpy.types.Event) -> bool:
        return _job().cancelled  # Esc may be meant for anything else during these minutes

    def state(self, output: str) -> str:
        job = _job()
        job.follow(output)
        return f"{self._subject}: {job.text}, {job.part:.0%}"

    def follow(self, context: bpy.types.Context, output: str) -> None:
        context.workspace.status_text_set(f"{self.state(output)}. Cancel is in the sidebar")
        redraw_sidebars(context)

    def done(self, context: bpy.types.Context) -> set[str]:
        job = _job()
        job.follow(self._output)
        import_assets(context, [job.out], self.use_environment)
        reconstruction.made = reconstruction.Made(job, self._warned)
        for file in reconstruction.made.pictures.values():
            load_picture(file)
        if self.use_cameras:
            free = context.scene.camera is None
            with contextlib.suppress(RuntimeError):  # it has told itself what is wrong
                bpy.ops.drgs.import_cameras(
                    filepath=str(job.capture), axes=self.axes, use_camera=free, use_resolution=free
                )
        return {"FINISHED"}

    def clear(self) -> None:
        CommandOperator.clear(self)
        reconstruction.job = None
        redraw_sidebars(bpy.context)


def _has_no_cameras(capture: Path, axes: str) -> bool:
    """Whether cameras are to be found first."""
    if is_video(capture):
        return True
    try:
        engine_link.output_of(["inspect", str(capture), "--json", "--axes", axes])
    except UsageError as error:
        return f"{NO_CAPTURE}." in str(error)  # what else is wrong the program says
    return False


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


class DRGS_OT_reconstruct_settings(DrgsOperator, bpy.types.Operator):
    """Write all settings of Reconstruct from Photographs to a new text, as its fields have them, and use that text"""

    bl_idname = "drgs.reconstruct_settings"
    bl_label = "New Settings"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        dialog = getattr(context.space_data, "active_operator", None)
        if getattr(dialog, "bl_idname", "") != "DRGS_OT_reconstruct":
            dialog = None
        options = [] if dialog is None else options_of(dialog)
        text = bpy.data.texts.new("Reconstruction.toml")
        try:
            text.write(engine_link.output_of(["reconstruct", "--print-settings", *options]))
        except BaseException:
            bpy.data.texts.remove(text)
            raise
        if dialog is not None:
            dialog.settings = text.name
        return {"FINISHED"}


class DRGS_OT_reconstruct_show(DrgsOperator, bpy.types.Operator):
    """Show this picture of the reconstruction in an Image Editor, in a window of its own where there is none"""

    bl_idname = "drgs.reconstruct_show"
    bl_label = "Show Picture"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(name="File", description="The picture", options={"SKIP_SAVE"})

    def run(self, context: bpy.types.Context) -> set[str]:
        image = load_picture(Path(self.chosen("Picture")))
        windows = context.window_manager.windows
        area = next((a for w in windows for a in w.screen.areas if a.ui_type == "IMAGE_EDITOR"), None)
        if area is None:
            bpy.ops.wm.window_new()
            area = windows[-1].screen.areas[0]
            area.ui_type = "IMAGE_EDITOR"
        area.spaces.active.image = image
        return {"FINISHED"}


def load_picture(file: Path) -> bpy.types.Image:
    """The image of a file, as the file is now.

    Raises
    ------
    AssetError
        It is no picture, or not there.
    """
    try:
        image = bpy.data.images.load(str(file), check_existing=True)
    except RuntimeError as error:
        raise AssetError(str(file), "cannot be read", "Reconstruct again, which writes it anew") from error
    image.reload()
    return image


def _job() -> reconstruction.Reconstruction:
    assert reconstruction.job is not None, "none is under way"
    return reconstruction.job


CLASSES = (
    DRGS_OT_reconstruct,
    DRGS_OT_reconstruct_settings,
    DRGS_OT_reconstruct_cancel,
    DRGS_OT_reconstruct_show,
)
