"""The cache key of compiled kernels: a change drops what it can have changed, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from drgs_blender.compute import closure

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {
    "__init__.py": '"""The package."""\n',
    "kernel.py": '"""A kernel."""\nfrom .inner import helper\nfrom . import constants\n\n\ndef f(x):\n    return x\n',
    "inner/__init__.py": "",
    "inner/helper.py": "from ..numbers import Wrong\n\n\ndef g(x):\n    return x + 1\n",
    "constants.py": "A = 1\n",
    "numbers.py": "class Wrong(Exception):\n    pass\n",
    "reader.py": "from .kernel import f\n\nB = 2\n",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A small package in the place of the real one; returns its folder."""
    folder = tmp_path / "drgs_blender"
    for name, text in SOURCES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(closure, "PACKAGE", folder)
    forget()
    yield folder
    forget()


def forget() -> None:
    cached = "digest", "_members", "_is_changed", "_facts", "_files", "_inside", "_name"
    for name in cached:
        getattr(closure, name).cache_clear()


def key(folder: Path) -> str:
    forget()
    return closure.digest(folder / "kernel.py")


def test_a_closure_holds_what_is_imported_and_nothing_that_imports(package):
    found = {path.relative_to(package).as_posix() for path in closure.closure(package / "kernel.py")}
    assert found == set(SOURCES) - {"reader.py"}


@pytest.mark.parametrize("name", ["kernel.py", "inner/helper.py", "constants.py", "numbers.py", "inner/__init__.py"])
def test_a_change_inside_drops_the_cache(package, name):
    before = key(package)
    (package / name).write_text(SOURCES[name] + "\nC = 3\n")
    assert key(package) != before
    (package / name).write_text(SOURCES[name])
    assert key(package) == before


def test_a_new_file_or_name_inside_drops_the_cache(package):
    before = key(package)
    (package / "constants.py").write_text("A = 2\n")
    assert key(package) != before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("reader.py", "from .kernel import f\n\nB = 3\n"),
        ("new.py", "D = 4\n"),
        ("constants.py", '"""Constants."""\n\n# The first.\nA = 1  # of all\n'),
        ("kernel.py", SOURCES["kernel.py"].replace('"""A kernel."""', '"""Another\n\ntext."""\n')),
        ("kernel.py", SOURCES["kernel.py"].replace("f(x):", 'f(x):\n    """Docstring."""\n')),
    ],
)
def test_a_change_outside_or_of_comments_keeps_the_cache(package, name, text):
    before = key(package)
    (package / name).write_text(text)
    assert key(package) == before


def test_what_code_does_not_depend_on_is_no_part_of_the_closure(package):
    """As the version, so that an update compiles nothing again whose sources are the same."""
    (package / "core").mkdir()
    (package / "core/version.py").write_text("from ..reader import B\n")
    (package / "constants.py").write_text("from .core.version import B\nA = 1\n")
    before = key(package)
    (package / "core/version.py").write_text("B = 4\n")
    (package / "reader.py").write_text("B = 5\n")
    assert key(package) == before
    assert all((ROOT / name).is_file() for name in closure.NEUTRAL)


def test_a_module_that_becomes_a_package_is_found(package):
    """Its importer is the same, and so may the row of an index be that an earlier version wrote."""
    key(package)
    (package / "constants").mkdir()
    (package / "constants.py").rename(package / "constants/__init__.py")
    before = key(package)
    (package / "constants/__init__.py").write_text("A = 2\n")
    assert key(package) != before


def test_the_same_bytes_in_two_folders_import_their_own_neighbours(package):
    for name in "ab":
        (package / name).mkdir()
        (package / name / "kernel.py").write_text("from .constants import A\n")
        (package / name / "constants.py").write_text("A = 1\n")
    forget()
    assert package / "b/constants.py" in closure.closure(package / "b/kernel.py")
    assert package / "a/constants.py" not in closure.closure(package / "b/kernel.py")


@pytest.mark.parametrize("damage", [b"", b"x", b"[" * 100_000, b"0" * 64 + b"\n{}"])
def test_a_damaged_index_is_parsed_anew(damage):
    rows = {"k": ("facts", ["drgs_blender.core"])}
    assert closure.unpacked(closure.packed(rows)) == {"k": ["facts", ["drgs_blender.core"]]}
    with pytest.raises((ValueError, RecursionError)):
        closure.unpacked(damage)


def test_the_same_sources_elsewhere_have_the_same_key(package, tmp_path, monkeypatch):
    before = key(package)
    other = tmp_path / "elsewhere" / "drgs_blender"
    shutil.copytree(package, other)
    monkeypatch.setattr(closure, "PACKAGE", other)
    assert key(other) == before


_PROGRAM = """
import numpy as np
from drgs_blender.compute import jit
from numba.core import event
class Count(event.Listener):
    total = 0
    def on_start(self, event): Count.total += 1
    def on_end(self, event): pass
event.register("numba:compile", Count())
from drgs_blender.geometry.normals import corner_table
corner_table(np.array([[0, 1, 2]], np.int32), 3)
print(Count.total)
"""


@pytest.mark.slow
def test_real_kernels_outlive_changes_elsewhere_and_no_others(tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(ROOT / "drgs_blender", copy / "drgs_blender", ignore=shutil.ignore_patterns("__pycache__", "*.zip"))

    def compiled() -> int:
        environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(copy)}
        command = [sys.executable, "-c", _PROGRAM]
        return int(subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True, cwd=copy).stdout)

    def append(name: str, text: str) -> None:
        path = copy / "drgs_blender" / name
        path.write_text(path.read_text() + text)

    assert compiled() > 0
    assert compiled() == 0
    append("formats/obj.py", "\nX = 1\n")
    append("reconstruct/pipeline.py", "\nX = 1\n")
    append("geometry/normals.py", "\n# a comment\n")
    assert compiled() == 0
    append("geometry/normals.py", "\nX = 1\n")
    assert compiled() > 0
    append("core/errors.py", "\nX = 1\n")
    assert compiled() == 0
    append("compute/jit.py", "\nX = 1\n")
    assert compiled() > 0


def test_kernels_of_films_depend_on_no_lobe():
    """A change of a lobe has only paths and the colours of lobes compiled again."""
    render = closure.PACKAGE / "render"
    lobes = set((render / "integrator/bsdf").glob("*.py"))
    others = *render.glob("film/*.py"), *render.glob("gbuffer/*.py")
    assert {path for path in others if lobes & closure.closure(path)} == {render / "film/lobe_colours.py"}
