"""tests/pace.py: which part of the tests runs, and that a test of the fast part cannot be slow unnoticed."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import pace
import pytest

import drgs_blender.compute.jit  # noqa: F401  # else Numba comes with a test's test, is forgotten after it and breaks

pytest_plugins = ["pytester"]

HEAD = """
import time
import pytest

def work(seconds):
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass
"""


@pytest.fixture
def outcome(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[dict, str]]:
    """Function that runs tests that fail above 50 ms (set-up 100 ms); returns the counts and what was printed."""
    monkeypatch.setattr(pace, "SECONDS", 0.05 / pace.FAILS)
    monkeypatch.setattr(pace, "WAITING", 2.0)
    monkeypatch.setattr(pace, "SHARED_SECONDS", 0.1 / pace.FAILS)
    monkeypatch.setattr(pace, "slowness", lambda: 1.0)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0), raising=False)
    pytester.makeconftest("from pace import *")
    pytester.makeini("[pytest]\nmarkers = slow\n alone\naddopts = --strict-markers -p no:cacheprovider -p no:xdist")

    def run(text: str, *options: str) -> tuple[dict, str]:
        pytester.makepyfile(HEAD + text)
        result = pytester.runpytest_inprocess(*options)
        counts = result.parseoutcomes()
        counts.pop("warnings", None)
        return counts, result.stdout.str()

    return run


def test_a_test_that_computes_for_long_fails_unless_it_is_marked(outcome) -> None:
    text = "def test_long(): work(0.08)\n@pytest.mark.slow\ndef test_marked(): work(0.08)\ndef test_short(): pass\n"
    counts, said = outcome(text, "--part=fast")
    assert counts == {"failed": 1, "passed": 1, "deselected": 1}
    assert "test_long took 0.1 s of the processor" in said and "mark it `slow`" in said
    assert outcome(text, "--part=slow")[0] == {"passed": 1, "deselected": 2}
    assert outcome(text)[0] == {"passed": 3}


def test_the_limit_is_three_seconds_and_twice_that_is_no_chance() -> None:
    assert pace.FAILS == 2.0 and (pace.SECONDS == 3.0 or "DRGS_TEST_SECONDS" in os.environ)


def test_a_test_that_takes_a_little_too_long_is_named(outcome) -> None:
    """It does not fail: by how little, the machine decides."""
    counts, said = outcome("def test_long(): work(0.03)\ndef test_short(): pass\n", "--part=fast")
    assert counts == {"passed": 2}
    assert "PaceWarning" in said and "test_long took 0.0 s" in said and "test_short took" not in said


def test_a_test_that_waits_for_long_fails_too_but_not_on_a_busy_machine(outcome, monkeypatch) -> None:
    text = "def test_it(): time.sleep(0.15)\n"
    assert outcome(text, "--part=fast")[0] == {"failed": 1}
    monkeypatch.setattr(os, "getloadavg", lambda: (2.0 * os.cpu_count(), 0.0, 0.0), raising=False)
    assert outcome(text, "--part=fast")[0] == {"passed": 1}


def test_programs_that_a_test_runs_count(outcome, monkeypatch) -> None:
    """As they would for whoever waits for the tests; and a slow processor has more time for all."""
    text = "import subprocess, sys\ndef test_it(): subprocess.run([sys.executable, '-c', {!r}])\n".format(
        "import time\nwhile time.process_time() < 0.3: pass"
    )
    assert outcome(text, "--part=fast")[0] == {"failed": 1}
    monkeypatch.setattr(pace, "slowness", lambda: 20.0)
    assert outcome(text, "--part=fast")[0] == {"passed": 1}


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere programs that run are not known")
def test_a_program_that_others_kept_busy_costs_the_test_that_ends_it_nothing(outcome) -> None:
    """As an engine that has rendered for many tests; what it does for the last one counts."""
    program = "import sys, time\nfor _ in sys.stdin:\n    end = time.process_time() + 0.3\n"
    program += "    while time.process_time() < end: pass\n    print(flush=True)\n"
    text = (
        f"import subprocess, sys\nprogram = subprocess.Popen([sys.executable, '-c', {program!r}], text=True,\n"
        "    stdin=subprocess.PIPE, stdout=subprocess.PIPE)\n"
        "def ask():\n    print(file=program.stdin, flush=True)\n    program.stdout.readline()\n"
        "ask()\n"
        "def test_end():\n    {}program.communicate()\n"
    )
    assert outcome(text.format(""), "--part=fast")[0] == {"passed": 1}
    assert outcome(text.format("ask(); "), "--part=fast")[0] == {"failed": 1}


def test_slowness_is_that_of_the_loop(monkeypatch) -> None:
    for seconds, slowness in ((0.5 * pace.LOOP_SECONDS, 1.0), (3 * pace.LOOP_SECONDS, 3.0)):
        monkeypatch.setattr(pace, "loop", lambda seconds=seconds: seconds)
        assert pace.slowness() == pytest.approx(slowness)


def test_set_up_counts_and_may_take_longer_where_it_is_shared(outcome) -> None:
    text = (
        "@pytest.fixture(scope={!r})\ndef thing(): work({})\n"
        "def test_a(thing): pass\ndef test_b(thing): pass\ndef test_c(): pass\n"
    )
    counts, said = outcome(text.format("function", 0.08), "--part=fast")
    assert counts == {"failed": 2, "passed": 1} and "test_b took" in said
    assert outcome(text.format("module", 0.08), "--part=fast")[0] == {"passed": 3}
    counts, said = outcome(text.format("session", 0.15), "--part=fast")
    assert counts == {"failed": 1, "passed": 2} and "needs thing, whose set-up took" in said


def test_kernels_that_are_compiled_do_not_count(outcome) -> None:
    text = (
        "from numba.core.event import trigger_event\n"
        "def test_it():\n"
        "    with trigger_event('numba:compile'):\n"
        "        with trigger_event('numba:compile'): work(0.05)\n"
        "        work(0.05)\n"
    )
    assert outcome(text, "--part=fast")[0] == {"passed": 1}


def test_what_is_slow_only_the_first_time_passes(outcome) -> None:
    """What other programs compile, and what is read from a cold disk."""
    text = "runs = []\ndef test_it():\n    runs.append(1)\n    work(0.08 if len(runs) == 1 else 0)\n"
    assert outcome(text, "--part=fast")[0] == {"passed": 1}


def test_a_failure_is_shown_as_it_was(outcome) -> None:
    text = "runs = []\ndef test_it():\n    runs.append(1)\n    work(0.08)\n    assert len(runs) == 2\n"
    counts, said = outcome(text, "--part=fast")
    assert counts == {"failed": 1} and "assert 1 == 2" in said and "took" not in said


def test_every_test_runs_in_one_lane(outcome) -> None:
    text = "@pytest.mark.alone\ndef test_a(): pass\ndef test_b(): pass\ndef test_c(): pass\n"
    assert outcome(text, "--lane=alone")[0] == {"passed": 1, "deselected": 2}
    assert outcome(text, "--lane=shared")[0] == {"passed": 2, "deselected": 1}


def test_slow_tests_that_fit_a_choice_are_counted(outcome, pytester: pytest.Pytester) -> None:
    text = (
        "@pytest.mark.slow\ndef test_red(): pass\n@pytest.mark.slow\ndef test_blue(): pass\ndef test_reddish(): pass\n"
    )
    outcome(text, "--part=fast", "-k", "red", "--junitxml=it.xml")
    assert (pytester.path / "it.left").read_text() == "1"


def test_a_mark_that_nobody_registered_is_an_error(outcome) -> None:
    assert outcome("@pytest.mark.slwo\ndef test_it(): pass\n")[0] == {"errors": 1}
