"""Materials by one click: presets on the attributes of the selected objects, and back to what was captured."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ..addon import assets, mesh_arrays
from ..addon.viewport_material import update_viewport_material
from ..drgs_blender.core.asset import BASE_CHANNELS, MATERIAL_CHANNELS, OPTIONAL_CHANNELS
from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator
from .nearest_surface import nearest, source_of

Array = np.ndarray
Change = Callable[[Array], Array]


def _all(*value: float) -> Change:
    """The same value for every vertex."""
    return lambda old: np.broadcast_to(np.array(value if old.ndim == 2 else value[0], np.float32), old.shape)


class Preset(NamedTuple):
    """Material preset: values of the channels that it names; albedo is linear Rec.709."""

    label: str
    about: str
    changes: dict[str, Change]


#: Albedo of metals: reflectance at normal incidence, as tabulated for rendering.
PRESETS = {
    "GOLD": Preset(
        "Gold", "Polished gold", {"albedo": _all(1.0, 0.78, 0.34), "roughness": _all(0.2), "metallic": _all(1)}
    ),
    "COPPER": Preset(
        "Copper", "Brushed copper", {"albedo": _all(0.96, 0.64, 0.54), "roughness": _all(0.35), "metallic": _all(1)}
    ),
    "CHROME": Preset(
        "Chrome", "A mirror of chrome", {"albedo": _all(0.55, 0.56, 0.55), "roughness": _all(0.03), "metallic": _all(1)}
    ),
    "CLAY": Preset(
        "Clay",
        "Matte grey, shows the shape alone",
        {"albedo": _all(0.5, 0.5, 0.5), "roughness": _all(0.9), "metallic": _all(0)},
    ),
    "PLASTIC": Preset("Plastic", "The own colours, smooth", {"roughness": _all(0.25), "metallic": _all(0)}),
    "WET": Preset(
        "Wet",
        "Darker and smoother",
        {"albedo": lambda old: old * 0.6, "roughness": lambda old: np.maximum(old * 0.3, 0.04)},
    ),
}


def _masks(operator: DRGS_OT_set_material, context: bpy.types.Context, typed: str) -> Iterable[str]:
    """Names that the mask may have, of all selected objects."""
    return dict.fromkeys(name for o in selection.selected(context) for name in mesh_arrays.mask_names(o, typed))


class DRGS_OT_set_material(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Give the selected DR-GS objects, or the parts that a mask says, another material"""

    bl_idname = "drgs.set_material"
    bl_label = "Set Material"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    preset: EnumProperty(
        name="Material",
        description="Material that the objects take",
        items=[(key, p.label, p.about) for key, p in PRESETS.items()],
        default="GOLD",
    )
    factor: FloatProperty(
        name="Factor",
        description="How much of the material is applied: 0 is nothing, 1 is all",
        subtype="FACTOR",
        min=0.0,
        max=1.0,
        default=1.0,
    )
    mask: StringProperty(
        name="Mask",
        description="Vertex group or point attribute that limits the change by its values; empty is everywhere",
        search=_masks,
        options={"SKIP_SAVE"},
    )
    use_invert: BoolProperty(
        name="Invert",
        description="Apply it where the mask is 0",
        default=False,
        options={"SKIP_SAVE"},
    )

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context), data=True)
        weights = [self.weight(obj) for obj in objects]  # all of them first: an error leaves every object as it was
        for obj, weight in zip(objects, weights, strict=True):
            set_material(obj, PRESETS[self.preset], weight)
        return {"FINISHED"}

    def weight(self, obj: bpy.types.Object) -> Array:
        """(n,) float32 in [0, 1]: how much of the material each vertex of `obj` gets.

        Raises
        ------
        UsageError
            It has no such mask; names the object.
        """
        mask = mask_of(obj, self.mask)
        if mask is None:
            return np.full(len(obj.data.vertices), self.factor, np.float32)
        return np.float32(self.factor) * (1 - mask if self.use_invert else mask)


class DRGS_OT_restore_material(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Give the selected DR-GS objects back the materials of their assets, without adjustments; where a mask says so,
    what is painted alone"""

    bl_idname = "drgs.restore_material"
    bl_label = "Restore Captured Material"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    mask: StringProperty(
        name="Mask",
        description="Vertex group or point attribute: what is painted goes by its values; empty is everywhere",
        search=_masks,
        options={"SKIP_SAVE"},
    )

    def run(self, context: bpy.types.Context) -> set[str]:
        objects = selection.editable(selection.selected(context), data=True)
        weights = [mask_of(obj, self.mask) for obj in objects]
        for obj, weight in zip(objects, weights, strict=True):
            captured = assets.captured_mesh(obj)
            if weight is None:
                mesh_arrays.restore_channels(obj.data, captured)
                obj.drgs.adjustment.reset()
            else:
                for channel in filter(obj.data.attributes.__contains__, MATERIAL_CHANNELS):
                    set_towards(obj, channel, captured.channel(channel), weight)
            update_viewport_material(obj.data)
        return {"FINISHED"}


class DRGS_OT_copy_material(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Copy the material of the active DR-GS object to the other selected ones, from the nearest places, with its
    adjustments"""

    bl_idname = "drgs.copy_material"
    bl_label = "Copy Material to Selected"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        *objects, source = selection.selected(context)
        if source is not context.active_object or not objects:
            raise UsageError(
                "Selection", "holds no two DR-GS objects", "Select those to change, then the one to copy from"
            )
        place = source_of(source)
        values = {channel: present(source, channel) for channel in MATERIAL_CHANNELS}
        shown = {*BASE_CHANNELS, *(n for n in OPTIONAL_CHANNELS if (values[n] != MATERIAL_CHANNELS[n].neutral).any())}
        for obj in selection.editable(objects, data=True):
            match = nearest(selection.world_vertices(obj), [place])
            for channel, own in values.items():
                if channel not in shown and channel not in obj.data.attributes:
                    continue
                copied = np.einsum("nc,nc...->n...", match.barycentric, own[match.corners])
                mesh_arrays.write_channel(obj.data, channel, copied)
            update_viewport_material(obj.data)
            obj.drgs.adjustment.copy_from(source.drgs.adjustment)
        return {"FINISHED"}


class DRGS_OT_reset_adjustments(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Take the adjustments of the selected DR-GS objects back; what is painted stays"""

    bl_idname = "drgs.reset_adjustments"
    bl_label = "Reset Adjustments"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        for obj in selection.editable(selection.selected(context), vertices=False):
            obj.drgs.adjustment.reset()
        return {"FINISHED"}


class DRGS_OT_paint(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Paint a material channel of the active DR-GS object, as all paint modes do, with Blender's brushes. Other
    objects stay selected"""

    bl_idname = "drgs.paint"
    bl_label = "Paint"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    channel: EnumProperty(
        name="Channel",
        description="Attribute that brushes paint",
        items=(
            ("albedo", "Albedo", "The colour of the surface without light"),
            ("roughness", "Roughness", "Black is a mirror, white is matte"),
            ("metallic", "Metallic", "Black is no metal, white is metal"),
            ("opacity", "Opacity", "Light passes what is black; white lets none through"),
            ("emission", "Emission", "Light that the surface gives off by itself; black is none"),
            ("specular", "Specular", "Middle grey reflects as glass does, black not at all"),
            ("coat", "Coat", "White is varnished, black is not"),
        ),
        default="albedo",
    )

    def run(self, context: bpy.types.Context) -> set[str]:
        (obj,) = selection.editable(selection.selected(context)[-1:], data=True)
        if not obj.visible_get():
            raise UsageError(f'Object "{obj.name}"', "is hidden", "Show it in the Outliner")
        mesh_arrays.make_paintable(obj.data, self.channel, present(obj, self.channel))
        update_viewport_material(obj.data)
        obj.select_set(True)
        context.view_layer.objects.active = obj
        bpy.ops.object.mode_set(mode="VERTEX_PAINT")
        return {"FINISHED"}


def set_material(obj: bpy.types.Object, preset: Preset, weight: Array) -> None:
    """Change the material attributes of `obj` towards `preset` by `weight`, (n,) in [0, 1]."""
    for channel, change in preset.changes.items():
        set_towards(obj, channel, change(present(obj, channel)), weight)


def set_towards(obj: bpy.types.Object, channel: str, values: Array, weight: Array) -> None:
    """Change a material channel of `obj` towards `values`, (n, 3) or (n,), by `weight`, (n,) in [0, 1]."""
    old = present(obj, channel)
    share = weight[:, None] if old.ndim == 2 else weight
    mesh_arrays.write_channel(obj.data, channel, np.where(share == 1, values, old + share * (values - old)))


def mask_of(obj: bpy.types.Object, name: str) -> Array | None:
    """(n,) float32 in [0, 1] of the mask of that name; None where none is named.

    Raises
    ------
    UsageError
        `obj` has no such mask; names it.
    """
    if not name:
        return None
    mask = mesh_arrays.read_mask(obj, obj.data, name)
    if mask is None:
        problem = f'has no vertex group or number of points "{name}"'
        raise UsageError(f'Object "{obj.name}"', problem, "Choose another mask")
    return np.clip(np.nan_to_num(mask), 0, 1)


def present(obj: bpy.types.Object, channel: str) -> Array:
    """A material channel as it is rendered now, without modifiers; see `assets.captured_mesh` for the errors."""
    try:
        values = mesh_arrays.read_channel(obj.data, channel)
    except TypeError:  # an attribute of another kind, which the render does not heed either
        values = None
    return assets.captured_mesh(obj).channel(channel) if values is None else values


CLASSES = (
    DRGS_OT_set_material,
    DRGS_OT_restore_material,
    DRGS_OT_copy_material,
    DRGS_OT_reset_adjustments,
    DRGS_OT_paint,
)
