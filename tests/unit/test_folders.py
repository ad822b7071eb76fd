"""The folder of compiled kernels: what is removed from it, and where it is without a home."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drgs_blender.compute import folders

ROOT = Path(__file__).resolve().parents[2]
OLD = time.time() - 60 * 24 * 3600


def age(path: Path) -> None:
    for each in (*path.rglob("*"), path):
        os.utime(each, (OLD, OLD), follow_symlinks=False)


def test_only_what_is_ours_is_ever_removed(tmp_path: Path) -> None:
    """The variable may name any folder of the user's."""
    ours, theirs = tmp_path / f"geometry-{'a' * 16}", tmp_path / f"mine-{'b' * 16}"
    for folder, name in (
        (ours, "f-0.kernel"),
        (theirs, "f-0.kernel"),
        (theirs, "letter.txt"),
        (tmp_path / "photos", "a.jpg"),
    ):
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x")
    (tmp_path / f"sources-{'c' * 16}.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "loop").symlink_to("loop")
    age(tmp_path)
    folders._prune(tmp_path)
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")}
    assert left == {f"mine-{'b' * 16}", f"mine-{'b' * 16}/letter.txt", "photos", "photos/a.jpg", "notes.txt", "loop"}


def test_what_a_killed_process_was_writing_is_removed_from_a_folder_in_use(tmp_path: Path) -> None:
    folder = tmp_path / f"geometry-{'a' * 16}"
    folder.mkdir()
    for name in (f".f.kernel.{'0' * 12}.tmp", f".g.kernel.{'1' * 12}.tmp", "h-0.kernel"):
        (folder / name).write_bytes(b"x")
    os.utime(folder / f".f.kernel.{'0' * 12}.tmp", (OLD, OLD))
    folders._prune(tmp_path)
    assert {path.name for path in folder.iterdir()} == {f".g.kernel.{'1' * 12}.tmp", "h-0.kernel"}


@pytest.mark.parametrize("named", ["", "relative/folder"])
def test_a_cache_folder_that_is_none_is_as_if_unset(monkeypatch: pytest.MonkeyPatch, named: str) -> None:
    monkeypatch.delenv("DRGS_CACHE_DIR", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    assert folders.wanted_folder() == Path.home() / ".cache/drgs/kernels"


def test_a_folder_that_is_named_relatively_stays_where_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DRGS_CACHE_DIR", "kernels")
    assert folders.wanted_folder() == tmp_path / "kernels"
    monkeypatch.setenv("DRGS_CACHE_DIR", "~/kernels")
    assert folders.wanted_folder() == Path.home() / "kernels"


def test_without_a_home_the_engine_works_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(folders, "wanted_folder", none)
    folders.cache_folder.cache_clear()
    found = folders.cache_folder()
    folders.cache_folder.cache_clear()
    assert found.path is not None and "DRGS_CACHE_DIR" in found.trouble


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="processes are told apart by their numbers")
def test_temporary_folders_end_with_their_processes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also of one that was killed: the next one removes it."""
    program = "import os\nfrom drgs_blender.compute import folders\nprint(folders._temporary())\nos._exit(0)"
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    left = []
    for ending in ("os._exit(0)", "folders._sweep()"):
        command = [sys.executable, "-c", program.replace("os._exit(0)", ending)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        left.append(Path(done.stdout.strip()).exists())
    assert left == [True, False]
    assert not list(tmp_path.iterdir())
