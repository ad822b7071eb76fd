"""``drgs submit check``: what a node would miss, said before it does."""

from __future__ import annotations

import subprocess

import pytest

from drgs_blender.cli.find_blender import find_blender
from drgs_blender.ipc import protocol


def check(drgs, folder, name, *options):
    return drgs("submit", "check", folder / name, "--frames", "1-3", "--out", "//f/####.exr", *options)


def test_files_and_settings_that_a_node_would_do_without_are_named(drgs, folder):
    code, lines, error = check(drgs, folder, "faulty.blend")
    assert code == 65 and "a node would miss" in error
    assert [line for line in lines if line.startswith("missing")] == ["missing  //gone.png: does not exist"]
    notes = [line for line in lines if line.startswith("note")]
    assert any("there.png: is an absolute path" in line for line in notes)
    assert any("Cryptomatte Asset" in line for line in notes)


def test_scene_that_takes_everything_along_is_fine(drgs, folder, tmp_path):
    code, lines, error = check(drgs, folder, "relative.blend", "--shared", folder)
    assert (code, len(lines)) == (0, 2), (error, lines)
    assert lines[0].split() == ["file", str(folder / "tile.drgs")]
    assert lines[1].startswith("ok") and "1 files, frames 1-3" in lines[1]
    code, lines, _ = check(drgs, folder, "relative.blend", "--shared", tmp_path)
    assert code == 65
    missing = [line for line in lines if line.startswith("missing")]
    assert [line.rsplit(": ", 1)[1] for line in missing] == ["is not in a shared folder"] * 2


@pytest.mark.slow
def test_scene_that_cannot_be_rendered_is_refused_as_by_a_node(drgs, folder, monkeypatch):
    code, lines, error = check(drgs, folder, "blind.blend")
    assert code == 64 and "has no camera" in error and "has no camera" in "".join(lines)
    (folder / "tile.drgs").rename(folder / "away.drgs")
    try:
        code, lines, _ = check(drgs, folder, "relative.blend")
    finally:
        (folder / "away.drgs").rename(folder / "tile.drgs")
    assert code == 65 and "missing  //tile.drgs: does not exist" in lines
    monkeypatch.setattr(protocol, "__version__", "9.8.7")
    assert check(drgs, folder, "relative.blend")[0] == 78


def test_scripts_that_will_not_run_are_named(drgs, folder):
    code, lines, _ = check(drgs, folder, "script.blend")
    assert code == 0 and any("--enable-scripts" in line for line in lines)


def test_brushes_of_blender_are_no_files_of_the_scene(drgs, folder, tmp_path):
    """A file begun as Blender starts names the brushes that come with Blender."""
    scene = tmp_path / "begun.blend"
    script = tmp_path / "begin.py"
    script.write_text(f"import bpy; bpy.ops.wm.save_as_mainfile(filepath={str(scene)!r})")
    subprocess.run(find_blender().command(script), check=True, timeout=120)
    code, lines, error = check(drgs, tmp_path, scene.name, "--shared", tmp_path)
    assert (code, len(lines)) == (0, 1) and "0 files" in lines[0], (lines, error)


@pytest.mark.slow
def test_simulated_frames_are_files_of_the_scene(drgs, folder, tmp_path):
    scene, script = tmp_path / "matter.blend", tmp_path / "make.py"
    script.write_text(f"""
import bpy
cube = bpy.data.objects["Cube"]
cube.modifiers.new("DR-GS Physics", "MESH_CACHE").filepath = "//drgs_cache/Cube/mesh.pc2"
bpy.ops.wm.save_as_mainfile(filepath={str(scene)!r})
""")
    subprocess.run(find_blender().command(script), check=True, timeout=600)
    code, lines, _ = check(drgs, tmp_path, scene.name)
    names = ("cache.json", "mesh.pc2")
    assert code == 65
    assert [line.split() for line in lines if line.startswith("missing")] == [
        ["missing", f"//drgs_cache/Cube/{name}:", "does", "not", "exist"] for name in names
    ]
    cache = tmp_path / "drgs_cache/Cube"
    cache.mkdir(parents=True)
    for name in names:
        (cache / name).write_text("x")
    code, lines, _ = check(drgs, tmp_path, scene.name, "--shared", tmp_path)
    assert code == 0 and [line.split()[1] for line in lines[:2]] == [str(cache / name) for name in names]
