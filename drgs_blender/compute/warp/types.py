"""Types of scalar code as Numba sees them, and how Warp spells them.

A type is the name of a scalar ("float32"), a tuple of types, a `Record`, a `Struct` or an `Array`. Numbers are promoted
as Numba promotes them, not as numpy does: small integers become 64-bit ones, a float32 next to an integer a float64.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, get_type_hints

import numpy as np

from ...core.errors import DrgsError

Type = Any

BOOL, INT32, INT64, UINT32, UINT64, FLOAT32, FLOAT64 = (
    "bool", "int32", "int64", "uint32", "uint64", "float32", "float64",
)  # fmt: skip
SCALARS = (BOOL, INT32, INT64, UINT32, UINT64, FLOAT32, FLOAT64)
#: Smaller integers, which only arrays hold.
SMALL = ("int8", "uint8", "int16", "uint16")
_FLOATS, _UNSIGNED = (FLOAT32, FLOAT64), (UINT32, UINT64, "uint8", "uint16")
#: Largest integer that a float32 is sure to hold.
_EXACT = 1 << 24


class TranslationError(DrgsError):
    """Code that has no counterpart; its author's mistake, not the user's."""


@dataclass(frozen=True)
class Array:
    """An array that kernels read and write: type of its elements, number of axes."""

    element: str
    axes: int = 1

    def __str__(self) -> str:
        return f"wp.array(dtype=wp.{self.element}, ndim={self.axes})"


@dataclass(frozen=True)
class Struct:
    """A ``NamedTuple`` of numbers, see `is_struct`; ``int`` fields are int64."""

    kind: type

    def __str__(self) -> str:
        return self.kind.__name__

    @property
    def fields(self) -> dict[str, Type]:
        """Types of the fields."""
        return {name: _field(note) for name, note in get_type_hints(self.kind).items()}


def _field(note: Any) -> Type:
    if hasattr(note, "_fields"):
        return Struct(note)
    return {int: INT64, float: FLOAT64}.get(note) or note.__name__


@functools.cache
def is_struct(kind: type) -> bool:
    """Whether a ``NamedTuple`` is a `Struct` of Warp's, by the types of its fields: numbers, and others of its kind.

    One with arrays, tuples or truth values is a `Record`.
    """

    def is_number(note: Any) -> bool:
        return note in (int, float) or (isinstance(note, type) and issubclass(note, np.number))

    notes = get_type_hints(kind).values()
    return all(is_struct(note) if hasattr(note, "_fields") else is_number(note) for note in notes)


class Record(tuple[Type, ...]):
    """A ``NamedTuple`` that holds anything: a tuple whose parts have names, and that vanishes as tuples do.

    It is the tuple of its fields' types.

    Attributes
    ----------
    kind : type
        The named tuple.
    """

    kind: Any

    def __new__(cls, kind: type, parts: Iterable[Type]) -> Record:
        """Keep the class next to the types."""
        made = super().__new__(cls, parts)
        made.kind = kind
        return made

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Record) and self.kind is other.kind and super().__eq__(other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash((self.kind, tuple(self)))

    def __str__(self) -> str:
        return f"{self.kind.__name__}({', '.join(map(str, self))})"


def like(kind: Type, parts: Iterable[Type]) -> Type:
    """A tuple of types, with the names of `kind` where that has some."""
    return Record(kind.kind, parts) if isinstance(kind, Record) else tuple(parts)


def type_of(value: Any) -> str | None:
    """Scalar type of a constant, or None for anything else."""
    if isinstance(value, (bool, np.bool_)):
        return BOOL
    if isinstance(value, int):
        return INT64 if value < 1 << 63 else UINT64
    if isinstance(value, float):
        return FLOAT64
    return type(value).__name__ if isinstance(value, np.generic) else None


def promoted(a: Type, b: Type, arithmetic: bool = True) -> str:
    """Type that numbers of two types meet in; under `arithmetic` no integer stays smaller than 64 bits.

    Raises
    ------
    TranslationError
        For what are no numbers, and for int64 next to uint64, which Numba makes a float64: nobody means that.
    """
    if not (isinstance(a, str) and isinstance(b, str)):
        raise TranslationError("an operation", f"on {a} and {b}", "Both must be numbers")
    if a == b and (a in _FLOATS or not arithmetic):
        return a
    if a in _FLOATS or b in _FLOATS:
        return FLOAT32 if {a, b} <= {FLOAT32, BOOL, *SMALL} else FLOAT64
    if UINT64 in (a, b) and INT64 in (a, b):
        raise TranslationError("an operation", "on int64 and uint64", "Cast one of them")
    if a in _UNSIGNED and b in _UNSIGNED and (arithmetic or a != b):
        return UINT64
    if arithmetic or a != b:
        return UINT64 if UINT64 in (a, b) else INT64
    return a


def unified(a: Type, b: Type) -> Type:
    """Type of a variable that is assigned values of two types."""
    if a is None or a == b:
        return b
    a, b = (BOOL if isinstance(kind, Known) else kind for kind in (a, b))
    if a == b:
        return a
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        return like(a, (unified(x, y) for x, y in zip(a, b)))
    return promoted(a, b, arithmetic=False)


@dataclass(frozen=True)
class Known:
    """A truth value known beforehand: what it rules out is not translated, and no argument is made of it."""

    value: bool


def spelled(kind: Type) -> str:
    """A type as Warp's source has it."""
    return f"wp.{kind}" if isinstance(kind, str) else str(kind)


def alike(a: str, b: str) -> bool:
    """Whether a variable may be of both types: integers of 64 bits hold smaller ones, and count on as these do."""
    return a == b or {a, b} == {INT32, INT64} or {a, b} == {UINT32, UINT64}


def flat(kind: Type) -> list[Type]:
    """The types of which a tuple consists, or the type itself."""
    return [part for inner in kind for part in flat(inner)] if isinstance(kind, tuple) else [kind]


def given(kind: Type) -> list[Type]:
    """The parts of a type that are arguments or results: all that are not known beforehand."""
    return [part for part in flat(kind) if not isinstance(part, Known)]


@dataclass(frozen=True)
class Value:
    """An expression: its text, its type, and its value where that is known beforehand.

    Of a tuple, `parts` are its values and the text is empty.
    """

    text: str
    type: Type
    constant: Any = None
    parts: tuple[Value, ...] = ()

    def as_type(self, kind: str) -> str:
        """Text of the expression converted to another scalar type."""
        if self.type == kind:
            return self.text
        if not isinstance(self.type, str):
            raise TranslationError("a conversion", f"of {self.type} to {kind}", "Only numbers can be converted")
        if kind == BOOL:
            return f"({self.text} != wp.{self.type}(0))"
        if self.type == BOOL and kind in _FLOATS:
            return f"wp.{kind}(wp.int32({self.text}))"
        return f"wp.{kind}({self.text})"

    def flat(self) -> list[Value]:
        """The values of which a tuple consists, or the value itself."""
        return [v for part in self.parts for v in part.flat()] if isinstance(self.type, tuple) else [self]

    def elements(self) -> tuple[Value, ...]:
        """The values of which a tuple or a struct consists."""
        if isinstance(self.type, Struct):
            return tuple(Value(f"{self.text}.{name}", kind) for name, kind in self.type.fields.items())
        return self.parts

    @property
    def known(self) -> Type:
        """The type, with truth values that are known."""
        if self.parts:
            return like(self.type, (part.known for part in self.parts))
        return Known(self.constant) if isinstance(self.constant, bool) else self.type

    @property
    def small(self) -> bool:
        """An integer constant that a float32 holds exactly."""
        return isinstance(self.constant, int) and abs(self.constant) <= _EXACT


def together(values: list[Value], kind: Type = ()) -> Value:
    """A tuple of values, with the names of `kind` where that has some."""
    return Value("", like(kind, (v.type for v in values)), None, tuple(values))


def shaped(kind: Type, texts: list[str]) -> Value:
    """A value of a type, its parts taken from the front of `texts`; what is known beforehand takes none."""
    if isinstance(kind, tuple):
        return together([shaped(inner, texts) for inner in kind], kind)
    if isinstance(kind, Known):
        return Value(f"wp.bool({kind.value})", BOOL, kind.value)
    return Value(texts.pop(0), kind)
