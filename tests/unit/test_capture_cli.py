"""`drgs capture`, `drgs markers`, and `drgs reconstruct` of photographs without cameras."""

from __future__ import annotations

import captures
import numpy as np
import pytest
from PIL import Image

from drgs_blender.capture import pipeline
from drgs_blender.cli.main import main
from drgs_blender.core.errors import EXIT_BAD_ASSET, EXIT_USAGE, AssetError
from drgs_blender.reconstruct.readers import has_cameras, read_capture


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
    assert main(words) == main([*words, "--masks", "auto"]) == EXIT_BAD_ASSET
    assert asked == [(photographs, tmp_path / "a.capture", masks) for masks in ("given", "auto")]
    assert "has no cameras: they are found first, in" in capsys.readouterr().err


def test_what_has_cameras_or_no_pictures_is_left_to_the_readers(tmp_path, photographs):
    assert not has_cameras(photographs) and not has_cameras(tmp_path / "absent")
    scene = captures.make(tmp_path / "c")
    captures.write_nerfstudio(scene)
    assert has_cameras(scene.folder)


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
