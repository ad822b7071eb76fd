"""Array jobs on a real Slurm of three nodes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from .conftest import PROGRAM, WHOLE, same_pixels
from .slurm_trio import Trio, absent

pytestmark = pytest.mark.skipif(bool(absent()), reason=absent() or "Slurm is there")

#: The first attempt at --frames=3 gets no time, so that it ends with code 75 as when an engine died.
SHAKY = """#!/bin/sh
case "$*" in *--frames=3\\ *) mkdir {mark} 2>/dev/null && exec {program} "$@" --timeout 0.05;; esac
exec {program} "$@"
"""


@pytest.fixture(scope="module")
def trio() -> Iterator[Trio]:
    with tempfile.TemporaryDirectory(prefix="slurm") as root:  # a socket's path must be short
        Path(root).chmod(0o755)
        with Trio(Path(root)) as running:
            yield running


def submit(drgs, trio: Trio, scene: Path, *options: object) -> Path:
    """Submit a job; returns its folder."""
    job = scene.parent / "job"
    code, lines, error = drgs("submit", "slurm", scene, "--no-check", "--to", job, *options)
    assert code == 0, error
    done = subprocess.run(lines[-1], shell=True, env=trio.env, capture_output=True, text=True, cwd=job, timeout=60)
    assert done.returncode == 0, done.stderr
    return job


def logs(job: Path, step: str) -> dict[str, str]:
    """Number of a task -> its log."""
    return {path.stem.rsplit("_", 1)[1]: path.read_text() for path in (job / "logs").glob(f"{step}-*.log")}


@pytest.fixture
def scene(folder, tmp_path) -> Path:
    """A copy of the scene in a folder of its own."""
    for name in ("relative.blend", "tile.drgs"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    return tmp_path / "relative.blend"


def test_chunk_that_ends_with_75_is_queued_again_and_the_second_step_waits(drgs, trio, scene, tmp_path):
    shaky = tmp_path / "drgs.sh"
    shaky.write_text(SHAKY.format(mark=tmp_path / "mark", program=PROGRAM))
    shaky.chmod(0o755)
    rays = ("--samples", "4", "--denoise", "none", "--passes", "temporal")
    job = submit(
        drgs, trio, scene, "--frames", "1-3", "--chunk", 2, "--out", "//noisy/####.exr", "--drgs", shaky,
        "--denoised", "//clean/####.exr", "--options=--samples 4",
    )  # fmt: skip
    trio.until_done(150)
    told = logs(job, "render")
    assert told["0"].count("DRGS_EXIT class=ok") == 1 and "attempt 2" not in told["0"]
    assert [word in told["1"] for word in ("attempt 1", "class=retry", "attempt 2", "class=ok")] == [True] * 4
    alone = tmp_path / "alone"
    assert drgs("render", scene, "--frames", "1-3", "--out", alone / "####.exr", *rays)[0] == 0
    for name in ("0001.exr", "0002.exr", "0003.exr"):
        assert same_pixels(alone / name, tmp_path / "noisy" / name)
        assert (tmp_path / "clean" / name).is_file()


@pytest.mark.parametrize("name", ["50%A of \"a\" 'b'", "#c $HOME;`d` ünï "])
def test_logs_lie_in_the_folder_whatever_its_name(drgs, trio, scene, tmp_path, name):
    folder = tmp_path / name
    folder.mkdir()
    scene = scene.rename(folder / scene.name)
    job = submit(drgs, trio, scene, "--frames", "1", "--out", "//f/####.exr", "--drgs", "sh -c 'echo here'")
    trio.until_done(60)
    (told,) = logs(job, "render").values()
    assert "here" in told


def test_chunk_that_met_a_full_disk_is_queued_again(drgs, trio, scene, tmp_path, monkeypatch):
    monkeypatch.setitem(trio.env, "DRGS_PAUSE", "1")
    job = submit(
        drgs, trio, scene, "--frames", "1", "--out", "//f/####.exr",
        "--drgs", f"sh -c 'mkdir {tmp_path / 'mark'} && exit 73; exit 0'",
    )  # fmt: skip
    trio.until_done(60)
    (told,) = logs(job, "render").values()
    assert "wait for room" in told and "attempt 2" in told and "attempt 3" not in told


def test_chunk_that_always_ends_with_75_is_given_up(drgs, trio, scene):
    job = submit(
        drgs, trio, scene, "--frames", "1-2", "--out", "//f/####.exr", "--denoised", "//clean/####.exr",
        "--drgs", "sh -c 'exit 75'", "--retries", 1,
    )  # fmt: skip
    trio.until_done(60)
    (told,) = logs(job, "render").values()
    assert "given up after 2 attempts" in told and "attempt 3" not in told
    assert not logs(job, "denoise")


def test_sessions_of_openjd_in_an_array_render_and_denoise_what_one_machine_does(drgs, trio, scene, tmp_path):
    pytest.importorskip("openjd.cli")
    job = tmp_path / "job"
    code, lines, error = drgs(
        "submit", "openjd", scene, "--frames", "1-5", "--chunk", 1, "--chunk-seconds", 5, "--out", "//noisy/####.exr",
        "--denoised", "//clean/####.exr", "--no-check", "--to", job, "--drgs", PROGRAM, "--options=--samples 4",
    )  # fmt: skip
    assert code == 0, error
    trio.submit_sessions(job, Path(sys.executable).with_name("openjd"), lines[-1], ["1-2", "3-4", "5"])
    trio.until_done(300)
    for step in ("render", "denoise"):
        told = [(job / f"logs/{step}-{k}.log").read_text() for k in range(3)]
        assert [text.count("Saved: ") for text in told] == [2, 2, 1], told
        assert [text.count("Entering Environment: WarmEngine") for text in told] == [1, 1, 1]
    alone = tmp_path / "alone"
    noisy, clean = alone / "noisy" / "####.exr", alone / "clean" / "####.exr"
    rays = ("--samples", 4, "--denoise", "none", "--passes", "temporal")
    assert drgs("render", scene, "--frames", "1-5", "--out", noisy, *rays)[0] == 0
    assert drgs("denoise", noisy, "--frames", "1-5", "--out", clean)[0] == 0
    for path in (*noisy.parent.iterdir(), *clean.parent.iterdir()):
        assert same_pixels(path, tmp_path / path.parent.name / path.name)


@pytest.mark.skipif(not WHOLE, reason="slow; DRGS_FAULTS=whole runs it")
def test_frames_of_a_node_that_is_lost_are_made_by_another(drgs, trio, scene, tmp_path):
    rays = ("--samples", "2048")
    job = submit(
        drgs, trio, scene, "--frames", "1-12", "--chunk", 3, "--out", "//f/####.exr", "--drgs", PROGRAM,
        f"--options={' '.join(rays)}",
    )  # fmt: skip

    def rendering() -> bool:
        return any(
            "node n2" in text and "Fra:" in text and "DRGS_EXIT" not in text for text in logs(job, "render").values()
        )

    trio.until(rendering, 90)
    trio.kill_node("n2")
    trio.until_done(240)
    alone = tmp_path / "alone"
    assert drgs("render", scene, "--frames", "1-12", "--out", alone / "####.exr", *rays)[0] == 0
    assert len(list(alone.iterdir())) == 12
    assert all(same_pixels(path, tmp_path / "f" / path.name) for path in alone.iterdir())
    saved = [line for text in logs(job, "render").values() for line in text.splitlines() if line.startswith("Saved")]
    assert len(saved) == len(set(saved)) == 12  # no finished frame was made twice
