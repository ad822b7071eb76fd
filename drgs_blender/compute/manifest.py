"""The kernels that each kind of job needs, so that they can be compiled before they are called.

`kernels.json` beside this file is written by ``tools/kernels.py`` from what jobs really call. A kernel that it does
not name is compiled when it is first called; one that it names and that is gone is passed over.
"""

from __future__ import annotations

import functools
import importlib
import json
import logging
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .numba_variables import check_numba_variables

check_numba_variables()

from numba import types  # noqa: E402
from numba.core.errors import NumbaError  # noqa: E402

log = logging.getLogger(__name__)
PATH = Path(__file__).with_name("kernels.json")


@dataclass(frozen=True)
class Kernel:
    """A compiled form of a function.

    Attributes
    ----------
    module, name : str
        Where the function is.
    arguments : str
        Its argument types, as `kernel_cache.describe` writes them.
    seconds : float
        Time of compiling it, measured once; only the order among kernels counts.
    """

    module: str
    name: str
    arguments: str
    seconds: float


@functools.cache
def jobs() -> dict[str, tuple[Kernel, ...]]:
    """Job -> its kernels; none where the list is damaged, so that each kernel is compiled when it is first called."""
    try:
        data = json.loads(PATH.read_text(encoding="utf-8"))
        kernels = [Kernel(str(a), str(b), str(c), float(seconds)) for a, b, c, seconds in data["kernels"]]
        return {str(job): tuple(kernels[i] for i in rows) for job, rows in data["jobs"].items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        log.warning("%s is damaged (%s): kernels are compiled when they are called. Install DR-GS again", PATH, error)
        return {}


def needed(names: Iterable[str]) -> list[Kernel]:
    """The kernels of some jobs, each once: those of the first job, of the second and so on, in each the longest first.

    Unknown jobs have none.
    """
    table = jobs()
    by_time = lambda kernel: (-kernel.seconds, kernel.name)  # noqa: E731
    return list(dict.fromkeys(kernel for name in names for kernel in sorted(table.get(name, ()), key=by_time)))


def dispatcher(kernel: Kernel) -> Any:
    """The compiled function of a kernel.

    Raises
    ------
    LookupError
        When there is no such function any more.
    """
    return _lookup(kernel.module, kernel.name)


def signature(kernel: Kernel) -> tuple[Any, ...]:
    """Argument types of a kernel.

    Raises
    ------
    LookupError
        When there is no such type any more.
    """
    try:
        return _Reader(kernel.arguments).all()
    except (ValueError, TypeError, AttributeError, NumbaError) as error:
        raise LookupError(f"{kernel.arguments}: {error}") from error


def _lookup(module: str, name: str) -> Any:
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise LookupError(f"{module}:{name}: {error}") from error
    return found


class _Reader:
    """Reads what `kernel_cache.describe` wrote."""

    def __init__(self, text: str) -> None:
        self.tokens = re.findall(r"[A-Za-z_][\w.]*(?::[\w.]+)?(?:\[\w+\])?|-?[\d.]+|[(),]", text)
        self.at = 0
        if "".join(self.tokens) != text.replace(" ", ""):
            raise LookupError(f"cannot be read: {text}")

    def all(self) -> tuple[Any, ...]:
        found = []
        while self.at < len(self.tokens):
            found.append(self.one())
            if self.at < len(self.tokens):
                self.expect(",")
        return tuple(found)

    def expect(self, token: str = "") -> str:
        if self.at == len(self.tokens) or (token and self.tokens[self.at] != token):
            raise LookupError(f"{token or 'more'} expected in {''.join(self.tokens)}")
        self.at += 1
        return self.tokens[self.at - 1]

    def group(self) -> list[Any]:
        self.expect("(")
        found = []
        while self.tokens[self.at] != ")":
            found.append(self.one())
            if self.tokens[self.at] == ",":
                self.expect()
        self.expect(")")
        return found

    def one(self) -> Any:
        if self.tokens[self.at] == "(":
            return types.BaseTuple.from_types(tuple(self.group()))
        word = self.expect()
        if word == "array":
            self.expect("(")
            dtype, _, dimensions, _, layout, _, mutable, _, aligned, _ = (self.expect() for _ in range(10))
            return types.Array(_scalar(dtype), int(dimensions), layout, mutable == "False", aligned=aligned == "True")
        if ":" in word:
            module, _, name = word.partition(":")
            found = _lookup(module, name)
            if self.at < len(self.tokens) and self.tokens[self.at] == "(":
                parts = tuple(self.group())
                if len(parts) != len(found._fields):
                    raise LookupError(f"{word} has {len(found._fields)} fields by now, not {len(parts)}")
                return types.BaseTuple.from_types(parts, found)
            return types.Dispatcher(found)
        return _scalar(word)


def _scalar(name: str) -> Any:
    found = {"bool": types.boolean, "none": types.none}.get(name) or getattr(types, name, None)
    if not isinstance(found, types.Type):
        raise LookupError(f"type {name}")
    return found
