"""Preparing kernels: in which order, by how many processes, and that nothing is left behind when these fail."""

from __future__ import annotations

import os
import threading
import time

import pytest

from drgs_blender.compute import folders, manifest, prepare
from drgs_blender.compute.jit import numba


@pytest.fixture
def small(tmp_path, monkeypatch):
    """Two kernels that compile in a moment, with an empty cache folder."""
    monkeypatch.setenv("DRGS_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("DRGS_SHIPPED", "0")
    folders.cache_folder.cache_clear()
    names = {"mix", "_number"}
    found = {kernel.name: kernel for kernel in manifest.needed(manifest.jobs()) if kernel.name in names}
    assert set(found) == names
    yield prepare._missing(found.values())
    folders.cache_folder.cache_clear()


def finish(pool: prepare._Pool, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while pool.is_working():
        assert time.monotonic() < deadline
        pool.wait(0.05)


def claims(kernels: list[prepare._Known]) -> list[object]:
    codegen = numba.core.registry.cpu_target.target_context.codegen()
    return [cache.claim(signature, codegen) for _, cache, signature in kernels]


def test_the_first_job_comes_first_beside_the_longest_kernel(monkeypatch) -> None:
    """The order does not depend on the hashes of the names, as that of a set does."""
    kernels = manifest.needed(["import", "frame"])
    first = manifest.needed(["import"])
    assert kernels[: len(first)] == first and len(set(kernels)) == len(kernels)
    assert manifest.needed(["frame", "import"]) != kernels
    started: list[tuple[str, bool]] = []

    class Recorder:
        is_alive, kernel = True, None

        def __init__(self, results: object, yields: bool) -> None:
            self._yields = yields

        def assign(self, kernel: manifest.Kernel, claim: prepare.Claim) -> bool:
            started.append((kernel.name, self._yields))
            self.kernel = kernel
            claim.close()
            return True

    monkeypatch.setattr(prepare, "_Worker", Recorder)
    monkeypatch.setattr(prepare, "processes", lambda: 2)
    monkeypatch.setattr(prepare.KernelCache, "is_there", lambda *_: False)
    prepare._Pool(list(prepare._known(kernels)))
    longest = max(kernels, key=lambda kernel: kernel.seconds)
    assert started == [(longest.name, False), (first[0].name, True)]


def test_no_process_is_started_for_what_others_compile(small) -> None:
    taken = claims(small)
    pool = prepare._Pool(small)
    try:
        assert pool.is_working() and not pool._workers
        for claim in taken:
            claim.close()
        finish(pool)
        assert pool.done == len(small) and not prepare.not_compiled([known[0] for known in small])
    finally:
        pool.close()


def test_processes_or_threads_that_cannot_be_started_leave_nothing_behind(small, monkeypatch) -> None:
    """The job goes on, its kernels are compiled when they are called; others may compile them at once."""
    made: list[prepare.subprocess.Popen] = []
    popen = prepare.subprocess.Popen

    def record(*args: object, **options: object) -> object:
        made.append(popen(*args, **options))
        return made[-1]

    def refuse(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(prepare.subprocess, "Popen", record)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    pool = prepare._Pool(small)
    assert not pool.is_working() and len(made) == 1 and made[0].poll() is not None
    free = claims(small)
    assert None not in free
    for claim in free:
        claim.close()


def test_it_ends_when_all_processes_have_died(small, monkeypatch) -> None:
    monkeypatch.setattr(prepare, "processes", lambda: 1)
    pool = prepare._Pool(small)
    try:
        pool._workers[0]._process.kill()
        finish(pool)
        assert pool.done < len(small)
    finally:
        pool.close()


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="no priorities here")
def test_workers_yield_but_the_one_with_the_longest_kernel(small, monkeypatch) -> None:
    monkeypatch.setattr(prepare, "processes", lambda: 2)
    pool = prepare._Pool(small)
    try:
        own = os.getpriority(os.PRIO_PROCESS, 0)
        found = [os.getpriority(os.PRIO_PROCESS, worker._process.pid) for worker in pool._workers]
        assert found == [own, min(own + prepare._LOWER, 19)]
    finally:
        pool.close()
