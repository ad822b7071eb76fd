"""Worker processes that compile kernels ahead, and what becomes of kernels over which they end."""

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
from collections import Counter
from typing import Any

from ..core import own_python
from ..core.memory import available_memory
from . import closure
from .folders import cache_folder
from .kernel_cache import Claim, KernelCache
from .manifest import Kernel

log = logging.getLogger(__name__)
#: Seconds without any progress after which what another process has begun is compiled here as well.
_PATIENCE = 180.0
#: Of memory, which a process that compiles takes.
BYTES = 700 << 20
#: Processes that compile a kernel, where they end over it.
_ATTEMPTS = 2
#: Processes that end one after the other, with no kernel compiled, after which no more are started.
_DEATHS = 6
#: Seconds for a process that has closed its output to end.
_END = 5.0
#: How much lower the priority of workers that yield is, on the scale of ``nice``.
_LOWER = 5
#: A kernel, its cache and its argument types.
Known = tuple[Kernel, KernelCache, tuple[Any, ...]]


def target_codegen() -> Any:
    """What generates code for the processor here, in Numba."""
    from .jit import numba

    return numba.core.registry.cpu_target.target_context.codegen()


class Pool:
    """Worker processes, each compiling one kernel at a time: first the longest, on which all wait, then in order.

    What another process compiles at the same time, here or on another machine with the same folder, is left to it. A
    worker that ends is replaced; a kernel over which they end is left to its first call. When one cannot write, all is.

    Parameters
    ----------
    kernels : list of tuple
        What is not compiled yet.
    most : int
        Of processes.
    started : list of subprocess.Popen, optional
        By `start_process`, before it was known what is to be compiled. Those that are used are taken out of the list.

    Attributes
    ----------
    done : int
        Kernels that are compiled.
    fraction : float
        Part of the time of compiling them all that lies behind.
    """

    def __init__(self, kernels: list[Known], most: int, started: list[subprocess.Popen[str]] | None = None) -> None:
        self._longest = max(kernels, key=lambda known: known[0].seconds)
        self._remaining = sorted(kernels, key=lambda known: known is not self._longest)
        self._codegen = target_codegen()
        self._all = sum(kernel.seconds for kernel, _, _ in kernels)
        self.done, self.fraction = 0, 0.0
        self._progress = time.monotonic()
        self._results: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._workers: list[Worker] = []
        self._started = [] if started is None else started
        self._most = min(len(kernels), most)
        self._failures: Counter[Kernel] = Counter()
        self._deaths = 0
        try:
            self._assign()
        except BaseException:
            self.close()
            raise

    def is_working(self) -> bool:
        """Whether a worker still has something to do, or will have."""
        return any(worker.known is not None for worker in self._workers) or (bool(self._remaining) and self._most > 0)

    def wait(self, seconds: float) -> None:
        """Take an answer, or wait for so long."""
        try:
            worker, answer = self._results.get(timeout=seconds)
        except queue.Empty:
            pass
        else:
            self._take(worker, answer)
        self._assign()

    def close(self) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.close()

    def _take(self, worker: Worker, answer: str | None) -> None:
        """Note what a worker says; None where it has ended."""
        known = worker.known
        worker.end()
        if answer is None:
            self._workers.remove(worker)
            worker.close()
            if known is not None:
                self._died(known, worker.exit_code)
        elif answer:
            self._most = 0
            self._remaining.clear()
            self.close()
            cache_folder().give_up(answer)
        elif known is not None:
            self._deaths = 0
            self._count(known[0], True)

    def _died(self, known: Known, code: int | None) -> None:
        """Try a kernel once more over which a process has ended, as one does for lack of memory or a fault of LLVM."""
        kernel = known[0]
        self._failures[kernel] += 1
        self._deaths += 1
        text = f"a process that compiled kernel {kernel.name} ended with code {code}"
        if self._deaths >= _DEATHS:
            self._most = 0
            log.warning("%s, as %d others did: kernels are compiled when they are called", text, self._deaths - 1)
        elif self._failures[kernel] < _ATTEMPTS:
            self._remaining.insert(0, known)
            log.warning("%s: another one tries", text)
        else:
            self._count(kernel, False)
            log.warning("%s, the second time: it is compiled when it is called", text)

    def _count(self, kernel: Kernel, is_done: bool) -> None:
        self.done += is_done
        self._progress = time.monotonic()
        self.fraction = min(1.0, self.fraction + kernel.seconds / (self._all or 1.0))

    def _assign(self) -> None:
        """Give idle workers a kernel each; no more are started than have one."""
        idle = [worker for worker in self._workers if worker.known is None]
        while self._most > 0 and (idle or len(self._workers) < self._most):
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
            else:
                worker.assign(known, claim)
                self._remaining.remove(known)

    def _start(self, yields: bool) -> Worker | None:
        """Another worker; None where there can be no more, for lack of memory or as the system refuses."""
        if self._workers and available_memory() < BYTES:
            self._most = len(self._workers)
            return None
        try:
            worker = Worker(self._results, yields, self._started.pop() if self._started else None)
        except (OSError, RuntimeError) as error:  # no process, no thread
            log.warning("kernels are compiled by %d processes: %s", len(self._workers), error)
            self._most = len(self._workers)
            return None
        self._workers.append(worker)
        return worker

    def _claim(self) -> tuple[Known, Claim] | None:
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


def start_process() -> subprocess.Popen[str]:
    """Start a process that runs `drgs_blender.compute.worker`.

    Raises
    ------
    OSError
    """
    environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
    if folder := cache_folder().path:
        environment["DRGS_CACHE_DIR"] = str(folder)
    # the package of this very process, whatever lies in the working folder
    flag = "-I" if sys.flags.isolated else "-P"
    paths = [str(closure.PACKAGE.parent), *filter(None, [environment.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    command = [*own_python.command(flag), "-m", "drgs_blender.compute.worker"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, encoding="utf-8")


def end_process(process: subprocess.Popen[str]) -> None:
    """End it at once."""
    process.kill()
    process.wait()
    if process.stdin is not None:
        with contextlib.suppress(OSError):  # what it has not read
            process.stdin.close()


class Worker:
    """A process that compiles, and the thread that waits for its answers.

    Parameters
    ----------
    results : object
        The queue of its answers.
    yields : bool
        Whether it yields to other programs, as all do but the one that has the longest kernel.
    process : subprocess.Popen, optional
        One that was started before.

    Raises
    ------
    OSError, RuntimeError
        No more processes, or threads, may be started.
    """

    def __init__(
        self, results: queue.SimpleQueue[Answer], yields: bool, process: subprocess.Popen[str] | None = None
    ) -> None:
        self.known: Known | None = None
        self._claim = Claim()
        self._process = process or start_process()
        if yields and hasattr(os, "setpriority"):  # not on Windows
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, os.getpriority(os.PRIO_PROCESS, 0) + _LOWER)
        try:
            threading.Thread(target=self._listen, args=(results,), daemon=True).start()
        except RuntimeError:
            self.close()
            raise

    @property
    def exit_code(self) -> int | None:
        """Of the process; that of a signal is negative, None while it lives."""
        return self._process.returncode

    def assign(self, known: Known, claim: Claim) -> None:
        """Have a kernel compiled."""
        self.known, self._claim = known, claim
        kernel = known[0]
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has ended, as `_listen` says in a moment
            self._process.stdin.write(json.dumps([kernel.module, kernel.name, kernel.arguments]) + "\n")
            self._process.stdin.flush()

    def end(self) -> None:
        """Note that it compiles nothing any more."""
        self._claim.close()
        self.known = None

    def close(self) -> None:
        """End it at once: a kernel that it is compiling is lost, nothing else."""
        end_process(self._process)
        self.end()

    def _listen(self, results: queue.SimpleQueue[Answer]) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.strip() == "done":
                results.put((self, ""))
            elif line.startswith("failed: "):
                results.put((self, line.removeprefix("failed: ").strip()))
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END)  # its exit code comes after the end of its output
        results.put((self, None))


#: Of a worker: "" for what it has compiled, why it cannot write, None when it has ended.
Answer = tuple[Worker, str | None]
