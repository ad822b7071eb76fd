"""File > Import > Cameras of photographs: one looks through each with its photograph behind the scene."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty
from mathutils import Matrix

from ..addon import blend_paths, engine_link, messages
from ..drgs_blender.core.errors import AssetError, UsageError, first_of
from ..drgs_blender.core.file_integrity import crashes_blender
from ..drgs_blender.core.file_types import READ
from .base import DrgsOperator
from .reconstruct_fields import CAMERA_ITEMS, NO_CAPTURE

#: Endings of files in captures: cameras of the layouts that are read, and photographs.
_IN_CAPTURES = (".json", ".npy", ".bin", ".txt", ".pkl", ".exr", *READ["picture"].extensions)
#: How many folders above a chosen file a capture is looked for: cameras may be in sparse/0, photographs in images.
_ABOVE = 3
#: Custom properties: of a collection the capture whose cameras it holds, of a camera its photograph.
_CAPTURE, _PHOTOGRAPH = "drgs_capture", "drgs_photograph"
#: Width of the sensor that the cameras get, mm: that of full frame.
_SENSOR = 36.0
#: Size of the cameras in the viewport, in parts of their median distance from the world's origin.
_DISPLAY = 0.06
#: Difference of fx and fy beyond which pixels are told not to be square.
_SQUARE = 0.005


class DRGS_OT_import_cameras(DrgsOperator, bpy.types.Operator):
    """Add the cameras of a capture (COLMAP, NeRF, nerfstudio, drgs capture), each with its photograph as background"""

    bl_idname = "drgs.import_cameras"
    bl_label = "Import Cameras of Photographs"
    bl_options = {"REGISTER", "UNDO", "PRESET"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        description="Folder of the capture, or a file in it",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{e}" for e in _IN_CAPTURES), options={"HIDDEN"})
    use_pictures: BoolProperty(
        name="Photographs", description="Show each photograph behind the scene in its camera's view", default=True
    )
    opacity: FloatProperty(name="Opacity", description="Of the photographs", default=0.5, min=0.0, max=1.0)
    axes: EnumProperty(
        name="Camera Convention",
        description="Axes of the cameras' matrices, as the object was reconstructed with",
        items=CAMERA_ITEMS,
        default="opengl",
        options={"SKIP_SAVE"},
    )
    use_camera: BoolProperty(name="Set Camera", description="Make the first one the camera of the scene", default=True)
    use_resolution: BoolProperty(
        name="Set Resolution",
        description="Give the scene the resolution of most photographs, and square pixels",
        default=True,
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.chosen("Import Cameras"))).absolute()
        path, found = _inspect(path, self.axes)
        cameras = found["cameras"]
        made = self._place(context, path, cameras)
        missing = [name for one, obj in zip(cameras, made) if (name := self._show(one, obj.data))]
        if self.use_camera:
            context.scene.camera = made[0]
        if self.use_resolution:
            render = context.scene.render
            (size, _), = Counter((one["width"], one["height"]) for one in cameras).most_common(1)  # fmt: skip
            (render.resolution_x, render.resolution_y), render.resolution_percentage = size, 100
            render.pixel_aspect_x = render.pixel_aspect_y = 1.0
        self._tell(path, found, missing)
        return {"FINISHED"}

    def _place(self, context: bpy.types.Context, path: Path, cameras: list[dict[str, Any]]) -> list[bpy.types.Object]:
        """The objects of `cameras` in the scene; those of an earlier import are renewed."""
        distances = [float(np.linalg.norm(np.array(one["matrix_world"])[:3, 3])) for one in cameras]
        size = _DISPLAY * float(np.median(distances))
        folder = path.parent if path.is_file() else path
        earlier = _collection(context, folder)
        known: dict[str, bpy.types.Object] = {}
        for obj in sorted(earlier.objects if earlier else (), key=lambda one: one.name):  # copies come later
            if obj.type == "CAMERA" and _PHOTOGRAPH in obj:
                known.setdefault(obj[_PHOTOGRAPH], obj)
        made = [_camera(one, size, known.get(one["image"])) for one in cameras]
        new = [obj for one, obj in zip(cameras, made) if one["image"] not in known]
        if new:
            into = earlier or _new_collection(context, folder)
            for obj in new:
                into.objects.link(obj)
        if len(new) < len(made):
            text = (
                f"{path}: {len(made) - len(new)} of its cameras were there already and are renewed, {len(new)} are new"
            )
            messages.note("INFO", text)
            self.report({"INFO"}, text)
        return made

    def _show(self, camera: dict[str, Any], data: bpy.types.Camera) -> str:
        """Put the photograph behind the camera's view; the name of one that cannot be loaded, else ""."""
        path = Path(camera["image"])
        for background in list(data.background_images):  # not the user's own
            if background.image and Path(bpy.path.abspath(background.image.filepath)) == path:
                data.background_images.remove(background)
        if not self.use_pictures:
            return ""
        try:
            if crashes_blender(path):
                return f"{path.name} (cut off)"
            image = bpy.data.images.load(str(path), check_existing=True)
        except (RuntimeError, OSError):
            return path.name
        background = data.background_images.new()
        background.image, background.alpha, background.frame_method = image, self.opacity, "FIT"
        data.show_background_images = True
        return ""

    def _tell(self, path: Path, found: dict[str, Any], missing: list[str]) -> None:
        """Warn of what Blender's cameras cannot show, and of what the capture assumed."""
        cameras = found["cameras"]
        if found["guessed"]:
            guessed = ", ".join(f"{name} ({why})" for name, why in found["guessed"].items())
            self.warn(f"{path}: was made without knowing {guessed}: objects made of it are where these cameras are")
        if missing:
            self.warn(f"{path}: {len(missing)} photographs cannot be loaded: {first_of(missing)}")
        if bent := [one["name"] for one in cameras if one["distorts"]]:
            self.warn(
                f"{path}: the lenses of {len(bent)} photographs distort, Blender's cameras do not: towards the edges "
                f"photographs and scene differ ({first_of(bent)})"
            )
        if oblong := [one["name"] for one in cameras if abs(one["fx"] / one["fy"] - 1) > _SQUARE]:
            self.warn(f"{path}: pixels are not square, and shown so, of {first_of(oblong)}")
        if len(sizes := {(one["width"], one["height"]) for one in cameras}) > 1 and self.use_resolution:
            self.warn(f"{path}: photographs have {len(sizes)} sizes: set the resolution to look through the others")


def _inspect(path: Path, axes: str) -> tuple[Path, dict[str, Any]]:
    """The capture that `path` is, or in whose folder it lies, and its description."""
    places = [path]
    if path.is_file() and path.suffix.lower() != ".json":
        if path.suffix.lower() not in _IN_CAPTURES:
            remedy = "Choose the folder of the photographs, its transforms.json, poses_bounds.npy or a photograph"
            raise AssetError(str(path), "is neither a capture nor a photograph", remedy)
        places = list(path.parents)[:_ABOVE]
    failures: list[UsageError] = []
    for place in places:
        try:
            found = json.loads(engine_link.output_of(["inspect", str(place), "--json", "--axes", axes]))
        except UsageError as error:
            failures.append(error)
            continue
        if found.get("kind") != "capture":
            problem = f"{NO_CAPTURE}, but {found.get('format', found.get('kind'))}"
            failures.append(UsageError(str(place), problem, "Choose the folder of the photographs"))
        elif path.suffix.lower() in READ["picture"].extensions and path.parent != place and not _has(found, path):
            failures.append(UsageError(str(path), f"is no photograph of the capture {place}", "Choose one of them"))
        else:
            return place, found
    raise next((one for one in failures if NO_CAPTURE not in str(one)), failures[0])


def _has(found: dict[str, Any], photograph: Path) -> bool:
    """Whether a capture has this photograph."""
    return any(Path(one["image"]) == photograph for one in found["cameras"])


def _collection(context: bpy.types.Context, folder: Path) -> bpy.types.Collection | None:
    """The scene's collection of the cameras of the capture in `folder`, if there is one."""
    return next((one for one in context.scene.collection.children_recursive if one.get(_CAPTURE) == str(folder)), None)


def _new_collection(context: bpy.types.Context, folder: Path) -> bpy.types.Collection:
    """A collection for them, in the scene."""
    made = bpy.data.collections.new(f"Cameras of {folder.name}")
    made[_CAPTURE] = str(folder)
    context.scene.collection.children.link(made)
    return made


def _camera(camera: dict[str, Any], size: float, known: bpy.types.Object | None) -> bpy.types.Object:
    """The object of a camera: `known`, renewed, or a new one, in no collection yet."""
    obj = known or bpy.data.objects.new(camera["name"], bpy.data.cameras.new(camera["name"]))
    obj[_PHOTOGRAPH] = camera["image"]
    data = obj.data
    width, height = camera["width"], camera["height"]
    data.sensor_fit, data.sensor_width = "HORIZONTAL", _SENSOR
    data.lens = camera["fx"] / width * _SENSOR
    data.shift_x, data.shift_y = (width / 2 - camera["cx"]) / width, (camera["cy"] - height / 2) / width
    data.display_size = max(size, 1e-3)
    obj.matrix_world = Matrix(camera["matrix_world"])
    return obj


CLASSES = (DRGS_OT_import_cameras,)
