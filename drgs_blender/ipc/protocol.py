"""The ipc protocol of extension and engine: the form of `messages` and the link that carries them (docs/protocol.md).

A message is a fixed prefix, a JSON header of limited size, and arrays: in the pipe behind the header, or in a shared
region. Everything is checked against limits before memory is taken for it; nothing received is ever executed.
Needs numpy and the standard library only: Blender's Python uses this module as it is.
"""

from __future__ import annotations

import contextlib
import json
import math
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..core.arrays import SHARED_FILES, mapped, shared_file
from ..core.version import __version__
from .codec import CodecError, decode, encode
from .messages import (
    MESSAGES,
    Alive,
    Cancel,
    Failed,
    Hello,
    LoadAsset,
    Loaded,
    Need,
    Passes,
    Progress,
    Refine,
    Render,
    Result,
    Shutdown,
    Stopped,
    View,
    Welcome,
)
from .shared_memory import Region

__all__ = [  # the messages are part of it
    "ALIGNMENT",
    "DTYPES",
    "MAGIC",
    "MAX_ARRAYS",
    "MAX_BULK",
    "MAX_DIMENSIONS",
    "MAX_HEADER",
    "MESSAGES",
    "PREFIX",
    "PROTOCOL",
    "Alive",
    "ArrayHeader",
    "Cancel",
    "Failed",
    "Hello",
    "Link",
    "LoadAsset",
    "Loaded",
    "Need",
    "Passes",
    "Progress",
    "ProtocolError",
    "RawIO",
    "Refine",
    "Render",
    "Result",
    "Shutdown",
    "Stopped",
    "View",
    "Welcome",
    "__version__",
    "pack",
    "same_version",
    "sendable",
    "unpack",
]

Array = np.ndarray

#: Raised with every change of the messages. Two sides work together only when it and the version are the same.
PROTOCOL = 18

MAGIC = b"DRGS"
PREFIX = struct.Struct("<4sIQ")  # magic, bytes of the header, bytes of arrays behind it in the pipe

MAX_HEADER = 8 << 20
MAX_ARRAYS = 1 << 14
MAX_DIMENSIONS = 4
MAX_BULK = 16 << 30
ALIGNMENT = 64
DTYPES = {d: np.dtype(d) for d in ("<f4", "<f8", "<i4", "<i8", "|u1")}


class ProtocolError(ValueError):
    """The received data is not a message of this protocol."""


class RawIO(Protocol):
    """The part of an unbuffered binary file that a link uses."""

    def readinto(self, buffer: memoryview, /) -> int | None: ...
    def write(self, data: memoryview | bytes, /) -> int | None: ...


# --- headers ------------------------------------------------------------------------------------------------------


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


def _no_constant(text: str) -> float:
    raise ProtocolError(f"the header holds the number {text}")


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ProtocolError("the header holds a name twice")
    return found


def sendable(array: Array) -> Array:
    """`array` C-contiguous, little-endian and of a dtype that may be sent, copied only where needed."""
    if not (isinstance(array, np.ndarray) and array.flags.c_contiguous):  # a view of it would not be frozen
        array = np.ascontiguousarray(array).reshape(np.shape(array))
    dtype = array.dtype.newbyteorder("<")
    if dtype.str not in DTYPES:
        raise CodecError(f"an array of {array.dtype} cannot be sent, only {', '.join(DTYPES)}")
    return array.astype(dtype, copy=False)


def pack(
    message: Any, arrays: dict[str, Array], where: str, files: dict[str, Array] | None = None
) -> tuple[bytes, int]:
    """Header of `message` with `arrays` (all `sendable`); return (header bytes, bytes of the arrays).

    `files` are further arrays, each in an open file that follows on the socket.
    """
    table = []
    offset = 0
    for name, array in arrays.items():
        table.append([name, array.dtype.str, list(array.shape), offset])
        offset = _aligned(offset + array.nbytes)
    header = {
        "type": type(message).__name__,
        "body": encode(type(message), message, "", {}),
        "where": where if offset else "inline",
        "arrays": table,
        "files": [[name, array.dtype.str, list(array.shape), 0] for name, array in (files or {}).items()],
    }
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode("ascii")
    if len(text) > MAX_HEADER:
        raise CodecError(f"the header has {len(text)} bytes, at most {MAX_HEADER} are allowed")
    return text, offset


@dataclass(slots=True)
class ArrayHeader:
    """One row of a message's array table: name, type, shape, and the position of its bytes in the bulk."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    offset: int
    size: int


def unpack(header: bytes) -> tuple[Any, str, list[ArrayHeader], list[ArrayHeader], int]:
    """Check a header; return (message, "inline" or "shared", its arrays, those in files, bytes of the bulk).

    Raises
    ------
    ProtocolError
        Whatever is wrong with it; no other error is raised.
    """
    try:
        data = json.loads(header, parse_constant=_no_constant, object_pairs_hook=_no_duplicates)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"the header cannot be read ({error})") from error
    if not isinstance(data, dict) or set(data) != {"type", "body", "where", "arrays", "files"}:
        raise ProtocolError("the header does not have the parts of a message")
    kind = data["type"]
    if not isinstance(kind, str) or kind not in MESSAGES:
        raise ProtocolError(f"unknown message {str(kind)[:100]!r}")
    if data["where"] not in ("inline", "shared"):
        raise ProtocolError("the arrays are neither inline nor shared")
    for key, most in (("arrays", MAX_ARRAYS), ("files", SHARED_FILES)):
        if not isinstance(data[key], list) or len(data[key]) > most:
            raise ProtocolError(f"the {key} are not a list of at most {most}")
    try:
        message = decode(MESSAGES[kind], data["body"], "", {})
    except CodecError as error:
        raise ProtocolError(f"{kind}: {error}") from error
    headers: list[ArrayHeader] = []
    offset = 0
    for entry in data["arrays"]:
        item = _array_header(entry, offset)
        headers.append(item)
        offset = _aligned(item.offset + item.size)
        if offset > MAX_BULK:
            raise ProtocolError(f"the arrays have more than {MAX_BULK} bytes")
    files = [_array_header(entry, 0) for entry in data["files"]]
    if len({item.name for item in headers + files}) != len(headers) + len(files):
        raise ProtocolError("two arrays have the same name")
    return message, data["where"], headers, files, offset


def _array_header(entry: Any, offset: int) -> ArrayHeader:
    """Check one row of the array table; arrays lie one behind the other, each on a multiple of `ALIGNMENT`."""
    if not isinstance(entry, list) or len(entry) != 4:
        raise ProtocolError("an array is not described by name, dtype, shape and offset")
    name, dtype, shape, start = entry
    if not isinstance(name, str) or not isinstance(dtype, str) or dtype not in DTYPES:
        raise ProtocolError(f"array {str(name)[:100]!r} has dtype {str(dtype)[:20]!r}, allowed: {', '.join(DTYPES)}")
    if not isinstance(shape, list) or len(shape) > MAX_DIMENSIONS:
        raise ProtocolError(f"array {name[:100]!r} has more than {MAX_DIMENSIONS} dimensions")
    if any(type(n) is not int or not 0 <= n <= MAX_BULK for n in shape):
        raise ProtocolError(f"array {name[:100]!r} has an impossible shape")
    size = math.prod(shape) * DTYPES[dtype].itemsize
    if type(start) is not int or start != offset or size > MAX_BULK:
        raise ProtocolError(f"array {name[:100]!r} does not lie where it must")
    return ArrayHeader(name, DTYPES[dtype], tuple(shape), start, size)


# --- the link -----------------------------------------------------------------------------------------------------


class Link:
    """Both ends of the two pipes, and the shared regions where there are any.

    One thread may receive; any thread may send. A message with arrays may be sent only when the other side has
    answered the previous one that had any: the shared region holds one message at a time.

    Parameters
    ----------
    reader, writer : RawIO
        Unbuffered binary files.
    on_read : callable, optional
        Called whenever bytes arrive.

    Attributes
    ----------
    incoming, outgoing : Region or None
        Shared memory of arrays; None: they travel in the pipe.
    files : socket.socket, optional
        What the client sends the open files of `shareable` arrays by, and the engine receives them; None: they are
        copied as others are.
    """

    def __init__(self, reader: RawIO, writer: RawIO, on_read: Callable[[], None] | None = None) -> None:
        self._reader, self._writer, self._on_read = reader, writer, on_read
        self._sending = threading.Lock()
        self.incoming: Region | None = None
        self.outgoing: Region | None = None
        self.files: socket.socket | None = None
        self.bulk_sent = 0
        self.bulk_received = 0

    def send(self, message: Any, arrays: dict[str, Array] | None = None) -> None:
        """Write one message.

        Raises
        ------
        OSError
            When the other side is gone, or a file cannot be handed over. The link cannot be used any more.
        CodecError
            When the message cannot be expressed.
        """
        ready = {name: sendable(array) for name, array in (arrays or {}).items()}
        shared: dict[str, Array] = {}
        if self.files is not None:
            shared = {name: array for name, array in ready.items() if shared_file(array) is not None}
            ready = {name: array for name, array in ready.items() if name not in shared}
        with self._sending:
            size = sum(_aligned(array.nbytes) for array in ready.values())
            region = self.outgoing.writable(size) if self.outgoing is not None and size else None
            header, _ = pack(message, ready, "inline" if region is None else "shared", shared)
            self.bulk_sent += size
            offset = 0
            if region is not None:
                for array in ready.values():
                    target = np.frombuffer(region, array.dtype, array.size, offset)
                    target[:] = array.reshape(-1)
                    offset = _aligned(offset + array.nbytes)
                size = 0
            self._write(PREFIX.pack(MAGIC, len(header), size) + header)
            for array in shared.values():
                self._send_file(array)
            if size:
                for array in ready.values():
                    self._write(array.reshape(-1).view(np.uint8).data)
                    self._write(bytes(_aligned(array.nbytes) - array.nbytes))

    def receive(self) -> tuple[Any, dict[str, Array]] | None:
        """Wait for one message; return (message, its arrays, each a new array), or None at the end of the pipe.

        Raises
        ------
        ProtocolError
            When what arrives is not a message. The link cannot be used any more.
        """
        prefix = bytearray(PREFIX.size)
        if not self._read(memoryview(prefix), may_end=True):
            return None
        magic, header_size, inline_size = PREFIX.unpack(prefix)
        if magic != MAGIC:
            raise ProtocolError(f"expected the start of a message, found {bytes(prefix[:4])!r}")
        if not 2 <= header_size <= MAX_HEADER:
            raise ProtocolError(f"a header of {header_size} bytes is announced, at most {MAX_HEADER} are allowed")
        header = bytearray(header_size)
        self._read(memoryview(header))
        message, where, headers, files, size = unpack(bytes(header))
        if inline_size != (size if where == "inline" else 0):
            raise ProtocolError(f"{inline_size} bytes of arrays are announced, the header describes {size}")
        self.bulk_received += size
        arrays = {item.name: self._map(item) for item in files}
        if where == "shared":
            return message, arrays | self._copy_shared(headers, size)
        padding = bytearray(ALIGNMENT)
        for item in headers:
            arrays[item.name] = array = self._allocate(item)
            self._read(array.reshape(-1).view(np.uint8).data)
            self._read(memoryview(padding)[: _aligned(item.size) - item.size])
        return message, arrays

    def _send_file(self, array: Array) -> None:
        fd = shared_file(array)
        assert self.files is not None and fd is not None
        try:
            socket.send_fds(self.files, [b"\0"], [fd])
        except OSError:
            # The other side waits for the file: now it knows that none comes, and ends.
            with contextlib.suppress(OSError):
                self.files.shutdown(socket.SHUT_RDWR)
            raise

    def _map(self, item: ArrayHeader) -> Array:
        """The array in the next file that arrives."""
        if self.files is None:
            raise ProtocolError("arrays are announced in files, but there is no socket")
        try:
            word, files, _, _ = socket.recv_fds(self.files, 1, 1)
            if len(word) != 1 or len(files) != 1:
                raise ProtocolError(f"the file of array {item.name[:100]!r} did not arrive")
            return mapped(files[0], item.shape, item.dtype)
        except (ValueError, OSError) as error:
            raise ProtocolError(f"array {item.name[:100]!r}: {error}") from error

    def _copy_shared(self, headers: list[ArrayHeader], size: int) -> dict[str, Array]:
        if self.incoming is None:
            raise ProtocolError("arrays are announced in a shared region, but there is none")
        try:
            region = self.incoming.readable(size)
        except (ValueError, OSError) as error:
            raise ProtocolError(str(error)) from error
        arrays: dict[str, Array] = {}
        for item in headers:
            source = np.frombuffer(region, item.dtype, math.prod(item.shape), item.offset)
            arrays[item.name] = array = self._allocate(item)
            array.reshape(-1)[:] = source
        self.incoming.done(size)
        return arrays

    @staticmethod
    def _allocate(item: ArrayHeader) -> Array:
        try:
            return np.empty(item.shape, item.dtype)
        except (MemoryError, ValueError) as error:
            raise ProtocolError(f"no memory for array {item.name[:100]!r} of {item.size} bytes") from error

    def _write(self, data: memoryview | bytes) -> None:
        view = memoryview(data)
        while len(view):
            view = view[self._writer.write(view) or 0 :]

    def _read(self, view: memoryview, may_end: bool = False) -> bool:
        wanted = len(view)
        while len(view):
            count = self._reader.readinto(view)
            if not count:
                if may_end and len(view) == wanted:
                    return False
                raise ProtocolError("the pipe ended in the middle of a message")
            view = view[count:]
            if self._on_read is not None:
                self._on_read()
        return True


def same_version(greeting: Hello | Welcome) -> bool:
    """Whether the other side speaks the same protocol and is the same version of DR-GS."""
    return greeting.protocol == PROTOCOL and greeting.version == __version__
