"""What a surface scatters: Blender's BSDFs with their weights, mixed and added."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from .layers import LayerRef
from .normal_nodes import DetailRef, NormalWalker
from .socket_value import SocketValue, uniform

#: Kinds whose colour is a factor of all their light.
_COLOURED = ("diffuse", "glossy", "glass", "refraction", "translucent", "sheen")
#: More parts than that are not told apart.
_MOST_PARTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Bsdf:
    """One BSDF.

    Attributes
    ----------
    kind : as of materials.Material
    values : by field of materials.Material; what is missing is at its default
    switches : fields of materials.Material that are true
    tangent : layer that its highlights follow
    leaves : its nodes, as of `bakes.node_trees.leaf_of`
    """

    kind: str
    values: dict[str, SocketValue]
    switches: frozenset[str] = frozenset()
    tangent: LayerRef | None = None
    leaves: tuple[tuple[str, str], ...] = ()

    def has(self, name: str) -> bool:
        """Whether a value is given and not zero everywhere."""
        return not self.values.get(name, uniform(0)).black

    def is_linear(self, name: str) -> bool:
        """Whether the light of the BSDF is a linear function of a value, as far as that is known.

        It is none of a colour where light meets a surface several times, and is coloured each time: of Multiscatter GGX
        metals and of rough diffuse surfaces; nor of metals brighter than white.
        """
        if name == "base_colour":
            bright = self.kind == "principled" and bool((self.values[name].colour > 1).any())
            metal = self.has("metallic") and (bright or "multiscatter" in self.switches)
            return not (metal or self.has("diffuse_roughness") or self.has("transmission"))
        if name == "coat":
            tint = self.values.get("coat_tint", uniform(1))
            return tint.texture is None and bool((tint.colour == 1).all()) and not self.has("sheen")
        return name in ("metallic", "sheen", "transmission")

    def difference(self, other: Bsdf) -> set[str] | None:
        """Names of the values in which both differ; None where they differ in more than values."""
        if (self.kind, self.switches, self.tangent) != (other.kind, other.switches, other.tangent):
            return None
        if self.values.keys() != other.values.keys():
            return None
        return {name for name, value in self.values.items() if not value.same(other.values[name])}


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A BSDF with its weight: `weight`, or its colour times one minus its texture."""

    bsdf: Bsdf
    weight: SocketValue = field(default_factory=lambda: uniform(1))
    inverted: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether the weight is 1."""
        return self.weight.texture is None and bool(np.allclose(self.weight.colour, 1, rtol=1e-9))


@dataclass(slots=True)
class Surface:
    """Result of a shader.

    Attributes
    ----------
    parts : what scatters light, of the part that is there
    emission : light given off by the part that is there
    alpha : share that is there; light passes the rest
    """

    parts: tuple[Part, ...] = ()
    emission: SocketValue = field(default_factory=lambda: uniform(0))
    alpha: SocketValue = field(default_factory=lambda: uniform(1))
    details: tuple[DetailRef, ...] = ()


def _texts(*values: SocketValue) -> tuple[str, ...]:
    """What is approximated in any of the values."""
    return tuple(dict.fromkeys(text for value in values for text in value.approximations))


class MixingWalker(NormalWalker):
    """Joins the surfaces of shaders."""

    def mixed(self, node: bpy.types.Node, first: Surface, second: Surface, share: SocketValue) -> Surface:
        """`share` of the second surface, the rest of the first."""
        rest, inverted = self.complement(node, share)
        return Surface(
            self.merged(
                node,
                [self.weighed(node, part, rest, inverted) for part in first.parts],
                [self.weighed(node, part, share) for part in second.parts],
            ),
            uniform(0)
            if first.emission.black and second.emission.black
            else self.combine(node, lambda f, a, b: a * (1 - f) + b * f, share, first.emission, second.emission),
            details=self.stronger_details(node, first, second, share),
        )

    def added(self, node: bpy.types.Node, first: Surface, second: Surface, one: float, two: float) -> Surface:
        """`one` times the first surface and `two` times the second."""
        return Surface(
            self.merged(
                node,
                [self.weighed(node, part, uniform(one)) for part in first.parts],
                [self.weighed(node, part, uniform(two)) for part in second.parts],
            ),
            self.combine(node, np.add, first.emission.times(one), second.emission.times(two)),
            details=self.stronger_details(node, first, second, uniform(two / (one + two))),
        )

    def complement(self, node: bpy.types.Node, share: SocketValue) -> tuple[SocketValue, bool]:
        """One minus a share, and whether that is left to `Part.inverted`."""
        if share.texture is not None and np.allclose(share.colour, 1):
            return share, True
        return self.combine(node, lambda f: 1 - f, share), False

    def weighed(self, node: bpy.types.Node, part: Part, factor: SocketValue, inverted: bool = False) -> Part:
        """A part times a factor."""
        texts = _texts(part.weight, factor)
        if factor.texture is None:
            return replace(part, weight=replace(part.weight.times(factor.colour), approximations=texts))
        if part.weight.texture is None:
            return Part(part.bsdf, replace(factor.times(part.weight.colour), approximations=texts), inverted)
        own = self.plain(node, part)
        other = self.combine(node, lambda f: 1 - f, factor) if inverted else factor
        return Part(part.bsdf, self.combine(node, np.multiply, own, other))

    def plain(self, node: bpy.types.Node, part: Part) -> SocketValue:
        """The weight of a part as a value."""
        if not part.inverted:
            return part.weight
        texture = replace(part.weight, colour=np.ones(3))
        return self.combine(node, lambda f: part.weight.colour * (1 - f), texture)

    def mean_weight(self, part: Part) -> float:
        if part.weight.texture is None:
            return float(part.weight.colour.mean())
        mean = self.mean(part.weight.texture)
        return float((part.weight.colour * (1 - mean if part.inverted else mean)).mean())

    def merged(self, node: bpy.types.Node, first: list[Part], second: list[Part]) -> tuple[Part, ...]:
        """All parts, those as one that are as one."""
        parts = [part for part in first if not part.weight.black]
        for part in second:
            if part.weight.black:
                continue
            for i, known in enumerate(parts):
                if (one := self.as_one(node, known, part)) is not None:
                    parts[i] = one
                    break
            else:
                parts.append(part)
        if len(parts) > _MOST_PARTS:
            self.note(node, f"more than {_MOST_PARTS} shaders are mixed; the weakest are left out")
            parts = sorted(parts, key=self.mean_weight, reverse=True)[:_MOST_PARTS]
        return tuple(parts)

    def as_one(self, node: bpy.types.Node, first: Part, second: Part) -> Part | None:
        """Two parts as one; None where no single BSDF scatters the same light."""
        a, b = first.bsdf, second.bsdf
        names = a.difference(b)
        if names is None or len(names) > 1 or not all(a.is_linear(n) and b.is_linear(n) for n in names):
            return None
        one, two = first.weight, second.weight
        texts = _texts(one, two)
        if one.texture is None and two.texture is None:
            sum_ = one.colour + two.colour
            share, weight = SocketValue(two.colour / sum_, None, texts), SocketValue(sum_, None, texts)
        elif one.same(two) and first.inverted != second.inverted:
            share, weight = SocketValue(np.ones(3), two.texture, texts), uniform(one.colour)
            if second.inverted:
                a, b = b, a
        else:
            return None
        values = dict(a.values)
        for name in names:
            values[name] = self.combine(
                node, lambda f, x, y: x * (1 - f) + y * f, share, a.values[name], b.values[name]
            )
        leaves = tuple(dict.fromkeys(a.leaves + b.leaves))
        return Part(replace(a, values=values, leaves=leaves), weight)

    def settled(self, node: bpy.types.Node, surface: Surface) -> Surface:
        """With the weight of a lone part in its colour, where that is the same."""
        if len(surface.parts) != 1 or surface.parts[0].is_whole:
            return surface
        (part,) = surface.parts
        if part.bsdf.kind not in _COLOURED or not part.bsdf.is_linear("base_colour"):
            return surface
        base = self.combine(node, np.multiply, part.bsdf.values["base_colour"], self.plain(node, part))
        bsdf = replace(part.bsdf, values=part.bsdf.values | {"base_colour": base})
        return replace(surface, parts=(Part(bsdf),))

    def stronger_details(
        self, node: bpy.types.Node, first: Surface, second: Surface, share: SocketValue
    ) -> tuple[DetailRef, ...]:
        """Normal and bump maps of the surface that scatters more, for both."""
        mean = float(share.colour[0] * (1 if share.texture is None else self.mean(share.texture)[0]))
        weights = [
            part * sum(self.mean_weight(p) for p in surface.parts)
            for part, surface in ((1 - mean, first), (mean, second))
        ]
        more = first if weights[0] >= weights[1] else second
        alike = len(first.details) == len(second.details) and all(map(DetailRef.same, first.details, second.details))
        if min(weights) > 0 and not alike:
            self.warn(node, "its shaders have other normal or bump maps; those of the stronger one are used for both")
        return more.details if max(weights) > 0 else ()
