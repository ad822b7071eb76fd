"""Materials of ordinary meshes, and the images and textures that vary them over a surface.

Colours are linear Rec.709, directions those of the mesh's object space unless a field says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Array = np.ndarray


@dataclass(slots=True)
class Image:
    """Pixels that textures refer to by name.

    Attributes
    ----------
    pixels : (h, w, c) uint8 or float32 array
        Row 0 at the top; alpha is straight and last. Four channels; of bytes also three, or one of a grey, where all
        is opaque.
    encoding : {"linear", "srgb"}
        "srgb" is decoded by the engine (colour channels only), "linear" is linear Rec.709 or no colour at all.
    """

    name: str
    pixels: Array
    encoding: Literal["linear", "srgb"] = "linear"

    @property
    def rgba(self) -> Array:
        """(h, w, 4): its pixels with all channels."""
        if self.pixels.shape[2] == 4:
            return self.pixels
        whole = np.full((*self.pixels.shape[:2], 4), 255, np.uint8)
        whole[..., :3] = self.pixels
        return whole


@dataclass(slots=True)
class Texture:
    """An image on a surface, or values that lie on the surface itself.

    Attributes
    ----------
    image : str
        Name of one of ``Frame.images``; "" for the values of the layer itself, which then has four numbers a corner.
    channel : {"rgb", "r", "g", "b", "a", "luminance"}
        Channel that is used: "rgb" for colours, one channel or the luminance for numbers.
    transform : (2, 3) float64 array
        Maps (u, v, 1) to the image's own (u, v); v = 0 is the image's bottom edge.
    interpolation : {"linear", "closest"}
        As Blender's Image Texture node.
    extension : {"repeat", "extend", "clip", "mirror"}
        As Blender's Image Texture node.
    layer : str
        Name of one of ``MeshState.layers``, whose coordinates place the image; "" for ``MeshState.uvs``.
    """

    image: str
    channel: Literal["rgb", "r", "g", "b", "a", "luminance"] = "rgb"
    transform: Array = field(default_factory=lambda: np.eye(2, 3))
    interpolation: Literal["linear", "closest"] = "linear"
    extension: Literal["repeat", "extend", "clip", "mirror"] = "repeat"
    layer: str = ""


@dataclass(slots=True)
class SurfaceDetail:
    """A normal map or a bump map, which changes the shading normal; as Blender's nodes of these names.

    Attributes
    ----------
    kind : {"tangent", "object", "world", "blender_object", "blender_world", "bump"}
        Space of a normal map, or a bump map.
    texture : Texture, optional
        Normals as colours, or heights; None: the same everywhere. The tangents of a normal map follow the coordinates
        of ``tangents``.
    colour : tuple of float
        Linear Rec.709, times the texture; of a bump map the first counts.
    strength : float
        At least 0.
    distance : float
        Metres that a height of 1 stands out, of a bump map; negative ones go in.
    tangents : str
        Layer with two numbers a corner whose coordinates the tangents follow, of a normal map in tangent space; "" for
        ``MeshState.uvs``.
    """

    kind: Literal["tangent", "object", "world", "blender_object", "blender_world", "bump"]
    texture: Texture | None = None
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    strength: float = 1.0
    distance: float = 1.0
    tangents: str = ""


#: Fields of `Material` that ``Material.textures`` may vary over the surface.
TEXTURED = (
    "ior", "specular_level", "specular_tint", "anisotropy", "anisotropy_rotation", "coat", "coat_roughness", "coat_ior",
    "coat_tint", "sheen", "sheen_roughness", "sheen_tint", "transmission", "diffuse_roughness",
)  # fmt: skip
#: What makes a material more than a diffuse and a glossy lobe of IOR 1.5, and the values that add nothing.
_PLAIN = {"specular_tint": (1.0, 1.0, 1.0), "anisotropy": 0.0, "coat": 0.0, "sheen": 0.0}
#: The same of what a metal has not.
_PLAIN_DIELECTRIC = {"ior": 1.5, "specular_level": 0.5, "transmission": 0.0, "diffuse_roughness": 0.0}


@dataclass(slots=True)
class ShaderAOV:
    """What a material gives to a shader AOV: a colour, or a number as a colour's first channel.

    Attributes
    ----------
    name : str
        Of its pass, see `passes.pass_of`.
    colour : tuple of float
        Linear Rec.709, times the texture; any finite numbers.
    texture : Texture, optional
    """

    name: str
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    texture: Texture | None = None


@dataclass(slots=True)
class Material:
    """Parameters of Blender's Principled BSDF for an ordinary surface. Numbers multiply their textures.

    Attributes
    ----------
    base_colour : tuple of float
        Linear Rec.709; above 1, as in Cycles, diffuse light grows and that of metals does not.
    roughness, metallic : float
        In [0, 1]; with a texture factors that may be larger.
    emission : tuple of float
        Linear Rec.709 radiance, colour times strength.
    alpha : float
        Share of the surface that is there, in [0, 1]; light passes the rest in a straight line.
    details : list of SurfaceDetail
        Done to the shading normal one after the other.
    pass_index : int
        Blender's material index pass.
    ior : float
        Above 0, inside over outside: of the glossy lobe and of what is transmitted.
    specular_level : float
        At least 0: the reflectance that `ior` gives at normal incidence, times twice this; of the glossy lobe alone,
        not of what is transmitted. At 0 a dielectric has no glossy lobe.
    specular_tint : tuple of float
        Linear Rec.709 factors on reflection: of a dielectric at normal incidence, of a metal at grazing angles.
    anisotropy : float
        In [0, 1]: how much longer highlights are along the tangent.
    anisotropy_rotation : float
        Turns of the tangent about the normal.
    tangent : str
        Name of a layer whose directions highlights follow: of two numbers, texture coordinates, along whose u; of four,
        the direction itself in object space, of any length, blended over the face. "" are the coordinates `uvs`.
    coat, coat_roughness, coat_ior : float
        Weight of a clear layer above all others but the sheen, in [0, 1]; its roughness; its IOR, at least 1.
    coat_tint : tuple of float
        Linear Rec.709, what the layer lets through at normal incidence.
    coat_details : bool
        Whether `details` change the normal of the coat, too.
    sheen, sheen_roughness : float
        Weight of a layer of fibres above all others, the coat, too; their roughness.
    sheen_tint : tuple of float
        Linear Rec.709.
    transmission : float
        In [0, 1]: share of the part that is no metal that is glass, whose refracted light has the colour
        sqrt(base_colour).
    thin_walled : bool
        Whether the surface is a sheet, of which light leaves in the direction in which it came.
    diffuse_roughness : float
        In [0, 1], of the diffuse lobe.
    textures : dict of str to Texture
        By name of a field in `TEXTURED`.
    kind : {"principled", "diffuse", "glossy", "glass", "refraction", "translucent", "sheen"}
        Blender's node of that name, with all of the above that it has: `base_colour` is its Color; "diffuse" has
        `diffuse_roughness`, "sheen" `sheen_roughness` for its Roughness; "diffuse" and "translucent" have no gloss.
    multiscatter : bool
        Multiscatter GGX instead of GGX: rough metals are as bright as smooth ones.
    of_point : bool
        Whether the surface has base colour, roughness and metallic of the shading point, which may be a surfel's, not
        those of above; of a single part alone.
    parts : list of Part
        Mix and Add Shader: if there are any, the surface scatters their weighted sum, and of the material itself only
        name, `alpha`, `emission`, `details` and `pass_index` count.
    aovs : list of ShaderAOV
        At most one per pass; others are 0.
    """

    name: str
    base_colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    roughness: float = 0.5
    metallic: float = 0.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_colour_texture: Texture | None = None
    roughness_texture: Texture | None = None
    metallic_texture: Texture | None = None
    emission_texture: Texture | None = None
    alpha: float = 1.0
    alpha_texture: Texture | None = None
    details: list[SurfaceDetail] = field(default_factory=list)
    pass_index: int = 0
    ior: float = 1.5
    specular_level: float = 0.5
    specular_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    anisotropy: float = 0.0
    anisotropy_rotation: float = 0.0
    tangent: str = ""
    coat: float = 0.0
    coat_roughness: float = 0.03
    coat_ior: float = 1.5
    coat_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    coat_details: bool = False
    sheen: float = 0.0
    sheen_roughness: float = 0.5
    sheen_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    transmission: float = 0.0
    thin_walled: bool = False
    diffuse_roughness: float = 0.0
    textures: dict[str, Texture] = field(default_factory=dict)
    kind: Literal["principled", "diffuse", "glossy", "glass", "refraction", "translucent", "sheen"] = "principled"
    multiscatter: bool = False
    of_point: bool = False
    parts: list[Part] = field(default_factory=list)
    aovs: list[ShaderAOV] = field(default_factory=list)

    @property
    def clear(self) -> bool:
        """Whether light may pass it in a straight line."""
        return not self.alpha >= 1.0 or self.alpha_texture is not None

    @property
    def has_more_lobes(self) -> bool:
        """Whether it is more than a diffuse and a glossy lobe of IOR 1.5."""
        if self.parts or self.kind != "principled":
            return True
        is_metal = self.metallic >= 1.0 and self.metallic_texture is None
        plain = _PLAIN if is_metal else _PLAIN | _PLAIN_DIELECTRIC
        return any(getattr(self, name) != value or name in self.textures for name, value in plain.items())

    def all_textures(self) -> list[Texture]:
        """Textures of the material and its parts."""
        names = ("base_colour", "roughness", "metallic", "emission", "alpha")
        found = [getattr(self, f"{name}_texture") for name in names]
        found += [*self.textures.values(), *(detail.texture for detail in self.details)]
        found += [aov.texture for aov in self.aovs]
        for part in self.parts:
            found += [part.weight_texture, *part.material.all_textures()]
        return [texture for texture in found if texture is not None]


@dataclass(slots=True)
class Part:
    """One of the surfaces that are mixed or added.

    Attributes
    ----------
    material : Material
        Without parts of its own.
    weight : tuple of float
        Linear Rec.709, at least 0.
    weight_texture : Texture, optional
        Multiplies the weight.
    inverted : bool
        One minus the texture instead of the texture, for the other part of a mix.
    """

    material: Material
    weight: tuple[float, float, float] = (1.0, 1.0, 1.0)
    weight_texture: Texture | None = None
    inverted: bool = False
