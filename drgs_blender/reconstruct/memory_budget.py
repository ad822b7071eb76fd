"""The memory budget of learning, checked before arrays are made: a system that runs out ends programs unasked."""

from __future__ import annotations

from ..core.errors import UsageError
from ..core.memory import available_memory, total_memory

#: Part of the memory that one thing may take.
_SHARE = 0.5


def fitting(needed: float, value: int, power: int, margin: int = 0) -> int:
    """The largest value, up to the one that needs `needed` bytes, with which one thing fits in free memory, too."""
    return _reduced(min(_SHARE * total_memory() / needed, available_memory() / needed, 1.0), value, power, margin)


def _reduced(share: float, value: int, power: int, margin: int) -> int:
    """The value whose bytes are this share of those of `value`; at least 1."""
    return max(int((value + margin) * share ** (1 / power)) - margin, 1)


def check_fits(needed: float, subject: str, of: str, option: str, value: int, power: int, margin: int = 0) -> None:
    """Raise UsageError where `needed` bytes are more than half of the memory, with the value that fits.

    Parameters
    ----------
    needed : float
    subject, of : str
        The array that is too large, and its elements, for the message.
    option : str
        Option that sets its size, for the message.
    value : int
        Of the option.
    power, margin : int
        The bytes grow with this power of the value and its margin together.
    """
    total = total_memory()
    if needed > _SHARE * total:
        reduced = _reduced(_SHARE * total / needed, value, power, margin)
        problem = f"is {needed / 2**30:.2g} GiB of {of}, this machine has {total / 2**30:.2g} GiB of memory"
        raise UsageError(subject, problem, f"Give {option} {reduced} or less")
