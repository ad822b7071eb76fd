"""Assets whose images were painted over.

Rays meet the images. Vertices and surfels have values that were looked up in them when the asset was made; where an
image has changed under one of these, it is looked up anew, over as much of the image as it stands for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from .asset.model import MATERIAL_CHANNELS, Asset, Mesh
from .asset.textures import ALBEDO, COLOURED, EXTENSIONS, FACTORS, NORMAL, OPACITY, SLOTS, MeshTextures, has_alpha
from .materials import Image
from .mip_pyramid import Pyramid

Array = np.ndarray
#: (h, w, 4) uint8 pixels of images of an asset, by their names and whether they are colours in sRGB.
Pictures = Mapping[tuple[str, bool], Array]

#: Change of a value from which the image was painted there.
_CHANGED = 1 / 512
#: Least length, so that what has none divides nothing.
_TINY = 1e-30


class _Points(NamedTuple):
    """Rows (n,) of a mesh or surfels: their materials (n,), texture coordinates and the width they cover (n, 2)."""

    row: Array
    material: Array
    uvs: Array
    width: Array


class _Picture(NamedTuple):
    """An image as a slot of a material has it; a `mip_pyramid.TextureImage`."""

    pixels: Array
    srgb: bool
    uv_transform: Array
    wrap: tuple[str, str]


def pictures_of(textures: MeshTextures, images: Sequence[Image]) -> dict[tuple[str, bool], Array]:
    """Pixels of painted `images`, which have the names of an asset's; what has another name or no bytes is left out.

    Alpha is that of images whose files have any. One that is albedo and opacity at once counts as both, though its
    encoding is that of the albedo.
    """
    found: dict[tuple[str, bool], Array] = {}
    names = list(textures.images)
    rows = textures.slots
    shared = {names[n] for n in rows[rows[:, OPACITY] == rows[:, ALBEDO], OPACITY] if n >= 0}
    for image in sorted(images, key=lambda image: image.encoding == "linear"):
        if image.name not in textures.images or image.pixels.dtype != np.uint8:
            continue
        pixels = np.full((*image.pixels.shape[:2], 4), 255, np.uint8)
        pixels[..., :3] = image.pixels[..., : min(image.pixels.shape[2], 3)]
        if image.pixels.shape[2] == 4 and has_alpha(textures.images[image.name].tobytes()):
            pixels[..., 3] = image.pixels[..., 3]
        pixels.flags.writeable = False
        coloured = image.encoding == "srgb"
        found[image.name, coloured] = pixels
        if coloured and image.name in shared:
            found[image.name, False] = pixels
    return found


def uses_of(textures: MeshTextures) -> set[tuple[str, bool]]:
    """Names of images that materials have, and whether as colours."""
    names = list(textures.images)
    return {(names[n], slot in COLOURED) for slot, uses in enumerate(textures.slots.T) for n in uses[uses >= 0]}


def repainted(asset: Asset, before: Pictures, now: Pictures, files: Mapping[tuple[str, bool], Array]) -> Asset:
    """The asset with painted images, and materials of vertices and surfels as these have them.

    Parameters
    ----------
    asset : Asset
        With textures.
    before : mapping
        The same images as its files have them; without one, vertices and surfels stay as they are under it.
    now : mapping
        Those that are painted.
    files : mapping
        The same as PNG or JPEG files, or their beginnings, (bytes,) uint8.
    """
    mesh, surfels, textures = asset.mesh, asset.surfels, asset.mesh.textures
    assert textures is not None
    painted = np.zeros(len(textures.names) + 1, bool)  # the last is that of faces without a material
    painted[[k for _, k, key in _painted(textures, now) if key in before]] = True
    on_face = painted[textures.material]
    at_vertices = _at_vertices(mesh, textures, on_face)
    at_surfels = None if asset.binding is None else _at_surfels(asset, textures, on_face)
    of_mesh: dict[str, Any] = {}
    of_surfels: dict[str, Any] = {}
    pyramids: list[Pyramid] = []
    made_of: tuple[object, ...] = ()
    for slot, k, key in _painted(textures, now):
        name, factors = SLOTS[slot], textures.factors[k, FACTORS[slot]]
        if key not in before:
            continue
        if (place := _place(textures, k, slot)) != made_of:
            pyramids.clear()  # of a large image two are much, and more are too much
            pyramids, made_of = [_pyramid(textures, k, slot, key, found[key]) for found in (before, now)], place
        for part, points, found in ((mesh, at_vertices, of_mesh), (surfels, at_surfels, of_surfels)):
            own = found.get(name, getattr(part, name, None))
            if own is None or points is None or (part is surfels and name == "opacity"):
                continue
            of_material = points.material == k
            given, rows = (points.uvs[of_material], points.width[of_material]), points.row[of_material]
            taps = [pyramids[0].taps_at(*given)]
            taps += taps if pyramids[0].layout == pyramids[1].layout else [pyramids[1].taps_at(*given)]
            then, value = (p.look_up(t, slice(len(factors))).T * factors for p, t in zip(pyramids, taps, strict=True))
            changed = (np.abs(value - then) > _CHANGED).any(axis=1)
            if not changed.any():
                continue
            found[name] = made = own if name in found else own.copy()
            new = np.clip(value[changed], 0, MATERIAL_CHANNELS[name].limit)
            made[rows[changed]] = new if own.ndim == 2 else new[:, 0]
    of_mesh["textures"] = _with_files(textures, now, files)
    return replace(asset, mesh=replace(mesh, **of_mesh), surfels=replace(surfels, **of_surfels))


def carried_paint(before: Mesh, now: Mesh, painted: Mapping[str, Any]) -> dict[str, Any]:
    """Channels painted on vertices, which differ from `before` only where they are painted, over those of `now`."""
    found = dict(painted)
    for name, values in painted.items():
        own, new = before.channel(name), now.channel(name)
        if values is None or own is new or values.shape != own.shape:
            continue
        same = values == own
        found[name] = np.where(same if same.ndim == 1 else same.all(axis=1, keepdims=True), new, values)
    return found


def _painted(textures: MeshTextures, now: Pictures) -> Iterator[tuple[int, int, tuple[str, bool]]]:
    """Slot, material, and image of all that is painted; normal maps are looked up by rays alone."""
    names = list(textures.images)
    for slot in range(len(SLOTS)):
        for k in np.flatnonzero(textures.slots[:, slot] >= 0):
            key = names[textures.slots[k, slot]], slot in COLOURED
            if slot != NORMAL and key in now:
                yield slot, int(k), key


def _with_files(textures: MeshTextures, now: Pictures, files: Mapping[tuple[str, bool], Array]) -> MeshTextures:
    """Textures with other files; an image that is painted as a colour and not as data, or so, becomes two."""
    images, slots = dict(textures.images), textures.slots.copy()
    names, coloured = list(images), np.isin(np.arange(len(SLOTS)), COLOURED)
    for (name, colour), data in files.items():
        uses = (textures.slots == names.index(name)) & (coloured == colour)
        others = (textures.slots == names.index(name)) & (coloured != colour)
        other = now.get((name, not colour))
        if others.any() and (other is None or not np.array_equal(other, now[name, colour])):
            own = f"{name} ({'colour' if colour else 'data'})"
            slots[uses] = len(images) if own not in images else list(images).index(own)
            images[own] = data
        else:
            images[name] = data
    return replace(textures, images=images, slots=slots)


def _place(textures: MeshTextures, k: int, slot: int) -> tuple[object, ...]:
    """What the pyramids of a slot depend on."""
    number, transform = int(textures.slots[k, slot]), textures.transforms[k, slot].tobytes()
    return number, slot in COLOURED, textures.channel(slot, number), transform, int(textures.extensions[k, slot])


def _pyramid(textures: MeshTextures, k: int, slot: int, key: tuple[str, bool], pixels: Array) -> Pyramid:
    """An image as it is for a slot of a material, with what counts of it in the first channels."""
    channel = textures.channel(slot, list(textures.images).index(key[0]))
    if channel != "rgb":
        pixels = pixels[..., "rgba".index(channel)]
    extension = EXTENSIONS[textures.extensions[k, slot]]
    wrap = "clamp" if extension == "extend" else extension
    return Pyramid(_Picture(pixels, key[1], textures.transforms[k, slot], (wrap, wrap)))


def _at_vertices(mesh: Mesh, textures: MeshTextures, on_face: Array) -> _Points:
    """The vertices of faces, (m,) bool, each by one of them."""
    faces = np.flatnonzero(on_face)
    face, corner = np.full(len(mesh.vertices), -1), np.zeros(len(mesh.vertices), np.int8)
    for k in range(3):
        face[mesh.faces[faces, k]], corner[mesh.faces[faces, k]] = faces, k
    row = np.flatnonzero(face >= 0)
    face, corner = face[row], corner[row]
    uvs = textures.uvs[face]
    return _Points(row, textures.material[face], uvs[np.arange(len(row)), corner], _extent(uvs) / 2)


def _at_surfels(asset: Asset, textures: MeshTextures, on_face: Array) -> _Points:
    """The surfels of faces, (m,) bool, as wide in the image as twice their larger axis on the face."""
    binding, mesh = asset.binding, asset.mesh
    assert binding is not None
    row = np.flatnonzero(on_face[binding.face])
    face = binding.face[row]
    corners, uvs = mesh.vertices[mesh.faces[face]], textures.uvs[face]
    longest = np.sqrt(np.max([((corners[:, k] - corners[:, k - 1]) ** 2).sum(axis=1) for k in range(3)], axis=0))
    at = np.einsum("nk,nkc->nc", binding.barycentric[row], uvs)
    width = 2 * asset.surfels.scale[row].max(axis=1) / np.maximum(longest, _TINY)
    return _Points(row, textures.material[face], at, width[:, None] * _extent(uvs))


def _extent(uvs: Array) -> Array:
    """(n, 2): how far (n, 3, 2) texture coordinates of corners are apart."""
    a, b, c = uvs.transpose(1, 0, 2)
    extent: Array = np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)
    return extent
