"""A DR-GS asset as plain arrays: surfels, mesh, binding, environment.

Conventions of every array in this project: right-handed, Z up, metres; float32, C-contiguous, (n, 3); colour is
linear Rec.709, scene-referred; quaternions are wxyz; roughness is perceptual (alpha = roughness squared).
Asset arrays are in **object space**: the space in which the mesh object's vertices live in Blender.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..arrays import outside
from ..errors import AssetError
from .textures import MeshTextures

Array = np.ndarray


@dataclass(frozen=True, slots=True)
class Channel:
    """A material channel of vertices and surfels.

    Attributes
    ----------
    width : int
        Numbers per vertex: 3 of a colour, else 1.
    neutral : float or None
        Value that an asset without the channel has everywhere; None: every asset has the channel.
    limit : float
        Largest value; the least is 0.
    surfels : bool
        Whether surfels have values of their own; else theirs are those of the vertices around them.
    """

    width: int
    neutral: float | None = None
    limit: float = 1.0
    surfels: bool = True


#: Material channels by name. Albedo is linear Rec.709; opacity is the share of the surface that is there; emission is
#: linear Rec.709 radiance; specular is Principled's specular IOR level, coat the weight of a coat of roughness 0.03.
MATERIAL_CHANNELS: dict[str, Channel] = {
    "albedo": Channel(3),
    "roughness": Channel(1),
    "metallic": Channel(1),
    "opacity": Channel(1, neutral=1.0, surfels=False),
    "emission": Channel(3, neutral=0.0, limit=float("inf")),
    "specular": Channel(1, neutral=0.5),
    "coat": Channel(1, neutral=0.0),
}
#: Channels that every asset has, and that every surfel of a frame is rendered with.
BASE_CHANNELS = tuple(name for name, channel in MATERIAL_CHANNELS.items() if channel.neutral is None)
#: Channels that an asset may lack.
OPTIONAL_CHANNELS = tuple(name for name, channel in MATERIAL_CHANNELS.items() if channel.neutral is not None)
#: Those of them that surfels have of their own.
SURFEL_CHANNELS = tuple(name for name in OPTIONAL_CHANNELS if MATERIAL_CHANNELS[name].surfels)


def _optional_channels(part: Surfels | Mesh, names: Iterable[str], count: int, subject: str) -> None:
    """Bring the channels `names` of `part`, where it has them, to their shapes; AssetError where they do not fit."""
    for name in names:
        if (values := getattr(part, name)) is not None:
            shape = (count, 3) if MATERIAL_CHANNELS[name].width == 3 else (count,)
            setattr(part, name, as_float(values, shape, f"{subject} {name}"))


def as_float(values: Any, shape: tuple[int, ...], name: str) -> Array:
    """Return `values` as a C-contiguous float32 array of `shape` (-1 is free) or raise AssetError naming it."""
    try:
        array = np.ascontiguousarray(values, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise AssetError(name, f"is not an array of numbers ({error})") from error
    fits = array.ndim == len(shape) and all(w in (-1, g) for w, g in zip(shape, array.shape, strict=False))
    if not fits:
        raise AssetError(name, f"has shape {array.shape}, expected {shape}")
    return array


def neutral_values(name: str, count: int) -> Array:
    """(count,) or (count, 3) float32 neutral values of an optional channel."""
    channel = MATERIAL_CHANNELS[name]
    assert channel.neutral is not None
    return np.full((count, 3) if channel.width == 3 else count, channel.neutral, np.float32)


@dataclass(slots=True)
class Surfels:
    """2D Gaussian surfels, activated (never raw network values).

    Attributes
    ----------
    centre : (n, 3) float32 array
        Metres, object space.
    scale : (n, 2) float32 array
        Metres: standard deviations along the two tangents (linear, not log).
    rotation : (n, 4) float32 array
        Unit quaternion wxyz; the rotated X and Y axes are the tangents, Z is the normal.
    opacity : (n,) float32 array
        In [0, 1].
    albedo : (n, 3) float32 array
        In [0, 1].
    roughness, metallic : (n,) float32 array
        In [0, 1].
    sh : (n, k, 3) float32 array, optional
        Spherical-harmonic outgoing colour as captured (3DGS basis and order).
    extras : dict of str to (n,) or (n, c) float32 array
        Unknown per-surfel properties kept from the file.
    emission, specular, coat : array, optional
        See `MATERIAL_CHANNELS`; None: neutral everywhere.
    """

    centre: Array
    scale: Array
    rotation: Array
    opacity: Array
    albedo: Array
    roughness: Array
    metallic: Array
    sh: Array | None = None
    extras: dict[str, Array] = field(default_factory=dict)
    emission: Array | None = None
    specular: Array | None = None
    coat: Array | None = None

    def __post_init__(self) -> None:
        self.centre = as_float(self.centre, (-1, 3), "surfel centre")
        n = len(self.centre)
        self.scale = as_float(self.scale, (n, 2), "surfel scale")
        self.rotation = as_float(self.rotation, (n, 4), "surfel rotation")
        self.opacity = as_float(self.opacity, (n,), "surfel opacity")
        self.albedo = as_float(self.albedo, (n, 3), "surfel albedo")
        self.roughness = as_float(self.roughness, (n,), "surfel roughness")
        self.metallic = as_float(self.metallic, (n,), "surfel metallic")
        if self.sh is not None:
            self.sh = as_float(self.sh, (n, -1, 3), "surfel sh")
        _optional_channels(self, SURFEL_CHANNELS, n, "surfel")

    def __len__(self) -> int:
        return len(self.centre)


@dataclass(slots=True)
class SourceVertices:
    """The vertices of the mesh from which an asset's was made, and where each vertex of the asset is among them.

    Attributes
    ----------
    index : (n, k) int32 array
        Vertices of the source, k from 1 to 3 for each of the asset.
    weights : (n, k) float32 array
        Their weights, of sum 1.
    count : (1,) int32 array
        How many vertices the source has.
    transform : (3, 3) float32 array
        From the source's axes and unit to the asset's: p = transform @ q.
    """

    index: Array
    weights: Array
    count: Array
    transform: Array = field(default_factory=lambda: np.eye(3, dtype=np.float32))

    def __post_init__(self) -> None:
        self.index = np.ascontiguousarray(self.index, dtype=np.int32)
        self.count = np.ascontiguousarray(self.count, dtype=np.int32)
        if self.index.ndim != 2 or not 1 <= self.index.shape[1] <= 3:
            raise AssetError("source vertices", f"have an index of shape {self.index.shape}, expected (n, 1 to 3)")
        if self.count.shape != (1,) or self.count[0] < 0:
            raise AssetError("source vertices", f"have the count {self.count.tolist()}, expected one number")
        self.weights = as_float(self.weights, self.index.shape, "source weights")
        self.transform = as_float(self.transform, (3, 3), "source transform")

    @classmethod
    def identity(cls, count: int) -> SourceVertices:
        """Vertices that are those of the source, in its order."""
        return cls(np.arange(count)[:, None], np.ones((count, 1)), np.array([count]))

    @property
    def in_order(self) -> bool:
        """Whether the vertices are those of the source in its order."""
        n = len(self.index)
        return self.index.shape == (n, 1) and bool((self.index[:, 0] == np.arange(n)).all())

    def turned(self, matrix: Array) -> SourceVertices:
        """The same, of an asset whose vertices were moved by a (3, 3) matrix."""
        return replace(self, transform=matrix @ self.transform)

    def to_asset(self, vertices: Array) -> Array:
        """(n, 3) float32 vertices of the asset for those of the source; exact where a vertex is one of the source.

        Parameters
        ----------
        vertices : (count, 3) array
            A pose of the source, in its axes and unit.
        """
        moved = np.zeros((len(self.index), 3))
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite, the scene counts and names
            for index, weights in zip(self.index.T, self.weights.T, strict=True):
                used = weights != 0  # what does not count may be infinite
                moved[used] += weights[used, None] * vertices[index[used]].astype(np.float64)
            if not np.array_equal(self.transform, np.eye(3)):
                moved = moved @ self.transform.T.astype(np.float64)
            return moved.astype(np.float32)


@dataclass(slots=True)
class Mesh:
    """Triangle mesh that carries the materials rays meet.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        Metres, object space.
    faces : (m, 3) int32 array
        Counter-clockwise seen from outside.
    albedo : (n, 3) float32 array
        Per vertex, in [0, 1].
    roughness, metallic : (n,) float32 array
        Per vertex, in [0, 1].
    groups : dict of str to (k,) int32 array
        Vertices of the named sets kept from the source (one per material or part).
    source : SourceVertices, optional
        Where the vertices come from; None: they are the source's own, in its order.
    textures : MeshTextures, optional
        Images on its faces, which rays meet in place of the materials of its vertices.
    opacity, emission, specular, coat : array, optional
        Per vertex, see `MATERIAL_CHANNELS`; None: neutral everywhere.
    """

    vertices: Array
    faces: Array
    albedo: Array
    roughness: Array
    metallic: Array
    groups: dict[str, Array] = field(default_factory=dict)
    source: SourceVertices | None = None
    opacity: Array | None = None
    emission: Array | None = None
    specular: Array | None = None
    coat: Array | None = None
    textures: MeshTextures | None = None

    def __post_init__(self) -> None:
        self.vertices = as_float(self.vertices, (-1, 3), "mesh vertices")
        n = len(self.vertices)
        self.faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise AssetError("mesh faces", f"have shape {self.faces.shape}, expected (-1, 3)")
        if (wrong := outside(self.faces, n)) is not None:
            raise AssetError("mesh faces", f"refer to vertex {wrong} but there are only {n} vertices, from 0 on")
        self.albedo = as_float(self.albedo, (n, 3), "mesh albedo")
        self.roughness = as_float(self.roughness, (n,), "mesh roughness")
        self.metallic = as_float(self.metallic, (n,), "mesh metallic")
        _optional_channels(self, OPTIONAL_CHANNELS, n, "mesh")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the material channels that it has."""
        return tuple(name for name in MATERIAL_CHANNELS if getattr(self, name) is not None)

    def channel(self, name: str) -> Array:
        """(n,) or (n, 3) float32 values of a material channel; neutral ones where it has none."""
        values: Array | None = getattr(self, name)
        return neutral_values(name, len(self.vertices)) if values is None else values

    @property
    def source_count(self) -> int:
        """How many vertices the source has."""
        return len(self.vertices) if self.source is None else int(self.source.count[0])

    def orders_of(self, count: int) -> tuple[str, ...]:
        """Orders of a pose with `count` vertices: "asset", that of this mesh, and "source", where that differs."""
        own, source = len(self.vertices) == count, self.source is not None and self.source_count == count
        return ("asset",) * own + ("source",) * source

    def in_own_order(self, vertices: Array) -> Array:
        """A pose in the order of this mesh, if it has as many vertices as its source and not as many as itself.

        Any other is returned as it is.
        """
        if np.shape(vertices)[1:] != (3,) or self.orders_of(len(vertices)) != ("source",):
            return vertices
        assert self.source is not None
        return self.source.to_asset(vertices)

    @classmethod
    def empty(cls) -> Mesh:
        """No mesh: of surfels that follow their object's matrix alone."""
        vertices, numbers = np.empty((0, 3), np.float32), np.empty(0, np.float32)
        return cls(vertices, np.empty((0, 3), np.int32), vertices, numbers, numbers)


@dataclass(slots=True)
class Binding:
    """Binding of surfel i to face ``face[i]``: p = sum_k barycentric_k v_k + offset * r_rest * n_face.

    Attributes
    ----------
    face : (n,) int32 array
    barycentric : (n, 3) float32 array
        Sums to 1.
    offset : (n,) float32 array
        Along the unit face normal in units of the rest face's mean edge length.
    normal : (n, 3) float32 array
        Shading normal in the orthonormal frame (t, b, s) of the face, where s is the interpolated smooth vertex normal,
        t the first edge projected off s, b = s x t. Surfels made from the mesh have exactly (0, 0, 1).
    """

    face: Array
    barycentric: Array
    offset: Array
    normal: Array

    def __post_init__(self) -> None:
        self.face = np.ascontiguousarray(self.face, dtype=np.int32)
        n = len(self.face)
        self.barycentric = as_float(self.barycentric, (n, 3), "binding barycentric")
        self.offset = as_float(self.offset, (n,), "binding offset")
        self.normal = as_float(self.normal, (n, 3), "binding normal")


@dataclass(slots=True)
class Environment:
    """Distant light: lat-long radiance in Blender's mapping.

    ``radiance`` is (h, w, 3) float32, row 0 at +Z; u = 0.5 - atan2(y, x) / 2pi, v = acos(z) / pi; +X at the centre.
    """

    radiance: Array

    def __post_init__(self) -> None:
        self.radiance = as_float(self.radiance, (-1, -1, 3), "environment")


@dataclass(slots=True)
class Asset:
    """Everything that does not change during an animation.

    ``binding`` is None only until the surfels are bound, and where the mesh has no faces. ``provenance`` is JSON-able:
    where each part came from, conversions done, counts dropped.
    """

    surfels: Surfels
    mesh: Mesh
    binding: Binding | None = None
    environment: Environment | None = None
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class PosedSurfels:
    """Surfels of one frame, ready to rasterise: what every deformation yields.

    Attributes
    ----------
    centre : (n, 3) float32 array
        World space.
    tangent_u, tangent_v : (n, 3) float32 array
        World space, **scaled** (F s_u t_u, F s_v t_v); need not be orthogonal: the kernel at q solves q - centre = u
        tangent_u + v tangent_v and is exp(-(u^2 + v^2) / 2).
    normal : (n, 3) float32 array
        Unit shading normal, world space.
    opacity, albedo, roughness, metallic : array
        As in Surfels, after the frame's material edits.
    object_index : (n,) int32 array
        Index into Frame.objects.
    """

    centre: Array
    tangent_u: Array
    tangent_v: Array
    normal: Array
    opacity: Array
    albedo: Array
    roughness: Array
    metallic: Array
    object_index: Array

    def __len__(self) -> int:
        return len(self.centre)
