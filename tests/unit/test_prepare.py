"""Preparing kernels: in which order, by how many processes, and that nothing is left behind when these fail."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from drgs_blender.compute import folders, manifest, prepare, worker_pool
from drgs_blender.compute.jit import numba
from drgs_blender.core.errors import EXIT_CANNOT_WRITE, Cancelled

ROOT = Path(__file__).resolve().parents[2]


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


def finish(pool: worker_pool.Pool, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while pool.is_working():
        assert time.monotonic() < deadline
        pool.wait(0.05)


def claims(kernels: list[worker_pool.Known]) -> list[object]:
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
        known = None

        def __init__(self, results: object, yields: bool, process: None) -> None:
            self._yields = yields

        def assign(self, known: worker_pool.Known, claim: worker_pool.Claim) -> None:
            started.append((known[0].name, self._yields))
            self.known = known
            claim.close()

    monkeypatch.setattr(worker_pool, "Worker", Recorder)
    monkeypatch.setattr(worker_pool.KernelCache, "is_there", lambda *_: False)
    worker_pool.Pool(list(prepare._known(kernels)), 2)
    longest = max(kernels, key=lambda kernel: kernel.seconds)
    assert started == [(longest.name, False), (first[0].name, True)]


def test_processes_that_were_started_early_compile_and_those_too_many_end(small, monkeypatch) -> None:
    monkeypatch.setattr(prepare, "processes", lambda: 3)
    with prepare._started_early(9) as started:
        processes = list(started)
        pool = worker_pool.Pool(small, 2, started)
    assert len(processes) == 3 and [process.poll() is None for process in processes].count(True) == 2
    with contextlib.closing(pool):
        finish(pool)
        assert {worker._process for worker in pool._workers} <= set(processes)
    assert pool.done == len(small) and None not in [process.poll() for process in processes]


def early() -> list[subprocess.Popen[str]]:
    """Processes that are started early, and that have ended since."""
    with prepare._started_early(2) as started:
        return list(started)


@pytest.mark.slow
def test_processes_are_started_early_only_into_an_empty_cache(small, monkeypatch) -> None:
    """Where some kernels are there, likely all are: then nothing is started, and nothing waits for it."""
    started = early()
    assert len(started) == min(2, prepare.processes())
    assert None not in [process.poll() for process in started]
    with contextlib.closing(worker_pool.Pool(small, 2)) as pool:
        finish(pool)
    assert not early()
    shutil.rmtree(folders.cache_folder().path)
    for owner, name, value in (
        (prepare.shipped, "brings_any", lambda: True),
        (prepare, "is_tested", lambda: False),
        (folders.cache_folder(), "trouble", "sealed: its kernels lie in another folder"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(owner, name, value)
            assert not early()


def test_processes_started_early_end_where_others_compile(small) -> None:
    taken = claims(small)
    with prepare._started_early(1) as started:
        processes = list(started)
        pool = worker_pool.Pool(small, 2, started)
    with contextlib.closing(pool):
        assert len(processes) == 1 and processes[0].poll() is not None
        for claim in taken:
            claim.close()
        finish(pool)  # by processes of its own
        assert pool.done == len(small) and not pool._failures


def test_no_process_is_started_for_what_others_compile(small) -> None:
    taken = claims(small)
    pool = worker_pool.Pool(small, 2)
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
    made: list[worker_pool.subprocess.Popen] = []
    popen = worker_pool.subprocess.Popen

    def record(*args: object, **options: object) -> object:
        made.append(popen(*args, **options))
        return made[-1]

    def refuse(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(worker_pool.subprocess, "Popen", record)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    pool = worker_pool.Pool(small, 2)
    assert not pool.is_working() and len(made) == 1 and made[0].poll() is not None
    free = claims(small)
    assert None not in free
    for claim in free:
        claim.close()


@pytest.mark.slow
def test_what_another_process_has_begun_is_compiled_here_after_some_minutes_without_progress(small) -> None:
    """It may hang, or hold its lock on a machine that is gone."""
    taken = claims(small)
    pool = worker_pool.Pool(small, 2)
    try:
        pool._progress -= 30.0
        pool.wait(0.0)
        assert not pool._workers
        pool._progress -= 600.0
        pool.wait(0.0)
        assert len(pool._workers) == 1
        while pool.is_working():  # minutes in a moment
            pool._progress -= 600.0
            pool.wait(0.05)
        assert not prepare.not_compiled([known[0] for known in small])
    finally:
        pool.close()
        for claim in taken:
            claim.close()


def kill_over(pool: worker_pool.Pool, names: set[str], times: int = 100) -> list[str]:
    """Work, and kill each process that has one of these kernels, so often at most; the kernels of those killed."""
    killed: list[str] = []
    dead: set[int] = set()
    deadline = time.monotonic() + 60.0
    while pool.is_working():
        assert time.monotonic() < deadline
        for worker in pool._workers:
            process = worker._process
            if worker.known and worker.known[0].name in names and process.pid not in dead and len(killed) < times:
                killed.append(worker.known[0].name)
                dead.add(process.pid)
                process.kill()
        pool.wait(0.02)
    return killed


@pytest.mark.parametrize("most", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_process_that_ends_is_replaced(small, caplog, most: int) -> None:
    """As one does that the system kills for lack of memory."""
    with contextlib.closing(worker_pool.Pool(small, most)) as pool:
        assert kill_over(pool, {"mix"}, times=1) == ["mix"]
        assert pool.done == len(small)
    assert not prepare.not_compiled([known[0] for known in small])
    (told,) = caplog.messages
    assert "kernel mix" in told and (os.name == "nt" or "code -9" in told)


def test_a_kernel_over_which_processes_end_is_left_to_its_first_call(small, caplog) -> None:
    with contextlib.closing(worker_pool.Pool(small, 1)) as pool:
        assert kill_over(pool, {"mix"}) == ["mix"] * 2
        assert pool.done == len(small) - 1
    assert [kernel.name for kernel in prepare.not_compiled([known[0] for known in small])] == ["mix"]
    assert len(caplog.messages) == 2 and "kernel mix" in caplog.messages[1] and "when it is called" in caplog.text
    free = claims(small)
    assert None not in free
    for claim in free:
        claim.close()


def test_it_ends_where_every_process_dies(small, monkeypatch, caplog) -> None:
    """As where the engine's packages cannot be loaded any more: that is not found out for each kernel anew."""
    kernels = list(prepare._known(manifest.needed(["import"])))
    monkeypatch.setattr(worker_pool.KernelCache, "is_there", lambda *_: False)
    with contextlib.closing(worker_pool.Pool(kernels, 1)) as pool:
        killed = kill_over(pool, {known[0].name for known in kernels})
        assert 2 < len(killed) < len(kernels) and pool.done == 0
    assert "kernels are compiled when they are called" in caplog.messages[-1]


def test_a_damaged_kernel_is_compiled_again_ahead(small) -> None:
    """Where the power was lost a file may be empty, or end before its time."""
    kernels = [known[0] for known in small]
    with contextlib.closing(worker_pool.Pool(small, 2)) as pool:
        finish(pool)
    paths = sorted(folders.cache_folder().path.rglob("*.kernel"))
    whole = [path.read_bytes() for path in paths]
    assert len(paths) == len(kernels) and not prepare.not_compiled(kernels)
    for left in (-1, 20, 0):
        for path, data in zip(paths, whole, strict=True):
            path.write_bytes(data[:left])
        assert prepare.not_compiled(kernels) == kernels
    with contextlib.closing(worker_pool.Pool(small, 2)) as pool:
        finish(pool)
    assert not prepare.not_compiled(kernels) and 0 not in [path.stat().st_size for path in paths]


def test_kernels_are_prepared_once_in_a_process(small, monkeypatch) -> None:
    """Those of a job that was cancelled are prepared the next time."""
    kernels, looks = [known[0] for known in small], []
    monkeypatch.setattr(prepare, "_prepared", set())
    monkeypatch.setattr(manifest, "needed", lambda jobs: looks.append(list(jobs)) or kernels)
    with pytest.raises(Cancelled):
        prepare.prepare_kernels(["some"], cancelled=lambda: True)
    for _ in range(3):
        prepare.prepare_kernels(["some"])
    assert looks == [["some"]] * 2 and not prepare.not_compiled(kernels)
    prepare.prepare_kernels(["some", "other"])
    assert looks[2:] == [["other"]]


@pytest.fixture
def full(small_disk) -> Path:
    """A folder that can be written, as each process tries, on a disk without room for a few kernels."""
    return small_disk("size=24k") / "kernels"


@pytest.mark.slow
def test_a_full_disk_ends_preparing_and_is_named(full: Path, tmp_path: Path) -> None:
    """Other kernels are not compiled for nothing."""
    record = tmp_path / "record"
    variables = {"DRGS_CACHE_DIR": str(full), "DRGS_SHIPPED": "0", "DRGS_RECORD_KERNELS": str(record)}
    done = subprocess.run(
        [sys.executable, "-m", "drgs_blender.compute.prepare", "import"],
        env=os.environ | variables | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == EXIT_CANNOT_WRITE and "ready" not in done.stdout
    assert done.stderr.count("No space left on device") == 1 and str(full) in done.stderr
    assert record.is_file(), done.stderr
    compiled = [row for row in map(json.loads, record.read_text().splitlines()) if row[3] > 0.0]
    assert 0 < len(compiled) < len(manifest.needed(["import"])) / 2


def test_an_engine_with_a_full_disk_goes_on(full: Path, small, monkeypatch, caplog) -> None:
    kernels = [known[0] for known in small]
    monkeypatch.setenv("DRGS_CACHE_DIR", str(full))
    folders.cache_folder.cache_clear()
    monkeypatch.setattr(manifest, "needed", lambda _: kernels)
    assert not folders.cache_folder().trouble
    (full / "filler").write_bytes(bytes(20 << 10))
    for _ in range(2):  # the second time there is no try
        monkeypatch.setattr(prepare, "_prepared", set())
        prepare.prepare_kernels(["any"])
    assert len(caplog.messages) == 1 and str(full) in folders.cache_folder().trouble
    assert prepare.not_compiled(kernels) == kernels
    (full / "filler").unlink()
    for kernel in kernels:
        manifest.dispatcher(kernel).compile(manifest.signature(kernel))


@pytest.mark.slow
def test_a_sealed_disk_that_has_all_kernels_is_ready(small_disk, tmp_path: Path) -> None:
    disk = small_disk("size=256m")
    with contextlib.suppress(OSError):  # what tests before have compiled
        kept = folders.cache_folder().path
        shutil.copytree(kept, disk / "kernels", ignore=shutil.ignore_patterns("warp", "numba"))
    (disk / "kernels").mkdir(exist_ok=True)
    (disk / "kernels").chmod(0o700)

    def prepared() -> subprocess.CompletedProcess[str]:
        variables = {"DRGS_CACHE_DIR": str(disk / "kernels"), "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-m", "drgs_blender.compute.prepare", "import"]
        return subprocess.run(command, env=os.environ | variables, capture_output=True, text=True)

    assert prepared().returncode == 0
    small_disk("ro")
    done = prepared()
    assert done.returncode == 0 and "ready" in done.stdout and "Read-only file system" in done.stderr


@pytest.mark.skipif((len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1) < 2, reason="one core")
@pytest.mark.parametrize(("limit", "most"), [("100000 100000", 1), ("50000 100000", 1), ("max 100000", 2)])
def test_a_containers_share_of_the_processors_counts(tmp_path: Path, limit: str, most: int) -> None:
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (group / "cpu.max").write_text(f"{limit}\n")
    assert min(prepare.processes(tmp_path), 2) == most


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="no priorities here")
def test_workers_yield_but_the_one_with_the_longest_kernel(small) -> None:
    pool = worker_pool.Pool(small, 2)
    try:
        own = os.getpriority(os.PRIO_PROCESS, 0)
        found = [os.getpriority(os.PRIO_PROCESS, worker._process.pid) for worker in pool._workers]
        assert found == [own, min(own + worker_pool._LOWER, 19)]
    finally:
        pool.close()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_preparing_as_an_exit(number: int) -> None:
    previous = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)}
    try:
        for n in previous:
            signal.signal(n, signal.SIG_DFL)
        prepare._end_at_signals()
        with pytest.raises(SystemExit) as ending:
            signal.raise_signal(number)
        assert ending.value.code == 128 + number
        signal.signal(number, signal.SIG_IGN)
        prepare._end_at_signals()
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        for n, handler in previous.items():
            signal.signal(n, handler)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has such a file")
def test_help_that_cannot_be_written_is_a_failure(monkeypatch, capsys) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert prepare.main(["--help"]) == 73
        with pytest.raises(OSError):
            full.close()
    assert capsys.readouterr().err == "prepare: standard output cannot be written: No space left on device\n"
