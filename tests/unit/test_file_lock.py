"""Locks on files: one holder at a time, free when the holder ends, and errors where a drive has none."""

from __future__ import annotations

import errno
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drgs_blender.cli import session, session_link
from drgs_blender.compute.kernel_cache import Claim
from drgs_blender.core.errors import WriteError
from drgs_blender.core.file_lock import FileLock

HOLDER = """
import sys, time
from pathlib import Path
from drgs_blender.core.file_lock import FileLock
lock = FileLock(Path(sys.argv[1]))
assert lock.acquire()
print("locked", flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock on ``tmp_path / "lock"``."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "lock")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
    assert process.stdout is not None and process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_lock_has_one_holder(holder, tmp_path):
    lock = FileLock(tmp_path / "lock")
    began = time.monotonic()
    assert not lock.acquire()
    assert not lock.acquire(patience=0.2) and time.monotonic() - began >= 0.2
    assert Claim.of(tmp_path / "lock") is None
    lock.close()


def test_the_lock_of_a_process_that_was_killed_is_free(holder, tmp_path):
    holder.kill()
    holder.wait()
    lock = FileLock(tmp_path / "lock")
    assert lock.acquire(patience=5)
    assert Claim.of(tmp_path / "lock") is None
    lock.close()
    claim = Claim.of(tmp_path / "lock")
    assert claim is not None
    claim.close()


def test_a_drive_without_locks(monkeypatch, tmp_path):
    """Kernels are compiled all the same; a session, which relies on its lock, says what is wrong."""
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    claim = Claim.of(tmp_path / "lock")
    assert claim is not None
    claim.close()
    assert session_link.is_running(tmp_path)  # what runs is not taken for ended
    with pytest.raises(WriteError, match="No locks available"):
        session._claim(tmp_path)


def test_a_lock_that_is_dropped_is_released(tmp_path):
    lock = FileLock(tmp_path / "lock")
    assert lock.acquire()
    del lock
    with FileLock(tmp_path / "lock") as other:
        assert other.acquire()
    with FileLock(tmp_path / "lock") as other:
        assert other.acquire()
