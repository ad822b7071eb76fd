"""A Blender and an engine that stay from chunk to chunk: the same frames, and gone with whoever needs them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import all_gone, children, listening

from drgs_blender.cli import denoise, session, session_link
from drgs_blender.core.errors import EngineError
from drgs_blender.core.file_lock import FileLock
from drgs_blender.render.film.frame_files import read_frame

from .conftest import PROGRAM, same_pixels

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@pytest.fixture
def warm(tmp_path) -> Iterator[Path]:
    """Folder of a running session."""
    place = tmp_path / "session"
    subprocess.run([*PROGRAM.split(), "session", "start", str(place)], check=True, timeout=90)
    yield place
    session_link.end(place)


def server(place: Path) -> int:
    """Process id of a session."""
    return int((place / "pid").read_text())


def chunk(scene: Path, out: Path, place: Path, frames: str, *options: str) -> subprocess.Popen[str]:
    """``drgs render`` of a task."""
    command = [*PROGRAM.split(), "render", str(scene), "--frames", frames, "--out", str(out / "####.exr")]
    command += ["--session", str(place), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def long_chunk(folder: Path, out: Path, place: Path) -> subprocess.Popen[str]:
    """A task of one frame that lasts longer than any test looks at it."""
    return chunk(folder / "large.blend", out, place, "1", "--samples", "65536")


def told(scene: Path, out: Path, place: Path, frames: str, *options: str) -> tuple[int, list[str], str]:
    """(exit code, lines, errors) of a task."""
    process = chunk(scene, out, place, frames, "--samples", "4", *options)
    text, errors = process.communicate(timeout=400)  # the first may compile kernels
    return process.returncode, text.splitlines(), errors


def family(pid: int) -> set[int]:
    """A process and all it started."""
    return {pid, *children(pid, recursive=True)}


def soon(condition: Callable[[], bool], seconds: float = 20.0) -> bool:
    """Whether `condition` holds in time."""
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return condition()


@pytest.mark.slow
def test_chunks_share_blender_and_engine_and_have_the_same_bits(drgs, folder, warm, tmp_path):
    scene, out, alone = folder / "relative.blend", tmp_path / "out", tmp_path / "alone"
    code, lines, errors = told(scene, out, warm, "3,-2", "--openjd")
    assert (code, errors) == (0, "") and lines[-1] == "DRGS_EXIT class=ok"
    assert lines.count("openjd_progress: 100.0") == 1
    used = family(server(warm))
    assert len(used) == 3  # itself, the engine and Blender
    assert not set().union(*(listening(pid) for pid in used))
    assert told(scene, out, warm, "1-2")[0] == 0
    code, lines, _ = told(scene, out, warm, "2-3")
    assert code == 0 and sum(line.startswith("skipping") for line in lines) == 2
    assert family(server(warm)) == used
    assert drgs("render", scene, "--frames=-2,1-3", "--out", alone / "####.exr", "--samples", 4)[0] == 0
    assert sorted(p.name for p in out.iterdir()) == ["-0002.exr", "0001.exr", "0002.exr", "0003.exr"]
    assert all(same_pixels(path, alone / path.name) for path in out.iterdir())
    session_link.end(warm)
    assert all_gone(used, 5) and sorted(p.name for p in warm.iterdir() if "-" in p.name or p.suffix) == []


@pytest.mark.slow
def test_what_fails_has_its_code_and_the_session_goes_on(folder, warm, tmp_path, small_disk):
    scene, out = folder / "relative.blend", tmp_path / "out"
    code, lines, errors = told(folder / "blind.blend", out, warm, "1")
    assert (code, lines) == (64, ["DRGS_EXIT class=usage"]) and "has no camera" in errors
    code, lines, errors = told(tmp_path / os.fsdecode(b"\xff.blend"), out, warm, "1")
    assert (code, lines) == (65, ["DRGS_EXIT class=bad-asset"]) and "does not exist" in errors
    disk = small_disk("size=16k")
    (disk / "filler").write_bytes(bytes(16 << 10))
    assert told(scene, disk, warm, "1")[0] == 73
    assert told(scene, out, warm, "1")[0] == 0


@pytest.mark.slow
def test_scene_saved_anew_is_opened_anew(folder, warm, tmp_path):
    scene = tmp_path / "scene.blend"
    (tmp_path / "tile.drgs").write_bytes((folder / "tile.drgs").read_bytes())
    shapes = []
    for source in ("relative.blend", "large.blend"):
        scene.write_bytes((folder / source).read_bytes())
        assert told(scene, tmp_path / source, warm, "1", "--noise-threshold", "0.5")[0] == 0
        shapes.append(read_frame(tmp_path / source / "0001.exr")[0]["Combined"].shape)
    assert shapes == [(24, 32, 4), (480, 640, 4)]


@pytest.mark.slow
def test_dead_blender_or_engine_costs_nothing_afterwards(folder, warm, tmp_path):
    scene = folder / "relative.blend"
    assert told(scene, tmp_path / "out", warm, "1")[0] == 0
    for pid in family(server(warm)) - {server(warm)}:
        os.kill(pid, signal.SIGKILL)
    assert told(scene, tmp_path / "out", warm, "2-3")[0] == 0


@pytest.mark.slow
def test_dead_session_gives_the_chunk_back_and_the_next_one_renders_by_itself(folder, warm, tmp_path):
    scene, out = folder / "relative.blend", tmp_path / "out"
    process = long_chunk(folder, out, warm)
    assert process.stdout.readline().startswith("Fra:1")
    all_of_it = family(server(warm))
    os.kill(server(warm), signal.SIGKILL)
    text, errors = process.communicate(timeout=30)
    assert process.returncode == 75 and "its process died" in errors and "class=retry" in text
    assert all_gone(all_of_it, 5)
    assert told(scene, out, warm, "1")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_task_that_is_ended_takes_its_frame_along(folder, warm, tmp_path, how):
    process = long_chunk(folder, tmp_path / "out", warm)
    assert process.stdout.readline().startswith("Fra:1")
    all_of_it = family(server(warm))
    if how == signal.SIGKILL:
        process.kill()
        process.wait()
        assert all_gone(all_of_it, 5)
    else:
        process.send_signal(how)
        started = time.monotonic()
        text, _ = process.communicate(timeout=20)
        assert process.returncode == 143 and text.splitlines()[-1] == "DRGS_EXIT class=terminated"
        assert all_gone(all_of_it, started + 5 - time.monotonic())
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_session_that_hangs_is_ended_and_the_chunk_given_back(folder, warm, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(session_link, "SILENT_SECONDS", 3.0)
    assert told(folder / "relative.blend", tmp_path / "out", warm, "1")[0] == 0
    all_of_it = family(server(warm))
    os.kill(server(warm), signal.SIGSTOP)
    started = time.monotonic()
    with pytest.raises(EngineError, match="said nothing for 3 s"):
        session_link.delegate(warm, ["render", "a.blend", "--frames", "1", "--out", "#.exr"])
    assert time.monotonic() - started < 15
    assert all_gone(all_of_it, 5) and not session_link.is_running(warm)


@pytest.mark.slow
def test_request_that_is_lost_is_given_back(folder, warm, tmp_path):
    process = long_chunk(folder, tmp_path / "out", warm)
    assert process.stdout.readline().startswith("Fra:1")
    for request in warm.glob("request-*.json"):
        request.unlink()
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 75 and "Try again" in errors


@pytest.mark.slow
def test_frames_are_denoised_by_the_warm_process(drgs, folder, warm, tmp_path, monkeypatch):
    noisy, here, there = (tmp_path / name / "####.exr" for name in ("noisy", "here", "there"))
    options = ("--samples", 4, "--denoise", "none", "--passes", "temporal")
    assert drgs("render", folder / "relative.blend", "--frames", "1-3", "--out", noisy, *options)[0] == 0
    job = ("denoise", noisy, "--frames", "1-3", "--openjd", "--out")
    with monkeypatch.context() as patch:
        patch.setattr(denoise, "denoise", None)  # this process does not
        code, lines, errors = drgs(*job, there, "--session", warm)
    assert (code, errors, lines[-1]) == (0, "", "DRGS_EXIT class=ok") and "openjd_progress: 100.0" in lines
    assert drgs(*job, here)[0] == 0
    assert len(list(here.parent.iterdir())) == 3
    assert all(path.read_bytes() == (there.parent / path.name).read_bytes() for path in here.parent.iterdir())


@pytest.mark.slow
def test_session_ends_without_its_folder_its_farm_or_work(tmp_path):
    start = [*PROGRAM.split(), "session", "start"]
    places = [tmp_path / name for name in ("folder", "farm", "work")]
    worker = subprocess.Popen(
        ["sh", "-c", f"(PATH=$PATH; {' '.join(start)} {places[1]}); sleep 60"], stdout=subprocess.DEVNULL
    )
    subprocess.run([*start, str(places[0])], check=True, timeout=90)
    subprocess.run([*start, str(places[2]), "--idle", "1"], check=True, timeout=90)
    try:
        assert soon(lambda: session_link.is_running(places[1]))
        assert soon(lambda: not session_link.is_running(places[2]))
        pid = server(places[0])
        assert session_link.is_running(places[0])
        for path in places[0].iterdir():
            path.unlink()
        places[0].rmdir()
        assert all_gone({pid}, 5)
        time.sleep(max(0.0, 6 - (time.time() - (places[1] / "pid").stat().st_mtime)))
        assert session_link.is_running(places[1])
    finally:
        subprocess.run(["pkill", "-P", str(worker.pid)], check=False)
        worker.kill()
        worker.wait()
    assert soon(lambda: not session_link.is_running(places[1]))


def test_chunk_that_comes_at_once_is_not_taken_for_an_old_one(tmp_path, monkeypatch):
    """Whoever sees the lock taken may ask, before the new session has tidied up what a killed one left."""
    (tmp_path / "request-00000000.json").touch()

    class Seen(FileLock):
        def acquire(self, patience: float = 0.0) -> bool:
            taken = super().acquire(patience)
            (tmp_path / "request-11111111.json").touch()
            return taken

    monkeypatch.setattr(session, "FileLock", Seen)
    lock = session._claim(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lock", "pid", "request-11111111.json"]
    lock.close()


@pytest.mark.parametrize("action", ["start", "serve"])
def test_folder_with_other_files_is_left_as_it_is(drgs, tmp_path, action):
    (tmp_path / "lock").touch()
    (tmp_path / "letter.txt").write_text("dear")
    (tmp_path / "log").write_text("mine")
    code, _, error = drgs("session", action, tmp_path)
    assert code == 64 and "letter.txt" in error
    assert (tmp_path / "letter.txt").read_text() == "dear" and (tmp_path / "log").read_text() == "mine"


def test_folders_that_cannot_be_are_said(drgs, tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / ("x" * 300)):
        code, _, error = drgs("session", "start", folder)
        assert code == 73 and str(folder) in error
        assert drgs("session", "stop", folder)[0] == 0


def test_folder_in_which_others_write_is_refused(drgs, tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    code, _, error = drgs("session", "start", tmp_path / "open")
    assert code == 64 and "others may write" in error
