"""A World's node tree -> frame.World: one constant colour or one lat-long image, turned and scaled.

What cannot be expressed is replaced by the nearest that can, with a warning that names the node; never by black.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import bpy
import numpy as np
from mathutils import Euler, Matrix

from ...drgs_blender.errors import UsageError
from ...drgs_blender.frame import World
from .image import forget, linear_pixels

Warn = Callable[[str], None]
Colour = np.ndarray

__all__ = ["export_world", "forget"]

#: Linear light when nothing better is known: the grey of Blender's default world.
FALLBACK = np.full(3, 0.05, np.float32)
#: Luminance weights of Rec.709.
LUMINANCE = np.array((0.2126, 0.7152, 0.0722), np.float32)


@dataclass(slots=True)
class Light:
    """A colour that may depend on direction: ``image(rotation @ d) * colour``; a constant where image is None."""

    colour: Colour = field(default_factory=lambda: np.ones(3, np.float32))
    image: bpy.types.Image | None = None
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    def times(self, factor: Colour | float) -> Light:
        """Scaled."""
        return replace(self, colour=self.colour * np.asarray(factor, np.float32))

    @property
    def weight(self) -> float:
        """How much light it is, roughly; an image counts as white."""
        return float(self.colour @ LUMINANCE)


BLACK = Light(np.zeros(3, np.float32))


def export_world(world: bpy.types.World | None, warn: Warn) -> World:
    """Describe an evaluated world; black without one, as in Blender.

    Raises
    ------
    UsageError
        Colour, strength or rotation are not finite; names the world.
    """
    light = BLACK
    if world is not None:
        light = _Tree(world, warn).light()
    pixels = None
    if light.image is not None:
        pixels = linear_pixels(light.image, warn)
        if pixels is None:
            warn(f'World: image "{light.image.name}" cannot be read; its colour is taken as grey')
            light = light.times(FALLBACK)
    if world is not None:
        light = _usable(light, world.name, warn)
    return World(environment=pixels, rotation=light.rotation, colour=tuple(map(float, light.colour)))


def _usable(light: Light, name: str, warn: Warn) -> Light:
    """`light` without negative parts; UsageError where it is no number."""
    if not (np.isfinite(light.colour).all() and np.isfinite(light.rotation).all()):
        raise UsageError(
            f'World "{name}"',
            "has a colour, strength or rotation that is not finite",
            "Check the values of its nodes and their drivers",
        )
    if (light.colour < 0).any():
        warn(f'World "{name}": its colour times strength is negative; negative light is taken as black')
        return replace(light, colour=np.maximum(light.colour, 0))
    return light


class _Tree:
    """Walks from the output node backwards. Each method names the kind of socket it evaluates."""

    def __init__(self, world: bpy.types.World, warn: Warn) -> None:
        self.world = world
        self._warn = warn

    def warn(self, node: bpy.types.Node, problem: str) -> None:
        self._warn(f'World "{self.world.name}", node "{node.label or node.name}": {problem}')

    def light(self) -> Light:
        tree = self.world.node_tree
        # From Blender 5.0 on every world has nodes, and the switch is deprecated.
        if tree is None or (bpy.app.version < (5, 0, 0) and not self.world.use_nodes):
            return Light(np.array(self.world.color, np.float32))
        output = tree.get_output_node("CYCLES") or tree.get_output_node("ALL")
        if output is None or not output.inputs["Surface"].is_linked:
            return BLACK
        if output.inputs["Volume"].is_linked:
            self.warn(output, "the volume is not rendered")
        return self.shader(_source(output.inputs["Surface"]))

    # Shaders

    def shader(self, socket: bpy.types.NodeSocket | None) -> Light:
        """Light of what feeds a shader socket."""
        if socket is None:
            return BLACK
        node = socket.node
        if node.type in ("BACKGROUND", "EMISSION"):
            return self.colour(node.inputs["Color"]).times(self.value(node.inputs["Strength"]))
        if node.type == "MIX_SHADER":
            return self.mixed(node, *(self.shader(_source(s)) for s in node.inputs[1:3]))
        if node.type == "ADD_SHADER":
            return self.sum(node, *(self.shader(_source(s)) for s in node.inputs[:2]))
        if node.type == "GROUP":
            self.warn(node, "node groups are not followed; ungroup it (Ctrl Alt G)")
        else:
            self.warn(node, f"{node.bl_label} is not supported as light of the world; a dim grey is used")
        return Light(FALLBACK)

    def mixed(self, node: bpy.types.Node, first: Light, second: Light) -> Light:
        """Mix Shader; where the factor tells camera rays from others, what lights the scene counts."""
        factor = _source(node.inputs[0])
        if factor is not None and factor.node.type == "LIGHT_PATH":
            self.warn(node, f'"{factor.name}" cannot be told apart; the light that other rays see is used')
            return first
        return self.sum(node, first.times(1 - (f := self.value(node.inputs[0]))), second.times(f))

    def sum(self, node: bpy.types.Node, first: Light, second: Light) -> Light:
        """Sum of two lights; of two that depend on direction, the stronger."""
        if first.weight == 0:
            return second
        if second.weight == 0:
            return first
        if first.image is None and second.image is None:
            return Light(first.colour + second.colour)
        chosen = first if first.weight >= second.weight else second
        self.warn(node, "two lights cannot be added unless both are plain colours; the stronger one is used")
        return chosen

    # Colours

    def colour(self, socket: bpy.types.NodeSocket) -> Light:
        """Value of a colour socket."""
        source = _source(socket)
        if source is None:
            return Light(_constant(socket))
        node = source.node
        evaluate = getattr(self, f"colour_{node.type.lower()}", None)
        if evaluate is not None:
            return evaluate(node)
        return self.nearest(node)

    def nearest(self, node: bpy.types.Node) -> Light:
        """An unknown colour node: pass on the first colour that goes into it."""
        inputs = [s for s in node.inputs if s.type == "RGBA" and s.enabled]
        linked = [s for s in inputs if s.is_linked]
        if linked:
            self.warn(node, f"{node.bl_label} is not supported and left out")
            return self.colour(linked[0])
        self.warn(node, f"{node.bl_label} is not supported; a plain colour is used. Bake it to an image")
        return Light(_constant(inputs[0]) if inputs else FALLBACK)

    def colour_rgb(self, node: bpy.types.Node) -> Light:
        return Light(_constant(node.outputs[0]))

    def colour_value(self, node: bpy.types.Node) -> Light:
        return Light(_constant(node.outputs[0]))

    def colour_tex_environment(self, node: bpy.types.Node) -> Light:
        if node.image is None:
            self.warn(node, "has no image; Blender shows magenta, a dim grey is used")
            return Light(FALLBACK)
        if node.type == "TEX_ENVIRONMENT" and node.projection != "EQUIRECTANGULAR":
            self.warn(node, "the Mirror Ball projection is read as Equirectangular")
        return Light(image=node.image, rotation=self.rotation(node.inputs["Vector"]))

    def colour_tex_image(self, node: bpy.types.Node) -> Light:
        self.warn(node, "an Image Texture is read as an Environment Texture")
        return self.colour_tex_environment(node)

    def colour_tex_sky(self, node: bpy.types.Node) -> Light:
        self.warn(node, "the sky is replaced by plain light of its usual colour. Bake it to an image")
        return Light(np.array((0.35, 0.55, 1.0), np.float32))

    def colour_mix(self, node: bpy.types.Node) -> Light:
        sockets = {s.identifier: s for s in node.inputs}
        if node.data_type != "RGBA":
            return self.nearest(node)
        return self.blended(node, sockets["Factor_Float"], sockets["A_Color"], sockets["B_Color"])

    def colour_mix_rgb(self, node: bpy.types.Node) -> Light:
        return self.blended(node, *node.inputs[:3])

    def blended(self, node: bpy.types.Node, *sockets: bpy.types.NodeSocket) -> Light:
        """Mix Color: multiply with a constant, or a mixture."""
        factor, first, second = self.value(sockets[0]), self.colour(sockets[1]), self.colour(sockets[2])
        if node.blend_type == "MULTIPLY":
            if second.image is not None and factor == 1:
                first, second = second, first
            if second.image is None:
                return first.times(1 - factor + factor * second.colour)
        elif node.blend_type == "MIX":
            return self.sum(node, first.times(1 - factor), second.times(factor))
        elif node.blend_type == "ADD":
            return self.sum(node, first, second.times(factor))
        self.warn(node, f"blending by {node.blend_type.title()} is not supported; its first colour is used")
        return first

    def colour_vect_math(self, node: bpy.types.Node) -> Light:
        if node.operation == "SCALE":
            return self.colour(node.inputs[0]).times(self.value(node.inputs["Scale"]))
        if node.operation == "MULTIPLY":
            first, second = self.colour(node.inputs[0]), self.colour(node.inputs[1])
            if first.image is None:
                first, second = second, first
            if second.image is None:
                return first.times(second.colour)
        return self.unsupported_vector(node)

    def unsupported_vector(self, node: bpy.types.Node) -> Light:
        self.warn(node, f"{node.operation.title()} is not supported; its first input is used")
        return self.colour(node.inputs[0])

    # Numbers

    def value(self, socket: bpy.types.NodeSocket) -> float:
        """A number that does not depend on direction."""
        source = _source(socket)
        if source is None:
            return float(socket.default_value)
        node = source.node
        if node.type == "VALUE":
            return float(node.outputs[0].default_value)
        if node.type == "MATH" and node.operation in _MATH:
            result = _MATH[node.operation](*(self.value(s) for s in node.inputs[:2]))
            return float(np.clip(result, 0, 1)) if node.use_clamp else float(result)
        own = float(socket.default_value)
        self.warn(node, f"{node.bl_label} is not supported; {own:g} is used for {socket.name}")
        return own

    # Directions

    def rotation(self, socket: bpy.types.NodeSocket) -> np.ndarray:
        """What the nodes before a texture do to the view direction, as a rotation."""
        source = _source(socket)
        if source is None:
            return np.eye(3)
        node = source.node
        if node.type == "TEX_COORD":
            if source.name not in ("Generated", "Object") or node.object is not None:
                self.warn(node, f"{source.name} is read as Generated")
            return np.eye(3)
        if node.type == "NEW_GEOMETRY":
            # Of the background, Position is the direction away from the viewer; Normal and Incoming oppose it.
            return np.eye(3) if source.name == "Position" else -np.eye(3)
        if node.type == "MAPPING":
            return self.mapping(node) @ self.rotation(node.inputs["Vector"])
        if node.type == "VECTOR_ROTATE":
            turn = self.vector_rotate(node)
            if turn is not None:
                return turn @ self.rotation(node.inputs["Vector"])
        inputs = [s for s in node.inputs if s.type == "VECTOR" and s.is_linked]
        self.warn(node, f"{node.bl_label} is not supported between direction and image, and left out")
        return self.rotation(inputs[0]) if inputs else np.eye(3)

    def mapping(self, node: bpy.types.Node) -> np.ndarray:
        """Mapping node; a texture is turned the other way than a point."""
        for name, neutral in (("Location", 0.0), ("Scale", 1.0)):
            values = node.inputs.get(name)
            relevant = values is not None and not (name == "Location" and node.vector_type in ("VECTOR", "NORMAL"))
            if relevant and any(abs(v - neutral) > 1e-6 for v in values.default_value):
                self.warn(node, f"{name} is ignored; only Rotation turns the world")
        if node.inputs["Rotation"].is_linked:
            self.warn(node, "a linked Rotation is not followed; set or drive the value itself")
        turn = np.array(_euler(node.inputs["Rotation"].default_value))
        return turn.T if node.vector_type == "TEXTURE" else turn

    def vector_rotate(self, node: bpy.types.Node) -> np.ndarray | None:
        """Vector Rotate about the origin."""
        kind = node.rotation_type
        if kind == "EULER_XYZ":
            turn = np.array(_euler(node.inputs["Rotation"].default_value))
        else:
            axes = {"X_AXIS": (1, 0, 0), "Y_AXIS": (0, 1, 0), "Z_AXIS": (0, 0, 1)}
            axis = axes.get(kind) or node.inputs["Axis"].default_value
            turn = np.array(Matrix.Rotation(self.value(node.inputs["Angle"]), 3, tuple(axis)))
        if any(abs(v) > 1e-6 for v in node.inputs["Center"].default_value):
            self.warn(node, "Center is ignored")
        return turn.T if node.invert else turn


_MATH: dict[str, Callable[[float, float], float]] = {
    "ADD": lambda a, b: a + b,
    "SUBTRACT": lambda a, b: a - b,
    "MULTIPLY": lambda a, b: a * b,
    "DIVIDE": lambda a, b: a / b if b else 0.0,
    "POWER": lambda a, b: abs(a) ** b,
    "MINIMUM": min,
    "MAXIMUM": max,
}


def _source(socket: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """The output that feeds an input, through reroutes and muted nodes; None when nothing does."""
    while socket.is_linked:
        link = socket.links[0]
        if link.is_muted:
            return None
        node = link.from_node
        if node.type == "REROUTE":
            socket = node.inputs[0]
        elif node.mute and node.internal_links:
            socket = next((i.from_socket for i in node.internal_links if i.to_socket == link.from_socket), None)
            if socket is None:
                return None
        else:
            return link.from_socket
    return None


def _constant(socket: bpy.types.NodeSocket) -> Colour:
    """Default value of a colour, vector or number socket as linear RGB."""
    value = socket.default_value
    return np.array(value[:3], np.float32) if hasattr(value, "__len__") else np.full(3, value, np.float32)


def _euler(angles: bpy.types.bpy_prop_array) -> Matrix:
    return Euler(tuple(angles), "XYZ").to_matrix()
