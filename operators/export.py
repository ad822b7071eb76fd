"""File > Export: DR-GS objects for other programs, posed, painted and lit as in the scene, in one frame or moving."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import assets, blend_paths
from ..addon.alembic import write_alembic
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.core.file_types import LOST_IN_ALEMBIC, READ, WRITTEN
from ..drgs_blender.core.frame_sequences import frame_path
from .import_parts import UP_ITEMS
from .scene_frames import NUMBER, SceneFrames, draw_colour

_HELD = {
    "splats": "Splats",
    "mesh": "Mesh with materials",
    "sequence": "Moving meshes: all frames in one file",
    "environment": "The World",
}
_ALEMBIC = "Alembic sequence"
# Blender evaluates annotations apart from this module: no loops in them.
_FORMATS = tuple((name, f"{name} ({t.extensions[0]})", _HELD[t.kind]) for name, t in WRITTEN.items())
_SPZ_VERSIONS = (
    ("auto", "Default", "4 in SPZ files, 2 in glTF"),
    ("4", "4", "The newest; smallest and read fastest"),
    ("3", "3", "For programs that do not know version 4"),
    ("2", "2", "For the oldest programs; coarser rotations"),
)
_KERNELS = (
    ("ellipsoid", "Ellipsoids", "Flat 3D Gaussians, which viewers of splats show"),
    ("surflet", "Surflets", "2D Gaussians, as surfels are; few programs show them yet"),
)
_ENDINGS = tuple(dict.fromkeys(e for t in WRITTEN.values() for e in t.extensions))
#: Endings of what other programs export, or of what is only read. Others may be parts of a name.
_FOREIGN = {".blend", ".bvh", ".drgs", ".fbx", ".mdd", ".pc2", ".svg", ".vdb", ".wrl", ".x3d"}
_FOREIGN |= {e for t in READ.values() for e in t.extensions if e not in _ENDINGS}
_GLOB = ";".join(f"*{e}" for e in _ENDINGS)


class DRGS_OT_export(SceneFrames, bpy.types.Operator):
    """Write DR-GS objects as they are posed, painted and lit, as splats or meshes for other programs"""

    bl_idname = "drgs.export"
    bl_label = "Export DR-GS"
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        description="The file to write; its ending chooses the format",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    filter_glob: StringProperty(default=_GLOB, options={"HIDDEN"})
    format: EnumProperty(
        name="Format",
        description="What to write",
        items=_FORMATS,
        default="3DGS PLY",
    )
    scale: FloatProperty(name="Scale", description="Factor on all lengths", default=1.0, min=1e-6, max=1e6)
    up: EnumProperty(
        name="Up",
        description="Axis that points up in the file, where its format leaves the choice",
        items=UP_ITEMS,
        default="auto",
    )
    materials: BoolProperty(
        name="Materials",
        description="Albedo, roughness, metallic and normals of the splats, too, for programs that light them",
        default=False,
    )
    compress: BoolProperty(
        name="Compress", description="Pack the splats of a glTF as SPZ, which not every viewer unpacks", default=False
    )
    spz_version: EnumProperty(
        name="Version", description="Version of the SPZ format", items=_SPZ_VERSIONS, default="auto"
    )
    surfels: BoolProperty(
        name="Surfels", description="Beside the meshes their surfels, as moving splats", default=False
    )
    kernel: EnumProperty(name="Kernel", description="What a splat is in USD", items=_KERNELS, default="ellipsoid")
    use_animation: BoolProperty(
        name="Animation", description="A file for each frame of the scene; its number ends the name", default=False
    )
    frame_start: IntProperty(name="Frame Start", description="First frame", default=1)
    frame_end: IntProperty(name="End", description="Last frame", default=250)
    frame_step: IntProperty(name="Step", description="Frames from one file to the next", default=1, min=1)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        scene = context.scene
        self.frame_start, self.frame_end, self.frame_step = scene.frame_start, scene.frame_end, scene.frame_step
        if not self.filepath:
            blend = bpy.data.filepath
            stem = Path(blend).with_suffix("") if blend else "untitled"
            self.filepath = f"{stem}{WRITTEN[self.format].extensions[0]}"
        self.check(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context: bpy.types.Context) -> bool:
        """Give the file the ending of the format; whether that changed anything. Foreign ones stay, to be refused."""
        path = Path(self.filepath)
        own = WRITTEN[self.format].extensions
        if path.suffix.lower() in (*own, *_FOREIGN) or not path.name:
            return False
        self.filepath = str(path.with_suffix(own[0]) if path.suffix.lower() in _ENDINGS else f"{path}{own[0]}")
        return True

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        kind = WRITTEN[self.format]
        layout.prop(self, "format")
        if kind.kind != "environment":
            layout.prop(self, "use_selection")
            layout.prop(self, "scale")
            if not kind.fixed:
                layout.prop(self, "up")
        if kind.kind == "splats":
            draw_colour(layout, self)
        for option in _options(self):
            layout.prop(self, option)
        if kind.kind == "sequence" and self.surfels and kind.options:
            draw_colour(layout, self)
        if kind.kind != "sequence":
            layout.prop(self, "use_animation")
        if self.use_animation or kind.kind == "sequence":
            column = layout.column(align=True)
            column.prop(self, "frame_start")
            column.prop(self, "frame_end")
            column.prop(self, "frame_step")

    def run(self, context: bpy.types.Context) -> set[str]:
        self.chosen("Export")
        given, kind = Path(self.filepath), WRITTEN[self.format]
        if given.suffix.lower() in _FOREIGN:
            raise UsageError(given.name, f"cannot be written; understood: {' '.join(_ENDINGS)}", "Choose one of these")
        if self.check(context) and given.suffix.lower() in _ENDINGS:
            self.warn(f"{given.name}: its format is {self.format}; written as {Path(self.filepath).name}")
        target = Path(bpy.path.abspath(self.filepath)).absolute()
        moving = kind.kind == "sequence"
        frames = None
        if self.use_animation or moving:
            frames = range(self.frame_start, self.frame_end + 1, self.frame_step)
        if frames is not None and not frames:
            raise UsageError("Export", f"frames {self.frame_start} to {self.frame_end} are none", "Change the range")
        if self.format == _ALEMBIC:
            return self._write_alembic(context, target, frames or range(0))
        if frames is not None and "#" not in target.name and not moving:
            target = target.with_name(f"{target.stem}_{NUMBER}{target.suffix}")
        with self.folder("drgs-export-"):
            arguments = self.describe(context, target, kind.kind, frames)
        if kind.kind != "environment":
            arguments.append(f"--scale={self.scale:.9g}")
        for option in _options(self):
            value = getattr(self, option)
            if value not in (False, "auto"):
                name = f"--{option.replace('_', '-')}"
                arguments.append(name if value is True else f"{name}={value}")
        if not kind.fixed and self.up != "auto":
            arguments.append(f"--up={self.up}")
        shown = [context.scene.frame_current] if frames is None else frames
        files = [target] if moving else [frame_path(str(target), n) for n in shown]
        return self.start(context, arguments, target.name, f"Writing {target.name}", "could not be written", files)

    def _write_alembic(self, context: bpy.types.Context, target: Path, frames: range) -> set[str]:
        """Let Blender's own exporter write the meshes."""
        names = [obj.name for obj in context.selected_objects if assets.is_drgs(obj)]
        if self.use_selection and not names:
            raise UsageError("Export", "no selected object is a DR-GS object", "Select one")
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        written = write_alembic(context, target, frames, names if self.use_selection else [], self.scale)
        for obj in map(context.view_layer.objects.get, written):
            if not len(assets.load(assets.file_of(obj)).mesh.vertices):
                found = "only its proxy" if len(obj.data.vertices) else "nothing"
                self.warn(f'"{obj.name}" has no mesh: {target.name} has {found} of it. A USD sequence has its surfels')
        self.report({"INFO"}, f"{target.name}: {LOST_IN_ALEMBIC}")
        return {"FINISHED"}


def _options(operator: DRGS_OT_export) -> list[str]:
    """Options of the chosen format; those of surfels in a sequence, and of SPZ in glTF, only where there are some."""
    names = WRITTEN[operator.format].options
    if "surfels" in names and not operator.surfels:
        return ["surfels"]
    return [n for n in names if n != "spz_version" or operator.format == "SPZ" or operator.compress]


CLASSES = (DRGS_OT_export,)
