"""Assets whose images are painted over in objects of the last frame, with what that makes of their materials."""

from __future__ import annotations

import contextlib
import io
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS
from ..core.asset.textures import has_alpha
from ..core.errors import AssetError
from ..core.frame import ObjectState
from ..core.materials import Image
from ..core.repainted_textures import carried_paint, pictures_of, repainted
from ..ipc.change_detection import reuse_equal
from .asset_textures import decoded
from .loaded_assets import LoadedAsset

Array = np.ndarray

_paintings = itertools.count(1)


class _Known(NamedTuple):
    """What is loaded of an asset, the images painted over it, and what that makes of it."""

    whole: LoadedAsset
    images: Sequence[Image]
    made: LoadedAsset


class RepaintedAssets:
    """Looks materials up in painted images; kept from one frame to the next, shared by instances."""

    def __init__(self) -> None:
        self._last: list[_Known] = []
        self._used: list[_Known] = []

    def begin(self) -> None:
        """A frame begins: what the last one did not use is forgotten."""
        self._last, self._used = self._used, []

    def loaded(self, whole: LoadedAsset, state: ObjectState) -> tuple[LoadedAsset, ObjectState]:
        """What is loaded for an object with its painted images, and its state, in which these are what is captured.

        Channels painted on its vertices are then painted over the materials that its images make.
        """
        mesh = whole.asset.mesh
        if not state.images or mesh.textures is None:
            return whole, state
        found = None
        for entry in (*self._used, *self._last):
            if entry.whole is whole and reuse_equal(state.images, entry.images) is entry.images:
                found = entry
                break
        if found is None:
            found = _Known(whole, reuse_equal(state.images, None), _made(whole, state))
        if all(found is not used for used in self._used):
            self._used.append(found)
        if found.made.driven is None and whole.driven is not None:
            found.made.driven = whole.driven.repainted(found.made.asset.mesh, found.made.asset.surfels)
        painted = {name: getattr(state, name) for name in MATERIAL_CHANNELS}
        return found.made, replace(state, images=[], **carried_paint(mesh, found.made.asset.mesh, painted))


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
        files[name, coloured] = _encoded(pixels if has_alpha(data.tobytes()) else pixels[..., :3])
        with contextlib.suppress(AssetError):  # a damaged file; what is painted over it is shown all the same
            before[name, coloured] = _pixels(whole, name, state.asset)
    made = repainted(whole.asset, before, now, files)
    number, alike = next(_paintings), whole.textured_of(state.asset)
    return LoadedAsset(made, whole.stamp, faults=[*whole.faults, *faults], painting=number, alike=alike)


def _pixels(whole: LoadedAsset, name: str, key: str) -> Array:
    """(h, w, 4) uint8 pixels of an image as its file has them."""
    textures = whole.asset.mesh.textures
    assert textures is not None
    file = textures.files[list(textures.images).index(name)]
    known = whole.textured_of(key).pixels_of(file)
    return decoded(file[1], f"{key}, image {name}") if known is None else known


def _encoded(pixels: Array) -> Array:
    """A PNG file of pixels, (bytes,) uint8; quickly, for it is read at once."""
    from PIL import Image as Pillow

    data = io.BytesIO()
    Pillow.fromarray(np.ascontiguousarray(pixels)).save(data, "PNG", compress_level=1)
    return np.frombuffer(data.getbuffer(), np.uint8)
