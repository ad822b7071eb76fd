"""Make an asset from captured surfels, their mesh and their light, by the command ``drgs``, then import it."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, StringProperty

from ..addon import assets, blend_paths
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.core.file_types import READ, extensions
from ..drgs_blender.core.frame_sequences import frame_path, frames_of, template_of
from . import sequences
from .base import DropTarget
from .engine_command import CommandOperator
from .import_asset import import_assets

#: Bytes in which the header of a PLY or glTF file says what it holds, and what only those of splats hold.
HEADER = 65536
SPLATS = {
    ".ply": (b" opacity\n", b" opacity\r", b" packed_position"),
    ".glb": (b'"KHR_gaussian_splatting"',),
    ".gltf": (b'"KHR_gaussian_splatting"',),
}
#: A name that says too little to be caught by it.
GENERAL = (".json",)
UP_ITEMS = (
    ("auto", "Automatic", "As the file's format says"),
    ("z", "Z", "As in Blender"),
    ("y", "Y", "Most games and glTF"),
    ("-y", "-Y", "Most photogrammetry"),
    ("-z", "-Z", "Upside down"),
)


#: Files that are dropped, and those that the browser shows besides.
DROPPED = tuple(e for e in extensions("surfels", "mesh") if e not in GENERAL)
SHOWN = (".drgs", *DROPPED, ".exr", ".hdr")
FILES = "surfels", "mesh", "environment", "out"
OPTIONS = "up", "scale", "pose"
SWITCHES = "use_mesh", "use_remove_light", "use_environment"


class DRGS_OT_import_parts(CommandOperator, bpy.types.Operator):
    """Make a .drgs asset from surfels or splats and their mesh, or from a textured mesh alone, and load it"""

    bl_idname = "drgs.import_parts"
    bl_label = "Import Object"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    surfels: StringProperty(
        name="Splats or Surfels",
        description="PLY, SPZ, SOG, ... with surfels or splats; #### stands for the number of a sequence",
        subtype="FILE_PATH",
        options=blend_paths.RELATIVE,
    )
    mesh: StringProperty(
        name="Mesh",
        description="The mesh they were reconstructed with; or, without surfels, any textured mesh",
        subtype="FILE_PATH",
        options=blend_paths.RELATIVE,
    )
    environment: StringProperty(
        name="Environment",
        description="EXR or HDR image of the light",
        subtype="FILE_PATH",
        options=blend_paths.RELATIVE,
    )
    out: StringProperty(
        name="Save As",
        description="The file to write; empty is beside the first file, numbered where an object is made of that",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    up: EnumProperty(name="Up", description="Axis that points up in the files", items=UP_ITEMS, default="auto")
    scale: FloatProperty(name="Scale", description="Factor on all lengths", default=1.0, min=1e-6, max=1e6)
    pose: EnumProperty(
        name="Pose",
        description="Of a rigged glTF file without surfels",
        items=(
            ("rest", "Rest", "As Blender's importer rests it, so that Transfer Rig fits"),
            ("default", "As Viewers Show", "For files whose rest pose is broken, or that need no rig"),
        ),
        default="rest",
    )
    use_mesh: BoolProperty(
        name="Mesh from Splats",
        description="Where no mesh is given, build one around the splats, so that they can be bent and cast shadows. "
        "Else light meets the splats themselves: for foliage, hair, anything thin",
        default=True,
    )
    use_remove_light: BoolProperty(
        name="Estimate Colour without Light",
        description="Estimate the albedo of surfels without materials: their captured colour divided by the light that "
        "the environment sends there, with shadows. Without an environment that is estimated, too, and kept in the "
        "asset: all but its brightness and mean colour; highlights and metals stay",
        default=False,
    )
    use_environment: BoolProperty(name="Set World", description="Light the scene with the environment", default=False)
    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE", "HIDDEN"})
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"})
    filter_glob: StringProperty(default=";".join(f"*{e}" for e in SHOWN), options={"HIDDEN"})
    browse: BoolProperty(
        description="Choose files in the file browser, .drgs as well, in place of the dialog",
        options={"SKIP_SAVE", "HIDDEN"},
    )

    _frames: tuple[int, ...] = ()
    _target = Path()

    @classmethod
    def description(cls, context: bpy.types.Context, given: bpy.types.OperatorProperties) -> str:
        return "Load .drgs assets, splats or textured meshes; of the last two an asset is made" if given.browse else ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.browse:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        try:
            self._assign_dropped_files()
        except UsageError as error:
            return self.fail(error)
        title = "Make Asset"
        return context.window_manager.invoke_props_dialog(self, width=420, title=title, confirm_text=title)

    def draw(self, context: bpy.types.Context) -> None:
        split = self.layout.column()
        split.use_property_split = True
        for name in (*(() if self.browse else FILES), *OPTIONS):
            split.prop(self, name)
        for name in SWITCHES:
            self.layout.prop(self, name)

    def run(self, context: bpy.types.Context) -> set[str]:
        if self.browse:
            others = self._import_assets(context)
            if not others:
                return {"FINISHED"}
            self._assign(others)
        else:
            self._assign_dropped_files()
        arguments = self._arguments()
        name = Path(self.surfels or self.mesh).name
        status = f"Making {self._target.name}"
        return self.start(context, arguments, name, status, "could not be made into an asset", self._files())

    def done(self, context: bpy.types.Context) -> set[str]:
        objects = import_assets(context, self._files(), self.use_environment)
        if self._frames:
            stem = self._target.stem
            sequences.play(objects, list(self._frames), stem.rstrip("#_-. ") or stem)
        return {"FINISHED"}

    def _import_assets(self, context: bpy.types.Context) -> list[Path]:
        """Import the .drgs files among those chosen; the others."""
        paths = [Path(self.directory) / f.name for f in self.files if f.name]
        if not paths:
            raise UsageError("Import", "no file is chosen", "Choose one, or several that belong together")
        ready = [path for path in paths if path.suffix.lower() == ".drgs"]
        if ready:
            import_assets(context, ready, self.use_environment)
        return [path for path in paths if path not in ready]

    def _assign_dropped_files(self) -> None:
        """Files that were dropped, each where it belongs; what was dropped before does not stay."""
        paths = [Path(self.directory) / f.name for f in self.files if f.name]
        paths = paths or ([Path(self.filepath)] if self.filepath else [])
        if paths:
            self._assign(paths)
        self.filepath = ""
        self.files.clear()

    def _assign(self, paths: list[Path]) -> None:
        """Each file where it belongs."""
        self.surfels = self.mesh = self.environment = ""
        kinds: dict[str, list[Path]] = {}
        for path in paths:
            kinds.setdefault(kind_of(path), []).append(path)
        for kind, found in kinds.items():
            setattr(self, kind, template_of(found)[0] if len(found) > 1 else str(found[0]))

    def _files(self) -> list[Path]:
        """The assets to write."""
        return [frame_path(str(self._target), frame) for frame in self._frames] or [self._target]

    def _choose_target(self) -> None:
        """Find where to write: never over the asset of an object."""
        target = Path(bpy.path.abspath(self.out or self.surfels or self.mesh)).with_suffix(".drgs")
        if self._frames and "#" not in target.name:
            raise UsageError(target.name, "has no # for the number of each frame", "Write asset_####.drgs")
        self._target = target if self.out else assets.unused(target, self._frames)
        for path in self._files():
            assets.check_unused(path)

    def _arguments(self) -> list[str]:
        """Arguments of the command ``drgs``."""
        surfels, mesh, light = (bpy.path.abspath(p) for p in (self.surfels, self.mesh, self.environment))
        if not surfels and not mesh:
            raise UsageError("Import", "neither surfels nor a mesh are given", "Choose at least one file")
        arguments = ["import", surfels] if surfels else ["make", mesh]
        self._frames = tuple(frames_of(surfels)) if "#" in Path(surfels).name else ()
        self._choose_target()
        if self._frames:
            arguments += ["--frames", ",".join(map(str, self._frames))]
        if surfels and mesh:
            arguments += ["--mesh", mesh]
        elif surfels and not self.use_mesh:
            arguments.append("--no-mesh")
        if light:
            arguments += ["--env", light]
        if surfels and self.use_remove_light:
            arguments.append("--remove-light")
        if self.pose != "rest" and not surfels:
            arguments += ["--pose", self.pose]
        if self.up != "auto":
            arguments.append(f"--up={self.up}")
        if self.scale != 1.0:
            arguments.append(f"--scale={self.scale:.9g}")
        return [*arguments, "--out", str(self._target)]


def kind_of(path: Path) -> str:
    """Kind of a file by its name and header: "surfels", "mesh" or "environment". The engine checks the rest."""
    suffix = path.suffix.lower()
    kinds = [t.kind for t in READ.values() if suffix in t.extensions]
    if suffix not in SPLATS:
        return kinds[0] if kinds and kinds[0] != "materials" else "mesh"
    try:
        with open(path, "rb") as file:
            head = file.read(HEADER)
    except OSError:
        return "mesh"
    if suffix == ".ply":
        head = head.partition(b"end_header")[0]
    return "surfels" if any(word in head for word in SPLATS[suffix]) else "mesh"


class DRGS_FH_parts(DropTarget, bpy.types.FileHandler):
    """Drop surfels, splats or textured meshes on the viewport."""

    bl_idname = "DRGS_FH_parts"
    bl_label = "Captured object (DR-GS)"
    bl_import_operator = "drgs.import_parts"
    bl_file_extensions = ";".join(DROPPED)


CLASSES = (DRGS_OT_import_parts, DRGS_FH_parts)
