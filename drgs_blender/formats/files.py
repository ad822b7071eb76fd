"""Results of readers of foreign files: plain arrays, with notes for the user about them.

Colours are linear Rec.709 already; positions are in the axes of the file unless a field says otherwise.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..core.asset import Environment, Surfels
from ..core.color import to_unit

Array = np.ndarray


@dataclass(slots=True)
class SurfelFile:
    """Surfels of a file.

    Attributes
    ----------
    surfels : Surfels
        Activated values; axes as in the file (see formats.axes). Properties that no layout knows, and known ones that a
        surfel cannot hold, are in ``surfels.extras``.
    layout : str
        Which program writes such files.
    unknown : list of str
        Properties of the file that the layout does not name.
    notes : list of str
        Conversions, losses and assumptions of the reader.
    up : str, optional
        The up axis that the format prescribes (a key of ``axes.UP_AXES``); None where it prescribes none.
    assumed : list of str
        The notes that concern surfels and their materials only, not the splats.
    """

    surfels: Surfels
    layout: str
    unknown: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    up: str | None = None
    assumed: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Image:
    """A texture.

    Attributes
    ----------
    pixels : (h, w, c) uint8, uint16 or float32 array
        Row 0 at the top; integers are fractions of their maximum.
    srgb : bool
        Integers are sRGB-encoded (else linear); float32 is linear whatever this says.
    uv_transform : (2, 3) float64 array
        Texture coordinates = uv_transform @ (u, v, 1), v **up** (Blender's convention).
    wrap : tuple of str
        "repeat", "clamp" or "mirror" along u and v.
    file : bytes
        The file that it was decoded from, where that is known; else empty.
    """

    pixels: Array
    srgb: bool
    uv_transform: Array = field(default_factory=lambda: np.eye(2, 3))
    wrap: tuple[str, str] = ("repeat", "repeat")
    file: bytes = b""

    @property
    def alpha(self) -> Image | None:
        """Its last channel as an image of its own; None without alpha."""
        if self.pixels.ndim < 3 or self.pixels.shape[2] not in (2, 4):
            return None
        return replace(self, pixels=to_unit(self.pixels[..., -1]), srgb=False, file=b"")


@dataclass(slots=True)
class MaterialFile:
    """A material: factors, times images where there are any.

    Attributes
    ----------
    base_colour : tuple of float
        Linear Rec.709 factor.
    base_colour_image : Image, optional
        RGB(A); multiplies base_colour.
    metallic_roughness_image : Image, optional
        G is roughness, B is metallic (glTF); multiplies the factors; never sRGB.
    normal_image : Image, optional
        Normals in tangent space (MikkTSpace), 2 * RGB - 1, green upwards; never sRGB.
    normal_strength : float
        Of the normal map, as of Blender's node.
    alpha : float
        In [0, 1]: how much of what lies behind it the surface hides.
    alpha_image : Image, optional
        First channel multiplies `alpha`; never sRGB.
    cut_out : bool
        Whether alpha is 0 or 1 by intent, as of leaves: then what is mostly transparent is not there.
    emission : tuple of float
        Linear Rec.709 radiance.
    emission_image : Image, optional
        RGB; multiplies emission.
    specular, coat : float
        As `core.asset.model.MATERIAL_CHANNELS` has them.
    specular_image, coat_image : Image, optional
        First channel; multiplies the factors; never sRGB.
    """

    name: str
    base_colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    roughness: float = 0.5
    metallic: float = 0.0
    base_colour_image: Image | None = None
    metallic_roughness_image: Image | None = None
    normal_image: Image | None = None
    normal_strength: float = 1.0
    alpha: float = 1.0
    alpha_image: Image | None = None
    cut_out: bool = False
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_image: Image | None = None
    specular: float = 0.5
    specular_image: Image | None = None
    coat: float = 0.0
    coat_image: Image | None = None


@dataclass(slots=True)
class MeshFile:
    """Triangles of a file with what is needed to look up their materials.

    Attributes
    ----------
    vertices : (n, 3) float32 array
    faces : (m, 3) int32 array
    corner_normals : (m, 3, 3) float32 array, optional
        Unit.
    corner_uvs : (m, 3, 2) float32 array, optional
        v up (0 is the bottom row of an image).
    face_material : (m,) int32 array, optional
        Into `materials`, -1 without one.
    materials : list of MaterialFile
    parts : list of tuple of (str, int, int)
        (name, first face, one past the last face) of each named object or primitive.
    vertex_colours : (n, 3) array, optional
        Linear factor on the base colour.
    vertex_roughness, vertex_metallic : (n,) array, optional
        In [0, 1], used in place of the material's.
    up_axis : {"Z", "unknown"}
        "Z" where positions are known to be Z up (glTF is converted on reading), "unknown" else.
    notes : list of str
        Conversions, losses and assumptions of the reader.
    numbers : (n,) int64 array, optional
        Of the vertices in the file, where the reader left some out or joined some; None: 0 to n - 1.
    file_count : int, optional
        How many vertices the file has; None: n.
    """

    vertices: Array
    faces: Array
    corner_normals: Array | None = None
    corner_uvs: Array | None = None
    face_material: Array | None = None
    materials: list[MaterialFile] = field(default_factory=list)
    parts: list[tuple[str, int, int]] = field(default_factory=list)
    vertex_colours: Array | None = None
    vertex_roughness: Array | None = None
    vertex_metallic: Array | None = None
    up_axis: Literal["Z", "unknown"] = "unknown"
    notes: list[str] = field(default_factory=list)
    numbers: Array | None = None
    file_count: int | None = None

    def __post_init__(self) -> None:
        self.vertices = np.ascontiguousarray(self.vertices, dtype=np.float32).reshape(-1, 3)
        self.faces = np.ascontiguousarray(self.faces, dtype=np.int32).reshape(-1, 3)
        if self.face_material is None:
            self.face_material = np.full(len(self.faces), 0 if self.materials else -1, np.int32)

    @property
    def vertex_numbers(self) -> Array:
        """(n,) int64: `numbers`, also where there are none."""
        return np.arange(len(self.vertices)) if self.numbers is None else self.numbers


@dataclass(slots=True)
class EnvironmentFile:
    """Distant light of a file, converted to Blender's lat-long mapping.

    Attributes
    ----------
    environment : Environment
        Linear radiance.
    layout : str
        Which program writes such files.
    notes : list of str
        Conversions and assumptions of the reader.
    """

    environment: Environment
    layout: str
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class MaterialsFile:
    """Materials one a vertex, without the mesh (NeRO).

    Attributes
    ----------
    albedo : (n, 3) float32 array
        In [0, 1], linear.
    roughness, metallic : (n,) float32 array
        In [0, 1], linear.
    """

    albedo: Array
    roughness: Array
    metallic: Array
    layout: str
    notes: list[str] = field(default_factory=list)


def plain_name(path: str | Path) -> str:
    r"""The name of a file as text that every program can show: bytes of it that are no UTF-8 as \xe9."""
    return os.fsencode(Path(path).name).decode(errors="backslashreplace")
