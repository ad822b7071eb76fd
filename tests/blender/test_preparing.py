"""What the extension says while the engine compiles its kernels, and that everything can be left meanwhile.

The engine has an empty folder for them, so it really compiles; no picture is awaited.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from scenes import new_world, part

phases = part("drgs_blender.core.phases")
link, engine, views = part("addon.engine_link"), part("addon.render_engine.engine"), part("addon.viewport.views")
COUNTED = re.compile(re.escape(phases.PREPARING) + r", \d+ of \d+")
#: A shared machine proves no more than that.
SECONDS = 3.0


@pytest.fixture
def cold(scene, ball, tmp_path, monkeypatch):
    """A lit scene and an engine without kernels."""
    new_world(scene)
    link.stop()
    monkeypatch.setenv("DRGS_CACHE_DIR", str(tmp_path / "kernels"))
    yield scene
    link.stop()


@pytest.fixture
def shown(monkeypatch):
    """Texts and fractions that Blender is given during final renders."""
    told: list[tuple[str, float]] = []
    original = engine.DrgsRenderEngine._progress

    def progress(self, phase, part):
        told.append((phase, part))
        original(self, phase, part)

    monkeypatch.setattr(engine.DrgsRenderEngine, "_progress", progress)
    return told


def wait(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.005)


@pytest.mark.slow
def test_f12_counts_them_and_is_left_at_once(cold, shown, monkeypatch):
    pressed: list[float] = []

    def stopped(self):
        if not pressed and any(COUNTED.fullmatch(text) for text, _ in shown):
            pressed.append(time.perf_counter())
        return bool(pressed)

    monkeypatch.setattr(engine.DrgsRenderEngine, "_stopped", stopped)
    for _ in range(2):
        shown.clear()
        pressed.clear()
        bpy.ops.render.render()
        assert pressed, shown
        assert time.perf_counter() - pressed[0] < SECONDS
        assert all(0 <= part_done <= 1 for _, part_done in shown)


def test_the_bar_of_f12_moves_with_them(scene, shown, captured, monkeypatch):
    """A real engine would take its time."""
    original = link.render

    def render(frame, on_progress, cancelled):
        for i in range(1, 4):
            on_progress(f"{phases.PREPARING}, {i} of 3", i / 3)
        return original(frame, on_progress, cancelled)

    monkeypatch.setattr(link, "render", render)
    bpy.ops.render.render()
    assert shown == [(f"{phases.PREPARING}, {i} of 3", i / 3) for i in range(1, 4)]
    shown.clear()
    scene.render.use_motion_blur, scene.drgs.blur_steps = True, 2
    bpy.ops.render.render()
    assert shown[:3] == [(f"{phases.PREPARING}, {i} of 3", i / 3) for i in range(1, 4)]


@pytest.mark.slow
def test_a_viewport_says_it_with_its_part_and_can_be_closed(cold, monkeypatch):
    worker = part("addon.viewport.worker").Worker()
    monkeypatch.setattr(views, "worker", worker)
    monkeypatch.setattr(views, "_viewports", {"a": views.ViewportState()})
    exported = part("addon.viewport.scenes").exported(bpy.context.evaluated_depsgraph_get())
    request = part("addon.viewport.worker").Request(exported.frame, link.client(), exported.assets)
    try:
        worker.submit("a", request)
        assert views.status("a")[0] == phases.STARTING
        wait(lambda: COUNTED.fullmatch(worker.progress("a")[0]))
        assert re.fullmatch(COUNTED.pattern + r"  \d+%", views.status("a")[0])
        phase, done = views.preparation()
        assert COUNTED.fullmatch(phase) and 0 <= done <= 1
        worker.drop("a")
        began = time.monotonic()
        wait(lambda: views.preparation() == ("", 0.0), 0.5)
        link.stop()
        assert time.monotonic() - began < SECONDS
    finally:
        worker.stop()


def test_a_picture_that_is_refined_says_it_too(scene, monkeypatch):
    """Kernels that are not counted have no part of their own."""
    frame = SimpleNamespace(settings=SimpleNamespace(sample_count=8))
    picture = SimpleNamespace(request=SimpleNamespace(frame=frame), fraction=0.5)
    phase = [("Rendering", 0.5)]
    worker = SimpleNamespace(
        state=lambda name: ("", ""), progress=lambda name: phase[0], names=lambda: ["a"], picture=lambda name: None
    )
    monkeypatch.setattr(views, "worker", worker)
    monkeypatch.setattr(views, "_viewports", {"a": views.ViewportState(picture=picture)})
    assert views.status("a") == ("Sample 4/8", "") and views.preparation() == ("", 0.0)
    phase[0] = phases.PREPARING, 0.3
    assert views.status("a") == (phases.PREPARING, "")
    phase[0] = f"{phases.PREPARING}, 3 of 12", 0.25
    assert views.status("a") == (f"{phases.PREPARING}, 3 of 12  25%", "")


def test_a_bake_says_it(body, tmp_path, monkeypatch):
    """`drgs simulate` without kernels, as its panel shows it; cancelled before there is a frame."""
    monkeypatch.setenv("DRGS_CACHE_DIR", str(tmp_path / "kernels"))
    bake_job = part("addon.physics.bake_job")
    bake = bake_job.Bake(body, bpy.context.scene)
    try:
        wait(lambda: bake.step(0.1) or COUNTED.fullmatch(bake.progress()[1]))
        assert 0 <= bake.progress()[0] <= 1
        began = time.monotonic()
        bake.close()
        wait(lambda: not part("addon.physics.simulate_process").ending(), 10)
        assert time.monotonic() - began < 2 * SECONDS
    finally:
        bake.close()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="environments have no links there")
def test_the_set_up_counts_them_and_cancelled_there_the_engine_answers(tmp_path, monkeypatch):
    """The true engine, in an environment that finds its packages in that of the tests."""
    setup = part("addon.engine_setup")
    environment = part("addon.engine_environment")
    monkeypatch.setenv("DRGS_CACHE_DIR", str(tmp_path / "kernels"))
    python, folder = os.environ["DRGS_ENGINE"], tmp_path / "engine"
    subprocess.run([python, "-m", "venv", "--without-pip", folder], check=True)
    asked = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    theirs = subprocess.run(asked, check=True, capture_output=True, text=True).stdout
    (own,) = folder.glob("lib/python3*/site-packages")
    (own / "theirs.pth").write_text(theirs)
    (folder / environment.SET_UP).write_text(json.dumps({"packages": environment.requirements()}))
    running = setup.EngineSetup(folder, Path("/no/python/is/needed"))
    wait(lambda: running.poll() or COUNTED.fullmatch(running.text), 240)
    assert not running.done, running.error
    assert environment.state(folder) == "ready" and running.fraction > 0
    group = running._process.pid
    running.cancel()
    assert running.remark and running.error is None and environment.state(folder) == "ready"
    with pytest.raises(ProcessLookupError):
        for _ in range(100):  # killed, and a moment away from its end
            os.killpg(group, 0)
            time.sleep(0.05)
    locate = part("drgs_blender.ipc.locate").locate_engine
    with part("drgs_blender.ipc.client").EngineClient(locate(environment.interpreter(folder))) as client:
        client.start()
        assert client.pid


def test_a_narrow_panel_writes_it_above_the_bar(scene):
    said: list[str] = []
    layout = SimpleNamespace(column=lambda align: SimpleNamespace(label=lambda text, icon: said.append(text)))
    text = f"{phases.PREPARING}, 3 of 12"
    for width, above in ((240, True), (900, False)):
        said.clear()
        region = SimpleNamespace(type="UI", width=width)
        context = SimpleNamespace(region=region, preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)))
        found = part("addon.panels.workflow").bar_text(layout, context, text, 0.25)
        assert (" ".join(said), found) == ((text, "25%") if above else ("", f"{text}  25%"))
