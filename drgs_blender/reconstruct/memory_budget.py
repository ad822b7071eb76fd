"""What fits into this machine's memory: asked before it is made, since a system that runs out ends programs unasked."""

from __future__ import annotations

import os

from ..core.errors import UsageError

#: Part of the memory that one thing may take.
_SHARE = 0.5


def memory() -> float:
    """Bytes of memory of this machine; infinite where the system does not say."""
    if not hasattr(os, "sysconf"):
        return float("inf")
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def check_fits(needed: float, subject: str, of: str, option: str, value: int, power: int, margin: int = 0) -> None:
    """Raise UsageError where `needed` bytes are more than half of the memory, with the value that fits.

    Parameters
    ----------
    subject, of : what is too large, and what it consists of, for the message
    option, value : what decides its size, and how it is set
    power, margin : the bytes grow with this power of the value and its margin together
    """
    if needed > _SHARE * memory():
        fitting = int((value + margin) * (_SHARE * memory() / needed) ** (1 / power)) - margin
        problem = f"is {needed / 2**30:.2g} GiB of {of}, this machine has {memory() / 2**30:.2g} GiB of memory"
        raise UsageError(subject, problem, f"Give {option} {max(fitting, 1)} or less")
