"""Parts of an image datablock that Blender shows alone: the tiles of a tiled image, the frame of a sequence or movie.

A copy of the datablock, for as long as its pixels are read, is made to show the part. So what loads it is Blender:
packed files, colour spaces and all.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

import bpy

T = TypeVar("T")

MOVING = ("SEQUENCE", "MOVIE")
#: The last digits of a file's name, which are its frame.
_DIGITS = re.compile(r"\d+(?=\D*$)")


def frame_of(user: bpy.types.ImageUser, now: int) -> int:
    """Frame of a sequence or movie that a node shows at frame `now` of the scene (BKE_image_user_frame_get).

    Cycles does so whether or not Auto Refresh is on.
    """
    length, frame = user.frame_duration, now - user.frame_start + 1
    if length <= 0:
        return 0
    if user.use_cyclic:
        frame = frame % length or length
    return min(max(frame, 0), length) + user.frame_offset


def frame_file(image: bpy.types.Image, frame: int) -> str:
    """Path of the file that holds a frame; that of a movie is the same for all."""
    path = bpy.path.abspath(image.filepath, library=image.library)
    if image.source != "SEQUENCE":
        return path
    folder, name = os.path.split(path)
    stem, ending = os.path.splitext(name)
    named = _DIGITS.sub(lambda digits: f"{frame:0{len(digits[0])}d}", stem, count=1)
    return os.path.join(folder, named + ending)


def tile_file(image: bpy.types.Image, number: int) -> str:
    """Path of the file that holds a tile."""
    path = bpy.path.abspath(image.filepath, library=image.library)
    row, column = divmod(number - 1001, 10)
    return path.replace("<UDIM>", str(number)).replace("<UVTILE>", f"u{column + 1}_v{row + 1}")


def ask_file(image: bpy.types.Image, question: Callable[[str | bytes], T]) -> T | None:
    """What a question, as of `file_integrity`, says of the file that Blender reads an image from, of a tiled the first.

    None where there is none, packed or on disk, and of a movie. Of those on disk answers are remembered.
    """
    if image.source not in ("FILE", "SEQUENCE", "TILED") or image.is_dirty:
        return None
    packed = [file.packed_file for file in image.packed_files if file.packed_file is not None]
    if packed:
        return question(packed[0].data)
    tiled = image.source == "TILED" and len(image.tiles)
    path = tile_file(image, image.tiles[0].number) if tiled else image.filepath
    path = bpy.path.abspath(path, library=image.library)
    try:
        facts = os.stat(path)
        return _answer(question, path, facts.st_mtime_ns, facts.st_size) if facts.st_size else None
    except OSError:
        return None


@lru_cache(maxsize=4096)
def _answer(question: Callable[[str | bytes], Any], path: str, changed: int, size: int) -> Any:
    """Of a file on disk as it was when it was changed last."""
    return question(path)


@contextmanager
def still(image: bpy.types.Image, frame: int) -> Iterator[bpy.types.Image]:
    """A copy that shows a frame of a sequence or movie; one without pixels where that cannot be read."""
    with copied(image) as copy:
        if image.source == "SEQUENCE":
            settings = image.colorspace_settings.name, image.alpha_mode
            copy.source, copy.filepath = "FILE", frame_file(image, frame)
            copy.colorspace_settings.name, copy.alpha_mode = settings  # a new path may change them
        elif copy.size[0] * copy.size[1] > 0:
            # The frame that was asked for last is the one whose pixels are seen.
            copy.scale(*copy.size, frame=frame)
        yield copy


@contextmanager
def tiles(image: bpy.types.Image) -> Iterator[Iterator[tuple[int, bpy.types.Image]]]:
    """Numbers of the tiles, each with an image that shows it. What is painted and not saved is in the first alone."""
    with copied(image) as copy:
        yield _each_tile(image.original, copy)


def _each_tile(image: bpy.types.Image, copy: bpy.types.Image) -> Iterator[tuple[int, bpy.types.Image]]:
    packed = {file.tile_number: file.packed_file for file in image.packed_files if file.packed_file is not None}
    for i, number in enumerate([tile.number for tile in image.tiles]):
        if i > 0:
            copy.tiles.remove(copy.tiles[0])  # pixels are those of the first that is left
        if i > 0 and number in packed:  # of which a copy shows the first alone
            with _unpacked(image, packed[number].data) as alone:
                yield number, alone
        else:
            yield number, image if i == 0 else copy


@contextmanager
def _unpacked(image: bpy.types.Image, data: bytes) -> Iterator[bpy.types.Image]:
    """An image of a packed file's bytes, with the settings of another."""
    made = bpy.data.images.new(image.name, 1, 1)
    try:
        made.source = "FILE"
        made.pack(data=data, data_len=len(data))
        made.colorspace_settings.name, made.alpha_mode = image.colorspace_settings.name, image.alpha_mode
        yield made
    finally:
        bpy.data.images.remove(made)


@contextmanager
def copied(image: bpy.types.Image) -> Iterator[bpy.types.Image]:
    """A copy of an image, for a while."""
    copy = image.original.copy()
    try:
        yield copy
    finally:
        bpy.data.images.remove(copy)
