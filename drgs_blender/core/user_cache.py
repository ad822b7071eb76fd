"""Where caches of the user lie: the system's folder for them, and the one that the user names instead."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def user_cache() -> Path:
    """The system's folder for caches of this user, absolute.

    Raises
    ------
    RuntimeError
        The user has no home folder.
    """
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local")
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches"
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return named if named.is_absolute() else Path.home() / ".cache"


def named_cache() -> Path | None:
    """The folder that ``DRGS_CACHE_DIR`` names, absolute; None without."""
    named = os.environ.get("DRGS_CACHE_DIR")
    return Path(named).expanduser().absolute() if named else None
