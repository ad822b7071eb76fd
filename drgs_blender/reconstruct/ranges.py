"""Ranges of settings: fields of dataclasses are annotated with them; one check reads them all."""

from __future__ import annotations

import math
import sys
import types
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from ..core.errors import UsageError

#: Characters of a value in a message, at most.
_LONGEST = 100


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers that a setting may have.

    Attributes
    ----------
    low, high : float
        Both belong to it, infinity does not.
    kind : {"", "even", "power of two"}
        Which of the whole numbers.

    Examples
    --------
    >>> 12 in Range(8, 1024), 12 in Range(8, 1024, "power of two"), float("inf") in Range(0.0)
    (True, False, False)
    >>> print(Range(0, 8, "even"), Range(0.0), sep="; ")
    from 0 to 8, even; of at least 0
    """

    low: float
    high: float = math.inf
    kind: Literal["", "even", "power of two"] = ""

    def __contains__(self, value: float) -> bool:
        """Whether the setting may be `value`."""
        if not (_is_finite(value) and self.low <= value <= self.high):
            return False
        whole = int(value)
        return {"": True, "even": whole % 2 == 0, "power of two": whole & (whole - 1) == 0}[self.kind]

    def __str__(self) -> str:
        """As in "from 8 to 1024, a power of two"."""
        kind = {"": "", "even": ", even", "power of two": ", a power of two"}[self.kind]
        limits = f"of at least {self.low:g}" if self.high == math.inf else f"from {self.low:g} to {self.high:.10g}"
        return limits + kind


def _is_finite(value: float) -> bool:
    """Whether a number is one of floating point; whole ones may be larger, and are no `float` then."""
    return abs(value) <= sys.float_info.max


def _shown(value: Any) -> str:
    """A value for a message, shortened."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # Python writes no number of more than 4300 digits
        return "too long to be shown"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


#: A part of the steps, a share, a weight.
Part = Annotated[float, Range(0.0, 1.0)]
Weight = Annotated[float, Range(0.0)]


@dataclass(frozen=True, slots=True)
class Allowed:
    """What a setting may be.

    Attributes
    ----------
    type : type
        bool, int, float or str; of a list that of its items.
    choices : tuple of str
        The only texts; () where any is allowed.
    range : Range, optional
        Of numbers.
    optional : bool
        None is allowed.
    items : int, optional
        A list of so many, -1 of any number; None: a single value.
    """

    type: type
    choices: tuple[str, ...] = ()
    range: Range | None = None
    optional: bool = False
    items: int | None = None

    def problem(self, value: Any) -> str:
        """What is wrong with `value`, as "is 3, not a whole number from 8 to 1024"; "" where nothing is."""
        if value is None and self.optional:
            return ""
        if self.items is not None:
            if not isinstance(value, list | tuple) or self.items not in (-1, len(value)):
                return f"is {_shown(value)}, not {self}"
            return next((text for item in value if (text := self._problem_of_one(item))), "")
        return self._problem_of_one(value)

    def _problem_of_one(self, value: Any) -> str:
        whole = isinstance(value, int) and not isinstance(value, bool)
        right = whole or isinstance(value, float) if self.type is float else type(value) is self.type
        right = right and (self.type is not float or _is_finite(value))
        right = right and (not self.choices or value in self.choices) and (self.range is None or value in self.range)
        return "" if right else f"is {_shown(value)}, not {self._of_one}"

    @property
    def _of_one(self) -> str:
        names = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
        quoted = [f'"{choice}"' for choice in (*self.choices, *(("none",) if self.optional and self.choices else ()))]
        text = " or ".join(filter(None, (", ".join(quoted[:-1]), *quoted[-1:]))) or names[self.type]
        text += f" {self.range}" if self.range is not None else ""
        return f'{text}, or "none"' if self.optional and not self.choices else text

    def __str__(self) -> str:
        """As in "a whole number from 8 to 1024", for messages and tables."""
        if self.items is None:
            return self._of_one
        return f"a list, each {self._of_one}" if self.items < 0 else f"a list of {self.items}, each {self._of_one}"


def allowed(settings: type) -> dict[str, Allowed]:
    """Field -> what it may be, from the annotations of a dataclass; nested dataclasses are left out."""
    hints = get_type_hints(settings, include_extras=True)
    return {field.name: found for field in fields(settings) if (found := _allowed(hints[field.name])) is not None}


def _allowed(hint: Any) -> Allowed | None:
    limits = None
    if get_origin(hint) is Annotated:
        hint, limits = get_args(hint)
    origin, inner = get_origin(hint), get_args(hint)
    if origin is tuple:
        one = _allowed(inner[0])
        assert one is not None, "lists of settings do not occur"
        return Allowed(one.type, one.choices, one.range, items=-1 if inner[-1] is Ellipsis else len(inner))
    if origin in (types.UnionType, Union):
        one = _allowed(next(part for part in inner if part is not type(None)))
        return one and Allowed(one.type, one.choices, one.range or limits, optional=True)
    if origin is Literal:
        return Allowed(str, inner)
    return Allowed(hint, range=limits) if hint in (bool, int, float, str) else None


def problems(settings: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """(name, what is wrong) of each field of a dataclass that is not what its annotation allows."""
    for name, rule in allowed(type(settings)).items():
        if text := rule.problem(getattr(settings, name)):
            yield f"{prefix}{name}", text


def check(settings: Any, prefix: str = "") -> None:
    """Raise UsageError about the first field of a dataclass that is not what its annotation allows."""
    for name, text in problems(settings, prefix):
        raise UsageError(name, text, "Choose such a value")
