"""Dataclasses to JSON and back, driven by their own type hints, and strict both ways.

Only what a type hint allows passes: no evaluation, no class names in the data, no unknown or missing field, no NaN
outside arrays. Arrays are not put in the JSON; they are collected by *slot*, a stable name made of the path to the
field (``objects/Robe/vertices``), so that the two sides can agree on which of them changed.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import types
import typing
from functools import cache
from typing import Any, Literal, Union

import numpy as np

from ..core.frame import Frame

Array = np.ndarray

#: Longest text, list or mapping in a header.
MAX_TEXT = 1 << 20
MAX_ITEMS = 1 << 16


class CodecError(ValueError):
    """A value that its type hint does not allow."""


@cache
def _fields(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls)}


def _alternative(hint: Any) -> Any:
    """The one type beside None of ``T | None``, or None when `hint` is not of that form."""
    if typing.get_origin(hint) in (Union, types.UnionType):
        others = [a for a in typing.get_args(hint) if a is not type(None)]
        if len(others) == 1 and len(typing.get_args(hint)) == 2:
            return others[0]
    return None


def _item_hints(hint: Any, length: int, path: str) -> list[Any]:
    """Type hint of each item of a list or tuple of `length` items."""
    arguments = typing.get_args(hint)
    if length > MAX_ITEMS:
        raise CodecError(f"{path} has {length} items, at most {MAX_ITEMS} are allowed")
    if typing.get_origin(hint) is list or (len(arguments) == 2 and arguments[1] is Ellipsis):
        return [arguments[0]] * length
    if len(arguments) != length:
        raise CodecError(f"{path} has {length} items, expected {len(arguments)}")
    return list(arguments)


def _text(value: Any, path: str) -> str:
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise CodecError(f"{path} is not a text of at most {MAX_TEXT} characters")
    return value


def _integer(value: Any, path: str) -> int:
    if not -(2**63) <= value < 2**63:
        raise CodecError(f"{path} does not fit 64 bits")
    return value


def _number(value: Any, path: str) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise CodecError(f"{path} is not a finite number")
    return number


def _item_names(items: Any) -> list[str]:
    """A distinct, stable name for each item: its own ``name`` where it has one, else its place."""
    names: list[str] = []
    taken: set[str] = set()
    for index, item in enumerate(items):
        own = getattr(item, "name", None)
        name = own if isinstance(own, str) else str(index)
        while name in taken:
            name += f"#{index}"
        taken.add(name)
        names.append(name)
    return names


def encode(hint: Any, value: Any, path: str, arrays: dict[str, Array]) -> Any:
    """Turn `value`, of type `hint`, into JSON-able data; arrays go into `arrays` under their slot.

    Raises
    ------
    CodecError
        Naming the path of the value that does not fit.
    """
    if hint is np.ndarray:
        if not isinstance(value, np.ndarray):
            raise CodecError(f"{path} is not an array")
        if path in arrays:
            raise CodecError(f"{path} occurs twice")
        arrays[path] = value
        return {"slot": path}
    if (other := _alternative(hint)) is not None:
        return None if value is None else encode(other, value, path, arrays)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, typing.cast(type, hint)):
            raise CodecError(f"{path or hint} is {type(value).__name__}, expected {hint}")
        prefix = path + "/" if path else ""
        fields = _fields(typing.cast(type, hint))
        return {name: encode(kind, getattr(value, name), prefix + name, arrays) for name, kind in fields.items()}
    origin = typing.get_origin(hint)
    if origin is Literal:
        if value not in typing.get_args(hint):
            raise CodecError(f"{path} is {value!r}, expected one of {', '.join(map(str, typing.get_args(hint)))}")
        return value
    if origin in (list, tuple):
        if not isinstance(value, (list, tuple)):
            raise CodecError(f"{path} is {type(value).__name__}, expected a list")
        hints = _item_hints(hint, len(value), path)
        names = _item_names(value)
        return [encode(k, item, f"{path}/{name}", arrays) for k, item, name in zip(hints, value, names)]
    if origin is dict:
        kind = typing.get_args(hint)[1]
        return {_text(key, path): encode(kind, item, f"{path}/{key}", arrays) for key, item in value.items()}
    try:
        if hint is bool:
            if not isinstance(value, (bool, np.bool_)):
                raise CodecError(f"{path} is not true or false")
            return bool(value)
        if hint is int:
            return _integer(operator.index(value), path)
        if hint is float:
            return _number(value, path)
    except (TypeError, ValueError) as error:
        raise CodecError(str(error) if isinstance(error, CodecError) else f"{path} is not a number") from error
    if hint is str:
        return _text(value, path)
    if hint is Any:
        return value
    raise CodecError(f"{path} has a type that cannot be sent: {hint}")


def decode(hint: Any, data: Any, path: str, arrays: dict[str, Array]) -> Any:
    """The inverse of `encode`: check `data` against `hint` and build the value; arrays are looked up by slot.

    Raises
    ------
    CodecError
        Naming the path of the value that does not fit. Nothing else is raised, whatever `data` is.
    """
    if hint is np.ndarray:
        if not isinstance(data, dict) or set(data) != {"slot"} or not isinstance(data["slot"], str):
            raise CodecError(f"{path} is not a reference to an array")
        if data["slot"] not in arrays:
            raise CodecError(f"{path} refers to an array that was not sent: {data['slot'][:200]!r}")
        return arrays[data["slot"]]
    if (other := _alternative(hint)) is not None:
        return None if data is None else decode(other, data, path, arrays)
    if dataclasses.is_dataclass(hint):
        fields = _fields(typing.cast(type, hint))
        if not isinstance(data, dict) or set(data) != set(fields):
            raise CodecError(f"{path or hint} does not have the fields {', '.join(fields)}")
        prefix = path + "/" if path else ""
        values = {name: decode(kind, data[name], prefix + name, arrays) for name, kind in fields.items()}
        return typing.cast(type, hint)(**values)
    origin = typing.get_origin(hint)
    if origin is Literal:
        if not isinstance(data, str) or data not in typing.get_args(hint):
            raise CodecError(f"{path} is not one of {', '.join(map(str, typing.get_args(hint)))}")
        return data
    if origin in (list, tuple):
        if not isinstance(data, list):
            raise CodecError(f"{path} is not a list")
        hints = _item_hints(hint, len(data), path)
        return origin(decode(k, item, f"{path}/{i}", arrays) for i, (k, item) in enumerate(zip(hints, data)))
    if origin is dict:
        if not isinstance(data, dict) or len(data) > MAX_ITEMS:
            raise CodecError(f"{path} is not a mapping of at most {MAX_ITEMS} items")
        kind = typing.get_args(hint)[1]
        return {_text(key, path): decode(kind, item, f"{path}/{key}", arrays) for key, item in data.items()}
    if hint is bool and isinstance(data, bool):
        return data
    if hint is int and isinstance(data, int) and not isinstance(data, bool):
        return _integer(data, path)
    if hint is float and isinstance(data, (int, float)) and not isinstance(data, bool):
        return _number(data, path)
    if hint is str:
        return _text(data, path)
    if hint is Any:
        return data
    raise CodecError(f"{path} is not of type {getattr(hint, '__name__', hint)}")


def completed(hint: Any, data: Any) -> Any:
    """Encoded `data` of type `hint`, with the defaults of fields that it lacks."""
    if (other := _alternative(hint)) is not None:
        return None if data is None else completed(other, data)
    if dataclasses.is_dataclass(hint) and isinstance(data, dict):
        hints = _fields(typing.cast(type, hint))
        given = {name: completed(hints[name], item) if name in hints else item for name, item in data.items()}
        for field in dataclasses.fields(hint):
            if field.name not in data and field.default is not dataclasses.MISSING:
                given[field.name] = encode(hints[field.name], field.default, field.name, {})
            elif field.name not in data and field.default_factory is not dataclasses.MISSING:
                given[field.name] = encode(hints[field.name], field.default_factory(), field.name, {})
        return given
    if typing.get_origin(hint) in (list, tuple) and isinstance(data, list):
        return [completed(kind, item) for kind, item in zip(_item_hints(hint, len(data), ""), data)]
    if typing.get_origin(hint) is dict and isinstance(data, dict):
        return {key: completed(typing.get_args(hint)[1], item) for key, item in data.items()}
    return data


def encode_frame(frame: Frame) -> tuple[dict[str, Any], dict[str, Array]]:
    """`frame` as JSON-able data and its arrays by slot."""
    arrays: dict[str, Array] = {}
    return encode(Frame, frame, "", arrays), arrays


def decode_frame(data: Any, arrays: dict[str, Array]) -> Frame:
    """The frame that `encode_frame` was given."""
    return decode(Frame, data, "", arrays)
