"""A material's nodes -> materials.Material: colours and numbers, each times an image where there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.materials import TEXTURED, Image, Material, Part, ShaderAOV, SurfaceDetail, Texture
from ...drgs_blender.core.passes import Pass
from ..bakes.node_trees import COLOURS, Leaves
from .aov_nodes import aov_values
from .bsdfs import Bsdf, Surface
from .layers import AttributeRef, LayerRef
from .node_math import rgb
from .normal_nodes import DetailRef
from .socket_value import SocketValue, Warn, uniform
from .surface_bake import BakedRef, SurfaceBakes
from .surface_nodes import SurfaceWalker
from .texture_refs import TextureRef


@dataclass(frozen=True, slots=True)
class ExportedMaterial:
    """An exported material; ``material`` None is an invisible one.

    Attributes
    ----------
    uv_map : UV map that is the mesh's own, "" the active one
    layers : further coordinates and values that its textures refer to
    is_baked : whether it is of one mesh alone, since a part of it is baked
    """

    material: Material | None
    uv_map: str | None = None
    layers: tuple[LayerRef, ...] = ()
    is_baked: bool = False


#: Says the name that a layer has in the frame.
Label = Callable[[LayerRef], str]
#: Least numbers, other than 0. Rotations have none.
_LOWEST = {"ior": 1e-5, "coat_ior": 1.0, "anisotropy": -0.99, "anisotropy_rotation": -np.inf}
_AT_MOST_1 = (
    "roughness", "metallic", "alpha", "anisotropy", "coat", "coat_roughness", "sheen", "sheen_roughness",
    "transmission", "diffuse_roughness",
)  # fmt: skip
DEFAULT_MATERIAL = Material("Default")
DEFAULT = ExportedMaterial(DEFAULT_MATERIAL)


class Materials:
    """All materials of one export, and the images they use.

    Attributes
    ----------
    override : takes the place of every one
    aovs : passes of the shader AOVs that are asked for
    """

    def __init__(self, warn: Warn, override: bpy.types.Material | None = None, aovs: Sequence[Pass] = ()) -> None:
        self._warn, self.override, self.aovs = warn, override, tuple(aovs)
        self._known: dict[tuple[int, int], ExportedMaterial] = {}
        self.images: dict[str, Image] = {}

    def slots(self, obj: bpy.types.Object) -> list[bpy.types.Material | None]:
        """Materials in the slots of an evaluated object."""
        own = [slot.material for slot in obj.material_slots]
        return own if self.override is None else [self.override] * max(len(own), 1)

    def export(
        self, material: bpy.types.Material | None, mesh: bpy.types.Mesh, bakes: SurfaceBakes | None = None
    ) -> ExportedMaterial:
        """The frame's description of an evaluated material on an evaluated mesh.

        Parameters
        ----------
        bakes : of the mesh; None: what is not read directly is approximated, with warnings
        """
        if material is None:
            return DEFAULT
        for key in ((material.as_pointer(), 0), (material.as_pointer(), mesh.as_pointer())):
            if key in self._known:
                return self._known[key]
        approximations: list[str] = []
        tree = SurfaceWalker(material, mesh, self._warn, approximations.append)
        exported = self._build(tree, bakes, approximations)
        if exported.is_baked:
            return exported  # for this mesh and these slots alone
        self._known[material.as_pointer(), mesh.as_pointer() if tree.uses_mesh else 0] = exported
        return exported

    def _build(self, tree: SurfaceWalker, bakes: SurfaceBakes | None, approximations: list[str]) -> ExportedMaterial:
        surface, aovs = tree.surface(), aov_values(tree, self.aovs)
        if surface is None:
            if aovs:
                tree.report(f"lets all light pass; its AOV Outputs ({', '.join(sorted(aovs))}) are not rendered")
            self._say(approximations)
            return ExportedMaterial(None)
        found = _Paints(surface)
        done: set[str] = set()
        left: set[str] = set()

        def baked(channel: str, value: SocketValue, possible: bool = True, **more: Any) -> SocketValue:
            """The value, or what a bake has in its place."""
            result, solved = value, False
            if bakes is not None and value.approximations and possible:
                result, solved = bakes.channel(tree.material, channel, value, self._warn, **more)
            (done if solved else left).update(value.approximations)
            return result

        for values, name, leaves in found.all():
            values[name] = baked(name, values[name], found.are_apart, leaves=leaves)
        given = {name: baked(f"aov {ref.socket.name}", value, source=ref) for name, (ref, value) in aovs.items()}
        details = [
            replace(one, value=baked("height", one.value, one.source is not None, source=one.source))
            for one in surface.details
        ]
        surface.details = tuple(one for one in details if one.kind != "bump" or one.value.texture is not None)
        self._say([text for text in approximations if text in left or text not in done])
        textures = [values[name].texture for values, name, _ in found.all() if values[name].texture]
        others = *given.values(), *(detail.value for detail in surface.details)
        textures += [value.texture for value in others if value.texture]
        wanted = [t.layer for t in textures] + [d.tangents for d in surface.details if d.kind == "tangent"]
        wanted += [part.bsdf.tangent for part in surface.parts if part.bsdf.tangent is not None]
        uv_map = next((layer.name for layer in wanted if layer.source == "uv"), None)
        layers = tuple(dict.fromkeys(layer for layer in wanted if layer != LayerRef("uv", uv_map or "")))

        def label(layer: LayerRef) -> str:
            return layer.label if layer in layers else ""

        described = self._described(tree, surface, found, label)
        described.aovs = [self._aov(tree, name, value, label) for name, value in given.items()]
        if described.aovs and described.clear:
            tree.report("its AOVs count by its alpha where it lets light pass; Cycles counts them whole")
        return ExportedMaterial(described, uv_map, layers, bool(done))

    def _described(self, tree: SurfaceWalker, surface: Surface, found: _Paints, label: Label) -> Material:
        """The material as frames hold it."""
        material = tree.material
        values = self._fields(tree, found.own, label)
        values |= {
            "details": [self._detail(tree, detail, label) for detail in surface.details],
            "pass_index": material.pass_index,
        }
        if not found.parts:
            bsdfs = [part.bsdf for part in surface.parts]
            return Material(material.name, **values, **(_switched(bsdfs[0], label) if bsdfs else {}))
        parts = []
        for part, (weights, channels) in zip(surface.parts, found.parts, strict=True):
            weight, name = weights["weight"], ", ".join((material.name, *(leaf[1] for leaf in part.bsdf.leaves[:1])))
            texture = None if weight.texture is None else self._texture(weight.texture, label(weight.texture.layer))
            scattering = Material(name, **self._fields(tree, channels, label), **_switched(part.bsdf, label))
            inverted = part.inverted and not isinstance(weight.texture, BakedRef)
            parts.append(Part(scattering, _finite(tree, "weight", weight, (1.0, 1.0, 1.0)), texture, inverted))
        return Material(material.name, **values, **_mean_of(parts), parts=parts)

    def _fields(self, tree: SurfaceWalker, values: dict[str, SocketValue], label: Label) -> dict[str, Any]:
        """Fields of materials.Material with their textures."""
        fields: dict[str, Any] = {}
        for name, value in values.items():
            fields[name] = _usable(tree, name, value)
            if value.texture is not None:
                texture = self._texture(value.texture, label(value.texture.layer))
                if name in TEXTURED:
                    fields.setdefault("textures", {})[name] = texture
                else:
                    fields[f"{name}_texture"] = texture
        return fields

    def _say(self, texts: list[str]) -> None:
        for text in texts:
            self._warn(text)

    def _aov(self, tree: SurfaceWalker, name: str, value: SocketValue, label: Label) -> ShaderAOV:
        texture = None if value.texture is None else self._texture(value.texture, label(value.texture.layer))
        return ShaderAOV(name, finite(tree, name, value.colour), texture)

    def _detail(self, tree: SurfaceWalker, detail: DetailRef, label: Label) -> SurfaceDetail:
        texture, numbers = detail.value.texture, (*detail.value.colour, detail.strength, detail.distance)
        x, y, z = map(float, detail.value.colour)
        if not np.isfinite(numbers).all():
            tree.report("its normal or bump map has a number that is not finite; it is left out. Check its drivers")
            return SurfaceDetail("bump")
        return SurfaceDetail(
            detail.kind,
            None if texture is None else self._texture(texture, label(texture.layer)),
            (x, y, z),
            max(detail.strength, 0.0),
            detail.distance,
            label(detail.tangents),
        )

    def _texture(self, picture: TextureRef | AttributeRef | BakedRef, layer: str) -> Texture:
        if isinstance(picture, AttributeRef):
            return picture.texture("", layer)
        exported = picture.export(self._warn)
        self.images[exported.name] = exported
        return picture.texture(exported.name, layer)


class _Paints:
    """The values of a surface: its own, and of each of its parts the weight and the values, if it has parts."""

    def __init__(self, surface: Surface) -> None:
        self.own = {"emission": surface.emission, "alpha": surface.alpha}
        self.parts: list[tuple[dict[str, SocketValue], dict[str, SocketValue]]] = []
        self._leaves: list[Leaves] = []
        if not surface.parts:
            self.own |= {"base_colour": uniform(0), "roughness": uniform(1)}
        elif len(surface.parts) == 1 and surface.parts[0].is_whole:
            self.own |= surface.parts[0].bsdf.values
        else:
            self.parts = [({"weight": part.weight}, dict(part.bsdf.values)) for part in surface.parts]
            self._leaves = [part.bsdf.leaves for part in surface.parts]

    @property
    def are_apart(self) -> bool:
        """Whether each shader node is of one part alone; not where two of them are instances of a group."""
        leaves = [leaf for own in self._leaves for leaf in own]
        return len(leaves) == len(set(leaves))

    def all(self) -> Iterator[tuple[dict[str, SocketValue], str, Leaves | None]]:
        """Of each value where it is held, its name, and the shaders that count for it; None: all."""
        for name in self.own:
            yield self.own, name, None
        for held, leaves in zip(self.parts, self._leaves, strict=True):
            for values in held:
                for name in values:
                    yield values, name, leaves


def _switched(bsdf: Bsdf, label: Label) -> dict[str, Any]:
    """Fields of materials.Material that are no numbers."""
    fields: dict[str, Any] = dict.fromkeys(bsdf.switches, True)
    if bsdf.tangent is not None:
        fields["tangent"] = label(bsdf.tangent)
    return fields | {"kind": bsdf.kind}


def _mean_of(parts: list[Part]) -> dict[str, Any]:
    """The weighted means that readers of a material without its parts take it for."""
    weights = np.array([np.mean(part.weight) for part in parts])
    weights = weights / max(weights.sum(), 1e-9)
    materials = [part.material for part in parts]
    base = weights @ np.array([material.base_colour for material in materials])
    numbers = {n: float(weights @ [getattr(m, n) for m in materials]) for n in ("roughness", "metallic")}
    return {"base_colour": rgb(base), **numbers}


def finite(tree: SurfaceWalker, name: str, colour: np.ndarray) -> tuple[float, float, float]:
    """A colour for a shader AOV; black where a number is not finite."""
    r, g, b = map(float, colour)
    if not np.isfinite(colour).all():
        tree.report(f"its {name} is not finite; it is 0. Check its drivers")
        return 0.0, 0.0, 0.0
    return r, g, b


def _finite(tree: SurfaceWalker, name: str, value: SocketValue, default: Any) -> tuple[float, float, float]:
    """A value without its texture, at least 0; the default where it is no number."""
    colour = value.colour
    if not np.isfinite(colour).all():
        tree.report(f"its {name.replace('_', ' ')} is not finite; Blender's default is used. Check its drivers")
        colour = np.broadcast_to(default, 3)
    lowest = _LOWEST.get(name, 0.0)
    if name == "ior" and (colour < lowest).any():
        tree.report("an IOR of 0 or less is none; as in Cycles it is taken as nearly 0. Choose one of 1 or more")
    return rgb(np.maximum(colour, lowest))


def _usable(tree: SurfaceWalker, name: str, value: SocketValue) -> tuple[float, float, float] | float:
    """The number or colour of a field of materials.Material, finite and where it can be."""
    colour = _finite(tree, name, value, getattr(DEFAULT_MATERIAL, name))
    if name in COLOURS:
        return colour
    number = colour[0]
    return min(number, 1.0) if name in _AT_MOST_1 and value.texture is None else number
