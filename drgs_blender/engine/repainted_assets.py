"""Assets whose images are painted over in objects of the last frame, with what that makes of their materials."""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS
from ..core.asset.textures import has_alpha
from ..core.errors import AssetError
from ..core.frame import ObjectState
from ..core.materials import Image
from ..core.repainted_textures import carried_paint, pictures_of, repainted
from .asset_textures import decoded
from .derived_assets import DerivedAssets
from .loaded_assets import LoadedAsset

Array = np.ndarray

_paintings = itertools.count(1)


class RepaintedAssets(DerivedAssets[Sequence[Image]]):
    """Looks materials up in painted images."""

    def loaded(self, whole: LoadedAsset, state: ObjectState) -> tuple[LoadedAsset, ObjectState]:
        """What is loaded for an object with its painted images, and its state, in which these are what is captured.

        Channels painted on its vertices are then painted over the materials that its images make.
        """
        mesh = whole.asset.mesh
        if not state.images or mesh.textures is None:
            return whole, state
        made = self.of(whole, state.images, lambda: _made(whole, state))
        if made.driven is None and whole.driven is not None:
            made.driven = whole.driven.repainted(made.asset.mesh, made.asset.surfels)
        painted = {name: getattr(state, name) for name in MATERIAL_CHANNELS}
        return made, replace(state, images=[], **carried_paint(mesh, made.asset.mesh, painted))


def _made(whole: LoadedAsset, state: ObjectState) -> LoadedAsset:
    """The asset with the painted images of an object; what of these does not fit it is named."""
    textures = whole.asset.mesh.textures
    assert textures is not None
    now = pictures_of(textures, state.images)
    shown = {name for name, _ in now}
    faults = [
        f"its painted image {image.name} is none of its asset, or has no bytes; it is not shown"
        for image in state.images
        if image.name not in shown
    ]
    before, files = {}, {}
    for (name, coloured), pixels in now.items():
        data = textures.images[name]
        files[name, coloured] = _header(pixels, has_alpha(data.tobytes()))
        with contextlib.suppress(AssetError):  # a damaged file; what is painted over it is shown all the same
            before[name, coloured] = _pixels(whole, name, state.asset)
    made = repainted(whole.asset, before, now, files)
    others = whole.textured_of(state.asset)

    def pixels_of(file: tuple[str, Array]) -> Array | None:
        painted = next((now[key] for key, header in files.items() if header is file[1]), None)
        return others.pixels_of(file) if painted is None else painted

    number, told = next(_paintings), [*whole.faults, *faults]
    return LoadedAsset(made, whole.stamp, faults=told, painting=number, pixels_of=pixels_of)


def _pixels(whole: LoadedAsset, name: str, key: str) -> Array:
    """(h, w, 4) uint8 pixels of an image as its file has them."""
    textures = whole.asset.mesh.textures
    assert textures is not None
    file = textures.files[list(textures.images).index(name)]
    known = whole.textured_of(key).pixels_of(file)
    return decoded(file[1], f"{key}, image {name}") if known is None else known


def _header(pixels: Array, alpha: bool) -> Array:
    """The beginning of a PNG file of pixels, (bytes,) uint8: it says what of them counts; they need not be read."""
    height, width = pixels.shape[:2]
    fields = struct.pack(">I4sIIBBBBB", 13, b"IHDR", width, height, 8, 6 if alpha else 2, 0, 0, 0)
    return np.frombuffer(b"\x89PNG\r\n\x1a\n" + fields, np.uint8)
