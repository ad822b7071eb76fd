"""Simulated matter from Blender: the real engine bakes, and Blender's own modifier plays what it made."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import bpy
import numpy as np
import pytest
from physics_scenes import (
    FRAMES,
    PATIENCE,
    bake_job,
    begin_of,
    box_object,
    cache_of,
    cache_state,
    computed_last,
    particle_cache,
    scene_export,
    settings_export,
    vertices,
    world,
)  # fmt: skip
from scenes import mesh_object, part, select, sphere

particle_display, playback = part("addon.physics.particle_display"), part("addon.cache_playback")
#: Vertices of a frame, in a Blender without the extension.
PLAIN = """
import os, sys, bpy, numpy as np
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
bpy.context.scene.frame_set(int(sys.argv[2]))
mesh = bpy.data.objects["ball"].evaluated_get(bpy.context.evaluated_depsgraph_get()).data
found = np.empty((len(mesh.vertices), 3), np.float32)
mesh.attributes["position"].data.foreach_get("vector", found.ravel())
np.save(sys.argv[3], found)
sys.stdout.flush()
os._exit(0)
"""


def test_frames_are_played_in_any_order_by_any_blender(body, scene, captured, tmp_path):
    scene.frame_set(3)
    bpy.ops.drgs.bake_physics()
    assert scene.frame_current == 3 and not bake_job.running
    cache = cache_of(body)
    assert cache.frames() == list(range(1, FRAMES + 1))
    baked = {frame: cache.read(frame).vertices for frame in cache.frames()}
    for frame in (4, 1, 6, 2, 3, 5, 2):
        np.testing.assert_array_equal(vertices(body, frame), baked[frame])
    np.testing.assert_allclose(vertices(body, 3, 0.25), 0.75 * baked[3] + 0.25 * baked[4], atol=1e-6)
    np.testing.assert_array_equal(vertices(body, -7), baked[1])
    np.testing.assert_array_equal(vertices(body, 99), baked[FRAMES])
    # It falls by the scene's gravity and frame rate; a time step adds up to a fifth.
    np.testing.assert_allclose(baked[1], sphere()[0], atol=1e-6)
    seconds = (FRAMES - 1) / 24
    fall = (baked[1] - baked[FRAMES])[:, 2].mean() / (9.81 * seconds**2 / 2)
    assert 0.98 < fall < 1.2
    scene.frame_set(FRAMES)
    bpy.ops.render.render()
    np.testing.assert_array_equal(captured[0].objects[0].vertices, baked[FRAMES])
    assert captured[0].objects[0].tear == pytest.approx(2 / 8), "a cell: where matter tears, faces are left out"
    assert captured[0].objects[0].grain == 0
    header = settings_export.folder_of(body) / "cache.json"
    header.write_text(header.read_text().replace('"grain": 0.0', '"grain": 0.25'))
    for grain, tear in ((0.25, 0.25), (0.0, 0.0)):
        bpy.ops.render.render()
        assert (captured[-1].objects[0].grain, captured[-1].objects[0].tear) == (grain, tear)
        body.drgs.physics.tear = body.drgs.physics.grain = False
    # The folder is moved, and opened where the extension is not.
    scene.frame_set(1)
    bpy.ops.wm.save_mainfile()
    moved = tmp_path.parent / f"{tmp_path.name}-moved"
    shutil.copytree(tmp_path, moved)
    shutil.rmtree(settings_export.folder_of(body))
    (moved / "user").mkdir()
    arguments = [str(moved / "scene.blend"), "4", str(moved / "found.npy")]
    plain = dict(os.environ, BLENDER_USER_RESOURCES=str(moved / "user"))
    subprocess.run([sys.executable, "-c", PLAIN, *arguments], check=True, timeout=900, env=plain)
    np.testing.assert_array_equal(np.load(moved / "found.npy"), baked[4])


def test_input_of_old_bakes_is_removed_whole_and_nothing_else(tmp_path):
    names = [scene_export.SETTINGS, scene_export.LOG, scene_export.STDOUT, "said.txt", "collider_000_Box.ply"]
    for folder, others in ((tmp_path / "own", []), (tmp_path / "shared", ["notes.txt"])):
        folder.mkdir()
        for name in names + others:
            (folder / name).touch()
        scene_export.clear(folder)
        assert folder.exists() == bool(others)
    assert [path.name for path in folder.iterdir()] == others


@pytest.mark.slow
def test_a_bake_is_stopped_at_once_and_goes_on(body, scene):
    physics = body.drgs.physics
    wanted = physics.frame_end = 500_000
    physics.gravity, physics.spin = 0.0, (0, 0, 3)
    bake = bake_job.Bake(body, scene)
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.drgs.bake_physics()
    begin_of(bake, 3)
    # The program hangs and never ends by itself: Blender goes on all the same. Other work on the machine may hold this
    # process up, so that several attempts are made: waiting for the program would make all of them slow.
    took = []
    while len(took) < 5 and min(took, default=1.0) >= 0.5:
        os.kill(bake._process._process.pid, signal.SIGSTOP)
        begin = time.monotonic()
        assert bake.cancel()
        took.append(time.monotonic() - begin)
        assert not bake_job.running
        os.kill(bake._process._process.pid, signal.SIGCONT)
        bake._process._process.wait(PATIENCE)
        done = bake.count
        if took[-1] >= 0.5:
            bake = begin_of(bake_job.Bake(body, scene), done)
    bake.close()
    assert min(took) < 0.5
    assert 3 <= done < wanted
    assert cache_of(body).read_state()[0] >= done, "what it needs to go on is saved"
    np.testing.assert_array_equal(vertices(body, 3), cache_of(body).read(3).vertices)
    assert np.abs(vertices(body, 3) - vertices(body, 1)).max() > 0.1, "it spins"
    found = cache_state.cached(body, scene)
    assert done <= found.frames < found.expected == wanted and not found.changed
    # So does one whose Blender dies: the pipe that it holds is closed then.
    again = bake_job.Bake(body, scene)
    begin_of(again, found.frames + 1)
    again._process._process.stdin.close()
    with pytest.raises(part("drgs_blender.core.errors").EngineError, match=r"Bake again: it goes on\. The first"):
        while not again.step():
            time.sleep(0.01)
    again.close()
    found = cache_state.cached(body, scene)
    physics.frame_end = found.frames + 2
    bpy.ops.drgs.bake_physics()
    assert computed_last(body) < physics.frame_end - 1, "it goes on where it was"
    np.testing.assert_array_equal(vertices(body, physics.frame_end), cache_of(body).read(physics.frame_end).vertices)
    physics.density = 900
    assert cache_state.cached(body, scene).changed
    # Freeing takes away what is ours and nothing else.
    folder = settings_export.folder_of(body)
    (folder / "notes.txt").write_text("mine")
    bpy.ops.drgs.free_physics()
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    assert not body.modifiers
    np.testing.assert_allclose(vertices(body, 3), sphere()[0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.blender_api
def test_pins_regions_and_colliders_take_part(body, scene):
    """Pinned at the top and carried aside by its own keys, while a table rises from below."""
    physics = body.drgs.physics
    height = sphere()[0][:, 2]
    body.vertex_groups.new(name="Other").add([0], 1.0, "REPLACE")
    group = body.vertex_groups.new(name="Top")
    group.add(np.flatnonzero(height > 0.3).tolist(), 1.0, "REPLACE")
    group.add(np.flatnonzero(height < -0.5).tolist(), 0.2, "REPLACE")
    stiff = body.data.attributes.new("stiff", "BOOLEAN", "POINT")
    stiff.data.foreach_set("value", sphere()[0][:, 0] > 0)
    physics.pin_group = "Top"
    bpy.ops.drgs.physics_row(rows="regions")
    physics.regions[0].group, physics.regions[0].material = "stiff", "rubber"
    physics.regions[0].youngs_modulus = 4e4
    table = box_object("Table", (-2, -2, -1.6), (2, 2, -1.1))
    bpy.ops.drgs.physics_row(rows="colliders")
    physics.colliders[0].object = table
    for frame, x, z, youngs_modulus in ((1, 0.0, 0.0, 2e4), (FRAMES, 0.5, 0.5, 9e4)):
        for obj, index, value in ((body, 0, x), (table, 2, z)):
            obj.location[index] = value
            obj.keyframe_insert("location", index=index, frame=frame)
        physics.youngs_modulus = youngs_modulus
        body.keyframe_insert("drgs.physics.youngs_modulus", frame=frame)
    scene.frame_set(FRAMES)
    assert physics.youngs_modulus == 9e4
    bpy.ops.drgs.bake_physics()
    data = json.loads((settings_export.folder_of(body) / bake_job.INPUT / scene_export.SETTINGS).read_text())
    assert data["material"] == {"name": "jelly", "youngs_modulus": 2e4}, "as in the first frame"
    assert data["regions"] == [{"group": "stiff", "material": {"name": "rubber", "youngs_modulus": 4e4}}]
    assert "motion" in data and "vertices" in data["colliders"][0] and "Table" in data["colliders"][0]["mesh"]
    np.testing.assert_allclose(world(body, 1), sphere()[0], atol=1e-5)
    assert not cache_state.cached(body, scene).changed
    for name, value in (("friction", 0.7), ("contact", "slip"), ("object", None)):
        before = getattr(physics.colliders[0], name)
        setattr(physics.colliders[0], name, value)
        assert cache_state.cached(body, scene).changed, name
        setattr(physics.colliders[0], name, before)
    assert not cache_state.cached(body, scene).changed
    now = world(body, FRAMES)
    np.testing.assert_allclose(now[height == 1], [[0.5, 0, 1]], atol=0.02)
    assert -0.8 < now[:, 2].min() < -0.4, "the table, at -0.6, has pushed it in"
    np.testing.assert_allclose(vertices(body, 3)[height == 1], [[0, 0, 1]], atol=0.02, err_msg="it follows its object")


@pytest.mark.slow
@pytest.mark.blender_api
def test_force_fields_of_the_scene_act_on_it(body, scene):
    """A wind that turns up carries it along, a vortex of another collection does not, and a magnet is named."""
    physics = body.drgs.physics
    physics.gravity, physics.fields, physics.resolution, physics.youngs_modulus = 0.0, 0.5, 6, 1e6
    made = {}
    for kind in ("WIND", "VORTEX", "MAGNET"):
        bpy.ops.object.effector_add(type=kind, rotation=(0, np.pi / 2, 0))
        made[kind] = bpy.context.object
    wind = made["WIND"].field
    wind.flow = 0.0
    for frame, strength in ((1, 0.0), (FRAMES, 40.0)):
        wind.strength = strength
        made["WIND"].keyframe_insert("field.strength", frame=frame)
    fields = bpy.data.collections.new("Fields")
    scene.collection.children.link(fields)
    for kind in ("WIND", "MAGNET"):
        fields.objects.link(made[kind])
    physics.field_collection = fields
    select(body)
    bpy.ops.drgs.bake_physics()
    (field,) = json.loads((settings_export.folder_of(body) / bake_job.INPUT / scene_export.SETTINGS).read_text())[
        "fields"
    ]
    assert field["kind"] == "wind" and field["shape"] == "plane" and len(field["frames"]) == FRAMES
    assert field["frames"][-1][3:] == pytest.approx([1, 0, 0, 20, 0], abs=1e-5)
    moved = (vertices(body, FRAMES) - vertices(body, 1)).mean(axis=0)
    strengths = np.interp(np.linspace(1, FRAMES, 2001), range(1, FRAMES + 1), [row[6] for row in field["frames"]])
    span = (FRAMES - 1) / 24
    expected = (np.cumsum(np.cumsum(strengths)) * (span / 2000) ** 2)[-1]
    np.testing.assert_allclose(moved, [expected, 0, 0], atol=0.05 * expected)
    said = [line.text for line in part("addon.messages").history]
    assert any(made["MAGNET"].name in text and "(Magnet) has no effect" in text for text in said)


@pytest.mark.slow
def test_faults_name_the_object_and_the_remedy(body, scene, tmp_path):
    physics = body.drgs.physics

    def fails(match):
        scene.frame_set(2)
        with pytest.raises(RuntimeError, match=match):
            bpy.ops.drgs.bake_physics()
        assert not bake_job.running and scene.frame_current == 2

    physics.pin_group = "Nope"
    fails('Object "ball": has no vertex group or point attribute "Nope".*Physics > DR-GS Physics')
    physics.pin_group = ""
    bpy.ops.drgs.physics_row(rows="colliders")
    hidden = box_object("Hidden", (3, 3, 3), (4, 4, 4))
    physics.colliders[0].object = hidden
    scene.collection.objects.unlink(hidden)
    fails('Object "Hidden": is hidden.*Show it')
    bpy.ops.drgs.physics_row(rows="colliders", remove=0)
    physics.colliders.add().object = wall = box_object("Sea Wall", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    fails(r'Object "ball": collider "Sea Wall": overlaps the body at the start')
    wall.keyframe_insert("location", frame=1)
    bake = bake_job.Bake(body, scene)
    next(bake._capture)
    bpy.data.objects.remove(wall)
    with pytest.raises(settings_export.UsageError, match=r'"ball": a collider or force field was removed.*Bake again'):
        bake.step()
    bake.close()
    assert scene.frame_current == 2
    physics.colliders.clear()
    body.scale.x = 0.0
    fails('Object "ball": is scaled to nothing.*Give it a size')
    body.scale.x = np.nan
    fails('Object "ball": has vertices or a transform that are not finite')
    body.scale.x = 1.0
    divided = body.modifiers.new("Finer", "SUBSURF")
    fails('Object "ball": modifier "Finer"')
    body.modifiers.remove(divided)
    physics.frame_end = 1
    fails('Object "ball": ends at frame 1')
    other = body.copy()
    scene.collection.objects.link(other)
    physics.frame_end = 40
    elsewhere = bpy.data.scenes.new("Elsewhere")
    for own, theirs, where in (
        ("//shared/", "//shared/", scene),
        ("//shared", str(tmp_path / "a/../shared"), elsewhere),
    ):
        scene.collection.objects.unlink(other)
        where.collection.objects.link(other)
        physics.folder, other.drgs.physics.folder = own, theirs
        fails('Object "ball": has the same cache as "ball.001"')
        where.collection.objects.unlink(other)
        scene.collection.objects.link(other)
    other.drgs.physics.use = False
    # What goes wrong in the engine is told in the same way, and what was done can be played.
    physics.domain = box_object("Room", (-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
    select(body)
    fails('Object "ball": simulation, frame .*outside the domain.*The first [0-9]+ frames can be played')
    assert (vertices(body, 4)[:, 2].mean() - vertices(body, 1)[:, 2].mean()) < -0.03
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    obj = mesh_object("plain", *sphere())
    with pytest.raises(settings_export.UsageError, match=r'"plain".*not saved\. Save the file'):
        settings_export.folder_of(obj)


def test_a_thin_collider_inside_of_the_body_is_named(body):
    """Thinner than a cell, so that no particle is inside of it."""
    body.drgs.physics.frame_end = 2
    body.drgs.physics.colliders.add().object = box_object("Sheet", (-0.5, -0.5, -0.01), (0.5, 0.5, 0.01))
    bpy.ops.drgs.bake_physics()
    said = part("addon.messages").history[-2]
    assert said.level == "WARNING" and said.text.startswith('Object "ball": collider "Sheet": passes through the body')


def test_preview_shows_the_particles_without_touching_the_cache(body, scene):
    bpy.ops.drgs.show_particles()
    fill = particle_display.of(body)
    assert fill.counts[0] == len(fill.points) > 500 and fill.counts[1] >= 1
    radius = np.linalg.norm(fill.points, axis=1)
    assert radius.max() < 1.01 and abs(np.median(radius) - 0.5 ** (1 / 3)) < 0.1, "all of the sphere and nothing else"
    assert not settings_export.folder_of(body).exists() and not body.modifiers
    bpy.ops.drgs.hide_particles()
    assert particle_display.of(body) is None


@pytest.mark.parametrize("name", ["jelly", "metal", "sand", "snow", "honey"])
def test_a_material_fills_its_numbers_in(body, scene, name):
    physics = body.drgs.physics
    physics.material = name
    assert settings_export.describe(body, scene)["material"] == {"name": name}, "the row of the table, nothing changed"
    physics.density = 777
    assert settings_export.describe(body, scene)["material"] == {"name": name, "density": 777}


@pytest.mark.slow
def test_it_is_baked_on_the_device_of_the_scene(body, scene):
    """What has no form for a card is not asked of it, and another device is no other simulation."""
    body.drgs.physics.frame_end = 3
    asked = []
    for device, solver in (("CPU", "mpm"), ("CUDA", "xpbd"), ("CUDA", "mpm")):
        scene.drgs.device, body.drgs.physics.solver = device, solver
        bake = begin_of(bake_job.Bake(body, scene), 2)
        arguments = bake._process._process.args
        asked.append(arguments[arguments.index("--device") + 1])
        bake.close()
        assert not cache_state.cached(body, scene).changed
    assert asked == ["cpu", "cpu", "cuda"]
    scene.drgs.device = "CPU"
    assert not cache_state.cached(body, scene).changed


def test_the_played_file_is_never_of_two_bakes(tmp_path):
    """It grows by what is new; another bake in the same folder begins it again, a kill between two writes does not."""
    cache = particle_cache.ParticleCache(tmp_path)
    rng = np.random.default_rng(1)

    def frame():
        return particle_cache.ParticleFrame(np.zeros((2, 3)), np.zeros((2, 3, 3)), rng.random((5, 3), np.float32))

    def begin(digest, count):
        made = [frame() for _ in range(count)]
        cache.create(particle_cache.Header(digest, 2, 5, 10, 24.0), made[0])
        for i, one in enumerate(made):
            cache.write(10 + i, one)
        return made

    def played():
        data = (tmp_path / playback.FILE).read_bytes()
        count = int.from_bytes(data[28:32], "little")
        return np.frombuffer(data[32 : 32 + count * 60], "<f4").reshape(count, 5, 3)

    player = playback.Playback(tmp_path)
    assert player.follow() == 0
    made = begin("a", 3)
    assert player.follow() == 3
    np.testing.assert_array_equal(played(), [one.vertices for one in made])
    made.append(frame())
    cache.write(13, made[-1])
    with open(tmp_path / playback.FILE, "ab") as file:
        file.write(b"half a frame")
    assert playback.Playback(tmp_path).follow() == 4
    np.testing.assert_array_equal(played(), [one.vertices for one in made])
    made = begin("b", 2)
    assert player.follow() == 2
    np.testing.assert_array_equal(played(), [one.vertices for one in made])
