"""Save the edited shape: an asset whose shape at rest is that of the object's mesh, with surfels on new faces."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, StringProperty

from ..addon import assets, blend_paths, mesh_arrays, proxies, surfel_points
from ..addon.export.face_match import MOST, match_faces
from ..addon.viewport_material import update_viewport_material
from ..drgs_blender.core.asset import MATERIAL_CHANNELS, Asset, Mesh
from ..drgs_blender.core.errors import AssetError
from . import selection
from .engine_command import CommandOperator

Array = np.ndarray
SUFFIX = ".drgs"


class ReshapeOperator(CommandOperator, selection.ObjectMode):
    """Base of operators for which ``drgs reshape`` writes a new asset, by arrays of what Blender has."""

    filepath: StringProperty(
        name="File",
        description="The .drgs file to write",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    filter_glob: StringProperty(default="*.drgs", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})

    _object, _target = "", Path()

    def choose_file(self, context: bpy.types.Context, name: str) -> set[str]:
        """Ask for the file, by default `name` beside the .blend."""
        if not self.filepath:
            self.filepath = os.path.join(os.path.dirname(bpy.data.filepath), f"{name}{SUFFIX}")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def read_target(self) -> None:
        """Take over the chosen file. Raises UsageError without one."""
        self._target = Path(bpy.path.ensure_ext(bpy.path.abspath(self.chosen("Asset")), SUFFIX))

    def reshape(
        self, context: bpy.types.Context, source: Path, arrays: dict[str, Any], subject: str, said: tuple[str, str]
    ) -> set[str]:
        """Start ``drgs reshape`` of the asset `source`; `said` are status and failure of `start`."""
        with self.folder("drgs-reshape-") as folder:
            edit = folder / "edit.npz"
            np.savez(edit, **arrays)
            given = ["reshape", str(source), "--edit", str(edit), "--out", str(self._target)]
            return self.start(context, given, subject, *said, [self._target])


class DRGS_OT_save_shape(ReshapeOperator, bpy.types.Operator):
    """Write the active DR-GS object as a new .drgs asset with the shape of its mesh, as sculpted, cut and mended; new
    faces, such as filled holes, get surfels. The object uses the new file from then on"""

    bl_idname = "drgs.save_shape"
    bl_label = "Save Edited Shape"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self.choose_file(context, f"{bpy.path.clean_name(selection.selected(context)[-1].name)} shape")

    def run(self, context: bpy.types.Context) -> set[str]:
        self.read_target()
        (obj,) = selection.editable(selection.selected(context)[-1:], data=True)
        surfel_points.check_finished(obj)
        assets.check_unused(self._target)
        self._object = obj.name
        source = assets.file_of(obj)
        said = f"Saving {self._target.name}", "could not be saved"
        return self.reshape(context, source, edit_of(obj, assets.load(source)), f'Object "{obj.name}"', said)

    def done(self, context: bpy.types.Context) -> set[str]:
        obj = bpy.data.objects.get(self._object)
        if obj is None:
            return {"FINISHED"}
        rest = assets.load(self._target).mesh
        if obj.mode == "EDIT" or len(rest.vertices) != len(obj.data.vertices):
            self.warn(
                f'"{obj.name}" was edited meanwhile: it keeps its file; {self._target.name} has the shape of before'
            )
            return {"FINISHED"}
        rows = mesh_arrays.source_rows(obj.data, assets.load(assets.file_of(obj)).mesh)
        new = np.zeros(len(rest.vertices), bool) if rows is None else rows < 0
        selection.own_mesh(obj)
        obj.drgs.asset = assets.anchor(self._target)
        obj.drgs.surfel_points = None
        mesh_arrays.write_source_vertices(obj.data, rest)
        give_channels(obj.data, rest, new)
        update_viewport_material(obj.data)
        obj.update_tag()
        self.report({"INFO"}, f"Saved {self._target}")
        return {"FINISHED"}


def edit_of(obj: bpy.types.Object, asset: Asset) -> dict[str, Array]:
    """Arrays of `drgs reshape` of the mesh of an object with that asset, without modifiers.

    Raises
    ------
    AssetError
        Its vertices are not known; names the object.
    """
    mesh, rest = obj.data, asset.mesh
    rows = mesh_arrays.source_rows(mesh, rest)
    if proxies.is_proxy(mesh, asset):
        problem = "has a proxy in place of a mesh, which is no shape of its surfels"
        raise AssetError(f'Object "{obj.name}"', problem, "Choose Save Edited Asset, or export it as splats")
    if rows is None:
        raise AssetError(
            f'Object "{obj.name}"', f"its mesh has {len(mesh.vertices)} vertices, the asset {len(rest.vertices)}",
            "Undo the edit, or import the asset again",
        )  # fmt: skip
    matched = match_faces(mesh, rows, rest.faces)
    corner_vertices = mesh_arrays.read_corner_vertices(mesh)
    corners, polygon = mesh_arrays.read_loop_triangles(mesh)
    start, total = mesh_arrays.read_polygons(mesh)
    of_asset = np.zeros(len(mesh.polygons), bool)
    of_asset[np.searchsorted(start, matched.corners.min(axis=1), side="right") - 1] = True
    of_asset = of_asset[polygon]
    large = np.flatnonzero((total > MOST)[polygon])  # these may be the asset's in part
    if len(large):
        matches = set(map(frozenset, matched.corners.tolist()))
        of_asset[large] = [frozenset(triangle) in matches for triangle in corners[large].tolist()]
    new = corner_vertices[corners[~of_asset]]
    found = {
        "vertices": np.array(mesh_arrays.read_vertices(mesh)),
        "source": rows,
        "faces": np.concatenate([corner_vertices[matched.corners], new]).astype(np.int32),
        "face": np.concatenate([matched.face, np.full(len(new), -1)]).astype(np.int32),
    }
    removed = surfel_points.removed_of(obj, asset)
    return found if removed is None else {**found, "removed": removed}


def give_channels(mesh: bpy.types.Mesh, rest: Mesh, new: Array) -> None:
    """Give the `new` vertices, (n,) bool, of a mesh the materials of its asset; those of others stay as painted."""
    for channel in MATERIAL_CHANNELS:
        own = getattr(rest, channel)
        if own is None or channel not in mesh.attributes:
            continue
        try:
            values = mesh_arrays.read_channel(mesh, channel)
        except TypeError:  # of another kind, which the render does not heed either
            continue
        assert values is not None
        values[new] = own[new]
        if mesh.attributes[channel].data_type in mesh_arrays.COLOURS and values.ndim == 1:
            continue  # painted as grey: what is new stays black until it is painted
        mesh_arrays.write_channel(mesh, channel, values)


CLASSES = (DRGS_OT_save_shape,)
