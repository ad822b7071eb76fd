"""Ahead-of-time compilation of the kernels that jobs need, in as many processes as there are processors.

python -m drgs_blender.compute.prepare [--all | JOB ...]
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import EXIT_CANNOT_WRITE, EXIT_INTERRUPTED, Cancelled, DrgsError
from ..core.memory import available_memory
from ..core.phases import PREPARING
from . import closure, manifest, shipped
from .folders import cache_folder
from .kernel_cache import Claim, KernelCache
from .manifest import Kernel

log = logging.getLogger(__name__)
#: The one text for it, in Blender and on the command line.
PHASE = PREPARING
_POLL = 0.1
_REPORT = 0.4
#: Seconds without any progress after which what another process has begun is compiled here as well.
_PATIENCE = 180.0
#: Of memory, which a process that compiles takes.
_BYTES = 700 << 20

#: How much lower the priority of workers that yield is, on the scale of ``nice``.
_LOWER = 5
Progress = Callable[[str, float], None]
_Known = tuple[Kernel, KernelCache, tuple[Any, ...]]


def prepare_kernels(
    jobs: Iterable[str], progress: Progress | None = None, cancelled: Callable[[], bool] | None = None
) -> None:
    """Compile what `jobs` need and the cache lacks; return at once where nothing is missing.

    A process that ends, or cannot write what it compiled, leaves it to the first call of the kernel: this never fails
    for lack of a cache.

    Parameters
    ----------
    jobs : iterable of str
        Of `manifest.jobs`; the kernels of the first are compiled first, beside the one that takes longest of all.
    progress : callable, optional
        Called with "Preparing the engine (first time only), 3 of 12" and the part that is done.
    cancelled : callable, optional
        Asked ten times per second.

    Raises
    ------
    Cancelled
    """
    if os.environ.get("DRGS_PREPARE") != "0":
        _compile(jobs, progress, cancelled)


def _compile(
    jobs: Iterable[str],
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> None:
    if cache_folder().path is None:
        return
    missing = _missing(manifest.needed(jobs))
    if not missing:
        return
    with contextlib.closing(_Pool(missing)) as pool:
        reported = 0.0
        while pool.is_working():
            if cancelled is not None and cancelled():
                raise Cancelled
            if progress is not None and time.monotonic() - reported >= _REPORT:
                reported = time.monotonic()
                progress(f"{PHASE}, {min(pool.done + 1, len(missing))} of {len(missing)}", pool.fraction)
            pool.wait(_POLL)


def not_compiled(kernels: Iterable[Kernel]) -> list[Kernel]:
    """The kernels among these that are not compiled yet and can be compiled ahead."""
    return [kernel for kernel, _, _ in _missing(kernels)]


def _missing(kernels: Iterable[Kernel]) -> list[_Known]:
    codegen = _codegen()
    return [known for known in _known(kernels) if not known[1].is_there(known[2], codegen)]


def _codegen() -> Any:
    from .jit import numba

    return numba.core.registry.cpu_target.target_context.codegen()


def _known(kernels: Iterable[Kernel]) -> Iterator[_Known]:
    """Kernels that exist, with their caches and argument types; not those of packages that are not installed."""
    for kernel in kernels:
        try:
            cache, signature = manifest.dispatcher(kernel)._cache, manifest.signature(kernel)
        except (LookupError, AttributeError) as error:
            log.info("kernel %s: %s", kernel.name, error)
            continue
        if isinstance(cache, KernelCache):  # else Numba keeps it in its own way
            yield kernel, cache, signature


@dataclass(frozen=True)
class KernelCounts:
    """Numbers of kernels of all jobs: shipped, compiled here, missing.

    Attributes
    ----------
    shipped : int
        Come with the release.
    compiled : int
        Were compiled here.
    missing : int
        Are compiled when they are needed.
    """

    shipped: int
    compiled: int
    missing: int


def count_kernels() -> KernelCounts:
    """Count the kernels of all jobs; those of packages that are not installed do not count."""
    codegen = _codegen()
    brought = compiled = missing = 0
    for _, cache, signature in _known(manifest.needed(manifest.jobs())):
        name = cache.file_name(signature, codegen)
        if name is not None and shipped.has(name):
            brought += 1
        elif cache.is_there(signature, codegen):
            compiled += 1
        else:
            missing += 1
    return KernelCounts(brought, compiled, missing)


def processes() -> int:
    """Number of kernels compiled at once: one per processor that this process may use, as memory allows."""
    allowed = os.cpu_count() or 1
    with contextlib.suppress(AttributeError, OSError):  # not every system has it
        allowed = len(os.sched_getaffinity(0))
    with contextlib.suppress(OSError, ValueError):  # Linux: a limit of a container counts
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        allowed = min(allowed, max(1, int(quota) // int(period)))
    most = available_memory() / _BYTES
    return allowed if most >= allowed else max(1, int(most))


class _Pool:
    """Worker processes, each compiling one kernel at a time: first the longest, on which all wait, then in order.

    What another process compiles at the same time, here or on another machine with the same folder, is left to it.

    Attributes
    ----------
    done : int
        Kernels that are compiled.
    fraction : float
        Part of the time of compiling them all that lies behind.
    """

    def __init__(self, kernels: list[_Known]) -> None:
        self._longest = max(kernels, key=lambda known: known[0].seconds)
        self._remaining = sorted(kernels, key=lambda known: known is not self._longest)
        self._codegen = _codegen()
        self._all = sum(kernel.seconds for kernel, _, _ in kernels)
        self.done, self.fraction = 0, 0.0
        self._progress = time.monotonic()
        self._results: queue.SimpleQueue[tuple[_Worker, bool]] = queue.SimpleQueue()
        self._workers: list[_Worker] = []
        self._most = min(len(kernels), processes())
        try:
            self._assign()
        except BaseException:
            self.close()
            raise

    def is_working(self) -> bool:
        """Whether a worker still has something to do, or will have."""
        if any(worker.kernel is not None for worker in self._workers):
            return True
        return bool(self._remaining) and (
            len(self._workers) < self._most or any(worker.is_alive for worker in self._workers)
        )

    def wait(self, seconds: float) -> None:
        """Take an answer, or wait for so long."""
        try:
            worker, is_alive = self._results.get(timeout=seconds)
        except queue.Empty:
            pass
        else:
            worker.is_alive = is_alive
            if worker.kernel is not None:
                self._count(worker.kernel, is_alive)
                worker.end()
        self._assign()

    def close(self) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.close()

    def _count(self, kernel: Kernel, is_done: bool) -> None:
        self.done += is_done
        self._progress = time.monotonic()
        self.fraction = min(1.0, self.fraction + kernel.seconds / (self._all or 1.0))

    def _assign(self) -> None:
        """Give idle workers a kernel each; no more are started than have one."""
        idle = [worker for worker in self._workers if worker.is_alive and worker.kernel is None]
        while idle or len(self._workers) < self._most:
            if (found := self._claim()) is None:
                return
            known, claim = found
            try:
                worker = idle.pop() if idle else self._start(yields=known is not self._longest)
            except BaseException:
                claim.close()
                raise
            if worker is None:
                claim.close()
            elif worker.assign(known[0], claim):
                self._remaining.remove(known)

    def _start(self, yields: bool) -> _Worker | None:
        """Another worker; None where there can be no more, for lack of memory or as the system refuses."""
        if self._workers and available_memory() < _BYTES:
            self._most = len(self._workers)
            return None
        try:
            worker = _Worker(self._results, yields)
        except (OSError, RuntimeError) as error:  # no process, no thread
            log.warning("kernels are compiled by %d processes: %s", len(self._workers), error)
            self._most = len(self._workers)
            return None
        self._workers.append(worker)
        return worker

    def _claim(self) -> tuple[_Known, Claim] | None:
        """The first kernel that nobody compiles or has compiled meanwhile."""
        for known in tuple(self._remaining):
            kernel, cache, signature = known
            if cache.is_there(signature, self._codegen):
                self._remaining.remove(known)
                self._count(kernel, True)
                continue
            claim = cache.claim(signature, self._codegen)
            if claim is None and time.monotonic() - self._progress > _PATIENCE:
                claim, self._progress = Claim(), time.monotonic()
            if claim is not None:
                return known, claim
        return None


class _Worker:
    """A process that runs `drgs_blender.compute.worker`, and the thread that waits for its answers.

    Parameters
    ----------
    results : object
        The queue of its answers.
    yields : bool
        Whether it yields to other programs, as all do but the one that has the longest kernel.

    Raises
    ------
    OSError, RuntimeError
        No more processes, or threads, may be started.
    """

    def __init__(self, results: queue.SimpleQueue[tuple[_Worker, bool]], yields: bool) -> None:
        self.kernel: Kernel | None = None
        self.is_alive, self._claim = True, Claim()
        environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
        if folder := cache_folder().path:
            environment["DRGS_CACHE_DIR"] = str(folder)
        # the package of this very process, whatever lies in the working folder
        flag = "-I" if sys.flags.isolated else "-P"
        paths = [str(closure.PACKAGE.parent), *filter(None, [environment.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        command = [sys.executable, flag, "-m", "drgs_blender.compute.worker"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, encoding="utf-8"
        )
        if yields and hasattr(os, "setpriority"):  # not on Windows
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, os.getpriority(os.PRIO_PROCESS, 0) + _LOWER)
        try:
            threading.Thread(target=self._listen, args=(results,), daemon=True).start()
        except RuntimeError:
            self.close()
            raise

    def assign(self, kernel: Kernel, claim: Claim) -> bool:
        """Have a kernel compiled; False where the process has ended."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps([kernel.module, kernel.name, kernel.arguments]) + "\n")
            self._process.stdin.flush()
        except OSError:
            self.is_alive = False
            claim.close()
            return False
        self.kernel, self._claim = kernel, claim
        return True

    def end(self) -> None:
        """Note that it compiles nothing any more."""
        self._claim.close()
        self.kernel = None

    def close(self) -> None:
        """End it at once: a kernel that it is compiling is lost, nothing else."""
        self._process.kill()
        self._process.wait()
        self.end()

    def _listen(self, results: queue.SimpleQueue[tuple[_Worker, bool]]) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.strip() == "done":
                results.put((self, True))
        results.put((self, False))


def main(argv: list[str] | None = None) -> int:
    """The command line; the return value is the exit code."""
    import argparse  # of no use to an engine, which imports this module when it starts

    parser = argparse.ArgumentParser(prog="python -m drgs_blender.compute.prepare", description=__doc__.split("\n")[0])
    parser.add_argument("jobs", nargs="*", metavar="JOB", help=f"any of {', '.join(manifest.jobs())}")
    parser.add_argument("--all", action="store_true", help="of all jobs")
    options = parser.parse_args(argv)
    if unknown := set(options.jobs) - set(manifest.jobs()):
        parser.error(f"unknown job {', '.join(sorted(unknown))}; there are {', '.join(manifest.jobs())}")
    if not options.jobs and not options.all:
        parser.error("name jobs, or --all")
    shown: list[str] = []
    jobs = list(manifest.jobs()) if options.all else options.jobs

    def show(phase: str, fraction: float) -> None:
        if shown[-1:] != [phase]:
            shown.append(phase)
            print(phase, flush=True)

    try:
        if cache_folder().trouble:  # which was logged
            return EXIT_CANNOT_WRITE
        _compile(jobs, show)
        missing = not_compiled(manifest.needed(jobs))
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except DrgsError as error:
        print(f"prepare: {error}", file=sys.stderr)
        return error.exit_code
    if missing:
        names = ", ".join(sorted({kernel.name for kernel in missing}))
        print(f"{len(missing)} kernels are not compiled, which are when they are called: {names}", file=sys.stderr)
        return EXIT_CANNOT_WRITE if cache_folder().trouble else 1
    print("The engine is ready", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
