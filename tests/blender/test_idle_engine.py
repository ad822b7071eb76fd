"""A program that says all is well and has not done its work: nobody is told that it is done."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
from physics_scenes import bake_job
from scenes import mesh_object, part, select, sphere

SAYS = r"drgs {} of .*idle ended without an error but has not written {}.*the engine of this extension"


@pytest.fixture
def idle(tmp_path, monkeypatch) -> Path:
    """Have the engine be such a program; the folder of the .blend."""
    path = tmp_path / "idle"
    path.write_text("#!/bin/sh\nexit 0\n")
    path.chmod(0o755)
    monkeypatch.setenv("DRGS_ENGINE", str(path))
    return tmp_path


def refused(operator, command: str, missing: str, **values) -> str:
    """The operator says what its program has not written; returns its words."""
    with pytest.raises(RuntimeError, match=SAYS.format(command, missing)) as told:
        operator(**values)
    assert part("addon.messages").history[-1].level == "ERROR"
    return str(told.value)


def test_export_names_what_is_missing_also_where_an_old_file_lies(ball, scene, idle):
    old = idle / "ball.ply"
    old.write_bytes(b"of yesterday")
    for before in (b"of yesterday", None):
        refused(bpy.ops.drgs.export, "convert", r".*ball\.ply", filepath=str(old), format="3DGS PLY")
        assert (old.read_bytes() if old.exists() else None) == before
        old.unlink(missing_ok=True)
    scene.frame_start, scene.frame_end = 1, 3
    frames = {"use_animation": True, "frame_start": 1, "frame_end": 3}
    refused(bpy.ops.drgs.export, "convert", r".*_0001\.ply and 2 more", filepath=str(old), format="3DGS PLY", **frames)


def test_what_makes_objects_makes_none(scene, idle):
    (idle / "toy.ply").write_bytes(b"ply\n")
    refused(bpy.ops.drgs.import_parts, "import", r".*toy\.drgs", surfels=str(idle / "toy.ply"))
    (idle / "photographs").mkdir()
    refused(bpy.ops.drgs.reconstruct, "reconstruct", r".*photographs\.drgs", filepath=str(idle / "photographs"))
    plain = mesh_object("Plain", *sphere())
    select(plain)
    refused(bpy.ops.drgs.convert, "make", r".*Plain\.drgs")
    assert not [obj for obj in scene.objects if obj.drgs.is_drgs] and plain.visible_get()
    assert not part("addon.assets")._coming


def test_what_is_made_of_objects_is_not_made(ball, idle):
    name = {"name": "relit"}
    refused(bpy.ops.drgs.bake_light, "bake", r".*\.npy", **name)
    assert "relit" not in ball.data.attributes
    if bpy.ops.drgs.splats.poll():
        refused(bpy.ops.drgs.splats, "convert", r".*splats\.ply")


@pytest.mark.parametrize("manager", ["openjd", "slurm", "flamenco"])
def test_no_job_is_said_to_be_written(ball, scene, idle, manager):
    settings = scene.drgs.submit
    settings.manager, settings.folder, settings.out, settings.use_check = manager, "//job", "//f/####.exr", False
    bpy.ops.wm.save_mainfile()
    file = {"openjd": "template.json", "slurm": "submit.sh", "flamenco": "job.json"}[manager]
    refused(bpy.ops.drgs.submit, "submit", rf".*job.{file}")
    assert not part("addon.submit").job.command
    part("addon.submit").job = None


def test_no_bake_and_no_preview_is_said_to_be_done(body, idle):
    refused(bpy.ops.drgs.bake_physics, "simulate", "frames 1 to 6 in .*drgs_cache")
    assert not bake_job.running and not body.modifiers
    refused(bpy.ops.drgs.show_particles, "simulate", "the particles in")
    assert not bake_job.running
