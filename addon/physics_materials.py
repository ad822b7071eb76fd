"""The materials of DR-GS Physics: which there are, and the numbers of each."""

from __future__ import annotations

import math

import bpy
from bpy.props import EnumProperty, FloatProperty

from ..drgs_blender.core.sim_materials import MATERIALS

#: Numbers of every material, and those that some models have besides.
BASIC = ("youngs_modulus", "poisson", "density")
OF_MODEL = {
    "plastic": ("yield_stress", "hardening", "viscosity"),
    "sand": ("friction_angle", "cohesion"),
    "snow": ("compression", "stretch", "hardening"),
    "fluid": ("viscosity",),
}
#: Numbers that Blender keeps in radians and the engine in degrees.
ANGLES = ("friction_angle",)
_FIRST = MATERIALS["jelly"]

MATERIAL_ITEMS = [(name, name.title(), row.about[:1].upper() + row.about[1:]) for name, row in MATERIALS.items()]


def numbers_of(material: str) -> tuple[str, ...]:
    """The numbers that count for a material of the table."""
    return BASIC + OF_MODEL.get(MATERIALS[material].model, ())


def _take_preset(settings: MaterialNumbers, context: bpy.types.Context) -> None:
    """Fill the numbers in when another material is chosen."""
    row = MATERIALS[settings.material]
    for name in BASIC + tuple({n for names in OF_MODEL.values() for n in names}):
        value = getattr(row, name)
        setattr(settings, name, math.radians(value) if name in ANGLES else value)


class MaterialNumbers:
    """A material: a row of the engine's table and the numbers of it."""

    material: EnumProperty(
        name="Material",
        description="Material. Choosing one sets its parameters",
        items=MATERIAL_ITEMS,
        default=_FIRST.name,
        update=_take_preset,
        options=set(),
    )
    youngs_modulus: FloatProperty(
        name="Young's Modulus",
        description="Stiffness, pascals. A hundred times as stiff takes ten times as long",
        min=1.0,
        soft_min=1e3,
        soft_max=1e8,
        max=1e12,
        default=_FIRST.youngs_modulus,
        precision=0,
        step=100,
    )
    poisson: FloatProperty(
        name="Poisson's Ratio",
        description="How much it bulges when it is squeezed: 0 not at all, 0.49 keeps its volume",
        min=0.0,
        max=0.495,
        default=_FIRST.poisson,
        precision=3,
    )
    density: FloatProperty(
        name="Density (kg/m³)",
        description="Kilograms per cubic metre",
        min=0.01,
        max=1e5,
        soft_max=1e4,
        default=_FIRST.density,
        precision=0,
        step=100,
    )
    yield_stress: FloatProperty(
        name="Yield Stress (Pa)",
        description="Stress beyond which deformation is permanent, pascals",
        min=0.0,
        max=1e12,
        soft_max=1e7,
        precision=0,
        step=100,
    )
    hardening: FloatProperty(
        name="Hardening",
        description="Metal, clay and foam: pascals that the yield stress gains as it deforms, less than 0 softens. "
        "Snow: how fast it gets hard when pressed",
        soft_min=-1e6,
        soft_max=1e6,
        precision=1,
        step=100,
    )
    viscosity: FloatProperty(
        name="Viscosity (Pa s)",
        description="Resistance to flowing, pascal seconds: water 0, honey 300",
        min=0.0,
        max=1e6,
        soft_max=1e3,
    )
    friction_angle: FloatProperty(
        name="Friction Angle",
        description="The slope at which a pile of it comes to rest",
        subtype="ANGLE",
        min=0.0,
        max=math.radians(89),
    )
    cohesion: FloatProperty(
        name="Cohesion",
        description="Volumetric strain, as a share of the volume, at which it comes apart",
        min=0.0,
        max=1.0,
        soft_max=0.1,
        precision=4,
    )
    compression: FloatProperty(
        name="Crush Limit",
        description="Compression, as a share of the length, beyond which snow is crushed for good",
        min=1e-5,
        max=1.0,
        default=_FIRST.compression,
        precision=4,
    )
    stretch: FloatProperty(
        name="Break Limit",
        description="Stretch, as a share of the length, beyond which snow breaks",
        min=1e-5,
        max=1.0,
        default=_FIRST.stretch,
        precision=4,
    )
