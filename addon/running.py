"""Commands that run beside the window, as panels show them; nothing is stored."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field

_LINE = re.compile(r'DRGS_PROGRESS part=([\d.]+).*? phase="([^"]*)"')


@dataclass(eq=False)
class Running:
    """A command that runs.

    Attributes
    ----------
    text : str
        What it does.
    since : float
        Seconds of `time.monotonic`.
    part : float or None
        Fraction that is done; None: it does not say.
    phase : str
        What it does now, where it says that.
    cancelled : bool
        Asked to end before its time.
    """

    text: str
    since: float = field(default_factory=time.monotonic)
    part: float | None = None
    phase: str = ""
    cancelled: bool = False

    def follow(self, output: str) -> None:
        """Update the progress from all output of the program so far."""
        if found := _LINE.findall(output):
            self.part, self.phase = float(found[-1][0]), found[-1][1]
            if self.part >= 1.0:  # of a part of the work: what comes now does not say how far it is
                self.part, self.phase = None, ""

    def shown(self) -> str:
        """Text with the phase and the time that it has taken."""
        phase = f": {self.phase}" if self.phase else ""
        seconds = int(time.monotonic() - self.since)
        return f"{self.text}{phase}, {seconds // 60}:{seconds % 60:02d}"


#: Those that run, the newest last.
commands: list[Running] = []


def begin(text: str) -> Running:
    """A command begins."""
    commands.append(made := Running(text))
    return made


def end(command: Running | None) -> None:
    """A command has ended, however."""
    if command in commands:
        commands.remove(command)
