"""Hooks of pytest: which part of the tests runs, and the limit that keeps the fast part fast.

``--part=fast`` leaves out the tests marked ``slow`` and holds the others to `SECONDS`. A test that takes longer is
named at the end of the run; one that takes `FAILS` times as long fails. A limit that failed at once would fail by
chance:

- what counts is the processor time of the test, of the programs that ended in it, and of set-up that no other test
  shares, less that of compiling kernels and what those programs had taken before (an engine serves many tests). A busy
  machine and an empty cache of kernels change little of it, and where the processor is slow just then the limit is
  larger, by a loop that is timed;
- a test that only waits uses no processor: it may take `WAITING` times as long by the clock, and longer in proportion
  to how many programs want each processor;
- a test that would fail runs a second time at once, and the smaller figures count: what it or its programs compiled is
  then in the cache;
- set-up that tests share may take `SHARED_SECONDS`; it is charged to the test that happens to come first.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

SECONDS = float(os.environ.get("DRGS_TEST_SECONDS", "3"))
WAITING = 4.0
SHARED_SECONDS = 10.0
#: So many times the limit is no noise of the machine.
FAILS = 2.0
#: Seconds that `loop` takes on the processor for which the limits are meant (2 GHz, of a server).
LOOP_SECONDS = 0.015


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("drgs", "parts of the tests")
    group.addoption("--part", choices=("fast", "slow", "all"), default="all", help="fast ones have limits")
    group.addoption("--lane", choices=("shared", "alone", "all"), default="all", help="tests marked alone, or others")


@pytest.hookimpl(trylast=True)  # after -k and -m, to count what of their choice is left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    part, lane = config.getoption("part"), config.getoption("lane")
    kept, left = [], 0
    for item in items:
        slow = item.get_closest_marker("slow") is not None
        if lane != "all" and (lane == "alone") != (item.get_closest_marker("alone") is not None):
            continue
        if part == "all" or (part == "slow") == slow:
            kept.append(item)
        else:
            left += slow
    chosen = set(kept)
    if gone := [item for item in items if item not in chosen]:
        config.hook.pytest_deselected(items=gone)
    items[:] = kept
    if left and (report := config.getoption("xmlpath", None)):
        Path(report).with_suffix(".left").write_text(str(left), encoding="utf-8")


class Compiling:
    """Processor and other time that kernels take to compile, each with all that it calls."""

    def __init__(self) -> None:
        self.busy = self.wall = 0.0
        self._thread = threading.local()
        self._listens = False

    def listen(self) -> None:
        """Hear of it from Numba as soon as somebody has imported that."""
        if self._listens or (events := sys.modules.get("numba.core.event")) is None:
            return
        hooks = {"on_start": lambda _, event: self.start(), "on_end": lambda _, event: self.end()}
        events.register("numba:compile", type("Heard", (events.Listener,), hooks)())
        self._listens = True

    def start(self) -> None:
        """A function begins to be compiled."""
        deep = self._thread.deep = getattr(self._thread, "deep", 0) + 1
        if deep == 1:
            self._thread.began = time.thread_time(), time.perf_counter()

    def end(self) -> None:
        """It is compiled."""
        self._thread.deep -= 1
        if not self._thread.deep:
            busy, wall = self._thread.began
            self.busy += time.thread_time() - busy
            self.wall += time.perf_counter() - wall


COMPILING = Compiling()


class PaceWarning(pytest.PytestWarning):
    """A test of the fast part is over the limit."""


def loop() -> float:
    """Processor time of a little arithmetic."""
    begun, total = time.process_time(), 0
    for number in range(200_000):
        total += number * number % 7
    return time.process_time() - begun


def slowness() -> float:
    """How many times slower this processor is right now than the one the limits are meant for; 1 for a faster one."""
    return max(1.0, statistics.median(loop() for _ in range(7)) / LOOP_SECONDS)


@dataclass
class Cost:
    """What one run of a test took, in seconds.

    Attributes
    ----------
    busy : float
        Of the processor, by the test and its programs, compilation not counted.
    wall : float
        By the clock, compilation not counted.
    shared : dict of str to float
        Name of a fixture that tests share -> processor time of its set-up.
    """

    busy: float = 0.0
    wall: float = 0.0
    shared: dict[str, float] = field(default_factory=dict)

    def fault(self, times: float = 1.0) -> str:
        """What is wrong with the test that takes more than so many times the limit, "" if nothing."""
        # what waits for others waits longer where many want the processor
        crowd = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)) if hasattr(os, "getloadavg") else 2.0
        if self.busy <= SECONDS * times and self.wall <= SECONDS * times * WAITING * crowd:
            return ""
        limit = SECONDS * times * slowness()
        if self.busy > limit:
            return f"took {self.busy:.1f} s of the processor, more than {limit:.1f}"
        if self.wall > limit * WAITING * crowd:
            return f"took {self.wall:.1f} s, more than {limit * WAITING * crowd:.0f}"
        return ""

    def shared_fault(self, times: float = 1.0) -> str:
        """What is wrong with set-up that it shares with others, "" if nothing."""
        for name, seconds in self.shared.items():
            limit = SHARED_SECONDS * times
            if seconds > limit and seconds > (limit := limit * slowness()):
                return f"needs {name}, whose set-up took {seconds:.1f} s of the processor, more than {limit:.1f}"
        return ""


COST = pytest.StashKey[Cost]()


def programs() -> dict[int, float]:
    """Process id of each program that this process has started and not waited for -> its processor time; on Linux."""
    found: dict[int, float] = {}
    with contextlib.suppress(OSError):  # it, or the thread that started it, has just ended; no other system has these
        for thread in os.listdir("/proc/self/task"):
            for number in _read(f"/proc/self/task/{thread}/children").split():
                fields = _read(f"/proc/{number}/stat").rpartition(")")[2].split()
                found[int(number)] = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return found


def _read(path: str) -> str:
    """Text of a small file."""
    with open(path) as file:
        return file.read()


class Stopwatch:
    """Time since it was made, compilation not counted."""

    def __init__(self) -> None:
        COMPILING.listen()
        self._programs, self._before = programs(), self._now()

    @staticmethod
    def _now() -> tuple[float, float, float]:
        spent = os.times()
        ended = spent.children_user + spent.children_system
        return time.process_time() - COMPILING.busy, ended, time.perf_counter() - COMPILING.wall

    def read(self) -> tuple[float, float]:
        """Processor time and time by the clock."""
        busy, ended, wall = (now - before for now, before in zip(self._now(), self._before))
        if ended and self._programs:
            there = programs()
            ended -= sum(seconds for number, seconds in self._programs.items() if number not in there)
        return busy + ended, wall


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    watch = Stopwatch()
    try:
        return (yield)
    finally:
        busy, wall = watch.read()
        cost = item.stash.setdefault(COST, Cost())
        cost.busy, cost.wall = cost.busy + busy, cost.wall + wall


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef, request: pytest.FixtureRequest) -> Iterator[None]:
    watch = Stopwatch()
    try:
        return (yield)
    finally:
        busy, wall = watch.read()
        cost = getattr(request, "_pyfuncitem").stash.setdefault(COST, Cost())  # noqa: B009
        if fixturedef.scope == "function":
            cost.busy, cost.wall = cost.busy + busy, cost.wall + wall
        else:
            cost.shared[fixturedef.argname] = busy


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test of the fast part, twice if it seems too slow."""
    if item.config.getoption("part") != "fast":
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports, cost = measured(item, nextitem)
    fault = cost.fault(FAILS)
    if fault and all(report.passed for report in reports):
        again, cost_again = measured(item, nextitem)
        if all(report.passed for report in again):  # some tests cannot run twice in a process
            reports, fault = again, cost_again.fault(FAILS)
    if all(report.passed for report in reports):
        advice = "make it faster, or mark it `slow` (see tests/pace.py)"
        if fault := fault or cost.shared_fault(FAILS):
            call = next(report for report in reports if report.when == "call")
            call.outcome, call.longrepr = "failed", f"{item.nodeid} {fault}: {advice}"
        elif fault := cost.fault() or cost.shared_fault():
            item.warn(PaceWarning(f"{item.nodeid} {fault}: {advice}"))
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def measured(item: pytest.Item, nextitem: pytest.Item | None) -> tuple[list[pytest.TestReport], Cost]:
    """Run a test; its reports and what it took."""
    cost = item.stash[COST] = Cost()
    return runtestprotocol(item, log=False, nextitem=nextitem), cost
