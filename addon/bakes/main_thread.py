"""Calls on Blender's main thread from others: datablocks are written there alone."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import bpy

from ...drgs_blender.core.errors import Cancelled

T = TypeVar("T")

#: Seconds between two looks for calls.
_INTERVAL, _POLL = 0.1, 0.05

_calls: queue.SimpleQueue[_Call] = queue.SimpleQueue()


class _Call:
    """A call that is made elsewhere."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self.function = function
        self.result: Any = None
        self.error: BaseException | None = None
        self.done = threading.Event()

    def make(self) -> None:
        """Make it, unless it was made or given up."""
        if self.done.is_set():
            return
        try:
            self.result = self.function()
        except BaseException as error:  # raised where it was asked for
            self.error = error
        self.done.set()


def call(function: Callable[[], T], cancelled: Callable[[], bool]) -> T:
    """The result of `function`, called on the main thread.

    Raises
    ------
    Cancelled
        `cancelled` said so before it was called.
    """
    if threading.current_thread() is threading.main_thread() or bpy.app.background:
        return function()
    made = _Call(function)
    _calls.put(made)
    while not made.done.wait(_POLL):
        if cancelled():
            made.done.set()
            raise Cancelled
    if made.error is not None:
        raise made.error
    result: T = made.result
    return result


def _serve() -> float:
    while not _calls.empty():
        _calls.get().make()
    return _INTERVAL


def register() -> None:
    if not bpy.app.background:  # without a window nothing else runs while something is rendered
        bpy.app.timers.register(_serve, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_serve):
        bpy.app.timers.unregister(_serve)
