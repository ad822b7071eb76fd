"""`drgs capture`, `drgs markers`, and `drgs reconstruct` of photographs without cameras."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import captures
import numpy as np
import pytest
from PIL import Image

from drgs_blender.capture import libraries, pipeline
from drgs_blender.capture.capture_folder import INPUTS, WORK, keep_work
from drgs_blender.capture.masks.default_mode import resolve_mode
from drgs_blender.cli import uncalibrated
from drgs_blender.cli.main import main
from drgs_blender.core.errors import (
    EXIT_BAD_ASSET,
    EXIT_INTERRUPTED,
    EXIT_NO_DEVICE,
    EXIT_USAGE,
    AssetError,
    Cancelled,
    DeviceError,
)
from drgs_blender.reconstruct.readers import has_cameras, read_capture
from drgs_blender.reconstruct.settings import Reading

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def photographs(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        Image.fromarray(np.random.default_rng(k).integers(0, 255, (24, 32, 3), np.uint8)).save(folder / f"{k}.png")
    return folder


def test_three_pictures_are_refused_before_any_work(photographs, tmp_path, capsys):
    words = ["capture", str(photographs), "--out", str(tmp_path / "out"), "--poses", "features", "--no-progress"]
    assert main(words) == EXIT_BAD_ASSET
    assert "has 3 usable pictures (0.png, 1.png, 2.png)" in capsys.readouterr().err


def test_damaged_exif_is_none_without_a_word_that_names_no_file(photographs, tmp_path):
    data = Image.Exif()
    data[271] = "Maker"
    Image.new("RGB", (32, 24)).save(photographs / "a.jpg", exif=data.tobytes()[:20])
    command = [
        sys.executable,
        "-m",
        "drgs_blender.cli.main",
        "capture",
        str(photographs),
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run([*command, "--masks", "none"], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert done.returncode == EXIT_BAD_ASSET and "has 4 usable pictures" in done.stderr
    assert "Warning" not in done.stderr


def test_lengths_are_above_zero(photographs, tmp_path, capsys):
    words = ["capture", str(photographs), "--out", str(tmp_path / "out"), "--marker-length", "-3"]
    assert main(words) == EXIT_USAGE
    assert "-3 is no length above zero" in capsys.readouterr().err


def test_cameras_are_found_for_a_reconstruction_that_has_none(photographs, tmp_path, capsys, monkeypatch):
    pytest.importorskip("torch")
    asked = []

    def refuse(source, folder, settings, *_):
        asked.append((source, folder, settings.masks))
        raise AssetError(str(source), "cannot be calibrated")

    monkeypatch.setattr(pipeline, "make_capture", refuse)
    words = ["reconstruct", str(photographs), "--out", str(tmp_path / "a.drgs")]
    assert main(words) == main([*words, "--masks", "given"]) == EXIT_BAD_ASSET
    assert asked == [(photographs, tmp_path / "a.capture", masks) for masks in ("auto", "given")]
    first, second = (line for line in capsys.readouterr().err.splitlines() if "has no cameras" in line)
    # Programs take what begins with "drgs:" for a warning or an error.
    assert first == f"{second}; masks are made where none are given (--masks auto)" and not first.startswith("drgs:")


SETTINGS = {
    "video_frames": ("frames", 120),
    "feature_resolution": ("size", 2000),
    "poses": ("poses", "markers"),
    "marker_length": ("marker_length", 29.4),
    "camera_distance": ("distance", 2.5),
    "brackets": ("brackets", "3"),
}


@pytest.mark.parametrize("how", ["reconstruct", "capture", "set", "config"])
def test_all_options_of_a_capture_reach_it_whoever_makes_it(photographs, tmp_path, monkeypatch, how):
    pytest.importorskip("torch")
    asked = []

    def refuse(source, folder, settings, *_):
        asked.append(settings)
        raise AssetError(str(source), "cannot be calibrated")

    monkeypatch.setattr(pipeline, "make_capture", refuse)
    words = ["capture" if how == "capture" else "reconstruct", str(photographs), "--out", str(tmp_path / "a.drgs")]
    values = {name: value for name, (_, value) in SETTINGS.items()}
    if how == "config":
        (tmp_path / "s.toml").write_text("[capture]\n" + "".join(f"{k} = {v!r}\n" for k, v in values.items()))
        words += ["--config", str(tmp_path / "s.toml")]
    for name, value in values.items() if how != "config" else ():
        option = ["--set", f"capture.{name}={value}"] if how == "set" else [f"--{name.replace('_', '-')}", str(value)]
        words += option
    assert main(words) == EXIT_BAD_ASSET
    wanted = {field: value for field, value in SETTINGS.values()}
    assert asked == [pipeline.Settings(masks="auto", **wanted)]
    asked.clear()
    assert main([*words[:4], "--masks", "none"]) == EXIT_BAD_ASSET
    assert asked == [pipeline.Settings(masks="none")]  # all others have one default


def test_what_only_photographs_without_cameras_need_is_told_of_others(photographs, caplog):
    scene = captures.make(photographs.parent / "c")
    captures.write_nerfstudio(scene)
    reading = Reading(video_frames=50, marker_length=29.0)
    uncalibrated.tell_unused(reading, scene.folder, calibrated=True)
    assert caplog.messages == [
        f"{scene.folder}: capture.video_frames, capture.marker_length: no effect, it has cameras"
    ]
    caplog.clear()
    uncalibrated.tell_unused(reading, photographs, calibrated=False)
    assert caplog.messages == [f"{photographs}: capture.video_frames: no effect, it is no video"]
    caplog.clear()
    marked = Reading(poses="features", marker_length=29.0)
    uncalibrated.tell_unused(marked, photographs, calibrated=False)
    assert caplog.messages == [f"{photographs}: capture.marker_length: no effect, capture.poses is features"]
    caplog.clear()
    (video := photographs.parent / "walk.mp4").touch()
    uncalibrated.tell_unused(reading, video, calibrated=False)
    uncalibrated.tell_unused(Reading(), scene.folder, calibrated=True)
    assert not caplog.messages


def test_masks_are_made_without_cameras_or_refused_before_long_work(photographs, tmp_path, monkeypatch, capsys):
    """Where a library lacks, given masks and alpha count, and what has neither is told what to do."""
    default = Reading().masks
    assert resolve_mode(default, photographs, calibrated=True) == "given"
    assert resolve_mode("none", photographs, calibrated=False) == "none"
    load = libraries.load

    def lacking(name):
        if name == "torch":
            raise DeviceError("masks", "needs torch, which cannot be loaded (it is not there)", "Install it: pip")
        return load(name)

    monkeypatch.setattr(libraries, "load", lacking)
    words = ["capture", str(photographs), "--out", str(tmp_path / "out")]
    assert main(words) == EXIT_NO_DEVICE
    said = capsys.readouterr().err
    assert "has no masks, and making them needs torch" in said and "Install it: pip, or give --masks none" in said
    assert not (tmp_path / "out").exists()
    with Image.open(photographs / "1.png") as image:
        image.putalpha(255)
        image.save(photographs / "1.png")
    with pytest.raises(DeviceError):  # opaque all over
        resolve_mode(default, photographs, calibrated=False)
    pixels = np.asarray(Image.open(photographs / "1.png")).copy()
    pixels[:5, :, 3] = 0
    Image.fromarray(pixels).save(photographs / "1.png")
    assert resolve_mode(default, photographs, calibrated=False) == "given"
    (photographs / "1.png").unlink()
    (photographs / "masks").mkdir()
    Image.new("L", (32, 24), 255).save(photographs / "masks" / "2.png")
    assert resolve_mode(default, photographs, calibrated=False) == "given"


def test_what_has_cameras_or_no_pictures_is_left_to_the_readers(tmp_path, photographs):
    assert not has_cameras(photographs) and not has_cameras(tmp_path / "absent")
    scene = captures.make(tmp_path / "c")
    captures.write_nerfstudio(scene)
    assert has_cameras(scene.folder)


def test_what_is_expected_of_a_folder_without_pictures_is_said(tmp_path, capsys):
    """Not that another command would take them: this one does."""
    (tmp_path / "notes.txt").touch()
    for path, problem in ((tmp_path, "holds no pictures"), (tmp_path / "notes.txt", "is neither a folder of")):
        assert main(["reconstruct", str(path), "--out", str(tmp_path / "o.drgs")]) == EXIT_BAD_ASSET
        said = capsys.readouterr().err
        assert f"{path}: {problem}" in said and "or in its images, photos or input, a video, or" in said
        assert "drgs capture" not in said


def test_a_world_that_is_to_stay_stays_and_brings_its_points(tmp_path, caplog):
    import json

    scene = captures.make(tmp_path / "c")
    captures.write_nerfstudio(scene)
    path = scene.folder / "transforms.json"
    data = json.loads(path.read_text())
    tilt = np.array([[1.0, 0, 0, 0], [0, 0.6, -0.8, 0], [0, 0.8, 0.6, 0], [0, 0, 0, 1]])
    for frame in data["frames"]:
        frame["transform_matrix"] = (tilt @ frame["transform_matrix"]).tolist()
    data |= {"orientation_override": "none", "ply_file_path": "points.ply"}
    path.write_text(json.dumps(data))
    read_capture(scene.folder)
    assert "points.ply" in caplog.text  # absent: said, and not used
    (scene.folder / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "1 2 3\n4 5 6\n"
    )
    capture = read_capture(scene.folder)
    np.testing.assert_allclose(capture.points, [[1, 2, 3], [4, 5, 6]])
    found = np.stack([view.camera.matrix_world for view in capture.views])
    wanted = np.stack([tilt @ matrix for matrix in scene.cameras])
    for matrix in wanted:
        assert np.abs(found - matrix).max(axis=(1, 2)).min() < 2e-5


def test_the_number_of_a_bracket_is_checked_and_handed_on(photographs, tmp_path, capsys, monkeypatch):
    words = ["capture", str(photographs), "--out", str(tmp_path / "out"), "--no-progress"]
    for wrong in ("1", "10", "some"):
        assert main([*words, "--brackets", wrong]) == EXIT_USAGE
    capsys.readouterr()
    assert main([*words, "--brackets", "3"]) == EXIT_BAD_ASSET  # no EXIF
    assert "has no 3 files that follow each other with different exposures" in capsys.readouterr().err
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"")
    assert main(["capture", str(video), "--out", str(tmp_path / "film"), "--brackets", "3"]) == EXIT_USAGE
    assert "is 3, and walk.mp4 a video" in capsys.readouterr().err
    asked = []

    def refuse(source, folder, settings, *_):
        asked.append(settings.brackets)
        raise AssetError(str(source), "cannot be calibrated")

    monkeypatch.setattr(pipeline, "make_capture", refuse)
    for given in ([], ["--brackets", "none"], ["--brackets", "5"]):
        assert main([*words, *given]) == EXIT_BAD_ASSET
    assert asked == ["auto", "none", "5"]


def test_a_capture_that_is_stopped_says_how_it_goes_on(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "statue"

    def stopped(*_: object) -> None:
        (folder / WORK).mkdir(parents=True, exist_ok=True)
        (folder / WORK / INPUTS).touch()
        raise Cancelled

    monkeypatch.setattr(pipeline, "make_capture", stopped)
    for quiet in (["-q"], []):  # the last leaves the level of messages as it was
        assert main(["capture", str(tmp_path), "--out", str(folder), "--masks", "none", *quiet]) == EXIT_INTERRUPTED
        assert ("the same command goes on from here" in capsys.readouterr().err) is not bool(quiet)


def test_work_of_the_same_pictures_is_kept_with_a_word_and_that_of_others_goes(tmp_path, caplog):
    for key, kept in (("a", False), ("a", True), ("b", False)):
        caplog.clear()
        keep_work(tmp_path, key)
        assert (tmp_path / "database.db").exists() is kept and ("going on" in caplog.text) is kept
        (tmp_path / "database.db").touch()
