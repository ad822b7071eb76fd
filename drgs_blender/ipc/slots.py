"""Slots: only arrays that changed are sent again; what the sender remembers of each, and what the receiver holds.

A slot is the stable name of one array of a frame. The sender gives each new content a version; a frame names a version
for every slot it uses and carries only the arrays whose version is new. Slots that a frame does not name are dropped
on both sides, so a vanished object costs nothing.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import keep, same_bits

Array = np.ndarray


class SentSlots:
    """The sender's memory: a copy and a version of what each slot last carried."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[int, Array]] = {}
        self._next = 1

    def changes(self, arrays: dict[str, Array]) -> tuple[dict[str, int], dict[str, Array]]:
        """Return (version of every slot, the arrays to send), and remember them as sent."""
        held: dict[str, tuple[int, Array]] = {}
        changed: dict[str, Array] = {}
        for slot, array in arrays.items():
            known = self._held.get(slot)
            if known is not None and same_bits(known[1], array):
                held[slot] = known
                continue
            held[slot] = self._next, keep(array)
            self._next += 1
            changed[slot] = held[slot][1]
        self._held = held
        return {slot: version for slot, (version, _) in held.items()}, changed

    def forget(self) -> None:
        """The receiver holds nothing any more: everything is sent again next time."""
        self._held = {}


class HeldSlots:
    """The receiver's memory: the last version of each slot."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[int, Array]] = {}

    def update(self, versions: dict[str, int], sent: dict[str, Array]) -> tuple[dict[str, Array], list[str]]:
        """Take in what was sent; return (array of every slot, slots whose version is not held)."""
        held: dict[str, tuple[int, Array]] = {}
        for slot, version in versions.items():
            if slot in sent:
                sent[slot].flags.writeable = False
                held[slot] = version, sent[slot]
            elif (known := self._held.get(slot)) is not None and known[0] == version:
                held[slot] = known
        self._held = held
        return {slot: array for slot, (_, array) in held.items()}, [slot for slot in versions if slot not in held]
