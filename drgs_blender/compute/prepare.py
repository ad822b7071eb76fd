"""Compile what jobs need before it is called, in as many processes as there are processors.

python -m drgs_blender.compute.prepare [--all | JOB ...]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ..errors import Cancelled
from ..phases import PREPARING
from . import manifest, shipped
from .folders import cache_folder
from .manifest import Kernel

log = logging.getLogger(__name__)
#: The one text for it, in Blender and on the command line.
PHASE = PREPARING
_POLL = 0.1
_TELL = 0.4

Progress = Callable[[str, float], None]


def prepare_kernels(
    jobs: Iterable[str], progress: Progress | None = None, cancelled: Callable[[], bool] | None = None
) -> None:
    """Compile what `jobs` need and the cache lacks; return at once where nothing is missing.

    A process that ends, or cannot write what it compiled, leaves it to the first call of the kernel: this never fails
    for lack of a cache.

    Parameters
    ----------
    jobs : iterable of str
        Of `manifest.jobs`.
    progress : callable, optional
        Called with "Preparing the engine (first time only), 3 of 12" and the part that is done.
    cancelled : callable, optional
        Asked ten times per second.

    Raises
    ------
    Cancelled
    """
    if os.environ.get("DRGS_PREPARE") == "0" or cache_folder().path is None:
        return
    missing = lacking(manifest.needed(jobs))
    if not missing:
        return
    with contextlib.closing(_Pool(missing)) as pool:
        told = 0.0
        while pool.is_working():
            if cancelled is not None and cancelled():
                raise Cancelled
            if progress is not None and time.monotonic() - told >= _TELL:
                told = time.monotonic()
                progress(f"{PHASE}, {min(pool.done + 1, len(missing))} of {len(missing)}", pool.fraction)
            pool.wait(_POLL)


def lacking(kernels: Iterable[Kernel]) -> list[Kernel]:
    """Those of some kernels that are not compiled yet and can be compiled ahead."""
    from .jit import numba

    codegen = numba.core.registry.cpu_target.target_context.codegen()
    missing = []
    for kernel in kernels:
        try:
            cache = manifest.dispatcher(kernel)._cache
            if not cache.is_there(manifest.signature(kernel), codegen):
                missing.append(kernel)
        except (LookupError, AttributeError) as error:
            log.info("kernel %s: %s", kernel.name, error)
    return missing


@dataclass(frozen=True)
class Stock:
    """How many kernels of all jobs are where.

    Attributes
    ----------
    shipped : int
        Come with the release.
    kept : int
        Were compiled here.
    missing : int
        Are compiled when they are needed.
    """

    shipped: int
    kept: int
    missing: int


def stock() -> Stock:
    """Where the kernels of all jobs are; those of packages that are not installed do not count."""
    from .jit import numba

    codegen = numba.core.registry.cpu_target.target_context.codegen()
    kernels, brought = manifest.needed(manifest.jobs()), 0
    missing = len(lacking(kernels))
    known = 0
    for kernel in kernels:
        with contextlib.suppress(LookupError, AttributeError):
            name = manifest.dispatcher(kernel)._cache.file_name(manifest.signature(kernel), codegen)
            known += 1
            brought += name is not None and shipped.has(name)
    return Stock(brought, known - brought - missing, missing)


class _Pool:
    """Worker processes, each compiling one kernel at a time; the longest first.

    Attributes
    ----------
    done : int
        Kernels that are compiled.
    fraction : float
        Part of the time of compiling them all that lies behind.
    """

    def __init__(self, kernels: list[Kernel]) -> None:
        self._left = list(reversed(kernels))
        self._all = sum(kernel.seconds for kernel in kernels)
        self.done, self.fraction = 0, 0.0
        self._answers: queue.SimpleQueue[tuple[_Worker, bool]] = queue.SimpleQueue()
        count = min(len(kernels), os.cpu_count() or 1)
        self._workers = [_Worker(self._answers) for _ in range(count)]
        for worker in self._workers:
            self._give(worker)

    def is_working(self) -> bool:
        """Whether a worker still has something to do."""
        return any(worker.kernel is not None for worker in self._workers)

    def wait(self, seconds: float) -> None:
        """Take an answer, or wait for so long."""
        try:
            worker, lives = self._answers.get(timeout=seconds)
        except queue.Empty:
            return
        if worker.kernel is not None:
            self.done += 1
            self.fraction = min(1.0, self.fraction + worker.kernel.seconds / (self._all or 1.0))
            worker.kernel = None
        if lives:
            self._give(worker)

    def close(self) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.close()

    def _give(self, worker: _Worker) -> None:
        if self._left and not worker.give(self._left[-1]):
            return
        if self._left:
            self._left.pop()


class _Worker:
    """A process that runs `drgs_blender.compute.worker`, and the thread that waits for its answers."""

    def __init__(self, answers: queue.SimpleQueue[tuple[_Worker, bool]]) -> None:
        self.kernel: Kernel | None = None
        environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
        if folder := cache_folder().path:
            environment["DRGS_CACHE_DIR"] = str(folder)
        command = [sys.executable, "-m", "drgs_blender.compute.worker"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, encoding="utf-8"
        )
        threading.Thread(target=self._listen, args=(answers,), daemon=True).start()

    def give(self, kernel: Kernel) -> bool:
        """Have a kernel compiled; False where the process has ended."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps([kernel.module, kernel.name, kernel.arguments]) + "\n")
            self._process.stdin.flush()
        except OSError:
            return False
        self.kernel = kernel
        return True

    def close(self) -> None:
        """End it at once: a kernel that it is compiling is lost, nothing else."""
        self._process.kill()
        self._process.wait()

    def _listen(self, answers: queue.SimpleQueue[tuple[_Worker, bool]]) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.strip() == "done":
                answers.put((self, True))
        answers.put((self, False))


def main(argv: list[str] | None = None) -> int:
    """The command line; the return value is the exit code."""
    parser = argparse.ArgumentParser(prog="python -m drgs_blender.compute.prepare", description=__doc__.split("\n")[0])
    parser.add_argument("jobs", nargs="*", metavar="JOB", help=f"any of {', '.join(manifest.jobs())}")
    parser.add_argument("--all", action="store_true", help="of all jobs")
    options = parser.parse_args(argv)
    if unknown := set(options.jobs) - set(manifest.jobs()):
        parser.error(f"unknown job {', '.join(sorted(unknown))}; there are {', '.join(manifest.jobs())}")
    if not options.jobs and not options.all:
        parser.error("name jobs, or --all")
    told: list[str] = []

    def show(phase: str, fraction: float) -> None:
        if told[-1:] != [phase]:
            told.append(phase)
            print(phase, flush=True)

    try:
        prepare_kernels(manifest.jobs() if options.all else options.jobs, show)
    except KeyboardInterrupt:
        return 130
    if trouble := cache_folder().trouble:
        print(trouble, file=sys.stderr)
    print("The engine is ready", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
