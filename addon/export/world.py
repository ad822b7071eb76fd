"""A World's node tree -> frame.World: one constant colour or one lat-long image, turned and scaled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.frame import World
from .images import linear_pixels
from .node_math import rgb
from .nodes import Walker, euler, vector_rotate
from .socket_value import SocketValue, once, uniform
from .sockets import SocketRef, surface_of

Warn = Callable[[str], None]

#: Linear light when nothing better is known: the grey of Blender's default world.
FALLBACK = 0.05
BLACK = uniform(0)


@dataclass(frozen=True, slots=True)
class Sky:
    """An image around the scene, ``image(rotation @ d)``; the rotation as a tuple of rows."""

    image: bpy.types.Image
    rotation: tuple[tuple[float, ...], ...]


def export_world(world: bpy.types.World | None, warn: Warn) -> World:
    """Describe an evaluated world; black without one, as in Blender.

    Raises
    ------
    UsageError
        Colour, strength or rotation are not finite; names the world.
    """
    light = BLACK if world is None else _Tree(world, warn).light()
    pixels, rotation = None, np.eye(3)
    if world is not None and isinstance(light.texture, Sky):
        pixels, rotation = linear_pixels(light.texture.image, warn), np.array(light.texture.rotation)
        if pixels is None:
            warn(
                f'World "{world.name}": image "{light.texture.image.name}" cannot be read; its colour is taken as '
                "grey. Choose File > External Data > Find Missing Files, or another image"
            )
            light = SocketValue(light.colour * FALLBACK)
    colour = light.colour
    if world is not None:
        colour = _usable(colour, rotation, world.name, warn)
        _check_rays(world, warn)
    return World(environment=pixels, rotation=rotation, colour=rgb(colour))


def _check_rays(world: bpy.types.World, warn: Warn) -> None:
    """Say where rays are not to see the world, by Cycles' settings of it: here all do."""
    # The add-on Cycles may be off, and until Blender 5 an evaluated world has these as they were.
    rays = getattr(world.original, "cycles_visibility", None)
    blind = [name for name in ("camera", "diffuse", "glossy") if rays is not None and not getattr(rays, name)]
    if blind:
        hint = "; Film > Transparent hides it from the camera" if "camera" in blind else ""
        warn(f'World "{world.name}": its Ray Visibility is ignored, {" and ".join(blind)} rays see it{hint}')


def _usable(colour: np.ndarray, rotation: np.ndarray, name: str, warn: Warn) -> np.ndarray:
    """`colour` without negative parts; UsageError where something is no number."""
    if not (np.isfinite(colour).all() and np.isfinite(rotation).all()):
        raise UsageError(
            f'World "{name}"',
            "has a colour, strength or rotation that is not finite",
            "Check the values of its nodes and their drivers",
        )
    if (colour < 0).any():
        warn(f'World "{name}": its colour times strength is negative; negative light is taken as black')
    return np.maximum(colour, 0)


class _Tree(Walker):
    """What a world's nodes say of light that comes from afar."""

    unknown = FALLBACK

    def __init__(self, world: bpy.types.World, warn: Warn) -> None:
        super().__init__(f'World "{world.name}"', warn)
        self.world = world

    def light(self) -> SocketValue:
        """Light of the world."""
        tree = self.world.node_tree
        # From Blender 5.0 on every world has nodes, and the switch is deprecated.
        if tree is None or (bpy.app.version < (5, 0, 0) and not self.world.use_nodes):
            return SocketValue(np.array(self.world.color, np.float64))
        surface = surface_of(tree)
        if surface is None:
            return BLACK
        if surface.node.inputs["Volume"].is_linked:
            self.warn(surface.node, "the volume is not rendered")
        return self.shader(surface)

    def mean(self, texture: Any) -> np.ndarray:
        pixels = linear_pixels(texture.image, self._warn)
        if pixels is None:
            return np.full(3, FALLBACK)
        rows = np.where(np.isfinite(pixels), pixels, 0).mean(axis=1, dtype=np.float64)
        height = len(rows)
        return np.average(rows, axis=0, weights=np.sin((np.arange(height) + 0.5) / height * np.pi))

    # Shaders

    @once(lambda self: uniform(self.unknown))
    def shader(self, ref: SocketRef) -> SocketValue:
        """Light of a shader input."""
        origin = ref.origin()
        if not origin.socket.is_output:
            return BLACK
        node = origin.node
        if node.type in ("BACKGROUND", "EMISSION"):
            operands = self.colour(origin.input("Color")), self.number(origin.input("Strength"))
            return self.combine(node, np.multiply, *operands)
        if node.type == "MIX_SHADER":
            factor = origin.input(0).origin()
            shaders = self.shader(origin.input(1)), self.shader(origin.input(2))
            if factor.socket.is_output and factor.node.type == "LIGHT_PATH":
                self.warn(node, f'"{factor.socket.name}" is not evaluated per ray: what other rays see is used')
                return shaders[0]
            share = float(np.clip(self.value(origin.input(0)), 0, 1))
            return self.sum(node, shaders[0].times(1 - share), shaders[1].times(share))
        if node.type == "ADD_SHADER":
            return self.sum(node, self.shader(origin.input(0)), self.shader(origin.input(1)))
        self.warn(node, f"{node.bl_label} is not supported as light of the world; a dim grey is used")
        return uniform(FALLBACK)

    def sum(self, node: bpy.types.Node, first: SocketValue, second: SocketValue) -> SocketValue:
        """Sum of two lights."""
        return self.combine(node, np.add, first, second)

    # Textures

    def node_tex_environment(self, output: SocketRef) -> SocketValue:
        node = output.node
        if node.image is None:
            self.warn(node, "has no image; Blender shows magenta, a dim grey is used. Choose one")
            return uniform(FALLBACK)
        if node.type == "TEX_ENVIRONMENT" and node.projection != "EQUIRECTANGULAR":
            self.warn(node, "the Mirror Ball projection is read as Equirectangular")
        if node.interpolation != "Linear":
            self.warn(node, f"{node.interpolation} interpolation is read as Linear")
        turn = self.rotation(output.input("Vector"))
        return SocketValue(np.ones(3), Sky(node.image, tuple(map(tuple, turn.tolist()))))

    def node_tex_image(self, output: SocketRef) -> SocketValue:
        self.warn(output.node, "an Image Texture is read as an Environment Texture")
        return self.node_tex_environment(output)

    def node_tex_sky(self, output: SocketRef) -> SocketValue:
        self.warn(output.node, "the sky is replaced by plain light of its usual colour. Bake it to an image")
        return SocketValue(np.array((0.35, 0.55, 1.0)))

    # Directions

    def rotation(self, ref: SocketRef) -> np.ndarray:
        """Rotation of the view direction by the nodes before a texture."""
        origin = ref.origin()
        if not origin.socket.is_output:
            return np.eye(3)
        node, name = origin.node, origin.socket.name
        if node.type == "TEX_COORD":
            if name not in ("Generated", "Object") or node.object is not None:
                self.warn(node, f"{name} is read as Generated")
            return np.eye(3)
        if node.type == "NEW_GEOMETRY":
            # Of the background, Position is the direction away from the viewer; Normal and Incoming oppose it.
            return np.eye(3) if name == "Position" else -np.eye(3)
        if node.type == "MAPPING":
            return self.mapping(origin) @ self.rotation(origin.input("Vector"))
        if node.type == "VECTOR_ROTATE":
            if np.abs(self.fixed(origin.input("Center"))).max() > 1e-6:
                self.warn(node, "Center is ignored")
            return vector_rotate(self, origin) @ self.rotation(origin.input("Vector"))
        inputs = [s for s in node.inputs if s.type == "VECTOR" and s.is_linked]
        self.warn(node, f"{node.bl_label} is not supported between direction and image, and left out")
        return self.rotation(SocketRef(inputs[0], origin.groups)) if inputs else np.eye(3)

    def mapping(self, output: SocketRef) -> np.ndarray:
        """Mapping node; a texture is turned the other way than a point."""
        node = output.node
        for name, neutral in (("Location", 0.0), ("Scale", 1.0)):
            relevant = not (name == "Location" and node.vector_type in ("VECTOR", "NORMAL"))
            if relevant and np.abs(self.fixed(output.input(name)) - neutral).max() > 1e-6:
                self.warn(node, f"{name} is ignored; only Rotation turns the world")
        turn = euler(self.fixed(output.input("Rotation")))
        return turn.T if node.vector_type == "TEXTURE" else turn
