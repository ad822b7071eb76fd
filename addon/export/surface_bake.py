"""Channels of materials that are not read directly -> requests for `bakes`, and their results -> textures on meshes."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.materials import Image, Texture
from .. import mesh_arrays
from ..bakes import node_trees
from ..bakes.manager import Request
from ..bakes.requests import Wanted, request
from ..bakes.store import Baked
from .layers import LayerRef
from .socket_value import SocketValue
from .sockets import SocketRef, surface_of

Array = np.ndarray
Warn = Callable[[str], None]

#: Outputs that are another for every ray, view, instance or frame, by the type of their node; None is all of them.
_NEVER: dict[str, set[str] | None] = {
    **dict.fromkeys(("LIGHT_PATH", "LAYER_WEIGHT", "FRESNEL", "CAMERA", "PARTICLE_INFO", "HAIR_INFO"), None),
    **dict.fromkeys(("POINT_INFO", "VOLUME_INFO", "AMBIENT_OCCLUSION", "SCRIPT", "RAYCAST"), None),
    "TEX_COORD": {"Reflection", "Camera", "Window"},
    "NEW_GEOMETRY": {"Incoming", "Backfacing"},
    "OBJECT_INFO": {"Random"},
}
#: Nodes that depend on where the mesh is, and how it is deformed.
_PLACED = {"NEW_GEOMETRY", "OBJECT_INFO", "VECT_TRANSFORM", "WIREFRAME", "BEVEL", "TANGENT", "NORMAL_MAP", "BUMP"}
#: Outputs of Texture Coordinate that do not.
_STUCK = {"UV", "Generated"}
#: How attributes are read: type -> property, numbers an element, their type.
_KINDS = {
    "FLOAT_COLOR": ("color", 4, np.float32),
    "BYTE_COLOR": ("color", 4, np.float32),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT2": ("vector", 2, np.float32),
    "FLOAT": ("value", 1, np.float32),
    "INT": ("value", 1, np.int32),
    "BOOLEAN": ("value", 1, bool),
}


class BakedLayer(LayerRef):
    """A UV map that was made for a bake."""

    __slots__ = ("_uvs",)
    _uvs: Array

    def __init__(self, uvs: Array) -> None:
        super().__init__("baked", hashlib.blake2b(uvs.tobytes(), digest_size=8).hexdigest())
        object.__setattr__(self, "_uvs", uvs)

    def values(self, mesh: bpy.types.Mesh, corners: Array, polygons: Array, corner_vertices: Array) -> Array | None:
        return self._uvs[corners] if corners.size == 0 or corners.max() < len(self._uvs) else None


@dataclass(frozen=True)
class BakedRef:
    """A baked channel as a texture; what `texture_refs.TextureRef` is for images."""

    image: Image = field(compare=False)
    name: str
    channel: str
    layer: LayerRef

    def export(self, warn: Warn) -> Image:
        """The pixels."""
        return self.image

    def texture(self, name: str, layer: str = "") -> Texture:
        """What it is on the surface."""
        channel: Any = self.channel
        return Texture(name, channel, extension="extend", layer=layer)

    def mean(self, warn: Warn) -> Array:
        """(3,) mean of the bytes; nothing is made of a baked channel."""
        return np.full(3, 0.5)


class SurfaceBakes:
    """What is baked of the materials of one mesh.

    Attributes
    ----------
    requests : list of Request
        What is not there yet.
    is_placed : bool
        Whether something depends on where the object is.
    """

    def __init__(self, wanted: Wanted, obj: bpy.types.Object, mesh: bpy.types.Mesh, slots: list[Any]) -> None:
        self._wanted, self._obj, self._mesh, self._slots = wanted, obj, mesh, slots
        self.requests: list[Request] = []
        self.is_placed = False
        self._arrays: dict[str, Array] | None = None

    def channel(
        self,
        material: bpy.types.Material,
        name: str,
        value: SocketValue,
        note: Warn,
        leaves: node_trees.Leaves | None = None,
        source: SocketRef | None = None,
    ) -> tuple[SocketValue, bool]:
        """A channel of a material, and whether its approximations are no matter any more.

        Parameters
        ----------
        value : as it is approximated
        note : called with the reason where it cannot be baked
        leaves : the only shaders that count; None: all do
        source : input that is baked by itself: of an AOV Output node, or the height of a Bump node
        """
        follow = node_trees.follow_channel(name, leaves)
        output = source or surface_of(material.node_tree)
        if output is None or output.groups:  # what is within a group has no place of its own
            return value, False
        found = node_trees.trees(material.node_tree, output.node, follow)
        if _never(found):
            return value, False
        more: dict[str, Any] = {} if source is None else {"output": output.node.name}
        if leaves is not None:
            more["leaves"] = [list(leaf) for leaf in leaves]
        made = self._request(material, name, found, follow, more)
        baked = self._wanted.find(made)
        if baked is not None:
            return self._value(made.key, name, baked), True
        if failure := self._wanted.failed(made):
            about = f'Material "{material.name}" on "{self._obj.name}": its {_words(name)}'
            self._wanted.tell(made, f"{about} cannot be baked ({failure}); it is approximated", note)
            self._wanted.depends(made, *value.approximations)
            return value, False
        self.requests.append(made)
        return value, True

    def end(self) -> None:
        """The mesh will be freed: forget it. What is wanted has its arrays."""
        self._arrays = None

    def _request(
        self,
        material: bpy.types.Material,
        name: str,
        found: list[node_trees.Tree],
        follow: node_trees.Follow,
        more: dict[str, Any],
    ) -> Request:
        arrays, mesh, obj = self._read(), self._mesh, self._obj
        numbers = [i for i, slot in enumerate(self._slots) if slot is not None and slot == material]
        index = np.clip(arrays["material_index"], 0, max(len(self._slots) - 1, 0))
        faces = np.isin(index, numbers)
        attributes = _attributes(mesh, found)
        extra = {f"attribute-{i}": values for i, (_, values) in enumerate(attributes)}
        placed = any(
            _is_placed(node) for tree in found for node in tree.nodes if node.type != "BUMP" or name != "height"
        )
        used = ["corner_vertices", "starts", *(key for key in arrays if key.startswith("uv-"))]
        used += ["generated"] + (["vertices", "normals"] if placed else [])
        digest = hashlib.blake2b(faces.tobytes(), digest_size=16)
        for values in (*(arrays[key] for key in used if key in arrays), *extra.values()):
            digest.update(np.ascontiguousarray(values).tobytes())
        own = {"name": obj.name, "matrix": np.eye(4).tolist(), "colour": [1.0] * 4, "index": 0}
        if placed:
            self.is_placed = True
            own |= {"matrix": [list(row) for row in obj.matrix_world], "colour": list(obj.color)}
            own |= {"index": obj.pass_index}
        else:
            own["name"] = ""
        colours = mesh.color_attributes
        active = mesh.uv_layers.active
        rendered = next((layer.name for layer in mesh.uv_layers if layer.active_render), active.name if active else "")
        about: dict[str, Any] = {
            "channel": name,
            "size": self._wanted.texture_size,
            "mesh": digest.hexdigest(),
            "object": own,
            "uv_maps": [layer.name for layer in mesh.uv_layers],
            "active_uv_map": rendered,
            "attributes": [spec for spec, _ in attributes],
            "active_colour": colours[max(colours.render_color_index, 0)].name if len(colours) else "",
            **more,
        }

        def write(folder: Path) -> None:
            # In memory first: NumPy's archive complains at its own end of a disk that is full.
            data = io.BytesIO()
            np.savez(data, faces=faces, **arrays, **extra)  # type: ignore[arg-type]
            (folder / "mesh.npz").write_bytes(data.getbuffer())

        label = f'Material "{material.name}" on "{obj.name}", {_words(name)}'
        return request("surface", material, label, found, about, write=write, follow=follow)

    def _read(self) -> dict[str, Array]:
        """Arrays of the mesh, as `baked_surface` needs them."""
        if self._arrays is None:
            mesh = self._mesh
            rest = _undeformed(mesh, self._obj)
            size = np.array(mesh.texspace_size)
            size = np.divide(0.5, size, out=np.zeros(3), where=size != 0)
            starts = np.empty(len(mesh.polygons), np.int32)
            mesh.polygons.foreach_get("loop_start", starts)
            index = mesh_arrays.read_material_index(mesh)
            normals = mesh_arrays.smooth_or_corner_normals(mesh)
            self._arrays = {
                "vertices": mesh_arrays.read_vertices(mesh),
                "corner_vertices": mesh_arrays.read_corner_vertices(mesh),
                "starts": starts,
                "triangles": mesh_arrays.read_loop_triangles(mesh)[0],
                "material_index": np.zeros(len(starts), np.int32) if index is None else index,
                "generated": ((rest - np.array(mesh.texspace_location)) * size + 0.5).astype(np.float32),
            }
            if normals is not None:
                self._arrays["normals"] = normals
            for number, layer in enumerate(mesh.uv_layers):
                uvs = np.empty((len(mesh.loops), 2), np.float32)
                layer.data.foreach_get("uv", uvs.ravel())
                self._arrays[f"uv-{number}"] = uvs
        return self._arrays

    def _value(self, key: str, name: str, baked: Baked) -> SocketValue:
        colour, encoded = name in node_trees.COLOURS or name == "aov Color", name in node_trees.COLOURS - {"emission"}
        image = Image(f"baked {key}", baked["pixels"], "srgb" if encoded else "linear")
        layer = LayerRef("uv") if len(baked["uvs"]) == 0 else BakedLayer(baked["uvs"])
        channel = "rgb" if colour else "r"
        return SocketValue(np.full(3, float(baked["factor"])), BakedRef(image, image.name, channel, layer))


def _undeformed(mesh: bpy.types.Mesh, obj: bpy.types.Object) -> Array:
    """(n, 3) float32: vertices before they were deformed, which Generated coordinates are of."""
    rest = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("undeformed_co", rest.ravel())
    source = obj.original.data
    # Blender keeps them for final pictures alone; where all modifiers deform, they are the object's own all the same.
    own = isinstance(source, bpy.types.Mesh) and not source.is_editmode and len(source.vertices) == len(rest)
    if own and (rest == mesh_arrays.read_vertices(mesh)).all():
        return mesh_arrays.read_vertices(source)
    return rest


def _words(name: str) -> str:
    return name.replace("_", " ")


def _never(found: list[node_trees.Tree]) -> bool:
    """Whether something depends on the ray, the view, the instance or the frame."""
    for node in (node for tree in found for node in tree.nodes):
        names = _NEVER.get(node.type, set())
        if any(output.is_linked and (names is None or output.name in names) for output in node.outputs):
            return True
        if node.type == "ATTRIBUTE" and node.attribute_type != "GEOMETRY":
            return True
        if node.type in ("TEX_COORD", "UVMAP") and getattr(node, "from_instancer", False):
            return True
    return False


def _is_placed(node: bpy.types.Node) -> bool:
    if node.type == "TEX_COORD":
        return any(output.is_linked and output.name not in _STUCK for output in node.outputs)
    return node.type in _PLACED


def _attributes(mesh: bpy.types.Mesh, found: list[node_trees.Tree]) -> list[tuple[list[str], Array]]:
    """Attributes of the mesh that nodes ask for: name, type, domain and property, and their values."""
    names = []
    for node in (node for tree in found for node in tree.nodes):
        if node.type == "VERTEX_COLOR":
            colours = mesh.color_attributes
            active = colours[max(colours.render_color_index, 0)].name if len(colours) else ""
            names.append(node.layer_name or active)
        elif node.type in ("ATTRIBUTE", "UVMAP"):
            names.append(getattr(node, "attribute_name", "") or getattr(node, "uv_map", ""))
    made = []
    for name in dict.fromkeys(names):
        attribute = mesh.attributes.get(name)
        if attribute is None or name in mesh.uv_layers or attribute.data_type not in _KINDS:
            continue
        prop, width, kind = _KINDS[attribute.data_type]
        values = np.empty(len(attribute.data) * width, kind)
        attribute.data.foreach_get(prop, values)
        made.append(([name, attribute.data_type, attribute.domain, prop], values))
    return made
