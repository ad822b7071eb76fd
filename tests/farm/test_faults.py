"""Real faults of a node: every frame under its name is whole, every other ends with the code that farms expect."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from processes import all_gone, children, listening

from drgs_blender.cli.find_blender import CHECKOUT
from drgs_blender.core.asset.container import read_asset, write_asset

from .conftest import PROGRAM, WHOLE, same_pixels

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def start(folder: Path, out: Path, frames: str, *options: str, scratch: Path | None = None) -> subprocess.Popen[str]:
    """``drgs render`` in a process of its own, whose temporary files are in `scratch`."""
    environment = os.environ | ({"TMPDIR": str(scratch)} if scratch else {})
    command = [*PROGRAM.split(), "render", str(folder / "shot.blend"), "--frames", frames]
    command += ["--out", str(out / "####.exr"), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


@pytest.mark.slow
def test_full_disk_gives_no_frame_and_the_frame_once_there_is_room(drgs, folder, small_disk):
    disk = small_disk("size=16k")
    (disk / "filler").write_bytes(bytes(16 << 10))
    job = ("render", folder / "shot.blend", "--frames", "1-2", "--out", disk / "####.exr", "--samples", 4)
    code, lines, error = drgs(*job)
    assert (code, lines[-1]) == (73, "DRGS_EXIT class=cannot-write")
    assert "0001.exr" in error and not any(line.startswith("Saved") for line in lines)
    assert [path.name for path in disk.iterdir()] == ["filler"]
    small_disk("size=1m")
    code, lines, _ = drgs(*job)
    assert code == 0 and sum(line.startswith("Saved") for line in lines) == 2


def test_folder_that_cannot_be_written_is_found_before_anything_is_rendered(drgs, folder, small_disk):
    disk = small_disk("ro")
    code, lines, error = drgs("render", folder / "shot.blend", "--frames", "1", "--out", disk / "####.exr")
    assert (code, lines) == (73, ["DRGS_EXIT class=cannot-write"]) and "ead-only" in error


@pytest.mark.slow
def test_denoised_frames_meet_full_and_sealed_disks_as_rendered_ones_do(drgs, folder, small_disk, tmp_path):
    noisy = tmp_path / "noisy" / "####.exr"
    options = ("--samples", 4, "--denoise", "none", "--passes", "temporal")
    assert drgs("render", folder / "shot.blend", "--frames", "1-2", "--out", noisy, *options)[0] == 0
    disk = small_disk("size=16k")
    job = ("denoise", noisy, "--frames", "1-2", "--out", disk / "####.exr")
    (disk / "filler").write_bytes(bytes(16 << 10))
    code, lines, error = drgs(*job)
    assert (code, lines[-1]) == (73, "DRGS_EXIT class=cannot-write") and "0001.exr" in error
    assert [path.name for path in disk.iterdir()] == ["filler"]
    small_disk("ro")
    code, lines, _ = drgs(*job)
    assert (code, lines) == (73, ["DRGS_EXIT class=cannot-write"])
    small_disk("rw,size=1m")
    code, lines, _ = drgs(*job)
    assert code == 0 and sum(line.startswith("Saved") for line in lines) == 2


@pytest.mark.slow
@linux
def test_log_on_a_full_disk_costs_neither_frame_nor_code(folder, tmp_path):
    """Logs lie on the disk of the frames as a rule; when it has room again the job goes on."""
    for scene, code in (("shot.blend", 0), ("blind.blend", 64)):
        command = [*PROGRAM.split(), "render", str(folder / scene), "--frames", "1-2", "--samples", "4"]
        command += ["--out", str(tmp_path / "####.exr")]
        with open("/dev/full", "w") as full:
            done = subprocess.run(command, stdout=full, stderr=full, timeout=120)
        assert done.returncode == code
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0001.exr", "0002.exr"]


def test_full_disk_of_temporary_files_is_said_and_can_be_tried_again(folder, small_disk, tmp_path):
    disk = small_disk("size=16k,nr_inodes=3")
    (disk / "filler").touch()
    process = start(folder, tmp_path / "out", "1", scratch=disk)
    out, error = process.communicate(timeout=60)
    assert (process.returncode, out.splitlines()[-1]) == (73, "DRGS_EXIT class=cannot-write"), error
    assert "temporary files" in error and "TMPDIR" in error
    assert [path.name for path in disk.iterdir()] == ["filler"]


@pytest.mark.slow
def test_frames_of_an_asset_that_changes_meanwhile_are_not_kept(folder, tmp_path):
    """They would be of the old content and bear the hash of the new one."""
    for name in ("relative.blend", "tile.drgs"):
        shutil.copy(folder / name, tmp_path)
    (tmp_path / "relative.blend").rename(tmp_path / "shot.blend")
    asset = read_asset(tmp_path / "tile.drgs")
    process = start(tmp_path, tmp_path / "out", "1-9", "--samples", "65536")
    while not process.stdout.readline().startswith("Fra:1 "):
        assert process.poll() is None
    write_asset(tmp_path / "tile.drgs", replace(asset, mesh=replace(asset.mesh, albedo=0.5 * asset.mesh.albedo)))
    _, error = process.communicate(timeout=60)
    assert process.returncode == 75 and "tile.drgs" in error and "rewritten" in error
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_asset_that_is_copied_over_in_place_gives_the_job_back(folder, tmp_path):
    """As `cp` and `scp` do it: first the file is cut off, while the engine has it mapped."""
    for name in ("relative.blend", "tile.drgs"):
        shutil.copy(folder / name, tmp_path)
    (tmp_path / "relative.blend").rename(tmp_path / "shot.blend")
    process = start(tmp_path, tmp_path / "out", "1-9", "--samples", "65536")
    while not process.stdout.readline().startswith("Fra:1 "):
        assert process.poll() is None
    os.truncate(tmp_path / "tile.drgs", 100)
    out, error = process.communicate(timeout=60)
    assert (process.returncode, out.splitlines()[-1]) == (75, "DRGS_EXIT class=retry"), error
    assert "tile.drgs" in error and "rewritten" in error
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_memory_that_does_not_do_gives_the_frame_back(drgs, folder, tmp_path):
    job = ("render", folder / "large.blend", "--frames", "1", "--samples", "4", "--passes", "all")
    code, lines, error = drgs(*job, "--memory-mb", 256, "--out", tmp_path / "####.exr")
    assert (code, lines[-1]) == (75, "DRGS_EXIT class=retry"), error
    assert not list(tmp_path.iterdir())
    code, _, error = drgs(*job, "--memory-mb", 4000, "--out", tmp_path / "####.exr")
    assert code == 0, error


@pytest.mark.slow
def test_unfinished_frames_of_killed_writers_go(drgs, folder, tmp_path):
    """Those of the same job that nobody adds to; other files stay, and those of a node whose clock is ahead."""
    names = [".a_0007.exr.x1.tmp", ".a_0001.exr.x2.tmp", ".b_0001.exr.x3.tmp", "notes.tmp", ".a_0002.exr.x4.tmp"]
    for name in names:
        (tmp_path / name).touch()
    for name in (names[0], *names[2:4]):
        os.utime(tmp_path / name, (0, 0))
    ahead = (4e9, 4e9)
    os.utime(tmp_path / names[4], ahead)
    job = ("render", folder / "shot.blend", "--frames", "1", "--out", tmp_path / "a_####.exr", "--samples", 4)
    assert drgs(*job)[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names[1:], "a_0001.exr"])
    for when in ((0, 0), ahead):  # what was made before what is nobody's business
        os.utime(tmp_path / "a_0001.exr", when)
        assert sum(line.startswith("skipping") for line in drgs(*job)[1]) == 1


#: A kernel that says whether it was compiled.
KERNEL = """
from drgs_blender.compute.jit import njit
@njit
def double(x):
    return 2 * x
print(double(21), *double.stats.cache_hits.values())
"""


@pytest.mark.slow
def test_kernels_are_compiled_where_they_cannot_be_kept_or_read(small_disk, tmp_path):
    """A full disk; and files that a node left empty or cut off when it lost its power."""
    program = tmp_path / "kernel.py"
    program.write_text(KERNEL)

    def said(folder: Path) -> tuple[str, str]:
        environment = os.environ | {"DRGS_CACHE_DIR": str(folder), "PYTHONPATH": str(CHECKOUT)}
        done = subprocess.run([sys.executable, str(program)], env=environment, capture_output=True, text=True)
        assert done.returncode == 0
        return done.stdout.strip(), done.stderr

    kept = tmp_path / "kept"
    assert [said(kept), said(kept)] == [("42", ""), ("42 1", "")]
    for length in (0, 20):
        (path,) = kept.rglob("*.kernel")
        path.write_bytes(path.read_bytes()[:length])
        result, told = said(kept)
        assert result == "42" and "damaged" in told and path.name in told
        assert said(kept) == ("42 1", "")
    disk = small_disk("size=16k")
    with contextlib.suppress(OSError), open(disk / "filler", "wb") as file:
        file.write(bytes(16 << 10))
    result, told = said(disk / "kernels")
    assert result == "42" and str(disk) in told and "space" in told


@pytest.mark.slow
@linux
@pytest.mark.parametrize("attempt", range(20 if WHOLE else 1))
def test_killed_blender_gives_the_job_back_and_takes_the_engine_along(folder, tmp_path, attempt):
    shared = set(os.listdir("/dev/shm"))
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    process = start(folder, tmp_path / "out", "1-9", "--samples", "65536", scratch=scratch)
    try:
        while not process.stdout.readline().startswith("Fra:1 "):
            assert process.poll() is None
        time.sleep(0.02 * attempt)
        started = children(process.pid)
        assert not set().union(*(listening(pid) for pid in (process.pid, *started)))
        blender = [pid for pid, line in started.items() if "blender_job.py" in line]
        assert len(blender) == 1 and len(started) == 2
        os.kill(blender[0], signal.SIGKILL)
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 75 and out.splitlines()[-1] == "DRGS_EXIT class=retry" and "Blender" in error
    assert all_gone(started, 2)
    assert all(path.suffix == ".exr" and path.name[0] != "." for path in (tmp_path / "out").iterdir())
    assert not list(scratch.iterdir()) and set(os.listdir("/dev/shm")) <= shared


@pytest.mark.slow
def test_two_jobs_on_one_folder_do_not_disturb_each_other(drgs, folder, tmp_path):
    alone, both = tmp_path / "alone", tmp_path / "both"
    assert drgs("render", folder / "shot.blend", "--frames", "1-3", "--out", alone / "####.exr", "--samples", 4)[0] == 0
    jobs = [start(folder, both, "1-3", "--samples", "4") for _ in range(2)]
    results = [job.communicate(timeout=120) for job in jobs]
    assert [job.returncode for job in jobs] == [0, 0], results
    assert sorted(path.name for path in both.iterdir()) == ["0001.exr", "0002.exr", "0003.exr"]
    assert all(same_pixels(alone / path.name, path) for path in both.iterdir())


@linux
@pytest.mark.skipif(not WHOLE, reason="slow; DRGS_FAULTS=whole runs it")
def test_fifty_engines_killed_in_the_middle_of_frames_cost_no_pixel(drgs, folder, tmp_path):
    """Killed at moments that are spread over the frame; each is noticed, and the frame made by the next engine."""
    calm, shaken = tmp_path / "calm", tmp_path / "shaken"
    rays = ("--samples", "65536")  # longer than the longest delay
    assert drgs("render", folder / "shot.blend", "--frames", "1-50", "--out", calm / "####.exr", *rays)[0] == 0
    process = start(folder, shaken, "1-50", *rays)
    killed: set[str] = set()  # in which frames; a frame that is made again may say so twice
    try:
        for line in process.stdout:
            if line.startswith("Fra:") and "| Rendering | Sample 0/" in line:
                if (frame := line.split()[0]) in killed:
                    continue
                time.sleep(0.02 * (len(killed) % 10))
                for pid, command in children(process.pid).items():
                    if "drgs_blender.engine" in command:
                        os.kill(pid, signal.SIGKILL)
                        killed.add(frame)
    finally:
        process.kill()
    assert process.wait() == 0 and len(killed) == 50, process.stderr.read()
    assert all(same_pixels(calm / path.name, path) for path in sorted(shaken.iterdir()))
