"""Photographs to views: decoded, straightened, scaled down, laid on one background."""

from __future__ import annotations

import logging

import numpy as np
from PIL import Image
from scipy.ndimage import binary_erosion, binary_fill_holes, label

from ...core.color import linear_to_srgb, to_unit
from ...core.errors import AssetError
from ...core.frame import Camera
from ..capture.capture import RGB, WHITE, View
from .exposures import exposed
from .layout import Layout, Photograph, load_picture
from .lens import Lens, resample, undistorted

Array = np.ndarray
logger = logging.getLogger(__name__)

#: Pixels darker than this everywhere, or that differ no more than this, are no photograph.
_BLACK, _ALIKE = 0.02, 0.002
#: Linear values above this are taken for damage.
_BRIGHTEST = 1e4
#: Pixels of the shorter side of the least picture that shows anything, also at half size.
_LEAST = 4
#: How much the surroundings may vary, and how much of the pixels must be surroundings, to be called one colour.
_PLAIN, _ENOUGH = 0.01, 0.05
#: Without masks: width of the border that shows the backdrop, in parts of the picture; part of it that must have one
#: colour, and how far from it that may be. Holes in the object's outline below this part of the picture are its own.
_BORDER, _MOST, _NEAR, _SPECK = 0.02, 0.7, 0.06, 0.002


def load_photograph(
    photograph: Photograph,
    layout: Layout,
    resolution: int | None,
    known: dict[Lens, tuple[Lens, Array]],
    gain: float = 1.0,
) -> View | None:
    """Read one photograph; None where it is black or of one colour all over.

    Parameters
    ----------
    photograph : Photograph
    layout : Layout
    resolution : int or None
        Pixels of the longer side at most; None keeps the size.
    known : dict of Lens to tuple of (Lens, array)
        Results of `undistorted` for lenses with distortion, filled as they occur.
    gain : float
        Of `exposures.find_gains`.

    Raises
    ------
    AssetError
        The file cannot be decoded; photograph, mask and calibration have different shapes; too few pixels.
    """
    subject = str(photograph.image)
    stored, notes = load_picture(photograph.image)
    layout.notes += [(photograph.image, note) for note in notes]
    if gain != 1.0 and stored.dtype.kind == "f":
        stored = np.concatenate([stored[..., :3] * np.float32(gain), stored[..., 3:]], axis=2)
    pixels, above = _shown(stored), _above_white(stored)
    if gain != 1.0 and stored.dtype.kind != "f":
        pixels = np.concatenate([exposed(pixels[..., :3], gain), pixels[..., 3:]], axis=2)
    height, width = pixels.shape[:2]
    lens = _fitting(photograph.lens, width, height, subject)
    mask = _mask(photograph, layout, pixels)
    if mask is not None and pixels.shape[2] == 4 and photograph.mask is None:
        # Premultiplied: colours of pixels that are not there must not bleed into those that are.
        pixels = pixels[..., :3] * mask[..., None]
        above = None if above is None else above * mask[..., None]
        premultiplied = True
    else:
        pixels, premultiplied = pixels[..., :3], False
    layers = np.dstack([layer for layer in (pixels, mask, above) if layer is not None])
    if lens.distorts:
        if lens not in known:
            known[lens] = undistorted(lens)
        lens, positions = known[lens]
        layers = resample(layers, positions)
    if resolution is not None and max(width, height) > resolution:
        factor = resolution / max(width, height)
        width, height = max(1, round(width * factor)), max(1, round(height * factor))
        layers = shrink(layers, width, height)
        lens = lens.scaled(width, height)
    if min(width, height) < _LEAST:
        remedy = "Use larger photographs" if resolution is None else "Use larger ones, or a larger --resolution"
        raise AssetError(subject, f"has {width} x {height} pixels to learn from, which show nothing", remedy)
    colour = layers[..., :3]
    mask = np.clip(layers[..., 3], 0, 1) if mask is not None else None
    if colour.max(initial=0.0) < _BLACK and (mask is None or mask.any()):
        return None
    if (mask is None or mask.min() >= 1) and np.ptp(colour, axis=(0, 1)).max() < _ALIKE:
        return None
    if premultiplied:
        assert mask is not None
        colour = colour + (1 - mask[..., None]) * np.asarray(WHITE, np.float32)
    camera = Camera(photograph.matrix, width, height, lens.fx, lens.fy, lens.cx, lens.cy)
    colour = np.ascontiguousarray(np.clip(colour, 0, 1), np.float32)
    mask = None if mask is None else np.ascontiguousarray(mask, np.float32)
    above = None if above is None else np.ascontiguousarray(layers[..., -3:], np.float32)
    linear = stored.dtype.kind == "f"
    band = photograph.mask_band
    if mask is not None and band:  # never less than a pixel of what is learned from
        band = max(1.0, band * max(width, height) / max(photograph.lens.width, photograph.lens.height))
    return View(
        photograph.name, camera, colour, mask, photograph.test, above_white=above, linear=linear,
        on_white=premultiplied, mask_band=0.0 if mask is None else band,
    )  # fmt: skip


def _fitting(lens: Lens, width: int, height: int, subject: str) -> Lens:
    """The lens for a picture of this size, when it is the calibrated one made smaller or larger."""
    if (lens.width, lens.height) == (width, height):
        return lens
    x, y = width / lens.width, height / lens.height
    if abs(x - y) * max(lens.width, lens.height) > 2:
        problem = f"is {width} x {height} pixels, but its camera was calibrated for {lens.width} x {lens.height}"
        raise AssetError(subject, problem, "Use the photographs that were calibrated, or calibrate these")
    return lens.scaled(width, height)


def _shown(pixels: Array) -> Array:
    """(h, w, 3 or 4) float32 in 0..1, sRGB-encoded, of a picture as it is read: floats are linear."""
    if pixels.dtype.kind == "u":
        return to_unit(pixels)
    pixels = np.clip(pixels, 0, 1)
    return np.concatenate([linear_to_srgb(pixels[..., :3]), pixels[..., 3:]], axis=2)


def _above_white(pixels: Array) -> Array | None:
    """(h, w, 3) float32: how much brighter than white linear colours are; None where none is, or they are no floats."""
    if pixels.dtype.kind != "f":
        return None
    above = np.clip(pixels[..., :3] - 1, 0, _BRIGHTEST).astype(np.float32)
    return above if above.any() else None


def _mask(photograph: Photograph, layout: Layout, pixels: Array) -> Array | None:
    """(h, w) float32 of a mask file, or of the photograph's own alpha."""
    if photograph.mask is None:
        return pixels[..., 3] if pixels.shape[2] == 4 else None
    mask = layout.decode_mask(photograph.mask)
    if mask.shape != pixels.shape[:2]:
        (h, w), (height, width) = mask.shape, pixels.shape[:2]
        if abs(w / width - h / height) * max(width, height) > 2:
            problem = f"is {w} x {h} pixels, its photograph {photograph.image.name} {width} x {height}"
            raise AssetError(str(photograph.mask), problem, "Make the mask again from this photograph")
        mask = np.asarray(Image.fromarray(mask).resize((width, height), Image.Resampling.BILINEAR))
    return mask.astype(np.float32)


def shrink(layers: Array, width: int, height: int) -> Array:
    """(h, w, c) float32 to (height, width, c): every pixel the mean of the area it covers."""
    channels = [
        np.asarray(Image.fromarray(np.ascontiguousarray(layers[..., c])).resize((width, height), Image.Resampling.BOX))
        for c in range(layers.shape[2])
    ]
    return np.stack(channels, axis=-1)


def find_background(views: list[View]) -> RGB | None:
    """The one colour outside of all masks; None where the surroundings are real, or there are none."""
    outside = [view.colour[view.mask < 0.004] for view in views if view.mask is not None]
    if len(outside) < len(views) or not outside:
        return None
    pixels = np.concatenate([part[:: max(1, len(part) // 4096)] for part in outside])
    if len(pixels) < _ENOUGH * 4096 or pixels.std(axis=0).max() > _PLAIN:
        return None
    r, g, b = (round(255 * float(c)) / 255 for c in pixels.mean(axis=0, dtype=np.float64))
    return r, g, b


def cut_out(views: list[View]) -> bool:
    """Give views without masks those of what differs from the colour of their borders; whether all have such a colour.

    Nothing is changed where one has not: its surroundings are real, or the object covers its border.
    """
    masks = [_standing_out(view.colour) for view in views]
    if not masks or any(mask is None for mask in masks):
        return False
    for view, mask in zip(views, masks):
        view.set_mask(mask)
    return True


def _standing_out(colour: Array) -> Array | None:
    """(h, w) float32 mask of what in (h, w, 3) `colour` is not the border's, small holes closed; None without such.

    The outermost pixels of the object show both, as much of either on average: one half.
    """
    width = max(1, round(_BORDER * min(colour.shape[:2])))
    frame = np.ones(colour.shape[:2], bool)
    frame[width:-width, width:-width] = False
    border = colour[frame]
    backdrop = np.median(border, axis=0)
    distance = np.abs(border - backdrop).max(axis=1)
    near = distance[distance < _NEAR]
    if len(near) < _MOST * len(border):
        return None
    # Its own noise or shading says how far from it a pixel must be.
    object_ = np.abs(colour - backdrop).max(axis=2) > 0.01 + 2 * float(np.quantile(near, 0.98))
    holes, count = label(binary_fill_holes(object_) & ~object_)
    small = np.bincount(holes.reshape(-1), minlength=count + 1) < _SPECK * holes.size
    small[0] = False
    object_ |= small[holes]
    return 0.5 * (object_.astype(np.float32) + binary_erosion(object_, border_value=1))
