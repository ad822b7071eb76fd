"""Messages for the user, shown by the panel: warnings and errors of exports, renders and the engine.

Plain data, so that it may be written from the render thread and drawn from the interface.
"""

from __future__ import annotations

import contextlib
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Collection, Container, Hashable
from typing import NamedTuple

from ..drgs_blender.core.errors import without_numbers

log = logging.getLogger("drgs")

MAX_MESSAGES = 50


class Message(NamedTuple):
    """One line of the log panel."""

    time: float
    level: str  # 'INFO', 'WARNING' or 'ERROR', as in Operator.report
    text: str


#: Newest last.
history: deque[Message] = deque(maxlen=MAX_MESSAGES)


def note(level: str, text: str, logged: bool = True) -> None:
    """Remember a message; a repetition of the latest one, as every redraw has it, only renews its time.

    So does one of an earlier warning, as a loop of renders has it. Not `logged` is one that Blender prints as well, by
    a report.
    """
    if history and history[-1][1:] == (level, text):
        history.pop()
    elif logged:
        log.log(getattr(logging, level), text)
    for message in [m for m in list(history) if m[1:] == (level, text) and level == "WARNING"]:
        with contextlib.suppress(ValueError):  # another thread was quicker
            history.remove(message)
    history.append(Message(time.time(), level, text))


def withdraw(level: str, text: str) -> None:
    """Take back a message that holds no longer."""
    for message in [m for m in list(history) if m[1:] == (level, text)]:
        with contextlib.suppress(ValueError):  # another thread was quicker
            history.remove(message)
    warned.discard(text)
    _owners.pop(text, None)


def own(owner: Hashable, texts: Collection[str], noted: bool = False) -> None:
    """The warnings that `owner` (a viewport, an export, the render) has now: those that nobody has left are withdrawn.

    Those that are `noted` are messages already.
    """
    for text, owners in list(_owners.items()):
        if owner in owners and text not in texts:
            owners.discard(owner)
            if not owners:
                withdraw("WARNING", text)
    for text in texts:
        owners = _owners.setdefault(text, set())
        if not (noted or owners):
            note("WARNING", text)
        owners.add(owner)


def clear() -> None:
    """Forget all messages; what holds still is said again by the next picture that has it."""
    history.clear()
    _owners.clear()


def named_in(text: str, known: Container[str]) -> str:
    """The first name that is `known`, in quotation marks or, as the engine writes it, before a colon; else ""."""
    return next((name for name in (*re.findall(r'"([^"]+)"', text), text.partition(": ")[0]) if name in known), "")


#: Who has a warning now, see `own`.
_owners: dict[str, set[Hashable]] = {}
_RENDER = "render"
#: What the render under way has warned of, in this frame or in those before.
warned: set[str] = set()


def begin_render() -> None:
    """A picture or an animation begins: each warning is given once, not with every frame."""
    for text in warned:  # also of a render that has no picture
        _owners.setdefault(text, set()).add(_RENDER)
    warned.clear()


def end_picture() -> None:
    """A picture is there: take back what was warned of the render before it and holds no longer."""
    own(_RENDER, warned.copy(), noted=True)


class Warnings:
    """Collects the warnings of one export; every text once, and none that is `known`, to which they are added.

    Of an animation, what is said again of another number of things is known.

    Parameters
    ----------
    report : prints a warning, in place of the log
    """

    def __init__(self, known: set[str] | None = None, report: Callable[[str], None] | None = None) -> None:
        self.texts: list[str] = []
        self._report = report
        self._known = set() if known is None else known
        self._earlier = set(map(without_numbers, self._known))

    def __call__(self, text: str) -> None:
        if text not in self._known and without_numbers(text) not in self._earlier:
            self._known.add(text)
            self.texts.append(text)
            note("WARNING", text, logged=self._report is None)
            if self._report is not None:
                self._report(text)
