"""Values at the corners of a mesh that textures refer to: UV maps, other coordinates, attributes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import bpy
import numpy as np

from ...drgs_blender.core.materials import Texture
from .. import mesh_arrays
from .nodes import LUMINANCE

Array = np.ndarray
Channel = Literal["rgb", "r", "g", "b", "a", "luminance"]
Change = Callable[[Array], Array]
Matrix = tuple[tuple[float, ...], ...]

_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}
_IDENTITY: Matrix = tuple(map(tuple, np.eye(4).tolist()))
#: Types of attributes -> (property, numbers an element, of those in Blender). Cycles has no others.
_KINDS = {
    "FLOAT_COLOR": ("color", 4),
    "BYTE_COLOR": ("color", 4),
    "FLOAT_VECTOR": ("vector", 3),
    "FLOAT2": ("vector", 2),
    "FLOAT": ("value", 1),
    "INT": ("value", 1),
    "INT8": ("value", 1),
    "BOOLEAN": ("value", 1),
}
#: What the node Hair Info says of strands (see `hair`), as attributes, and their domain.
HAIR_INFO = {"Hair Info: Intercept": "POINT", "Hair Info: Random": "CURVE"}


@dataclass(frozen=True, slots=True)
class LayerRef:
    """Coordinates or values of a mesh.

    Attributes
    ----------
    source : "uv" is a UV map ("" the active one), "attribute" values, "tangent" directions about the axis `name`, the
        others are coordinates by `matrix`
    matrix : (4, 4), from the coordinates to those of a texture
    change, mark : function of (n, 4) values, and what tells it from others
    """

    source: Literal["uv", "attribute", "generated", "object", "vector", "baked", "tangent"]
    name: str = ""
    matrix: Matrix = _IDENTITY
    mark: str = ""
    change: Change | None = field(default=None, compare=False)

    @property
    def label(self) -> str:
        """Its name in the frame, unlike that of any other."""
        place = (
            "" if self.matrix == _IDENTITY else hashlib.blake2b(repr(self.matrix).encode(), digest_size=6).hexdigest()
        )
        return " ".join(part for part in (self.source, self.name, place, self.mark) if part)

    def values(self, mesh: bpy.types.Mesh, corners: Array, polygons: Array, corner_vertices: Array) -> Array | None:
        """(m, 3, 2) or (m, 3, 4) float32 at the corners (m, 3) of triangles; None where the mesh has no such thing.

        `mesh` may be `hair.Hair`, which knows its corners.
        """
        if hasattr(mesh, "layer"):
            found = mesh.layer(self)
            return None if found is None else np.asarray(found)
        if self.source == "uv":
            uvs = mesh_arrays.read_uvs(mesh, self.name)
            return None if uvs is None else uvs[corners]
        if self.source == "attribute":
            found = attribute_values(mesh, self.name)
            if found is None:
                return None
            values = np.asarray(found if self.change is None else self.change(found), np.float32)
            return values[_elements(mesh.attributes[self.name].domain, corners, polygons, corner_vertices)]
        if self.source == "tangent":
            values = _tangents(_generated(mesh), self.name)
            return values[_elements("POINT", corners, polygons, corner_vertices)]
        there = self._coordinates(mesh)
        if there is None:
            return None
        coordinates, domain = there
        matrix = np.array(self.matrix)
        placed = (coordinates @ matrix[:2, :3].T + matrix[:2, 3]).astype(np.float32)
        return placed[_elements(domain, corners, polygons, corner_vertices)]

    def _coordinates(self, mesh: bpy.types.Mesh) -> tuple[Array, str] | None:
        """(n, 3) coordinates and what they are of."""
        if self.source == "object":
            return mesh_arrays.read_vertices(mesh), "POINT"
        if self.source == "vector":
            found = attribute_values(mesh, self.name)
            return None if found is None else (found[:, :3], mesh.attributes[self.name].domain)
        return _generated(mesh), "POINT"


@dataclass(frozen=True, slots=True)
class AttributeRef:
    """An attribute of a mesh as a texture; what `texture_refs.TextureRef` is for images.

    Attributes
    ----------
    average : (4,) linear mean of its values
    """

    layer: LayerRef
    channel: Channel
    sample: Array = field(compare=False)

    def texture(self, name: str = "", layer: str = "") -> Texture:
        """What it is on the surface."""
        return Texture(name, self.channel, layer=layer)

    def mean(self, warn: Callable[[str], None]) -> Array:
        """(3,) linear mean; of one channel three times the same."""
        return _shown(self.sample, self.channel).mean(axis=0)

    def only(self, channel: Channel) -> AttributeRef:
        """One channel or the luminance; of what is one channel already, itself."""
        return replace(self, channel=channel) if self.channel == "rgb" else self

    def curved(self, function: Change) -> tuple[AttributeRef, bool]:
        """With `function` of (n, 3) colours done to its values, and whether that is the same between the corners."""
        channel, before = self.channel, self.layer.change

        def change(values: Array) -> Array:
            values = values if before is None else before(values)
            made = np.nan_to_num(np.asarray(function(_shown(values, channel).astype(np.float64))))
            return np.column_stack([np.broadcast_to(made, (len(values), 3)), np.ones(len(values))]).astype(np.float32)

        probes = np.random.default_rng(0).uniform(0, 1, (64, 4)).astype(np.float32)
        made = change(probes)
        halves = (made[::2] + made[1::2]) / 2
        exact = np.allclose(change((probes[::2] + probes[1::2]) / 2), halves, rtol=1e-4, atol=1e-5)
        mark = hashlib.blake2b(made.tobytes(), digest_size=6).hexdigest()
        layer = replace(self.layer, change=change, mark=mark)
        shown = _shown(self.sample, channel)
        made = np.nan_to_num(np.broadcast_to(function(shown), shown.shape))
        return AttributeRef(layer, "rgb", np.column_stack([made, np.ones(len(shown))])), exact


def attribute_values(mesh: bpy.types.Mesh, name: str) -> Array | None:
    """(n, 4) float32 values of a mesh's attribute as Cycles reads them, colours linear; None without any."""
    if hasattr(mesh, "attribute_values"):
        return mesh.attribute_values(name)  # of `hair.Hair`
    attribute = mesh.attributes.get(name)
    if attribute is None or attribute.data_type not in _KINDS or attribute.domain == "EDGE" or not len(attribute.data):
        return None
    prop, width = _KINDS[attribute.data_type]
    kind = {"BOOLEAN": bool, "INT": np.int32, "INT8": np.int8}.get(attribute.data_type, np.float32)
    values = np.empty((len(attribute.data), width), kind)
    attribute.data.foreach_get(prop, values.ravel())
    out = np.zeros((len(values), 4), np.float32)
    out[:, 3] = 1
    out[:, : max(width, 3) if width == 1 else width] = values
    return out


def _generated(mesh: bpy.types.Mesh) -> Array:
    """(n, 3) Generated coordinates of the vertices."""
    rest = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("undeformed_co", rest)
    size = np.array(mesh.texspace_size)
    size = np.divide(0.5, size, out=np.zeros(3), where=size != 0)
    return (rest.reshape(-1, 3) - np.array(mesh.texspace_location)) * size + 0.5


def _tangents(generated: Array, axis: str) -> Array:
    """(n, 4) float32 directions about an axis through the middle of Generated coordinates, as Cycles has them."""
    x, y = {"X": (1, 2), "Y": (0, 2), "Z": (0, 1)}[axis]
    values = np.zeros((len(generated), 4), np.float32)
    values[:, x], values[:, y] = 0.5 - generated[:, y], generated[:, x] - 0.5
    return values


def colour_average(values: Array) -> Array:
    """Of each value the mean of red, green and blue: what an attribute is as a number."""
    grey = values[:, :3].mean(axis=1, keepdims=True)
    return np.concatenate([np.repeat(grey, 3, axis=1), np.ones_like(grey)], axis=1)


def _shown(values: Array, channel: Channel) -> Array:
    """(n, 3) colours that a channel of (n, 4) values is."""
    if channel == "rgb":
        return values[:, :3]
    grey = values[:, :3] @ LUMINANCE if channel == "luminance" else values[:, _CHANNELS[channel]]
    return np.repeat(grey[:, None], 3, axis=1)


def _elements(domain: str, corners: Array, polygons: Array, corner_vertices: Array) -> Array:
    """(m, 3) which value of a domain each corner has."""
    if domain == "CORNER":
        return corners
    return corner_vertices[corners] if domain == "POINT" else np.repeat(polygons[:, None], 3, axis=1)
