"""tools/dev.py: what makes two commands from a clean clone enough."""

from __future__ import annotations

import importlib.util
import os
import stat
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def dev(monkeypatch, tmp_path):
    """The script as a module, working in a folder of its own."""
    spec = importlib.util.spec_from_file_location("drgs_dev", ROOT / "tools" / "dev.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    return module


def test_script_needs_the_standard_library_alone(dev):
    source = (ROOT / "tools" / "dev.py").read_text()
    imported = {line.split()[1].split(".")[0] for line in source.splitlines() if line.startswith(("import ", "from "))}
    assert imported <= {*sys.stdlib_module_names, "__future__"}


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


def fake_environment(dev, folder: Path, calls: list, broken: str = "never") -> None:
    """An interpreter that writes down what it is asked and fails at one probe."""
    calls.append(folder)
    python = dev.python_of(folder)
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\necho "$@" >> {folder.parent}/log\ncase "$*" in *"{broken}"*) exit 1;; esac\n')
    python.chmod(python.stat().st_mode | stat.S_IXUSR)


def suite(dev, tmp_path: Path, text: str):
    """Tally after one folder of tests."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_it.py").write_text(text)
    tally = dev.Tally()
    tally.pytest("it", Path(sys.executable), "tests")
    return tally


def test_every_folder_of_tests_is_run(dev, monkeypatch):
    """Those that need a window where there is one, or when they are asked for."""
    run = []
    monkeypatch.setattr(dev, "no_window", lambda: "there is none")
    monkeypatch.setattr(dev, "ensure_engine", lambda: None)
    monkeypatch.setattr(dev, "ensure_blender", lambda version="": None)
    monkeypatch.setattr(dev.Tally, "check", lambda *_: None)
    monkeypatch.setattr(dev.Tally, "pytest", lambda self, title, python, *folders, **_: run.extend(folders))
    assert dev.main(["test"]) == 0
    there = {f"tests/{path.parent.name}" for path in (ROOT / "tests").glob("*/test_*.py")}
    assert set(run) == there - {"tests/ui"} and "tests/farm" in run
    dev.main(["test", "window"])
    assert set(run) == there


def test_counts_are_summed(dev, tmp_path, capfd):
    text = "import pytest\ndef test_a(): pass\ndef test_b(): assert 0\n@pytest.mark.skip\ndef test_c(): pass\n"
    assert suite(dev, tmp_path, text).finish() == 1
    assert capfd.readouterr().out.splitlines()[-1] == "1 passed, 1 failed, 1 skipped"


def test_a_suite_without_tests_has_not_passed(dev, tmp_path):
    assert suite(dev, tmp_path, "x = 1\n").finish() == 1


def test_a_suite_that_passes_passes(dev, tmp_path):
    assert suite(dev, tmp_path, "def test_a(): pass\n").finish() == 0


def test_a_suite_that_hangs_is_ended_with_its_children(dev, tmp_path, monkeypatch):
    monkeypatch.setattr(dev, "TEST_SECONDS", 2)
    text = (
        "import subprocess, sys\ndef test_a(): subprocess.run([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
    )
    tally = suite(dev, tmp_path, text)
    assert tally.wrong == ["it"] and tally.finish() == 1
