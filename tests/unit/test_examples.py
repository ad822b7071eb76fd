"""The scripts of the examples: what they take from each other is there, and wrong arguments get a line."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py"))
#: With a command line of its own.
DEMOS = ("demo", "demo_simulation", "demo_film")


@pytest.fixture(autouse=True)
def modules(monkeypatch):
    """The scripts are found by their names, whatever the checkout's folder is called."""
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), str(ROOT / "tools"), *sys.path])
    others = {name: sys.modules.pop(name) for name in SCRIPTS if name in sys.modules}
    yield
    for name in SCRIPTS:
        sys.modules.pop(name, None)
    sys.modules.update(others)


def tree_of(name: str) -> ast.Module:
    return ast.parse((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))


def imported(name: str) -> set[str]:
    """Modules that a script imports, by their first names."""
    found = set()
    for node in ast.walk(tree_of(name)):
        if isinstance(node, ast.Import):
            found.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module.partition(".")[0])
    return found


def in_blender(name: str) -> bool:
    """Whether a script runs in Blender alone, or imports one that does."""
    names = imported(name)
    return "bpy" in names or any(in_blender(other) for other in names.intersection(SCRIPTS))


def defined(name: str) -> set[str]:
    """Names at the top of a script."""
    found = set()
    for node in tree_of(name).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            found.update(alias.asname or alias.name for alias in node.names)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found.update(part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name))
    return found


@pytest.mark.parametrize("name", [name for name in SCRIPTS if not in_blender(name)])
def test_a_script_outside_blender_can_be_imported(name):
    there = dir(importlib.import_module(name))
    assert {word.partition(".")[0] for word in defined(name)} <= set(there)


@pytest.mark.parametrize("name", SCRIPTS)
def test_what_scripts_take_from_each_other_is_there(name):
    """Also of those in Blender, and of names that are used as attributes of a script."""
    tree, others = tree_of(name), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in SCRIPTS:
            missing = {alias.name for alias in node.names} - defined(node.module)
            assert not missing, f"{name} takes {missing} from {node.module}"
        elif isinstance(node, ast.Import):
            others.update(alias.name for alias in node.names if alias.name in SCRIPTS)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in others:
            assert node.attr in defined(node.value.id), f"{name} uses {node.value.id}.{node.attr}"


@pytest.mark.parametrize("name", DEMOS)
def test_steps_wait_for_steps_that_come_before_and_run_what_is_there(name, tmp_path):
    module = importlib.import_module(name)
    first = {"demo": "1-24", "demo_simulation": "1-48x3"}.get(name)
    made = module.steps(tmp_path, *([first] if first else []))
    known = {"engine", "blender"}
    for step in made:
        assert known.issuperset(step.after), step.name
        known.add(step.name)
        assert all(path.exists() for path in step.of if ROOT in path.parents), step.name
        scripts = [Path(part) for part in step.command if str(part).endswith(".py")]
        assert all(path.is_file() for path in scripts), step.name


@pytest.mark.parametrize("name", DEMOS)
def test_a_folder_that_cannot_be_written_gets_a_line(name, tmp_path, capsys, monkeypatch):
    module = importlib.import_module(name)
    monkeypatch.setattr(module, "run_all", lambda *_: pytest.fail("it has begun"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    file = tmp_path / "file"
    file.touch()
    for place in (file, file / "below"):
        assert module.main(["--out", str(place)]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and f"--out {place}" in said and "it is a file, or in one" in said


@pytest.mark.parametrize("name", ("demo", "demo_simulation"))
@pytest.mark.parametrize("frames", ("0", "0-3", "5-3", "1-99", "nine", "1-4x0", ""))
def test_frames_that_the_scene_has_not_get_a_line(name, frames, tmp_path, capsys):
    module = importlib.import_module(name)
    assert module.main(["--out", str(tmp_path / "out"), "--frames", frames]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"--frames {frames}" in said and "Traceback" not in said
    assert not (tmp_path / "out").exists(), "nothing is begun"


def test_frames_are_counted_once_each():
    import demo_run

    counts = [demo_run.frame_count(text, 24) for text in ("1-24", "1-24x2", "7", "1-3,2-4", "1-24x23")]
    assert counts == [24, 12, 1, 4, 2]


def test_frames_that_are_there_count_as_done_and_tell_no_time():
    import demo_run

    counted = demo_run.frames_saved("Rendering", 8)
    lines = ["Fra:- | Starting Blender", "skipping existing frame '1.exr'", "skipping existing frame '2.exr'"]
    lines += ["skipping existing frame '3.exr'", "Fra:4 | Rendering | Sample 0/8", "Saved: '4.exr'", "Saved: '5.exr'"]
    words, parts = zip(*filter(None, map(counted, lines)))
    assert words[-1] == "Rendering, 5 of 8 frames" and words[0] == "Rendering, 1 of 8 frames"
    assert parts == (0.0, 0.0, 0.0, 0.0, 0.2, 0.4)


def test_the_film_asks_for_its_encoder_before_anything_else(tmp_path, capsys, monkeypatch):
    import demo_film

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "av" else find(name))
    monkeypatch.setattr(demo_film, "run_all", lambda *_: pytest.fail("it has begun"))
    assert demo_film.main(["--out", str(tmp_path / "film")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "av" in said and "`make env`" in said
    assert not (tmp_path / "film").exists()


def test_the_film_lies_beside_its_frames_unless_a_folder_is_named(tmp_path, capsys, monkeypatch):
    import demo_film

    folders = []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(demo_film, "missing", lambda out: [])
    monkeypatch.setattr(demo_film, "film", lambda out: [])
    monkeypatch.setattr(demo_film, "publish", lambda pictures, folder: folders.append(folder))
    out, other = tmp_path / "film", tmp_path / "docs"
    assert demo_film.main(["--cut", "--out", str(out)]) == 0
    assert demo_film.main(["--cut", "--out", str(out), "--publish", str(other)]) == 0
    assert folders == [out, other] and str(out) in capsys.readouterr().out


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_an_interrupt_says_how_to_go_on(tmp_path):
    program = f"""
import sys; sys.path[:0] = [{str(EXAMPLES)!r}, {str(ROOT / "tools")!r}]
from pathlib import Path
from demo_run import exit_code
from steps import Step, run_steps
sleep = Step("a", "a", [sys.executable, "-c", "open('begun', 'w').close(); import time; time.sleep(600)"], 1.0)
sys.exit(exit_code("demo", "make demo", lambda: run_steps([sleep], Path("log"), Path("."), {{}})))
"""
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 30
    while not (tmp_path / "begun").exists():
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=20)[1]
    assert process.returncode == 130 and said == "Interrupted; `make demo` goes on from here\n"


def test_a_caption_of_the_film_keeps_its_spaces_and_lies_below_the_photographs():
    import demo_film

    black = np.zeros((demo_film.SIZE[1], demo_film.SIZE[0], 3))

    def columns(words: str) -> np.ndarray:
        return np.flatnonzero(demo_film.titled(black, words, 1.0).sum(axis=(0, 2)))

    for words in demo_film.WORDS.values():
        gaps = np.diff(columns(words))
        assert (gaps > demo_film.TEXT * 0.2).sum() >= words.count(" "), words
    rows = np.flatnonzero(demo_film.titled(black, demo_film.WORDS["photographs"], 1.0).sum(axis=(1, 2)))
    assert rows[0] >= 5 * demo_film.SIDE and rows[-1] < demo_film.SIZE[1]
