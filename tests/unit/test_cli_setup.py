"""tools/dev.py: what makes two commands from a clean clone enough."""

from __future__ import annotations

import importlib.util
import os
import shutil
import stat
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Modules of tools/ that run before there is any environment.
OWN = ("dev", "suites", "job_runner", "junit_report", "environments", "steps")


@pytest.fixture
def dev(monkeypatch, tmp_path):
    """The script as a module, working in a folder of its own."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    spec = importlib.util.spec_from_file_location("drgs_dev", ROOT / "tools" / "dev.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    return module


@pytest.mark.parametrize("name", [f"{name}.py" for name in OWN])
def test_scripts_need_the_standard_library_alone(name):
    source = (ROOT / "tools" / name).read_text()
    imported = {line.split()[1].split(".")[0] for line in source.splitlines() if line.startswith(("import ", "from "))}
    assert imported <= {*sys.stdlib_module_names, "__future__", *OWN}


def test_missing_library_is_named_with_its_package(dev, tmp_path):
    message = "ImportError: libxkbcommon.so.0: cannot open shared object file: No such file or directory"
    text = dev.import_trouble(tmp_path, message)
    assert "libxkbcommon.so.0" in text and "apt-get install" in text and "libxkbcommon0" in text
    assert "does not work" in dev.import_trouble(tmp_path, "ImportError: bad magic number")


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as an interpreter")
def test_environment_is_made_once(dev, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(dev.venv, "create", lambda folder, with_pip: fake_environment(dev, folder, calls))
    for wanted in ("a", "a", "b"):
        dev.ensure(tmp_path / ".venv", {"packages": wanted}, [["one"], ["two"]], "import x")
    installs = [line.split()[-1] for line in (tmp_path / "log").read_text().splitlines() if "install" in line]
    assert installs == ["one", "two", "one", "two"] and len(calls) == 1


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as an interpreter")
def test_environment_that_fails_is_tried_again(dev, tmp_path, monkeypatch):
    monkeypatch.setattr(dev.venv, "create", lambda folder, with_pip: fake_environment(dev, folder, [], "import broken"))
    for _ in range(2):
        with pytest.raises(dev.Failure, match="does not work"):
            dev.ensure(tmp_path / ".venv", {}, [["one"]], "import broken")


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as an interpreter")
@pytest.mark.parametrize("free", [10**8, 10**11])
def test_a_full_disk_is_named_where_pip_fails(dev, tmp_path, monkeypatch, free):
    monkeypatch.setattr(dev.venv, "create", lambda folder, with_pip: fake_environment(dev, folder, [], "install"))
    monkeypatch.setattr(dev.shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    with pytest.raises(dev.Failure, match=r"failed in \.venv") as told:
        dev.ensure(tmp_path / ".venv", {}, [["one"]], "import x")
    assert ("Only 0.1 GB" in str(told.value)) == (free < 10**9)


def fake_environment(dev, folder: Path, calls: list, broken: str = "never") -> None:
    """An interpreter that writes down what it is asked and fails at one probe."""
    calls.append(folder)
    python = dev.python_of(folder)
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\necho "$@" >> {folder.parent}/log\ncase "$*" in *"{broken}"*) exit 1;; esac\n')
    python.chmod(python.stat().st_mode | stat.S_IXUSR)


@pytest.fixture
def extras(dev):
    """Function that says what the extra `capture` is, in a checkout of its own with an environment."""
    fake_environment(dev, dev.ROOT / ".venv", [], "too-new")

    def write(*packages: str) -> None:
        text = f"[project]\n[project.optional-dependencies]\ncapture = {list(packages)}\n"
        (dev.ROOT / "pyproject.toml").write_text(text)

    return write


def fetched(dev) -> list[str]:
    """What pip of the environment was asked for, and the list emptied."""
    log = dev.ROOT / "log"
    lines = log.read_text().splitlines() if log.exists() else []
    log.unlink(missing_ok=True)
    return lines


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as an interpreter")
def test_libraries_of_capture_are_fetched_once_and_when_they_change(dev, extras):
    python = dev.python_of(dev.ROOT / ".venv")
    for packages, times in ((["one>=1", "two"], 1), (["one>=1", "two"], 0), (["one>=2", "two"], 1)):
        extras(*packages)
        dev.ensure_capture(python)
        lines = fetched(dev)
        assert len(lines) == times and all(line.endswith(" ".join(packages)) for line in lines)


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as an interpreter")
def test_where_capture_has_no_wheels_it_is_said_and_tried_again(dev, extras, capfd):
    extras("too-new>=9")
    for _ in range(2):
        dev.ensure_capture(dev.python_of(dev.ROOT / ".venv"))
        assert len(fetched(dev)) == 1
        assert "Could not fetch the libraries of drgs capture" in capfd.readouterr().out


def test_what_never_ends_to_be_fetched_is_left_out(dev, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(dev, "FETCH_SECONDS", 1)
    command = [sys.executable, "-c", "import time; time.sleep(60)"]
    dev.fetch(tmp_path, "stamp", ["one"], command, "programs")
    assert "Could not fetch programs, not within 1 s" in capfd.readouterr().out
    assert not (tmp_path / "stamp").exists()


def test_suites_of_the_engine_and_make_env_fetch_the_libraries_of_capture_and_no_demo_waits(dev, plans, monkeypatch):
    asked = []
    monkeypatch.setattr(dev, "ensure_capture", asked.append)
    monkeypatch.setattr(dev, "both", lambda: None)
    for words, times in ((["test"], 1), (["check", "engine"], 1), (["test", "blender"], 0), (["check", "floor"], 0)):
        plans(*words)
        assert len(asked) == times, words
        asked.clear()
    assert dev.main(["env", "--engine"]) == 0 and not asked  # a step of the demo
    assert dev.main(["env"]) == 0 and asked == [dev.python_of(dev.ROOT / ".venv")]


@pytest.fixture
def plans(dev, monkeypatch):
    """Function that runs a command of the script; returns the plan that it made."""
    made = []
    monkeypatch.setattr(dev, "no_window", lambda: "there is none")
    monkeypatch.setattr(dev, "ensure_engine", lambda: Path("python"))
    monkeypatch.setattr(dev, "ensure_blender", lambda version="": Path("python"))
    monkeypatch.setattr(dev, "find_python", lambda minor: Path("python"))
    monkeypatch.setattr(dev, "ensure_node", lambda: None)
    monkeypatch.setattr(dev, "ensure_capture", lambda engine: None)
    monkeypatch.setattr(dev.suites, "run", lambda plan, *_: made.append(plan) or 0)
    shutil.copytree(ROOT / "tests", dev.ROOT / "tests", ignore=shutil.ignore_patterns("__pycache__"))

    def plan(*words):
        assert dev.main(words) == 0
        return made.pop()

    return plan


def commands(dev, plan, tmp_path):
    """Suite -> what its jobs run, with the files to collect last."""
    python = {name: lambda: Path("python") for name in dev.SUITES}
    jobs = dev.suites.jobs(plan, dev.SUITES, python, dev.ROOT, tmp_path / "reports")
    return {job.title: " ".join(command) for job in jobs for command in job.commands}


def test_every_folder_of_tests_is_run(dev, plans, tmp_path):
    """Those that need a window where there is one, or when they are asked for."""
    there = {f"tests/{path.parent.name}" for path in (ROOT / "tests").glob("*/test_*.py")}
    for word in ("test", "check"):
        run = " ".join(commands(dev, plans(word), tmp_path).values())
        assert {folder for folder in there if folder in run} == there - {"tests/ui"}
    assert "tests/ui" in commands(dev, plans("check", "window"), tmp_path)["a window"]


def test_what_test_leaves_is_all_that_the_rest_of_check_runs(dev, plans, tmp_path):
    """Nothing twice, nothing never: the parts of each suite, and those of other Blenders as a whole."""
    fast, rest, whole = (commands(dev, plans(*words), tmp_path) for words in (["test"], ["check", "--rest"], ["check"]))
    assert fast.keys() | rest.keys() == whole.keys() and fast.keys() & rest.keys() == fast.keys() - {"lint"}
    for title in fast.keys() - {"lint"}:
        assert "--part=fast" in fast[title] and "--part=slow" in rest[title]
    others = {dev.SUITES[name].title for name in (dev.FLOOR, dev.NEWEST_LTS)}
    assert {title.removesuffix(", alone") for title in rest if "--part=all" in rest[title]} == others
    assert all("--part=all" in command for title, command in whole.items() if title != "lint")
    for title in ("engine", "farm", f"Blender {dev.BLENDER}"):
        assert "--lane=shared" in whole[title]
    assert "--lane=alone" in whole["engine, alone"]


def test_check_leaves_out_a_blender_whose_python_is_missing(dev, plans, monkeypatch, capsys):
    assert dev.NEWEST_LTS in plans("check").suites
    monkeypatch.setattr(dev, "find_python", lambda minor: None)
    assert dev.NEWEST_LTS not in plans("check", "--rest").suites
    said = capsys.readouterr().out
    assert f"{dev.SUITES[dev.NEWEST_LTS].title}: skipped" in said and "no Python 3.13" in said


def test_a_python_that_is_missing_is_named_when_its_blender_is_asked_for(dev, monkeypatch, capsys):
    monkeypatch.setattr(dev, "find_python", lambda minor: None)
    monkeypatch.setattr(dev, "ensure_engine", lambda: Path("python"))
    for words in (["check", dev.NEWEST_LTS], ["env", "--blender", dev.NEWEST_LTS]):
        assert dev.main(words) == 1
        assert "needs Python 3.13" in capsys.readouterr().err


@pytest.mark.parametrize(("version", "minor"), [("4.2.23", 11), ("5.0.1", 11), ("5.1.0", 13), ("5.3.0", 13)])
def test_each_blender_has_the_environment_and_the_python_of_its_series(dev, version, minor, monkeypatch, capsys):
    monkeypatch.setattr(dev, "find_python", lambda minor: Path(f"python3.{minor}"))
    assert dev.python_for(version) == Path(f"python3.{minor}")
    series = version.rpartition(".")[0]
    folder = ".venv-blender" if version == dev.BLENDER else f".venv-blender-{series}"
    assert dev.blender_folder(version).name == folder
    if series in dev.BLENDER_OTHERS:
        assert dev.blender_version(series).startswith(f"{series}.")
    with pytest.raises(SystemExit):
        dev.parse(["env", "--blender", f"{version}.1"])
    assert "no whole version" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as an interpreter")
def test_a_python_is_found_where_pyenv_keeps_it(dev, tmp_path, monkeypatch):
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    assert dev.find_python(99) is None
    for name, code in (("3.99.0", 1), ("3.99.1", 0)):
        python = tmp_path / "versions" / name / "bin" / "python3.99"
        python.parent.mkdir(parents=True)
        python.write_text(f"#!/bin/sh\necho {python}\nexit {code}\n")
        python.chmod(0o755)
    assert dev.find_python(99) == python


def test_words_choose_suites_files_and_tests(dev, plans, tmp_path):
    assert plans("test", "engine", "farm").suites == ["engine", "farm"]
    plan = plans("test", "engine", "-k", "farm or window", "-x")
    assert plan.suites == ["engine"] and plan.options == ["-k", "farm or window", "-x"]
    assert plans("test", "-k", "lint").suites == ["blender", "farm", "engine"]
    chosen = commands(dev, plans("test", "tests/blender/test_panels.py"), tmp_path)
    assert [*chosen] == [f"Blender {dev.BLENDER}"] and "--part=fast" in next(iter(chosen.values()))
    chosen = commands(dev, plans("test", "tests/unit/test_light.py::test_it"), tmp_path)
    assert "--part=all" in chosen["engine"], "a test that is named is run, slow or not"
    chosen = commands(dev, plans("test", "tests"), tmp_path)
    assert chosen["engine"].endswith(" tests/unit tests/engine") and chosen["farm"].endswith(" tests/farm")
    assert dev.main(["test", "enigne"]) == 1
    assert dev.main(["test", "-x", "tests/unit/test_light.py"]) == 1


@pytest.mark.parametrize("words", [["clean", "--al"], ["env", "--eng"]])
def test_an_option_is_written_out(dev, words, capsys):
    with pytest.raises(SystemExit):
        dev.parse(words)
    assert "unrecognized arguments" in capsys.readouterr().err
