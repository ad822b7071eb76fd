"""Images of DR-GS objects that are painted over, by the names they have in their assets."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np

from ...drgs_blender.core.asset import Asset
from ...drgs_blender.core.asset.textures import MeshTextures, has_alpha, image_suffix
from ...drgs_blender.core.materials import Image
from ...drgs_blender.core.repainted_textures import pictures_of, repainted, uses_of
from .. import lookups
from ..viewport_material import IMAGE, KEY
from . import image_parts, image_pixels, images

Array = np.ndarray
Warn = Callable[[str], None]
#: Gives the pixels of an image, straight; None where it has none.
Read = Callable[[bpy.types.Image, Warn], Image | None]

#: Assets whose images are hashed at a time.
_ASSETS = 16
#: Textures of assets, and the hash of each of their images.
_hashes: list[tuple[MeshTextures, dict[str, str]]] = []


class Painted(NamedTuple):
    """An image that is painted over, its name in its asset, and its pixels."""

    image: bpy.types.Image
    name: str
    picture: Image


def read_picture(image: bpy.types.Image, warn: Warn) -> Image | None:
    """Pixels of an image as textures of assets are looked up, straight; None where it has none."""
    return images.export_image(image, True, warn)


def painted_images(obj: bpy.types.Object, asset: Asset, warn: Warn, read: Read = read_picture) -> list[Image]:
    """Images of the asset's that have other pixels on an object, with those and their names in the asset.

    Warns of those that cannot be rendered as painted.
    """
    return [replace(found.picture, name=found.name) for found in _found(obj, asset, warn, read)]


def are_painted(obj: bpy.types.Object, asset: Asset) -> bool:
    """Whether images of the asset's are painted over on an object; their pixels are not read."""
    if asset.mesh.textures is None:
        return False
    hashes = _hashes_of(asset.mesh.textures)
    shown = (image for image in _shown(obj, lambda text: None) if _names(image, hashes))
    return any(image_parts.ask_file(image, _hash) not in hashes.values() for image in shown)


def with_painted_images(obj: bpy.types.Object, asset: Asset, warn: Warn) -> Asset:
    """The asset of an object, or what is left of it, with its images as painted; packed ones are packed anew."""
    found = list(_found(obj, asset, warn, read_picture))
    textures = asset.mesh.textures
    if not found or textures is None:
        return asset
    before: dict[tuple[str, bool], Array] = {}
    now: dict[tuple[str, bool], Array] = {}
    files: dict[tuple[str, bool], Array] = {}
    for one in found:
        data = np.frombuffer(_file_of(one, has_alpha(textures.images[one.name].tobytes())), np.uint8)
        own = _as_captured(one, textures)
        painted = pictures_of(textures, [replace(one.picture, name=one.name)])
        now |= painted
        files |= dict.fromkeys(painted, data)
        before |= pictures_of(textures, [] if own is None else [replace(own, name=one.name)])
    return repainted(asset, before, now, files)


def _found(obj: bpy.types.Object, asset: Asset, warn: Warn, read: Read) -> Iterator[Painted]:
    """Images of an asset that are painted over on an object."""
    textures = asset.mesh.textures
    if textures is None:
        return
    hashes, uses = _hashes_of(textures), uses_of(textures)
    shown: dict[tuple[str, bool], str] = {}
    for image in _shown(obj, warn):
        if image_parts.ask_file(image, _hash) in hashes.values():
            continue
        names = _names(image, hashes)
        picture = read(image, warn) if names else None
        lack = "is of another asset" if not names else "has no pixels" if picture is None else ""
        if picture is not None:
            coloured = picture.encoding == "srgb"
            names = [name for name in names if (name, coloured) in uses]
            if picture.pixels.dtype != np.uint8:
                lack = "has floats, where the asset has bytes"
            elif not names:
                kind = "colours" if coloured else "data"
                lack = f"has the colour space {image.colorspace_settings.name}, and its asset has no {kind} there"
            elif other := next((shown[name, coloured] for name in names if (name, coloured) in shown), None):
                lack = f'stands for the same image of its asset as "{other}" does'
        if lack:
            warn(f'"{obj.name}": its image "{image.name}" {lack}; as painted it is not rendered, but the asset\'s own')
            continue
        assert picture is not None
        shown |= {(name, coloured): image.name for name in names}
        yield from (Painted(image, name, picture) for name in names)


def _shown(obj: bpy.types.Object, warn: Warn) -> list[bpy.types.Image]:
    """Images of assets that the materials of an object show; warns of what is in the place of such."""
    found = set()
    for material in dict.fromkeys(slot.material for slot in obj.original.material_slots):
        if material is None or material.node_tree is None:
            continue
        for node in _image_nodes(material.node_tree):
            if node.image is not None and KEY in node.image:
                found.add(node.image)
            elif KEY in material and any(output.is_linked for output in node.outputs):
                what = "no image" if node.image is None else f'an image, "{node.image.name}", that is none of its asset'
                warn(f'"{obj.name}": its material "{material.name}" shows {what}; the asset\'s own is rendered')
    return sorted(found, key=lambda image: image.name_full)


def _image_nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """Nodes with an image in a tree and in the groups within it."""
    trees = [tree]
    for each in trees:  # grows
        for node in each.nodes:
            if node.type == "TEX_IMAGE":
                yield node
            elif node.type == "GROUP" and node.node_tree is not None and node.node_tree not in trees:
                trees.append(node.node_tree)


def _names(image: bpy.types.Image, hashes: dict[str, str]) -> list[str]:
    """Names in an asset of an image that was made of its files, by their `hashes`: the last it had, or the first."""
    last = "" if image.packed_file is None else _hash(image.packed_file.data)
    for digest in (last, str(image[KEY]).partition(" ")[0]):
        if names := [name for name, known in hashes.items() if known == digest]:
            return names
    return [name for name in [image.get(IMAGE)] if name in hashes]


def _hashes_of(textures: MeshTextures) -> dict[str, str]:
    """Of the images of an asset, by their names; found once."""

    def found() -> tuple[MeshTextures, dict[str, str]]:
        return textures, {name: hashlib.sha256(data.tobytes()).hexdigest() for name, data in textures.images.items()}

    return lookups.recall(_hashes, lambda known: known[0] is textures, found, _ASSETS)[1]


def _hash(file: str | bytes) -> str:
    """Of a file at a path, or a packed one."""
    return hashlib.sha256(Path(file).read_bytes() if isinstance(file, str) else file).hexdigest()


def _as_captured(painted: Painted, textures: MeshTextures) -> Image | None:
    """An image as its asset has it; None where that is damaged."""
    data = textures.images[painted.name].tobytes()
    image = bpy.data.images.new(painted.name, 1, 1)
    try:
        image.pack(data=data, data_len=len(data))
        image.source, image.alpha_mode = "FILE", painted.image.alpha_mode
        image.colorspace_settings.name = painted.image.colorspace_settings.name
        return image_pixels.straight(image)
    finally:
        bpy.data.images.remove(image)


def _file_of(painted: Painted, alpha: bool) -> bytes:
    """A painted image as a file with `alpha` or without, as the asset's own has it, which says what of it counts.

    One that is packed and not saved is packed as that.
    """
    image = painted.image
    if ours := image.is_dirty and image.packed_file is not None and image.library is None:
        image.file_format = "PNG"
        image.pack()
    if not image.is_dirty and image.source == "FILE" and image.packed_file is not None:
        data = bytes(image.packed_file.data)
        if image_suffix(data) and has_alpha(data) == alpha:
            return data
    # Not a copy of the datablock: what is painted and not saved is not in that.
    pixels = painted.picture.rgba[::-1]
    made = bpy.data.images.new(painted.name, pixels.shape[1], pixels.shape[0], alpha=alpha)
    try:
        made.pixels.foreach_set(np.ravel(pixels / np.float32(255)))
        made.file_format = "PNG"
        made.pack()
        data = bytes(made.packed_file.data)
    finally:
        bpy.data.images.remove(made)
    if ours:  # so that it is known as the new file's
        image.pack(data=data, data_len=len(data))
    return data
