"""F12 through Blender's own pipeline: the engine's pixels, passes, animation, cancelling, failures."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from scenes import PACKAGE, ROOT, new_world, part, read_exr

pytestmark = pytest.mark.blender_api

link = part("addon.engine_link")
errors = part("drgs_blender.core.errors")

#: Renders a frame description in the engine's own interpreter, without process boundary or Blender.
SESSION = """
import json, sys
import numpy as np
from drgs_blender.ipc.codec import decode_frame
from drgs_blender.engine.session import Session
folder = sys.argv[1]
session = Session()
arrays = dict(np.load(folder + "/arrays.npz"))
frame = decode_frame(json.load(open(folder + "/frame.json")), arrays)
for state in frame.objects:
    state.asset = session.load_asset(state.asset)
np.savez(folder + "/passes.npz", **session.render(frame))
"""


def light(scene, colour=(0.9, 0.6, 0.3), strength=1.5):
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (*colour, 1)
    background.inputs["Strength"].default_value = strength


def render(scene, width=64, height=48):
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, width, height)


def test_an_animation_warns_once_of_what_is_in_every_frame(ball, scene, captured, tmp_path):
    history = part("addon.messages").history
    scene.view_layers[0].use_pass_cryptomatte_asset = True
    scene.collection.objects.link(bpy.data.objects.new("Fog", bpy.data.volumes.new("Fog")))
    scene.frame_start, scene.frame_end = 1, 3
    scene.render.filepath = str(tmp_path / "####")
    history.clear()
    bpy.ops.render.render(animation=True)
    assert len(captured) == 3 and len(history) == 2
    told = max(message.time for message in history)
    bpy.ops.render.render()
    assert len(history) == 2 and min(message.time for message in history) > told, "the next render says it again"


def test_a_warning_is_printed_once_without_a_window(ball, scene, captured, capfd, caplog):
    scene.collection.objects.link(bpy.data.objects.new("Fog", bpy.data.volumes.new("Fog")))
    bpy.ops.render.render()
    printed = "".join(capfd.readouterr())
    assert printed.count("Fog") == 1 and "Warning: 1 volume object is not rendered by DR-GS: Fog" in printed
    assert not [record for record in caplog.records if "Fog" in record.message]


def test_compiling_is_said_without_a_window_but_not_each_kernel(monkeypatch, capsys):
    background, preparing = part("addon.background_render"), part("drgs_blender.core.phases").PREPARING
    engine = SimpleNamespace(update_stats=lambda *_: None, update_progress=lambda _: None)
    progress = part("addon.render_engine.engine").DrgsRenderEngine._progress
    monkeypatch.setattr(background, "_next_news", 0.0)
    for phase in ("Light", f"{preparing}, 1 of 9", f"{preparing}, 2 of 9", "Light"):
        progress(engine, phase, 0.5)
    assert capsys.readouterr().out == f"drgs: {preparing}, 1 of 9\n"
    monkeypatch.setattr(background, "_next_news", time.monotonic())
    progress(engine, f"{preparing}, 7 of 9", 0.5)
    assert capsys.readouterr().out == f"drgs: {preparing}, 7 of 9\n"


def test_without_a_card_f12_is_rendered_on_the_processor_and_says_so(ball, scene):
    history = part("addon.messages").history
    light(scene)
    here = render(scene)
    history.clear()
    scene.drgs.device = "CUDA"
    there = render(scene)
    if any("Rendered on the CPU" in message.text for message in history):
        np.testing.assert_array_equal(there, here)
    else:
        np.testing.assert_allclose(there, here, atol=2e-3)
        pytest.skip("this machine has a card, which gave the same picture")


def test_f12_writes_exactly_the_pixels_of_a_session(ball, scene, tmp_path, captured, monkeypatch):
    light(scene)
    ball.rotation_euler = (0.3, 0.2, 0.1)
    bpy.ops.render.render()
    (frame,) = captured
    monkeypatch.undo()
    picture = render(scene)
    description, arrays = part("drgs_blender.ipc.codec").encode_frame(frame)
    (tmp_path / "frame.json").write_text(json.dumps(description))
    np.savez(tmp_path / "arrays.npz", **arrays)
    subprocess.run([os.environ["DRGS_ENGINE"], "-c", SESSION, str(tmp_path)], check=True, timeout=300, cwd=ROOT)
    expected = np.load(tmp_path / "passes.npz")["Combined"]
    np.testing.assert_array_equal(picture, expected)
    # The ball is lit, round and upright; around it is the world.
    np.testing.assert_allclose(picture[2, 2, :3], (1.35, 0.9, 0.45), rtol=1e-5)
    middle = picture[24, 32]
    assert middle[3] > 0.99 and middle[:3].min() > 0.02 and middle[:3].max() < 1.35


def test_picture_is_upright_and_transparent_where_asked(ball, scene):
    light(scene)
    ball.location.z = 0.8
    scene.render.film_transparent = True
    picture = render(scene)
    rows = np.flatnonzero(picture[..., 3].max(1) > 0.5)
    assert rows.mean() < 20, "a ball above the centre is in the upper rows"
    assert (picture[picture[..., 3] == 0][:, :3] == 0).all() and (picture[..., 3] == 0).mean() > 0.5


def test_border_renders_the_same_pixels_as_the_whole(ball, scene):
    light(scene)
    whole = render(scene)
    scene.render.use_border = True
    scene.render.border_min_x, scene.render.border_max_x = 0.25, 0.75
    scene.render.border_min_y, scene.render.border_max_y = 0.5, 1.0
    inside = render(scene)
    np.testing.assert_array_equal(inside[:24, 16:48], whole[:24, 16:48])
    assert not inside[24:].any()
    scene.render.use_crop_to_border = True
    np.testing.assert_array_equal(render(scene, 32, 24), whole[:24, 16:48])


def test_passes_of_the_table_reach_the_compositor(ball, scene, captured):
    """Every pass that can be switched on arrives in the render result under Blender's name."""
    layer = scene.view_layers[0]
    table, names = part("drgs_blender.core.passes").PASSES, part("addon.view_layer_passes")
    switch = part("addon.view_layer_settings").switch_of
    for p in table:
        setattr(*((layer, p.blender) if p.blender else (layer.drgs, switch(p))), True)
    registered = []
    engine = part("addon.render_engine.engine").DrgsRenderEngine
    stand_in = type("StandIn", (), {"register_pass": lambda self, *a: registered.append(a)})()
    engine.update_render_passes(stand_in, scene, layer)
    assert [r[2] for r in registered] == [names.blender_name(p) for p in table]
    assert all(r[3] == len(r[4]) for r in registered)
    image = scene.render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    bpy.ops.render.render(write_still=True)
    assert captured[0].passes == tuple(p.name for p in table)
    header = Path(scene.render.filepath).read_bytes()[:40000]
    for p in table:
        assert f".{names.blender_name(p)}.{p.channels[-1]}".encode() in header, p.name


def test_only_blenders_own_names_are_used_for_its_passes():
    """A compositor made for Cycles finds the same sockets."""
    scene = bpy.context.scene
    layer = scene.view_layers[0]
    table = [p for p in part("drgs_blender.core.passes").PASSES if p.blender]
    for p in table:
        setattr(layer, p.blender, True)
    import importlib
    import sys

    scripts = bpy.utils.system_resource("SCRIPTS") or bpy.utils.resource_path("LOCAL")
    path = next(
        p for p in sys.path if p.endswith(("addons_core", "addons")) and os.path.isdir(os.path.join(p, "cycles"))
    )
    assert path, scripts
    cycles = importlib.import_module("cycles.engine")
    theirs = {name: (channels, kind) for name, channels, kind in cycles.list_render_passes(scene, layer)}
    for p in table:
        assert theirs[part("addon.view_layer_passes").blender_name(p)] == (p.channels, p.kind)


def test_view_layers_are_rendered_separately(ball, scene, captured):
    second = scene.view_layers.new("Second")
    second.layer_collection.exclude = True
    for collection in second.layer_collection.children:
        collection.exclude = True
    hidden = bpy.data.collections.new("Ball")
    scene.collection.children.link(hidden)
    scene.collection.objects.unlink(ball)
    hidden.objects.link(ball)
    second.layer_collection.children["Ball"].exclude = True
    bpy.ops.render.render()
    assert [len(f.objects) for f in captured] == [1, 0]


def test_animation_writes_every_frame_with_its_pose(ball, scene, tmp_path):
    light(scene)
    scene.frame_start, scene.frame_end = 1, 3
    for number, x in ((1, -1.0), (3, 1.0)):
        ball.location.x = x
        ball.keyframe_insert("location", frame=number)
    scene.render.film_transparent = True
    scene.render.filepath = str(tmp_path / "frame_####")
    bpy.ops.render.render(animation=True)
    middles = []
    for number in (1, 2, 3):
        alpha = read_exr(tmp_path / f"frame_{number:04}.exr", 64, 48)[..., 3]
        middles.append((alpha * (np.arange(64) + 0.5)).sum() / alpha.sum())
    assert middles[0] < 26 and abs(middles[1] - 32) < 0.5 and middles[2] > 38


def test_frames_of_several_layers_stay_and_those_cut_off_go(ball, scene, tmp_path):
    """Blender cannot read a multilayer EXR back; what is whole by its chunks is kept all the same."""
    light(scene)
    scene.view_layers[0].use_pass_z = True
    image = scene.render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    scene.frame_start, scene.frame_end = 1, 2
    scene.render.filepath = str(tmp_path / "layers_####")
    bpy.ops.render.render(animation=True)
    files = sorted(tmp_path.glob("layers_*.exr"))
    assert [path.name for path in files] == ["layers_0001.exr", "layers_0002.exr"]
    files[0].write_bytes(files[0].read_bytes()[:-200])
    for number in (1, 2):
        scene.frame_set(number)
        part("addon.background_render").verify(scene)
    assert [path.is_file() for path in files] == [False, True]


def test_engine_process_survives_between_renders_and_is_replaced_when_killed(ball, scene):
    light(scene)
    first = render(scene)
    pid = link.client().pid
    np.testing.assert_array_equal(render(scene), first)
    assert link.client().pid == pid
    os.kill(pid, 9)
    np.testing.assert_array_equal(render(scene), first)
    assert link.client().pid != pid
    bpy.ops.drgs.engine_stop()
    assert not link.is_running()


@pytest.fixture
def no_engine(monkeypatch, tmp_path):
    link.stop()
    monkeypatch.setenv("DRGS_ENGINE", str(tmp_path / "nowhere"))


def test_without_engine_nothing_is_written_and_the_message_helps(ball, scene, no_engine):
    with pytest.raises(RuntimeError, match=r"engine.*nowhere.*Set it to"):
        bpy.ops.render.render(write_still=True)
    assert not os.path.exists(scene.render.filepath)
    assert part("addon.messages").history[-1].level == "ERROR"
    with pytest.raises(RuntimeError, match="nowhere"):
        bpy.ops.drgs.engine_test()


def test_preference_names_the_engine_where_the_environment_does_not(scene, monkeypatch):
    place = os.environ["DRGS_ENGINE"]
    monkeypatch.delenv("DRGS_ENGINE")
    settings = bpy.context.preferences.addons[PACKAGE].preferences
    settings.engine_python = place
    try:
        assert link.command_line()[0] == place
        assert bpy.ops.drgs.engine_test() == {"FINISHED"} and link.is_running()
        settings.engine_python = str(Path(place).with_name("no-such-python"))
        with pytest.raises(RuntimeError, match=r"preference.*no-such-python"):
            bpy.ops.drgs.engine_test()
    finally:
        settings.engine_python = ""


def test_failing_frame_stops_an_animation(ball, scene, ball_file, captured, tmp_path):
    scene.frame_start, scene.frame_end = 1, 3
    scene.render.filepath = str(tmp_path / "frame_####")

    def spoil(*_):
        if scene.frame_current == 2:
            ball_file.unlink()

    bpy.app.handlers.frame_change_pre.append(spoil)
    try:
        with pytest.raises(RuntimeError, match=r'"ball".*does not exist'):
            bpy.ops.render.render(animation=True)
    finally:
        bpy.app.handlers.frame_change_pre.remove(spoil)
    assert [p.name for p in tmp_path.glob("frame_*")] == ["frame_0001.exr"]


def test_unexpected_failure_is_reported_and_not_swallowed(ball, scene, captured, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("on purpose")

    monkeypatch.setattr(link, "render", broken)
    with pytest.raises(RuntimeError, match="ZeroDivisionError: on purpose"):
        bpy.ops.render.render(write_still=True)
    assert not os.path.exists(scene.render.filepath)


def test_cancel_ends_a_long_render_within_half_a_second(ball, scene, monkeypatch):
    light(scene)
    render(scene)
    scene.render.resolution_x = scene.render.resolution_y = 2048
    scene.drgs.cosine_samples = scene.drgs.environment_samples = 500
    pressed: list[float] = []
    original = link.render

    def impatient(frame, on_progress, cancelled):
        """Esc a moment after the render has begun; Blender's own test_break cannot be pressed in the background."""
        phases: list[str] = []

        def test_break():
            assert cancelled() is False
            if len(phases) > 2 and not pressed:
                pressed.append(time.perf_counter())
            return bool(pressed)

        return original(frame, lambda phase, part: (phases.append(phase), on_progress(phase, part)), test_break)

    monkeypatch.setattr(link, "render", impatient)
    bpy.ops.render.render()
    assert pressed and time.perf_counter() - pressed[0] < 0.5
    monkeypatch.undo()
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    scene.drgs.cosine_samples, scene.drgs.environment_samples = 2, 1
    assert render(scene)[24, 32, 3] > 0.99
