"""Commands side by side: what waits for what, what is made again, what is said of them and of a failure."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import all_gone

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import environments  # noqa: E402
import steps  # noqa: E402
from steps import Line, Step, StepFailed, clock, counted, run_steps  # noqa: E402


def step(name: str, program: str, **options) -> Step:
    return Step(name, f"doing {name}", [sys.executable, "-c", program], 1.0, **options)


@pytest.fixture
def run(tmp_path):
    """Function that runs steps; returns what was said, and the log."""

    def together(*chosen: Step) -> tuple[str, str]:
        stream = io.StringIO()
        run_steps(chosen, tmp_path / "log.txt", tmp_path, {"DRGS_STEP": "here"}, stream)
        return stream.getvalue(), (tmp_path / "log.txt").read_text()

    return together


def shown(said: str) -> list[str]:
    """What was under way, without the lines of what had ended."""
    return [line for line in said.splitlines() if " done. " in line]


def test_steps_run_side_by_side_and_after_what_they_wait_for(run, tmp_path):
    """Two wait for each other's files, and a third for both."""
    meet = "import os, time\nopen('{0}', 'w').close()\nend = time.monotonic() + 30\n"
    meet += "while not os.path.exists('{1}'): time.sleep(0.01); assert time.monotonic() < end\n"
    last = "import os; assert os.path.exists('a') and os.path.exists('b'); print(os.environ['DRGS_STEP'])"
    said, log = run(
        step("last", last, after=("a", "b")), step("a", meet.format("a", "b")), step("b", meet.format("b", "a"))
    )
    lines = shown(said)
    assert lines[0] == "0 of 3 done. doing a, doing b" and lines[-1].startswith("2 of 3 done. doing last")
    assert re.search(r"^ *[\d.]+ last: here$", log, re.M)


def test_what_a_command_counts_is_said_once_for_each_change(run):
    program = "import time\nfor i in (1, 1, 2): print(f'Baking bread, {i} of 2', flush=True); time.sleep(0.3)"
    said, _ = run(step("bread", program, count=counted))
    assert [line.split(" done. ")[1] for line in shown(said)] == [
        "doing bread",
        "Baking bread, 1 of 2",
        "Baking bread, 2 of 2",
    ]


def test_on_a_terminal_one_line_is_rewritten():
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    line = Line(stream)
    line.show("a long text", "about 20 s left")
    line.show("short", "")
    line.show("x" * 500, "about 10 s left")
    line.clear()
    first, second, third, empty = stream.getvalue().removeprefix("\r").rstrip("\r").split("\r")
    assert "\n" not in stream.getvalue()
    assert first == "a long text; about 20 s left" and second == "short".ljust(len(first))
    assert third.endswith("...; about 10 s left") and not empty.strip()


def test_a_failure_ends_the_others_and_names_command_words_and_log(run, tmp_path):
    pid = tmp_path / "pid"
    sleeper = f"import os, time\nopen({str(pid)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)"
    broken = f"import os, time\nwhile not os.path.exists({str(pid)!r}): time.sleep(0.01)\n"
    broken += "for i in range(40): print('word', i)\nraise SystemExit('no flour')"
    began = time.monotonic()
    with pytest.raises(StepFailed) as caught:
        run(step("sleep", sleeper), step("bread", broken), step("never", "", after=("bread",)))
    text = str(caught.value)
    assert text.startswith("doing bread failed (1): ") and "    no flour\n" in text and "word 39" in text
    assert "word 20" not in text and text.endswith(f"All of it: {tmp_path / 'log.txt'}")
    assert "word 20" in (tmp_path / "log.txt").read_text()
    assert time.monotonic() - began < 30
    assert all_gone([int(pid.read_text())], 5.0)


def test_a_command_that_is_not_there_is_named(run):
    with pytest.raises(StepFailed, match="/nowhere/oven cannot be started"):
        run(Step("bread", "baking", ["/nowhere/oven"], 1.0))


def test_what_is_up_to_date_is_not_made_again(run, tmp_path):
    flour, bread = tmp_path / "flour", tmp_path / "bread"
    flour.write_text("white")
    baking = f"open({str(bread)!r}, 'a').write('|')"

    def bake(program: str = baking) -> str:
        run(step("bread", program, makes=bread, of=(flour,)), step("eat", "", after=("bread",)))
        return bread.read_text()

    assert bake() == bake() == "|"
    flour.write_text("brown")
    assert bake() == "||"
    assert bake(baking + " # another oven") == "|||"
    bread.unlink()
    assert bake() == "|"
    flour.write_text("rye")
    with pytest.raises(StepFailed):  # what fails half way is no bread
        bake(f"open({str(bread)!r}, 'a').write('half'); raise SystemExit(1)")
    assert bake() == "|half|"


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_ctrl_c_ends_everything(tmp_path):
    pid = tmp_path / "pid"
    sleeper = f"import os, time; open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(600)"
    program = f"""
import sys; sys.path.insert(0, {str(ROOT / "tools")!r})
from pathlib import Path
from steps import Step, run_steps
run_steps([Step("a", "a", [sys.executable, "-c", {sleeper!r}], 1.0)], Path("log"), Path("."), {{}})
"""
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 30
    while not (pid.exists() and pid.read_text()):
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    assert process.wait(20) != 0
    assert all_gone([int(pid.read_text())], 5.0)


def test_time_left_is_said_roughly():
    assert [clock(seconds) for seconds in (1, 12, 44, 95, 300)] == ["5 s", "10 s", "45 s", "2 min", "5 min"]


def test_each_step_and_its_time_are_told_as_it_ends(run, tmp_path):
    bread = tmp_path / "bread"
    baking = step("bread", f"import time; time.sleep(0.3); open({str(bread)!r}, 'w').close()", makes=bread)
    silent = Step("silent", "", [sys.executable, "-c", ""], 1.0)
    oven = step("oven", "", after=("bread",), title="Heating the oven")
    times = lambda said: [line for line in said.splitlines() if " done. " not in line]  # noqa: E731
    first, second = times(run(silent, baking, oven)[0])
    told = re.fullmatch(r"doing bread: ([\d.]+) s", first)
    assert told and float(told[1]) >= 0.3 and re.fullmatch(r"Heating the oven: [\d.]+ s", second)
    baking.process = oven.process = silent.process = None
    assert times(run(silent, baking, oven)[0])[0] == "doing bread: nothing has changed"


def job_of(*chosen: Step) -> steps._Run:
    return steps._Run(chosen, Path("log"), Path("."), {}, io.StringIO(), Line(io.StringIO()))


def test_time_left_is_not_said_before_it_is_measured(monkeypatch):
    """Nothing until the frames have been counted; then what those that are left take, and the short step after."""
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    first = step("first", "")
    frames = step("frames", "", after=("first",), measured=True, count=counted)
    last = step("last", "", after=("frames",))
    job = job_of(first, frames, last)
    first.seconds, frames.seconds, last.seconds = 60.0, 50.0, 10.0
    first.process, first.began = object(), now
    now += 10.0
    assert job._left() == ""
    job._done.add("first")
    frames.process, frames.began = object(), now
    now += 40.0
    assert job._left() == ""  # the program starts
    job._count(frames, "0 of 4", 0.0)
    now += 9.0
    job._count(frames, "kernels", 0.0)  # it is still not at the first
    now += 20.0
    assert job._left() == ""
    job._count(frames, "1 of 4", 0.25)
    now += 5.0
    assert job._left() == "about 65 s left"  # three of 20 s, less 5, and the last step
    last.seconds = 40.0
    assert job._left() == "", "too much of it is not measured here"
    last.seconds, now = 10.0, now + 30.0
    assert job._left() == "", "nothing measured is left"


def test_time_left_is_that_of_the_longer_row_and_of_no_step_that_is_late(monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    kernels, frames, short = step("kernels", "", count=counted), step("frames", "", count=counted), step("short", "")
    short.seconds = 10.0
    job = job_of(kernels, frames, short)
    for one in (kernels, frames, short):
        one.process, one.began = object(), now
    now += 8.0
    job._count(kernels, "1 of 2", 0.5)
    assert job._left() == "", "of the frames nothing is known"
    job._count(frames, "1 of 5", 0.2)
    now += 1.0
    assert job._left() == "", "a third of it is a guess"
    job._count(frames, "1 of 6", 0.16)
    assert job._left() == "about 45 s left"
    now += 2.0
    assert job._left() == "", "the short one takes longer than it should"


def test_an_environment_that_was_not_made_to_its_end_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(environments, "ENGINE", tmp_path)
    python = environments.python_of(tmp_path)
    python.parent.mkdir()
    python.touch()
    half = environments.environments()[0]
    (tmp_path / environments.STAMP).touch()
    whole = environments.environments()[0]
    assert half.text.startswith("Making") and whole.text.startswith("Checking") and half.seconds > 10 * whole.seconds
