"""Fields of the dialog *Reconstruct from Photographs*, and the options of ``drgs reconstruct`` that they give."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import blend_paths
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.core.file_types import CAMERAS, VIDEOS


def _title(cameras: str) -> str:
    """As "OpenCV, Inverse"."""
    return cameras.replace("opencv", "OpenCV").replace("opengl", "OpenGL").replace("-inverse", ", Inverse")


#: Choices of what the cameras' matrices are.
CAMERA_ITEMS = (
    ("opengl", "Automatic", "What the layout of the files has by convention: COLMAP, NeRF, nerfstudio"),
    *((name, _title(name), meaning.capitalize()) for name, meaning in CAMERAS.items() if name != "opengl"),
)
#: What `drgs inspect` says of folders that are none.
NO_CAPTURE = "is no capture"
_MODEL = "model"
_MASK_ITEMS = (
    ("auto-without-cameras", "Automatic without Cameras", "Make them where the photographs have neither masks nor "
     "cameras; of photographs with cameras use those that are there"),
    ("given", "As Given", "Use those that are there (in a folder masks, or alpha), and make none"),
    ("auto", "Automatic", "Make them where there are none: the object stands on a ground that shows texture, in about "
     "two minutes"),
    (_MODEL, "From a Model File", "Make them, where there are none, by a segmentation model that you have (ONNX)"),
    ("none", "None", "Use none and make none: the surroundings become part of the object"),
)  # fmt: skip
_POSE_ITEMS = (
    ("auto", "Automatic", "By the marker sheet where most photographs show it, else by features"),
    ("markers", "Marker Sheet", "By the marker sheet alone, however few photographs show it"),
    ("features", "Features", "By what photographs show in common; no marker sheet is looked for"),
)
_BRACKET_ITEMS = (
    ("auto", "Automatic", "Merge those that the photographs' metadata (EXIF) show"),
    ("none", "None", "Merge nothing"),
    *((str(n), f"Each {n}", f"Each {n} photographs that follow each other are one view") for n in range(2, 10)),
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
    "video_frames": ("capture.video_frames", 1, 10),
    "marker_length": ("capture.marker_length", 1e-6, 0.001),
    "camera_distance": ("capture.camera_distance", 1e-6, 0.001),
}
#: Fields that are a choice -> the setting of each.
_CHOICES = {"masks": "capture.masks", "poses": "capture.poses", "brackets": "capture.brackets"}
#: Fields of *Without Cameras*, in their order.
_WITHOUT_CAMERAS = ("video_frames", "poses", "marker_length", "camera_distance", "brackets")
_ADVANCED = ("surfels", "voxels", "iterations", "material_iterations")


def is_video(capture: str | PurePath) -> bool:
    """Whether a file is a video, by its name."""
    return PurePath(capture).suffix.lower() in VIDEOS


def without_cameras(fields: bpy.types.OperatorProperties, capture: str) -> list[str]:
    """Fields that matter where cameras are to be found of a file or folder, "" of any.

    Files that are no video hold cameras; the length of markers needs a sheet, and what one measures needs no distance.
    """
    film = is_video(capture)
    if not film and os.path.isfile(capture):
        return []
    idle = {"brackets"} if film else set()
    idle |= {"markers": {"camera_distance"}, "features": {"marker_length"}}.get(fields.poses, set())
    return [name for name in _WITHOUT_CAMERAS if name not in idle]


def options_of(fields: bpy.types.OperatorProperties, capture: str = "") -> list[str]:
    """Options of ``drgs reconstruct`` for the fields of the dialog.

    Raises
    ------
    UsageError
        Masks are to be made by a model, and none is named.
    """
    idle = set(_WITHOUT_CAMERAS).difference(without_cameras(fields, capture))
    arguments = ["--variant", fields.variant, "--axes", fields.axes]
    for name, (setting, given_from, least) in _NUMBERS.items():
        if name not in idle and (value := getattr(fields, name)) >= given_from:
            value = max(value, least)
            arguments += ["--set", f"{setting}={value:.6g}" if isinstance(value, float) else f"{setting}={value}"]
    for name, setting in _CHOICES.items():
        value, default = getattr(fields, name), ReconstructFields.defaults[name]
        if name not in idle and value != default:
            value = _model_of(fields) if (name, value) == ("masks", _MODEL) else value
            arguments += ["--set", f"{setting}={value}"]
    return arguments if fields.use_materials else [*arguments, "--no-materials"]


def _model_of(fields: bpy.types.OperatorProperties) -> str:
    """The segmentation model: a file, or a name that the program looks up."""
    if not fields.mask_model:
        raise UsageError("Masks", "no model is given", "Choose its ONNX file as Mask Model, or other Masks")
    path = bpy.path.abspath(fields.mask_model)
    return str(Path(path).absolute()) if os.path.isfile(path) else fields.mask_model


def settings_file(text: str, named: str, folder: Path) -> Path | None:
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


class ReconstructFields:
    """Properties of the operator, and how the file browser shows them."""

    if TYPE_CHECKING:  # of Blender's Operator
        layout: bpy.types.UILayout

    #: Of the choices.
    defaults = {"masks": "auto-without-cameras", "poses": "auto", "brackets": "auto"}  # noqa: RUF012 - never changed

    filepath: StringProperty(
        description="Folder of the photographs, with their cameras or without; or a video",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    out: StringProperty(
        name="Save As",
        description="The file to write; empty is beside the .blend, numbered where an object is made of that",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
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
    masks: EnumProperty(
        name="Masks",
        description="What tells the object from its surroundings",
        items=_MASK_ITEMS,
        default="auto-without-cameras",
    )
    mask_model: StringProperty(
        name="Mask Model",
        description="Segmentation model (.onnx), such as U2-Net or BiRefNet, or the name of one that rembg has "
        "downloaded. Nothing is downloaded here",
        subtype="FILE_PATH",
        options=blend_paths.RELATIVE,
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
    use_cameras: BoolProperty(
        name="Import Cameras",
        description="Add the photographs' cameras too, each with its photograph as background, to see how the object "
        "fits",
        default=False,
    )
    video_frames: IntProperty(
        name="Frames of a Video",
        description="How many of its frames are used, about: the sharpest of each part of the way, from 10 to 400; 0 "
        "is 90",
        default=0,
        min=0,
        max=400,
    )
    poses: EnumProperty(
        name="Find Cameras By", description="What shows where each photograph was taken", items=_POSE_ITEMS
    )
    marker_length: FloatProperty(
        name="Marker Square Length (mm)",
        description="Side of a black square of the printed marker sheet, as measured; 0: it was printed in true size",
        default=0.0,
        min=0.0,
        max=1e4,
    )
    camera_distance: FloatProperty(
        name="Camera Distance (m)",
        description="From the cameras to the object, typically: how large the object is where no marker sheet says it; "
        "0: 1 m, a guess",
        default=0.0,
        min=0.0,
        max=1e4,
    )
    brackets: EnumProperty(
        name="Exposure Brackets",
        description="Photographs of one view in several exposures, merged to one",
        items=_BRACKET_ITEMS,
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
        "Set World, Import Cameras and the scene's device are not among them",
        options={"SKIP_SAVE"},
    )
    config: StringProperty(
        name="Settings File",
        description="TOML file of settings, or an asset whose settings to use again, in place of a text",
        options={"SKIP_SAVE"},
    )

    def draw(self, context: bpy.types.Context) -> None:
        """Blender's."""
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        own = not (self.settings or self.config)
        masks = ["masks", *(["mask_model"] if self.masks == _MODEL else [])]
        _show(layout, self, ["minutes", "resolution", "variant", "use_materials", *masks, "test_every", "axes"], own)
        _show(layout, self, ["use_environment", "use_cameras", "out"])
        if found := without_cameras(self, _browsed(context) or self.filepath):
            header, body = layout.panel("DRGS_PT_reconstruct_without_cameras", default_closed=True)
            header.label(text="Without Cameras")
            if body is not None:
                _show(body, self, found, own)
        header, body = layout.panel("DRGS_PT_reconstruct_advanced", default_closed=True)
        header.label(text="Advanced")
        if body is None:
            return
        _show(body, self, _ADVANCED, own)
        row = body.row(align=True)
        row.prop_search(self, "settings", bpy.data, "texts")
        row.operator("drgs.reconstruct_settings", text="", icon="ADD")
        body.prop(self, "config")


def _show(layout: bpy.types.UILayout, fields: bpy.types.Operator, names: Sequence[str], active: bool = True) -> None:
    """Fields below each other; those that are not `active` are greyed."""
    column = layout.column()
    column.active = active
    for name in names:
        column.prop(fields, name)


def _browsed(context: bpy.types.Context) -> str:
    """The file or folder that is chosen in the file browser; "" elsewhere."""
    params = getattr(context.space_data, "params", None)
    return os.path.join(os.fsdecode(params.directory), params.filename) if params is not None else ""
