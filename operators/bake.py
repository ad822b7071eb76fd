"""Bake Light: what DR-GS sees on the selected objects, for other engines: colour attributes or images."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..addon import assets, blend_paths, mesh_arrays, messages
from ..addon.export import export_baked
from ..addon.export.camera import NO_CAMERA
from ..addon.export.frame import WORKING_SPACE
from ..addon.export.topology_check import check_topology
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.core.frame_sequences import frame_path
from ..drgs_blender.ipc.frame_file import SUFFIX, write_frame_file
from . import selection
from .engine_command import CommandOperator

_NUMBER = "####"
#: Attributes of meshes themselves, whose names Blender 5.2 gives away, too; others begin with a dot.
_BUILT_IN = {"position", "material_index", "sharp_face", "sharp_edge"}


class DRGS_OT_bake_light(CommandOperator, selection.ObjectMode, bpy.types.Operator):
    """Bake the light of the scene on the selected DR-GS objects to colour attributes, or to images by their UV maps"""

    bl_idname = "drgs.bake_light"
    bl_label = "Bake Light"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    target: EnumProperty(
        name="Bake To",
        description="Where the colour goes",
        items=(
            ("ATTRIBUTE", "Attribute", "A colour attribute of the vertices; one for each frame of an animation"),
            ("IMAGE", "Image", "An EXR file for each object, and for each frame of an animation, by its UV map"),
        ),
        default="ATTRIBUTE",
    )
    name: StringProperty(
        name="Name",
        description="Name of the attribute; the number of a frame of an animation is added",
        default="relit",
    )
    directory: StringProperty(
        name="Folder",
        description="Where the images go",
        subtype="DIR_PATH",
        default="//",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    size: IntProperty(
        name="Size", description="Width and height of the images, texels", default=1024, min=16, max=16384
    )
    light: EnumProperty(
        name="Light",
        description="Part of the light that is baked",
        items=(
            ("all", "All", "Diffuse light and highlights, these as seen along the normal"),
            ("diffuse", "Diffuse", "Only light that is the same from every viewpoint"),
        ),
        default="all",
    )
    samples: IntProperty(
        name="Samples", description="Samples of light per vertex or texel", default=256, min=3, max=65536
    )
    use_animation: BoolProperty(name="Animation", description="All frames of the scene's range", default=False)

    _names: tuple[str, ...] = ()
    _frames: tuple[int, ...] = ()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "target", expand=True)
        for name in ("name",) if self.target == "ATTRIBUTE" else ("directory", "size"):
            layout.prop(self, name)
        for name in ("light", "samples", "use_animation"):
            layout.prop(self, name)

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context), data=True)
        scene = context.scene
        frames = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        self._frames = tuple(frames) if self.use_animation else (scene.frame_current,)
        if self.target == "ATTRIBUTE":
            for name in map(self._attribute_name, self._frames):
                check_name(name, objects)
        self._names = tuple(obj.name for obj in objects)
        self._check_targets(objects)
        with self.folder("drgs-bake-") as folder:
            scenes = str(folder / f"{_NUMBER}{SUFFIX}")
            arguments = ["bake", scenes, "--samples", str(self.samples), "--light", self.light]
            arguments += ["--size", str(self.size), f"--frames={','.join(map(str, self._frames))}"]
            for number in self._visited(context):
                given = context.evaluated_depsgraph_get(), str, messages.Warnings(), lambda text, part: None
                frame = export_baked(*given, camera=NO_CAMERA)
                known = {state.name for state in frame.objects}
                for name in set(self._names) - known:
                    raise UsageError(f'Object "{name}"', "is not rendered", "Enable it in renders, or deselect it")
                write_frame_file(frame_path(scenes, number), frame)
            files = []
            for i, obj in enumerate(objects):
                place = self._target_of(context, i, obj)
                arguments += ["--object", obj.name, *place]
                files += [frame_path(place[0], number) for number in self._frames]
        return self.start(context, arguments, "Light", "Baking light", "could not be baked", files)

    def done(self, context: bpy.types.Context) -> set[str]:
        """Put what the program wrote where it belongs."""
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        for i, name in enumerate(self._names):
            obj = context.scene.objects.get(name)
            if obj is None:
                self.warn(f'Object "{name}" is gone; its light is lost')
            elif self.target == "IMAGE":
                show_image(frame_path(self._image(obj), self._frames[0]), len(self._frames) > 1)
            else:
                for number in self._frames:
                    colours = np.load(frame_path(self._attribute(i), number), allow_pickle=False)
                    if len(colours) != len(obj.data.vertices):
                        colours = of_all(obj, colours)
                    if colours is None:
                        self.warn(f'Object "{name}" has other vertices than before the bake; its light is lost')
                        break
                    write_colours(obj.data, self._attribute_name(number), colours)
        self.report({"INFO"}, f"Baked the light of {_count(self._frames, 'frame')} on {_count(self._names, 'object')}")
        return {"FINISHED"}

    def _visited(self, context: bpy.types.Context) -> Iterator[int]:
        """Have the scene at every frame, one after the other, and at its own again."""
        scene = context.scene
        now = scene.frame_current, scene.frame_subframe
        if not self.use_animation:
            yield now[0]
            return
        try:
            for number in self._frames:
                scene.frame_set(number)
                yield number
        finally:
            scene.frame_set(now[0], subframe=now[1])

    def _attribute_name(self, number: int) -> str:
        """The colour attribute that holds the light of a frame."""
        return f"{self.name}.{number:04}" if self.use_animation else self.name

    def _attribute(self, index: int) -> str:
        """Pattern of the files with the colours of an object's vertices."""
        return str(self.work_folder / f"{_NUMBER}_{index}.npy")

    def _image(self, obj: bpy.types.Object) -> str:
        """Pattern of the images of an object."""
        clean = re.sub(r"[^\w.-]+", "_", obj.name)
        return str(Path(bpy.path.abspath(self.directory)) / f"{clean}_{_NUMBER}.exr")

    def _check_targets(self, objects: list[bpy.types.Object]) -> None:
        """Refuse objects of which one would get the light of another."""
        targets: dict[object, bpy.types.Object] = {}
        for obj in objects:
            # Some file systems are case-insensitive.
            other = targets.setdefault(self._image(obj).casefold() if self.target == "IMAGE" else obj.data, obj)
            if other is obj:
                continue
            if self.target == "IMAGE":
                problem, remedy = f"would be baked to the same files, {self._image(obj)}", "Rename one of them"
            else:
                problem = f'share the mesh "{obj.data.name}"'
                remedy = "Choose Object > Relations > Make Single User, or bake to images"
            raise UsageError(f'Objects "{other.name}" and "{obj.name}"', problem, remedy)

    def _target_of(self, context: bpy.types.Context, index: int, obj: bpy.types.Object) -> list[str]:
        """Where the program writes the light of an object, and the UV map where that is an image."""
        if self.target == "ATTRIBUTE":
            return [self._attribute(index)]
        if not bpy.data.filepath and self.directory.startswith("//"):
            raise UsageError("Folder", f"{self.directory} lies beside the .blend, which is not saved", "Save it first")
        evaluated = obj.evaluated_get(context.evaluated_depsgraph_get())
        fit = check_topology(evaluated, evaluated.data, assets.load(assets.file_of(obj)).mesh, messages.Warnings())
        uvs = mesh_arrays.read_uvs(evaluated.data, "")
        if uvs is None:
            raise UsageError(f'Object "{obj.name}"', "has no UV map", "Unwrap it in Edit Mode, or bake to an attribute")
        path = self.work_folder / f"{index}_uvs.npy"
        of_faces = uvs.reshape(-1, 3, 2) if fit.corners is None else uvs[fit.corners]
        np.save(path, of_faces, allow_pickle=False)
        return [self._image(obj), str(path)]


def _count(items: Sequence[object], word: str) -> str:
    """How many there are, in words."""
    return f"{len(items)} {word}" if len(items) == 1 else f"{len(items)} {word}s"


def show_image(path: Path, sequence: bool) -> None:
    """Have Blender show the file at `path` as it is now, also where an image of it is there with what it was before."""
    image = bpy.data.images.load(str(path), check_existing=True)
    if not image.is_editable:  # of a library
        image = bpy.data.images.load(str(path))
    if image.packed_file is not None:
        image.unpack(method="REMOVE")
    image.source = "SEQUENCE" if sequence else "FILE"
    image.colorspace_settings.name = WORKING_SPACE
    image.alpha_mode = "PREMUL"
    image.reload()


def check_name(name: str, objects: list[bpy.types.Object]) -> None:
    """UsageError where the colours of vertices cannot be called `name`, or where something else would be lost."""
    trial = bpy.data.meshes.new("trial")
    usable = name not in ("", *mesh_arrays.ATTRIBUTES, *_BUILT_IN) and not name.startswith(".")
    usable = usable and trial.attributes.new(name, "FLOAT_COLOR", "POINT") is not None
    bpy.data.meshes.remove(trial)
    if not usable:
        raise UsageError("Name", f'"{name}" is none for baked light', "Choose another")
    for obj in objects:
        attribute = obj.data.attributes.get(name)
        if name in obj.vertex_groups or (attribute and attribute.data_type not in mesh_arrays.COLOURS):
            raise UsageError(f'Object "{obj.name}"', f'has "{name}" already, which is no colour', "Choose another name")


def of_all(obj: bpy.types.Object, colours: np.ndarray) -> np.ndarray | None:
    """Colours of the vertices that an object has of its asset, for all of its own: new ones are black.

    None: these are of other vertices.
    """
    rows = mesh_arrays.source_rows(obj.data, assets.load(assets.file_of(obj)).mesh)
    if rows is None or np.count_nonzero(rows >= 0) != len(colours):
        return None
    found = np.zeros((len(rows), 3), np.float32)
    found[rows >= 0] = colours
    return found


def write_colours(mesh: bpy.types.Mesh, name: str, colours: np.ndarray) -> None:
    """Set a colour attribute of the vertices, (n, 3) linear Rec.709; one of that name and another type is replaced."""
    attribute = mesh.attributes.get(name)
    if attribute is not None and (attribute.data_type, attribute.domain) != ("FLOAT_COLOR", "POINT"):
        mesh.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = mesh.attributes.new(name, "FLOAT_COLOR", "POINT")
    values = np.ones((len(colours), 4), np.float32)
    values[:, :3] = colours
    attribute.data.foreach_set("color", values.ravel())
    mesh.update_tag()


CLASSES = (DRGS_OT_bake_light,)
