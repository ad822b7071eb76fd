"""Cage deformation by Geometry Nodes, for cages that Surface Deform refuses: any mesh with faces.

Each vertex keeps its place in the frames of the nearest faces (two edges and the normal) and goes to the mean of where
they bring it: values and gradients blended, as by generalised moving least squares (Martin et al. 2010). A cage that is
moved, turned and scaled as a whole does exactly that to the object.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np

from ..drgs_blender.core.errors import UsageError
from . import lookups, mesh_arrays

Array = np.ndarray

#: Faces that carry a vertex.
FACES = 6
#: Point attributes, one for each of them: its corners in the cage, their weights, and that of the normal.
CORNERS, WEIGHTS, HEIGHT = (f"drgs_cage_{what}_{{}}" for what in ("corners", "weights", "height"))
#: Property of the mesh, and point attribute: the points of what carries it, when it was bound.
COUNT = "drgs_cage_points"
#: Name of the node that knows the cage.
SOURCE = "DR-GS Cage"
#: Gives the place of the point of an index.
Place = Callable[[bpy.types.NodeSocket], bpy.types.NodeSocket]


def cage_of(modifier: bpy.types.Modifier) -> bpy.types.Object | None:
    """The mesh that carries an object by a modifier of `carry`; None of other modifiers."""
    return _known(modifier.node_group) if modifier.type == "NODES" and modifier.node_group is not None else None


def check(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, warn: Callable[[str], None]) -> None:
    """Warn where what carries an evaluated object by nodes has another number of points than when it was bound."""
    bound = obj.original.data.get(COUNT)
    for modifier in obj.original.modifiers:
        shown = modifier.show_render if depsgraph.mode == "RENDER" else modifier.show_viewport
        if bound is None or not shown or not carries(modifier):
            continue
        if (cage := cage_of(modifier)) is None:
            warn(
                f'"{obj.name}": what carried it by modifier "{modifier.name}" is deleted. Remove the modifier, or undo'
            )
            continue
        found = len(points_of(cage.evaluated_get(depsgraph)))
        if found != bound:
            warn(
                f'"{obj.name}": "{cage.name}", which carries it, has {found} points and had {bound} when it was bound, '
                "so it does not follow. Keep their number, or bind again"
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


def note_count(mesh: bpy.types.Mesh, count: int) -> None:
    """Keep how many points carry a mesh: its nodes move nothing where there are others."""
    mesh[COUNT] = count
    write(mesh, COUNT, "FLOAT", np.full(len(mesh.vertices), count))


def points_of(cage: bpy.types.Object) -> bpy.types.bpy_prop_collection:
    """Points of an evaluated mesh or point cloud."""
    return cage.data.points if cage.type == "POINTCLOUD" else cage.data.vertices


def _known(tree: bpy.types.NodeTree) -> bpy.types.Object | None:
    source = tree.nodes.get(SOURCE)
    return None if source is None else source.inputs["Object"].default_value


def carry(obj: bpy.types.Object, cage: bpy.types.Object, modifier: bpy.types.Modifier) -> None:
    """Let a nodes `modifier` of `obj` follow `cage`, from where both are evaluated to be now."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    shape = cage.evaluated_get(depsgraph).data
    points = mesh_arrays.read_vertices(obj.evaluated_get(depsgraph).data).astype(np.float64)
    into = np.array(obj.matrix_world.inverted() @ cage.matrix_world, np.float64)
    vertices = mesh_arrays.read_vertices(shape) @ into[:3, :3].T + into[:3, 3]
    corners, weights, heights = frames(points, vertices, mesh_arrays.loop_triangles(shape))
    for i in range(FACES):
        write(obj.data, CORNERS.format(i), "FLOAT_VECTOR", corners[:, i])
        write(obj.data, WEIGHTS.format(i), "FLOAT_VECTOR", weights[:, i])
        write(obj.data, HEIGHT.format(i), "FLOAT", heights[:, i])
    note_count(obj.data, len(vertices))
    modifier.node_group = tree_of(SOURCE, cage, _places)


def frames(points: Array, vertices: Array, triangles: Array) -> tuple[Array, Array, Array]:
    """Coordinates of points in the frames of the nearest faces of a cage, times each face's weight.

    Parameters
    ----------
    points : (n, 3)
    vertices, triangles : (v, 3), (m, 3) of the cage, in the same space; at least one has an area

    Returns
    -------
    (n, FACES, 3) int corners of the faces; (n, FACES, 3) their weights, which sum to one for each point; (n, FACES) the
    weights of the normals, whose length is the root of that of the edges' cross product. Zero where there are no more
    faces.
    """
    first, second, third = (vertices[triangles[:, i]] for i in range(3))
    edges = np.stack((second - first, third - first), axis=2)
    cross = np.cross(edges[..., 0], edges[..., 1])
    area = np.linalg.norm(cross, axis=1)
    sound = np.flatnonzero(area > 1e-9 * area.max())
    # The next face ends the reach of the others, so that vertices do not jump where the nearest change.
    index, distance = lookups.nearest(((first + second + third) / 3)[sound], points, FACES + 1)
    reach = np.maximum(distance[:, -1:] * (1.0 if len(sound) > FACES else 1.5), 1e-30)
    count = min(FACES, len(sound))
    face = sound[index[:, :count]]
    share = np.maximum(1 - (distance[:, :count] / reach) ** 2, 1e-6) ** 3
    share /= share.sum(axis=1, keepdims=True)
    away = points[:, None] - first[face]
    a, b = np.moveaxis(np.einsum("nkij,nkj->nki", np.linalg.pinv(edges)[face], away), 2, 0)
    missing = ((0, 0), (0, FACES - count))
    return (
        np.pad(triangles[face], (*missing, (0, 0))),
        np.pad(share[..., None] * np.stack((1 - a - b, a, b), axis=2), (*missing, (0, 0))),
        np.pad(share * np.einsum("nki,nki->nk", away, cross[face]) / area[face] ** 1.5, missing),
    )


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


def _places(build: Builder, place: Place) -> bpy.types.NodeSocket:
    """The mean of where the faces of each vertex are on the cage now."""
    total = None
    for i in range(FACES):
        corners = [place(index) for index in build.parts(build.attribute(CORNERS.format(i), "FLOAT_VECTOR"))]
        weights = build.parts(build.attribute(WEIGHTS.format(i), "FLOAT_VECTOR"))
        edges = [build.vector("SUBTRACT", corner, corners[0]) for corner in corners[1:]]
        cross = build.vector("CROSS_PRODUCT", *edges)
        length = build.node("ShaderNodeVectorMath", cross, operation="LENGTH").outputs["Value"]
        root = build.out("ShaderNodeMath", length, operation="SQRT")
        height = build.out("ShaderNodeMath", build.attribute(HEIGHT.format(i), "FLOAT"), root, operation="MULTIPLY")
        terms = [build.scaled(build.vector("NORMALIZE", cross), height), *map(build.scaled, corners, weights)]
        for term in terms:
            total = term if total is None else build.vector("ADD", total, term)
    assert total is not None
    return total


def tree_of(
    kind: str, carrier: bpy.types.Object, places: Callable[[Builder, Place], bpy.types.NodeSocket]
) -> bpy.types.NodeTree:
    """The nodes of a `kind` for modifiers that follow `carrier`, made where there are none.

    They bring each vertex to one of `places`, as long as the carrier has as many points as when it was bound.
    """
    for known in bpy.data.node_groups:
        if known.library is None and known.name.startswith(kind) and _known(known) == carrier:
            return known
    tree = bpy.data.node_groups.new(f"{kind} {carrier.name}", "GeometryNodeTree")
    tree.is_modifier = True
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    build = Builder(tree)
    source = build.node("GeometryNodeObjectInfo", carrier, transform_space="RELATIVE", name=SOURCE)
    position, shape = build.out("GeometryNodeInputPosition"), source.outputs["Geometry"]

    def place(index: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return build.out("GeometryNodeSampleIndex", shape, position, index, data_type="FLOAT_VECTOR", domain="POINT")

    bound = build.attribute(COUNT, "FLOAT")
    found = [build.out("GeometryNodeAttributeDomainSize", shape, component=kind) for kind in ("MESH", "POINTCLOUD")]
    same = [build.out("FunctionNodeCompare", n, bound, 0.5, data_type="FLOAT", operation="EQUAL") for n in found]
    chosen = build.out("FunctionNodeBooleanMath", *same, operation="OR")
    given, result = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    moved = tree.nodes.new("GeometryNodeSetPosition")
    tree.links.new(given.outputs[0], moved.inputs["Geometry"])
    tree.links.new(chosen, moved.inputs["Selection"])
    tree.links.new(places(build, place), moved.inputs["Position"])
    tree.links.new(moved.outputs["Geometry"], result.inputs[0])
    return tree
