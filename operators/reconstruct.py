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
CAMERA_ITEMS = (
    ("opengl", "Automatic", "What the layout of the files has by convention: COLMAP, NeRF, nerfstudio"),
    *((name, _title(name), meaning.capitalize()) for name, meaning in CAMERAS.items() if name != "opengl"),
)


#: Fields of the dialog -> (the setting of each, from which value on it is given, its least value). 0 says nothing; nor
#: does every first photograph to hold out, which would leave none.
_NUMBERS = {
    "minutes": ("minutes", 1e-6, 0.001),
    "resolution": ("capture.resolution", 1, 8),
    "test_every": ("capture.test_every", 2, 2),
    "surfels": ("schedule.surfels", 1, 10),
    "voxels": ("mesh_resolution", 1, 16),
    "iterations": ("schedule.iterations", 1, 1),
    "material_iterations": ("decoupling.iterations", 1, 1),
}


def options_of(fields: bpy.types.OperatorProperties) -> list[str]:
    """Options of ``drgs reconstruct`` for the fields of the dialog."""
    arguments = ["--variant", fields.variant, "--axes", fields.axes]
    for name, (setting, given_from, least) in _NUMBERS.items():
        if (value := getattr(fields, name)) >= given_from:
            value = max(value, least)
            arguments += ["--set", f"{setting}={value:.6g}" if isinstance(value, float) else f"{setting}={value}"]
    return arguments if fields.use_materials else [*arguments, "--no-materials"]


def _settings_file(text: str, named: str, folder: Path) -> Path | None:
    """The file of settings that the dialog gives, a text written to `folder`; None where it gives none."""
    if text and named:
        raise UsageError("Settings", f'are given as the text "{text}" and as the file {named}', "Leave one of them out")
    if named:
        return Path(bpy.path.abspath(named)).absolute()
    if not text:
        return None
    block = bpy.data.texts.get(text)
    if block is None:
        raise UsageError(f'Text "{text}"', "is not in this .blend", "Choose one, or press New Settings")
    file = folder / f"{bpy.path.clean_name(text)}.toml"
    file.write_text(block.as_string(), encoding="utf-8")
    return file


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
        name="Time Budget (min)",
        description="About how long it may take; 0 lets the steps decide",
        default=10.0,
        min=0.0,
        max=1e4,
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
        items=CAMERA_ITEMS,
        default="opengl",
        options={"SKIP_SAVE"},
    )
    use_environment: BoolProperty(
        name="Set World", description="Light the scene with the light of the photographs", default=False
    )
    surfels: IntProperty(
        name="Surfels, at Most", description="0: as many as the photographs show", default=0, min=0, max=5_000_000
    )
    voxels: IntProperty(
        name="Voxels",
        description="Of the mesh's longest side, from 16 to 1024; 0: 512 at most",
        default=0,
        min=0,
        max=1024,
    )
    iterations: IntProperty(
        name="Surfel Steps", description="How long surfels are learned; 0 is 3,000", default=0, min=0, max=10_000_000
    )
    material_iterations: IntProperty(
        name="Material Steps",
        description="How long materials and light are learned; 0 is 2,500",
        default=0,
        min=0,
        max=10_000_000,
    )
    settings: StringProperty(
        name="Settings",
        description="Text with all settings (TOML), as New Settings writes it; it comes in place of the fields above. "
        "Set World and the scene's device are not among them",
        options={"SKIP_SAVE"},
    )
    config: StringProperty(
        name="Settings File",
        description="TOML file of settings, or an asset whose settings to use again, in place of a text",
        options={"SKIP_SAVE"},
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        fields = layout.column()
        fields.active = not (self.settings or self.config)
        for name in ("minutes", "resolution", "variant", "use_materials", "test_every", "axes"):
            fields.prop(self, name)
        layout.prop(self, "use_environment")
        layout.prop(self, "out")
        header, body = layout.panel("DRGS_PT_reconstruct_advanced", default_closed=True)
        header.label(text="Advanced")
        if body is None:
            return
        fields = body.column()
        fields.active = not (self.settings or self.config)
        for name in ("surfels", "voxels", "iterations", "material_iterations"):
            fields.prop(self, name)
        row = body.row(align=True)
        row.prop_search(self, "settings", bpy.data, "texts")
        row.operator("drgs.reconstruct_settings", text="", icon="ADD")
        body.prop(self, "config")

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
        arguments = ["reconstruct", str(capture), "--out", str(out), "--device", context.scene.drgs.device.lower()]
        with self.folder("drgs-reconstruct-") as work:
            file = _settings_file(self.settings, self.config, work)
            arguments += options_of(self) if file is None else ["--config", str(file)]
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


def _job() -> reconstruction.Reconstruction:
    assert reconstruction.job is not None, "none is under way"
    return reconstruction.job


def _redraw(context: bpy.types.Context) -> None:
    """Draw the sidebars again."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


CLASSES = (DRGS_OT_reconstruct, DRGS_OT_reconstruct_settings, DRGS_OT_reconstruct_cancel)
