"""JSON files that a user wrote: cameras, settings of simulations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..core.errors import UsageError

_UTF16 = (b"\xff\xfe", b"\xfe\xff")


def read_json(path: Path, subject: str, largest: int, content: str) -> Any:
    """Read a JSON file of UTF-8 text, with or without a byte order mark.

    Parameters
    ----------
    path : Path
    subject : str
        Of the file, in messages.
    largest : int
        Bytes that it may have.
    content : str
        What the file should hold, such as "a camera", for messages.

    Raises
    ------
    UsageError
        It is absent, no regular file (pipes and devices are never opened), too large, of another encoding or not JSON.
    """
    remedy = f"Choose a JSON file of {content}"
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise UsageError(subject, "is not a regular file", remedy)
        if size > largest:
            raise UsageError(subject, f"has {size} bytes, more than {largest}", remedy)
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(subject, f"cannot be read ({error.strerror or error})", "Check the path") from error
    if data.startswith(_UTF16) or b"\0" in data[:2]:
        raise UsageError(subject, "is UTF-16 text", "Save it as UTF-8")
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise UsageError(
            subject, "is not UTF-8 text", f"Save it as UTF-8, if it is a JSON file of {content}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UsageError(subject, f"is not JSON ({error})", remedy) from error
