"""Files that are numbered, one a frame: ``cloud_####.ply``."""

from __future__ import annotations

import re
from pathlib import Path

from .errors import UsageError

_NUMBER = re.compile(r"\d+")


def frame_path(template: str, frame: int) -> Path:
    """Path of a frame: the last run of ``#`` in the file's name becomes the number, padded with zeros.

    Examples
    --------
    >>> frame_path("take_#/cow_####.exr", 12).as_posix()
    'take_#/cow_0012.exr'
    """
    folder, name = Path(template).parent, Path(template).name
    runs = list(re.finditer("#+", name))
    if not runs:
        return folder / name
    start, end = runs[-1].span()
    number = f"{'-' if frame < 0 else ''}{abs(frame):0{end - start}d}"
    return folder / (name[:start] + number + name[end:])


def template_of(paths: list[Path]) -> tuple[str, list[int]]:
    """The pattern and the numbers of files whose names differ in a number alone: ``cloud_####.ply``.

    Raises
    ------
    UsageError
        They differ in more, or lie in several folders.

    Examples
    --------
    >>> template_of([Path("cow_0012.ply"), Path("cow_0007.ply")])
    ('cow_####.ply', [7, 12])
    """
    first = paths[0]
    for found in reversed(list(_NUMBER.finditer(first.name))):
        start, end = found.span()
        before, after = first.name[:start], first.name[end:]
        numbers = [_between(path, first.parent, before, after) for path in paths]
        if all(n is not None for n in numbers) and len(set(numbers)) == len(paths):
            width = min(len(path.name) for path in paths) - len(before) - len(after)
            return str(first.parent / f"{before}{'#' * width}{after}"), sorted(int(n) for n in numbers if n is not None)
    raise UsageError(
        first.name, f"and {len(paths) - 1} others are not numbered files of one name", "Choose one, or a sequence"
    )


def frames_of(template: str) -> list[int]:
    """Numbers of the files that a pattern stands for.

    Raises
    ------
    UsageError
        There are none.
    """
    path = Path(template)
    runs = list(re.finditer("#+", path.name))
    if not runs:
        raise UsageError(template, "has no # for the number of a frame", "Write it as cloud_####.ply")
    start, end = runs[-1].span()
    before, after = path.name[:start], path.name[end:]
    try:
        others = list(path.parent.iterdir())
    except OSError as error:
        raise UsageError(template, f"cannot be looked for ({error.strerror or error})", "Check the folder") from error
    written = [_between(other, path.parent, before, after) for other in others]
    # As long as the pattern, or longer and without a leading zero: what writing the number would give.
    numbers = sorted(int(n) for n in written if n is not None and str(int(n)).zfill(end - start) == n)
    if not numbers:
        raise UsageError(template, "matches no file", "Write # for each digit of the number: cloud_####.ply")
    return numbers


def _between(path: Path, folder: Path, before: str, after: str) -> str | None:
    """The number in the name of `path`; None where it is another's."""
    name = path.name
    if path.parent != folder or not (name.startswith(before) and name.endswith(after)):
        return None
    number = name[len(before) : len(name) - len(after)]
    return number if number.isascii() and number.isdigit() else None
