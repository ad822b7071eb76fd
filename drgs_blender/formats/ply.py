"""The PLY format: any element, any property, in all three encodings, without trusting a single number.

Elements of fixed size are read at once, lists are walked by a small compiled loop. Every count is checked
against the bytes that are there before anything is allocated (G. Turk, "The PLY Polygon File Format", 1994).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..compute.jit import njit
from ..core.errors import AssetError

Array = np.ndarray

#: A header longer than this is not one.
HEADER_LIMIT = 1 << 20

_TYPES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
TYPES = {name: code for code, names in _TYPES.items() for name in names}
_ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_DAMAGED = "Export the file again, or restore it from a copy"


@dataclass(frozen=True, slots=True)
class Property:
    """A property of an element; `count_type` is set where it is a list. Types are numpy codes without byte order."""

    name: str
    type: str
    count_type: str = ""


@dataclass(frozen=True, slots=True)
class Element:
    """An element of the header."""

    name: str
    count: int
    properties: tuple[Property, ...]

    def __contains__(self, name: str) -> bool:
        return any(p.name == name for p in self.properties)


@dataclass(frozen=True, slots=True)
class Header:
    """A parsed header; `order` is "<", ">" or "" for ASCII; `size` is its length in bytes."""

    elements: tuple[Element, ...]
    order: str
    size: int
    comments: tuple[str, ...] = ()

    def element(self, name: str) -> Element | None:
        """The element `name`, or None."""
        return next((e for e in self.elements if e.name == name), None)


@dataclass(slots=True)
class Rows:
    """The data of one element.

    Attributes
    ----------
    element : Element
        Its header.
    columns : dict of str to (count,) array
        Scalar properties, of the declared type; may be views of the mapped file.
    lists : dict of str to tuple of ((total,) array, (count,) int64 array)
        Values and lengths of list properties.
    """

    element: Element
    columns: dict[str, Array] = field(default_factory=dict)
    lists: dict[str, tuple[Array, Array]] = field(default_factory=dict)


def parse_header(head: bytes, subject: str) -> Header:
    """Parse the header at the start of `head`.

    Raises
    ------
    AssetError
        `head` does not start with a complete and sensible PLY header.
    """
    if not head.startswith((b"ply\n", b"ply\r")):
        raise AssetError(subject, "is not a PLY file", "Choose another file")
    newline = b"\r\n" if head.startswith(b"ply\r\n") else head[3:4]
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*" + newline, head[:HEADER_LIMIT])
    if end is None:
        raise AssetError(subject, "has a PLY header without an end", _DAMAGED)
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    comments = []
    for line in head[4 : end.start()].decode("latin-1").replace("\r", "\n").split("\n"):
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "format" and len(words) == 3 and words[1] in _ENCODINGS:
            order = _ENCODINGS[words[1]]
        elif keyword == "element" and len(words) == 3 and re.fullmatch(r"\d{1,15}", words[2]):
            elements.append((words[1], int(words[2]), []))
        elif keyword == "property" and elements:
            elements[-1][2].append(_property(words, subject))
        elif keyword in ("comment", "obj_info"):
            comments.append(line.partition(" ")[2].strip())
        elif keyword:
            raise AssetError(subject, f"has the header line {line[:60]!r}, which PLY does not know", _DAMAGED)
    if order is None:
        raise AssetError(subject, "has a PLY header without a known format line", _DAMAGED)
    for name, _, properties in elements:
        names = [p.name for p in properties]
        if len(set(names)) != len(names):
            raise AssetError(subject, f"has a property twice in the element {name!r}", _DAMAGED)
    parsed = tuple(Element(name, count, tuple(properties)) for name, count, properties in elements)
    return Header(parsed, order, end.end(), tuple(comments))


def read_ply(path: Path) -> tuple[Header, dict[str, Rows]]:
    """Read the file at `path`; return its header and element name -> Rows.

    Raises
    ------
    AssetError
        The header or the data are damaged or truncated.
    """
    subject = str(path)
    data = np.fromfile(path, np.uint8)  # not mapped: a trainer may be writing it, and what it cuts off would be missed
    header = parse_header(data[:HEADER_LIMIT].tobytes(), subject)
    if not header.order:
        return header, _read_ascii(data[header.size :].tobytes(), header, subject)
    rows: dict[str, Rows] = {}
    position = header.size
    for element in header.elements:
        types = {p: np.dtype(header.order + p.type) for p in element.properties}
        rows[element.name], position = _read_element(data, position, element, types, header.order, subject)
    return header, rows


def _property(words: list[str], subject: str) -> Property:
    if len(words) == 3 and words[1] in TYPES:
        return Property(words[2], TYPES[words[1]])
    if len(words) == 5 and words[1] == "list" and words[3] in TYPES and TYPES.get(words[2], "f")[0] != "f":
        return Property(words[4], TYPES[words[3]], TYPES[words[2]])
    raise AssetError(subject, f"has the header line {' '.join(words)[:60]!r}, which PLY does not know", _DAMAGED)


def _read_element(
    data: Array, position: int, element: Element, types: dict[Property, np.dtype[Any]], order: str, subject: str
) -> tuple[Rows, int]:
    """Rows of `element`, whose bytes start at `position`, and where they end."""
    rows = Rows(element)
    count_types = {p: np.dtype((order or "<") + (p.count_type if order else "f8")) for p in types if p.count_type}
    least = sum(count_types[p].itemsize if p.count_type else t.itemsize for p, t in types.items())
    if least * element.count > len(data) - position:
        raise AssetError(
            subject,
            f"is truncated: {element.count} rows of {element.name!r} need at least {least * element.count} bytes, "
            f"{len(data) - position} are left",
            _DAMAGED,
        )
    if not count_types:
        record = np.dtype([(p.name, t) for p, t in types.items()])
        if not record.itemsize:
            return rows, position
        stop = position + record.itemsize * element.count
        table = data[position:stop].view(record)
        rows.columns = {p.name: table[p.name] for p in types}
        return rows, stop
    sizes = np.array([t.itemsize for t in types.values()], np.int64)
    counts = np.array([_count_code(count_types[p]) if p.count_type else 0 for p in types], np.int64)
    starts, lengths, stop = _walk(data, position, element.count, sizes, counts, order == ">")
    if stop < 0:
        raise AssetError(
            subject, f"is damaged: row {-stop - 1} of {element.name!r} has a list that does not fit", _DAMAGED
        )
    for i, (p, dtype) in enumerate(types.items()):
        values = _gather(data, starts[i], lengths[i], dtype)
        if p.count_type:
            rows.lists[p.name] = values, lengths[i]
        else:
            rows.columns[p.name] = values
    return rows, int(stop)


def _count_code(dtype: np.dtype[Any]) -> int:
    """A list's count type for `_walk`: 1 + 2 * size in bytes + 1 where signed; 16 is double (ASCII)."""
    return 16 if dtype.kind == "f" and dtype.itemsize == 8 else 2 * dtype.itemsize + (dtype.kind == "i")


@njit
def _walk(data: Array, position: int, rows: int, sizes: Array, counts: Array, big: bool) -> tuple[Array, Array, int]:
    """Find every value of an element with lists.

    Returns (starts, lengths), both (properties, rows), and the position after the last row, or -(row + 1) for the row
    whose list has a negative or impossible length.
    """
    n = len(sizes)
    starts = np.zeros((n, rows), np.int64)
    lengths = np.ones((n, rows), np.int64)
    for row in range(rows):
        for i in range(n):
            length = 1
            if counts[i]:
                width = counts[i] // 2
                if position + width > len(data):
                    return starts, lengths, -(row + 1)
                length = 0
                if counts[i] == 16:
                    value = data[position : position + 8].copy().view(np.float64)[0]
                    length = int(value) if 0.0 <= value < 1e15 else -1
                else:
                    for k in range(width):
                        byte = data[position + k] if big else data[position + width - 1 - k]
                        length = length * 256 + byte
                    if counts[i] % 2 and length >= 1 << (8 * width - 1):
                        length = -1
                position += width
            if length < 0 or length > (len(data) - position) // sizes[i]:
                return starts, lengths, -(row + 1)
            starts[i, row] = position
            lengths[i, row] = length
            position += length * sizes[i]
    return starts, lengths, position


def _gather(data: Array, starts: Array, lengths: Array, dtype: np.dtype[Any]) -> Array:
    """Values of `dtype` that lie in runs of `lengths` at the byte offsets `starts`, joined."""
    joined = np.empty(int(lengths.sum()) * dtype.itemsize, np.uint8)
    _join(data, starts, lengths * dtype.itemsize, joined)
    return joined.view(dtype)


@njit
def _join(data: Array, starts: Array, sizes: Array, joined: Array) -> None:
    """Copy the byte runs of `data` one after the other into `joined`."""
    position = 0
    for i in range(len(starts)):
        for k in range(sizes[i]):
            joined[position] = data[starts[i] + k]
            position += 1


def _read_ascii(text: bytes, header: Header, subject: str) -> dict[str, Rows]:
    """Read an ASCII body: all its numbers become doubles, which are then read like a binary body."""
    words = text.split()
    try:
        numbers = np.array(words, dtype="S").astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise AssetError(subject, f"has text where numbers are expected ({error})", _DAMAGED) from error
    data = numbers.astype("<f8").view(np.uint8)
    data.flags.writeable = False  # as a mapped file: the compiled loops need one version only
    rows: dict[str, Rows] = {}
    position = 0
    double = np.dtype("<f8")
    for element in header.elements:
        types = dict.fromkeys(element.properties, double)
        found, position = _read_element(data, position, element, types, "", subject)
        for p in element.properties:
            where = f"{subject}, {element.name}.{p.name}"
            if p.count_type:
                values, lengths = found.lists[p.name]
                found.lists[p.name] = _narrow(values, p.type, where), lengths
            else:
                found.columns[p.name] = _narrow(found.columns[p.name], p.type, where)
        rows[element.name] = found
    return rows


def _narrow(values: Array, code: str, where: str) -> Array:
    """Doubles as the declared type; AssetError where an integer does not fit it."""
    dtype = np.dtype(code)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    if values.size and not (values.min() >= limits.min and values.max() <= limits.max):  # NaN fails both
        raise AssetError(where, f"has values that do not fit {TYPES_OF[code]}", _DAMAGED)
    return values.astype(dtype)


#: numpy code -> PLY's name.
TYPES_OF = {code: names[0] for code, names in _TYPES.items()}
