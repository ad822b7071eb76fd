"""A material's nodes -> frame.Material: colours and numbers, each times an image where there is one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.frame import Image, Material, Texture
from .socket_value import SocketValue, Warn
from .surface_nodes import SurfaceWalker
from .texture_refs import TextureRef


@dataclass(frozen=True, slots=True)
class ExportedMaterial:
    """An exported material; ``material`` None is an invisible one, ``uv_map`` "" the active UV map."""

    material: Material | None
    uv_map: str | None = None


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

    def export(self, material: bpy.types.Material | None, mesh: bpy.types.Mesh) -> ExportedMaterial:
        """The frame's description of an evaluated material on an evaluated mesh."""
        if material is None:
            return DEFAULT
        for key in ((material.as_pointer(), 0), (material.as_pointer(), mesh.as_pointer())):
            if key in self._known:
                return self._known[key]
        tree = SurfaceWalker(material, mesh, self._warn)
        exported = self._build(tree)
        self._known[material.as_pointer(), mesh.as_pointer() if tree.uses_mesh else 0] = exported
        return exported

    def _build(self, tree: SurfaceWalker) -> ExportedMaterial:
        material = tree.material
        surface = tree.surface()
        if surface is None:
            return ExportedMaterial(None)
        # A surface is there or not; one that is there scatters as if it were there entirely.
        base = surface.base.times(1 / (1 - surface.clear)) if surface.clear < 1 else surface.base
        paints = {
            "base_colour": base,
            "roughness": surface.roughness,
            "metallic": surface.metallic,
            "emission": surface.emission,
        }
        values: dict[str, Any] = {}
        maps: list[str] = []
        for name, value in paints.items():
            picture = value.texture
            values[name] = _usable(tree, name, value, getattr(DEFAULT_MATERIAL, name))
            if isinstance(picture, TextureRef):
                values[f"{name}_texture"] = self._texture(picture)
                maps.append(picture.uv_map)
        if len(set(maps)) > 1:
            names = ", ".join(name or "the active one" for name in dict.fromkeys(maps))
            self._warn(f'Material "{material.name}": of its UV maps ({names}) only the first is used')
        return ExportedMaterial(Material(material.name, **values), maps[0] if maps else None)

    def _texture(self, picture: TextureRef) -> Texture:
        exported = picture.export(self._warn)
        self.images[exported.name] = exported
        return picture.texture(exported.name)


def _usable(tree: SurfaceWalker, name: str, value: SocketValue, default: tuple[float, float, float] | float) -> object:
    """The number or colour of a field of frame.Material, finite and where it can be."""
    colour = value.colour
    if not np.isfinite(colour).all():
        tree.report(f"its {name.replace('_', ' ')} is not finite; Blender's default is used. Check its drivers")
        colour = np.broadcast_to(default, 3)
    colour = np.maximum(colour, 0)
    if name in ("roughness", "metallic") and value.texture is None:
        colour = np.minimum(colour, 1)
    return tuple(map(float, colour)) if name in ("base_colour", "emission") else float(colour[0])
