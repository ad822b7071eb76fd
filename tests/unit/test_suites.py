"""tools/suites.py: test suites side by side, and what is said of them."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from processes import gone

ROOT = Path(__file__).resolve().parents[2]
SLEEP = "import os, subprocess, sys\nopen('pid{}', 'w').write(str(os.getpid()))\n" + (
    "subprocess.run([sys.executable, '-c', \"import os, time; open('child{}', 'w').write(str(os.getpid())); "
    'time.sleep(60)"])\n'
)


@pytest.fixture
def suites(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    spec = importlib.util.spec_from_file_location("drgs_suites", ROOT / "tools" / "suites.py")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(suites, tmp_path, monkeypatch, capfd):
    """Function that runs files of tests, each a suite of its own; returns the code and the printed lines."""
    monkeypatch.setattr(suites, "suite_jobs", plain_jobs(suites))

    def go(files: dict[str, str], part: str = "fast", options: tuple[str, ...] = ()):
        for name, text in files.items():
            (tmp_path / name).mkdir(exist_ok=True)
            (tmp_path / name / "test_it.py").write_text(text)
        table = {name: suites.Suite(name, (name,)) for name in files}
        plan = suites.Plan(part, [*files], options=list(options))
        python = {name: lambda: Path(sys.executable) for name in (*files, "lint")}
        capfd.readouterr()
        code = suites.run(plan, table, python, tmp_path, os.environ)
        return code, capfd.readouterr().out.splitlines()

    return go


def plain_jobs(suites):
    """As `suites.suite_jobs`, without the options of this project's tests."""

    def jobs(name, suite, plan, python, root, folder, after):
        report = folder / f"{name}.xml"
        command = [
            str(python),
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
            f"--junitxml={report}",
        ]
        log = folder / f"{name}.log"
        return [suites.Job(name, [[*command, *plan.options, name]], log, report, may_be_empty=plan.selects)]

    return jobs


def test_counts_are_summed_and_times_kept(run, tmp_path):
    text = "import pytest\ndef test_a(): pass\ndef test_b(): assert 0\n@pytest.mark.skip\ndef test_c(): pass\n"
    code, lines = run({"one": text, "two": "def test_d(): pass\n"})
    assert code == 1 and lines[-1] == "2 passed, 1 failed, 1 skipped" and "not passed: one" in lines
    durations = json.loads((tmp_path / "build" / "durations.json").read_text())
    assert {(entry["suite"], entry["test"].split("::")[-1]) for entry in durations} == {
        ("one", "test_a"), ("one", "test_b"), ("one", "test_c"), ("two", "test_d"),
    }  # fmt: skip
    code, lines = run({"three": "def test_e(): pass\n"}, "slow")
    assert code == 1 and lines[-1] == "3 passed, 1 failed, 1 skipped", "of both parts"
    assert sum("test_" in line for line in lines) == 5, "the slowest are named"


def test_what_a_suite_prints_stays_together_and_a_passing_one_is_short(run):
    failing = "import time\ndef test_a(): print('1 of a'); time.sleep(0.3); print('2 of a'); assert 0\n"
    code, lines = run({"a": failing, "b": failing.replace("of a", "of b"), "c": "def test_c(): pass\n"})
    assert code == 1
    for name in "ab":
        first = lines.index(f"1 of {name}")
        assert lines[first + 1] == f"2 of {name}"
    assert not any(line.startswith(".") for line in lines)


def test_a_suite_without_tests_has_not_passed(run):
    assert run({"one": "x = 1\n", "two": "def test_a(): pass\n"})[0] == 1


def test_a_word_may_fit_tests_of_one_suite_alone_but_not_none(run):
    files = {"one": "def test_red(): pass\n", "two": "def test_blue(): pass\n"}
    code, lines = run(files, options=("-k", "blue"))
    assert code == 0 and lines[-1] == "1 passed, 0 failed, 0 skipped"
    code, lines = run(files, options=("-k", "green"))
    assert code == 1 and "not passed: no test fits -k green" in lines


def test_options_that_pytest_refuses_are_the_cause(run, suites):
    with pytest.raises(suites.Failure, match="pytest does not run --lanes=foo: unrecognized arguments: --lanes=foo"):
        run({"one": "def test_red(): pass\n", "two": "def test_blue(): pass\n"}, options=("--lanes=foo",))
    with pytest.raises(suites.Failure, match="its message is above"):
        run({"one": "def test_red(): pass\n"}, options=("--lanes=foo",))
    with pytest.raises(suites.Failure, match="-k needs a word"):
        suites.parse(["-k"], [], ROOT)


@pytest.mark.skipif(os.name == "nt", reason="processes are told apart by their ids")
def test_a_job_that_hangs_is_ended_with_its_children_and_named(suites, tmp_path, capfd):
    jobs = [job_of(suites, tmp_path, name, SLEEP.format(name, name), seconds=1.0) for name in "ab"]
    runner = suites.Runner(tmp_path, os.environ, 2)
    runner.run(jobs)
    assert runner.codes == {"a": [124], "b": [124]} and "b: ended after 1 s" in capfd.readouterr().out
    pids = [int((tmp_path / name).read_text()) for name in ("pida", "childa", "pidb", "childb")]
    assert all(gone(pid) for pid in pids)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_everything(tmp_path, how):
    program = (
        f"import os, pathlib, sys; sys.path.insert(0, {str(ROOT / 'tools')!r}); import suites\n"
        f"jobs = [suites.Job(n, [[sys.executable, '-c', {SLEEP!r}.format(n, n)]], pathlib.Path(n)) for n in 'ab']\n"
        f"suites.Runner(pathlib.Path('.'), os.environ, 2).run(jobs)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stderr=subprocess.PIPE)
    files = [tmp_path / name for name in ("pida", "childa", "pidb", "childb")]
    until = time.monotonic() + 30
    while not all(path.exists() and path.read_text() for path in files):
        assert time.monotonic() < until
        time.sleep(0.02)
    process.send_signal(how)
    assert b"KeyboardInterrupt" in process.communicate(timeout=30)[1]
    assert all(gone(int(path.read_text())) for path in files)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signal")
def test_a_program_of_dev_ends_with_it(tmp_path):
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "extension.py").write_text(SLEEP.format("", ""))
    program = (
        f"import pathlib, sys; sys.path.insert(0, {str(ROOT / 'tools')!r}); import dev\n"
        "dev.both, dev.ROOT = lambda: None, pathlib.Path.cwd()\n"
        "dev.python_of = lambda _: pathlib.Path(sys.executable)\n"
        "sys.exit(dev.main(['extension']))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path)
    files = [tmp_path / name for name in ("pid", "child")]
    until = time.monotonic() + 30
    while not all(path.exists() and path.read_text() for path in files):
        assert time.monotonic() < until
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 130
    assert all(gone(int(path.read_text())) for path in files)


def test_jobs_wait_for_others_and_for_an_empty_machine(suites, tmp_path):
    note = (
        "import time; open('log', 'a').write('{0} begins\\n'); time.sleep(0.2); open('log', 'a').write('{0} ends\\n')"
    )
    jobs = [job_of(suites, tmp_path, name, note.format(name)) for name in ("alone", "kernels", "first", "after")]
    jobs[0].alone, jobs[3].after = True, "kernels"
    suites.Runner(tmp_path, os.environ, 3).run(jobs)
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines[-2:] == ["alone begins", "alone ends"]
    assert lines.index("after begins") > lines.index("kernels ends")


def test_kernels_are_prepared_before_tests_where_there_is_a_program_for_it(suites, tmp_path):
    table = {"engine": suites.Suite("engine", ("tests",))}
    (tmp_path / "tests").mkdir()
    plan, python = suites.Plan("fast", ["engine"]), {name: lambda: Path("python") for name in ("engine", "lint")}
    assert [job.title for job in suites.jobs(plan, table, python, tmp_path, tmp_path)] == ["engine"]
    program = tmp_path / "drgs_blender" / "compute" / "prepare.py"
    program.parent.mkdir(parents=True)
    program.touch()
    kernels, engine = suites.jobs(plan, table, python, tmp_path, tmp_path)
    assert kernels.commands == [["python", "-m", "drgs_blender.compute.prepare", "--all"]]
    assert engine.after == kernels.title


@pytest.mark.parametrize(
    ("plan", "leaves"),
    [
        ({}, True),
        ({"options": ["-k", "light"]}, True),
        ({"named": True}, False),
        ({"files": ["tests/test_it.py::test_it"]}, False),
    ],
)
def test_a_suite_leaves_tests_to_others_unless_they_are_asked_for(suites, tmp_path, plan, leaves):
    suite = suites.Suite("floor", ("tests",), leaves="judged or (slow and not blender_api)")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_it.py").touch()
    made = suites.suite_jobs(
        "floor", suite, suites.Plan("all", ["floor"], **plan), Path("python"), tmp_path, tmp_path, ""
    )
    assert made and all(("not (judged or (slow and not blender_api))" in job.commands[0]) == leaves for job in made)


def test_types_of_the_extension_are_checked_where_a_package_can_be_named_as_its_folder(suites, tmp_path):
    def checked(folder):
        commands = suites.lint(Path("python"), tmp_path / folder, tmp_path).commands
        return [command[2:] for command in commands if "mypy" in command]

    assert checked("drgs-blender") == [
        ["mypy"],
        ["mypy", "-p", "drgs-blender.addon", "-p", "drgs-blender.operators", "-m", "drgs-blender"],
    ]
    assert checked("drgs-blender-1.0") == [["mypy"]]


def test_types_of_every_tool_are_checked():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"]
    assert settings["modules"] == sorted(path.stem for path in (ROOT / "tools").glob("*.py"))


def job_of(suites, folder: Path, name: str, program: str, **options):
    """A job that runs a program."""
    return suites.Job(name, [[sys.executable, "-c", program]], folder / f"{name}.log", **options)
