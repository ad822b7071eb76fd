"""``drgs render`` through a real Blender: frames, resuming, overriding, faults. Skipped where there is no Blender."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from blend_files import make_blend_files
from processes import children

from drgs_blender.cli import blender_process
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.cli.main import main
from drgs_blender.core.errors import EngineError
from drgs_blender.render.film.frame_files import read_frame


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset and Blender files that show it moving to the right from frame 1 to 3."""
    folder = tmp_path_factory.mktemp("render")
    make_blend_files(folder)
    return folder


@pytest.fixture
def render(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Function that renders and returns (exit code, lines on stdout, lines on stderr)."""

    def render(*options: str, scene: str = "shot.blend", frames: str = "1-3") -> tuple[int, list[str], list[str]]:
        out = str(tmp_path / "####.exr")
        code = main(["render", str(folder / scene), "--frames", frames, "--out", out, *options])
        captured = capsys.readouterr()
        return code, captured.out.splitlines(), captured.err.splitlines()

    return render


def column(path: Path) -> float:
    """Where the object is in a frame: centre of its coverage in pixels."""
    coverage = read_frame(path)[0]["Coverage"][..., 0]
    return float(coverage.sum(axis=0) @ (np.arange(coverage.shape[1]) + 0.5) / coverage.sum())


@pytest.mark.slow
def test_renders_evaluated_frames_and_resumes(render, tmp_path):
    options = ("--passes", "Coverage,Depth", "--camera-sees", "mesh")
    code, lines, _ = render(*options)
    assert code == 0 and lines[-1] == "DRGS_EXIT class=ok"
    paths = [tmp_path / f"000{n}.exr" for n in (1, 2, 3)]
    assert [re.fullmatch("Saved: '(.*)'", line)[1] for line in lines if line.startswith("Saved")] == [*map(str, paths)]
    assert sorted(tmp_path.iterdir()) == paths
    first = read_frame(paths[0])[0]
    assert {name: p.shape for name, p in first.items()} == {
        "Combined": (24, 32, 4), "Depth": (24, 32, 1), "Coverage": (24, 32, 1)
    }  # fmt: skip
    # 1 m at 6 m distance through a 50 mm lens on a 36 mm sensor, 32 pixels wide.
    assert column(paths[0]) == pytest.approx(16, abs=0.05)
    assert column(paths[2]) - column(paths[0]) == pytest.approx(32 * 50 / 36 / 6, abs=0.1)
    # One square of 1 m; the object that is hidden from renders is not there.
    assert first["Coverage"].sum() == pytest.approx((32 * 50 / 36 / 6) ** 2, rel=0.05)

    stamps = [p.stat().st_mtime_ns for p in paths]
    code, lines, _ = render(*options, "--threads", "1")
    assert code == 0 and sum("skipping existing frame" in line for line in lines) == 3
    assert [p.stat().st_mtime_ns for p in paths] == stamps

    paths[1].write_bytes(paths[1].read_bytes()[:-100])
    paths[2].write_bytes(b"")
    code, lines, _ = render(*options)
    assert code == 0 and [int(p.stat().st_mtime_ns != s) for p, s in zip(paths, stamps)] == [0, 1, 1]
    assert column(paths[2]) > column(paths[1]) > column(paths[0])


@pytest.mark.slow
def test_other_settings_are_rendered_again(render, tmp_path):
    path = tmp_path / "0002.exr"
    render(frames="2")
    before = read_frame(path)[0]["Combined"]
    assert any("Saved" in line for line in render("--seed", "3", frames="2")[1])
    after = read_frame(path)[0]["Combined"]
    assert before.shape == after.shape and not np.array_equal(before, after)
    assert any("Saved" in line for line in render("--seed", "3", "--overwrite", frames="2")[1])
    assert np.array_equal(read_frame(path)[0]["Combined"], after)


@pytest.mark.slow
def test_blur_is_rendered_skipped_and_made_again(render, tmp_path):
    """The shutter is open over half a frame in which the tile moves, and the lens is wide."""

    def rendered(scene: str, word: str, *more: str) -> dict[str, np.ndarray]:
        options = "--passes", "Coverage", "--camera-sees", "mesh", "--filter-width", "0", *more
        code, lines, errors = render(*options, scene=scene, frames="2")
        assert code == 0 and any(line.startswith(word) for line in lines), (lines, errors)
        assert not any(line.startswith("Note") for line in lines)
        return read_frame(tmp_path / "0002.exr")[0]

    blurred = rendered("blurred.blend", "Saved")
    rendered("blurred.blend", "skipping")
    sharp = rendered("shot.blend", "Saved")
    assert np.array_equal(sharp["Coverage"] > 0, blurred["Coverage"] > 0)
    assert not np.array_equal(sharp["Combined"], blurred["Combined"])
    assert np.array_equal(rendered("blurred.blend", "Saved")["Combined"], blurred["Combined"])
    assert not np.array_equal(rendered("blurred.blend", "Saved", "--seed", "3")["Combined"], blurred["Combined"])


@pytest.mark.slow
def test_a_frame_does_not_depend_on_its_chunk(render, tmp_path):
    render(frames="1-3")
    together = read_frame(tmp_path / "0003.exr")[0]["Combined"]
    render("--overwrite", frames="3")
    assert np.array_equal(read_frame(tmp_path / "0003.exr")[0]["Combined"], together)


@pytest.mark.slow
def test_every_view_layer_gets_a_file(render, tmp_path):
    assert render(scene="layers.blend", frames="1")[0] == 0
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["0001_Second_layer.exr", "0001_ViewLayer.exr"]


def test_negative_frames_are_evaluated_where_they_are(render, tmp_path):
    assert render("--passes", "Coverage", "--camera-sees", "mesh", frames="-2,2,3")[0] == 0
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["-0002.exr", "0002.exr", "0003.exr"]
    assert column(tmp_path / "-0002.exr") == pytest.approx(16, abs=0.05)
    assert column(tmp_path / "0002.exr") > 16.5


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="finds Blender in /proc")
def test_job_that_is_killed_leaves_no_folder(folder, tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "drgs_blender.cli.main", "render", str(folder / "shot.blend"), "--frames", "1-9",
         "--out", str(tmp_path / "####.exr"), "--samples", "65536"],
        stdout=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(scratch)},
    )  # fmt: skip
    try:
        while not process.stdout.readline().startswith("Fra:1 "):
            assert process.poll() is None
        assert list(scratch.glob("drgs-*"))
    finally:
        process.kill()
        process.wait()
    deadline = time.monotonic() + 20
    while list(scratch.glob("drgs-*")) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not list(scratch.glob("drgs-*"))


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there are no such signals there")
def test_blender_that_stops_answering_is_ended(folder, monkeypatch):
    monkeypatch.setattr(blender_process, "SILENT_SECONDS", 7.0)
    job = {"scene": str(folder / "shot.blend"), "frames": list(range(1, 9)), "scripts": False, "passes": None}
    with blender_process.BlenderProcess(find_blender(), job, lambda path: "key") as process:
        frames = process.frames()
        next(frames)
        os.kill(process._process.pid, signal.SIGSTOP)
        with pytest.raises(EngineError, match="did not answer for 7 s"):
            next(frames)


@pytest.mark.slow
def test_scripts_in_the_file_run_only_when_allowed(render):
    assert render(scene="script.blend", frames="1")[0] == 0
    code, lines, errors = render("--enable-scripts", scene="script.blend", frames="2")
    assert code == 75 and lines[-1] == "DRGS_EXIT class=retry"
    assert "exit code 9" in errors[-1]


@pytest.mark.slow
def test_scene_faults_have_their_exit_code(render, folder, tmp_path):
    faults = {"blind": "has no camera", "layerless": "has no view layer that is rendered", "empty": "render region"}
    for name, fault in faults.items():
        code, lines, errors = render(scene=f"{name}.blend")
        assert (code, lines[-1]) == (64, "DRGS_EXIT class=usage") and fault in errors[-1], name
    (folder / "torn.blend").write_bytes((folder / "shot.blend").read_bytes()[:200])
    code, lines, errors = render(scene="torn.blend")
    assert (code, lines[-1]) == (65, "DRGS_EXIT class=bad-asset") and "torn.blend" in errors[-1]
    (folder / "tile.drgs").rename(folder / "away.drgs")
    try:
        code, lines, errors = render()
    finally:
        (folder / "away.drgs").rename(folder / "tile.drgs")
    assert (code, lines[-1]) == (65, "DRGS_EXIT class=bad-asset") and "tile.drgs" in errors[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGTERM ends a process at once there")
@pytest.mark.parametrize(("how", "code", "word"), [("SIGTERM", 143, "terminated"), ("SIGINT", 130, "interrupted")])
def test_termination_leaves_nothing_behind(folder, tmp_path, how, code, word):
    """SIGINT as Ctrl+C gives it: to Blender and the engine, too."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    command = [sys.executable, "-m", "drgs_blender.cli.main", "render", str(folder / "shot.blend"), "--frames", "1-9"]
    command += ["--out", str(tmp_path / "####.exr"), "--samples", "65536"]
    environment = os.environ | {"TMPDIR": str(scratch)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True)
    try:
        while not process.stdout.readline().startswith("Fra:1 "):
            assert process.poll() is None
        time.sleep(0.3)
        (process.send_signal if how == "SIGTERM" else partial(os.killpg, process.pid))(getattr(signal, how))
        started = time.monotonic()
        rest, _ = process.communicate(timeout=20)
    finally:
        process.kill()
    assert time.monotonic() - started < 5
    assert process.returncode == code
    assert rest.splitlines()[-1] == f"DRGS_EXIT class={word}"
    assert [p.name for p in tmp_path.iterdir()] == ["scratch"]
    assert not list(scratch.glob("drgs-*"))
    with pytest.raises(ProcessLookupError):  # neither Blender nor the engine outlives it
        deadline = time.monotonic() + 2
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)
            time.sleep(0.05)


def engines_of(process: subprocess.Popen) -> list[int]:
    """Process ids of the engines that `process` runs."""
    return [pid for pid, command in children(process.pid).items() if "drgs_blender.engine" in command]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="finds the engine in /proc")
@pytest.mark.parametrize(("deaths", "code"), [(1, 0), (2, 0), (3, 75)])
def test_engine_killed_in_the_middle_of_a_frame_costs_no_pixel(render, folder, tmp_path, deaths, code):
    """Two engines may die of one frame; the third death gives the frame back to the farm."""
    assert render("--samples", "2048", frames="1")[0] == 0
    (tmp_path / "0001.exr").rename(tmp_path / "calm.exr")
    command = [sys.executable, "-m", "drgs_blender.cli.main", "render", str(folder / "shot.blend"), "--frames", "1"]
    command += ["--out", str(tmp_path / "####.exr"), "--samples", "2048"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    killed: set[int] = set()
    try:
        while not process.stdout.readline().startswith("Fra:1 "):
            assert process.poll() is None
        while len(killed) < deaths:
            for pid in set(engines_of(process)) - killed:
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            assert process.poll() is None or len(killed) == deaths
            time.sleep(0.02)
        rest, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == code
    assert rest.splitlines()[-1] == f"DRGS_EXIT class={'retry' if code else 'ok'}"
    if code:
        assert [p.name for p in tmp_path.iterdir()] == ["calm.exr"]
    else:
        calm, shaken = (read_frame(tmp_path / name)[0]["Combined"] for name in ("calm.exr", "0001.exr"))
        assert np.array_equal(calm, shaken)


@pytest.mark.slow
def test_a_frame_that_takes_too_long_is_given_back(render, tmp_path):
    options = ("--samples", "65536", "--noise-threshold", "0", "--timeout", "4")
    code, lines, errors = render(*options, scene="large.blend", frames="1")
    assert (code, lines[-1]) == (75, "DRGS_EXIT class=retry") and "took longer than 4 s" in errors[-1]
    code, lines, errors = render("--enable-scripts", "--timeout", "6", scene="slow.blend", frames="1")
    assert code == 75 and "evaluated one frame for more than 6 s" in errors[-1]
    assert not list(tmp_path.iterdir())


def test_what_computes_nowhere_is_refused_before_anything_starts(render):
    code, lines, errors = render("--device", "abacus")
    assert (code, lines) == (64, ["DRGS_EXIT class=usage"]) and "abacus" in errors[-1]


@pytest.mark.slow
def test_nothing_is_left_in_the_temporary_folder(render, tmp_path_factory, monkeypatch):
    scratch = tmp_path_factory.mktemp("scratch")
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    assert render(frames="1")[0] == 0
    assert render(scene="blind.blend")[0] == 64
    assert not list(scratch.iterdir())


@pytest.mark.slow
def test_frames_with_the_passes_for_it_are_denoised_over_time(render, tmp_path, capsys):
    """The cameras that neighbours name are the same, so the tile is followed; motion is what Blender's keys say."""
    assert render("--passes", "temporal,Vector", "--denoise", "none")[0] == 0
    code = main(["denoise", str(tmp_path / "####.exr"), "--frames", "1-3", "--out", str(tmp_path / "clean/####.exr")])
    assert code == 0 and "Note" not in capsys.readouterr().out
    from drgs_blender.render.denoise.noisy_frames import read_noisy

    frames = [read_noisy(tmp_path / f"000{n}.exr") for n in (1, 2, 3)]
    assert frames[1].follows(frames[0]) and frames[2].follows(frames[1])
    vector = frames[1].passes["Vector"][frames[1].picture.guides.coverage > 0.99]
    step = column(tmp_path / "0002.exr") - column(tmp_path / "0001.exr")
    assert step > 1 and abs(np.median(vector[:, 0]) + step) < 0.1 and abs(np.median(vector[:, 1])) < 0.01
    clean = read_frame(tmp_path / "clean" / "0002.exr")[0]
    assert "Vector" in clean and "Variance" not in clean
