"""A World's node tree -> frame.World: one constant colour or one lat-long image, turned and scaled.

What is neither is baked, see `bakes`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.frame import Light, World
from ..bakes.manager import Request
from ..bakes.requests import Wanted
from . import world_bake
from .images import MISSING, linear_pixels
from .node_math import rgb
from .nodes import Walker, euler, vector_rotate
from .socket_value import SocketValue, once, uniform
from .sockets import SocketRef, hollow, surface_of

Warn = Callable[[str], None]

#: Linear light when nothing better is known: the grey of Blender's default world.
FALLBACK = 0.05
BLACK = uniform(0)


@dataclass(frozen=True, slots=True)
class Sky:
    """An image around the scene, ``image(rotation @ d)``; the rotation as a tuple of rows."""

    image: bpy.types.Image
    rotation: tuple[tuple[float, ...], ...]


@dataclass(slots=True)
class ExportedWorld:
    """A world as frames describe it.

    Attributes
    ----------
    world : World
        What lights.
    background : World, optional
        What the camera sees, where that is another.
    suns : list of Light
        Of its skies.
    requests : list of Request
        What has to be baked for it; until then something representative takes its place.
    """

    world: World
    background: World | None = None
    suns: list[Light] = field(default_factory=list)
    requests: list[Request] = field(default_factory=list)


def export_world(world: bpy.types.World | None, warn: Warn, wanted: Wanted | None = None) -> ExportedWorld:
    """Describe an evaluated world; black without one, as in Blender.

    Parameters
    ----------
    wanted : what is not read directly is baked; None: it is approximated, with warnings

    Raises
    ------
    UsageError
        Colour, strength or rotation are not finite; names the world.
    """
    if world is None:
        return ExportedWorld(World(colour=(0.0, 0.0, 0.0)))
    _check_rays(world, warn)
    paths = world_bake.light_paths(world) if _has_nodes(world) else set()
    lights = _read(world, False, warn, wanted, bool(paths))
    if not paths:
        return lights
    if others := sorted(paths - {"Is Camera Ray"}):
        names = ", ".join(f'"{name}"' for name in others)
        warn(f'World "{world.name}", {names} of Light Path: all that is lit sees what diffuse rays see')
    lights.suns = [replace(sun, camera=False) for sun in lights.suns]
    if views := world_bake.of_the_view(world):
        node, name = views[0]
        warn(
            f'World "{world.name}", node "{node.label or node.name}": "{name}" is another for every picture, which is '
            "not rendered; the camera sees what lights"
        )
        return lights
    seen = _read(world, True, warn, wanted, True)
    return replace(lights, background=seen.world, requests=lights.requests + seen.requests)


def _has_nodes(world: bpy.types.World) -> bool:
    """Whether nodes make a world; from Blender 5.0 on they make all, and the switch is deprecated."""
    return world.node_tree is not None and (bpy.app.version >= (5, 0, 0) or world.use_nodes)


def _read(world: bpy.types.World, camera: bool, warn: Warn, wanted: Wanted | None, splits: bool) -> ExportedWorld:
    """The world as it lights, or as the `camera` sees it: read, or baked where it cannot be read exactly.

    Where it `splits` by Light Path, what depends on the view is taken for the camera's.
    """
    approximations: list[str] = []
    tree = _Tree(world, camera, warn, approximations.append)
    light = tree.light()
    made = None
    if approximations and wanted is not None and (splits or not world_bake.of_the_view(world)):
        made, factor = world_bake.world_request(world, wanted.world_size, camera)
        found = wanted.find(made)
        if found is not None:
            world_bake.report(world, found, warn)
            return ExportedWorld(
                World(found["map"], colour=rgb(_usable(np.full(3, factor), np.eye(3), world.name, warn))),
                suns=world_bake.baked_suns(found, factor, world.name),
            )
        failure = wanted.failed(made)
        if failure:
            wanted.tell(made, f'World "{world.name}" cannot be baked ({failure}); it is approximated', warn)
    for text in approximations if made is None or failure else ():
        if made is None or wanted is None:
            warn(text)
        else:
            wanted.tell(made, text, warn)
    return ExportedWorld(_readable(world, light, warn), requests=[made] if made is not None and not failure else [])


def _readable(world: bpy.types.World, light: SocketValue, warn: Warn) -> World:
    """The frame's world of a light that is a colour, or an image times a colour."""
    pixels, rotation = None, np.eye(3)
    if isinstance(light.texture, Sky):
        pixels, rotation = linear_pixels(light.texture.image, warn), np.array(light.texture.rotation)
        if pixels is None:
            warn(
                f'World "{world.name}": image "{light.texture.image.name}" cannot be read; as in Cycles it is magenta. '
                "Choose File > External Data > Find Missing Files, or another image"
            )
            light = SocketValue(light.colour * MISSING)
    colour = _usable(light.colour, rotation, world.name, warn)
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
    """What a world's nodes say of light that comes from afar: as it lights, or as the camera sees it."""

    unknown = FALLBACK

    def __init__(self, world: bpy.types.World, camera: bool, warn: Warn, approximate: Warn) -> None:
        super().__init__(f'World "{world.name}"', warn, approximate)
        self.world, self.camera = world, camera

    def light(self) -> SocketValue:
        """Light of the world."""
        if not _has_nodes(self.world):
            return SocketValue(np.array(self.world.color, np.float64))
        surface = surface_of(self.world.node_tree)
        if surface is None:
            return BLACK
        self.name_lost_groups(self.world.node_tree, surface.node)
        if surface.node.inputs["Volume"].is_linked:
            self.note(surface.node, "the volume is not rendered")
        return self.shader(surface)

    def mean(self, texture: Any) -> np.ndarray:
        pixels = linear_pixels(texture.image, self._warn)
        if pixels is None:
            return np.array(MISSING)
        rows = np.where(np.isfinite(pixels), pixels, 0).mean(axis=1, dtype=np.float64)
        height = len(rows)
        return np.average(rows, axis=0, weights=np.sin((np.arange(height) + 0.5) / height * np.pi))

    # Shaders

    @once(lambda self: uniform(self.unknown))
    def shader(self, ref: SocketRef) -> SocketValue:
        """Light of a shader input."""
        origin = self.origin(ref)
        if not origin.socket.is_output:
            return BLACK
        node = origin.node
        if node.type in ("BACKGROUND", "EMISSION"):
            operands = self.colour(origin.input("Color")), self.number(origin.input("Strength"))
            return self.combine(node, np.multiply, *operands)
        if node.type == "MIX_SHADER":
            share = float(np.clip(self.value(origin.input(0)), 0, 1))
            if share in (0.0, 1.0):  # the other has no part in it
                return self.shader(origin.input(1 + int(share)))
            shaders = self.shader(origin.input(1)), self.shader(origin.input(2))
            return self.sum(node, shaders[0].times(1 - share), shaders[1].times(share))
        if node.type == "ADD_SHADER":
            return self.sum(node, self.shader(origin.input(0)), self.shader(origin.input(1)))
        if node.type == "GROUP":
            self.note(node, f"{hollow(node)}; it is black in Cycles, here a dim grey. Mend or replace it")
        else:
            self.warn(node, f"{node.bl_label} is not supported as light of the world; a dim grey is used")
        return uniform(FALLBACK)

    def sum(self, node: bpy.types.Node, first: SocketValue, second: SocketValue) -> SocketValue:
        """Sum of two lights."""
        return self.combine(node, np.add, first, second)

    def node_light_path(self, output: SocketRef) -> SocketValue:
        return uniform(world_bake.light_path(output.socket.name, self.camera))

    # Textures

    def node_tex_environment(self, output: SocketRef) -> SocketValue:
        node = output.node
        if problem := world_bake.missing_image(node):
            self.warn(node, problem)
            return SocketValue(np.array(MISSING))
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
        origin = self.origin(ref)
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
