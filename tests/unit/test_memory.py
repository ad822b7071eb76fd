"""Memory that a process may use, of a machine and of containers within it."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.memory import available_memory, filled_columns, give_back, sparse_zeros, total_memory

GIB = 1 << 30


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def system(root: Path, free: int, own: str, groups: dict[str, tuple[str, int]]) -> Path:
    """Files as Linux shows them: `free` bytes, a process in the group `own`, limit and use by group."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/meminfo").write_text(f"MemTotal: {1 << 40} kB\nMemFree: 1 kB\nMemAvailable: {free >> 10} kB\n")
    (root / "proc/self/cgroup").write_text(f"12:cpu:/old\n0::{own}\n")
    for name, (limit, used) in groups.items():
        folder = root / "sys/fs/cgroup" / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text(f"{used}\n")
    return root


def test_without_a_limit_what_the_system_says_counts(tmp_path):
    root = system(tmp_path, 3 * GIB, "/", {})
    assert available_memory(root) == 3 * GIB
    assert total_memory(root) == total_memory(tmp_path / "none")


@pytest.mark.parametrize("own", ["/", "/slice/job", "/../elsewhere"])
def test_a_limit_of_the_container_counts(tmp_path, own):
    root = system(tmp_path, 3 * GIB, own, {"": (str(1 * GIB), GIB // 4), "slice": ("max", GIB)})
    assert total_memory(root) == GIB and available_memory(root) == GIB - GIB // 4


def test_the_least_of_nested_limits_counts(tmp_path):
    groups = {"": (str(4 * GIB), 0), "slice": (str(2 * GIB), GIB), "slice/job": (str(3 * GIB), 0)}
    root = system(tmp_path, 8 * GIB, "/slice/job", groups)
    assert available_memory(root) == GIB and total_memory(root) <= 2 * GIB


def test_a_container_over_its_limit_has_nothing_left(tmp_path):
    assert available_memory(system(tmp_path, GIB, "/", {"": ("1000", 2000)})) == 0


@pytest.mark.skipif(sys.platform == "win32", reason="Windows says it in another way")
def test_a_system_that_does_not_say_sets_no_limit(tmp_path, monkeypatch):
    monkeypatch.delattr("os.sysconf", raising=False)
    assert available_memory(tmp_path) == total_memory(tmp_path) == float("inf")


@pytest.mark.skipif(sys.platform != "linux", reason="reads files of Linux")
def test_of_this_machine():
    assert 1 << 20 < available_memory() <= total_memory() < 1 << 50


@pytest.mark.skipif(sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="not glibc")
def test_what_lies_free_between_arrays_in_use_is_given_back():
    parts = [np.ones(96 << 10, np.uint8) for _ in range(400)]
    last = parts.pop()
    before = resident()
    parts.clear()
    give_back()
    assert before - resident() > 30 << 20 and last.all()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere they are NumPy's")
def test_of_sparse_zeros_only_what_is_written_takes_memory():
    before = resident()
    picture = sparse_zeros((2048, 2048, 8))
    assert picture.dtype == np.float32 and picture.flags.c_contiguous and picture.flags.writeable
    picture[:, :256] = 1.0  # a part of each row, in each of the huge pages that NumPy would ask for
    assert picture.nbytes // 10 < resident() - before < picture.nbytes // 6
    assert picture.sum() == 2048 * 256 * 8
    del picture
    assert resident() - before < 4 << 20


def test_small_sparse_zeros_are_those_of_numpy():
    small = sparse_zeros((3, 4))
    assert small.flags.owndata and small.dtype == np.float32 and not small.any()
    assert sparse_zeros((0, 3)).shape == (0, 3)


def test_filled_columns_are_those_between_the_first_and_the_last_with_a_value():
    rows = np.zeros((3, 9, 4, 3), np.float32)
    assert rows[:, filled_columns(rows[:, :, 1])].size == 0
    rows[2, 3, 1, 2], rows[0, 6, 1, 0], rows[1, 8, 2, 0] = -1e-30, np.nan, 5.0  # the last is another part's
    assert filled_columns(rows[:, :, 1]) == slice(3, 7)
