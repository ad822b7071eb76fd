"""Walking back through shader nodes: from a socket to the constant, or the scaled texture, that feeds it.

What worlds, materials and lights share. Colours are linear Rec.709; numbers are colours of three equal parts. What
cannot be expressed is replaced by the nearest that can, with a warning that names the node; never by black.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Hashable
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Matrix

from ...drgs_blender.core.color import LUMINANCE as REC709
from ..bakes import node_trees
from .node_math import BLENDS, OPERATIONS, blackbody, by_row, divide, hsl, hsv, hue_saturation, in_system
from .socket_value import Array, SocketValue, Warn, constant, once, tracked, uniform
from .sockets import SocketRef, hollow

#: Luminance weights of Rec.709.
LUMINANCE = np.array(REC709)
#: Colours with which a function is probed for being a plain scaling of each channel.
_PROBES = np.array(((0.9, 0.6, 0.3), (0.2, 0.5, 0.8), (0.04, 0.02, 0.07)))


class Walker:
    """Evaluates the sockets of one node tree. A method ``node_<type>`` gives the value of an output of such nodes."""

    #: Grey for a colour that nothing is known of.
    unknown = 0.5

    def __init__(self, owner: str, warn: Warn, approximate: Warn | None = None) -> None:
        """`approximate` is called with what is not exact and a bake can do better; `warn` with everything else."""
        self.owner = owner
        self._warn = warn
        self._approximate = approximate or warn
        self._warned: set[str] = set()
        #: Of the value that is worked out now, see `tracked`.
        self.approximated: tuple[str, ...] = ()
        self.found: dict[tuple[str, SocketRef], Any] = {}
        self.depth = 0

    def warn(self, node: bpy.types.Node, problem: str) -> None:
        """Say once how a node is approximated."""
        self.approximated = (*self.approximated, self._say(node, problem, self._approximate))

    def note(self, node: bpy.types.Node, problem: str, approximated: bool = False) -> None:
        """Say once what is wrong with a node, and stays so when it is baked, as it is where it is `approximated`."""
        self._say(node, problem, self._warn)
        if approximated:  # not by the text itself, which a bake would withdraw
            self.approximated = (*self.approximated, problem)

    def _say(self, node: bpy.types.Node, problem: str, say: Warn) -> str:
        text = f'{self.owner}, node "{node.label or node.name}": {problem}'
        if text not in self._warned:
            self._warned.add(text)
            say(text)
        return text

    def name_lost_groups(self, tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        """Name group nodes without a group in all trees behind an output: no sockets are left that lead to them."""
        for each in node_trees.trees(tree, output):
            for node in each.tree.nodes:
                if node.type == "GROUP" and node.node_tree is None:
                    within = "" if each.tree.is_embedded_data else f' (in "{each.tree.name}")'
                    self.note(
                        node, f"{hollow(node)}{within}; what it fed is as if unlinked. Choose one, or remove the node"
                    )

    # What a subclass knows of its textures

    def mean(self, texture: Hashable) -> Array:
        """(3,) mean colour of a texture."""
        raise TypeError(f"{self.owner} has no textures")

    def channel(self, texture: Hashable, name: str) -> Hashable | None:
        """The texture reduced to "r", "g", "b" or "luminance"; None where there is no such thing."""
        return None

    def curved(self, texture: Hashable, function: Callable[[Array], Array]) -> SocketValue | None:
        """The texture with `function` of (n, 3) colours done to its values; None where that cannot be."""
        return None

    # Sockets

    def origin(self, ref: SocketRef) -> SocketRef:
        """What feeds an input; a link that Blender cannot follow is named."""
        found = ref.origin()
        if found.is_cut:
            self.note(found.node, f'the link to "{found.socket.name}" is part of a loop; it is left out')
        return found

    @tracked
    @once(lambda self: uniform(self.unknown))
    def colour(self, ref: SocketRef) -> SocketValue:
        """Value of a colour or vector input."""
        origin = self.origin(ref)
        if not origin.socket.is_output:
            return SocketValue(constant(origin.socket))
        evaluate = getattr(self, f"node_{origin.node.type.lower()}", None)
        return evaluate(origin) if evaluate is not None else self.nearest(origin, ref)

    @tracked
    def number(self, ref: SocketRef) -> SocketValue:
        """Value of a number input; of a colour its luminance, of a vector its mean."""
        value, source = self.colour(ref), ref.origin()
        if not source.socket.is_output or source.socket.type == "VALUE":
            return value
        if source.socket.type == "VECTOR":
            return uniform(self.flat(source.node, value).mean())
        return self.grey(source.node, value)

    def fixed(self, ref: SocketRef) -> Array:
        """(3,): an input that must not vary over the surface."""
        value = self.colour(ref)
        return self.flat(ref.origin().node, value)

    def value(self, ref: SocketRef) -> float:
        """A number that must not vary over the surface."""
        return float(self.flat(ref.origin().node, self.number(ref))[0])

    def flat(self, node: bpy.types.Node, value: SocketValue) -> Array:
        """(3,): the mean of a value."""
        if value.texture is None:
            return value.colour
        self.warn(node, "a texture cannot vary this; its mean is used")
        return value.colour * self.mean(value.texture)

    def grey(self, node: bpy.types.Node, value: SocketValue) -> SocketValue:
        """Luminance."""
        if value.texture is None:
            return uniform(value.colour @ LUMINANCE)
        texture = self.channel(value.texture, "luminance")
        if texture is None:
            return uniform(self.flat(node, value) @ LUMINANCE)
        if texture == value.texture or np.ptp(value.colour) < 1e-6:
            return SocketValue(uniform(value.colour @ LUMINANCE).colour, texture)
        self.warn(node, "the luminance of a tinted image is that of the image, scaled")
        mean = self.mean(value.texture)
        return SocketValue(uniform((value.colour * mean) @ LUMINANCE / max(mean @ LUMINANCE, 1e-9)).colour, texture)

    def part(self, node: bpy.types.Node, value: SocketValue, index: int) -> SocketValue:
        """Red, green or blue."""
        if value.texture is None:
            return uniform(value.colour[index])
        texture = self.channel(value.texture, "rgb"[index])
        if texture is None:
            return uniform(self.flat(node, value)[index])
        return SocketValue(uniform(value.colour[index]).colour, texture)

    @tracked
    def combine(self, node: bpy.types.Node, function: Callable[..., Array], *values: SocketValue) -> SocketValue:
        """`function` of (..., 3) arrays for values.

        Exact for constants, where the result is a scaled texture, and where the texture takes curves. Else the texture
        with the most influence stays, scaled so that the mean is right; where the result falls as the texture rises,
        the mean alone.
        """
        textures = dict.fromkeys(p.texture for p in values if p.texture is not None and not p.black)

        def at(levels: dict[Hashable, Array]) -> Array:
            return np.asarray(function(*(p.colour * levels.get(p.texture, 0 if p.texture else 1) for p in values)))

        if not textures:
            return uniform(at({}))
        if len(textures) == 1:
            (texture,) = textures
            zero, *probed = (at({texture: level}) for level in (np.zeros(3), *_PROBES))
            scales = np.array(probed) / _PROBES
            if not zero.any() and np.allclose(scales, scales[0], rtol=1e-5, atol=1e-7):
                return SocketValue(scales[0], texture)
        means = {t: self.mean(t) for t in textures}
        whole = at(means)
        influence = {t: np.abs(whole - at({**means, t: np.zeros(3)})).max() for t in textures}
        texture = max(influence, key=lambda t: influence[t])
        if influence[texture] < 1e-6:
            return uniform(whole)
        if len(textures) > 1 and sorted(influence.values())[-2] < 1e-6:
            return self.combine(node, function, *(_fixed_but(p, texture, means) for p in values))
        curved = self.curved(texture, lambda value: at({**means, texture: value}))
        if curved is not None:
            if len(textures) > 1:
                self.warn(node, "of several images the one with the most influence stays, the mean of the others")
            return curved
        halved = at({**means, texture: means[texture] / 2})
        if whole.sum() < halved.sum():
            self.warn(node, "this cannot be done to an image; the mean colour is used. Bake it to an image")
            return uniform(whole)
        self.warn(node, "this cannot be done to an image exactly; the image is scaled to the right mean")
        mean = means[texture]
        return SocketValue(np.where(mean > 1e-9, whole / np.maximum(mean, 1e-9), 1.0), texture)

    def nearest(self, origin: SocketRef, ref: SocketRef) -> SocketValue:
        """An unknown node: its first linked colour, the mean of its own colours, or what the input is without it."""
        node = origin.node
        if node.type == "GROUP":
            self.note(node, f"{hollow(node)}; it is black in Cycles. Mend or replace it", approximated=True)
            return uniform(self.unknown)
        colours = [SocketRef(s, origin.groups) for s in node.inputs if s.type == "RGBA" and s.enabled]
        linked = [c for c in colours if c.socket.is_linked]
        if linked:
            self.warn(node, f"{node.bl_label} is not supported and left out")
            return self.colour(linked[0])
        if origin.socket.type == "RGBA" or node.type.startswith("TEX_"):
            self.warn(node, f"{node.bl_label} is not supported; a plain colour is used. Bake it to an image")
            if origin.socket.type == "RGBA" and colours:
                return uniform(np.mean([constant(c.socket) for c in colours], axis=0))
            return uniform(self.unknown)
        own = constant(ref.socket) if hasattr(ref.socket, "default_value") else np.full(3, self.unknown)
        text = f"{own[0]:g}" if ref.socket.type == "VALUE" else "a plain colour"
        self.warn(node, f"{node.bl_label} is not supported; {text} is used for {ref.socket.name}")
        return uniform(own)

    # Nodes

    def node_rgb(self, output: SocketRef) -> SocketValue:
        return SocketValue(constant(output.socket))

    node_value = node_rgb

    def node_blackbody(self, output: SocketRef) -> SocketValue:
        return SocketValue(blackbody(self.value(output.input("Temperature"))))

    def node_mix(self, output: SocketRef) -> SocketValue:
        node, inputs = output.node, output.inputs()
        kind = {"FLOAT": "Float", "VECTOR": "Vector", "RGBA": "Color"}.get(node.data_type)
        if kind is None:
            return self.nearest(output, output)
        apart = kind == "Vector" and node.factor_mode == "NON_UNIFORM"
        factor = self.colour(inputs["Factor_Vector"]) if apart else self.number(inputs["Factor_Float"])
        evaluate = self.number if kind == "Float" else self.colour
        operands = evaluate(inputs[f"A_{kind}"]), evaluate(inputs[f"B_{kind}"])
        blend = node.blend_type if kind == "Color" else "MIX"
        return self.blended(node, blend, node.clamp_factor, node.clamp_result, factor, *operands)

    def node_mix_rgb(self, output: SocketRef) -> SocketValue:
        node = output.node
        operands = self.number(output.input(0)), self.colour(output.input(1)), self.colour(output.input(2))
        return self.blended(node, node.blend_type, True, node.use_clamp, *operands)

    def blended(
        self,
        node: bpy.types.Node,
        kind: str,
        clamp_factor: bool,
        clamp: bool,
        factor: SocketValue,
        a: SocketValue,
        b: SocketValue,
    ) -> SocketValue:
        """Mix Color: from `a` to what `kind` makes of both."""
        if kind not in BLENDS:
            self.warn(node, f"blending by {kind.title()} is not supported; its first colour is used")
            return a

        def mix(f: Array, x: Array, y: Array) -> Array:
            f = np.clip(f, 0, 1) if clamp_factor else f
            mixed = x + f * (BLENDS[kind](x, y) - x)
            return np.clip(mixed, 0, 1) if clamp else mixed

        return self.combine(node, mix, factor, a, b)

    def node_math(self, output: SocketRef) -> SocketValue:
        node = output.node
        if node.operation not in OPERATIONS:
            return self.first_input(output)
        count, function = OPERATIONS[node.operation]
        operands = [self.number(output.input(i)) for i in range(count)]
        return self.combine(node, (lambda *v: np.clip(function(*v), 0, 1)) if node.use_clamp else function, *operands)

    def node_vect_math(self, output: SocketRef) -> SocketValue:
        node = output.node
        if node.operation == "SCALE":
            scale = self.number(output.input("Scale"))
            return self.combine(node, np.multiply, self.colour(output.input(0)), scale)
        if node.operation not in OPERATIONS or OPERATIONS[node.operation][0] > 2:
            return self.first_input(output)
        count, function = OPERATIONS[node.operation]
        return self.combine(node, function, *(self.colour(output.input(i)) for i in range(count)))

    def first_input(self, output: SocketRef) -> SocketValue:
        """Pass on what goes into an operation that is not known."""
        self.warn(output.node, f"{output.node.operation.title()} is not supported; its first input is used")
        return self.colour(output.input(0))

    def node_clamp(self, output: SocketRef) -> SocketValue:
        operands = [self.number(output.input(i)) for i in range(3)]
        return self.combine(output.node, np.clip, *operands)

    def node_map_range(self, output: SocketRef) -> SocketValue:
        node = output.node
        if node.data_type != "FLOAT" or node.interpolation_type != "LINEAR":
            return self.nearest(output, output)

        def mapped(v: Array, from_min: Array, from_max: Array, to_min: Array, to_max: Array) -> Array:
            span = from_max - from_min
            part = divide(v - from_min, span)
            return to_min + (np.clip(part, 0, 1) if node.clamp else part) * (to_max - to_min)

        names = ("Value", "From Min", "From Max", "To Min", "To Max")
        inputs = output.inputs()
        return self.combine(node, mapped, *(self.number(inputs[name]) for name in names))

    def node_gamma(self, output: SocketRef) -> SocketValue:
        operands = self.colour(output.input("Color")), self.number(output.input("Gamma"))
        return self.combine(output.node, lambda c, g: np.maximum(c, 0) ** g, *operands)

    def node_invert(self, output: SocketRef) -> SocketValue:
        operands = self.number(output.input(0)), self.colour(output.input("Color"))
        return self.combine(output.node, lambda f, c: c + f * (1 - 2 * c), *operands)

    def node_brightcontrast(self, output: SocketRef) -> SocketValue:
        operands = (self.colour(output.input(0)), self.number(output.input(1)), self.number(output.input(2)))
        return self.combine(output.node, lambda c, b, k: np.maximum((1 + k) * c + b - k / 2, 0), *operands)

    def node_hue_sat(self, output: SocketRef) -> SocketValue:
        inputs = output.inputs()
        operands = [self.number(inputs[name]) for name in ("Hue", "Saturation", "Value", "Fac")]
        return self.combine(output.node, hue_saturation, *operands, self.colour(inputs["Color"]))

    def node_curve_rgb(self, output: SocketRef) -> SocketValue:
        mapping = output.node.mapping
        mapping.initialize()

        @by_row
        def curved(f: Array, colour: Array) -> Array:
            once = [mapping.evaluate(mapping.curves[3], c) for c in colour]
            twice = np.array([mapping.evaluate(mapping.curves[i], c) for i, c in enumerate(once)])
            return colour + f * (twice - colour)

        return self.combine(output.node, curved, self.number(output.input(0)), self.colour(output.input("Color")))

    def node_valtorgb(self, output: SocketRef) -> SocketValue:
        ramp, alpha = output.node.color_ramp, output.socket.name == "Alpha"

        @by_row
        def ramped(f: Array) -> Array:
            return np.array([ramp.evaluate(v)[3 if alpha else i] for i, v in enumerate(f)])

        return self.combine(output.node, ramped, self.number(output.input(0)))

    def node_rgbtobw(self, output: SocketRef) -> SocketValue:
        return self.grey(output.node, self.colour(output.input(0)))

    def node_separate_color(self, output: SocketRef) -> SocketValue:
        node, colour = output.node, self.colour(output.input(0))
        index = list(node.outputs).index(output.socket)
        mode = getattr(node, "mode", "RGB")
        if mode == "RGB":
            return self.part(node, colour, index)
        return uniform((hsv if mode == "HSV" else hsl)(self.flat(node, colour))[index])

    node_seprgb = node_sepxyz = node_separate_color

    def node_combine_color(self, output: SocketRef) -> SocketValue:
        mode = getattr(output.node, "mode", "RGB")

        @by_row
        def joined(r: Array, g: Array, b: Array) -> Array:
            values = np.array((r[0], g[1], b[2]))
            if mode == "HSL":
                return in_system(colorsys.hls_to_rgb, values[[0, 2, 1]])
            return in_system(colorsys.hsv_to_rgb, values) if mode == "HSV" else values

        return self.combine(output.node, joined, *(self.number(output.input(i)) for i in range(3)))

    node_combrgb = node_combxyz = node_combine_color


def _fixed_but(value: SocketValue, texture: Hashable, means: dict[Hashable, Array]) -> SocketValue:
    """`value`, flattened to its mean unless it has this texture."""
    if value.texture is None or value.texture == texture:
        return value
    return SocketValue(value.colour * means.get(value.texture, 0))


def euler(angles: Array) -> Array:
    """(3, 3) rotation of XYZ Euler angles."""
    return np.array(Euler(tuple(angles), "XYZ").to_matrix())


def vector_rotate(walker: Walker, output: SocketRef) -> Array:
    """(3, 3) rotation of a Vector Rotate node, about the origin."""
    node = output.node
    if node.rotation_type == "EULER_XYZ":
        turn = euler(walker.fixed(output.input("Rotation")))
    else:
        axes = {"X_AXIS": (1, 0, 0), "Y_AXIS": (0, 1, 0), "Z_AXIS": (0, 0, 1)}
        axis = axes.get(node.rotation_type) or walker.fixed(output.input("Axis"))
        turn = np.array(Matrix.Rotation(walker.value(output.input("Angle")), 3, tuple(axis)))
    return turn.T if node.invert else turn
