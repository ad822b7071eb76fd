"""Geometry Nodes by which one object carries the vertices of another: the tree, its checks, and what builds it.

`carrier_weights` says which points of the carrier count for each vertex.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np

from ..drgs_blender.core.errors import UsageError

Array = np.ndarray

#: Points that carry a vertex, in threes.
THREES = 12
#: Point attributes, one for each three of them: their numbers, their weights, and those of their normals.
INDICES, WEIGHTS, NORMALS = (f"drgs_carrier_{what}_{{}}" for what in ("indices", "weights", "normals"))
#: What these leave of a vertex's place.
LEFT = "drgs_carrier_left"
#: Ends the names of the attributes for the carrier as it is rendered, where it has other points than in viewports.
RENDERED = "_render"
#: How many points what carries an object had when it was bound. Property of the object: by the names of modifiers of
#: Surface Deform. Of nodes, property of its mesh, in viewports and, where they are others, in renders; and attribute.
COUNT = "drgs_cage_points"
#: Name of the node that knows the cage.
SOURCE = "DR-GS Cage"
#: Begins the names of the trees; what older versions made have others, and go on.
NAME = "DR-GS Carrier"
#: Attribute of the carrier within the tree: `carrier_weights.normals_of`.
_NORMAL = "drgs_carrier_normal"
#: Name of the group that adds three points, and its property, by which it is found; a dot hides it from menus.
_GROUP = ".DR-GS Carrier Points"
#: Their inputs; the output is "Place" with the points added.
_SOCKETS = (
    ("Geometry", "Geometry"),
    *((name, "Vector") for name in ("Place", "Indices", "Weights", "Normals")),
)


def carrier_of(modifier: bpy.types.Modifier) -> bpy.types.Object | None:
    """The mesh that carries an object by a modifier of `carry`; None of other modifiers."""
    return _known(modifier.node_group) if modifier.type == "NODES" and modifier.node_group is not None else None


def check(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, warn: Callable[[str], None]) -> None:
    """Warn where what carries an evaluated object has other points than when it was bound, or is deleted."""
    original = obj.original
    by_name = original.get(COUNT, {})
    for modifier in original.modifiers:
        if not (modifier.show_render if depsgraph.mode == "RENDER" else modifier.show_viewport):
            continue
        if modifier.type == "SURFACE_DEFORM":
            bound, carrier = by_name.get(modifier.name), modifier.target
        elif carries(modifier):
            bound, carrier = original.data.get(COUNT), carrier_of(modifier)
        else:
            continue
        if bound is None:
            continue
        if carrier is None:
            warn(
                f'"{obj.name}": what carried it by modifier "{modifier.name}" is deleted. Remove the modifier, or undo'
            )
            continue
        found = len(points_of(carrier.evaluated_get(depsgraph)))
        counts = [bound] if isinstance(bound, int) else list(bound)
        if found not in counts:
            had = " or ".join(map(str, counts))
            warn(
                f'"{obj.name}": "{carrier.name}", which carries it, has {found} points and had {had} when it was '
                "bound, so it does not follow. Keep their number, or bind again"
            )


def carries(modifier: bpy.types.Modifier) -> bool:
    """Whether it is one of `carry`, also where what carried is deleted."""
    tree = modifier.node_group if modifier.type == "NODES" else None
    return tree is not None and tree.nodes.get(SOURCE) is not None


def check_free(obj: bpy.types.Object, name: str) -> None:
    """UsageError where nodes of a modifier that is not called `name` carry an object: its mesh knows one carrier."""
    for modifier in obj.modifiers:
        if modifier.name != name and carries(modifier):
            raise UsageError(
                f'Object "{obj.name}"',
                f'is carried by modifier "{modifier.name}"',
                "Apply that or remove it, then bind",
            )


def points_of(cage: bpy.types.Object) -> bpy.types.bpy_prop_collection:
    """Points of an evaluated mesh or point cloud."""
    return cage.data.points if cage.type == "POINTCLOUD" else cage.data.vertices


def _known(tree: bpy.types.NodeTree) -> bpy.types.Object | None:
    source = tree.nodes.get(SOURCE)
    return None if source is None else source.inputs["Object"].default_value


def forget(mesh: bpy.types.Mesh, suffix: str) -> None:
    """Take away what a mesh remembers of a carrier by attributes whose names end in `suffix`."""
    names = [name.format(i) for name in (INDICES, WEIGHTS, NORMALS) for i in range(THREES)]
    for name in (*names, LEFT, COUNT):
        if (attribute := mesh.attributes.get(name + suffix)) is not None:
            mesh.attributes.remove(attribute)


def write(mesh: bpy.types.Mesh, name: str, kind: str, values: Array) -> None:
    """Give a mesh a point attribute, FLOAT or FLOAT_VECTOR, in place of one of that name."""
    if (old := mesh.attributes.get(name)) is not None:
        mesh.attributes.remove(old)
    attribute = mesh.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set("vector" if kind == "FLOAT_VECTOR" else "value", values.astype(np.float32).ravel())


class Builder:
    """Adds nodes to a tree; what is linked to an input is a socket or a value."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self._tree = tree

    def node(self, kind: str, *inputs: object, **values: object) -> bpy.types.Node:
        """A node with `values` whose inputs, in their order, are linked or set."""
        node = self._tree.nodes.new(kind)
        for name, value in values.items():
            setattr(node, name, value)
        for socket, given in zip([s for s in node.inputs if s.enabled], inputs):
            if isinstance(given, bpy.types.NodeSocket):
                self._tree.links.new(given, socket)
            elif given is not None:
                socket.default_value = given
        return node

    def out(self, kind: str, *inputs: object, **values: object) -> bpy.types.NodeSocket:
        """The first output of such a node."""
        return next(s for s in self.node(kind, *inputs, **values).outputs if s.enabled)

    def vector(self, operation: str, *inputs: object) -> bpy.types.NodeSocket:
        """Vector Math."""
        return self.out("ShaderNodeVectorMath", *inputs, operation=operation)

    def scaled(self, vector: bpy.types.NodeSocket, factor: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """`vector` times the number `factor`."""
        node = self.node("ShaderNodeVectorMath", vector, operation="SCALE")
        self._tree.links.new(factor, node.inputs["Scale"])
        return node.outputs["Vector"]

    def attribute(self, name: str, kind: str) -> bpy.types.NodeSocket:
        """A named attribute."""
        return self.out("GeometryNodeInputNamedAttribute", name, data_type=kind)

    def parts(self, vector: bpy.types.NodeSocket) -> list[bpy.types.NodeSocket]:
        """X, Y, Z."""
        return list(self.node("ShaderNodeSeparateXYZ", vector).outputs)


def tree_of(carrier: bpy.types.Object) -> bpy.types.NodeTree:
    """The nodes for modifiers that follow `carrier`, made where there are none.

    They bring each vertex to what its mesh remembers of the carrier, as long as that has as many points as it had then.
    """
    for known in bpy.data.node_groups:
        if known.library is None and known.name.startswith(NAME) and _known(known) == carrier:
            return known
    tree = bpy.data.node_groups.new(f"{NAME} {carrier.name}", "GeometryNodeTree")
    tree.is_modifier = True
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    build = Builder(tree)
    source = build.node("GeometryNodeObjectInfo", carrier, transform_space="RELATIVE", name=SOURCE)
    shape = source.outputs["Geometry"]
    counts = [build.out("GeometryNodeAttributeDomainSize", shape, component=kind) for kind in ("MESH", "POINTCLOUD")]
    root = build.out("ShaderNodeMath", build.out("GeometryNodeInputMeshFaceArea"), operation="SQRT")
    normal = build.out(
        "GeometryNodeFieldOnDomain",
        build.scaled(build.out("GeometryNodeInputNormal"), root),
        data_type="FLOAT_VECTOR",
        domain="FACE",
    )
    store = build.node("GeometryNodeStoreNamedAttribute", data_type="FLOAT_VECTOR", domain="POINT")
    for socket, given in (("Geometry", shape), ("Value", normal)):
        tree.links.new(given, next(s for s in store.inputs if s.enabled and s.name == socket))
    store.inputs["Name"].default_value = _NORMAL
    shape = store.outputs["Geometry"]
    geometry = tree.nodes.new("NodeGroupInput").outputs[0]
    group = _group()
    for suffix in ("", RENDERED):
        moved = tree.nodes.new("GeometryNodeSetPosition")
        tree.links.new(geometry, moved.inputs["Geometry"])
        tree.links.new(_same(build, counts, COUNT + suffix), moved.inputs["Selection"])
        tree.links.new(_place(build, group, shape, suffix), moved.inputs["Position"])
        geometry = moved.outputs["Geometry"]
    tree.links.new(geometry, tree.nodes.new("NodeGroupOutput").inputs[0])
    return tree


def _same(build: Builder, counts: list[bpy.types.NodeSocket], name: str) -> bpy.types.NodeSocket:
    """Whether one of the `counts` is the attribute `name`, and not 0, which it is where it lacks."""
    bound = build.attribute(name, "FLOAT")
    same = [build.out("FunctionNodeCompare", n, bound, 0.5, data_type="FLOAT", operation="EQUAL") for n in counts]
    some = build.out("FunctionNodeCompare", bound, 0.5, data_type="FLOAT", operation="GREATER_THAN")
    either = build.out("FunctionNodeBooleanMath", *same, operation="OR")
    return build.out("FunctionNodeBooleanMath", either, some, operation="AND")


def _place(build: Builder, group: bpy.types.NodeTree, shape: bpy.types.NodeSocket, suffix: str) -> bpy.types.NodeSocket:
    """The sum of where the points of each vertex are now, and of their normals."""
    total = build.attribute(LEFT + suffix, "FLOAT_VECTOR")
    for i in range(THREES):
        named = (build.attribute(name.format(i) + suffix, "FLOAT_VECTOR") for name in (INDICES, WEIGHTS, NORMALS))
        total = build.out("GeometryNodeGroup", shape, total, *named, node_tree=group)
    return total


def _group() -> bpy.types.NodeTree:
    """The nodes that add three points of a carrier to a place; one for all trees, as each node slows their making."""
    for known in bpy.data.node_groups:
        if known.library is None and known.get(_GROUP) == len(_SOCKETS):
            return known
    tree = bpy.data.node_groups.new(_GROUP, "GeometryNodeTree")
    tree[_GROUP] = len(_SOCKETS)
    for name, kind in _SOCKETS:
        tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
    tree.interface.new_socket("Place", in_out="OUTPUT", socket_type="NodeSocketVector")
    build = Builder(tree)
    shape, total, *given = list(tree.nodes.new("NodeGroupInput").outputs)[: len(_SOCKETS)]
    indices, *weights = map(build.parts, given)
    values = build.out("GeometryNodeInputPosition"), build.attribute(_NORMAL, "FLOAT_VECTOR")
    for value, weight in zip(values, weights):
        for index, share in zip(indices, weight):
            found = build.out("GeometryNodeSampleIndex", shape, value, index, data_type="FLOAT_VECTOR", domain="POINT")
            total = build.vector("ADD", total, build.scaled(found, share))
    tree.links.new(total, tree.nodes.new("NodeGroupOutput").inputs[0])
    return tree
