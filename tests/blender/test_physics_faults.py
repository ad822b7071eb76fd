"""Bakes that the machine disturbs: full disks, killed programs. What was done stays, and a message says what to do."""

from __future__ import annotations

import re
import time

import bpy
import numpy as np
import pytest
from physics_scenes import bake_job, bake_time, begin_of, cache_of, computed_last, vertices
from scenes import mesh_object, part, sphere

errors = part("drgs_blender.core.errors")


def whole(cache) -> list[int]:
    """Frames of a cache, each of which can be read, without a gap."""
    frames = cache.frames()
    for frame in frames:
        cache.read(frame)
    assert frames == list(range(1, len(frames) + 1))
    return frames


@pytest.mark.slow
def test_a_full_disk_ends_a_bake_with_a_word_and_what_was_done_stays(body, scene, small_disk):
    physics, disk = body.drgs.physics, small_disk("size=1024k")
    physics.folder, physics.frame_end, physics.gravity = str(disk / "cache"), 500, 0.0
    physics.spin = (0, 0, 3)
    with pytest.raises(RuntimeError, match=r"[Ff]ree (some )?space.*The first [0-9]+ frames can be played") as caught:
        bpy.ops.drgs.bake_physics()
    assert 'Object "ball"' in str(caught.value) and str(disk / "cache") in str(caught.value)
    assert not bake_job.running
    frames = whole(cache_of(body))
    shown = int(re.search(r"The first (\d+) frames", str(caught.value))[1])
    assert 2 <= shown <= len(frames) < 500
    np.testing.assert_array_equal(vertices(body, shown), cache_of(body).read(shown).vertices)
    assert not list((disk / "cache").glob(".*.tmp"))
    small_disk("size=65536k")
    physics.frame_end = len(frames) + 2
    bpy.ops.drgs.bake_physics()
    assert whole(cache_of(body))[-1] == physics.frame_end
    np.testing.assert_array_equal(vertices(body, physics.frame_end), cache_of(body).read(physics.frame_end).vertices)


def test_a_disk_that_is_full_before_anything_is_computed_is_no_end_of_blender(body, scene, small_disk):
    """What moves is written while the scene is read."""
    physics, disk = body.drgs.physics, small_disk("size=512k")
    physics.folder, physics.frame_end = str(disk / "cache"), 60
    at, faces = sphere(32, 48)
    rolling = mesh_object("Rolling", np.add(at, [0, 0, -4]), faces)
    for frame, x in ((1, 0.0), (60, 3.0)):
        rolling.location.x = x
        rolling.keyframe_insert("location", frame=frame)
    bpy.ops.drgs.physics_row(rows="colliders")
    physics.colliders[0].object = rolling
    with pytest.raises(
        RuntimeError, match=r"cannot be written \(No space left on device\)\. Free some space"
    ) as caught:
        bpy.ops.drgs.bake_physics()
    assert str(disk / "cache") in str(caught.value) and not bake_job.running
    small_disk("size=65536k")
    physics.frame_end = 3
    bpy.ops.drgs.bake_physics()
    assert whole(cache_of(body)) == [1, 2, 3]


@pytest.mark.slow
def test_a_program_that_is_killed_leaves_its_frames_and_the_next_goes_on(body, scene):
    physics = body.drgs.physics
    physics.frame_end, physics.gravity, physics.spin = 500_000, 0.0, (0, 0, 3)
    bake = bake_job.Bake(body, scene)
    begin_of(bake, 3)
    while not (cache_of(body).folder / "state.drgp").exists():
        begin_of(bake, bake.count + 1)
    bake._process._process.kill()
    with pytest.raises(errors.EngineError, match=r'"ball".*\(-9\).*Bake again: it goes on\. The first \d+ frames'):
        while not bake.step():
            time.sleep(0.01)
    bake.close()
    frames = whole(cache_of(body))
    np.testing.assert_array_equal(vertices(body, bake.count), cache_of(body).read(bake.count).vertices)
    assert frames[-1] >= 3
    physics.frame_end = frames[-1] + 2
    bpy.ops.drgs.bake_physics()
    assert computed_last(body) < physics.frame_end - 1, "it goes on where it was"
    assert whole(cache_of(body))[-1] == physics.frame_end


def test_frames_that_were_left_behind_are_named_not_rendered_at_rest(body, scene, export, captured):
    bpy.ops.drgs.bake_physics()
    folder = cache_of(body).folder
    bpy.ops.render.render()
    assert captured[-1].objects[0].tear > 0
    (folder / "cache.json").rename(folder / "away.json")
    bpy.ops.render.render()
    assert captured[-1].objects[0].tear == 0
    said = [line.text for line in part("addon.messages").history]
    assert any('"ball"' in text and "cache.json does not exist; its tears" in text for text in said)
    (folder / "mesh.pc2").rename(folder / "away.pc2")
    with pytest.raises(errors.AssetError, match=r'Object "ball": its simulated frames are not there.*mesh.pc2.*Bring'):
        export()
    body.modifiers[0].show_viewport = False
    export()
    (folder / "away.pc2").rename(folder / "mesh.pc2")


def test_the_time_told_before_a_bake_is_that_of_its_material(body):
    physics, counts = body.drgs.physics, (100_000, 53)
    physics.frame_end = 251
    told = {}
    for material in ("jelly", "water", "metal", "sand"):
        physics.material = material
        told[material] = bake_time.estimate(physics, counts, 2)
    assert 40 < told["jelly"] < 100, "bench/bench_simulate.py --part body takes longer"
    assert len(set(told.values())) == 1, "all take a step as fast; what differs is how many, which is given here"
    physics.material, physics.solver = "jelly", "xpbd"
    assert bake_time.estimate(physics, counts, 2) < 0.5 * told["jelly"]
    physics.solver = "mpm"
    physics.frame_end = 126
    assert bake_time.estimate(physics, counts, 2) == pytest.approx(told["jelly"] / 2, abs=2)
