"""A material's AOV Output nodes -> what it gives to the shader AOVs of a view layer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import bpy

from ...drgs_blender.core.passes import AOV_VALUE, Pass
from .socket_value import SocketValue
from .sockets import SocketRef
from .texture_nodes import TextureWalker


def aov_values(tree: TextureWalker, aovs: Sequence[Pass]) -> dict[str, tuple[SocketRef, SocketValue]]:
    """Pass name -> input of an AOV Output node and its value, of those that a material has; of several the first."""
    found: dict[str, tuple[SocketRef, SocketValue]] = {}
    if not aovs or tree.material.node_tree is None:
        return found
    for node, groups in _outputs(tree.material.node_tree):
        for p in aovs:
            if p.layer != node.aov_name:
                continue
            if p.name in found:
                tree.note(node, f'the AOV "{p.layer}" has another output, which is used alone')
                continue
            is_value = p.name.startswith(AOV_VALUE)
            ref = SocketRef(node.inputs["Value" if is_value else "Color"], groups)
            found[p.name] = ref, tree.number(ref) if is_value else tree.colour(ref)
    return found


def _outputs(
    tree: bpy.types.NodeTree, groups: tuple[bpy.types.Node, ...] = ()
) -> Iterator[tuple[bpy.types.Node, tuple[bpy.types.Node, ...]]]:
    """AOV Output nodes of a tree and its groups, which as in Cycles need not be linked, and the group nodes around."""
    for node in tree.nodes:
        if node.mute:
            continue
        if node.type == "OUTPUT_AOV":
            yield node, groups
        inner = node.node_tree if node.type == "GROUP" else None
        if inner is not None and all(around.node_tree != inner for around in groups):
            yield from _outputs(inner, (*groups, node))
