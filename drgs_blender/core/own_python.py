"""This Python as a command: what a process starts of itself has the packages that the process has."""

from __future__ import annotations

import sys
from pathlib import Path

#: Set by `cli/bundled.py`, where that began this process: all that stands before ``-m`` or ``-c``.
bundled: list[str] = []
#: File in an environment that *Set Up Engine* made.
SET_UP = "drgs-engine.json"


def command(*flags: str) -> list[str]:
    """What stands before ``-m`` or ``-c``; `flags` are for a Python that finds the packages by itself."""
    return list(bundled) or [sys.executable, *flags]


def install_remedy(packages: str, part: str) -> str:
    """What brings `packages`, words for pip, into this Python: pip, or in Blender the `part` of *Set Up Engine*."""
    if bundled or Path(sys.prefix, SET_UP).is_file():
        return f'press Set Up Engine in Blender, with "{part}"'
    return f'"{sys.executable}" -m pip install {packages}'
