"""Images of DR-GS objects that are painted over, by the names they have in their assets."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import bpy
import numpy as np

from ...drgs_blender.core.asset import Asset
from ...drgs_blender.core.asset.textures import MeshTextures, image_suffix
from ...drgs_blender.core.materials import Image
from ...drgs_blender.core.repainted_textures import pictures_of, repainted
from .. import lookups
from ..viewport_material import IMAGE, KEY
from . import image_parts, image_pixels, images

Array = np.ndarray
Warn = Callable[[str], None]

#: Assets whose images are hashed at a time, and bytes at the end of a file that tell it from another of its size:
#: a checksum of a PNG's is among them.
_ASSETS, _END = 16, 64
#: Textures of assets, and the hash of each of their images.
_hashes: list[tuple[MeshTextures, dict[str, str]]] = []
#: Packed files, by their size and end, and the hash of each.
_packed: dict[tuple[int, bytes], str] = {}


class Painted(NamedTuple):
    """An image that is painted over, its name in its asset, and its pixels."""

    image: bpy.types.Image
    name: str
    picture: Image


def painted_images(obj: bpy.types.Object, asset: Asset, warn: Warn) -> list[Image]:
    """Images of the asset's that have other pixels on an object, with those and their names in the asset.

    Warns of those that cannot be rendered as painted.
    """
    return [replace(found.picture, name=found.name) for found in _found(obj, asset, warn)]


def with_painted_images(obj: bpy.types.Object, asset: Asset, warn: Warn) -> Asset:
    """The asset of an object, or what is left of it, with its images as painted; these are packed in the .blend."""
    found = list(_found(obj, asset, warn))
    textures = asset.mesh.textures
    if not found or textures is None:
        return asset
    now = pictures_of(textures, [replace(one.picture, name=one.name) for one in found])
    before, files = {}, {}
    for one in found:
        own = pictures_of(textures, [replace(_as_captured(one, textures), name=one.name)])
        data = np.frombuffer(_file_of(one.image), np.uint8)
        for key in own.keys() & now.keys():
            before[key], files[key] = own[key], data
    return repainted(asset, before, now, files)


def _found(obj: bpy.types.Object, asset: Asset, warn: Warn) -> Iterator[Painted]:
    """Images of an asset that are painted over on an object."""
    textures = asset.mesh.textures
    trees = [s.material.node_tree for s in obj.original.material_slots if s.material and s.material.node_tree]
    shown = {node.image for tree in trees for node in tree.nodes if node.type == "TEX_IMAGE" and node.image}
    if textures is None:
        return
    made = lambda: (textures, _hashes_of(textures))  # noqa: E731
    _, hashes = lookups.recall(_hashes, lambda known: known[0] is textures, made, _ASSETS)
    for image in sorted((image for image in shown if KEY in image), key=lambda image: image.name):
        if not image.is_dirty and (image.packed_file is None or _hash(image.packed_file) in hashes.values()):
            continue
        was = image[KEY].split()[0]
        names = [name for name, digest in hashes.items() if digest == was]
        names = names or [name for name in [image.get(IMAGE)] if name in textures.images]
        picture = images.export_image(image, True, warn) if names else None
        lack = "is of another asset" if not names else "has no pixels" if picture is None else ""
        if picture is not None and picture.pixels.dtype != np.uint8:
            lack = "has floats, where the asset has bytes"
        if lack:
            warn(f'"{obj.name}": its image "{image.name}" {lack}; as painted it is not rendered, but the asset\'s own')
            continue
        assert picture is not None
        yield from (Painted(image, name, picture) for name in names)


def _hashes_of(textures: MeshTextures) -> dict[str, str]:
    return {name: hashlib.sha256(data.tobytes()).hexdigest() for name, data in textures.images.items()}


def _hash(packed: bpy.types.PackedFile) -> str:
    data = packed.data
    key = len(data), data[-_END:]
    if key not in _packed:
        _packed[key] = hashlib.sha256(data).hexdigest()
    return _packed[key]


def _as_captured(painted: Painted, textures: MeshTextures) -> Image:
    """An image as its asset has it."""
    data = textures.images[painted.name].tobytes()
    image = bpy.data.images.new(painted.name, 1, 1)
    try:
        image.pack(data=data, data_len=len(data))
        image.source, image.alpha_mode = "FILE", painted.image.alpha_mode
        image.colorspace_settings.name = painted.image.colorspace_settings.name
        picture = image_pixels.straight(image)
    finally:
        bpy.data.images.remove(image)
    # One that is damaged was never looked up: nothing of it is known.
    return Image(painted.name, np.zeros((1, 1, 3), np.uint8), painted.picture.encoding) if picture is None else picture


def _file_of(image: bpy.types.Image) -> bytes:
    """An image as a file, which it is packed as; one of a library is copied for it."""
    if not image.is_dirty and image.packed_file is not None and image_suffix(image.packed_file.data):
        return bytes(image.packed_file.data)
    if image.library is None:
        image.file_format = "PNG"
        image.pack()
        return bytes(image.packed_file.data)
    with image_parts.copied(image) as copy:
        copy.file_format = "PNG"
        copy.pack()
        return bytes(copy.packed_file.data)
