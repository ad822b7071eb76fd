"""Frames on disk: OpenEXR files that are either whole or absent.

Layout. The beauty is the plain channels R, G, B, A, which every viewer opens; every other pass is a layer of its own
name beside it (``Depth.Z``, ``Normal.X`` ...). Blender 5's Image node shows such a file as one layer with the sockets
Combined, Depth, Normal ...; writing the beauty a second time as ``ViewLayer.Combined`` would only double the file.
Data passes are 32-bit floats always, colour passes are as well unless half floats are asked for. Compression is ZIP,
lossless, 16 scan lines a block.

Metadata lie in the header as string attributes named ``drgs:<key>``, those of Cryptomatte under the names that every
reader of it knows. ``drgs:crc32`` covers pixels and metadata, because
OpenEXR itself accepts many damaged files; `read_frame` checks it.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from ...compute.threads import get_num_threads
from ...core.cryptomatte import METADATA
from ...core.errors import AssetError, UsageError, WriteError
from ...core.passes import AOV_COLOUR, AOV_VALUE, BY_NAME, LIGHT_GROUP, Pass, pass_of
from ...core.system import WINDOWS, replace

Array = np.ndarray

PREFIX = "drgs:"
_CHECKSUM = "crc32"
#: What is wrong with a file of others, and what to do.
_FOREIGN = (
    "was not written by DR-GS's commands",
    "Frames to be read come from `drgs render`, not from Blender itself; to write, choose another folder or file name",
)
_LARGEST_HALF = 65504.0
#: What OpenEXR raises when a file is absent, damaged or cannot be written; the kind says nothing about the cause.
_FAILURES = (OSError, RuntimeError, ValueError, TypeError)


def write_frame(path: str | Path, passes: dict[str, Array], metadata: dict[str, str], half: bool = False) -> None:
    """Write a frame so that `path` never holds anything but a whole frame.

    The file is written beside `path` under a temporary name, flushed to the disk, read back and compared bit by bit,
    and only then renamed. On failure nothing new is left in the folder and an older frame under `path` is untouched.

    Parameters
    ----------
    path : str or Path
        File to write; its folder must exist.
    passes : dict of str to array
        Pass name (see `passes.PASSES`) -> (h, w, channels) float32, row 0 at the top, linear Rec.709.
    metadata : dict of str to str
        Free text by key, such as the hash of the settings.
    half : bool
        Colour passes as half floats (values beyond 65504 are clamped).

    Raises
    ------
    UsageError: the passes do not make a picture.
    WriteError: the folder is missing or read-only, the disk is full, or the file cannot be read back.
    """
    path = Path(path)
    channels = _channels(path, passes, half)
    checksum = _checksum(channels, metadata)
    header: dict[str, Any] = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    header |= {key if key.startswith(METADATA) else PREFIX + key: str(value) for key, value in metadata.items()}
    header[PREFIX + _CHECKSUM] = checksum
    temporary: Path | None = None
    OpenEXR.set_global_thread_count(get_num_threads())
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        temporary = Path(name)
        os.close(handle)
        with OpenEXR.File(header, dict(channels)) as file:  # a copy: OpenEXR puts objects of its own into it
            file.write(str(temporary))
        _flush(temporary)
        _verify(temporary, channels, checksum)
        temporary.chmod(0o666 & ~_umask())
        replace(temporary, path)
        with contextlib.suppress(OSError):  # the frame is there; some network disks cannot flush a folder
            _flush(path.parent)
    except _FAILURES as error:
        remedy = "Check the folder's permissions and the free space on its disk"
        raise WriteError(str(path), f"cannot be written ({str(error).strip()})", remedy) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def read_frame(path: str | Path) -> tuple[dict[str, Array], dict[str, str]]:
    """Read and verify a frame.

    Returns
    -------
    passes : dict of str to array
        Pass name -> (h, w, channels) float32, row 0 at the top; unknown layers are left out. A layer of a colour or
        of a number that no pass of the table has is a shader AOV, or a light group.
    metadata : dict of str to str
        As given to `write_frame`.

    Raises
    ------
    AssetError: there is no such file, it is damaged or cut short, or it is no frame of DR-GS.
    """
    path = Path(path)
    OpenEXR.set_global_thread_count(get_num_threads())
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header = dict(file.header())  # a copy: OpenEXR empties it when the file closes
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except _FAILURES as error:
        raise AssetError(str(path), f"cannot be read as OpenEXR ({error})", "Render this frame again") from error
    texts = {k: v for k, v in header.items() if k.startswith((PREFIX, METADATA)) and isinstance(v, str)}
    metadata = {k.removeprefix(PREFIX): v for k, v in texts.items()}
    checksum = metadata.pop(_CHECKSUM, None)
    if checksum is None:
        raise AssetError(str(path), *_FOREIGN)
    if checksum != _checksum(channels, metadata):
        raise AssetError(str(path), "is damaged: its checksum does not fit", "Render this frame again")
    passes: dict[str, Array] = {}
    for kind in (*BY_NAME.values(), *_named(channels)):
        names = [_channel_name(kind, c) for c in kind.channels]
        if all(n in channels for n in names):
            passes[kind.name] = np.stack([channels[n].astype(np.float32) for n in names], axis=-1)
    return passes, metadata


def _named(channels: dict[str, Array]) -> list[Pass]:
    """Passes that a scene named, by the channels of a file."""
    known = {_channel_name(kind, c) for kind in BY_NAME.values() for c in kind.channels}
    letters: dict[str, set[str]] = {}
    for name in sorted(channels.keys() - known):
        layer, _, letter = name.rpartition(".")
        letters.setdefault(layer, set()).add(letter)
    found = []
    for layer, own in letters.items():
        start = {"RGBA": AOV_COLOUR, "X": AOV_VALUE, "RGB": ""}.get("".join(c for c in "RGBAX" if c in own))
        if start is not None and (start or layer.startswith(LIGHT_GROUP)) and (kind := pass_of(start + layer)):
            found.append(kind)
    return found


def read_checksum(path: str | Path) -> str:
    """Checksum of pixels and metadata that the frame at `path` carries; only its header is read.

    Raises
    ------
    AssetError: there is no such file, or it is no frame of DR-GS.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            checksum = file.header().get(PREFIX + _CHECKSUM)
    except _FAILURES as error:
        raise AssetError(str(path), f"cannot be read as OpenEXR ({error})", "Render this frame again") from error
    if not isinstance(checksum, str):
        raise AssetError(str(path), *_FOREIGN)
    return checksum


def _channel_name(kind: Pass, channel: str) -> str:
    return channel if kind.name == "Combined" else f"{kind.layer}.{channel}"


def _channels(path: Path, passes: dict[str, Array], half: bool) -> dict[str, Array]:
    """Channel name -> (h, w) float32 or float16; raise UsageError unless all passes have one size."""
    size = None
    channels: dict[str, Array] = {}
    for name, values in passes.items():
        kind = pass_of(name)
        if kind is None:
            raise UsageError(f"pass {name!r}", "does not exist", f"Choose from {', '.join(BY_NAME)}")
        if values.ndim != 3 or values.shape[2] != len(kind.channels) or values.shape[:2] != (size or values.shape[:2]):
            raise UsageError(f"pass {name!r}", f"has shape {values.shape}, which does not fit the frame", "")
        size = values.shape[:2]
        for i, letter in enumerate(kind.channels):
            channel = np.ascontiguousarray(values[:, :, i], dtype=np.float32)
            if half and kind.kind == "COLOR" and not kind.exact:
                channel = np.clip(channel, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16)
            if _channel_name(kind, letter) in channels:
                raise UsageError(f"pass {name!r}", f"is named as another layer, {kind.layer}", "Give it another name")
            channels[_channel_name(kind, letter)] = channel
    if size is None or 0 in size:
        raise UsageError(str(path), "would hold no pixels", "Ask for at least one pass and a region with pixels")
    return channels


def _checksum(channels: dict[str, Array], metadata: dict[str, str]) -> str:
    """CRC-32 of names, sizes, pixels and metadata, in the order of the names."""
    crc = 0
    for name in sorted(channels):
        crc = zlib.crc32(f"{name} {channels[name].dtype} {channels[name].shape}".encode(), crc)
        crc = zlib.crc32(np.ascontiguousarray(channels[name]).view(np.uint8).reshape(-1).data, crc)
    for key in sorted(metadata):
        crc = zlib.crc32(f"{key}={metadata[key]}\n".encode(), crc)
    return f"{crc:08x}"


def _verify(path: Path, channels: dict[str, Array], checksum: str) -> None:
    """Raise OSError unless the file decodes to exactly these channels."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
        if file.header().get(PREFIX + _CHECKSUM) != checksum or found.keys() != channels.keys():
            raise OSError("the header reads back differently")
        for name, values in channels.items():
            if found[name].dtype != values.dtype or found[name].tobytes() != values.tobytes():
                raise OSError(f"channel {name} reads back differently")


def _flush(path: Path) -> None:
    """Force a file, or where the system can do so a folder, to the disk."""
    if path.is_dir() and WINDOWS:
        return
    handle = os.open(path, os.O_RDWR if WINDOWS else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    """The permissions a new file would lack; mkstemp gives none to others."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
