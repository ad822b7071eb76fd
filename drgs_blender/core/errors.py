"""The few errors that reach a user. Each message names the file or object, what is wrong, and what to do.

The ``exit_code`` of a class is what ``drgs`` returns to the shell or the farm when the error ends a command.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from unicodedata import category

EXIT_OK = 0
EXIT_USAGE = 64
EXIT_BAD_ASSET = 65
EXIT_NO_DEVICE = 69
EXIT_INTERNAL = 70
EXIT_CANNOT_WRITE = 73
EXIT_RETRY = 75
EXIT_VERSION = 78
#: As shells count: 128 and the number of the signal, SIGINT's and SIGTERM's.
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143

#: Exit code -> word in the last line of ``drgs render`` and ``drgs denoise``, which farms parse.
EXIT_CLASSES = {
    EXIT_OK: "ok",
    EXIT_USAGE: "usage",
    EXIT_BAD_ASSET: "bad-asset",
    EXIT_NO_DEVICE: "no-device",
    EXIT_INTERNAL: "internal",
    EXIT_CANNOT_WRITE: "cannot-write",
    EXIT_RETRY: "retry",
    EXIT_VERSION: "version",
    EXIT_INTERRUPTED: "interrupted",
    EXIT_TERMINATED: "terminated",
}


def printable(text: str) -> str:
    r"""A text with control, format and other characters that a terminal does not show as escape sequences.

    Names of files and keys of JSON can have them. Letters of all languages, and spaces of all kinds, stay.

    Examples
    --------
    >>> print(printable("Würfel\x1b[2J.drgs"))
    Würfel\x1b[2J.drgs
    """
    return "".join(
        c if c.isprintable() or category(c) == "Zs" else c.encode("unicode_escape").decode("ascii") for c in text
    )


class DrgsError(Exception):
    """Base of every error meant for a user. Its text is `printable`; its parts are as they were given.

    Parameters
    ----------
    subject : str
        The file, object or setting the error is about; "" where the problem is a sentence that names it.
    problem : str
        The problem.
    remedy : str
        Advice for the user; None stands for the usual advice of the class.
    """

    exit_code = EXIT_INTERNAL
    usual_remedy = ""

    def __init__(self, subject: str, problem: str, remedy: str | None = None) -> None:
        self.subject, self.problem = subject, problem
        self.remedy = self.usual_remedy if remedy is None else remedy
        said = f"{subject}: {problem}." if subject else f"{problem}."
        super().__init__(printable(said + (f" {self.remedy}." if self.remedy else "")))

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.subject, self.problem, self.remedy)


class UsageError(DrgsError):
    """A setting or argument that cannot be used."""

    exit_code = EXIT_USAGE


class AssetError(DrgsError):
    """A file (asset, mesh, surfels, environment) that is damaged, incomplete or does not fit."""

    exit_code = EXIT_BAD_ASSET
    usual_remedy = "What wrote it is at fault or did not finish: make or export it again"


class DeviceError(DrgsError):
    """A part needed to compute (engine interpreter, Embree, a device) is absent."""

    exit_code = EXIT_NO_DEVICE


class WriteError(DrgsError):
    """An output that cannot be written."""

    exit_code = EXIT_CANNOT_WRITE


class EngineError(DrgsError):
    """The engine died or did not answer; the same request may succeed when repeated."""

    exit_code = EXIT_RETRY


class VersionError(DrgsError):
    """Two parts of DR-GS of different versions met."""

    exit_code = EXIT_VERSION


class Cancelled(Exception):
    """The user cancelled; not an error."""


_NAMES_AND_NUMBERS = re.compile(r'"[^"]*"|(?<![\w./\\-])\d+(?:[.,]\d+)*(?![\w/\\-]|\.\w)')
#: Name -> class, for errors that cross the process boundary.
ERROR_CLASSES: dict[str, type[DrgsError]] = {
    c.__name__: c for c in (DrgsError, UsageError, AssetError, DeviceError, WriteError, EngineError, VersionError)
}


def without_numbers(text: str) -> str:
    """A message but for its counts, so that it is told once of all frames; names, before a colon or quoted, stay."""
    name, colon, rest = text.partition(": ") if ": " in text else ("", "", text)
    return name + colon + _NAMES_AND_NUMBERS.sub(lambda found: found[0] if found[0][0] == '"' else "#", rest)


def first_of(names: Sequence[str]) -> str:
    """The first of many names, for a message."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
