"""A material's nodes -> frame.Material: colours and numbers, each times an image where there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.frame import Image, Material, SurfaceDetail, Texture
from .layers import AttributeRef, LayerRef
from .normal_nodes import DetailRef
from .socket_value import SocketValue, Warn
from .surface_bake import CHANNELS, BakedRef, SurfaceBakes
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


DEFAULT_MATERIAL = Material("Default")
DEFAULT = ExportedMaterial(DEFAULT_MATERIAL)


class Materials:
    """All materials of one export, and the images they use. `override` takes the place of every one."""

    def __init__(self, warn: Warn, override: bpy.types.Material | None = None) -> None:
        self._warn, self.override = warn, override
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
        material = tree.material
        surface = tree.surface()
        if surface is None:
            self._say(approximations)
            return ExportedMaterial(None)
        paints = {
            "base_colour": surface.base,
            "roughness": surface.roughness,
            "metallic": surface.metallic,
            "emission": surface.emission,
            "alpha": surface.alpha,
        }
        done: set[str] = set()
        left = {text for detail in surface.details for text in detail.value.approximations}
        for name, value in paints.items():
            solved = False
            if bakes is not None and name in CHANNELS and value.approximations:
                paints[name], solved = bakes.channel(material, name, value, self._warn)
            (done if solved else left).update(value.approximations)
        self._say([text for text in approximations if text in left or text not in done])
        textures = [value.texture for value in (*paints.values(), *(d.value for d in surface.details)) if value.texture]
        wanted = [t.layer for t in textures] + [d.tangents for d in surface.details if d.kind == "tangent"]
        uv_map = next((layer.name for layer in wanted if layer.source == "uv"), None)
        layers = tuple(dict.fromkeys(layer for layer in wanted if layer != LayerRef("uv", uv_map or "")))

        def label(layer: LayerRef) -> str:
            return layer.label if layer in layers else ""

        values: dict[str, Any] = {}
        for name, value in paints.items():
            values[name] = _usable(tree, name, value, getattr(DEFAULT_MATERIAL, name))
            if value.texture is not None:
                values[f"{name}_texture"] = self._texture(value.texture, label(value.texture.layer))
        details = [self._detail(tree, detail, label) for detail in surface.details]
        described = Material(material.name, **values, details=details, pass_index=material.pass_index)
        return ExportedMaterial(described, uv_map, layers, bool(done))

    def _say(self, texts: list[str]) -> None:
        for text in texts:
            self._warn(text)

    def _detail(self, tree: SurfaceWalker, detail: DetailRef, label: Callable[[LayerRef], str]) -> SurfaceDetail:
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


def _usable(tree: SurfaceWalker, name: str, value: SocketValue, default: tuple[float, float, float] | float) -> object:
    """The number or colour of a field of frame.Material, finite and where it can be."""
    colour = value.colour
    if not np.isfinite(colour).all():
        tree.report(f"its {name.replace('_', ' ')} is not finite; Blender's default is used. Check its drivers")
        colour = np.broadcast_to(default, 3)
    colour = np.maximum(colour, 0)
    if name in ("roughness", "metallic", "alpha") and value.texture is None:
        colour = np.minimum(colour, 1)
    return tuple(map(float, colour)) if name in ("base_colour", "emission") else float(colour[0])
