"""The start of the engine in a Python that has none of its packages, as Blender's own."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from drgs_blender.capture import libraries
from drgs_blender.core import own_python
from drgs_blender.ipc.locate import bundled_command

ROOT = Path(__file__).resolve().parents[2]
#: Prints its arguments and where the package lies, starts itself once more, and prints a variable's part of sys.path.
CODE = """
import subprocess, sys
import lazy_loader
from drgs_blender.core import own_python
print(sys.argv[0], *sys.argv[1:], sep="|")
print(own_python.__file__)
print(any("elsewhere" in folder for folder in sys.path))
if sys.argv[1] == "again":
    sys.exit(subprocess.run([*own_python.command("-I"), "-c", sys.stdin.read(), "ä b"]).returncode)
"""


@pytest.fixture
def command(tmp_path):
    """What stands before -m or -c, in folders with spaces and letters of all kinds."""
    folder = tmp_path / "Größe 1 объект"
    for name in ("core", "cli"):
        shutil.copytree(ROOT / "drgs_blender" / name, folder / "drgs" / "drgs_blender" / name)
    shutil.copy(ROOT / "drgs_blender" / "__init__.py", folder / "drgs" / "drgs_blender")
    site = folder / "site-packages"
    spec = importlib.util.find_spec("lazy_loader")
    site.symlink_to(Path(spec.origin).parents[1], target_is_directory=True)
    whole = bundled_command(sys._base_executable, site)
    before = whole[: whole.index("-m")]
    before[before.index("-Xutf8") + 1] = str(folder / "drgs" / "drgs_blender" / "cli" / "bundled.py")
    return before


def started(command, code, *arguments):
    environment = os.environ | {"PYTHONPATH": "/elsewhere"}
    return subprocess.run(
        [*command, "-c", code, *arguments], input=CODE, env=environment, capture_output=True, encoding="utf-8"
    )


def test_it_and_what_it_starts_have_the_packages_and_nothing_of_the_user(command):
    done = started(command, CODE, "again", "ß")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert {"-c|again|ß", "-c|ä b"} == {line for line in lines if line.startswith("-c")}
    assert sum("Größe 1 объект" in line for line in lines) == 2 and lines.count("False") == 2


def test_a_package_that_is_broken_is_told_after_where_that_was_found(command):
    done = started(command, "def inner(): import no_such_package\ninner()")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("is broken: No module named 'no_such_package'")
    assert "in inner" in done.stderr


@pytest.mark.parametrize(("bundled", "said"), [(["python", "-I"], "Set Up Engine"), ([], "pip install")])
def test_what_is_absent_is_installed_where_the_engine_is(monkeypatch, bundled, said):
    """Blender's own Python is nobody's to install into."""
    monkeypatch.setattr(own_python, "bundled", bundled)
    remedy = libraries.install_command(["av"])
    assert said in remedy and ("pip install" in remedy) == (said == "pip install")


def test_what_an_environment_of_set_up_engine_lacks_comes_by_set_up_engine(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert "pip install" in libraries.install_command(["av"])
    (tmp_path / own_python.SET_UP).touch()
    assert "Set Up Engine" in libraries.install_command(["av"])
