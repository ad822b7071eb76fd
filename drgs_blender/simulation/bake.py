"""Bakes a simulation: frames of a job into a cache; what is there already stays."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Protocol

from ..core.errors import UsageError
from ..core.particle_cache import Header, ParticleCache, ParticleFrame
from .cracks import cracks_of, cracks_until, renewed
from .input_digest import same_until
from .job import Job
from .settings import Settings

log = logging.getLogger(__name__)

#: Seconds of computing that an interruption may cost.
_SAVE_EVERY = 5.0


def bake(
    job: Job,
    cache: ParticleCache,
    *,
    overwrite: bool = False,
    cancelled: Callable[[], bool] | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> int:
    """Simulate the frames of a job that are not in the cache.

    A bake that was stopped in any way goes on where it was, with the same bits as if it had not been.

    Parameters
    ----------
    job : Job
        At its beginning.
    cache : ParticleCache
    overwrite : bool
        Frames of other settings are removed; otherwise they are an error.
    cancelled : callable, optional
        Asked before every time step.
    progress : callable, optional
        Called with the frame that is computed and the part of it that is done.

    Returns
    -------
    int
        Frames computed.

    Raises
    ------
    UsageError
        The cache holds another simulation, or this one ran into trouble: frames up to there stay.
    Cancelled, WriteError
        What was done stays.
    """
    settings, rest = job.settings, job.rest()
    header = header_of(job, rest, asdict(settings))
    start = _resume(job, cache, header, overwrite)
    if start is None:
        begin(cache, header, rest)
        start = settings.first
    return compute(job, [(cache, job)], start, cancelled, progress)


def begin(cache: ParticleCache, header: Header, rest: ParticleFrame) -> None:
    """Begin a cache: its header, and its first frame, in which all is at rest."""
    cracks = cracks_of(header, rest)
    rest = rest if cracks is None else cracks.add(rest)
    cache.create(header, rest)
    cache.write(header.first, rest)


class Simulation(Protocol):
    """What moves one body or several, a `Job` or a `coupled_job.CoupledJob`."""

    @property
    def settings(self) -> Settings: ...

    @property
    def solver(self) -> Any: ...

    def pin_targets(self, frame: int) -> Any: ...


def compute(
    simulation: Simulation,
    bodies: Sequence[tuple[ParticleCache, Job]],
    start: int,
    cancelled: Callable[[], bool] | None,
    progress: Callable[[int, float], None] | None,
) -> int:
    """Compute the frames after `start` into the caches of all bodies, the state into the first; how many these are."""
    settings, solver = simulation.settings, simulation.solver
    done, kept, kept_at = 0, start, time.monotonic()
    cracks = [cracks_until(cache, start) if start < settings.last else None for cache, _ in bodies]
    try:
        for frame in range(start + 1, settings.last + 1):
            report = None if progress is None else (lambda part, f=frame: progress(f, part))
            solver.advance(1 / settings.fps, simulation.pin_targets(frame - settings.first), cancelled, report)
            for (cache, job), known in zip(bodies, cracks, strict=True):
                _check_owner(cache, job)
                cache.write(frame, job.now() if known is None else known.add(job.now()))
            done += 1
            if time.monotonic() - kept_at > _SAVE_EVERY:
                bodies[0][0].write_state(frame, solver.arrays())
                kept, kept_at = frame, time.monotonic()
        if done:
            _tell_lost([job for _, job in bodies])
    finally:
        now = settings.first + solver.frame
        if now > kept and all(cache.path(now).exists() and _owned(cache, job) for cache, job in bodies):
            bodies[0][0].write_state(now, solver.arrays())
    return done


def _tell_lost(jobs: Sequence[Job]) -> None:
    for solver in (job.solver for job in jobs if job.solver.lost):
        log.warning(
            "%s: %d of %d particles left the domain, and stay where they left it. Give a larger domain, or let it have "
            "walls, to keep them",
            solver.subject, solver.lost, len(solver.points),
        )  # fmt: skip


def header_of(job: Job, rest: ParticleFrame, settings: dict[str, Any]) -> Header:
    """What a cache says of a simulation that begins `rest`, made with `settings`."""
    own = job.settings
    return Header(
        job.digest, len(rest.points), len(rest.vertices), own.first, own.fps, settings,
        tear=job.tear, grain=job.grain, moves=job.moves, cells=job.cells,
    )  # fmt: skip


def _owned(cache: ParticleCache, job: Job) -> bool:
    header = cache.header()
    return header is not None and (header.digest, header.moves) == (job.digest, job.moves)


def _check_owner(cache: ParticleCache, job: Job) -> None:
    """Frames of two simulations must never lie in one folder."""
    if not _owned(cache, job):
        raise UsageError(
            str(cache.folder), "was given to another simulation, or emptied, meanwhile", "Bake again, one at a time"
        )


def _resume(job: Job, cache: ParticleCache, header: Header, overwrite: bool) -> int | None:
    """The last frame of this simulation in the cache, with the solver put there; None to start over."""
    found, first = cache.header(), job.settings.first
    if found is None:
        return None
    state = cache.read_state()
    frame, arrays = state or (first, {})
    needed = min(frame, job.settings.last) - first
    if found.digest != job.digest or not same_until(needed, found.moves, job.moves):
        if not overwrite:
            raise UsageError(
                str(cache.folder), "holds another simulation", "Choose another folder, or overwrite it (--overwrite)"
            )
        return None
    found = renewed(cache, found, header)
    if found is None:
        log.warning("%s: one of its frames is damaged; begins again", cache.folder)
        return None
    if state is None:
        last = job.settings.last
        if found.moves == job.moves and cache.lacking(first, last) is None:
            return last  # nothing is left to do
        if len(cache.frames()) > 1:
            log.warning("%s: its state is missing or damaged; begins again", cache.folder)
        return None
    if (gone := cache.lacking(first, frame)) is not None:
        log.warning("%s: frame %d is missing or damaged; begins again", cache.folder, gone)
        return None
    if not job.solver.restore(frame - first, arrays):
        log.warning("%s: its state is not that of this simulation; begins again", cache.folder)
        return None
    go_on(cache, found, header, frame, job.settings.last)
    return frame


def go_on(cache: ParticleCache, found: Header, header: Header, frame: int, last: int) -> None:
    """Bring the header of a cache, `found`, up to date with what is to go on after `frame`."""
    if frame < last and found.moves != header.moves:
        cache.extend(header, frame)
