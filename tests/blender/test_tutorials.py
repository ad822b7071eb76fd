"""The tutorials: their blocks of code run as they are printed, one after the other, in an empty folder."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import bpy
import numpy as np
import pytest
from doc_blocks import blocks
from scenes import ROOT, part, read_exr
from test_scripting import vertices

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the blocks are for a shell of Unix")
PAGES = {path.stem: path for path in sorted((ROOT / "docs" / "tutorials").glob("*.md"))}
WHOLE = os.environ.get("DRGS_FAULTS") == "whole"


@pytest.fixture
def follow(tmp_path) -> Callable[..., Path]:
    """Function that runs the blocks of a page, from the first that contains `since`, in a folder; returns that.

    A block of Python begins with its file's name; one of ``sh`` is run, and ends at the first command that fails.
    """
    desk, programs = tmp_path / "desk", tmp_path / "bin"
    desk.mkdir()
    programs.mkdir()
    shutil.copytree(ROOT / "examples", desk / "examples")
    engine = f'PYTHONPATH="{ROOT}" exec "{os.environ["DRGS_ENGINE"]}" -m drgs_blender.cli.main'
    blender = f'exec "{sys.executable}" "{Path(__file__).parent / "blender_program.py"}"'
    python = f'exec "{os.environ["DRGS_ENGINE"]}"'
    for name, command in (("drgs", engine), ("python", python), ("blender", blender)):
        (programs / name).write_text(f'#!/bin/sh\n{command} "$@"\n')
        (programs / name).chmod(0o755)
    path = os.pathsep.join([str(programs), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "DRGS_BLENDER": sys.executable, "PYTHONPATH": ""}

    def run(page: str, since: str = "", **made: Path) -> Path:
        for name, source in made.items():
            shutil.copy(source, desk / f"{name}{source.suffix}")
        texts = blocks(PAGES[page].read_text(encoding="utf-8"))
        (first,) = [i for i, (_, text) in enumerate(texts) if since in text][:1]
        for language, text in texts[first:]:
            if language == "python":
                (name,) = re.findall(r"\A# (\w+\.py)\n", text)
                (desk / name).write_text(text, encoding="utf-8")
            elif language == "sh":
                done = subprocess.run(
                    ["sh", "-e", "-c", text], cwd=desk, env=environment, capture_output=True, text=True, timeout=1800
                )
                assert done.returncode == 0, f"{text}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
                with (desk / "printed.txt").open("a", encoding="utf-8") as printed:
                    printed.write(done.stdout)
        return desk

    return run


def shown(node: ast.AST) -> list[ast.expr | None]:
    """What a node of code shows to the user: labels of panels and operators, names of properties and their values."""
    match node:
        case ast.Call():
            return [word.value for word in node.keywords if word.arg in ("name", "text", "label")]
        case (
            ast.Assign(targets=[ast.Name(id="bl_label" | "bl_category" | "text")])
            | ast.AnnAssign(target=ast.Name(id="bl_label" | "bl_category"))
        ):
            return [node.value]
        case ast.Tuple(elts=[_, label, _, *_]):  # a value of an enumeration
            return [label]
        case ast.Dict():  # the same, by the value's identifier
            return [value.elts[0] for value in node.values if isinstance(value, ast.Tuple) and value.elts]
    return []


@cache
def labels() -> set[str]:
    """Texts that the extension shows as names of panels, buttons, properties and their values."""
    paths = [*(ROOT / "addon").rglob("*.py"), *(ROOT / "operators").rglob("*.py")]
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in paths)
    parts = (
        part for tree in trees for node in ast.walk(tree) for found in shown(node) if found for part in ast.walk(found)
    )
    return {part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)}


@pytest.mark.parametrize("page", PAGES)
def test_what_is_clicked_is_there(page):
    """Names in italics are of the extension; those of Blender's own are not in italics."""
    text = re.sub(r"^```.*?^```$", "", PAGES[page].read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    clicked = re.findall(r"(?<!\*)\*([^*\s][^*]*)\*(?!\*)", text)
    assert clicked and not {" ".join(name.split()) for name in clicked} - labels()


@pytest.mark.parametrize("page", PAGES)
def test_files_of_python_are_named_and_run(page):
    text = PAGES[page].read_text(encoding="utf-8")
    found = blocks(text)
    commands = "".join(text for language, text in found if language == "sh")
    for language, code in found:
        if language == "python":
            (name,) = re.findall(r"\A# (\w+\.py)\n", code)
            assert f"`{name}`" in text and re.search(rf"(?:blender .*--python|python) {name}", commands)


@pytest.mark.slow
@pytest.mark.programs
def test_lights_differ_and_albedo_does_not(follow):
    desk = follow("scripting")
    pictures = [read_exr(desk / f"lights/{name}.png", 240, 320) for name in ("city", "forest", "sunset")]
    for picture in pictures:
        assert 0.1 < (picture[..., 3] > 0.5).mean() < 0.9
    assert np.abs(pictures[0] - pictures[2]).mean() > 0.01
    printed = (desk / "printed.txt").read_text(encoding="utf-8")
    assert "kind: frame" in printed and "ViewLayer.Albedo: 320 x 240 x 3" in printed
    found = re.findall(r"albedo (\[[^]]+\]), (\d+)%", printed)
    albedo = np.array([[float(number) for number in re.findall(r"[\d.]+", text)] for text, _ in found])
    assert albedo.shape == (3, 3) and np.ptp(albedo, axis=0).max() < 0.02
    assert all(0 < int(part) < 100 for _, part in found)


@pytest.mark.slow
@pytest.mark.programs
def test_a_chunk_goes_on_and_jobs_are_written(follow):
    desk = follow("farm")
    assert [path.name for path in sorted((desk / "frames").iterdir())] == [f"000{n}.exr" for n in range(1, 7)]
    printed = (desk / "printed.txt").read_text(encoding="utf-8")
    assert "\n1\n" in printed, "only one frame was skipped"
    assert "exit code 65\n" in printed and "DRGS_EXIT class=bad-asset" in printed
    assert "array=0-2" in (desk / "slurm" / "render.sbatch").read_text(encoding="utf-8")
    for name in ("slurm/submit.sh", "openjd/template.json", "flamenco/job.json"):
        assert (desk / name).is_file() and name.split("/")[0] in printed


@pytest.mark.slow
@pytest.mark.programs
def test_matter_falls_and_bodies_push_each_other(follow):
    desk = follow("simulate")
    jelly, sand, metal = (read_exr(desk / f"{matter}.png", 240, 240) for matter in ("jelly", "sand", "metal"))
    assert min(np.abs(a - b).mean() for a, b in ((jelly, sand), (sand, metal), (metal, jelly))) > 0.005
    for name in ("cat", "spot"):
        assert len(list((desk / "drgs_cache" / "bodies" / name).glob("frame_*.drgp"))) == 12
    first, last = (read_exr(desk / f"bodies/{n:04}.exr", 240, 320) for n in (1, 12))
    assert np.abs(first - last).mean() > 0.005
    bpy.ops.wm.open_mainfile(filepath=str(desk / "bodies.blend"))
    cat, cow = bpy.data.objects["cat"], bpy.data.objects["spot"]
    shapes = {}
    for frame in (1, 12):
        bpy.context.scene.frame_set(frame)
        shapes[frame] = [vertices(obj) for obj in (cat, cow)]
    foot = shapes[1][0][:, 2] < -0.75
    assert np.abs(shapes[12][0] - shapes[1][0])[foot].max() < 0.02, "the foot is held"
    assert shapes[12][1][:, 2].mean() < shapes[1][1][:, 2].mean() - 0.2, "the cow fell"
    assert shapes[12][1][:, 2].mean() > 0, "the cat is in her way"


@pytest.mark.slow
@pytest.mark.programs
def test_a_statue_stands_in_a_picture_of_cycles(follow):
    desk = follow("relight")
    alone = read_exr(desk / "catcher.png", 320, 320)
    shadow = (alone[..., :3].max(axis=2) < 0.02) & (alone[..., 3] > 0.3)
    assert 0.01 < shadow.mean() < 0.5 and (alone[:20, :, 3] == 0).all()
    laid, thrown = (read_exr(desk / f"plate_{shadows}.png", 320, 320) for shadows in ("catcher", "holdout"))
    for picture in (laid, thrown):
        assert (picture[..., 3] > 0.99).all() and picture[..., :3].std() > 0.05
    changed = np.abs(laid - thrown)[..., :3].max(axis=2) > 0.1
    assert 0.002 < changed.mean() < 0.4, "the ball reflects the statue in one of them"


def check_dance(desk: Path) -> None:
    """Whether the head sways, the feet stay, and all frames are there."""
    assert [path.name for path in sorted((desk / "dance").iterdir())] == [f"{n:04}.exr" for n in range(1, 13)]
    bpy.ops.wm.open_mainfile(filepath=str(desk / "dance.blend"))
    shapes = []
    for frame in (3, 9):
        bpy.context.scene.frame_set(frame)
        shapes.append(vertices(bpy.data.objects["character"]))
    moved, height = np.linalg.norm(shapes[1] - shapes[0], axis=1), shapes[0][:, 2]
    feet, size = height < height.min() + 0.1 * np.ptp(height), np.ptp(height)
    assert np.median(moved[feet]) < 0.05 * size < 0.15 * size < moved.max()
    first, last = (read_exr(desk / f"dance/{n:04}.exr", 240, 240) for n in (3, 9))
    assert np.abs(first - last).mean() > 0.005


@pytest.mark.slow
@pytest.mark.programs
def test_a_character_dances(follow):
    """From its skeleton on; all of the page takes a quarter of an hour (below)."""
    check_dance(follow("dance", "# dance.py", character=ROOT / "examples" / "captured" / "spot.drgs"))


@pytest.mark.slow
@pytest.mark.programs
@pytest.mark.skipif(not WHOLE, reason="a quarter of an hour; DRGS_FAULTS=whole runs it")
def test_a_video_becomes_a_character_that_dances(follow):
    desk = follow("dance")
    asset = part("drgs_blender.core.asset.container").read_asset(desk / "character.drgs")
    size = np.ptp(asset.mesh.vertices, axis=0)
    assert 0.1 < size[2] < 0.6, "the cameras are 1 m away, the cow is a third of that"
    assert asset.mesh.metallic.mean() < 0.5 and asset.mesh.albedo.mean() > 0.2
    check_dance(desk)
