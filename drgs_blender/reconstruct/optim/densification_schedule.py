"""The schedule of densification: when surfels are split, and how many there may be then."""

from __future__ import annotations

from .schedule import Schedule


class DensificationSchedule:
    """Rounds of densification, spread evenly over a part of the schedule.

    Parameters
    ----------
    schedule : Schedule
    start : int
        Surfels at the first step.
    most : int
        Surfels at the end, at most.

    Attributes
    ----------
    start : int
    rounds : int
        Number of rounds that are done.
    """

    def __init__(self, schedule: Schedule, start: int, most: int) -> None:
        self._schedule, self.start, self.rounds, self._most = schedule, start, 0, most

    def due(self, part: float) -> int:
        """Rounds that are to be done by this part of the schedule."""
        return int(self._grown(part) * self._schedule.rounds)

    def budget(self, part: float) -> int:
        """Largest number of surfels at this part of the schedule."""
        return int(self.start + (self._most - self.start) * self._grown(part))

    def _grown(self, part: float) -> float:
        begin, end = self._schedule.densify
        return min(max((part - begin) / (end - begin), 0.0), 1.0)
