"""The outer layer of a `.drgs` file: a stored zip of which every byte is determined by its members.

Any zip program can list and unpack it. Member data start at multiples of 64 bytes (padding in the local header's
extra field), so arrays can be mapped. Dates, flags and attributes have one permitted value; the reader rebuilds all
headers from the list of members and compares, which refuses every other kind of zip (compressed, encrypted,
symbolic links, hidden data, overlapping members) as well as any damaged header. Layout after PKWARE's APPNOTE 6.3.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import stat
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import AssetError, WriteError
from ..file_types import READ
from ..system import WINDOWS, replace

Array = np.ndarray

ALIGNMENT = 64
#: More members than a `.drgs` file can have in any schema.
MEMBER_LIMIT = 64

_LOCAL = struct.Struct("<4s5H3I2H")
_CENTRAL = struct.Struct("<4s6H3I5H2I")
_END = struct.Struct("<4s4H2IH")
_VERSION, _FLAGS, _STORED = 20, 1 << 11, 0  # 2.0; names in UTF-8; not compressed
_TIME, _DATE = 0, 0x21  # 1980-01-01 00:00, so that equal assets are equal files
_PADDING_ID = 0xD935  # extra field that Android's zipalign reserves for padding
_ATTRIBUTES = 0o100644 << 16  # a regular file, in Unix terms
_BY_HAND = "import it by File > Import and choose Object > Convert > DR-GS"
_SIZE_LIMIT = 0xFFFFFFFF - (1 << 20)  # what a zip without the zip64 extension can address, less headers


@dataclass(frozen=True, slots=True)
class Member:
    """One member: name, size in bytes, CRC-32 of its data."""

    name: str
    size: int
    crc: int


def write_archive(path: str | os.PathLike[str], members: Sequence[tuple[str, Sequence[memoryview]]]) -> None:
    """Write `members` (name, buffers to join) atomically: temporary file in the same folder, fsync, replace.

    Raises
    ------
    WriteError
        Naming `path`, whatever stopped the write. No part of a file stays behind.
    """
    path = Path(path)
    described = []
    for name, buffers in members:
        crc = 0
        for buffer in buffers:
            crc = zlib.crc32(buffer, crc)
        described.append(Member(name, sum(len(b) for b in buffers), crc))
    if sum(m.size for m in described) > _SIZE_LIMIT:
        raise WriteError(str(path), "would be larger than 4 GiB, the limit of the format", "Split the asset")

    heads, _, tail = _framing(described)

    def parts() -> Iterable[bytes | memoryview]:
        for head, (_, buffers) in zip(heads, members, strict=True):
            yield head
            yield from buffers
        yield tail

    replace_file(path, parts())


def read_archive(path: str | os.PathLike[str], check: Collection[str] = ()) -> dict[str, Array]:
    """Map a file written by `write_archive`; return name -> (n,) uint8 read-only view, in the file's order.

    Only headers are read, and the members named in `check`, whose CRC-32 is compared.

    Raises
    ------
    AssetError
        The file cannot be opened, is truncated, or is not laid out as `write_archive` does; one named as a mesh, splats
        or an image is called that, with the way to an asset.
    """
    try:
        return _read_archive(Path(path), check)
    except AssetError as error:
        other = _foreign(Path(path))
        if other is None or not (os.path.isfile(path) and os.access(path, os.R_OK)):
            raise
        raise AssetError(str(path), *other) from error


def _foreign(path: Path) -> tuple[str, str] | None:
    """What a file is that is no `.drgs` file, by its name, and what to do; None where the name does not say it."""
    suffix = path.suffix.lower()
    kinds = {t.kind for t in READ.values() if suffix in t.extensions}
    if "environment" in kinds:
        return "is an image, no .drgs file", "Choose an asset, or use the image as the environment"
    ways = {"mesh": ("a mesh", "make"), "surfels": ("splats", "import")}
    known = [] if suffix == ".json" else [way for kind, way in ways.items() if kind in kinds]
    if not known:
        return None
    commands = " or ".join(f"`drgs {command} {path.name}`" for _, command in known)
    hint = f"Make one of it by {commands}; in Blender by File > Import > DR-GS asset from splats and mesh"
    return f"is no .drgs file but {' or '.join(what for what, _ in known)}", f"{hint}, or {_BY_HAND}"


def _read_archive(path: Path, check: Collection[str]) -> dict[str, Array]:
    data = _map(path)
    members, tail_start = _central_directory(data, str(path))
    _check_names(members, str(path))
    heads, offsets, tail = _framing(members)
    views: dict[str, Array] = {}
    for member, head, offset in zip(members, heads, offsets, strict=True):
        if offset + member.size > tail_start or data[offset - len(head) : offset].tobytes() != head:
            raise AssetError(f"{path}, {member.name}", "has a damaged or unexpected header", _RESTORE)
        views[member.name] = data[offset : offset + member.size]
        if member.name in check and zlib.crc32(views[member.name].data) != member.crc:
            raise AssetError(f"{path}, {member.name}", "has been altered: its CRC-32 is wrong", _RESTORE)
    end = offsets[-1] + members[-1].size if members else 0
    if end != tail_start or data[tail_start:].tobytes() != tail:
        raise AssetError(str(path), "has a damaged directory or bytes that belong to no member", _RESTORE)
    return views


_RESTORE = "Restore the file from a copy, or import the source files again"


def _framing(members: Sequence[Member]) -> tuple[list[bytes], list[int], bytes]:
    """(bytes before each member's data, offset of each member's data, bytes after the last one)."""
    heads: list[bytes] = []
    offsets: list[int] = []
    directory = b""
    position = 0
    for member in members:
        name = member.name.encode()
        padding = -(position + _LOCAL.size + len(name) + 4) % ALIGNMENT
        extra = struct.pack("<HH", _PADDING_ID, padding) + bytes(padding)
        shared = (_FLAGS, _STORED, _TIME, _DATE, member.crc, member.size, member.size, len(name))
        head = _LOCAL.pack(b"PK\3\4", _VERSION, *shared, len(extra)) + name + extra
        record = (b"PK\1\2", 3 << 8 | _VERSION, _VERSION, *shared, 0, 0, 0, 0, _ATTRIBUTES, position)
        directory += _CENTRAL.pack(*record) + name
        heads.append(head)
        offsets.append(position + len(head))
        position = offsets[-1] + member.size
    count = len(members)
    end = _END.pack(b"PK\5\6", 0, 0, count, count, len(directory), position, 0)
    return heads, offsets, directory + end


def _map(path: Path) -> Array:
    """The bytes of `path`, mapped read-only; on Windows, where nobody could replace a mapped file, read."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):  # a pipe or a device may never end
            raise AssetError(str(path), "cannot be read (it is no regular file)", "Choose a file")
        if (size := about.st_size) < _END.size:
            raise AssetError(str(path), f"is {size} bytes long, too short for a .drgs file", _RESTORE)
        if WINDOWS:
            data = np.fromfile(path, np.uint8)
            data.flags.writeable = False
            return data
        return np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
    except FileNotFoundError as error:
        raise AssetError(str(path), "does not exist", "Check the path, or find the missing file in Blender") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise AssetError(str(path), f"cannot be read ({reason})", "Check the path and its permissions") from error


def _central_directory(data: Array, subject: str) -> tuple[list[Member], int]:
    """(members, offset of the directory), with an error of its own for each fault of the file."""
    end = _END.unpack(data[-_END.size :].tobytes())
    signature, disk, first_disk, here, count, length, start, comment = end
    if signature != b"PK\5\6":
        if data[:4].tobytes() == b"PK\3\4":
            raise AssetError(subject, "is truncated: the directory at its end is missing", _RESTORE)
        hint = f"`drgs make` makes one of a mesh, `drgs import` of splats; in Blender {_BY_HAND}"
        raise AssetError(subject, "is not a .drgs file", hint)
    if disk or first_disk or here != count or comment or count > MEMBER_LIMIT:
        raise AssetError(subject, "is a zip, but not laid out as a .drgs file", _RESTORE)
    if start + length != len(data) - _END.size:
        raise AssetError(subject, "is truncated or has been added to: its directory is not where it says", _RESTORE)
    members = []
    position = start
    for _ in range(count):
        record = data[position : position + _CENTRAL.size].tobytes()
        if len(record) < _CENTRAL.size:
            raise AssetError(subject, "has a damaged directory", _RESTORE)
        magic, _, _, flags, method, _, _, crc, packed, size, width, *_, attributes, _ = _CENTRAL.unpack(record)
        raw = data[position + _CENTRAL.size : position + _CENTRAL.size + width].tobytes()
        if magic != b"PK\1\2" or len(raw) < width:
            raise AssetError(subject, "has a damaged directory", _RESTORE)
        try:
            name = raw.decode()
        except UnicodeDecodeError as error:
            raise AssetError(subject, f"has a member name that is not text ({raw!r})", _RESTORE) from error
        problem = _refused(flags, method, packed, size, attributes)
        if problem:
            raise AssetError(f"{subject}, {name}", problem, "Write the asset with DR-GS, not with a zip program")
        members.append(Member(name, size, crc))
        position += _CENTRAL.size + width
    if sum(member.size for member in members) > start:  # also more than headers could be rebuilt for
        raise AssetError(subject, "has members that are larger than the file", _RESTORE)
    return members, start


def _refused(flags: int, method: int, packed: int, size: int, attributes: int) -> str:
    """Why a member of a general zip is not one of a .drgs file; "" when nothing speaks against it."""
    if flags & 1:
        return "is encrypted"
    if method != _STORED or packed != size:
        return "is compressed; members of a .drgs file are stored"
    if attributes >> 28 == 0o12:
        return "is a symbolic link"
    return ""


def _check_names(members: Sequence[Member], subject: str) -> None:
    """Refuse names that would leave a folder, or that are one name for some file systems."""
    seen: set[str] = set()
    for member in members:
        name = member.name
        parts = name.replace("\\", "/").split("/")
        if not name or "\0" in name or ":" in name or "\\" in name or any(p in ("", ".", "..") for p in parts):
            raise AssetError(f"{subject}, {name!r}", "is not a plain relative member name", _RESTORE)
        if name.casefold() in seen:
            raise AssetError(f"{subject}, {name}", "appears twice (or differs from another only in case)", _RESTORE)
        seen.add(name.casefold())


def replace_file(path: Path, parts: Iterable[bytes | memoryview]) -> None:
    """Write `parts` beside `path`, make them durable, and give them its name; a symbolic link is followed.

    Raises
    ------
    WriteError
        Naming `path`, whatever stopped the write. No part of a file stays behind.
    """
    with _writing(path) as target:
        temporary = _temporary(target)
        try:
            with open(temporary, "xb") as file:
                for part in parts:
                    file.write(part)
                file.flush()
                os.fsync(file.fileno())
            replace(temporary, target)
            _sync_folder(target.parent)
        finally:
            with suppress(OSError):  # after success it is gone already
                temporary.unlink()


def replace_by(path: Path, save: Callable[[Path], object]) -> None:
    """As `replace_file`, for libraries that write files themselves: `save` gets a path of the same extension.

    It lies in a folder beside `path` and not in the system's for temporary files, which may be full or small.
    """
    with _writing(path) as target:
        folder = target.with_name(f".{secrets.token_hex(4)}.tmp")  # libraries take no names that are not text
        try:
            folder.mkdir()
            temporary = folder / f"file{path.suffix.lower()}"
            save(temporary)
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            replace(temporary, target)
            _sync_folder(target.parent)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


@contextmanager
def _writing(path: Path) -> Iterator[Path]:
    """What `path` stands for once links are followed; what goes wrong while it is written is a WriteError.

    RuntimeError is what pathlib raises for links in a circle, and what errors of libraries in C++ derive from.
    """
    try:
        yield path.resolve() if path.is_symlink() else path
    except UnicodeError as error:
        raise WriteError(str(path), "is no name that the format's library takes", "Use plain letters") from error
    except (OSError, RuntimeError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or first_reason(str(error))
        raise WriteError(str(path), f"cannot be written ({reason})", "Check free space and permissions") from error


def first_reason(text: str) -> str:
    """The first thing that a library says went wrong; USD's puts it in quotes behind the place in its source."""
    said = re.search(r"Error in .*? : '([^']*)'", text)
    return (said[1] if said else next(iter(text.strip().splitlines()), "no reason given"))[:200]


def _sync_folder(folder: Path) -> None:
    """Make the new name durable where the system can (Windows cannot open folders)."""
    if WINDOWS:
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
