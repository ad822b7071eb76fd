"""Change detection: unchanged parts of a frame keep the identity of those in the last one."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any, TypeVar

import numpy as np

from ..core.arrays import keep, same_bits

T = TypeVar("T")


def reuse_equal(value: T, known: Any) -> T:
    """`known` itself when it equals `value`, else a read-only copy of `value`.

    Arrays are compared bit by bit. Where a part of `value` (a field, an item) equals that of `known`, the copy holds
    the latter, so that later stages recognise changes by identity.
    """
    made: Any
    if isinstance(value, np.ndarray):
        made = known if isinstance(known, np.ndarray) and same_bits(value, known) else keep(value)
        return made
    kind: Any = type(value)
    names = _field_names(kind)
    if names is not None:
        before = known if type(known) is type(value) else None
        made = {name: reuse_equal(getattr(value, name), getattr(before, name, None)) for name in names}
        if before is not None and all(made[name] is getattr(before, name) for name in names):
            return before
        return type(value)(**made)
    if isinstance(value, (list, tuple)):
        old = known if type(known) is type(value) else ()
        made = [reuse_equal(item, old[i] if i < len(old) else None) for i, item in enumerate(value)]
        if len(old) == len(made) and type(known) is type(value) and all(a is b for a, b in zip(made, old)):
            return known
        return type(value)(made)
    return known if type(known) is type(value) and known == value else value


@cache
def _field_names(kind: type) -> tuple[str, ...] | None:
    """Names of the fields of a dataclass, looked up once, since viewports ask for every picture; None for others."""
    return tuple(f.name for f in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else None
