"""An object that moved while it was photographed: registration follows the ground, so it is there twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_capture_registration import registration, ring, scene

from drgs_blender.capture.features import Photo
from drgs_blender.capture.left_out import tell_left_out
from drgs_blender.capture.moved_object import find_move
from drgs_blender.capture.pictures import Picture

#: Pictures, points of the object.
COUNT, OBJECT = 24, 160


def photographs(moment: int, twins: bool = False, rings: int = 2):
    """Arguments of `find_move`: a ball on a table that stands elsewhere from picture `moment` on.

    With `twins` the ball looks the same when it is turned by half.
    """
    random = np.random.default_rng(0)
    table = np.column_stack([random.random((400, 2)) - 0.5, np.zeros(400)])
    outward = random.normal(size=(OBJECT // 2, 3))
    outward = np.concatenate([outward, outward * [-1, -1, 1]])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    ball = 0.08 * outward + [0, 0, 0.08]
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    points = np.concatenate([table, ball, ball @ turn.T + [0.05, 0.02, 0]])
    normals = np.concatenate([np.broadcast_to([0, 0, 1.0], table.shape), outward, outward @ turn.T])
    looks = np.concatenate([np.arange(400), *[400 + np.arange(OBJECT) % (OBJECT // 2 if twins else OBJECT)] * 2])
    centres, rows = [], []
    for k in range(COUNT):
        angle, height = rings * 2 * np.pi * k / COUNT, (0.5, 0.6)[2 * k >= COUNT]
        ring = [np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)]
        centres.append(0.6 * np.array(ring))
        towards = centres[-1] - points
        facing = (towards * normals).sum(axis=1) > 0.5 * np.linalg.norm(towards, axis=1)
        facing[400:] &= (np.arange(2 * OBJECT) >= OBJECT) == (k >= moment)
        facing[:400] |= True
        rows.append(np.flatnonzero(facing & (random.random(len(points)) < 0.8)))
    matches = []
    for a in range(COUNT):
        for b in range(a + 1, COUNT):
            alike = np.argwhere(looks[rows[a]][:, None] == looks[rows[b]])
            wrong = random.integers(0, (len(rows[a]), len(rows[b])), (30, 2))
            matches.append((a, b, np.concatenate([alike, wrong])))
    return rows, matches, points, np.array(centres), np.ones((COUNT, len(points)), bool), 0.001


@pytest.mark.parametrize(
    ("moment", "twins", "rings", "found"),
    [(12, False, 2, 12), (10, False, 2, 10), (COUNT, False, 2, None), (COUNT, True, 2, None), (COUNT, True, 1, None)],
    ids=["between rings", "in a ring", "never", "never, both sides look alike", "never, alike in one ring"],
)
def test_the_moment_at_which_an_object_moved_is_found(moment, twins, rings, found):
    assert find_move(*photographs(moment, twins, rings)) == found


def test_who_moved_the_object_is_told_between_which_pictures(caplog, tmp_path):
    cameras = ring(6)
    photos = [Photo(name, ("one",), None, (800, 600)) for name in cameras]
    by_file = {name: Picture(Path(f"IMG_{name}").with_suffix(".png"), name) for name in cameras}
    found = replace(registration(cameras, scene(table=True)), moved="04.jpg")
    tell_left_out(found, photos, by_file, tmp_path)
    (line,) = [record.getMessage() for record in caplog.records]
    assert "between IMG_03.png and IMG_04.png" in line and "4 pictures before it, 2 after" in line
