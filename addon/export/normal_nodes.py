"""A material's normals: the Normal Map and Bump nodes before a shader's Normal input."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, cast

import numpy as np

from .layers import LayerRef
from .socket_value import SocketValue, once
from .sockets import SocketRef
from .texture_nodes import TextureWalker
from .texture_refs import TextureRef

Kind = Literal["tangent", "object", "world", "blender_object", "blender_world", "bump"]


@dataclass(frozen=True, slots=True)
class DetailRef:
    """A normal or bump map; all that materials.SurfaceDetail says.

    Attributes
    ----------
    value : colours or heights
    tangents : UV map that the tangents follow
    source : input that heights come from; None of other kinds
    """

    kind: Kind
    value: SocketValue
    strength: float
    distance: float = 1.0
    tangents: LayerRef = field(default_factory=lambda: LayerRef("uv"))
    source: SocketRef | None = None

    def same(self, other: DetailRef) -> bool:
        """Whether both do the same."""
        return self._facts == other._facts

    @property
    def _facts(self) -> tuple[object, ...]:
        unread = self.source if self.value.texture is None else None
        return (
            self.kind, self.value.texture, tuple(self.value.colour), self.strength, self.distance, self.tangents, unread
        )  # fmt: skip


class NormalWalker(TextureWalker):
    """Evaluates what changes the shading normal."""

    def normal_of(self, output: SocketRef) -> tuple[DetailRef, ...]:
        """What is done to the shading normal of a shader node."""
        return self.normal(output.input("Normal")) if "Normal" in output.node.inputs else ()

    @once(lambda self: ())
    def normal(self, ref: SocketRef) -> tuple[DetailRef, ...]:
        """What a normal input does to the shading normal, first to last."""
        origin = self.origin(ref)
        if not origin.socket.is_output:
            return ()
        evaluate = getattr(self, f"normal_{origin.node.type.lower()}", None)
        if evaluate is None:
            self.warn(origin.node, f"{origin.node.bl_label} is not supported for normals and left out")
            return ()
        found: tuple[DetailRef, ...] = evaluate(origin)
        return found

    def normal_normal_map(self, output: SocketRef) -> tuple[DetailRef, ...]:
        node = output.node
        colour = self.colour(output.input("Color"))
        if getattr(node, "convention", "OPENGL") == "DIRECTX":
            up, down = np.array((1.0, -1.0, 1.0)), np.array((0.0, 1.0, 0.0))
            colour = self.combine(node, lambda c: c * up + down, colour)
        if isinstance(colour.texture, TextureRef):
            colour = replace(colour, texture=replace(colour.texture, data=True))
        strength = self.value(output.input("Strength"))
        return (DetailRef(cast(Kind, node.space.lower()), colour, strength, tangents=LayerRef("uv", node.uv_map)),)

    def normal_bump(self, output: SocketRef) -> tuple[DetailRef, ...]:
        node = output.node
        before = self.normal(output.input("Normal"))
        height = self.number(output.input("Height"))
        if height.texture is None and not height.approximations:  # else a bake may have one
            return before
        if getattr(height.texture, "interpolation", "linear") == "closest":
            self.warn(node, "an image with Closest interpolation has no slopes, and no bumps; choose Linear")
        if isinstance(height.texture, TextureRef):
            height = replace(height, texture=replace(height.texture, data=True))
        distance = self.value(output.input("Distance")) * (-1 if node.invert else 1)
        strength = self.value(output.input("Strength"))
        return (*before, DetailRef("bump", height, strength, distance, source=output.input("Height")))

    def normal_new_geometry(self, output: SocketRef) -> tuple[DetailRef, ...]:
        if output.socket.name != "Normal":
            self.warn(output.node, f"{output.socket.name} is not supported for normals and left out")
        return ()
