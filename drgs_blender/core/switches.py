"""Environment variables that switch something on or off."""

from __future__ import annotations

import functools
import logging
import os

log = logging.getLogger(__name__)
_OFF, _ON = ("0", "false", "no", "off"), ("1", "true", "yes", "on")


def is_on(name: str, default: bool) -> bool:
    """Whether an environment variable switches on what it stands for.

    Parameters
    ----------
    name : str
        0, false, no and off switch off; 1, true, yes, on, and with a warning any other text, switch on.
    default : bool
        Where it is unset or empty.
    """
    text = os.environ.get(name, "").strip().lower()
    if not text:
        return default
    if text not in (*_OFF, *_ON):
        _warn(name, text)
    return text not in _OFF


@functools.cache
def _warn(name: str, text: str) -> None:
    """Warn of a value, once."""
    log.warning("%s is %s, which counts as 1: set it to 0 or 1", name, text)
