"""Numbered files: told from others, and found."""

from __future__ import annotations

from pathlib import Path

import pytest
from splat_files import random_splats

from drgs_blender.cli.main import main
from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame_sequences import frame_path, frames_of, template_of
from drgs_blender.formats.registry import read_surfels
from drgs_blender.formats.splat_ply import write_splat_ply


def test_numbered_files_are_told_from_others(tmp_path: Path) -> None:
    for number in (1, 2, 10, 1000):
        (tmp_path / f"a2_{number:03d}_b.ply").touch()
    (tmp_path / "a2_0001_b.ply").touch()  # of another width
    paths = [tmp_path / f"a2_{n:03d}_b.ply" for n in (10, 1, 2)]
    template, numbers = template_of(paths)
    assert (Path(template).name, numbers) == ("a2_###_b.ply", [1, 2, 10])
    assert frames_of(template) == [1, 2, 10, 1000]
    with pytest.raises(UsageError, match="are not numbered files"):
        template_of([tmp_path / "x.ply", tmp_path / "y.ply"])
    with pytest.raises(UsageError, match="matches no file"):
        frames_of(str(tmp_path / "none_##.ply"))
    assert [frame_path(template, n).name for n in (2, 1000, -3)] == ["a2_002_b.ply", "a2_1000_b.ply", "a2_-003_b.ply"]


def test_all_frames_that_are_there_are_converted(tmp_path: Path) -> None:
    for number in (1, 3, 12):
        write_splat_ply(tmp_path / f"in{number:04d}.ply", random_splats(number))
    (tmp_path / "other0002.ply").touch()
    assert main(["convert", str(tmp_path / "in####.ply"), str(tmp_path / "out##.spz"), "--frames"]) == 0
    found = {path.name: len(read_surfels(path).surfels) for path in tmp_path.glob("*.spz")}
    assert found == {"out01.spz": 1, "out03.spz": 3, "out12.spz": 12}
    assert main(["convert", str(tmp_path / "in.ply"), str(tmp_path / "out##.spz"), "--frames"]) == 64
    options = ["--no-mesh", "--frames", "3,12", "--out", str(tmp_path / "a#.drgs")]
    assert main(["import", str(tmp_path / "in####.ply"), *options]) == 0
    assert sorted(p.name for p in tmp_path.glob("*.drgs")) == ["a12.drgs", "a3.drgs"]
