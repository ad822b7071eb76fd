"""Settings of DR-GS Physics: material, regions, pins, colliders, domain, frames, folder; not the state of a bake."""

from __future__ import annotations

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import blend_paths
from .physics_materials import MaterialNumbers
from .property_limits import tag_changed

CONTACT_ITEMS = (
    ("separate", "Separate", "The object slides with friction and may leave the surface"),
    ("slip", "Slip", "The object slides without friction and stays on the surface"),
    ("sticky", "Sticky", "What touches the surface sticks to it"),
)
WALL_ITEMS = (("open", "Open", "Particles that leave the domain stop the bake with a message"), *CONTACT_ITEMS)


def _take_range(settings: DrgsPhysicsSettings, context: bpy.types.Context) -> None:
    """Take the scene's frames when physics is switched on for the first time, as Blender's own caches do."""
    scene = context.scene
    chosen = settings.is_property_set("frame_start") or settings.is_property_set("frame_end")
    if settings.use and not chosen and scene.frame_end > scene.frame_start:
        settings.frame_start, settings.frame_end = scene.frame_start, scene.frame_end


class DrgsPhysicsRegion(MaterialNumbers, bpy.types.PropertyGroup):
    """A part of the object with another material."""

    group: StringProperty(
        name="Group",
        description="Vertex group (weights of 0.5 and more) or point attribute that marks the part. The last region "
        "that holds a place counts",
    )


class DrgsPhysicsCollider(bpy.types.PropertyGroup):
    """A mesh, or the meshes of a collection, that the object collides with."""

    object: PointerProperty(
        type=bpy.types.Object,
        name="Object",
        description="Mesh that the object collides with; it may be animated",
        poll=lambda self, obj: obj.type == "MESH",
    )
    collection: PointerProperty(
        type=bpy.types.Collection, name="Collection", description="All meshes of it are colliders"
    )
    contact: EnumProperty(name="Contact", description="How the object moves along the surface", items=CONTACT_ITEMS)
    friction: FloatProperty(
        name="Friction", description="Coulomb friction: 0 is ice", min=0.0, soft_max=2.0, max=1e6, default=0.5
    )
    thickness: FloatProperty(
        name="Thickness",
        description="Distance from the surface at which the object is stopped, metres",
        unit="LENGTH",
        soft_min=0.0,
        soft_max=1.0,
        min=-1e3,
        max=1e3,
    )


class DrgsPhysicsSettings(MaterialNumbers, bpy.types.PropertyGroup):
    """Material, forces, colliders and frames of a simulated object.

    Animated and driven values count as they are in the first frame.
    """

    use: BoolProperty(
        name="Physics",
        description="Fill the object with particles that the engine simulates; its mesh and splats follow them",
        default=False,
        update=_take_range,
        options=set(),
    )
    regions: CollectionProperty(
        type=DrgsPhysicsRegion, name="Regions", description="Parts of the object with another material"
    )
    colliders: CollectionProperty(
        type=DrgsPhysicsCollider, name="Colliders", description="Meshes with which the simulated object collides"
    )
    coupling: PointerProperty(
        type=bpy.types.Collection,
        name="Coupled With",
        description="Objects of this collection with DR-GS Physics are baked with this one, and all push each other",
    )
    contact: EnumProperty(
        name="Contact",
        description="How it moves along the other bodies. Of two the one that holds more counts: Sticky, then Slip",
        items=CONTACT_ITEMS,
    )
    friction: FloatProperty(
        name="Friction",
        description="Coulomb friction on other bodies: 0 is ice. Of two the geometric mean counts",
        min=0.0,
        soft_max=2.0,
        max=1e6,
        default=0.5,
    )
    solver: EnumProperty(
        name="Solver",
        description="Method by which the motion is computed",
        items=(
            ("mpm", "MPM", "Material points on a grid (MLS-MPM): every material"),
            ("xpbd", "Preview (XPBD)", "Position-based dynamics of a lattice: fast, and every material is elastic"),
            ("rigid", "Rigid Body", "Nothing bends: it falls, tumbles and comes to rest in one piece"),
        ),
        options=set(),
    )
    tear: BoolProperty(
        name="Open Tears",
        description="Part the mesh where the material has come apart, instead of stretching it over the gap",
        default=True,
        update=tag_changed,
        options=set(),
    )
    surface: EnumProperty(
        name="Surface",
        description="What is shown of the simulated object",
        items=(
            (
                "automatic",
                "Automatic",
                "Fluids by a surface around their particles, everything else by mesh and splats",
            ),
            ("mesh", "Mesh", "The object's mesh and splats, which the particles move"),
            ("particles", "Particles", "A surface around the particles, in the object's colours; splats are not shown"),
        ),
        update=tag_changed,
        options=set(),
    )
    inside: EnumProperty(
        name="Inside",
        description="What is seen where the material has come apart",
        items=(
            (
                "automatic",
                "As Outside",
                "Pieces are closed; inside they have the mean colour and material of the object",
            ),
            ("own", "Own Material", "Pieces are closed; inside they have a colour and material of their own"),
            ("open", "Hollow", "No faces are made: one looks into the pieces as into shells"),
        ),
        update=tag_changed,
        options=set(),
    )
    inside_colour: FloatVectorProperty(
        name="Base Color",
        description="Colour of the inside",
        subtype="COLOR",
        min=0.0,
        max=1.0,
        default=(0.5, 0.5, 0.5),
        update=tag_changed,
        options=set(),
    )
    inside_roughness: FloatProperty(
        name="Roughness",
        description="Roughness of the inside",
        subtype="FACTOR",
        min=0.0,
        max=1.0,
        default=0.8,
        update=tag_changed,
        options=set(),
    )
    inside_metallic: FloatProperty(
        name="Metallic",
        description="How metallic the inside is",
        subtype="FACTOR",
        min=0.0,
        max=1.0,
        default=0.0,
        update=tag_changed,
        options=set(),
    )
    grain: BoolProperty(
        name="Granular Splats",
        description="Sand: where it flows, splats are drawn as grains instead of a stretched skin",
        default=True,
        update=tag_changed,
        options=set(),
    )
    driven_by: EnumProperty(
        name="Driven By",
        description="What carries the splats of the simulated object",
        items=(
            ("automatic", "Automatic", "Splats on the mesh follow its surface, all others the particles around them"),
            ("surface", "Surface", "All follow the faces of the mesh, which the particles move"),
            ("particles", "Particles", "All follow the particles around them; where the material flows, the surface"),
        ),
        update=tag_changed,
        options=set(),
    )
    resolution: IntProperty(
        name="Resolution",
        description="Cells along the longest side of the object; each holds eight particles. Twice as many take up to "
        "sixteen times as long",
        min=4,
        soft_max=160,
        max=400,
        default=48,
        options=set(),
    )
    seed: IntProperty(
        name="Seed",
        description="Random places of the particles of sand and fluids. Another seed gives another variant "
        "of the motion",
        min=0,
    )
    gravity: FloatProperty(
        name="Gravity",
        description="Share of the scene's gravity that acts on it",
        default=1.0,
        soft_min=0.0,
        soft_max=1.0,
        min=-200.0,
        max=200.0,
    )
    fields: FloatProperty(
        name="Force Fields",
        description="Share of the scene's forces, winds, vortices and turbulence that acts on it; a strength of 1 "
        "accelerates by 1 m/s²",
        default=1.0,
        soft_min=0.0,
        soft_max=1.0,
        min=-200.0,
        max=200.0,
    )
    field_collection: PointerProperty(
        type=bpy.types.Collection,
        name="Effector Collection",
        description="Only force fields of this collection act on it",
    )
    wind: FloatVectorProperty(
        name="Wind", description="Velocity of the air, metres per second, world", subtype="XYZ", unit="VELOCITY"
    )
    drag: FloatProperty(
        name="Drag",
        description="How the wind takes it along: share of the difference in speed that is lost per second. Without "
        "wind there is none",
        min=0.0,
        max=1e4,
        soft_max=10.0,
        default=1.0,
    )
    damping: FloatProperty(
        name="Damping", description="Share of the speed lost per second", min=0.0, max=1e4, soft_max=10.0
    )
    velocity: FloatVectorProperty(
        name="Velocity", description="At the start, metres per second, world", subtype="XYZ", unit="VELOCITY"
    )
    spin: FloatVectorProperty(
        name="Spin",
        description="At the start, about the object's centre: angle per second about each axis of the world",
        subtype="XYZ",
        unit="ROTATION",
    )
    pin_group: StringProperty(
        name="Pin Group",
        description="Vertex group (weights of 0.5 and more) or point attribute of the pinned part; it follows the "
        "object's own animation: armature, shape keys, transforms",
    )
    use_floor: BoolProperty(name="Floor", description="A level floor without end", default=False, options=set())
    floor: FloatProperty(name="Height", description="Height of the floor in the world, metres", unit="LENGTH")
    floor_contact: EnumProperty(name="Contact", description="How the object moves along the floor", items=CONTACT_ITEMS)
    floor_friction: FloatProperty(
        name="Friction", description="Coulomb friction of the floor: 0 is ice", min=0.0, soft_max=2.0, default=0.5
    )
    domain: PointerProperty(
        type=bpy.types.Object,
        name="Domain",
        description="Mesh whose bounding box, in the world, is the space simulated. Without one, three times the "
        "object's size",
        poll=lambda self, obj: obj.type == "MESH",
    )
    walls: EnumProperty(name="Walls", description="Contact at the sides of the domain", items=WALL_ITEMS)
    frame_start: IntProperty(
        name="First Frame",
        description="Frame in which all is at rest and the simulation begins; at first the scene's first one",
        default=1,
        min=-1_048_574,
        max=1_048_574,
        options=set(),
    )
    frame_end: IntProperty(
        name="Last Frame",
        description="Last frame that is baked; the object stays so after it. At first the scene's last one",
        default=100,
        min=-1_048_574,
        max=1_048_574,
        options=set(),
    )
    folder: StringProperty(
        name="Cache Folder",
        description="Folder of the frames; empty is drgs_cache/BLEND/OBJECT beside the .blend. One folder per object "
        "of one .blend",
        subtype="DIR_PATH",
        options=blend_paths.RELATIVE,
    )


CLASSES = (DrgsPhysicsRegion, DrgsPhysicsCollider, DrgsPhysicsSettings)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
