"""Progress bars on stderr."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from ..core.phases import is_counted, is_preparing
from .frame_lines import emit
from .interrupt import interruptible

#: Between two lines while kernels are compiled: for programs, and for people without a terminal.
PROGRAM_SECONDS, PEOPLE_SECONDS = 0.5, 5.0
#: Between two lines of a whole reconstruction, for programs.
REPORT_SECONDS = 2.0
#: Between two lines of work that takes minutes, for people without a terminal.
WORK_SECONDS = 20.0


def lines_wanted(args: argparse.Namespace) -> bool:
    """Whether a program reads lines of progress on stdout: it said so by the variable DRGS_PROGRESS."""
    return os.environ.get("DRGS_PROGRESS") == "1" and not args.quiet and not sys.stdout.isatty()


def bar(args: argparse.Namespace, label: str, total: float | None = None, unit: str = "it", **options: Any) -> Any:
    """A tqdm bar: on a terminal, or when ``--progress`` asks for it; never with ``-q``."""
    from tqdm import tqdm

    wanted = args.progress
    disable = True if args.quiet or wanted is False else (False if wanted else None)
    width: dict[str, Any] = {"ncols": 80, "nrows": 24} if _unsized() else {"dynamic_ncols": True}
    return tqdm(total=total, desc=label, unit=unit, disable=disable, leave=False, **width, **options)


def _unsized() -> bool:
    """Whether stderr is a terminal that does not say how large it is: tqdm would draw nothing there."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(sys.stderr.fileno()).columns == 0
    return False


@contextlib.contextmanager
def clock(args: argparse.Namespace, label: str) -> Iterator[None]:
    """A running clock beside `label`, for work that cannot say how far it is."""
    with bar(args, label, bar_format="{desc} {elapsed}") as line:
        ended = threading.Event()

        def tick() -> None:
            while not ended.wait(0.5):
                line.refresh()

        thread = threading.Thread(target=tick, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


class FractionBar:
    """A bar for work that reports the fraction done; used as a context manager and called as (phase, fraction).

    Parameters
    ----------
    args : argparse.Namespace
    label : str
    programs : bool
        While kernels are compiled, lines on stdout for a program that reads them, see `lines_wanted`.
    every : float
        Seconds between two lines on stderr during the work itself, for people without a terminal; 0: none, only those
        of the time in which kernels are compiled.
    span : tuple of (float, float)
        The part of the whole work that is this one's, see `Steps`.
    """

    def __init__(
        self,
        args: argparse.Namespace,
        label: str,
        programs: bool = False,
        every: float = 0.0,
        span: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        self._span = span
        layout = "{desc}{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        self._bar = bar(args, label, total=1.0, bar_format=layout)
        self._counted, self._furthest = False, 0.0
        self._for_programs = programs and lines_wanted(args)
        self._for_people = self._bar.disable and not args.quiet and args.progress is None
        self._every = every
        self._next = 0.0

    def __enter__(self) -> FractionBar:
        return self

    def since(self, start: float) -> FractionBar:
        """Itself, with a clock that began at `start`, seconds of ``time.time``."""
        self._bar.start_t = start
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        if self._for_programs and self._next:
            emit('DRGS_PROGRESS part=1.000 phase="Ready"\n', sys.stdout)

    def __call__(self, phase: str, fraction: float) -> None:
        """Show what is being done and the part of it that is done, in [0, 1]; a second try takes nothing back."""
        if not is_counted(phase):
            fraction = self._furthest = max(self._furthest, self.of_all(fraction))
        if is_counted(phase) != self._counted:  # it has a bar of its own
            self._counted = is_counted(phase)
            self._bar.reset()
        if phase:
            self._bar.set_description(phase, refresh=False)
        self._bar.update(max(0.0, min(1.0, fraction) - self._bar.n))
        self._bar.refresh()  # the clock goes on where nothing else does
        if is_preparing(phase):
            self._emit(phase, fraction)
        elif self._for_people and self._every and time.monotonic() >= self._next:
            self._next = time.monotonic() + self._every
            emit(f"drgs: {_counted(phase, fraction)}\n", sys.stderr)

    def of_all(self, fraction: float) -> float:
        """The part of the whole work that is done with this part of its own."""
        first, last = self._span
        return first + (last - first) * max(0.0, min(1.0, fraction))

    def _emit(self, phase: str, fraction: float) -> None:
        """Nothing else is heard for minutes where there is no bar."""
        now = time.monotonic()
        if now < self._next:
            return
        if self._for_programs:
            self._next = now + PROGRAM_SECONDS
            emit(f'DRGS_PROGRESS part={fraction:.3f} phase="{phase}"\n', sys.stdout)
        elif self._for_people:
            self._next = now + PEOPLE_SECONDS
            emit(f"drgs: {_counted(phase, fraction)}\n", sys.stderr)


class ProgramLines:
    """Lines on stdout for programs that want them, see `lines_wanted`, one in a while."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._wanted, self._next = lines_wanted(args), 0.0

    def __call__(self, phase: str, part: float, surfels: int = 0, psnr: float | None = None) -> None:
        """Say what is being done, the part of it that is done, and how many surfels there are, how good."""
        now = time.monotonic()
        if self._wanted and now >= self._next:
            self._next = now + REPORT_SECONDS
            known = "" if psnr is None else f"psnr={psnr:.2f} "
            print(f'DRGS_PROGRESS part={part:.3f} surfels={surfels} {known}phase="{phase}"', flush=True)


class Steps:
    """One bar for work of several steps: each goes on where the one before it ended, with the same clock.

    Parameters
    ----------
    args : argparse.Namespace
    label : str
    """

    def __init__(self, args: argparse.Namespace, label: str) -> None:
        self._args, self._label = args, label
        self._done, self._since = 0.0, time.time()

    def step(self, part: float = 1.0) -> FractionBar:
        """The bar of the next step, which is this part of the whole, or all that is left of it."""
        span = self._done, min(self._done + part, 1.0)
        self._done = span[1]
        return FractionBar(self._args, self._label, every=WORK_SECONDS, span=span).since(self._since)


def _counted(phase: str, fraction: float) -> str:
    """The phase and how far it is, which some say themselves ("3 of 12")."""
    return phase if " of " in phase else f"{phase}, {min(fraction, 1.0):.0%} of all"


def prepare_engine(args: argparse.Namespace, *jobs: str) -> None:
    """Have the kernels of `jobs` compiled, see `compute.prepare`, and show it by a bar or lines, as `FractionBar`.

    Raises
    ------
    Cancelled
        Ctrl+C came.
    """
    from ..compute.prepare import prepare_kernels

    with FractionBar(args, "preparing", programs=True) as show, interruptible() as stopped:
        prepare_kernels(jobs, show, stopped)


def frames_on(bar: FractionBar, first: int, last: int) -> Callable[[int, float], None]:
    """What shows on a bar the frame that is computed, of those after `first` up to `last`, and the part of it."""
    count = max(last - first, 1)
    return lambda frame, part: bar(f"frame {frame}", (frame - first - 1 + part) / count)
