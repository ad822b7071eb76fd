"""Which frames to render, and the file of each: ``1-24x2,30`` and ``out/####.exr``."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from ..core.errors import UsageError
from ..core.frame_sequences import frames_of

_TERM = re.compile(r"(?P<first>-?\d{1,20})(?:(?:-|\.\.)(?P<last>-?\d{1,20})(?:[x:](?P<step>-?\d{1,20}))?)?")
#: Far beyond any shot; a mistyped range must not fill the memory.
MOST_FRAMES = 1_000_000
#: Blender's MAXFRAME; it silently stops there in both directions.
LAST_FRAME = 1_048_574


def parse_frames(text: str) -> list[int]:
    """Expand a frame range.

    Parameters
    ----------
    text : str
        Terms separated by commas: ``7``, ``1-24`` (or ``1..24``, as Blender writes it), every second frame ``1-24x2``
        or ``1-24:2``, downwards ``24-1x-2``. Numbers may be negative: ``-5--1``.

    Returns
    -------
    list of int
        In the order written, each frame once.

    Raises
    ------
    UsageError
        Naming the term that cannot be used.

    Examples
    --------
    >>> parse_frames("1-9x4, 24-22x-1, 7")
    [1, 5, 9, 24, 23, 22, 7]
    """
    frames: dict[int, None] = {}
    for term in text.replace(" ", "").split(","):
        match = _TERM.fullmatch(term)
        if not match:
            raise UsageError(f"frame range {text!r}", f"{term!r} is not a frame or a range", "Write it as 1-24x2,30")
        first = int(match["first"])
        last = int(match["last"] or first)
        step = int(match["step"] or 1)
        if step == 0:
            raise UsageError(f"frame range {text!r}", f"{term!r} has a step of 0", "Use a step of at least 1")
        count = (last - first) // step + 1
        if count < 1:
            raise UsageError(f"frame range {text!r}", f"{term!r} is empty", "A range that runs down needs a step x-1")
        if len(frames) + count > MOST_FRAMES:
            raise UsageError(f"frame range {text!r}", f"has more than {MOST_FRAMES} frames", "Split it")
        if max(abs(first), abs(last)) > LAST_FRAME:
            problem = f"{term!r} is beyond the frames of Blender"
            raise UsageError(f"frame range {text!r}", problem, f"They are {-LAST_FRAME} to {LAST_FRAME}")
        frames.update(dict.fromkeys(range(first, first + count * step, step)))
    return list(frames)


def requested_frames(text: str | None, source: Path) -> list[int] | None:
    """The frames of a sequence of files, one file each; None where `source` is a single file.

    Parameters
    ----------
    text : str or None
        The value of ``--frames``: a range, "" for those that are there, None where it is not given, which means the
        same for a `source` that is no file but a pattern of files.
    source : Path
        With a run of ``#`` for the number.

    Raises
    ------
    UsageError
        There are no such files.
    """
    if text is None and ("#" not in source.name or os.path.lexists(source)):
        return None
    return parse_frames(text) if text else frames_of(str(source))


def write_frames(frames: Sequence[int]) -> str:
    """The frames, in their order, as text that `parse_frames` and OpenJD read: ``1-24:2,30``.

    Parameters
    ----------
    frames : sequence of int
        At least one, none twice.

    Examples
    --------
    >>> write_frames([1, 3, 5, 7, 30])
    '1-7:2,30'
    """
    terms: list[str] = []
    start = 0
    while start < len(frames):
        end = start + 1
        step = frames[end] - frames[start] if end < len(frames) else 1
        while end + 1 < len(frames) and frames[end + 1] - frames[end] == step:
            end += 1
        if end - start < 2:  # two frames are no range
            terms.append(str(frames[start]))
            start += 1
        else:
            terms.append(f"{frames[start]}-{frames[end]}" + ("" if step == 1 else f":{step}"))
            start = end + 1
    return ",".join(terms)


def cut_frames(frames: Sequence[int], size: int) -> list[list[int]]:
    """The frames in parts of `size`, the last perhaps of fewer."""
    return [list(frames[i : i + size]) for i in range(0, len(frames), size)]


def absolute_template(template: str, scene: Path) -> str:
    """The pattern of the files with its whole path; a leading ``//`` is the folder of `scene`."""
    return str(scene.parent / template[2:] if template.startswith("//") else Path(template).absolute())


def check_template(template: str, frames: list[int]) -> None:
    """Refuse a template that would write several frames to one file."""
    if len(frames) > 1 and "#" not in Path(template).name:
        raise UsageError(
            f"output {template}", "has no # for the frame's number", f"Write it as out/####{Path(template).suffix}"
        )
