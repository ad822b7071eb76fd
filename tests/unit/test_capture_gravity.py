"""Gravity of phones: read from made-up maker notes, used as up where it agrees with the cameras, else named."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from PIL import ExifTags, Image
from test_capture_pictures import exif, texture
from test_capture_registration import moved, registration, ring, scene

from drgs_blender.capture import pipeline
from drgs_blender.capture.exif import read_exif
from drgs_blender.capture.gravity import measured_up, up_of_maker_note
from drgs_blender.capture.world_alignment import LOWEST, MEASURED, PLANE, align_to_ground

#: Right, up and backward of the upright picture, in the phone's frame: right, top, out of the screen.
TURNS = {
    6: np.eye(3),
    1: [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    8: np.diag([-1.0, -1, 1]),
    3: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}


def maker_note(vector, order: str = ">") -> bytes:
    """An Apple maker note with a tag before and after the acceleration vector."""
    entries = [(0x0001, 9, 1, 14), (0x0008, 10, 3, None), (0x000E, 9, 1, 4)]
    start = 14 + 2 + 12 * len(entries) + 4
    data = b"Apple iOS\0" + b"\0\1" + (b"MM" if order == ">" else b"II") + struct.pack(f"{order}H", len(entries))
    for tag, kind, count, value in entries:
        data += struct.pack(f"{order}HHII", tag, kind, count, start if value is None else value)
    data += struct.pack(f"{order}I", 0)
    for part in vector:
        data += struct.pack(f"{order}2i", round(part * 100_000), 100_000)
    return data


def acceleration(camera: np.ndarray, orientation: int) -> np.ndarray:
    """What a phone measures at rest that takes an upright picture with a camera to world (4, 4): g, down."""
    down = camera[:3, :3].T @ [0, 0, -1.0]
    return np.asarray(TURNS[orientation]).T @ down


def test_a_phone_held_upright_or_on_its_side_measures_what_apple_says():
    level = np.eye(4)
    level[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks along y, z up
    assert acceleration(level, 6) == pytest.approx([0, -1, 0])  # Core Motion: y to the top of the phone
    assert acceleration(level, 1) == pytest.approx([-1, 0, 0])  # top to the left: x, to its right, points up
    assert acceleration(level, 3) == pytest.approx([1, 0, 0])


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("order", ["<", ">"])
def test_up_is_read_from_a_photograph(tmp_path, orientation, order):
    camera = next(iter(ring(3, seed=1).values()))
    path = tmp_path / "a.jpg"
    found = exif(Orientation=orientation, Make="Apple", LensModel="back camera 4.2mm f/1.8")
    found.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote] = maker_note(acceleration(camera, orientation), order)
    texture(0).save(path, exif=found)
    with Image.open(path) as image:
        up = read_exif(image).up
    np.testing.assert_allclose(camera[:3, :3] @ up, [0, 0, 1], atol=1e-3)


def test_what_is_no_gravity_is_left_out():
    note = maker_note((0, -1, 0))
    assert up_of_maker_note(note, 6, "back camera") == pytest.approx((0, 1, 0))
    assert up_of_maker_note(note, 6, "iPhone 12 front camera 2.7mm") is None
    assert up_of_maker_note(note, 2, "") is None  # mirrored
    assert up_of_maker_note(maker_note((0, -1.6, 0)), 6, "") is None  # moved
    assert up_of_maker_note(note.replace(b"Apple", b"Nokia"), 6, "") is None
    for end in range(len(note)):  # damaged, wherever
        assert up_of_maker_note(note[:end], 6, "") is None
    for damage in range(14, len(note)):
        up_of_maker_note(note[:damage] + b"\xff" + note[damage + 1 :], 6, "")  # no exception
    assert up_of_maker_note(None, 6, "") is None and up_of_maker_note("text", 6, "") is None


def tilted(noise: float = 0.0, wrong: int = 0, sign: float = 1.0):
    """Cameras of which each leans 15 degrees to one side, in a turned world, and up as their phones measure it."""
    random = np.random.default_rng(0)
    cameras = dict(list(ring(80).items())[:20])  # from one side: rolls do not cancel
    lean = np.radians(15)
    turn = np.array([[np.cos(lean), -np.sin(lean), 0], [np.sin(lean), np.cos(lean), 0], [0, 0, 1]])
    ups = {}
    for k, (name, matrix) in enumerate(cameras.items()):
        matrix[:3, :3] = matrix[:3, :3] @ turn
        up = sign * matrix[:3, :3].T @ [0, 0, 1.0] + noise * random.normal(size=3)
        ups[name] = tuple(random.normal(size=3) if k < wrong else up / np.linalg.norm(up))
    found = registration(cameras, scene(table=False))
    return moved(found, 3.0, 5), ups, cameras


def test_gravity_is_up_where_nothing_else_says_it_in_spite_of_some_that_were_moved(tmp_path):
    found, ups, cameras = tilted(noise=0.02, wrong=4)
    up = measured_up(found, ups, "set")
    assert up is not None
    by_hand, by_phone = (align_to_ground(found, 0.5, one) for one in (None, up))
    assert by_phone.up_from == MEASURED and by_phone.guessed == {"ground": LOWEST}
    name = next(iter(cameras))
    true = cameras[name][2, :3]  # the world's up in the camera's frame
    errors = [
        np.degrees(np.arccos(np.clip((one.rotation @ found.matrices[name][:3, :3])[2] @ true, -1, 1)))
        for one in (by_hand, by_phone)
    ]
    assert errors[1] < 1.0 < 5.0 < errors[0]


def test_a_plane_under_the_object_counts_before_gravity():
    found = moved(registration(ring(20), scene(table=True)), 2.0, 3)
    up = found.matrices["00.jpg"][:3, :3] @ ring(20)["00.jpg"][:3, :3].T @ [0, 0, 1.0]
    assert align_to_ground(found, 0.5, up).up_from == PLANE


@pytest.mark.parametrize("case", ["differ", "upside down"])
def test_gravity_that_does_not_fit_is_named_and_not_used(case, caplog):
    found, ups, _ = tilted(noise=1.0) if case == "differ" else tilted(sign=-1.0)
    assert measured_up(found, ups, "set") is None
    said = "does not fit their cameras" if case == "differ" else "degrees from how the cameras were held"
    assert "gravity in the metadata of 20 pictures" in caplog.text and said in caplog.text


def test_gravity_of_few_pictures_is_not_used(caplog):
    found, ups, _ = tilted()
    assert measured_up(found, dict(list(ups.items())[:9]), "set") is None and not caplog.messages
    assert measured_up(found, dict(list(ups.items())[:10]), "set") is not None


def test_a_capture_stands_upright_by_its_phone(tmp_path, monkeypatch, caplog):
    """The whole command but for structure from motion, whose cameras are true ones in a turned world."""
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    cameras = dict(list(ring(24).items())[:8])  # from one side, and leaning
    lean = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    for k, (name, matrix) in enumerate(cameras.items()):
        matrix[:3, :3] = matrix[:3, :3] @ lean
        found = exif(Orientation=1, Make="Apple")
        found.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote] = maker_note(acceleration(matrix, 1))
        texture(k, 160, 120).save(photos / name, exif=found)

    monkeypatch.setattr(pipeline, "register", lambda *_: moved(registration(cameras, np.zeros((0, 3))), 1.0, 7))
    monkeypatch.setattr(pipeline.features, "extract", lambda *_: None)
    monkeypatch.setattr(pipeline.features, "match", lambda *_: None)
    made = pipeline.make_capture(photos, out, pipeline.Settings(poses="features"), lambda *_: None, lambda: False)
    assert f"up: {MEASURED}; ground: what the cameras look at (guessed)" in made.lines
    assert "the height of the ground is (what the cameras look at) guessed" in caplog.text
    for frame in json.loads((out / "transforms.json").read_text())["frames"]:
        level = np.array(frame["transform_matrix"])[2, :3]
        np.testing.assert_allclose(level, cameras[frame["file_path"][7:]][2, :3], atol=1e-3)
