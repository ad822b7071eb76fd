"""A mesh as other programs take it: faces by material, with the images they have, or an atlas of their vertices."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow

from ..core.asset import Mesh
from ..core.asset.textures import (
    ALBEDO,
    COAT,
    EMISSION,
    FACTORS,
    METALLIC,
    NORMAL,
    OPACITY,
    ROUGHNESS,
    SLOTS,
    SPECULAR,
    MeshTextures,
)
from ..geometry.normals import VertexNormals, unit
from .atlas import (
    SAME,
    TexturedMaterial,
    UniformMaterial,
    check_mesh,
    mesh_material,
    uniform_channels,
    vertex_channels,
)
from .images import decode_image

Array = np.ndarray


class Picture(NamedTuple):
    """An image file on a surface.

    Attributes
    ----------
    name : str
        With suffix, of its own in the mesh.
    data : bytes
    extension : str
        Of `core.asset.textures.EXTENSIONS`.
    """

    name: str
    data: bytes
    extension: str


@dataclass(slots=True)
class ImageMaterial(UniformMaterial):
    """A material with images, which multiply its values.

    Attributes
    ----------
    name : str
    normal_strength : float
    colour_picture : Picture, optional
        sRGB.
    translucent : bool
        Whether the alpha of `colour_picture` multiplies the opacity.
    surface_picture : Picture, optional
        Green is the roughness, blue the metallic.
    normal_picture : Picture, optional
        Tangent space, green upwards.
    emission_picture : Picture, optional
        sRGB.
    specular_picture, coat_picture : Picture, optional
        Alpha is the specular level; red is the coat.
    """

    name: str = ""
    normal_strength: float = 1.0
    colour_picture: Picture | None = None
    surface_picture: Picture | None = None
    normal_picture: Picture | None = None
    emission_picture: Picture | None = None
    specular_picture: Picture | None = None
    coat_picture: Picture | None = None
    translucent: bool = False


def pictured_material(material: UniformMaterial) -> ImageMaterial:
    """The material itself where it may have images, else one that has none."""
    return material if isinstance(material, ImageMaterial) else ImageMaterial((1.0, 1.0, 1.0), 1.0, 0.0)


@dataclass(slots=True)
class FaceGroup:
    """Faces of one material.

    Attributes
    ----------
    faces : (k,) int64 array
        Rows of the mesh's.
    material : UniformMaterial or TexturedMaterial
        The first perhaps an `ImageMaterial`.
    uvs : (k, 3, 2) float32 array, optional
        Of the corners, the origin at the upper left (glTF).
    """

    faces: Array
    material: UniformMaterial | TexturedMaterial
    uvs: Array | None = None


def face_groups(mesh: Mesh, subject: str) -> list[FaceGroup]:
    """All faces of `mesh` by material: first those with images, then the others with an atlas of their own.

    Raises
    ------
    UsageError, AssetError
        As `atlas.mesh_material`.
    """
    check_mesh(mesh, subject)
    found: list[FaceGroup] = []
    rest = np.ones(len(mesh.faces), bool)
    textures = mesh.textures
    for k in range(0 if textures is None else len(textures.names)):
        assert textures is not None
        rows = np.flatnonzero(textures.material == k)
        material = _image_material(mesh, textures, k, rows) if len(rows) else None
        if material is None:
            continue
        rest[rows] = False
        slot = int(np.flatnonzero(textures.slots[k] >= 0)[0])
        transform = textures.transforms[k, slot].astype(np.float64)
        uvs = textures.uvs[rows] @ transform[:, :2].T + transform[:, 2]
        found.append(FaceGroup(rows, material, (uvs * (1, -1) + (0, 1)).astype(np.float32)))
    rows = np.flatnonzero(rest)
    if len(rows):
        left = mesh_material(replace(mesh, faces=mesh.faces[rows], textures=None), subject)
        found.append(FaceGroup(rows, left, left.uvs if isinstance(left, TexturedMaterial) else None))
    return found


def corner_normals(mesh: Mesh) -> Array:
    """(m, 3, 3) float32 unit normals at the corners of `mesh`: those of its textures, else smooth ones."""
    if mesh.textures is not None and mesh.textures.normals is not None:
        return unit(mesh.textures.normals.reshape(-1, 3)).reshape(-1, 3, 3).astype(np.float32)
    return VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)[mesh.faces].astype(np.float32)


def joined_corners(vertices: Array, normals: Array, uvs: Array | None) -> tuple[list[Array], Array]:
    """Corners with equal values as one.

    Parameters
    ----------
    vertices, normals : (k, 3, 3) float32 array
    uvs : (k, 3, 2) float32 array, optional

    Returns
    -------
    values : list of array
        (n, 3), (n, 3) and perhaps (n, 2).
    index : (3 k,) uint32 array
        Of each corner.
    """
    given = [a.reshape(len(vertices) * 3, -1) for a in (vertices, normals, uvs) if a is not None]
    rows = np.ascontiguousarray(np.concatenate(given, axis=1) + np.float32(0))  # no -0
    _, first, index = np.unique(rows.view(f"V{rows.itemsize * rows.shape[1]}"), return_index=True, return_inverse=True)
    return [values[first] for values in given], index.reshape(-1).astype(np.uint32)


def kept(mesh: Mesh, subject: str) -> str:
    """What becomes of the textures of `mesh`, in a sentence for the user; "" where it has none."""
    if mesh.textures is None:
        return ""
    groups = [group for group in face_groups(mesh, subject) if isinstance(group.material, ImageMaterial)]
    count = sum(len(group.faces) for group in groups)
    text = f"{len(groups)} materials with the images, texture coordinates and normals of {count} triangles"
    others = len(mesh.faces) - count
    return text + (f"; {others} others have what is at their vertices, in a texture of its own" if others else "")


def _image_material(mesh: Mesh, textures: MeshTextures, k: int, rows: Array) -> ImageMaterial | None:
    """Material `k` of faces `rows`; None where other programs cannot have it with its images.

    That is where a channel varies from vertex to vertex, or images lie on the surface in different ways.
    """
    slots, factors = textures.slots[k], textures.factors[k].astype(np.float64)
    used = slots >= 0
    first = int(np.flatnonzero(used)[0])
    alike = (textures.transforms[k, used] == textures.transforms[k, first]).all()
    pair = [ROUGHNESS, METALLIC]
    together = slots[ROUGHNESS] == slots[METALLIC] or not used[pair].all()
    if not (alike and together):
        return None
    values, columns = vertex_channels(mesh)
    values = values[np.unique(mesh.faces[rows])]
    middle = np.median(values, axis=0)
    pictured = {SLOTS[slot]: slot for slot in np.flatnonzero(used).tolist() if slot != NORMAL}
    for name, own in columns.items():
        if name in pictured:
            middle[own] = factors[FACTORS[pictured[name]]]
        elif np.ptp(values[:, own], axis=0).max() >= SAME:
            return None
    if used[pair].any() and not used[pair].all():
        return None  # the image would multiply what is at the vertices
    files = textures.files

    def picture(slot: int) -> Picture | None:
        if not used[slot]:
            return None
        number = int(slots[slot])
        extension = ("repeat", "extend", "mirror")[textures.extensions[k, slot]]
        return Picture(f"{number}_{_plain(files[number][0])}", files[number][1].tobytes(), extension)

    own_channels = uniform_channels(middle, columns)
    for slot in (OPACITY, EMISSION, SPECULAR, COAT):  # of which vertices may have none
        if used[slot]:
            whole = tuple(factors[FACTORS[slot]].tolist())
            own_channels[SLOTS[slot]] = whole if len(whole) > 1 else whole[0]
    colour, opacity, specular = picture(ALBEDO), picture(OPACITY), picture(SPECULAR)
    if opacity is not None:
        if colour is not None and colour.extension != opacity.extension:
            return None  # other programs have one image of both
        if colour is None or slots[ALBEDO] != slots[OPACITY]:
            colour = _joined(colour, opacity, textures.channel(OPACITY, int(slots[OPACITY])))
    elif colour is not None and own_channels.get("opacity", 1.0) < 1:
        colour = colour._replace(data=_opaque(colour.data, f"image {files[int(slots[ALBEDO])][0]}"))
    if specular is not None and textures.channel(SPECULAR, int(slots[SPECULAR])) != "a":
        specular = _joined(None, specular, "r")
    return ImageMaterial(
        **own_channels, name=textures.names[k], normal_strength=float(factors[5]),
        colour_picture=colour, surface_picture=picture(ROUGHNESS), normal_picture=picture(NORMAL),
        emission_picture=picture(EMISSION), specular_picture=specular, coat_picture=picture(COAT),
        translucent=opacity is not None,
    )  # fmt: skip


def _joined(colour: Picture | None, opacity: Picture, channel: str) -> Picture:
    """An image of colours, white where there is none, whose alpha is a channel of another.

    Raises
    ------
    AssetError
        A file cannot be read.
    """
    alpha = _decoded(opacity.data, f"image {opacity.name}").convert("RGBA").getchannel(channel.upper())
    whole = Pillow.new("RGB", alpha.size, "white")
    if colour is not None:
        whole = _decoded(colour.data, f"image {colour.name}").convert("RGB")
        alpha = alpha.resize(whole.size, Pillow.Resampling.BILINEAR)
    whole.putalpha(alpha)
    stem = opacity.name if colour is None else f"{colour.name.rsplit('.', 1)[0]}_{opacity.name}"
    return Picture(f"{stem.rsplit('.', 1)[0]}_alpha.png", _png(whole), opacity.extension)


def _opaque(data: bytes, subject: str) -> bytes:
    """An image file without alpha, which would count a second time where its material has opacity.

    Raises
    ------
    AssetError
        The file cannot be read.
    """
    picture = _decoded(data, subject)
    return data if picture.mode == "RGB" else _png(picture.convert("RGB"))


def _decoded(data: bytes, subject: str) -> Pillow.Image:
    """An image file as bytes of RGB or RGBA."""
    pixels = decode_image(data, subject)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    return Pillow.fromarray(np.ascontiguousarray(pixels))


def _png(picture: Pillow.Image) -> bytes:
    made = io.BytesIO()
    picture.save(made, "PNG", compress_level=6)
    return made.getvalue()


def _plain(name: str) -> str:
    """A name of a file of letters, digits and what is harmless everywhere."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "-.") else "_" for c in name)
