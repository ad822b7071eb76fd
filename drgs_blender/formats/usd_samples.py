"""Time samples of USD's attributes, as few as say what moves and what stands still."""

from __future__ import annotations

from typing import Any


class Samples:
    """Values of an attribute over time: no samples while nothing changes; what stood still does so until it moves."""

    def __init__(self, attribute: Any) -> None:
        self._attribute = attribute
        self._value: Any = None
        self._first = self._last = self._written = 0
        self._moves = False

    def add(self, number: int, value: Any) -> bool:
        """The value in the frame of this number, which comes after all others; whether it is another."""
        changed = self._value is not None and self._value != value
        if self._value is None:
            self._first = number
        elif changed:
            if not self._moves:
                self._set(self._first)
                self._moves = True
            if self._written != self._last:
                self._set(self._last)
            self._value = value
            self._set(number)
        self._value, self._last = value, number
        return changed

    def finish(self) -> None:
        """Write what never changed."""
        if not self._moves and self._value is not None:
            self._attribute.Set(self._value)

    def _set(self, number: int) -> None:
        self._attribute.Set(self._value, number)
        self._written = number
