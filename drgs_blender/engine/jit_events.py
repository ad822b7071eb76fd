"""Events of JIT compilation by Numba or Warp: the one long wait of a first picture, which the user is shown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..compute import jit  # noqa: F401  (sets Numba up before it is imported)
from ..compute.warp import runtime

from numba.core import event  # isort: skip


class _Listener(event.Listener):
    def __init__(self, change: Callable[[int], None]) -> None:
        self._change = change

    def on_start(self, event: Any) -> None:
        self._change(1)

    def on_end(self, event: Any) -> None:
        self._change(-1)


def watch(change: Callable[[int], None]) -> None:
    """Call `change` with 1 when a compilation begins and with -1 when it ends; they nest.

    Loading from the cache is no compilation.
    """
    event.register("numba:compile", _Listener(change))
    runtime.watchers.append(change)
