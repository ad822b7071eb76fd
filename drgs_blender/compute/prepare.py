"""Ahead-of-time compilation of the kernels that jobs need, in as many processes as there are processors.

python -m drgs_blender.compute.prepare [--all | JOB ...]
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen

from ..core.errors import EXIT_CANNOT_WRITE, EXIT_INTERRUPTED, Cancelled, DrgsError
from ..core.memory import available_memory
from ..core.phases import PREPARING
from ..core.switches import is_on

try:
    from . import manifest, shipped
except DrgsError as error:  # variables of Numba
    if __name__ != "__main__":
        raise
    print(f"prepare: {error}", file=sys.stderr)
    sys.exit(error.exit_code)
from .folders import cache_folder
from .kernel_cache import ENDING, KernelCache
from .kernel_compiler import is_tested
from .manifest import Kernel
from .worker_pool import BYTES as _BYTES
from .worker_pool import Known, Pool, end_process, start_process, target_codegen

log = logging.getLogger(__name__)
#: The one text for it, in Blender and on the command line.
PHASE = PREPARING
_POLL = 0.1
_REPORT = 0.4
_ROOT = Path("/")
#: Jobs that were prepared in this process.
_prepared: set[str] = set()
Progress = Callable[[str, float], None]


def prepare_kernels(
    jobs: Iterable[str], progress: Progress | None = None, cancelled: Callable[[], bool] | None = None
) -> None:
    """Compile what `jobs` need and the cache lacks; return at once where nothing is missing.

    A process does so once per job. A worker that ends, or cannot write what it compiled, leaves it to the first call of
    the kernel: this never fails for lack of a cache.

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
    if not is_on("DRGS_PREPARE", True):
        return
    jobs = [job for job in jobs if job not in _prepared]
    if jobs:
        _compile(jobs, progress, cancelled)
        _prepared.update(jobs)


def _compile(
    jobs: Iterable[str],
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> None:
    if cache_folder().path is None or cache_folder().has_failed:
        return
    kernels = manifest.needed(jobs)
    with _started_early(len(kernels)) as started:
        missing = _missing(kernels)
        if not missing:
            return
        pool = Pool(missing, processes(), started)
    with contextlib.closing(pool):
        reported = 0.0
        while pool.is_working():
            if cancelled is not None and cancelled():
                raise Cancelled
            if progress is not None and time.monotonic() - reported >= _REPORT:
                reported = time.monotonic()
                progress(f"{PHASE}, {min(pool.done + 1, len(missing))} of {len(missing)}", pool.fraction)
            pool.wait(_POLL)


@contextlib.contextmanager
def _started_early(most: int) -> Iterator[list[Popen[str]]]:
    """Processes that load Numba while it is found out what they have to compile; those not taken by then end.

    There are none where some kernels are there.
    """
    started: list[Popen[str]] = []
    try:
        with contextlib.suppress(OSError):  # the pool meets it again, and says so
            if _keeps_none():
                for _ in range(min(most, processes())):
                    started.append(start_process())
        yield started
    finally:
        while started:  # the pool takes no ended ones
            end_process(started.pop())


def _keeps_none() -> bool:
    """Whether kernels will be kept, and none is yet."""
    cache = cache_folder()
    if cache.path is None or cache.trouble or shipped.brings_any() or not is_tested():
        return False
    return not any(cache.path.glob(f"*/*{ENDING}"))


def not_compiled(kernels: Iterable[Kernel]) -> list[Kernel]:
    """The kernels among these that are not compiled yet and can be compiled ahead."""
    return [kernel for kernel, _, _ in _missing(kernels)]


def _missing(kernels: Iterable[Kernel]) -> list[Known]:
    codegen = target_codegen()
    return [known for known in _known(kernels) if not known[1].is_there(known[2], codegen)]


def _known(kernels: Iterable[Kernel]) -> Iterator[Known]:
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
    jobs : tuple of str
        Jobs of `manifest.jobs` that need one of those.
    """

    shipped: int
    compiled: int
    missing: int
    jobs: tuple[str, ...] = ()


def count_kernels() -> KernelCounts:
    """Count the kernels of all jobs; those of packages that are not installed do not count."""
    codegen = target_codegen()
    brought = compiled = 0
    missing: set[Kernel] = set()
    for kernel, cache, signature in _known(manifest.needed(manifest.jobs())):
        name = cache.file_name(signature, codegen)
        if name is not None and shipped.has(name):
            brought += 1
        elif cache.is_there(signature, codegen):
            compiled += 1
        else:
            missing.add(kernel)
    jobs = tuple(job for job, kernels in manifest.jobs().items() if missing.intersection(kernels))
    return KernelCounts(brought, compiled, len(missing), jobs)


def processes(root: Path = _ROOT) -> int:
    """Number of kernels compiled at once: one per processor that this process may use, as memory allows.

    Parameters
    ----------
    root : Path
        Folder that holds `sys` and `proc`.
    """
    allowed = os.cpu_count() or 1
    with contextlib.suppress(AttributeError, OSError):  # not every system has it
        allowed = len(os.sched_getaffinity(0))
    with contextlib.suppress(OSError, ValueError):  # Linux: a limit of a container counts
        quota, period = (root / "sys/fs/cgroup/cpu.max").read_text().split()
        allowed = min(allowed, max(1, int(quota) // int(period)))
    most = available_memory(root) / _BYTES
    return allowed if most >= allowed else max(1, int(most))


def _print_help(text: str) -> int:
    """Print the help, of which argparse would not say that it cannot be written; the exit code."""
    try:
        print(text, end="", flush=True)
    except OSError as error:
        sys.stdout = None
        print(f"prepare: standard output cannot be written: {error.strerror}", file=sys.stderr)
        return EXIT_CANNOT_WRITE
    return 0


def main(argv: list[str] | None = None) -> int:
    """The command line; the return value is the exit code."""
    import argparse  # of no use to an engine, which imports this module when it starts

    parser = argparse.ArgumentParser(
        prog="python -m drgs_blender.compute.prepare", description=__doc__.split("\n")[0], add_help=False
    )
    parser.add_argument("jobs", nargs="*", metavar="JOB", help=f"any of {', '.join(manifest.jobs())}")
    parser.add_argument("-h", "--help", action="store_true", help="show this help message and exit")
    parser.add_argument("--all", action="store_true", help="of all jobs")
    options = parser.parse_args(argv)
    if options.help:
        return _print_help(parser.format_help())
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
        if not cache_folder().trouble:  # else it was logged, and what would be compiled now would not be kept
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


def _end_at_signals() -> None:
    """Let SIGTERM and SIGHUP end the workers, too; one that is ignored, as by ``nohup``, stays so."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda which, _: sys.exit(128 + which))


if __name__ == "__main__":
    _end_at_signals()
    sys.exit(main())
