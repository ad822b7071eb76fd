"""What the command lines of the demos do alike: where they write, which frames, what is said of an end before time.

Standard library only.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
sys.path.insert(0, str(ROOT / "tools"))

import environments  # noqa: E402
from steps import Step, StepFailed, run_steps  # noqa: E402

DRGS = [environments.python_of(environments.ENGINE), "-m", "drgs_blender.cli.main"]


def variables(out: Path) -> dict[str, str]:
    """Environment variables of all steps: Blender keeps its settings in `out`, and finds the engine."""
    return {
        "BLENDER_USER_RESOURCES": str(out / "blender"),
        "DRGS_ENGINE": str(environments.python_of(environments.ENGINE)),
        "DRGS_BLENDER": str(environments.blender()),
    }


def for_blender() -> tuple[str, ...]:
    """Steps before those in Blender: its environment, where no other Blender is named."""
    return () if os.environ.get("DRGS_BLENDER") else (environments.FOR_BLENDER,)


def first_steps(before: Sequence[Step]) -> list[Step]:
    """The steps `before`; without any, the environments are there, and their steps do nothing."""
    names = (environments.FOR_ENGINE, *for_blender())
    return list(before) or [Step(name, "", [sys.executable, "-c", ""], 0.1) for name in names]


def run_all(steps: Sequence[Step], out: Path, before: Sequence[Step] = ()) -> float:
    """Run the steps of a demo that writes to `out`, after those `before`; the seconds that it took.

    Raises
    ------
    StepFailed
    """
    return run_steps([*first_steps(before), *steps], out / "log.txt", ROOT, variables(out))


def building(extension: Path) -> Step:
    """The step that zips the extension."""
    command = [environments.python_of(environments.ENGINE), ROOT / "tools/extension.py", "--out", extension]
    return Step("extension", "Building the extension", command, 0.5, (environments.FOR_ENGINE,))


def frames_saved(text: str, count: int) -> Callable[[str], tuple[str, float] | None]:
    """Of lines of `drgs render`, how many of `count` frames are done; `text` begins what is said of it.

    The part that is done is that of the frames which were not there before: these alone tell the time of one.
    """
    done = there = 0

    def counted(line: str) -> tuple[str, float] | None:
        nonlocal done, there
        saved, skipped = line.startswith("Saved: "), line.startswith("skipping existing frame")
        begun = line.startswith("Fra:") and ("| Preparing" in line or "| Sample 0/" in line)
        if not (saved or skipped or begun):
            return None
        done += saved
        there += skipped
        return f"{text}, {done + there} of {count} frames", done / max(count - there, 1)

    return counted


def rendering(name: str, title: str, command: list[object], seconds: float, after: tuple[str, ...], count: int) -> Step:
    """The step of a `drgs render` of `count` frames, which first starts Blender."""
    counted = frames_saved(title, count)
    return Step(name, "Starting Blender", command, seconds, after, count=counted, measured=True, title=title)


def frame_count(text: str, last: int) -> int:
    """How many frames a range like 1-24x2,30 has.

    Raises
    ------
    StepFailed
        It is no range, or has frames that are not between 1 and `last`.
    """
    found: set[int] = set()
    try:
        for part in text.split(","):
            span, _, stride = part.partition("x")
            first, _, end = span.partition("-")
            found.update(range(int(first), int(end or first) + 1, int(stride or 1)))
    except ValueError:
        found.clear()
    if not found:
        raise StepFailed(f"--frames {text} is no range of frames like 1-{last}, 1-{last}x2 or 7")
    if min(found) < 1 or max(found) > last:
        raise StepFailed(f"--frames {text}: the scene has frames 1 to {last}")
    return len(found)


def check_folder(option: str, folder: Path) -> None:
    """Make a folder to write to.

    Raises
    ------
    StepFailed
        It cannot be made, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        is_file = isinstance(error, (FileExistsError, NotADirectoryError))
        why = "it is a file, or in one" if is_file else error.strerror
        raise StepFailed(f"{option} {folder}: nothing can be written there ({why}); name another folder") from error


def exit_code(name: str, again: str, work: Callable[[], object]) -> int:
    """Do `work`; in a line say why it failed, or that the command `again` goes on with it; the exit code."""
    try:
        work()
    except StepFailed as failure:
        print(f"{name}: {failure}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"Interrupted; `{again}` goes on from here", file=sys.stderr)
        return 130
    return 0
