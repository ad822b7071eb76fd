"""Blender's lights -> frame.Light."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.frame import Light
from .instances import Visible
from .node_math import rgb
from .nodes import Walker
from .socket_value import SocketValue, once, uniform
from .sockets import SocketRef, hollow, surface_of

Warn = Callable[[str], None]


def export_light(item: Visible, warn: Warn) -> Light | None:
    """Describe a visible instance of a light; None for portals and for what is not finite, which give none."""
    obj, light = item.object, item.object.data
    if light.type == "AREA" and getattr(getattr(light, "cycles", None), "is_portal", False):
        return None
    name = f'Light "{obj.name}"'
    if light.use_custom_distance:
        warn(f"{name}: a custom distance is not rendered; its light goes on")
    colour = np.array(light.color, np.float64)
    if getattr(light, "use_temperature", False):  # from Blender 4.5 on
        colour *= np.array(light.temperature_color)
    if light.use_nodes and light.node_tree is not None:
        colour *= _Tree(light, warn).emission()
    power = light.energy * 2.0 ** getattr(light, "exposure", 0.0)
    kind = light.type.lower()
    shape = _SHAPES[kind](light)
    sizes = [value for value in shape.values() if isinstance(value, float)]
    if not np.isfinite((*colour, power, *sizes)).all():
        warn(f"{name}: its colour, power or size is not finite; it is off. Check its values and their drivers")
        return None
    rays = item.visibility
    return Light(
        name=obj.name,
        kind=kind,
        matrix_world=item.matrix_world,
        colour=rgb(colour),
        power=power,
        normalize=getattr(light, "normalize", True),
        camera=rays.camera,
        diffuse=rays.diffuse,
        glossy=rays.glossy,
        cast_shadow=light.use_shadow,
        light_group=obj.lightgroup,
        **shape,
    )


def _point(light: bpy.types.Light) -> dict[str, Any]:
    return {"radius": light.shadow_soft_size, "soft_falloff": light.use_soft_falloff}


def _spot(light: bpy.types.Light) -> dict[str, Any]:
    return {**_point(light), "spot_size": light.spot_size, "spot_blend": light.spot_blend}


def _area(light: bpy.types.Light) -> dict[str, Any]:
    shape = light.shape.lower()
    height = light.size_y if shape in ("rectangle", "ellipse") else light.size
    return {"shape": shape, "size_x": light.size, "size_y": height, "spread": light.spread}


_SHAPES: dict[str, Callable[[bpy.types.Light], dict[str, Any]]] = {
    "point": _point,
    "sun": lambda light: {"angle": light.angle},
    "spot": _spot,
    "area": _area,
}


class _Tree(Walker):
    """What a light's nodes multiply it with."""

    unknown = 1.0

    def __init__(self, light: bpy.types.Light, warn: Warn) -> None:
        super().__init__(f'Light "{light.name}"', warn)
        self.tree = light.node_tree

    def emission(self) -> np.ndarray:
        """(3,): colour times strength; black without an output, as in Blender."""
        surface = surface_of(self.tree)
        if surface is None:
            return np.zeros(3)
        self.name_lost_groups(self.tree, surface.node)
        return self.shader(surface)

    @once(lambda self: np.ones(3))
    def shader(self, ref: SocketRef) -> np.ndarray:
        """(3,) of a shader input."""
        origin = self.origin(ref)
        if not origin.socket.is_output:
            return np.zeros(3)
        node = origin.node
        if node.type == "EMISSION":
            return self.fixed(origin.input("Color")) * self.value(origin.input("Strength"))
        if node.type == "ADD_SHADER":
            return self.shader(origin.input(0)) + self.shader(origin.input(1))
        if node.type == "MIX_SHADER":
            share = float(np.clip(self.value(origin.input(0)), 0, 1))
            return (1 - share) * self.shader(origin.input(1)) + share * self.shader(origin.input(2))
        problem = hollow(node) if node.type == "GROUP" else f"{node.bl_label} is not supported in a light"
        self.warn(node, f"{problem}; its own colour is used")
        return np.ones(3)

    def node_light_falloff(self, output: SocketRef) -> SocketValue:
        strength = self.number(output.input("Strength"))
        if output.socket.name != "Quadratic" or self.value(output.input("Smooth")) != 0:
            self.warn(output.node, "only the natural, quadratic falloff is rendered")
        return strength

    def node_tex_ies(self, output: SocketRef) -> SocketValue:
        self.warn(output.node, "IES profiles are not rendered; it shines evenly")
        return self.number(output.input("Strength")) if "Strength" in output.node.inputs else uniform(1)

    def node_tex_image(self, output: SocketRef) -> SocketValue:
        self.warn(output.node, "images are not projected by lights; white is used")
        return uniform(1)
