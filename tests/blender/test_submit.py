"""The farm panel: a job is written from the saved file by the engine's own `drgs submit`."""

from __future__ import annotations

import json
import time
from pathlib import Path

import bpy
import pytest
from scenes import part

submit = part("addon.submit")
messages = part("addon.messages")


@pytest.fixture
def settings(scene, ball, tmp_path):
    """Settings of a saved scene with an object."""
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 5, 2
    settings = scene.drgs.submit
    settings.out, settings.folder, settings.use_check = "//f/####.exr", "//job", False
    yield settings
    submit.job = None


def write() -> set[str]:
    """Save and submit."""
    bpy.ops.wm.save_mainfile()
    return bpy.ops.drgs.submit()


@pytest.mark.parametrize(
    ("manager", "file", "starts"),
    [("openjd", "template.json", "openjd run "), ("slurm", "render.sbatch", "sh "), ("flamenco", "job.json", "curl ")],
)
def test_a_job_is_written_and_its_command_shown(settings, tmp_path, capfd, manager, file, starts):
    settings.manager, settings.chunk, settings.options = manager, 2, "--samples 16"
    settings.use_denoise, settings.denoised = True, "//clean/####.exr"
    settings.sbatch, settings.retries = "--partition=farm --mem=8G", 7
    assert write() == {"FINISHED"}
    text = (tmp_path / "job" / file).read_text()
    assert str(tmp_path / "f" / "####.exr") in text or manager == "openjd"
    assert submit.job.command.startswith(starts) and "3 frames in 2 tasks" in submit.job.text
    assert f"Info: {submit.job.command}" in capfd.readouterr().out, "without a window it is printed"
    assert "16" in text and submit.job.error == ""
    if manager == "slurm":
        assert "#SBATCH --partition=farm" in text and "#SBATCH --mem=8G" in text and ">= 7" in text
        assert "chunks=(1,3 5)" in text and (tmp_path / "job" / "denoise.sbatch").is_file()
    elif manager == "flamenco":
        assert json.loads(text)["settings"]["frames"] == "1,3,5"
    assert bpy.ops.drgs.copy_submit() == {"FINISHED"}


@pytest.mark.slow
@pytest.mark.blender_api
def test_what_a_node_would_miss_is_told(settings, tmp_path):
    settings.use_check, settings.shared = True, str(tmp_path / "assets")
    with pytest.raises(RuntimeError, match="a node would miss"):
        write()
    assert any("is not in a shared folder" in note for note in submit.job.notes)
    assert not submit.job.command and not bpy.ops.drgs.copy_submit.poll()
    assert not (tmp_path / "job").exists() and messages.history[-1].level == "ERROR"
    settings.shared = str(tmp_path)
    assert write() == {"FINISHED"} and submit.job.command


def test_bad_settings_are_refused_by_name(settings):
    settings.manager, settings.sbatch = "slurm", "--comment='open"
    with pytest.raises(RuntimeError, match="Options of sbatch"):
        write()
    settings.sbatch, settings.options = "", "--frames 7"
    with pytest.raises(RuntimeError, match="which the job itself gives"):
        write()
    settings.options, settings.out = "", "//f/one.exr"
    with pytest.raises(RuntimeError, match="has no #"):
        write()


def test_files_that_are_not_saved_are_not_submitted(scene, settings):
    bpy.ops.wm.save_mainfile()
    assert bpy.ops.drgs.submit.poll()
    Path(bpy.data.filepath).unlink()
    with pytest.raises(RuntimeError, match="not there any more"):
        bpy.ops.drgs.submit()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert not bpy.ops.drgs.submit.poll()


def test_a_job_under_way_is_followed_and_cancelled(scene, settings, monkeypatch):
    bpy.ops.wm.save_mainfile()
    monkeypatch.setattr(submit, "job", submit.Submission(scene))
    assert submit.running() and not bpy.ops.drgs.submit.poll()
    assert submit.follow() == submit.INTERVAL or submit.job.done
    deadline = time.monotonic() + 60
    while submit.follow() is not None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert submit.job.command
    settings.use_check = True
    monkeypatch.setattr(submit, "job", submit.Submission(scene))
    assert bpy.ops.drgs.submit_cancel() == {"FINISHED"}
    assert not submit.running() and not submit.job.command and submit.job.text == "Cancelled"
