"""An Open Job Description bundle in a local session of openjd-cli, on files that lie elsewhere than at submission."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from processes import all_gone

from drgs_blender.cli.frame_range import parse_frames

from .conftest import PROGRAM, same_pixels

pytest.importorskip("openjd.cli")
OPENJD = [str(Path(sys.executable).with_name("openjd"))]


@pytest.mark.slow
def test_bundle_renders_and_denoises_what_one_machine_does(drgs, folder, tmp_path):
    studio, node = tmp_path / "studio", tmp_path / "node"
    studio.mkdir()
    for name in ("relative.blend", "tile.drgs"):
        shutil.copy(folder / name, studio)
    scene, rays = studio / "relative.blend", "--samples 4"
    code, lines, error = drgs(
        "submit", "openjd", scene, "--frames", "1-3", "--chunk", 2, "--out", "//noisy/####.exr", "--no-check",
        "--denoised", "//clean/####.exr", "--to", tmp_path / "job", "--drgs", PROGRAM, f"--options={rays}",
    )  # fmt: skip
    assert code == 0, error
    studio.rename(node)
    rules = [{"source_path_format": "POSIX", "source_path": str(studio), "destination_path": str(node)}]
    mapping = json.dumps({"version": "pathmapping-1.0", "path_mapping_rules": rules})
    command = [*OPENJD, *shlex.split(lines[-1])[1:], "--path-mapping-rules", mapping]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "still open" not in result.stdout  # nothing inherits the streams of a task

    alone = tmp_path / "alone"
    noisy = ("--denoise", "none", "--passes", "temporal", *rays.split())
    scene = node / "relative.blend"
    assert drgs("render", scene, "--frames", "1-3", "--out", alone / "noisy" / "####.exr", *noisy)[0] == 0
    clean = ("denoise", alone / "noisy" / "####.exr", "--frames", "1-3", "--out", alone / "clean" / "####.exr")
    assert drgs(*clean)[0] == 0
    for kind in ("noisy", "clean"):
        names = sorted(path.name for path in (node / kind).iterdir())
        assert names == ["0001.exr", "0002.exr", "0003.exr"]
        assert all(same_pixels(node / kind / name, alone / kind / name) for name in names)
    assert len(re.findall("DRGS_EXIT class=ok", result.stdout)) == 4
    (pid,) = re.findall(r"session \S+: process (\d+)", result.stdout)
    assert all_gone([int(pid)], 5)
    assert "openjd_progress: 100.0" in result.stdout


#: Stands for drgs: notes the frames it is given, and takes half a second for them.
NOTES = """#!/bin/sh
for word; do case $word in --frames=*) echo "$1 ${{word#*=}}" >>{log}; sleep 0.5;; esac; done
"""


@pytest.mark.slow
def test_schedulers_adapt_chunks_and_every_frame_is_made_once(drgs, tmp_path):
    (tmp_path / "a.blend").touch()
    program, log = tmp_path / "drgs.sh", tmp_path / "log"
    program.write_text(NOTES.format(log=log))
    program.chmod(0o755)
    frames = "-3-9x2,20,21,30-41"
    job = ["submit", "openjd", tmp_path / "a.blend", "--no-check", "--to", tmp_path / "job", "--drgs", program]
    job += [f"--frames={frames}", "--out", "//f/####.exr", "--denoised", "//g/####.exr"]
    code, lines, error = drgs(*job, "--chunk", 1, "--chunk-seconds", 5)
    assert code == 0, error
    ran = subprocess.run([*OPENJD, *shlex.split(lines[-1])[1:]], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    told = [line.split() for line in log.read_text().splitlines()]
    for command in ("render", "denoise"):
        chunks = [parse_frames(text) for name, text in told if name == command]
        assert sorted(frame for chunk in chunks for frame in chunk) == sorted(parse_frames(frames))
        assert len(chunks[0]) == 1 < max(map(len, chunks))  # it begins with what it is told, and learns


def test_template_is_valid_for_all_ranges_and_sessions_end_where_nothing_renders(drgs, tmp_path):
    (tmp_path / "a.blend").touch()
    job = ["submit", "openjd", tmp_path / "a.blend", "--out", "//f/####.exr", "--no-check", "--to", tmp_path / "job"]
    code, lines, error = drgs(*job, "--frames=-3-9x2,20,21,2-8x2", "--chunk-seconds", 600, "--drgs", "false")
    assert code == 0, error
    template = str(tmp_path / "job/template.json")
    checked = subprocess.run([*OPENJD, "check", template], capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    ran = subprocess.run([*OPENJD, *shlex.split(lines[-1])[1:]], capture_output=True, text=True, timeout=60)
    assert ran.returncode != 0 and "CheckedNode" in ran.stdout + ran.stderr
    references = json.loads((tmp_path / "job/asset_references.json").read_text())["assetReferences"]
    assert references["inputs"]["filenames"] == [str(tmp_path / "a.blend")]
    assert references["outputs"]["directories"] == [str(tmp_path / "f")]
