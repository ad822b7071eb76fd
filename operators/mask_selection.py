"""A mask of what is selected: vertices of a DR-GS object, or its surfels as points."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import StringProperty

from ..addon import assets, mesh_arrays, surfel_points
from ..drgs_blender.core.asset import Asset
from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator

Array = np.ndarray

#: Weights that the group of a selection of surfels has between 0 and 1.
_LEVELS = 64


class DRGS_OT_mask_selection(DrgsOperator, bpy.types.Operator):
    """Limit the adjustments of the DR-GS object (colour, opacity, roughness ...) to its selected vertices, or to the
    surfels that are selected as points: they become a vertex group, which is its mask"""

    bl_idname = "drgs.mask_selection"
    bl_label = "Mask from Selection"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    name: StringProperty(
        name="Vertex Group", description="Group that has the selection; one of that name is replaced",
        default="Selection",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Select vertices of a DR-GS object in Edit Mode, or surfels by Edit Surfels")
        obj = context.active_object
        shown = obj is not None and (assets.is_drgs(obj) or assets.is_drgs(obj.drgs.points_of))
        return shown and context.mode in ("EDIT_MESH", "OBJECT")

    def run(self, context: bpy.types.Context) -> set[str]:
        active = context.active_object
        of_points = not assets.is_drgs(active)
        (obj,) = selection.editable([active.drgs.points_of if of_points else active], data=True)
        if not self.name:
            raise UsageError("Vertex Group", "has no name", "Give it one")
        if active.mode == "EDIT":
            active.update_from_editmode()
        weights = _of_surfels(active, obj) if of_points else surfel_points.read_selection(obj.data).astype(np.float32)
        if not weights.any():
            raise UsageError(
                f'Object "{active.name}"', "has nothing selected", "Select vertices or points in Edit Mode"
            )
        editing = obj.mode == "EDIT"
        if editing:  # Blender adds no weights meanwhile
            bpy.ops.object.mode_set(mode="OBJECT")
        if (old := obj.vertex_groups.get(self.name)) is not None:
            obj.vertex_groups.remove(old)
        group = obj.vertex_groups.new(name=self.name)
        levels = np.rint(weights * _LEVELS).astype(int)
        for level in np.unique(levels[levels > 0]).tolist():
            group.add(np.flatnonzero(levels == level).tolist(), level / _LEVELS, "REPLACE")
        if editing:
            bpy.ops.object.mode_set(mode="EDIT")
        obj.drgs.adjustment.mask, obj.drgs.adjustment.use_invert = group.name, False
        obj.update_tag()
        others = [o for o in bpy.data.objects if o.data == obj.data and o != obj]  # weights are of the mesh
        if names := [f'"{o.name}"' for o in others if o.drgs.adjustment.mask == group.name]:
            self.warn(f'{", ".join(names)} have the same mesh and mask "{group.name}": it changes there, too')
        self.report({"INFO"}, f'Adjustments of "{obj.name}" count at {int((levels > 0).sum()):,} vertices')
        return {"FINISHED"}


def _of_surfels(points: bpy.types.Object, obj: bpy.types.Object) -> Array:
    """(n,) float32 weights of the vertices of an object, by the surfels that are selected as points."""
    asset = assets.load(assets.file_of(obj))
    rows, selected = surfel_points.read_points(points)
    source = mesh_arrays.source_rows(obj.data, asset.mesh)
    if asset.binding is None or source is None:
        raise UsageError(f'Object "{obj.name}"', "has surfels that are bound to no vertices", "Import it with a mesh")
    own = (rows >= 0) & (rows < len(asset.surfels))
    return np.where(source >= 0, vertex_shares(asset, rows[own & selected], rows[own])[source], 0)


def vertex_shares(asset: Asset, chosen: Array, left: Array) -> Array:
    """(n,) float32: the part of the surfels around each vertex of an asset that are chosen.

    A vertex on whose faces none hangs has the mean of its neighbours.

    Parameters
    ----------
    asset : Asset
    chosen, left : (k,) int array
        Surfels; those that were removed are not `left`, and count nowhere.
    """
    mesh, binding = asset.mesh, asset.binding
    assert binding is not None
    corner = mesh.faces[binding.face].reshape(-1)
    weight = binding.barycentric.clip(0, 1).astype(np.float64)
    weight *= np.isin(np.arange(len(weight)), left)[:, None]
    of_chosen = np.zeros(len(asset.surfels), bool)
    of_chosen[chosen] = True
    total = np.bincount(corner, weight.reshape(-1), len(mesh.vertices))
    share = np.bincount(corner, (weight * of_chosen[:, None]).reshape(-1), len(mesh.vertices))
    known = total > 1e-6
    share = np.where(known, share / np.maximum(total, 1e-6), 0)
    ends = np.concatenate([mesh.faces[:, (a, b)] for a, b in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))])
    while True:
        reached = ends[known[ends[:, 0]] & ~known[ends[:, 1]]]
        if not len(reached):
            return share.astype(np.float32)
        count = np.bincount(reached[:, 1], minlength=len(known))
        new = count > 0
        share[new] = np.bincount(reached[:, 1], share[reached[:, 0]], len(known))[new] / count[new]
        known |= new


CLASSES = (DRGS_OT_mask_selection,)
