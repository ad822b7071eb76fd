"""Drive From: anything that deforms carries DR-GS objects: meshes, cloth, points, caches, particle systems."""

from __future__ import annotations

import bpy

from ..addon import assets, carrier_nodes, carrier_weights
from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator

NAME = "DR-GS Driver"
#: What can carry others, as it is evaluated.
KINDS = "MESH", "POINTCLOUD"
#: The share of an object's size that may be left of the way from the points that carry a vertex.
_FAR = 0.02
TOLD = (
    '"{}": some of it is beside or amid the points of "{}", not among them, and follows roughly. Fill its volume with '
    "points, or use a mesh with faces around it"
)


class DRGS_OT_drive_from(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Let the other object that is selected carry the selected DR-GS objects, from where both are now: a mesh (also cloth, soft bodies, caches), points, or the particles of a system. It stays as it is"""  # noqa: E501

    bl_idname = "drgs.drive_from"
    bl_label = "Drive From Selected"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    source: bpy.props.EnumProperty(
        name="From",
        description="What of the other object carries",
        items=(
            (
                "GEOMETRY",
                "Geometry",
                "Its faces, or its points where it has no faces, with all modifiers; points should fill the object",
            ),
            ("PARTICLES", "Particles", "The particles of its particle system; a mesh of a point for each is added"),
        ),
        default="GEOMETRY",
    )

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context), data=True)
        others = [o for kind in KINDS for o in selection.of_type(context.selected_objects, kind)]
        if len(others) != 1:
            problem = f"holds {len(others)} objects that could carry it" if others else "has nothing that carries it"
            raise UsageError("Selection", problem, "Select one mesh or point cloud too")
        (carrier,) = others
        for obj in objects:
            selection.check_size(obj)
            carrier_nodes.check_free(obj, NAME)
            if obj in shaped_by(carrier):
                problem = f'shapes "{carrier.name}", which should carry it'
                raise UsageError(f'Object "{obj.name}"', problem, "Remove the modifier there, or apply it")
            if obj.data.users > 1:
                raise UsageError(
                    f'Object "{obj.name}"',
                    f'shares its mesh "{obj.data.name}" with others, which are elsewhere',
                    "Choose Object > Relations > Make Single User > Object & Data",
                )
        made = particles_of(context, carrier) if self.source == "PARTICLES" else None
        try:
            left = drive(context, objects, carrier if made is None else made)
        except UsageError:
            if made is not None:
                selection.remove_with_mesh(made)
            raise
        for obj, share in left.items():
            if share > _FAR:
                self.warn(TOLD.format(obj.name, (carrier if made is None else made).name))
        selection.select_only(context, objects, objects[-1])
        return {"FINISHED"}


def drive(
    context: bpy.types.Context, objects: list[bpy.types.Object], carrier: bpy.types.Object
) -> dict[bpy.types.Object, float]:
    """Let `carrier` carry `objects`: by its points, and their normals where it has faces.

    Returns
    -------
    dict
        Object -> `carrier_weights.carry`

    Raises
    ------
    UsageError
        It has no points, or they are nowhere; nothing has been changed then.
    """
    context.view_layer.update()
    evaluated = carrier.evaluated_get(context.evaluated_depsgraph_get())
    selection.in_world(carrier, carrier_weights.read_points(evaluated))
    left = {}
    for obj in objects:
        modifier = selection.add_modifier(obj, "NODES", NAME)
        context.view_layer.update()
        left[obj] = carrier_weights.carry(obj, carrier, modifier)
    context.view_layer.update()
    return left


def shaped_by(carrier: bpy.types.Object) -> set[bpy.types.Object]:
    """The objects that shape another by its modifiers, and those that shape these."""
    found: set[bpy.types.Object] = set()
    left = [carrier]
    while left:
        for modifier in left.pop().modifiers:
            given = [getattr(modifier, p.identifier) for p in modifier.bl_rna.properties if p.type == "POINTER"]
            if modifier.type == "NODES" and modifier.node_group is not None:
                given += _inputs_of(modifier)
                given += [s.default_value for n in modifier.node_group.nodes for s in n.inputs if s.type == "OBJECT"]
            new = {other for other in given if isinstance(other, bpy.types.Object)} - found
            found |= new
            left += new
    return found


def _inputs_of(modifier: bpy.types.Modifier) -> list[object]:
    """What a nodes modifier is given in its panel."""
    if not hasattr(modifier, "properties"):  # before Blender 5.2
        return [modifier[key] for key in modifier.keys()]  # noqa: SIM118 - no dictionary
    inputs = modifier.properties.inputs
    return [getattr(getattr(inputs, p.identifier), "value", None) for p in inputs.bl_rna.properties]


def particles_of(context: bpy.types.Context, emitter: bpy.types.Object) -> bpy.types.Object:
    """A mesh with a vertex for each particle of the active system of `emitter`, born or not.

    Raises
    ------
    UsageError
        It has none.
    """
    system = emitter.particle_systems.active if emitter.type == "MESH" else None
    if system is None:
        raise UsageError(f'Object "{emitter.name}"', "has no particle system", "Add one, or choose From: Geometry")
    mesh = bpy.data.meshes.new(f"{emitter.name} particles")
    mesh.from_pydata([(0.0, 0.0, 0.0)], [], [])
    points = bpy.data.objects.new(mesh.name, mesh)
    assets.collection(context).objects.link(points)
    index = emitter.particle_systems.active_index + 1
    selection.add_modifier(
        points, "PARTICLE_INSTANCE", "Particles", object=emitter, particle_system_index=index, use_normal=True,
        show_unborn=True, show_alive=True, show_dead=True, use_path=False, space="WORLD",
    )  # fmt: skip
    points.hide_render = True
    return points


CLASSES = (DRGS_OT_drive_from,)
