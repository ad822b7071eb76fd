"""Clean a capture: its surfels as points to select and delete, floaters found by themselves, a box to crop to."""

from __future__ import annotations

from itertools import compress

import bmesh
import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty

from ..addon import assets, mesh_arrays, proxies, surfel_points
from ..addon.export.face_match import match_faces
from ..addon.viewport.surfels import evaluated_vertices, places_of
from ..drgs_blender.core.asset import Asset
from ..drgs_blender.core.asset.part import taken
from ..drgs_blender.core.bare_faces import bare_faces
from ..drgs_blender.core.errors import AssetError, UsageError
from ..drgs_blender.core.floaters import distance_from_mesh, find_floaters, median_size
from . import selection
from .base import DrgsOperator

Array = np.ndarray


class DRGS_OT_edit_surfels(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Show the surfels of the active DR-GS object as points in Edit Mode: select them by box, lasso or circle, delete
    them with X, then press Finish"""

    bl_idname = "drgs.edit_surfels"
    bl_label = "Edit Surfels"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        (obj,) = selection.editable(selection.selected(context)[-1:], vertices=False)
        known = obj.drgs.surfel_points
        for earlier in surfel_points.objects_of(obj):
            if earlier.data == known:  # not finished: its mesh says what was deleted
                bpy.data.objects.remove(earlier)
        mesh = points_of(obj, context.evaluated_depsgraph_get())
        points = bpy.data.objects.new(mesh.name, mesh)
        points.drgs.points_of = obj
        points.matrix_world = obj.matrix_world
        points.show_in_front = context.scene.drgs.overlay == "OFF"
        points.hide_render = True
        assets.collection(context).objects.link(points)
        selection.select_only(context, [points], points)
        bpy.ops.object.mode_set(mode="EDIT")
        context.tool_settings.mesh_select_mode = True, False, False
        bpy.ops.mesh.select_all(action="DESELECT")
        return {"FINISHED"}


class DRGS_OT_select_surfels(DrgsOperator, bpy.types.Operator):
    """Select the surfels that are floaters, faint, large, of the colour of the selected ones, or far from the mesh"""

    bl_idname = "drgs.select_surfels"
    bl_label = "Select Surfels"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    criterion: EnumProperty(
        name="By",
        description="Which surfels are selected",
        items=(
            ("FLOATERS", "Floaters", "Small parts in the air, and faint, wide or distant surfels that stand alone"),
            ("OPACITY", "Opacity", "Those that are fainter"),
            ("SIZE", "Size", "Those that are larger than a multiple of the median"),
            ("COLOUR", "Colour", "Those with nearly the mean colour of the selected ones"),
            ("DISTANCE", "Distance", "Those that are farther from the mesh than a multiple of the median size"),
        ),
        default="FLOATERS",
    )
    strength: FloatProperty(name="Strength", description="More finds more floaters", min=0.1, max=10.0, default=1.0)
    opacity: FloatProperty(name="Opacity", description="Select what is fainter", min=0.0, max=1.0, default=0.1)
    size: FloatProperty(name="Size", description="Select what is larger, in medians", min=0.0, max=1000.0, default=5.0)
    tolerance: FloatProperty(
        name="Tolerance", description="Distance of colours, as displayed, that still are alike", min=0.0, max=2.0,
        default=0.1,
    )  # fmt: skip
    distance: FloatProperty(
        name="Distance", description="Select what is farther from the mesh, in medians of the size", min=0.0,
        max=1000.0, default=3.0,
    )  # fmt: skip
    use_extend: BoolProperty(name="Extend", description="Keep what is selected already", default=False)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Press Edit Surfels first")
        return context.mode == "EDIT_MESH" and edited(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.prop(self, "criterion")
        of = {"FLOATERS": "strength", "OPACITY": "opacity", "SIZE": "size", "COLOUR": "tolerance"}
        column.prop(self, of.get(self.criterion, "distance"))
        column.prop(self, "use_extend")

    def run(self, context: bpy.types.Context) -> set[str]:
        pair = edited(context)
        assert pair is not None, "poll has looked"
        points, obj = pair
        asset = assets.load(assets.file_of(obj))
        points.update_from_editmode()
        rows, before = surfel_points.read_points(points)
        if rows.max(initial=-1) >= len(asset.surfels):
            raise UsageError(f'Object "{points.name}"', f'has no points of surfels of "{obj.name}"', "Undo the edit")
        own = rows >= 0
        found = np.zeros(len(rows), bool)
        found[own] = self.chosen_of(asset, rows[own], before[own])
        count = int(found.sum())
        if self.use_extend:
            found |= before
        mesh = bmesh.from_edit_mesh(points.data)
        mesh.verts.ensure_lookup_table()
        for number in np.flatnonzero(found != before).tolist():
            mesh.verts[number].select = not before[number]
        mesh.select_flush_mode()
        bmesh.update_edit_mesh(points.data, loop_triangles=False, destructive=False)
        self.report({"INFO"}, f"{count:,} of {len(rows):,} surfels")
        return {"FINISHED"}

    def chosen_of(self, asset: Asset, rows: Array, before: Array) -> Array:
        """(n,) bool of the surfels `rows`, of which `before` says what is selected."""
        surfels = asset.surfels
        typical = median_size(surfels)
        if self.criterion == "OPACITY":
            return (surfels.opacity < self.opacity)[rows]
        if self.criterion == "SIZE":
            return (surfels.scale.max(axis=1) > self.size * typical)[rows]
        if self.criterion == "COLOUR":
            if not before.any():
                raise UsageError("Selection", "holds no surfel whose colour is meant", "Select one or several")
            shown = surfels.albedo.clip(0, 1)[rows] ** (1 / 2.2)
            return np.linalg.norm(shown - shown[before].mean(axis=0), axis=1) <= self.tolerance
        away = distance_from_mesh(asset)
        if self.criterion == "DISTANCE":
            return np.zeros(len(rows), bool) if away is None else (away > self.distance * typical)[rows]
        left = np.unique(rows)
        if len(left) == len(surfels):
            return find_floaters(surfels, away, self.strength)[rows]
        found = np.zeros(len(surfels), bool)
        found[left] = find_floaters(taken(surfels, left), None if away is None else away[left], self.strength)
        return found[rows]


class _Removing(DrgsOperator):
    """Removes surfels."""

    def tell_proxy(self, obj: bpy.types.Object, asset: Asset) -> None:
        """A proxy, which may be rigged, is not cut."""
        if proxies.is_proxy(obj.data, asset):
            self.warn(
                f'"{obj.name}": its proxy still encloses the surfels that are removed, and physics fills all of it. To '
                "have another, delete its vertices in Edit Mode, then choose Add Proxy Mesh"
            )


class DRGS_OT_finish_surfels(_Removing, bpy.types.Operator):
    """End the editing of surfels: those that were deleted are not rendered any more, and faces that only they covered
    go, too"""

    bl_idname = "drgs.finish_surfels"
    bl_label = "Finish"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    use_faces: BoolProperty(
        name="Delete Their Faces",
        description="Also delete the faces that deleted surfels alone covered, so that they throw no shadow",
        default=True,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Press Edit Surfels first")
        return context.mode in ("EDIT_MESH", "OBJECT") and bool(_unfinished(context))

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = _unfinished(context)
        for obj in objects:
            if obj.name not in context.view_layer.objects:
                raise UsageError(
                    f'Object "{obj.name}"', "is in no collection of this view layer",
                    "Undo what removed it, or show that",
                )  # fmt: skip
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        for obj, points in objects.items():
            self.finish(obj, obj.drgs.surfel_points if points is None else points.data)
        selection.select_only(context, objects, list(objects)[-1])
        return {"FINISHED"}

    def finish(self, obj: bpy.types.Object, mesh: bpy.types.Mesh) -> None:
        """The surfels of an object are those in a mesh of points."""
        asset, replaced = assets.load(assets.file_of(obj)), obj.drgs.surfel_points
        obj.drgs.surfel_points = mesh
        try:
            removed = surfel_points.removed_of(obj, asset)
        except AssetError:
            obj.drgs.surfel_points = replaced
            raise
        before = np.array(mesh.get(surfel_points.SURFEL, ()), np.int64)
        before = before[before < len(asset.surfels)]
        for points in surfel_points.objects_of(obj):
            if points.data == mesh:
                bpy.data.objects.remove(points)
        _give_back(mesh, obj, before, len(asset.surfels))
        if surfel_points.SURFEL in mesh:
            del mesh[surfel_points.SURFEL]
        if replaced not in (None, mesh) and not replaced.users:
            bpy.data.meshes.remove(replaced)
        if copies := surfel_points.objects_of(obj):
            names = ", ".join(f'"{points.name}"' for points in copies)
            self.warn(f'"{obj.name}": other points of its surfels are left: {names}. Delete them, or Finish takes them')
        rows = surfel_points.rows_of(mesh)
        assert rows is not None, "removed_of has read them"
        if foreign := int(np.count_nonzero(rows < 0)):
            self.warn(f'"{obj.name}": {foreign:,} of the points are none of its surfels; they are left out')
        if removed is None:
            obj.drgs.surfel_points = None
        elif len(new := np.setdiff1d(removed, before)):
            self.tell_proxy(obj, asset)
            if self.use_faces and len(obj.data.polygons):
                delete_vertices_or_faces(obj, faces=faces_of(obj, asset, new))
        obj.update_tag()
        gone = 0 if removed is None else len(removed)
        self.report({"INFO"}, f"{gone:,} of {len(asset.surfels):,} surfels are removed")


class DRGS_OT_restore_surfels(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Bring back all surfels that were deleted from the selected DR-GS objects; faces come back by Undo alone"""

    bl_idname = "drgs.restore_surfels"
    bl_label = "Restore Surfels"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        for obj in selection.editable(selection.selected(context), vertices=False):
            for points in surfel_points.objects_of(obj):
                if points.data == obj.drgs.surfel_points:
                    bpy.data.objects.remove(points)
            obj.drgs.surfel_points = None
            obj.update_tag()
        return {"FINISHED"}


class DRGS_OT_crop(_Removing, selection.ObjectMode, bpy.types.Operator):
    """Delete what of the selected DR-GS objects lies outside the box around another selected object"""

    bl_idname = "drgs.crop"
    bl_label = "Crop to Box"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    use_inside: BoolProperty(name="Delete Inside", description="Delete what lies in the box instead", default=False)

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context), vertices=False, data=True)
        boxes = [o for o in context.selected_objects if not assets.is_drgs(o) and o.type in ("MESH", "EMPTY")]
        if len(boxes) != 1:
            raise UsageError(
                "Selection", f"holds {len(boxes)} objects that could be the box",
                "Select the DR-GS objects and one cube, or one empty",
            )  # fmt: skip
        for obj in objects:
            surfel_points.check_finished(obj)
        depsgraph = context.evaluated_depsgraph_get()
        for obj in objects:
            asset = assets.load(assets.file_of(obj))
            vertices = evaluated_vertices(obj, depsgraph)
            gone = in_box(boxes[0], obj, vertices) == self.use_inside
            mesh = points_of(obj, depsgraph)
            rows, places = surfel_points.rows_of(mesh), np.empty((len(mesh.vertices), 3), np.float32)
            assert rows is not None
            mesh.vertices.foreach_get("co", places.ravel())
            left = in_box(boxes[0], obj, places) != self.use_inside
            if not left.any():
                raise UsageError(f'Object "{obj.name}"', "would be gone as a whole", "Move the box, or delete it")
            obj.drgs.surfel_points = None
            bpy.data.meshes.remove(mesh)
            if not (left.all() and len(rows) == len(asset.surfels)):
                obj.drgs.surfel_points = surfel_points.new_points(f"{obj.name} surfels", rows[left], places[left])
            if not left.all():
                self.tell_proxy(obj, asset)
            if gone.any() and len(gone) == len(obj.data.vertices) and len(asset.mesh.vertices):
                delete_vertices_or_faces(obj, vertices=gone)
            obj.update_tag()
        return {"FINISHED"}


def edited(context: bpy.types.Context) -> tuple[bpy.types.Object, bpy.types.Object] | None:
    """The points that are edited, and the DR-GS object whose surfels they are."""
    points = context.active_object
    obj = None if points is None else points.drgs.points_of
    return None if points is None or not assets.is_drgs(obj) else (points, obj)


def _unfinished(context: bpy.types.Context) -> dict[bpy.types.Object, bpy.types.Object | None]:
    """DR-GS objects -> the points by which their surfels are edited; of those that are edited, active or selected."""
    edited_now = context.objects_in_mode if context.mode == "EDIT_MESH" else ()
    chosen = [*(context.selected_objects or ()), *edited_now, context.active_object]
    found = {o: None for o in chosen if assets.is_drgs(o) and surfel_points.is_unfinished(o)}
    return found | {o.drgs.points_of: o for o in chosen if o is not None and assets.is_drgs(o.drgs.points_of)}


def _give_back(mesh: bpy.types.Mesh, owner: bpy.types.Object, removed: Array, count: int) -> None:
    """Give copies of an object, made while its surfels were edited, points of their own: without those `removed`."""
    for obj in [o for o in bpy.data.objects if o.drgs.surfel_points == mesh and o != owner]:
        left = np.delete(np.arange(count, dtype=np.int32), removed)
        places = np.array(assets.load(assets.file_of(obj)).surfels.centre[left])
        none = len(left) == count
        obj.drgs.surfel_points = None if none else surfel_points.new_points(f"{obj.name} surfels", left, places)


def points_of(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bpy.types.Mesh:
    """The mesh of points of an object's surfels, made anew, placed as the object is posed, to be edited.

    It keeps which surfels were removed before, until the editing is finished.
    """
    asset, known = assets.load(assets.file_of(obj)), obj.drgs.surfel_points
    unfinished = surfel_points.is_unfinished(obj)
    rows, places = places_of(obj, depsgraph)
    obj.drgs.surfel_points = mesh = surfel_points.new_points(f"{obj.name} surfels", rows, places)
    removed = surfel_points.lacking(rows, len(asset.surfels))
    before = known[surfel_points.SURFEL] if known is not None and unfinished else removed
    mesh[surfel_points.SURFEL] = before.tolist() if isinstance(before, np.ndarray) else list(before)
    if known is not None and not known.users:
        bpy.data.meshes.remove(known)
    return mesh


def in_box(box: bpy.types.Object, obj: bpy.types.Object, places: Array) -> Array:
    """(n,) bool: which (n, 3) places of `obj` lie in the box around `box`, turned as it is."""
    if box.type == "EMPTY":
        low, high = -box.empty_display_size * np.ones(3), box.empty_display_size * np.ones(3)
    else:
        corners = np.array(box.bound_box)
        low, high = corners.min(axis=0), corners.max(axis=0)
    world = selection.in_world(obj, places)
    inverse = np.array(box.matrix_world.inverted_safe(), np.float64)
    local = world @ inverse[:3, :3].T + inverse[:3, 3]
    return ((local >= low) & (local <= high)).all(axis=1)


def faces_of(obj: bpy.types.Object, asset: Asset, removed: Array) -> Array:
    """(p,) bool polygons of the mesh that only the surfels `removed` covered, see `bare_faces`."""
    found = np.zeros(len(obj.data.polygons), bool)
    rows = mesh_arrays.source_rows(obj.data, asset.mesh)
    if rows is None or not (bare := bare_faces(asset, removed)).any():
        return found
    triangles = mesh_arrays.read_triangles(obj.data)
    if triangles is not None and np.array_equal(rows[triangles], asset.mesh.faces):
        return bare
    matched = match_faces(obj.data, rows, asset.mesh.faces)
    start, _ = mesh_arrays.read_polygons(obj.data)
    polygon = np.searchsorted(start, matched.corners.min(axis=1), side="right") - 1
    found[polygon] = True
    found[polygon[~bare[matched.face]]] = False
    return found


def delete_vertices_or_faces(obj: bpy.types.Object, vertices: Array | None = None, faces: Array | None = None) -> None:
    """Delete vertices, (n,) bool, or faces, (p,) bool, of the mesh of an object, with vertices that lose all faces.

    Objects that share the mesh keep it.
    """
    selection.own_mesh(obj)
    mesh = bmesh.new()
    mesh.from_mesh(obj.data)
    if vertices is not None:
        bmesh.ops.delete(mesh, geom=list(compress(mesh.verts, vertices.tolist())), context="VERTS")
    if faces is not None:
        bmesh.ops.delete(mesh, geom=list(compress(mesh.faces, faces.tolist())), context="FACES")
    mesh.to_mesh(obj.data)
    mesh.free()
    obj.data.update()


CLASSES = (DRGS_OT_edit_surfels, DRGS_OT_select_surfels, DRGS_OT_finish_surfels, DRGS_OT_restore_surfels, DRGS_OT_crop)
