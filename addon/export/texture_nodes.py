"""A material's textures, attributes and coordinates: which image lies how on a surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import bpy
import numpy as np

from . import images
from .layers import HAIR_INFO, AttributeRef, LayerRef, attribute_values, colour_average
from .node_math import reflectance
from .nodes import Walker, euler, vector_rotate
from .socket_value import Array, SocketValue, Warn, uniform
from .sockets import SocketRef
from .texture_refs import Channel, TextureRef


class TextureWalker(Walker):
    """Evaluates the nodes of a material on a mesh, up to its shaders."""

    def __init__(
        self, material: bpy.types.Material, mesh: bpy.types.Mesh, warn: Warn, approximate: Warn | None = None
    ) -> None:
        super().__init__(f'Material "{material.name}"', warn, approximate)
        self.material, self.mesh = material, mesh
        #: Hair is never baked, so its materials are its own.
        self.uses_mesh = not isinstance(mesh, bpy.types.Mesh)

    def report(self, problem: str) -> None:
        """Warn of the material as a whole."""
        self._warn(f"{self.owner}: {problem}")

    # Textures

    def mean(self, texture: Any) -> Array:
        return texture.mean(self._warn)

    def channel(self, texture: Any, name: str) -> TextureRef | AttributeRef:
        return texture.only(cast(Channel, name))

    def curved(self, texture: Any, function: Callable[[Array], Array]) -> SocketValue | None:
        if isinstance(texture, AttributeRef):
            made, exact = texture.curved(function)
            if not exact:
                self.report(f'nodes change the values "{texture.layer.name}" at the corners; between, they are blended')
            return SocketValue(np.ones(3), made)
        found = texture.curved(function, self._warn)
        return None if found is None else SocketValue(np.full(3, found[1]), found[0])

    def node_tex_image(self, output: SocketRef) -> SocketValue:
        node, image = output.node, output.node.image
        straight = node.outputs["Alpha"].is_linked
        lookup = images.Lookup.of(node)
        shown = None if image is None else images.show(image, straight, self._warn, lookup)
        if shown is None:
            problem, damaged = images.unreadable(image, lookup.frame)
            self.note(node, f"{problem}. Choose another, or find its file", approximated=damaged)
            return uniform(1) if output.socket.name == "Alpha" else SocketValue(np.array(images.MISSING))
        if node.projection != "FLAT":
            self.warn(node, f"the {node.projection.title()} projection is not supported; the UV map is used")
        if lookup.is_cubic and not shown.is_spline:
            why = "of tiled images" if image.source == "TILED" else "of an image this large"
            self.warn(node, f"{node.interpolation} interpolation {why} is read as Linear")
        matrix, layer = self.coordinates(output.input("Vector"))
        if layer.source != "uv":
            layer, matrix = replace(layer, matrix=tuple(map(tuple, matrix.tolist()))), np.eye(4)
        return SocketValue(
            np.ones(3),
            TextureRef(
                image,
                straight,
                "a" if output.socket.name == "Alpha" else "rgb",
                layer,
                tuple(map(tuple, (shown.place @ matrix).tolist())),
                "closest" if node.interpolation == "Closest" else "linear",
                cast(Any, shown.extension.lower()),
                lookup=lookup,
            ),
        )

    def node_tex_environment(self, output: SocketRef) -> SocketValue:
        node = output.node
        if (
            node.image is not None
            and (
                picture := images.export_image(
                    node.image, False, self._warn, images.Lookup(images.Lookup.of(node).frame)
                )
            )
            is not None
        ):
            self.warn(node, "an Environment Texture is not supported on surfaces; its mean colour is used")
            return SocketValue(images.mean_colour(picture)[:3])
        return self.nearest(output, output)

    def node_vertex_color(self, output: SocketRef) -> SocketValue:
        return self.attribute(output, output.node.layer_name)

    def node_attribute(self, output: SocketRef) -> SocketValue:
        node = output.node
        if node.attribute_type != "GEOMETRY":
            return self.nearest(output, output)
        return self.attribute(output, node.attribute_name)

    def attribute(self, output: SocketRef, name: str) -> SocketValue:
        """Values of an attribute of the mesh; "" is the colour attribute that renders."""
        self.uses_mesh = True
        if name == "" and len(self.mesh.color_attributes):
            name = self.mesh.color_attributes[max(self.mesh.color_attributes.render_color_index, 0)].name
        values = attribute_values(self.mesh, name)
        if values is None:
            problem = f'mesh "{self.mesh.name}" has no values "{name}", which are black in Cycles. Choose others'
            self.note(output.node, problem, approximated=True)
            return uniform(self.unknown)
        layer, channel = LayerRef("attribute", name), cast(Channel, "rgb")
        if output.socket.name == "Alpha":
            channel = "a"
        elif output.socket.type == "VALUE":
            layer, values, channel = replace(layer, change=colour_average, mark="mean"), colour_average(values), "r"
        texture = AttributeRef(layer, channel, np.nan_to_num(values.astype(np.float64)))
        if (np.ptp(values, axis=0) == 0).all():
            return SocketValue(texture.mean(self._warn))
        return SocketValue(np.ones(3), texture)

    def node_hair_info(self, output: SocketRef) -> SocketValue:
        self.uses_mesh, name = True, output.socket.name
        if isinstance(self.mesh, bpy.types.Mesh):
            return uniform(0)  # as in Cycles
        if name == "Is Strand":
            return uniform(1)
        name = f"Hair Info: {name}"
        return self.attribute(output, name) if name in HAIR_INFO else self.nearest(output, output)

    def node_ambient_occlusion(self, output: SocketRef) -> SocketValue:
        if output.socket.type == "RGBA":
            return self.nearest(output, output)
        self.warn(output.node, "Ambient Occlusion is not supported; 1 is used")
        return uniform(1)

    def node_fresnel(self, output: SocketRef) -> SocketValue:
        ior = self.value(output.input("IOR"))
        self.warn(output.node, "it cannot depend on the direction; the value when seen from the front is used")
        return uniform(reflectance(ior))

    def node_layer_weight(self, output: SocketRef) -> SocketValue:
        blend = np.clip(self.value(output.input("Blend")), 0, 0.99999)
        self.warn(output.node, "it cannot depend on the direction; the value when seen from the front is used")
        if output.socket.name == "Facing":
            return uniform(0)
        return uniform(reflectance(1 / (1 - blend)))

    # Coordinates

    def coordinates(self, ref: SocketRef) -> tuple[Array, LayerRef]:
        """(4, 4) from coordinates on the mesh to those of a texture, and which ones these are."""
        origin = self.origin(ref)
        if not origin.socket.is_output:
            return np.eye(4), LayerRef("uv")
        node, name = origin.node, origin.socket.name
        if node.type == "UVMAP":
            return np.eye(4), LayerRef("uv", node.uv_map)
        if node.type == "TEX_COORD":
            if name in ("Generated", "Object") and node.object is None and not node.from_instancer:
                return np.eye(4), LayerRef("generated" if name == "Generated" else "object")
            if name != "UV":
                self.warn(node, f"{name} coordinates are not supported; the UV map is used")
            return np.eye(4), LayerRef("uv")
        if node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
            self.uses_mesh = True
            known = (
                node.attribute_name in self.mesh.uv_layers or attribute_values(self.mesh, node.attribute_name) is None
            )
            return np.eye(4), LayerRef("uv" if known else "vector", node.attribute_name)
        if node.type == "MAPPING" and node.vector_type != "NORMAL":
            matrix, layer = self.coordinates(origin.input("Vector"))
            return self.mapping(origin) @ matrix, layer
        if node.type == "VECTOR_ROTATE":
            matrix, layer = self.coordinates(origin.input("Vector"))
            centre = np.append(self.fixed(origin.input("Center")), 1)
            turn = np.eye(4)
            turn[:3, :3] = vector_rotate(self, origin)
            turn[:3, 3] = (centre - turn @ centre)[:3]
            return turn @ matrix, layer
        if node.type == "VECT_MATH" and node.operation in ("ADD", "SUBTRACT", "MULTIPLY", "SCALE"):
            matrix, layer = self.coordinates(origin.input(0))
            change = np.eye(4)
            if node.operation == "SCALE":
                change[:3, :3] *= self.value(origin.input("Scale"))
            elif node.operation == "MULTIPLY":
                change[:3, :3] = np.diag(self.fixed(origin.input(1)))
            else:
                change[:3, 3] = self.fixed(origin.input(1)) * (1 if node.operation == "ADD" else -1)
            return change @ matrix, layer
        inputs = [s for s in node.inputs if s.type == "VECTOR" and s.is_linked]
        self.warn(node, f"{node.bl_label} is not supported between UV map and image, and left out")
        return self.coordinates(SocketRef(inputs[0], origin.groups)) if inputs else (np.eye(4), LayerRef("uv"))

    def mapping(self, output: SocketRef) -> Array:
        """(4, 4) of a Mapping node."""
        node = output.node
        matrix = np.eye(4)
        matrix[:3, :3] = euler(self.fixed(output.input("Rotation"))) * self.fixed(output.input("Scale"))
        if node.vector_type == "VECTOR":
            return matrix
        matrix[:3, 3] = self.fixed(output.input("Location"))
        if node.vector_type == "POINT":
            return matrix
        if abs(np.linalg.det(matrix)) < 1e-12:
            self.warn(node, "a Scale of 0 cannot be undone; it is left out")
            return np.eye(4)
        return np.linalg.inv(matrix)
