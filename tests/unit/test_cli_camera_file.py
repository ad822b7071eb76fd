"""Camera files: what is read, and that every mistake is named."""

from __future__ import annotations

import json
import math
import os

import numpy as np
import pytest

from drgs_blender.cli.camera_file import read_camera
from drgs_blender.core.errors import UsageError

GOOD = {"matrix_world": np.eye(4).tolist(), "width": 640, "height": 480, "fov_x": 90}


@pytest.fixture
def write(tmp_path):
    def write(changes: dict) -> str:
        data = {key: value for key, value in (GOOD | changes).items() if value is not ...}
        path = tmp_path / "camera.json"
        path.write_text(json.dumps(data))
        return str(path)

    return write


def test_field_of_view_is_horizontal_degrees(write):
    camera = read_camera(write({}))
    # At 90 degrees the left edge of the picture is seen at 45 degrees: tan = 1 = (width / 2) / fx.
    assert (camera.fx, camera.fy) == pytest.approx((320, 320))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (320, 240, 640, 480)
    assert camera.matrix_world.dtype == np.float64


def test_intrinsics_in_pixels(write):
    camera = read_camera(write({"fov_x": ..., "fx": 500, "fy": 510, "cx": 300.5, "cy": 200}))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 300.5, 200)
    assert read_camera(write({"fov_x": ..., "fx": 500})).fy == 500


def test_orthographic(write):
    camera = read_camera(write({"fov_x": ..., "fx": 64, "orthographic": True, "clip_start": 0.1, "clip_end": 20}))
    assert camera.orthographic and (camera.clip_start, camera.clip_end) == (0.1, 20)


def test_numerical_noise_of_an_exporter_is_accepted(write):
    matrix = np.eye(4)
    c, s = math.cos(0.3), math.sin(0.3)
    matrix[:2, :2] = [[c, -s], [s, c]]
    assert read_camera(write({"matrix_world": np.round(matrix, 5).tolist()})).matrix_world[0, 0] == round(c, 5)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"matrix_world": ...}, "matrix_world is missing"),
        ({"matrix_world": [[1, 0], [0, 1]]}, "matrix_world"),
        ({"matrix_world": [[1, 0, 0, 0], [0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]}, "matrix_world"),
        ({"matrix_world": "identity"}, "matrix_world"),
        ({"matrix_world": (2 * np.eye(4)).tolist()}, "0 0 0 1"),
        ({"matrix_world": np.diag([2.0, 2, 2, 1]).tolist()}, "matrix_world is not rigid"),
        ({"matrix_world": np.diag([-1.0, 1, 1, 1]).tolist()}, "matrix_world is not rigid"),
        ({"matrix_world": (np.eye(4) + np.eye(4)[[3]].T * [1, 2, 3, 0]).tolist()}, "0 0 0 1"),
        ({"width": ...}, "width is missing"),
        ({"width": 0}, "width is 0"),
        ({"width": 10.5}, "width is 10.5"),
        ({"width": True}, "width is true, not a number"),
        ({"height": "480"}, 'height is "480", not a number'),
        ({"width": 10**400}, r"width is 10+\.\.\.; it must be from 1 to 65536"),
        ({"fov_x": 10**400}, r"fov_x is 10+\.\.\.; it must be from 0\.001 to 179\.999"),
        ({"fov_x": 5e-324}, r"fov_x is 5e-324; it must be from 0\.001"),
        ({"fov_x": 179.99999999999997}, r"fov_x is 179\.99999999999997; it must be from 0\.001 to 179\.999"),
        ({"matrix_world": [[10**400, 0, 0, 0], *np.eye(4).tolist()[1:]]}, "matrix_world is not 4 rows of 4 numbers"),
        ({"matrix_world": [[1, 0, 0, 1e300], *np.eye(4).tolist()[1:]]}, r"4 numbers from -1e\+09 to 1e\+09"),
        ({"matrix_world": [["1", 0, 0, 0], *np.eye(4).tolist()[1:]]}, "matrix_world is not 4 rows"),
        ({"matrix_world": [[True, 0, 0, 0], *np.eye(4).tolist()[1:]]}, "matrix_world is not 4 rows"),
        ({"cx": 1e300}, r"cx is 1e\+300; it must be from -1000000000 to 1000000000"),
        ({"fov_x": ..., "fx": 1e308}, r"fx is 1e\+308; it must be"),
        ({"fov_x": ..., "fx": 5e-324}, "fx is 5e-324; it must be"),
        ({"clip_end": math.inf}, "clip_end is Infinity; it must be"),
        ({"height": 1_000_000}, "height"),
        ({"fov_x": ...}, "fov_x is missing, and so is fx"),
        ({"fov_x": 180}, "fov_x is 180"),
        ({"fov_x": -1}, "fov_x is -1"),
        ({"fov_x": float("nan")}, "fov_x is NaN, not a number"),
        ({"fx": 500}, "fov_x and fx"),
        ({"orthographic": True}, "fov_x means nothing"),
        ({"orthographic": 1}, "orthographic is not"),
        ({"clip_start": 5, "clip_end": 4}, "clip_end"),
        ({"fovx": 90}, "unknown keys fovx"),
    ],
)
def test_mistake_is_named(write, changes, named):
    with pytest.raises(UsageError, match=named) as caught:
        read_camera(write(changes))
    assert "camera.json" in str(caught.value)
    assert caught.value.exit_code == 64


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "null", "\x00\xff", "[" * 200_000, " " * (1 << 20) + "{}"])
def test_not_a_camera_at_all(tmp_path, text):
    path = tmp_path / "camera.json"
    path.write_bytes(text.encode("latin1"))
    with pytest.raises(UsageError, match=r"camera\.json"):
        read_camera(path)


def test_a_byte_order_mark_is_read(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(GOOD), encoding="utf-8-sig")
    assert read_camera(path).width == 640


@pytest.mark.parametrize(
    ("encoding", "said"),
    [("utf-16", "is UTF-16 text. Save it as UTF-8"), ("utf-16-le", "is UTF-16 text"), ("utf-16-be", "is UTF-16 text")],
)
def test_another_encoding_is_named(tmp_path, encoding, said):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(GOOD), encoding=encoding)
    with pytest.raises(UsageError, match=said):
        read_camera(path)


def test_latin_1_is_no_utf_8(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"Höhe": 1}', encoding="latin-1")
    with pytest.raises(UsageError, match=r"is not UTF-8 text\. Save it as UTF-8"):
        read_camera(path)


def test_absent_file(tmp_path):
    with pytest.raises(UsageError, match="cannot be read"):
        read_camera(tmp_path / "no.json")


@pytest.mark.skipif(os.name == "nt", reason="pipes are no files there")
@pytest.mark.parametrize("kind", ["fifo", "folder", "device"])
def test_only_a_regular_file_is_opened(tmp_path, kind):
    path = tmp_path / "c.json"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(UsageError, match="is not a regular file"):
        read_camera(path)
