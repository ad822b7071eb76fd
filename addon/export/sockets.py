"""Sources of socket values: links followed through reroutes, muted nodes and node groups."""

from __future__ import annotations

from typing import NamedTuple

import bpy


class SocketRef(NamedTuple):
    """A socket with its context: the group nodes around it, outermost first (Blender's `SocketInContext`)."""

    socket: bpy.types.NodeSocket
    groups: tuple[bpy.types.Node, ...] = ()

    @property
    def node(self) -> bpy.types.Node:
        return self.socket.node

    def input(self, key: int | str) -> SocketRef:
        """An input of the same node by index or name."""
        return SocketRef(self.node.inputs[key], self.groups)

    def inputs(self) -> dict[str, SocketRef]:
        """The inputs of the same node by identifier, which is unique."""
        return {s.identifier: SocketRef(s, self.groups) for s in self.node.inputs}

    @property
    def is_cut(self) -> bool:
        """Whether it is an input whose link is not followed, as links of loops are not."""
        socket = self.socket
        return not socket.is_output and any(not link.is_valid for link in _links(socket))

    def origin(self) -> SocketRef:
        """The output that feeds this input, through reroutes, muted nodes and groups.

        Where nothing does, the input whose own value counts.
        """
        own = ref = self
        while links := _links(ref.socket):
            link = links[0]
            if link.is_muted or not link.is_valid:  # a loop has a link that is not valid
                return own
            source = SocketRef(link.from_socket, ref.groups)
            node = source.node
            if node.mute:
                passed = [i.from_socket for i in node.internal_links if i.to_socket == source.socket]
                if not passed:
                    return own
                ref = SocketRef(passed[0], ref.groups)
            elif node.type == "REROUTE":
                ref = source.input(0)
            elif node.type == "GROUP" and node.node_tree is not None:
                exits = [n for n in node.node_tree.nodes if n.type == "GROUP_OUTPUT" and n.is_active_output]
                if not exits:
                    return source
                own = ref = SocketRef(_same(exits[0].inputs, source.socket), (*ref.groups, node))
            elif node.type == "GROUP_INPUT" and ref.groups:
                own = ref = SocketRef(_same(ref.groups[-1].inputs, source.socket), ref.groups[:-1])
            else:
                return source
        return own


def _links(socket: bpy.types.NodeSocket) -> tuple[bpy.types.NodeLink, ...]:
    """The links of a socket: Blender 4.2 still calls one linked whose link went with its node group."""
    return socket.links if socket.is_linked else ()  # links are searched in the whole tree


def hollow(node: bpy.types.Node) -> str:
    """What is wrong with a group node whose outputs nothing feeds."""
    tree = node.node_tree
    if tree is None:
        return "has no node group"
    if tree.original.is_missing:  # which an evaluated one does not say
        return f'its node group "{tree.name}" is missing from {tree.original.library.filepath}'
    return f'its node group "{tree.name}" has no output'


def _same(sockets: bpy.types.bpy_prop_collection, socket: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The socket on the other side of a group's border."""
    return next(s for s in sockets if s.identifier == socket.identifier)


def surface_of(tree: bpy.types.NodeTree | None) -> SocketRef | None:
    """The surface socket of the output that Cycles would use; None without one."""
    output = tree and (tree.get_output_node("CYCLES") or tree.get_output_node("ALL"))
    return SocketRef(output.inputs["Surface"]) if output else None
