"""Bind to Cage: a low-poly mesh carries the selected objects along (Surface Deform, or nodes where that refuses)."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
from bpy.props import IntProperty

from ..addon import assets, carrier_nodes, carrier_weights, mesh_arrays
from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator

NAME = "DR-GS Cage"
#: Ends the name of the modifier for the cage as it is rendered.
_RENDERED = " Render"
#: Voxels along the diagonal from which a new cage is made, before it is thinned out.
VOXELS = 48


class DRGS_OT_bind_to_cage(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Let a low-poly mesh carry the selected DR-GS objects: the mesh that is selected too, or a new one around them"""

    bl_idname = "drgs.bind_to_cage"
    bl_label = "Add Cage"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    faces: IntProperty(name="Faces", description="Triangles of a new cage, about", min=50, soft_max=5000, default=400)

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context))
        cages = list(selection.of_type(context.selected_objects, "MESH"))
        if len(cages) > 1:
            raise UsageError("Selection", f"holds {len(cages)} other meshes", "Select one cage, or none for a new one")
        cage = cages[0] if cages else new_cage(context, objects, self.faces)
        try:
            refused = bind_to_cage(context, objects, cage)
        except UsageError:
            if not cages:
                selection.remove_with_mesh(cage)
            raise
        for name, reason in refused.items():
            self.report({"INFO"}, f'Surface Deform cannot bind "{name}" to "{cage.name}" ({reason}); nodes carry it')
        selection.select_only(context, [cage], cage)
        return {"FINISHED"}


def bind_to_cage(context: bpy.types.Context, objects: list[bpy.types.Object], cage: bpy.types.Object) -> dict[str, str]:
    """Bind `objects` as they are now to `cage` as it is now; the cage is shown as wires and not rendered.

    Where it has other points in renders than in viewports, there is a modifier for each.

    Returns
    -------
    dict
        Object name -> why Surface Deform did not take it, so that `carrier_nodes` carry it.

    Raises
    ------
    UsageError
        That mesh cannot carry anything, or an object's mesh may not be changed; nothing has been changed then.
    """
    shape = cage.evaluated_get(context.evaluated_depsgraph_get()).data
    selection.in_world(cage, mesh_arrays.read_vertices(shape))
    if not any(p.area > 0 for p in shape.polygons):
        raise UsageError(f'Cage "{cage.name}"', "has no faces that could carry anything", "Give it faces")
    count = len(shape.vertices)
    with carrier_weights.as_rendered(cage):
        rendered = len(cage.evaluated_get(context.evaluated_depsgraph_get()).data.vertices)
    refused = {}
    for obj in objects:
        remove(obj)
        reason = _surface_deform(context, obj, cage, NAME, count)
        if not reason and rendered != count:
            shown = obj.modifiers[NAME]
            shown.show_render = shown.show_viewport = False
            with carrier_weights.as_rendered(cage):
                reason = _surface_deform(context, obj, cage, NAME + _RENDERED, rendered)
            shown.show_viewport = True
            obj.modifiers[NAME + _RENDERED].show_viewport = False
        if reason:
            refused[obj.name] = reason
    left = [obj for obj in objects if obj.name in refused]
    try:
        _check_carried(left, cage)
    except UsageError:
        for obj in objects:
            remove(obj)
        raise
    for obj in left:
        remove(obj)
        modifier = selection.add_modifier(obj, "NODES", NAME)
        context.view_layer.update()
        carrier_weights.carry(obj, cage, modifier)
    cage.display_type, cage.hide_render = "WIRE", True
    return refused


def remove(obj: bpy.types.Object) -> None:
    """Take away what `bind_to_cage` added."""
    counts = dict(obj.get(carrier_nodes.COUNT, {}))
    for known in (NAME, NAME + _RENDERED):
        if (modifier := obj.modifiers.get(known)) is not None:
            obj.modifiers.remove(modifier)
        counts.pop(known, None)
    if counts:
        obj[carrier_nodes.COUNT] = counts
    elif carrier_nodes.COUNT in obj:
        del obj[carrier_nodes.COUNT]


def _surface_deform(
    context: bpy.types.Context, obj: bpy.types.Object, cage: bpy.types.Object, name: str, count: int
) -> str:
    """Bind by Surface Deform to a cage of `count` points; why it refuses, or nothing."""
    modifier = selection.add_modifier(obj, "SURFACE_DEFORM", name, target=cage)
    context.view_layer.update()
    reason = ""
    with context.temp_override(object=obj, active_object=obj, selected_objects=[obj]):
        try:
            bpy.ops.object.surfacedeform_bind(modifier=modifier.name)
        except RuntimeError as error:
            reason = str(error).removeprefix("Error: ").strip().rstrip(".")
    context.view_layer.update()
    if not modifier.is_bound:
        return reason or "a face is concave, or an edge has more than two"
    obj[carrier_nodes.COUNT] = {**dict(obj.get(carrier_nodes.COUNT, {})), name: count}
    return ""


def _check_carried(objects: list[bpy.types.Object], cage: bpy.types.Object) -> None:
    """UsageError where nodes cannot carry an object: each vertex of its mesh keeps its place in the cage."""
    for obj in selection.editable(objects, data=True) if objects else ():
        selection.check_size(obj)
        selection.check_size(cage)
        carrier_nodes.check_free(obj, NAME)
        if obj.data.users > 1:
            raise UsageError(
                f'Object "{obj.name}"',
                f'shares its mesh "{obj.data.name}" with others, which are elsewhere in the cage',
                "Choose Object > Relations > Make Single User > Object & Data",
            )


def new_cage(context: bpy.types.Context, objects: list[bpy.types.Object], faces: int) -> bpy.types.Object:
    """A closed mesh of about `faces` triangles around the undeformed `objects`, in their collection."""
    vertices = [selection.world_vertices(o) for o in objects]
    starts = np.cumsum([0, *map(len, vertices)])
    everything = np.concatenate(vertices)
    triangles = np.concatenate([mesh_arrays.loop_triangles(o.data) + start for o, start in zip(objects, starts)])
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata(everything.tolist(), [], triangles.tolist())
    cage = bpy.data.objects.new(NAME, mesh)
    assets.collection(context).objects.link(cage)
    size = float(np.linalg.norm(np.ptp(everything, axis=0)))
    try:
        for kind, values in (
            ("SOLIDIFY", {"thickness": 2 * size / VOXELS, "offset": 0.0}),
            ("REMESH", {"mode": "VOXEL", "voxel_size": size / VOXELS}),
        ):
            selection.add_modifier(cage, kind, kind, **values)
        apply_modifiers(context, cage)
        if not len(cage.data.polygons):
            raise UsageError(
                "Cage", "nothing is left of the objects at this size", "Make the cage by hand and select it"
            )
        thin_out(context, cage, faces, 1e-4 * size)
    except UsageError:
        selection.remove_with_mesh(cage)
        raise
    return cage


def thin_out(context: bpy.types.Context, obj: bpy.types.Object, faces: int, distance: float) -> None:
    """Leave about `faces` triangles of a mesh, without what is smaller than `distance`."""
    ratio = min(1.0, faces / max(len(mesh_arrays.loop_triangles(obj.data)), 1))
    selection.add_modifier(obj, "DECIMATE", "DECIMATE", ratio=ratio, use_collapse_triangulate=True)
    apply_modifiers(context, obj)
    clean(obj.data, distance)


def clean(mesh: bpy.types.Mesh, distance: float) -> None:
    """Take away what Surface Deform refuses: slivers, and edges of more than two faces."""
    work = bmesh.new()
    work.from_mesh(mesh)
    bmesh.ops.dissolve_degenerate(work, dist=distance, edges=work.edges)
    crowded = [e for e in work.edges if len(e.link_faces) > 2]
    bmesh.ops.split_edges(work, edges=crowded)
    bmesh.ops.triangulate(work, faces=work.faces)
    slivers = [f for f in work.faces if f.calc_area() < distance**2]
    bmesh.ops.delete(work, geom=slivers, context="FACES_ONLY")
    work.to_mesh(mesh)
    work.free()


def apply_modifiers(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Replace the mesh by what its modifiers make of it."""
    context.view_layer.update()
    old = obj.data
    evaluated = obj.evaluated_get(context.evaluated_depsgraph_get())
    obj.data = bpy.data.meshes.new_from_object(evaluated)
    obj.modifiers.clear()
    bpy.data.meshes.remove(old)
    obj.data.name = NAME


CLASSES = (DRGS_OT_bind_to_cage,)
