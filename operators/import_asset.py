"""File > Import > DR-GS asset: an asset becomes a mesh object with material attributes."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, StringProperty

from ..addon import assets, blend_paths, mesh_arrays
from ..addon.viewport_material import viewport_material
from ..drgs_blender.core.asset import Asset, Environment
from ..drgs_blender.core.asset.container import read_asset
from .asset_materials import show_textures
from .base import DrgsOperator, DropTarget
from .mark_assets import mark


class DRGS_OT_import_asset(DrgsOperator, bpy.types.Operator):
    """Load .drgs assets as mesh objects that can be rigged, animated, painted and relit"""

    bl_idname = "import_scene.drgs"
    bl_label = "Import DR-GS"
    bl_options = {"REGISTER", "UNDO", "PRESET"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        description="The .drgs file to import", subtype="FILE_PATH", options={"SKIP_SAVE", *blend_paths.RELATIVE}
    )
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"})
    filter_glob: StringProperty(default="*.drgs", options={"HIDDEN"})
    use_environment: BoolProperty(
        name="Set World", description="Light the scene with the environment of the asset, if it has one", default=False
    )
    use_mark: BoolProperty(name="Mark as Asset", description="Offer the objects in the asset browser", default=False)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath or self.files:  # dropped on the window
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        paths = [Path(self.directory) / f.name for f in self.files if f.name] or [Path(self.chosen("Import"))]
        objects = import_assets(context, paths, self.use_environment)
        if self.use_mark:
            mark(objects)
        return {"FINISHED"}


def import_assets(
    context: bpy.types.Context, paths: list[Path], use_environment: bool = False
) -> list[bpy.types.Object]:
    """Add an object for every asset and select them; the last one is active. Return them.

    Raises
    ------
    AssetError
        A file is damaged, named in the message. Nothing has been added then.
    """
    into = assets.collection(context)
    loaded = [(path, read_asset(path)) for path in (Path(bpy.path.abspath(str(p))).absolute() for p in paths)]
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for selected in context.selected_objects:
        selected.select_set(False)
    objects = []
    for path, asset in loaded:
        obj = new_object(path, asset)
        objects.append(obj)
        into.objects.link(obj)
        obj.select_set(True)
        context.view_layer.objects.active = obj
        if use_environment and asset.environment is not None:
            context.scene.world = new_world(path.stem, asset.environment)
    return objects


def new_object(path: Path, asset: Asset) -> bpy.types.Object:
    """An object, in no collection yet, that shows and stands for the asset at `path`."""
    mesh = mesh_arrays.new_mesh(path.stem, asset.mesh)
    mesh.materials.append(viewport_material(asset.mesh.channels))
    if asset.mesh.textures is not None:
        show_textures(mesh, asset.mesh.textures)
    obj = bpy.data.objects.new(path.stem, mesh)
    obj.drgs.asset = assets.anchor(path)
    return obj


def new_world(name: str, environment: Environment) -> bpy.types.World:
    """A World that shines as `environment`; its image is packed into the .blend."""
    height, width = environment.radiance.shape[:2]
    image = bpy.data.images.new(f"{name} environment", width, height, float_buffer=True)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = environment.radiance[::-1]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    world = bpy.data.worlds.new(name)
    if world.node_tree is None:
        world.use_nodes = True
    nodes = world.node_tree.nodes
    background = next(n for n in nodes if n.type == "BACKGROUND")
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    texture.location = (background.location.x - 350, background.location.y)
    world.node_tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    return world


class DRGS_FH_asset(DropTarget, bpy.types.FileHandler):
    """Drop .drgs files on the viewport or the outliner."""

    bl_idname = "DRGS_FH_asset"
    bl_label = "DR-GS asset"
    bl_import_operator = "import_scene.drgs"
    bl_file_extensions = ".drgs"


CLASSES = (DRGS_OT_import_asset, DRGS_FH_asset)
