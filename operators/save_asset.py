"""Save the edited object as a new .drgs file: what is painted and adjusted becomes what is captured."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, StringProperty

from ..addon import assets, blend_paths, mesh_arrays, messages, surfel_points
from ..addon.export.objects import appearance_of
from ..addon.export.painted_images import with_painted_images
from ..addon.export.topology_check import check_topology
from ..addon.viewport_material import update_viewport_material
from ..drgs_blender.core.asset.container import write_asset
from ..drgs_blender.core.errors import UsageError
from ..drgs_blender.core.material_adjustments import edited_asset
from ..drgs_blender.core.repainted_textures import carried_paint
from ..drgs_blender.core.texture_adjustments import edited_textures
from . import selection
from .base import DrgsOperator

SUFFIX = ".drgs"


class DRGS_OT_save_asset(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Write the selected DR-GS objects with their painted and adjusted materials as new .drgs assets"""

    bl_idname = "drgs.save_asset"
    bl_label = "Save Edited Asset"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        name="File",
        description="The .drgs file to write; of several objects, each gets one of its own name beside it",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    filter_glob: StringProperty(default="*.drgs", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    use_saved: BoolProperty(
        name="Link Objects to New File",
        description="The objects use the new files from now on; their adjustments, which are in these, are reset",
        default=False,
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.filepath:
            name = bpy.path.clean_name(selection.selected(context)[-1].name)
            self.filepath = os.path.join(os.path.dirname(bpy.data.filepath), f"{name} edited{SUFFIX}")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        if not self.filepath:
            raise UsageError("Asset", "has no file to go to", "Choose one")
        path = Path(bpy.path.ensure_ext(bpy.path.abspath(self.filepath), SUFFIX))
        objects = selection.editable(selection.selected(context), vertices=False)
        for obj in objects if self.use_saved else ():
            surfel_points.check_finished(obj)
        paths = [path] if len(objects) == 1 else [path.with_name(bpy.path.clean_name(o.name) + SUFFIX) for o in objects]
        if len(set(paths)) < len(paths):
            raise UsageError("Objects", "have names that make the same file name", "Rename one")
        for target in paths:
            assets.check_unused(target)
            if len(objects) > 1 and os.path.exists(target):  # the file browser asked for another name
                raise UsageError(str(target), "is there already", "Choose another folder, or save the objects singly")
        for obj, target in zip(objects, paths):
            if lost := save(obj, target, context.evaluated_depsgraph_get()):
                problem = f'"{obj.name}": textures of {lost} faces cannot say its adjustments'
                self.warn(f"{problem}; the file has the adjusted materials of their vertices")
        if self.use_saved:
            for obj, target in zip(selection.editable(objects, vertices=False, data=True), paths):
                rows = rows_in_part(obj, context.evaluated_depsgraph_get())
                selection.own_mesh(obj)
                obj.drgs.asset = assets.anchor(target)
                obj.drgs.adjustment.reset()
                obj.drgs.surfel_points = None
                if rows is not None:
                    mesh_arrays.write_source_vertices(obj.data, assets.load(target).mesh, rows)
                mesh_arrays.restore_channels(obj.data, assets.captured_mesh(obj))
                update_viewport_material(obj.data)
        self.report({"INFO"}, f"Saved {', '.join(map(str, paths))}")
        return {"FINISHED"}


def save(obj: bpy.types.Object, path: Path, depsgraph: bpy.types.Depsgraph) -> int:
    """Write `obj` as `depsgraph` evaluates it to `path`; pose and shape are not part of it.

    Returns how many faces lost images to adjustments, see `texture_adjustments.edited_textures`.

    Raises
    ------
    AssetError
        The mesh is not the asset's; names the object.
    UsageError
        Nothing of it is left; names the object.
    WriteError
        The file cannot be written.
    """
    source = assets.file_of(obj)
    asset = assets.load(source)
    told = messages.Warnings()
    asset, _, painted, adjustment, _ = appearance_of(obj.evaluated_get(depsgraph), asset, told)
    repainted = with_painted_images(obj, asset, told)
    painted, asset = carried_paint(asset.mesh, repainted.mesh, painted), repainted
    if not len(asset.surfels) and not len(asset.mesh.faces):
        raise UsageError(f'Object "{obj.name}"', "has nothing left of its asset", "Undo the edit, or show some of it")
    edited = edited_asset(asset, painted, adjustment)
    write_asset(path, replace(edited, provenance={**asset.provenance, "edited_from": source.name}))
    textures = asset.mesh.textures
    return 0 if textures is None else edited_textures(asset.mesh, textures, painted, adjustment)[1]


def rows_in_part(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray | None:
    """(n,) int32 number of each vertex of the mesh of `obj` in what `save` writes, -1 of none; None where all is."""
    rest, evaluated = assets.load(assets.file_of(obj)).mesh, obj.evaluated_get(depsgraph)
    part = check_topology(evaluated, evaluated.data, rest, messages.Warnings()).part
    if part is None:
        return None
    rows = mesh_arrays.source_rows(obj.data, rest)
    assert rows is not None, "the evaluated mesh knows them"
    if len(evaluated.data.vertices) == len(rows):
        return np.where(rows >= 0, np.cumsum(rows >= 0) - 1, -1).astype(np.int32)
    number = np.full(len(rest.vertices) + 1, -1, np.int32)  # modifiers leave vertices out: the first copy of each
    number[part.vertices[::-1]] = np.arange(len(part.vertices), dtype=np.int32)[::-1]
    return number[rows]


CLASSES = (DRGS_OT_save_asset,)
