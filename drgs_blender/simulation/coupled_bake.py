"""Bakes bodies that push each other: a cache each, which belong together.

What is needed to go on lies in the cache of the first body alone, so that it is of one frame whatever ends the bake.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from ..core.errors import UsageError
from ..core.particle_cache import Header, ParticleCache
from .bake import begin, compute, go_on, header_of
from .coupled_job import CoupledJob, about_others
from .cracks import renewed
from .input_digest import same_until

log = logging.getLogger(__name__)

_ANOTHER = "Choose another folder, or overwrite it (--overwrite)"


def bake_coupled(
    job: CoupledJob,
    caches: Sequence[ParticleCache],
    *,
    overwrite: bool = False,
    cancelled: Callable[[], bool] | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> int:
    """Simulate the frames of several bodies that are not in their caches.

    Parameters
    ----------
    job : CoupledJob
        At its beginning.
    caches : sequence of ParticleCache
        Of the bodies.
    overwrite : bool
        As of `bake.bake`.
    cancelled, progress : callable, optional
        As of `bake.bake`.

    Returns
    -------
    int
        Frames computed.

    Raises
    ------
    UsageError
        A cache holds another simulation, or one of those that belong together is missing; or the simulation ran into
        trouble: frames up to there stay.
    Cancelled, WriteError
        What was done stays.
    """
    settings, jobs = job.settings, job.jobs
    rests = [one.rest() for one in jobs]
    headers = [
        header_of(one, rest, about_others(job, i)) for i, (one, rest) in enumerate(zip(jobs, rests, strict=True))
    ]
    start = _resume(job, caches, headers, overwrite)
    if start is None:
        for cache in caches:
            cache.clear()  # all before any: none of them is left with frames of before
        for cache, header, rest in zip(caches, headers, rests, strict=True):
            begin(cache, header, rest)
        start = settings.first
    return compute(job, list(zip(caches, jobs, strict=True)), start, cancelled, progress)


def _resume(job: CoupledJob, caches: Sequence[ParticleCache], headers: Sequence[Header], overwrite: bool) -> int | None:
    """The last frame of this simulation in all caches, with the solver put there; None to start over."""
    first, last = job.settings.first, job.settings.last
    found = [cache.header() for cache in caches]
    state = caches[0].read_state()
    frame, arrays = state or (first, {})
    needed = min(frame, last) - first
    for body, cache, there, header in zip(job.bodies, caches, found, headers, strict=True):
        if there is None or (there.digest == header.digest and same_until(needed, there.moves, header.moves)):
            continue
        if not overwrite:
            raise UsageError(f'body "{body.name}", {cache.folder}', "holds another simulation", _ANOTHER)
        return None
    missing = [i for i, there in enumerate(found) if there is None]
    begun = [i for i, cache in enumerate(caches) if i not in missing and len(cache.frames()) > 1]
    if missing and begun and not overwrite:
        names = ", ".join(f'"{job.bodies[i].name}"' for i in begun)
        raise UsageError(
            f'body "{job.bodies[missing[0]].name}", {caches[missing[0]].folder}',
            f"is missing: it belongs to the frames that are there of {names}",
            "Put the folder back, or bake all again (--overwrite)",
        )
    if missing:
        return None
    found = [a and renewed(cache, a, b) for cache, a, b in zip(caches, found, headers, strict=True)]
    if None in found:
        log.warning("%s: one of its frames is damaged; all bodies begin again", caches[found.index(None)].folder)
        return None
    if state is None:
        moves = all(a is not None and a.moves == b.moves for a, b in zip(found, headers, strict=True))
        if moves and all(cache.lacking(first, last) is None for cache in caches):
            return last  # nothing is left to do
        if begun:
            log.warning("%s: its state is missing or damaged; all bodies begin again", caches[0].folder)
        return None
    for body, cache in zip(job.bodies, caches, strict=True):
        if (gone := cache.lacking(first, frame)) is not None:
            told = 'body "%s", %s: frame %d is missing or damaged; all bodies begin again'
            log.warning(told, body.name, cache.folder, gone)
            return None
    if not job.solver.restore(frame - first, arrays):
        log.warning("%s: its state is not that of this simulation; begins again", caches[0].folder)
        return None
    for cache, there, header in zip(caches, found, headers, strict=True):
        if there is not None:
            go_on(cache, there, header, frame, last)
    return frame
