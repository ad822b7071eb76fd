"""Kernels over a range: each element once, in whatever pieces, on whatever threads."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from drgs_blender.compute.jit import njit
from drgs_blender.compute.threads import checkpoint, get_num_threads, interruptible, over_range, use_threads


@njit
def _count(first, last, seen):
    for i in range(first, last):
        seen[i] += 1
    return first, last


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("fewest", [1, 7, 1000])
@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17, 999, 5000])
def test_each_element_is_worked_on_once_and_pieces_come_in_order(count, fewest, threads):
    before = get_num_threads()
    seen = np.zeros(count, np.int64)
    try:
        use_threads(min(threads, before))
        pieces = over_range(_count, count, seen, fewest=fewest)
    finally:
        use_threads(before)
    assert (seen == 1).all()
    assert [first for first, _ in pieces] == [0, *(last for _, last in pieces)][: len(pieces)]
    assert not pieces or pieces[-1][1] == count
    if count > fewest:
        assert all(last - first >= min(fewest, count // threads) for first, last in pieces[:-1])


def test_an_error_of_one_piece_is_raised_when_the_others_have_ended(monkeypatch):
    monkeypatch.setattr("drgs_blender.compute.threads.get_num_threads", lambda: 3)
    ended = []

    def kernel(first, last):
        if first == 0:
            raise MemoryError("no room")
        ended.append(last - first)

    with pytest.raises(MemoryError, match="no room"):
        over_range(kernel, 240)
    assert sum(ended) == 230


def test_two_threads_may_ask_at_once():
    seen = [np.zeros(100_000, np.int64) for _ in range(4)]
    asking = [threading.Thread(target=over_range, args=(_count, 100_000, s)) for s in seen]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()
    assert all((s == 1).all() for s in seen)


def test_calls_within_calls_end(monkeypatch):
    """Pool threads that wait for pool threads would wait for ever."""
    monkeypatch.setattr("drgs_blender.compute.threads.get_num_threads", lambda: 2)
    ended = []

    def level(depth):
        def kernel(first, last):
            time.sleep(0.001)  # the other thread takes something
            if depth:
                over_range(level(depth - 1), 8)
            else:
                ended.append(last - first)

        return kernel

    calling = threading.Thread(target=over_range, args=(level(2), 8), daemon=True)
    calling.start()
    calling.join(60)
    assert not calling.is_alive()
    assert sum(ended) == 8**3


@pytest.mark.parametrize("threads", [1, 3])
def test_what_is_interrupted_ends_between_two_pieces(monkeypatch, threads):
    """On all threads, before the rest is done, and only while it is asked for."""
    monkeypatch.setattr("drgs_blender.compute.threads.get_num_threads", lambda: threads)
    done = np.zeros(2400, int)

    def kernel(first, last):
        done[first:last] += 1
        if threading.current_thread() is not threading.main_thread():
            time.sleep(0.05)  # else it may have done everything before it is asked

    def check():
        if done.sum() > 300:
            raise InterruptedError

    with interruptible(check):
        with pytest.raises(InterruptedError):
            over_range(kernel, len(done))
        assert done.sum() < len(done)
        with pytest.raises(InterruptedError):
            checkpoint()
        ended = done.copy()
    time.sleep(0.1)
    assert np.array_equal(done, ended), "no thread works on"
    done[:] = 0
    over_range(kernel, len(done))
    checkpoint()
    assert (done == 1).all()


def test_who_is_interruptible_inside_is_so_outside_again():
    asked = []
    with interruptible(lambda: asked.append("outside")):
        with interruptible(lambda: asked.append("inside")):
            checkpoint()
        checkpoint()
    checkpoint()
    assert asked == ["inside", "outside"]
