"""Files that a program is to write: whether it has. Exit code 0 alone is no proof."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

#: What to do where a program says that all is well and has not done its work.
REMEDY = "See that this is the engine of this extension (preferences), or set it up again"


class ExpectedFiles:
    """Files as they are before a program that is to write them begins.

    Parameters
    ----------
    paths : of files; those that are there already count as written when they have changed
    """

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        self._before = {path: _stamp(path) for path in paths}

    @property
    def paths(self) -> list[Path]:
        """All of them."""
        return list(self._before)

    def missing(self) -> list[Path]:
        """The files that were not written."""
        return [path for path, before in self._before.items() if _stamp(path) in (None, before)]


def complaint(program: str, missing: list[Path]) -> str:
    """A problem in words, for messages."""
    more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
    return f"{program} ended without an error but has not written {missing[0]}{more}"


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Changes when a file is written; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
