"""Worlds that are not read directly -> requests for `bakes`, and their results -> frame.World and suns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ...drgs_blender.core.frame import Light
from ..bakes import node_trees
from ..bakes.requests import Request, request
from ..bakes.store import Baked
from .image_pixels import is_empty
from .images import unreadable
from .node_math import rgb
from .sockets import surface_of

#: Outputs that depend on where a picture is taken from, by the type of their node; None is all of them.
_OF_THE_VIEW = {"TEX_COORD": {"Camera", "Window"}, "CAMERA": None}


#: What a ray that gathers light from a diffuse surface is to a Light Path node, and what a camera's is; 0 otherwise.
_LIGHTING = {"Is Diffuse Ray": 1.0, "Is Reflection Ray": 1.0, "Ray Depth": 1.0, "Diffuse Depth": 1.0}
_SEEN = {"Is Camera Ray": 1.0}


def light_path(output: str, camera: bool) -> float:
    """Value of an output of Light Path nodes, for rays of the camera or for light that a surface gathers."""
    return (_SEEN if camera else _LIGHTING).get(output, 0.0)


def light_paths(world: bpy.types.World) -> set[str]:
    """Outputs of Light Path nodes that a world depends on."""
    nodes = (node for tree in _trees(world) for node in tree.nodes if node.type == "LIGHT_PATH")
    return {output.name for node in nodes for output in node.outputs if output.is_linked}


def of_the_view(world: bpy.types.World) -> list[tuple[bpy.types.Node, str]]:
    """Nodes of a world's light whose values are not the same for every place, and which they are."""
    found = []
    for tree in _trees(world):
        for node in tree.nodes:
            names = _OF_THE_VIEW.get(node.type, set())
            used = [o.name for o in node.outputs if o.is_linked and (names is None or o.name in names)]
            found += [(node, name) for name in used]
    return found


def world_request(world: bpy.types.World, size: int, camera: bool) -> tuple[Request, float]:
    """The bake of an evaluated world, and a factor of its map.

    Parameters
    ----------
    size : width of the map in pixels
    camera : as the camera sees it; else as it lights
    """
    factor, node = _strength(world)

    def change(trees: list[dict[str, Any]]) -> None:
        if node is not None:
            trees[0][node.name]["inputs"][node.inputs["Strength"].identifier]["value"] = 1.0

    about = {"size": size, "camera": camera, "light_path": _SEEN if camera else _LIGHTING}
    made = request("world", world, f'World "{world.name}"', _trees(world), about, change)
    return made, factor


def report(world: bpy.types.World, found: Baked, warn: Callable[[str], None]) -> None:
    """Say what is not as it should be in a baked world."""
    for node in (node for tree in _trees(world) for node in tree.nodes):
        if node.type in ("TEX_ENVIRONMENT", "TEX_IMAGE") and (problem := missing_image(node)):
            warn(f'World "{world.name}", node "{node.label or node.name}": {problem}')
    if int(found["kept"]):
        warn(f'World "{world.name}": a sun of it is not one round disc; it is part of the map, as sharp as that is')


def missing_image(node: bpy.types.Node) -> str:
    """Why a node has no image to show, for the user; "" where it has one."""
    image = node.image
    if image is not None and not is_empty(image):
        return ""
    return f"{unreadable(image, 0)[0]}. Choose one, or File > External Data > Find Missing Files"


def baked_suns(found: Baked, factor: float, name: str) -> list[Light]:
    """The suns of a baked world, as lamps."""
    suns = []
    for number, row in enumerate(found["suns"]):
        direction, irradiance, angle = row[:3], row[3:6] * factor, float(row[6])
        power = float(irradiance.max())
        if power > 0:
            matrix = np.array(Vector(direction).to_track_quat("Z", "Y").to_matrix().to_4x4(), np.float64)
            suns.append(
                Light(
                    name=f'Sun {number + 1} of World "{name}"',
                    kind="sun",
                    matrix_world=matrix,
                    colour=rgb(irradiance / power),
                    power=power,
                    angle=angle,
                    camera=True,
                )
            )
    return suns


def _trees(world: bpy.types.World) -> list[node_trees.Tree]:
    surface = surface_of(world.node_tree)
    return [] if surface is None else node_trees.trees(world.node_tree, surface.node)


def _strength(world: bpy.types.World) -> tuple[float, bpy.types.Node | None]:
    """The constant strength of the one Background that is a world's light, and that node; 1 and None without.

    A strength that changes then needs no other map.
    """
    surface = surface_of(world.node_tree)
    origin = surface and surface.origin()
    if not origin or origin.groups or origin.node.type != "BACKGROUND":
        return 1.0, None
    strength = origin.node.inputs["Strength"]
    if strength.is_linked or not 0 <= strength.default_value < np.inf:
        return 1.0, None
    return float(strength.default_value), origin.node
