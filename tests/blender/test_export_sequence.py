"""Moving objects as USD and Alembic, read by Blender's own importers: each frame is what was evaluated."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from scenes import ROOT, armature_object, part, sphere

pytestmark = pytest.mark.blender_api

FRAMES = range(3, 8)


@pytest.fixture
def walker(ball, scene):
    """The ball, turned, bent by a bone, swollen by a shape key, and moved as a whole, over the frames."""
    rig = armature_object({"Bone": ((0, 0, -1), (0, 0, 1))})
    rest = sphere()[0]
    ball.vertex_groups.new(name="Bone").add(np.flatnonzero(rest[:, 2] > 0.5).tolist(), 1.0, "REPLACE")
    ball.modifiers.new("Armature", "ARMATURE").object = rig
    ball.shape_key_add(name="Basis")
    key = ball.shape_key_add(name="Wide", from_mix=False)
    key.points.foreach_set("co", (rest * np.float32((2, 1, 1))).ravel())
    bone = rig.pose.bones["Bone"]
    ball.rotation_euler, ball.scale = (0.3, 0, 0.4), (1, 2, 0.5)
    for frame, share in ((FRAMES[0], 0.0), (FRAMES[-1], 1.0)):
        key.value, bone.location, ball.location = share, (0, share, 0), (3 * share, 0, 1)
        key.keyframe_insert("value", frame=frame)
        bone.keyframe_insert("location", frame=frame)
        ball.keyframe_insert("location", frame=frame)
    scene.frame_start, scene.frame_end = FRAMES[0], FRAMES[-1]
    scene.render.fps, scene.frame_current = 30, 1
    ball.name = "Big ball"
    return ball


def world_points(obj) -> np.ndarray:
    """(n, 3) places of the evaluated vertices."""
    own = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.empty(3 * len(own.data.vertices), np.float32)
    own.data.attributes["position"].data.foreach_get("vector", points)
    matrix = np.array(own.matrix_world)
    return points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def over_time(obj) -> list[np.ndarray]:
    found = []
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        found.append(world_points(obj))
    return found


def export(path: Path, format_: str, **more):
    bounds = {"frame_start": FRAMES[0], "frame_end": FRAMES[-1]}
    assert bpy.ops.drgs.export(filepath=str(path), format=format_, **bounds, **more) == {"FINISHED"}


def imported(operator, path: Path):
    """The mesh object that an importer of Blender adds to the scene."""
    before = set(bpy.data.objects)
    assert operator(filepath=str(path)) == {"FINISHED"}
    (found,) = [o for o in bpy.data.objects if o not in before and o.type == "MESH"]
    return found


def assert_moves_like(found, walker) -> None:
    wanted = over_time(walker)
    assert np.abs(wanted[0] - wanted[-1]).max() > 1, "it stands still"
    for points, there in zip(over_time(found), wanted):
        np.testing.assert_allclose(points, there, atol=1e-5)


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_usd_moves_as_the_scene(walker, scene, tmp_path, suffix):
    """Vertices of each frame, attributes by their names, texture coordinates and images."""
    export(tmp_path / f"walk{suffix}", "USD sequence")
    assert scene.frame_current == 1
    found = imported(bpy.ops.wm.usd_import, tmp_path / f"walk{suffix}")
    assert_moves_like(found, walker)
    arrays = part("addon.mesh_arrays")
    for name in ("albedo", "roughness", "metallic"):
        own, there = (arrays.read_channel(obj.data, name) for obj in (found, walker))
        np.testing.assert_allclose(own, there, atol=1e-6)
    assert found.data.uv_layers
    images = [n.image for n in found.data.materials[0].node_tree.nodes if n.type == "TEX_IMAGE"]
    assert images and all(image.size[0] > 8 for image in images)


def test_surfels_follow_the_mesh(walker, scene, tmp_path):
    """Read back, the splats of the first frame stand on its surface."""
    export(tmp_path / "walk.usdc", "USD sequence", surfels=True, materials=True, use_selection=True)
    assert bpy.ops.drgs.import_parts(surfels=str(tmp_path / "walk.usdc"), use_mesh=False) == {"FINISHED"}
    asset = part("addon.assets").file_of(bpy.context.active_object)
    surfels = part("drgs_blender.core.asset.container").read_asset(asset).surfels
    scene.frame_set(FRAMES[0])
    corners = world_points(walker)[sphere()[1]]
    np.testing.assert_allclose(surfels.centre, corners.mean(axis=1), atol=0.02)
    np.testing.assert_allclose(surfels.albedo[:, 2], 0.4, atol=1e-3)


def test_what_viewports_and_renders_show_differently_is_named(walker, scene, tmp_path):
    """The file has what viewports show."""
    messages = part("addon.messages")
    texts = {"hide_render": "written, though renders do not", "hide_viewport": "left out, though renders"}
    for hidden, text in texts.items():
        messages.clear()
        setattr(walker, hidden, True)
        if hidden == "hide_viewport":
            with pytest.raises(RuntimeError, match="no object of the scene"):
                export(tmp_path / "walk.usdc", "USD sequence")
        else:
            export(tmp_path / "walk.usdc", "USD sequence")
        setattr(walker, hidden, False)
        assert any(f"{walker.name}: {text} show it;" in m.text for m in messages.history)
    messages.clear()
    export(tmp_path / "walk.usdc", "USD sequence")
    assert not any("renders" in m.text for m in messages.history)


@pytest.mark.slow
def test_simulated_matter_moves_as_it_was_baked(body, scene, tmp_path):
    assert bpy.ops.drgs.bake_physics() == {"FINISHED"}
    last = body.drgs.physics.frame_end
    bounds = {"frame_start": scene.frame_start, "frame_end": last}
    assert bpy.ops.drgs.export(filepath=str(tmp_path / "fall.usdc"), format="USD sequence", **bounds) == {"FINISHED"}
    found = imported(bpy.ops.wm.usd_import, tmp_path / "fall.usdc")
    places = []
    for frame in range(scene.frame_start, last + 1):
        scene.frame_set(frame)
        places.append(world_points(body))
        np.testing.assert_allclose(world_points(found), places[-1], atol=1e-5)
    assert np.abs(places[0] - places[-1]).max() > 1e-3, "nothing fell"


@pytest.mark.skipif(not bpy.app.build_options.alembic, reason="this Blender was built without Alembic")
def test_alembic_moves_as_the_scene(walker, scene, tmp_path):
    other = walker.copy()
    scene.collection.objects.link(other)
    walker.select_set(True)
    other.select_set(False)
    export(tmp_path / "walk.abc", "Alembic sequence", use_selection=True)
    assert walker.select_get() and not other.select_get() and scene.frame_current == 1
    assert_moves_like(imported(bpy.ops.wm.alembic_import, tmp_path / "walk.abc"), walker)


def test_instances_are_objects_of_their_own(ball, scene, tmp_path):
    """A collection that stands somewhere else, too."""
    stage, again = bpy.data.collections.new("Stage"), bpy.data.objects.new("Again", None)
    stage.objects.link(ball)
    again.instance_type, again.instance_collection, again.location = "COLLECTION", stage, (5, 0, 0)
    scene.collection.objects.link(again)
    export(tmp_path / "two.usdc", "USD sequence")
    before = set(bpy.data.objects)
    assert bpy.ops.wm.usd_import(filepath=str(tmp_path / "two.usdc")) == {"FINISHED"}
    middles = sorted(world_points(o)[:, 0].mean() for o in bpy.data.objects if o not in before and o.type == "MESH")
    np.testing.assert_allclose(middles, [world_points(ball)[:, 0].mean() + x for x in (0, 5)], atol=1e-4)


def test_what_cannot_be_written_is_refused_by_name(walker, scene, tmp_path, monkeypatch):
    with pytest.raises(RuntimeError, match="frames are skipped"):
        export(tmp_path / "walk.abc", "Alembic sequence", frame_step=2)
    walker.hide_viewport = True
    with pytest.raises(RuntimeError, match=r'"Big ball".*hidden in viewports'):
        export(tmp_path / "walk.abc", "Alembic sequence")
    walker.hide_viewport = False
    module = part("addon.alembic")
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'"Box".*Big ball'):
        module.write_alembic(bpy.context, tmp_path / "walk.abc", FRAMES, ["Box"], 1.0)
    assert not (tmp_path / "walk.abc").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "operator"), [("walk.usdc", "usd_import"), ("walk.abc", "alembic_import")])
def test_a_scene_is_converted_by_the_command(walker, scene, tmp_path, name, operator):
    """Another Blender evaluates the saved file, which has no camera."""
    bpy.data.objects.remove(scene.camera)
    other = walker.copy()
    other.name = "Other"
    scene.collection.objects.link(other)
    blend = tmp_path / "walk.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    command = [os.environ["DRGS_ENGINE"], "-m", "drgs_blender.cli.main", "convert", str(blend), str(tmp_path / name)]
    command += ["--object", walker.name, "--frames", "3-7", "--blender", sys.executable]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "frames 3 to 7" in done.stdout and (operator != "usd_import" or "30 per second" in done.stdout)
    assert_moves_like(imported(getattr(bpy.ops.wm, operator), tmp_path / name), walker)
    missing = subprocess.run([*command, "--object", "Nobody"], capture_output=True, text=True, timeout=200, cwd=ROOT)
    assert missing.returncode == 64 and "Nobody" in missing.stderr and "Big ball" in missing.stderr
