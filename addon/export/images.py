"""Image datablocks -> pixels, remembered while an image does not change."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import bpy
import numpy as np

from ...drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from ...drgs_blender.core.materials import Image
from . import image_cubic, image_grid, image_parts, image_pixels

Array = np.ndarray
Warn = Callable[[str], None]
T = TypeVar("T")

#: What Cycles shows for an image it cannot read.
MISSING = (1.0, 0.0, 1.0)
#: Exports for which an image that none of them used is remembered: view layers and scenes take turns.
KEPT_EXPORTS = 4

#: What was made of an image -> (the number of the export that used it last, result).
_known: dict[tuple[object, ...], tuple[int, Any]] = {}
_export = 0
_MAGENTA_TEXEL = np.array([[[255, 0, 255, 255]]], np.uint8)
#: In place of pixels for which there is no memory any more.
LOST = Image("no memory", _MAGENTA_TEXEL, "linear")
#: Frame of the scene that is exported.
_now = 0
#: Whether the export read a sequence or a movie.
_moving = False


@dataclass(frozen=True, slots=True)
class Lookup:
    """What of an image a node shows, and how; as Blender's Image Texture node says it.

    Attributes
    ----------
    frame : of a sequence or movie, 0 for others
    interpolation, extension : as the node's
    """

    frame: int = 0
    interpolation: str = "Linear"
    extension: str = "REPEAT"

    @classmethod
    def of(cls, node: bpy.types.Node) -> Lookup:
        """That of an Image or Environment Texture node at the frame that is exported."""
        frame = 0
        if node.image is not None and node.image.source in image_parts.MOVING:
            frame = image_parts.frame_of(node.image_user, _now)
        return cls(frame, node.interpolation, getattr(node, "extension", "REPEAT"))

    @property
    def is_cubic(self) -> bool:
        """Whether Cycles shows a spline."""
        return self.interpolation in ("Cubic", "Smart")


PLAIN = Lookup()


def linear_pixels(image: bpy.types.Image, warn: Warn) -> Array | None:
    """(h, w, 3) float32 linear Rec.709, row 0 at the top, read-only; None when the image has no pixels.

    Blender keeps float images in scene-linear already; 8-bit ones are as in the file and decoded here. Values that are
    no light (NaN, infinite, negative) stay as they are: the engine takes such texels as black and warns with a count.
    """
    if image.source in image_parts.MOVING:
        warn(f'Image "{image.name}": of a {image.source.lower()} only the current picture is used')
    if image.source == "TILED" and len(image.tiles) > 1:
        warn(f'Image "{image.name}": of its {len(image.tiles)} UDIM tiles only the first is used')
    _check(image, warn)
    return _made(image, "light", _with_problems(image_pixels.linear), warn)


@dataclass(frozen=True, slots=True)
class Shown:
    """A picture, and where it lies.

    Attributes
    ----------
    place : (4, 4), from the coordinates at which Blender looks the image up to those of the picture
    extension : of the picture, as the node's
    is_spline : as Cubic and Smart want it; else the picture is looked up as with Linear
    """

    picture: Image
    place: Array
    extension: str
    is_spline: bool = False


def export_image(image: bpy.types.Image, straight: bool, warn: Warn, lookup: Lookup = PLAIN) -> Image | None:
    """Pixels of a texture; None when the image has none.

    Parameters
    ----------
    straight : keep the colours as they are where alpha is small. Cycles does so only for nodes whose Alpha is used;
        else the colours are multiplied with alpha (not those of data and of channel-packed images)
    """
    found = show(image, straight, warn, lookup)
    return None if found is None else found.picture


def show(image: bpy.types.Image, straight: bool, warn: Warn, lookup: Lookup) -> Shown | None:
    """What a node shows of an image; None when it has no pixels. Parameters as of `export_image`."""
    global _moving
    _check(image, warn)
    make = image_pixels.straight if straight else image_pixels.associated
    name = image.name_full + (" (straight)" if straight else "")
    kind = "straight" if straight else "associated"
    if image.source == "TILED":
        picture = _tiled(image, kind, make, name, lookup, warn)
        if picture is None:
            return None
        return Shown(picture, image_grid.placement([tile.number for tile in image.tiles], picture), "EXTEND")
    if image.source in image_parts.MOVING:
        _moving = True
        picture = _still(image, kind, make, f"{name} (frame {lookup.frame})", lookup, warn)
    else:
        picture = _made(image, kind, _with_problems(lambda i: _named(make(i), name)), warn)
    if picture is None:
        return None
    shown = Shown(picture, np.eye(4), lookup.extension)
    if not lookup.is_cubic:
        return shown

    def spline(_: bpy.types.Image) -> tuple[Shown, list[str]]:
        finer = image_cubic.finer(picture, lookup.extension)
        if finer is None:
            return shown, []
        named = replace(finer, name=f"{picture.name} (cubic {lookup.extension})")
        size = picture.pixels.shape[1], picture.pixels.shape[0]
        return Shown(named, image_cubic.placement(size, lookup.extension), lookup.extension, True), []

    name = f"{kind} {lookup.extension} {lookup.frame} cubic"
    return _made(image, name, spline, warn, lookup.frame) or shown


def _tiled(
    image: bpy.types.Image, kind: str, make: Callable[..., Image | None], name: str, lookup: Lookup, warn: Warn
) -> Image | None:
    """All tiles in one picture; None where none can be read."""
    closest = lookup.interpolation == "Closest"

    def stitch(image: bpy.types.Image) -> tuple[Image | None, list[str]]:
        read = _with_problems(make)
        with image_parts.tiles(image) as shown:
            tiles = {number: read(tile) for number, tile in shown}
        found = {number: picture for number, (picture, _) in tiles.items()}
        lost = [str(number) for number, picture in found.items() if picture is None]
        whole = {number: picture for number, picture in found.items() if picture is not None}
        problems = [f"tile {number}: {text}" for number, (_, texts) in tiles.items() for text in texts]
        if not whole:
            return None, problems
        if lost:
            problems.append(f"tile {', '.join(lost)} cannot be read; as in Cycles it is magenta. Find or fill it")
        if image.is_dirty and len(found) > 1:
            problems.append("what is painted on its tiles is not saved; but for the first they are as saved. Save it")
        # The grid is that of all tiles, so that it lies where `placement` says.
        ends = {n: whole.get(n) or Image("", _MAGENTA_TEXEL, "linear") for n in found}
        picture, reduced = image_grid.grid(ends, lookup.extension, closest)
        if reduced > 1:
            problems.append(f"its {len(found)} tiles are too large together and are reduced {reduced:.3g} times")
        return _named(picture, f"{name} ({lookup.extension} {'closest' if closest else 'linear'} tiles)"), problems

    return _made(image, f"{kind} {lookup.extension} {closest}", stitch, warn)


def _still(
    image: bpy.types.Image, kind: str, make: Callable[..., Image | None], name: str, lookup: Lookup, warn: Warn
) -> Image | None:
    """The picture of a frame; None where it cannot be read."""

    def read(image: bpy.types.Image) -> tuple[Image | None, list[str]]:
        with image_parts.still(image, lookup.frame) as shown:
            picture, problems = _with_problems(make)(shown)
        if picture is None:
            path = image_parts.frame_file(image, lookup.frame)
            problems.append(f"frame {lookup.frame}, {path}, cannot be read. See that the file is there")
        return _named(picture, name), problems

    return _made(image, f"{kind} {lookup.frame}", read, warn, lookup.frame)


def _with_problems(
    make: Callable[[bpy.types.Image], T | None],
) -> Callable[[bpy.types.Image], tuple[T | None, list[str]]]:
    """`make`, with what is wrong with the image."""
    return lambda image: (make(image), image_pixels.problems(image))


def _made(
    image: bpy.types.Image, kind: str, make: Callable[..., tuple[T, list[str]]], warn: Warn, frame: int = 0
) -> T | None:
    """What `make` makes of an image, remembered; warns of what is wrong with it. None where there is no memory for it.

    That is not remembered: the next export tries again.
    """
    try:
        found, problems = _remembered(image, kind, make, frame)
    except MemoryError:
        found, problems = None, ["there is no memory for its pixels. Use a smaller image, or close other programs"]
    for problem in problems:
        warn(f'Image "{image.name}": {problem}')
    return found


def _named(picture: Image | None, name: str) -> Image | None:
    return None if picture is None else replace(picture, name=name)


def unreadable(image: bpy.types.Image | None, frame: int) -> tuple[str, bool]:
    """What is said of a node's image without pixels, and whether its file is there, of which Cycles may read a part."""
    if image is None:
        return "has no image; as in Cycles it is magenta", False
    damaged = image.packed_file is not None or os.path.isfile(image_parts.frame_file(image, frame))
    seen = "what Cycles makes of it is shown" if damaged else "as in Cycles it is magenta"
    return f'image "{image.name}" cannot be read; {seen}', damaged


def mean_colour(picture: Image) -> Array:
    """(4,) linear mean of a picture, from at most some 65 thousand of its pixels."""
    some = _some(picture).astype(np.float64)
    if picture.pixels.dtype == np.uint8:
        some /= 255
    if picture.encoding == "srgb":
        some[:, :3] = srgb_to_linear(some[:, :3])
    some = some[np.isfinite(some).all(axis=1)]
    return some.mean(axis=0) if len(some) else np.zeros(4)


def _some(picture: Image) -> Array:
    """(n, 4) of its pixels, spread evenly."""
    steps = [max(1, n // 256) for n in picture.pixels.shape[:2]]
    return replace(picture, pixels=picture.pixels[:: steps[0], :: steps[1]]).rgba.reshape(-1, 4)


def export_curved(
    image: bpy.types.Image,
    straight: bool,
    source: str,
    curve: bytes,
    warn: Warn,
    data: bool = False,
    lookup: Lookup = PLAIN,
) -> Image:
    """Pixels of an 8-bit texture whose bytes stand for other values.

    Parameters
    ----------
    source : channel whose bytes are looked up for red, green and blue; "rgb" is each of its own
    curve : (256, 3) float32 in [0, 1], linear, as bytes
    data : keep the values as they are; else colours are encoded as sRGB
    """
    plain = export_image(image, straight, warn, lookup)
    if plain is None:  # which was there when it was looked for
        return LOST
    values = np.frombuffer(curve, np.float32).reshape(256, 3)
    number = data or (bool((np.ptp(values, axis=1) < 1e-6).all()) and source != "rgb")
    table = np.rint(255 * (values if number else linear_to_srgb(values))).astype(np.uint8)

    def make(_: bpy.types.Image) -> tuple[Image, list[str]]:
        given = plain.rgba
        pixels = given.copy()
        for i in range(3):
            pixels[..., i] = table[:, i][given[..., i if source == "rgb" else "rgba".index(source)]]
        pixels.flags.writeable = False
        mark = hashlib.blake2b(source.encode() + b"data" * data + curve, digest_size=6).hexdigest()
        return Image(f"{plain.name} ({mark})", pixels, "linear" if number else "srgb"), []

    kind = f"{plain.name} {source} {data} {hashlib.blake2b(curve).hexdigest()}"
    return _made(image, kind, make, warn, lookup.frame) or LOST


def is_grey(picture: Image) -> bool:
    """Whether red, green and blue are the same, in some 65 thousand of its pixels at most."""
    some = _some(picture)
    return bool((some[:, 0] == some[:, 1]).all() and (some[:, 0] == some[:, 2]).all())


def begin_export(frame: int) -> None:
    """An export of the scene at a frame begins."""
    global _now, _moving
    _now, _moving = frame, False


def end_export() -> bool:
    """Drop what the last exports did not use; whether this one read a sequence or a movie."""
    global _export
    _export += 1
    for key in [k for k, (used, _) in _known.items() if used < _export - KEPT_EXPORTS]:
        del _known[key]
    return _moving


def forget() -> None:
    """Drop all remembered pixels."""
    _known.clear()


def _check(image: bpy.types.Image, warn: Warn) -> None:
    """Say what is not as in Cycles."""
    space = image.colorspace_settings.name
    if space in (*image_pixels.LINEAR, "sRGB", ""):  # "": of a movie that was not read yet
        return
    if not _remembered(image, "float", lambda i: image_pixels.is_empty(i) or i.is_float):
        warn(f'Image "{image.name}": colour space {space} of an 8-bit image is read as sRGB')


def _remembered(image: bpy.types.Image, kind: str, make: Callable[[bpy.types.Image], Any], frame: int = 0) -> Any:
    """What `make` makes of the image, from memory where the image did not change.

    What Blender reads of a file for that is given back, where it was not there before.
    """
    key = _key(image, frame)
    if key is None:
        return make(image)
    key = (kind, *key)
    if key not in _known:
        was_there = image.has_data or image.source != "FILE"
        try:
            _known[key] = _export, make(image)
        finally:
            if not was_there:
                image.buffers_free()
    result = _known[key][1]
    _known[key] = _export, result
    return result


def _key(image: bpy.types.Image, frame: int) -> tuple[object, ...] | None:
    """What the pixels depend on, or None where that is not known: painted and generated images."""
    if image.source in ("GENERATED", "VIEWER") or image.is_dirty:
        return None
    settings = image.session_uid, image.name_full, image.source, image.colorspace_settings.name, image.alpha_mode
    if image.source == "TILED":
        known = {p.tile_number: _digest(p.packed_file) for p in image.packed_files}
        return *settings, *(known.get(tile.number) or _tile_key(image, tile) for tile in image.tiles)
    stamp = _stamp(image_parts.frame_file(image, frame))
    packed = _digest(image.packed_file) if image.packed_file else b""
    # Not its size: to say it, Blender reads the file.
    return *settings, *stamp, packed, 0 if image.source == "FILE" else frame


def _tile_key(image: bpy.types.Image, tile: bpy.types.UDIMTile) -> tuple[object, ...]:
    """File of a tile, or what it is filled with: to say its size, Blender reads the file."""
    path, changed = _stamp(image_parts.tile_file(image, tile.number))
    if changed:
        return tile.number, path, changed
    return tile.number, path, *tile.size, tile.generated_type, *tile.generated_color


def _stamp(path: str) -> tuple[str, int]:
    try:
        return path, os.stat(path).st_mtime_ns
    except OSError:  # packed, or missing (then there are no pixels)
        return path, 0


def _digest(packed: bpy.types.PackedFile) -> bytes:
    return hashlib.blake2b(packed.data).digest()
