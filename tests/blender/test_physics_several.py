"""Bakes of several objects at once, and the frames that a new one takes."""

from __future__ import annotations

import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from physics_scenes import FRAMES, PATIENCE, bake_job, begin_of, cache_of, computed_last, settings_export, world
from scenes import part, select


@pytest.mark.slow
def test_all_selected_objects_are_baked_one_after_another(body, scene, tmp_path):
    """One that cannot be is named, and does not keep the others from it."""
    first, second, third, plain = body, body.copy(), body.copy(), body.copy()
    for x, obj in ((4, second), (8, third), (12, plain)):
        scene.collection.objects.link(obj)
        obj.location.x = x
    plain.drgs.physics.use = False
    first.name, second.name, third.name = "First", "Second", "Third"
    second.drgs.physics.pin_group = "Nope"
    select(plain, third, second, first)
    with pytest.raises(RuntimeError, match='Object "Second": has no vertex group') as told:
        bpy.ops.drgs.bake_physics()
    assert "First" not in str(told.value) and "Third" not in str(told.value)
    assert cache_of(first).frames() == cache_of(third).frames() == list(range(1, FRAMES + 1))
    assert not cache_of(second).frames() and not plain.modifiers and not bake_job.running and not bake_job.waiting
    assert world(third, FRAMES)[:, 2].mean() < -0.1 and abs(world(third, FRAMES)[:, 0].mean() - 8) < 0.01
    second.drgs.physics.pin_group = ""
    # What an editor is pinned to is meant alone, whatever is selected.
    with bpy.context.temp_override(object=second):
        assert bake_job.chosen(bpy.context) == [second]
        assert bpy.ops.drgs.bake_physics() == {"FINISHED"}
    assert cache_of(second).frames() == list(range(1, FRAMES + 1))
    scene.frame_set(1)
    select(second, first)
    assert [obj.name for obj in bake_job.chosen(bpy.context)] == ["Second", "First"]


class Window(SimpleNamespace):
    """What a modal operator asks of Blender's window."""

    def __init__(self, scene) -> None:
        manager = SimpleNamespace(
            windows=[], event_timer_add=lambda *_, **__: "timer", event_timer_remove=lambda _: None,
            modal_handler_add=lambda _: None,
        )  # fmt: skip
        workspace = SimpleNamespace(status_text_set=lambda _: None)
        super().__init__(scene=scene, window=object(), window_manager=manager, workspace=workspace)


def in_window(obj, scene, monkeypatch):
    """The operator as it runs beside a window, the window, and a list of what it tells."""
    operators = part("operators.physics")
    monkeypatch.setattr(operators, "bpy", SimpleNamespace(app=SimpleNamespace(background=False), types=bpy.types))
    own = {n: v for n, v in vars(operators.DRGS_OT_bake_physics).items() if not n.startswith(("__", "bl_"))}
    told: list[str] = []
    bake = type("StandIn", (operators._JobOperator,), own | {"report": lambda self, _, text: told.append(text)})()
    context = Window(scene)
    context.object = context.active_object = obj
    context.selected_objects = [obj]
    return bake, context, told


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["all", "without the second", "escape", "a closed window", "removed"])
def test_a_bake_that_waits_says_so_and_can_be_cancelled(body, scene, monkeypatch, ending):
    """The operator's own steps, on a window that stands in for Blender's: there is none in the background."""
    other = body.copy()
    scene.collection.objects.link(other)
    select(body, other)
    bake, context, told = in_window(other, scene, monkeypatch)
    context.selected_objects = [body, other]
    assert bake.run(context) == {"RUNNING_MODAL"}
    assert bake_job.of(body) and bake_job.is_waiting(other) and not bake_job.of(other)
    assert not bpy.ops.drgs.bake_physics.poll() and bpy.ops.drgs.cancel_physics.poll()
    if ending == "without the second":
        assert bpy.ops.drgs.cancel_physics() == {"FINISHED"} and bake_job.of(body)
    elif ending == "escape":
        assert bake.modal(context, SimpleNamespace(type="ESC", value="PRESS")) == {"CANCELLED"}
    elif ending == "a closed window":
        bake.cancel(context)
    elif ending == "removed":
        context.selected_objects.remove(body)
        bpy.data.objects.remove(body)
    result = {"RUNNING_MODAL"}
    until = time.monotonic() + PATIENCE
    while ending not in ("escape", "a closed window") and result <= {"RUNNING_MODAL", "PASS_THROUGH"}:
        assert time.monotonic() < until
        result = bake.modal(context, SimpleNamespace(type="TIMER", value="NOTHING"))
    assert not bake_job.running and not bake_job.waiting and bpy.ops.drgs.bake_physics.poll()
    if ending == "removed":
        assert result == {"FINISHED"} and len(cache_of(other).frames()) == FRAMES
        assert "was removed while it was simulated" in told[0] and "frames baked" in told[1] and len(told) == 2
        return
    frames = [len(cache_of(obj).frames()) for obj in (body, other)]
    if ending in ("all", "without the second"):
        assert result == {"FINISHED"} and frames == [FRAMES, FRAMES if ending == "all" else 0]
        assert len(told) == sum(map(bool, frames)) and all("frames baked" in text for text in told)
    else:
        assert len(told) == 1 and "stopped at" in told[0]


@pytest.mark.slow
def test_undo_during_a_bake_that_fails_takes_no_frames_away(body, scene, monkeypatch):
    """What plays them is there again at the end, and in the undo step that the operator then makes."""
    bake, context, told = in_window(body, scene, monkeypatch)
    body.drgs.physics.frame_end = 1000
    assert bake.run(context) == {"RUNNING_MODAL"}
    begin_of(bake._job, 2)
    part("addon.cache_playback").detach(body)
    bake._job.process._process.kill()
    result, until = {"PASS_THROUGH"}, time.monotonic() + PATIENCE
    while result == {"PASS_THROUGH"}:
        assert time.monotonic() < until
        result = bake.modal(context, SimpleNamespace(type="TIMER", value="NOTHING"))
    assert "frames can be played" in told[0] and result == {"FINISHED"}
    assert [m.type for m in body.modifiers] == ["MESH_CACHE"]


def test_a_renamed_object_keeps_its_cache(ball, scene):
    """Of the objects that play one cache, as duplicates do, each has the one of its name."""
    before = settings_export.folder_of(ball)
    part("addon.cache_playback").attach(ball, before / "mesh.pc2", 1)
    ball.name = "Fireball"
    assert settings_export.folder_of(ball) == before
    other = ball.copy()
    scene.collection.objects.link(other)
    folders = [settings_export.folder_of(obj).name for obj in (ball, other)]
    assert folders == ["Fireball", "Fireball_001"]
    bpy.data.objects.remove(other)
    assert settings_export.folder_of(ball) == before


@pytest.mark.slow
def test_another_blend_never_replaces_frames_and_goes_on_from_those_it_plays(body, scene, tmp_path):
    """Two files of one folder, with an object of one name, as a copy and *Save As* make."""
    bpy.ops.drgs.bake_physics()
    bpy.ops.wm.save_mainfile()
    first = cache_of(body)
    before = {path: path.read_bytes() for path in first.folder.iterdir() if path.is_file()}
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene v2.blend"))
    shown = world(body, FRAMES)
    body.drgs.physics.frame_end = FRAMES + 1
    bpy.ops.drgs.bake_physics()
    second = cache_of(body)
    assert second.folder == tmp_path / "drgs_cache" / "scene v2" / "ball"
    assert computed_last(body) == 1, "the frames that it played are its own now"
    np.testing.assert_array_equal(world(body, FRAMES), shown)
    assert settings_export.played_elsewhere(body) is None
    body.drgs.physics.density = 300
    bpy.ops.drgs.bake_physics()
    assert computed_last(body) == FRAMES
    assert {path: path.read_bytes() for path in before} == before
    # A copy that has not been baked plays the frames, which go with none but the file that baked them.
    body.drgs.physics.frame_end = FRAMES
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "third.blend"))
    (kept,) = second.folder.glob(f"frame_{FRAMES:06d}.drgp")
    bpy.ops.drgs.free_physics()
    assert kept.exists() and not body.modifiers
    assert f"the frames in {second.folder} stay" in part("addon.messages").history[-1].text
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    again = bpy.data.objects["ball"]
    select(again)
    np.testing.assert_array_equal(world(again, FRAMES), shown)
    bpy.ops.drgs.free_physics()
    assert not first.folder.exists() and kept.exists()


def test_a_chosen_folder_is_refused_to_another_blend_while_the_first_is_there(body, scene, tmp_path):
    body.drgs.physics.folder, body.drgs.physics.frame_end = "//shared", 2
    bpy.ops.drgs.bake_physics()
    bpy.ops.wm.save_mainfile()
    old = tmp_path / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    kept = cache_of(body)
    with pytest.raises(RuntimeError, match=rf'"ball": would replace the frames of "ball" of {old}.*Choose another'):
        bpy.ops.drgs.bake_physics()
    bpy.ops.drgs.free_physics()
    assert kept.frames() == [1, 2] and f'they are those of "ball" of {old}' in part("addon.messages").history[-1].text
    old.unlink()  # renamed, or given up
    assert bpy.ops.drgs.bake_physics() == {"FINISHED"}
    bpy.ops.drgs.free_physics()
    assert not kept.folder.exists()


def test_every_blend_has_a_folder_of_caches_of_its_own(ball, tmp_path):
    """Also one that is named as the backups that Blender makes, and the objects of a library."""
    folders = []
    for name in ("scene.blend", "scene.v2.blend", "scene.blend1"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / name))
        folders.append(settings_export.folder_of(ball).relative_to(tmp_path).as_posix())
    assert folders == [f"drgs_cache/{name}/ball" for name in ("scene", "scene.v2", "scene.blend1")]
    bpy.ops.wm.read_homefile(use_empty=True)
    (tmp_path / "shots").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shots" / "shot.blend"))
    bpy.ops.wm.link(directory=f"{tmp_path}/scene.blend/Object/", filename="ball")
    assert settings_export.folder_of(bpy.data.objects["ball"]) == tmp_path / folders[0]


def test_frames_are_the_scenes_until_the_artist_chooses(ball, scene):
    physics = ball.drgs.physics
    scene.frame_start, scene.frame_end = 10, 72
    physics.use = True
    assert (physics.frame_start, physics.frame_end) == (10, 72)
    physics.frame_end = 40
    scene.frame_start, scene.frame_end = 1, 250
    physics.use = False
    physics.use = True
    assert (physics.frame_start, physics.frame_end) == (10, 40), "what is chosen, or baked, stays"
    other = ball.copy()
    assert (other.drgs.physics.frame_start, other.drgs.physics.frame_end) == (10, 40)
