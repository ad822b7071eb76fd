"""Convert to DR-GS: splats and meshes of other importers become DR-GS objects at the same place, with their rig."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty

from ..addon import assets, blend_paths, splat_attributes
from ..drgs_blender.core.errors import UsageError, first_of
from . import selection
from .bind_rig import armature_over, bind_to_rig, rest_pose
from .engine_command import CommandOperator
from .import_asset import import_assets

#: What can be converted.
KINDS = "MESH", "POINTCLOUD"


class DRGS_OT_convert(CommandOperator, bpy.types.Operator):
    """Make the active object, a cloud of splats or a textured mesh, a DR-GS object at the same place"""

    bl_idname = "drgs.convert"
    bl_label = "Convert to DR-GS"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    out: StringProperty(
        name="Save As",
        description="The file to write; empty is beside the .blend, numbered where an object is made of that",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    use_mesh: BoolProperty(
        name="Mesh from Splats",
        description="Build a mesh around splats, so that they can be bent and cast shadows. Else light meets the "
        "splats themselves",
        default=True,
    )
    use_original: BoolProperty(name="Keep Original", description="Leave the original visible", default=False)

    _name = ""
    _target = Path()

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Select a cloud of splats or a mesh in Object Mode")
        return context.mode == "OBJECT" and context.active_object is not None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=420)

    def run(self, context: bpy.types.Context) -> set[str]:
        obj = context.active_object
        subject = f'Object "{obj.name}"'
        if assets.is_drgs(obj):
            raise UsageError(subject, "is a DR-GS object already", "Choose another")
        if not self.out and not bpy.data.filepath:
            raise UsageError(subject, "has no place for its asset", "Save the .blend, or name the asset's file")
        others = sorted(
            o.name for o in context.selected_objects if o is not obj and o.type in KINDS and not assets.is_drgs(o)
        )
        if others:
            self.warn(f'Only the active object, "{obj.name}", is converted, not {first_of(others)}: convert each')
        named = self.out or f"//{bpy.path.clean_name(obj.name)}"
        target = Path(bpy.path.abspath(named)).absolute().with_suffix(".drgs")
        self._target = target = assets.chosen(target, bool(self.out))
        self._name = obj.name
        with self.folder("drgs-convert-"):
            arguments = self._source(context, obj)
        arguments += ["--out", str(target)]
        status = f"Making {target.name}"
        return self.start(context, arguments, subject, status, "could not be made into an asset", [target])

    def done(self, context: bpy.types.Context) -> set[str]:
        original = bpy.data.objects.get(self._name)
        if original is None:
            raise UsageError(f'Object "{self._name}"', "is gone", "Undo what removed it")
        (made,) = import_assets(context, [self._target])
        with rest_pose(context, armature_over(original)):  # which moves what is parented to a bone
            made.matrix_world = original.matrix_world
        if original.type == "MESH" and len(original.data.polygons):
            self._take_rig(context, made, original)
        if not self.use_original:
            original.hide_set(True)
            original.hide_render = True
        return {"FINISHED"}

    def _source(self, context: bpy.types.Context, obj: bpy.types.Object) -> list[str]:
        """Write what the object is, and return the arguments that make an asset of it."""
        subject = f'Object "{obj.name}"'
        data = obj.evaluated_get(context.evaluated_depsgraph_get()).data
        if obj.type in KINDS and splat_attributes.is_splats(data):
            try:
                columns = splat_attributes.read_splats(data)
            except TypeError as error:
                raise UsageError(subject, f"has splats of an unknown kind ({error})", "Import their file") from error
            if not len(columns["x"]):
                raise UsageError(subject, "has no points", "Choose another")
            path = self.work_folder / "splats.ply"
            splat_attributes.write_ply(path, columns)
            return ["import", str(path), "--up", "z", *([] if self.use_mesh else ["--no-mesh"])]
        if obj.type != "MESH" or not len(data.polygons):
            raise UsageError(subject, "has neither faces nor the attributes of splats", "Choose splats or a mesh")
        path = self.work_folder / "mesh.glb"
        with _alone_at_rest(context, obj):
            try:
                bpy.ops.export_scene.gltf(
                    filepath=str(path), use_selection=True, export_apply=True, export_skins=False, export_morph=False,
                    export_animations=False,
                )  # fmt: skip
            except (RuntimeError, AttributeError) as error:
                problem = f"cannot be written by Blender's glTF exporter ({str(error).strip()[:200]})"
                raise UsageError(subject, problem, "Enable the add-on glTF 2.0 format") from error
        return ["make", str(path)]

    def _take_rig(self, context: bpy.types.Context, made: bpy.types.Object, original: bpy.types.Object) -> None:
        """Let an object move as the one that it was made of: bones, shape keys, parent, constraints, animation."""
        if armature_over(original) is not None or original.data.shape_keys:
            bind_to_rig(context, made, [original])
        animation = original.animation_data
        same = made.parent is original.parent and original.parent_type == "OBJECT"
        if made.parent is not None and not same:  # the armature, by which it is moved now
            if animation is not None or original.constraints:
                self.warn(f'"{made.name}" moves with "{made.parent.name}" alone: the animation and constraints of '
                          f'"{original.name}" itself are not taken over')  # fmt: skip
            return
        if original.parent is not None:
            made.parent, made.parent_type = original.parent, original.parent_type
            made.parent_bone, made.parent_vertices = original.parent_bone, original.parent_vertices
            made.matrix_parent_inverse = original.matrix_parent_inverse
        made.rotation_mode, made.matrix_basis = original.rotation_mode, original.matrix_basis
        for name in ("location", "rotation_euler", "rotation_quaternion", "scale"):
            setattr(made, name, getattr(original, name))
            setattr(made, f"delta_{name}", getattr(original, f"delta_{name}"))
        for constraint in original.constraints:
            made.constraints.copy(constraint)
        if animation is not None and animation.action is not None:
            own = made.animation_data_create()
            own.action = animation.action
            if getattr(animation, "action_slot", None) is not None:  # Blender 4.4 and later
                own.action_slot = animation.action_slot
        if animation is not None and (animation.nla_tracks or animation.drivers):
            self.warn(f'"{made.name}" has no NLA tracks and drivers of "{original.name}": copy them, or parent it')


@contextlib.contextmanager
def _alone_at_rest(context: bpy.types.Context, obj: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """A copy of a mesh object at the origin, alone selected: modifiers are applied, bones and shape keys at rest."""
    keys = obj.data.shape_keys.key_blocks if obj.data.shape_keys else ()
    muted = [key.mute for key in keys]
    selected, active = context.selected_objects, context.view_layer.objects.active
    with rest_pose(context, armature_over(obj)):
        try:
            for key in keys:
                key.mute = True
            depsgraph = context.evaluated_depsgraph_get()
            mesh = bpy.data.meshes.new_from_object(
                obj.evaluated_get(depsgraph), preserve_all_data_layers=True, depsgraph=depsgraph
            )
        finally:
            for key, mute in zip(keys, muted):
                key.mute = mute
    for index, slot in enumerate(obj.material_slots):
        if slot.link == "OBJECT" and index < len(mesh.materials):  # nodes may have made other slots
            mesh.materials[index] = slot.material
    alone = bpy.data.objects.new(obj.name, mesh)
    assets.collection(context).objects.link(alone)
    try:
        for other in selected:
            other.select_set(False)
        alone.select_set(True)
        context.view_layer.objects.active = alone
        yield alone
    finally:
        selection.remove_with_mesh(alone)
        for other in selected:
            other.select_set(True)
        context.view_layer.objects.active = active


CLASSES = (DRGS_OT_convert,)
