"""Swap the mesh: a retopologised one, with its rig, takes the surfels and the materials of a DR-GS object."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty

from ..addon import assets, mesh_arrays, surfel_points
from ..addon.export.painted_images import painted_images
from ..addon.export.topology_check import REMODELLING
from ..addon.viewport_material import viewport_material
from ..drgs_blender.core.asset import MATERIAL_CHANNELS, Asset, Mesh
from ..drgs_blender.core.asset.part import vertices_of
from ..drgs_blender.core.errors import UsageError
from . import selection
from .save_shape import ReshapeOperator, edit_of

Array = np.ndarray


class DRGS_OT_swap_mesh(ReshapeOperator, bpy.types.Operator):
    """Select a new mesh at the same place, such as a retopology, then the DR-GS object: the new mesh becomes the DR-GS
    object, with the same surfels and materials, in a new .drgs file. It keeps its rig, weights and shape keys"""

    bl_idname = "drgs.swap_mesh"
    bl_label = "Swap Mesh"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    use_original: BoolProperty(name="Keep Original", description="Leave the old object visible", default=False)

    _other = ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            _, other = chosen(context)
        except UsageError as error:
            return self.fail(error)
        return self.choose_file(context, bpy.path.clean_name(other.name))

    def run(self, context: bpy.types.Context) -> set[str]:
        obj, other = chosen(context)
        self.read_target()
        assets.check_unused(self._target)
        surfel_points.check_finished(obj)
        check_new(other)
        self._object, self._other = obj.name, other.name
        source = assets.file_of(obj)
        check_images(obj, assets.load(source), self.warn)
        said = f"Binding to {other.name}", "could not be bound to it"
        return self.reshape(context, source, swap_of(obj, assets.load(source), other), f'Object "{other.name}"', said)

    def done(self, context: bpy.types.Context) -> set[str]:
        obj, other = bpy.data.objects.get(self._object), bpy.data.objects.get(self._other)
        if obj is None or other is None:
            return {"FINISHED"}
        rest = assets.load(self._target).mesh
        if other.mode == "EDIT" or not np.array_equal(mesh_arrays.loop_triangles(other.data), rest.faces):
            self.warn(
                f'"{other.name}" was edited meanwhile: it stays as it is; {self._target.name} has the mesh of before'
            )
            return {"FINISHED"}
        selection.own_mesh(other)
        make_drgs(other, obj, self._target, rest)
        if obj.animation_data is not None and obj.animation_data.action is not None:
            self.warn(f'"{other.name}" moves by its own rig: keyframes of "{obj.name}" itself are not taken over')
        mask = other.drgs.adjustment.mask
        if mask and mesh_arrays.read_mask(other, other.data, mask) is None:
            problem = f'adjustments want the mask "{mask}", which "{other.name}" lacks: they count nowhere'
            self.warn(f"{problem}. Transfer it (Data Transfer), or choose another")
        if not self.use_original:
            obj.hide_set(True)
            obj.hide_render = True
        selection.select_only(context, [other], other)
        self.report({"INFO"}, f'"{other.name}" has the surfels of "{obj.name}", in {self._target}')
        return {"FINISHED"}


def chosen(context: bpy.types.Context) -> tuple[bpy.types.Object, bpy.types.Object]:
    """The active DR-GS object, and the other mesh that is selected. Raises UsageError."""
    obj = context.active_object
    others = [o for o in context.selected_objects if o != obj and o.type == "MESH"]
    if not assets.is_drgs(obj) or len(others) != 1:
        raise UsageError(
            "Selection", "is not one new mesh and, active, the DR-GS object whose surfels it gets",
            "Select the new mesh, then, with Shift, the DR-GS object",
        )  # fmt: skip
    selection.editable(others, vertices=False, data=True)
    return obj, others[0]


def check_images(obj: bpy.types.Object, asset: Asset, warn: Callable[[str], None]) -> None:
    """UsageError where images of an object are painted, which are not in its file; names both."""
    names = ", ".join(image.name for image in painted_images(obj, asset, warn))
    if names and not obj.drgs.show_captured:
        raise UsageError(
            f'Object "{obj.name}"', f"has images that are painted and not in its file ({names})",
            "Choose Save Edited Asset, with Link Objects to New File, or Show as Captured",
        )  # fmt: skip


def check_new(other: bpy.types.Object) -> None:
    """UsageError where an object has no faces, or a modifier makes others of them; names it."""
    if not len(other.data.polygons):
        raise UsageError(f'Object "{other.name}"', "has no faces", "Choose a mesh with a surface")
    for modifier in other.modifiers:
        if modifier.type in REMODELLING and (modifier.show_render or modifier.show_viewport):
            raise UsageError(
                f'Object "{other.name}"', f'has the modifier "{modifier.name}", which makes other faces',
                "Apply it, or disable it for viewports and renders",
            )  # fmt: skip


def swap_of(obj: bpy.types.Object, asset: Asset, other: bpy.types.Object) -> dict[str, Array]:
    """Arrays of `drgs reshape`: what an object has of its asset, edited and painted, and the mesh of the other one.

    Raises
    ------
    UsageError
        One is mirrored or flattened by its scale; names it.
    """
    matrix = np.array(other.matrix_world.inverted_safe() @ obj.matrix_world, np.float64)
    for each in (obj, other):
        selection.check_size(each)
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise UsageError(
            f'Object "{other.name}"', f'is mirrored by its scale, or "{obj.name}" is', "Apply their scale (Ctrl A)"
        )
    near = np.abs(matrix - np.eye(4)).max() < 1e-6
    faces = np.ascontiguousarray(mesh_arrays.loop_triangles(other.data))
    found = {"matrix": np.eye(4) if near else matrix, "mesh_faces": faces}
    found["mesh_vertices"] = np.array(mesh_arrays.read_vertices(other.data))
    if asset.binding is None:
        return found
    edit = edit_of(obj, asset)
    return found | edit | painted_of(obj.data, asset.mesh, edit["source"])


def painted_of(mesh: bpy.types.Mesh, rest: Mesh, rows: Array) -> dict[str, Array]:
    """Channels of a mesh that differ from its asset's; new vertices, of which `rows` are -1, as they are painted."""
    own, found = vertices_of(rest, rows.clip(0)), {}
    for channel in MATERIAL_CHANNELS:
        try:
            values = mesh_arrays.read_channel(mesh, channel)
        except TypeError:  # of another kind, which the render does not heed either
            continue
        if values is None:
            continue
        before = own.channel(channel)
        values = np.where(np.isnan(values), before, values)
        if not np.array_equal(values[rows >= 0], before[rows >= 0]):
            found[channel] = values.astype(np.float32)
    return found


def make_drgs(other: bpy.types.Object, obj: bpy.types.Object, path: Path, rest: Mesh) -> None:
    """Make an object, with a mesh of its own, the DR-GS object of the asset at `path`, as `obj` is one."""
    mesh, settings = other.data, other.drgs
    mesh_arrays.restore_channels(mesh, rest)
    for group, members in rest.groups.items():
        if group not in mesh.attributes:
            mesh_arrays.write_group(mesh, group, members)
    mesh_arrays.write_source_vertices(mesh, rest)
    mesh.attributes.default_color_name = mesh.attributes.active_color_name = "albedo"
    mesh.materials.clear()
    mesh.materials.append(viewport_material(rest.channels))
    for slot in other.material_slots:
        slot.link = "DATA"
    settings.asset, settings.surfel_points = assets.anchor(path), None
    settings.adjustment.copy_from(obj.drgs.adjustment)
    settings.captured_colours = obj.drgs.captured_colours
    other.update_tag()


CLASSES = (DRGS_OT_swap_mesh,)
