"""Settings that adjust an object's material: changes to what was captured or painted, with keyframes and a way back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import bpy
import numpy as np
from bpy.props import BoolProperty, FloatProperty, FloatVectorProperty, StringProperty

from ..drgs_blender.core.frame import Adjustment
from . import mesh_arrays
from .property_limits import Limited, tag_changed

Array = np.ndarray

#: Settings that are numbers, and the values of all, the tint first, that change nothing.
NUMBERS = (
    *("hue", "saturation", "value", "brightness", "contrast"),
    *(f"{channel}_{part}" for channel in ("roughness", "metallic") for part in ("gain", "offset", "low", "high")),
    *("emission", "opacity"),
)
_NEUTRAL = ((1.0, 1.0, 1.0), 0.0, 1.0, 1.0, 0.0, 0.0, *(2 * (1.0, 0.0, 0.0, 1.0)), 1.0, 1.0)


def _masks(settings: DrgsAdjustmentSettings, context: bpy.types.Context, typed: str) -> Iterable[str]:
    """Names that the mask may have."""
    obj = settings.id_data
    return mesh_arrays.mask_names(obj, typed) if obj.type == "MESH" else []


def _number(label: str, about: str, **limits: float) -> FloatProperty:
    return FloatProperty(name=label, description=about, precision=3, step=1, update=tag_changed, **limits)


class DrgsAdjustmentSettings(bpy.types.PropertyGroup):
    """Changes on top of the material attributes of an object; see drgs_blender.core.frame.Adjustment."""

    use: BoolProperty(
        name="Adjustments",
        description="Apply the adjustments; switched off, the object is as it was before them",
        default=True,
        update=tag_changed,
    )
    tint: FloatVectorProperty(
        name="Tint",
        description="Colour that the albedo is multiplied with",
        subtype="COLOR",
        size=3,
        min=0.0,
        soft_max=1.0,
        max=10.0,
        default=(1.0, 1.0, 1.0),
        update=tag_changed,
    )
    hue: FloatProperty(
        name="Hue",
        description="Turn of the albedo's hue, in degrees",
        subtype="ANGLE",
        soft_min=-math.pi,
        soft_max=math.pi,
        default=0.0,
        update=tag_changed,
    )
    saturation: _number(
        "Saturation", "Factor on the albedo's saturation; 0 is grey", min=0.0, soft_max=2.0, default=1.0
    )
    value: _number("Value", "Factor on the albedo's brightness", min=0.0, soft_max=2.0, max=100.0, default=1.0)
    brightness: _number(
        "Brightness", "Added to the albedo, as Blender's node does", soft_min=-1.0, soft_max=1.0, default=0.0
    )
    contrast: _number(
        "Contrast", "Spreads the albedo around middle grey, as Blender's node does", soft_min=-1.0, soft_max=1.0,
        default=0.0,
    )  # fmt: skip
    roughness_gain: _number("Roughness Factor", "Multiplies the roughness", min=0.0, soft_max=4.0, default=1.0)
    roughness_offset: _number("Offset", "Added to the roughness after the factor", min=-1.0, max=1.0, default=0.0)
    roughness_low: _number("Minimum", "The roughness becomes no lower than this", min=0.0, max=1.0, default=0.0)
    roughness_high: _number("Maximum", "The roughness becomes no higher than this", min=0.0, max=1.0, default=1.0)
    metallic_gain: _number("Metallic Factor", "Multiplies the metallic channel", min=0.0, soft_max=4.0, default=1.0)
    metallic_offset: _number("Offset", "Added to the metallic channel after the factor", min=-1.0, max=1.0, default=0.0)
    metallic_low: _number("Minimum", "The metallic channel becomes no lower than this", min=0.0, max=1.0, default=0.0)
    metallic_high: _number("Maximum", "The metallic channel becomes no higher than this", min=0.0, max=1.0, default=1.0)
    emission: _number("Emission", "Factor on the light of the surface; 0 is none", min=0.0, soft_max=10.0, default=1.0)
    opacity: _number("Opacity", "Factor on the opacity, to fade an object out", min=0.0, max=1.0, default=1.0)
    mask: StringProperty(
        name="Mask",
        description="Vertex group or point attribute that limits the adjustments by its values; empty is everywhere",
        search=_masks,
        update=tag_changed,
    )
    use_invert: BoolProperty(name="Invert", description="Adjust where the mask is 0", default=False, update=tag_changed)

    def values(self) -> tuple[object, ...]:
        """All settings, to be compared; () where they change nothing."""
        made = (tuple(self.tint), *(getattr(self, name) for name in NUMBERS))
        return (*made, self.mask, self.use_invert) if self.use and made != _NEUTRAL else ()

    def reset(self) -> None:
        """Change nothing any more."""
        for name in ("use", "tint", *NUMBERS, "mask", "use_invert"):
            self.property_unset(name)
        self.id_data.update_tag(refresh={"OBJECT"})

    def copy_from(self, other: DrgsAdjustmentSettings) -> None:
        """Have the values of another object's."""
        for name in ("use", "tint", *NUMBERS, "mask", "use_invert"):
            setattr(self, name, getattr(other, name))

    def to_frame(self, mask: Array | None, warn: Callable[[str], None]) -> Adjustment:
        """The engine's description; `mask` (n,) is the one named here, None for everywhere."""
        own = Limited(self, f'Object "{self.id_data.name}"', warn)
        if mask is not None and self.use_invert:
            mask = 1 - mask
        return Adjustment(
            tint=tuple(own.tint),
            hue=own.hue / (2 * math.pi),
            saturation=own.saturation,
            value=own.value,
            roughness=tuple(getattr(own, f"roughness_{part}") for part in ("gain", "offset", "low", "high")),
            metallic=tuple(getattr(own, f"metallic_{part}") for part in ("gain", "offset", "low", "high")),
            mask=mask,
            emission=own.emission,
            opacity=own.opacity,
            brightness=own.brightness,
            contrast=own.contrast,
        )
