"""Frame ranges and output patterns."""

from __future__ import annotations

from pathlib import Path

import pytest

from drgs_blender.cli.frame_range import MOST_FRAMES, check_template, parse_frames
from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame_sequences import frame_path


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", [7]),
        ("1-4", [1, 2, 3, 4]),
        ("1-24x2,30", [*range(1, 25, 2), 30]),
        ("1..5,9..7x-1", [1, 2, 3, 4, 5, 9, 8, 7]),
        ("1-24:2", list(range(1, 25, 2))),
        ("20-30:2", [20, 22, 24, 26, 28, 30]),
        ("9,10,20,22", [9, 10, 20, 22]),
        ("-5--1", [-5, -4, -3, -2, -1]),
        ("-3-3x3", [-3, 0, 3]),
        ("-7", [-7]),
        ("10-1x-3", [10, 7, 4, 1]),
        ("10-1:-3", [10, 7, 4, 1]),
        ("5-5", [5]),
        ("1-3, 2-4", [1, 2, 3, 4]),
        ("4,1-2", [4, 1, 2]),
        ("1-10x4", [1, 5, 9]),
    ],
)
def test_range_expands(text, frames):
    assert parse_frames(text) == frames


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "''"),
        ("1-", "'1-'"),
        ("a", "'a'"),
        ("1,,3", "''"),
        ("1-4x0", "step of 0"),
        ("4-1", "is empty"),
        ("1-4x-1", "is empty"),
        ("1.5", "'1.5'"),
        ("1-4y2", "'1-4y2'"),
        ("2,1-4x", "'1-4x'"),
        (f"1-{MOST_FRAMES + 1}", "more than"),
        ("0-99999999999999999999", "more than"),
        ("1048575", "beyond"),
        ("-1048575", "beyond"),
        ("9" * 5000, "not a frame"),
    ],
)
def test_bad_range_names_the_term(text, named):
    with pytest.raises(UsageError, match=named) as caught:
        parse_frames(text)
    assert caught.value.exit_code == 64


@pytest.mark.parametrize(
    ("template", "frame", "path"),
    [
        ("out/####.exr", 7, "out/0007.exr"),
        ("out/####.exr", -7, "out/-0007.exr"),
        ("out/####.exr", 12345, "out/12345.exr"),
        ("v#2/shot_###_b.exr", 3, "v#2/shot_003_b.exr"),
        ("a##_b#.exr", 3, "a##_b3.exr"),
        ("still.exr", 3, "still.exr"),
    ],
)
def test_path_of_a_frame(template, frame, path):
    assert frame_path(template, frame) == Path(path)


def test_two_frames_need_a_number_in_the_name():
    check_template("still.exr", [1])
    check_template("a/#.exr", [1, 2])
    with pytest.raises(UsageError, match=r"has no #.*####\.spz"):
        check_template("a#/still.spz", [1, 2])
