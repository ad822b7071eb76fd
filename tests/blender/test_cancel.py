"""Esc in every phase of a final render: it ends at once, and what comes next is as if nothing had been.

``DRGS_FAULTS=whole`` repeats each phase twenty times, at other moments.
"""

from __future__ import annotations

import os
import time

import bpy
import numpy as np
import pytest
from scenes import mesh_object, new_world, part, read_exr

TIMES = 20 if os.environ.get("DRGS_FAULTS") == "whole" else 3
SECONDS = 0.5 if os.environ.get("DRGS_FAULTS") == "whole" else 3.0  # a shared machine proves no more than that
link, engine = part("addon.engine_link"), part("addon.render_engine.engine")


@pytest.fixture
def lit(ball, scene):
    new_world(scene)
    return scene


@pytest.fixture
def escape(monkeypatch):
    """Function that presses Esc; Blender's own cannot be pressed in the background. Called without, it lifts it."""
    pressed: list[float] = []
    monkeypatch.setattr(engine.DrgsRenderEngine, "_stopped", lambda self: bool(pressed))
    return pressed


def rendered(scene) -> np.ndarray:
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, scene.render.resolution_x, scene.render.resolution_y)


def check(scene, pressed, **settings) -> None:
    """Render until Esc is pressed and look how long it took."""
    render = scene.render
    size = render.resolution_x, render.resolution_y
    for name, value in settings.items():
        setattr(scene.drgs if hasattr(scene.drgs, name) else render, name, value)
    for _ in range(TIMES):
        pressed.clear()
        bpy.ops.render.render()
        assert pressed, "the phase was never reached"
        assert time.perf_counter() - pressed[0] < SECONDS
    pressed.clear()
    render.resolution_x, render.resolution_y = size


@pytest.mark.parametrize("phase", ["Rendering", "Denoising"])
def test_tracing_and_denoising(lit, escape, phase, monkeypatch):
    """From the moment on that the engine says what it does, and a little later each time."""
    before = rendered(lit)
    original, turns = link.render, iter(range(10**6))

    def watched(frame, on_progress, cancelled):
        wait, since = 0.04 * (next(turns) % 5), []

        def tell(name, part_done):
            if name == phase:
                since.append(time.perf_counter())
            on_progress(name, part_done)

        def stopped():
            if since and not escape and time.perf_counter() - since[0] >= wait:
                escape.append(time.perf_counter())
            return cancelled()

        return original(frame, tell, stopped)

    monkeypatch.setattr(link, "render", watched)
    samples = {"cosine_samples": 500} if phase == "Rendering" else {"cosine_samples": 1}
    size = 1024 if phase == "Rendering" else 768
    check(lit, escape, resolution_x=size, resolution_y=size, denoise="svgf", **samples)
    monkeypatch.setattr(link, "render", original)
    lit.drgs.cosine_samples, lit.drgs.denoise = 2, "none"
    np.testing.assert_array_equal(rendered(lit), before)


def test_export_stops_before_the_next_object(lit, escape, captured, monkeypatch):
    """Also while the scene is evaluated at other frames, after which it is at its own again."""
    lit.view_layers[0].use_pass_vector = True
    for i in range(40):
        mesh_object(f"Plane {i}", [(-1, -1, i), (1, -1, i), (1, 1, i), (-1, 1, i)], [(0, 1, 2, 3)])
    lit.frame_set(7)
    seen = []
    original = part("addon.export.instances").visible

    def watched(depsgraph):
        for item in original(depsgraph):
            seen.append(item.key)
            if len(seen) == last:
                escape.append(time.perf_counter())
            yield item

    for module in ("frame", "motion_steps"):
        monkeypatch.setattr(part(f"addon.export.{module}"), "visible", watched)
    for turn in range(TIMES):
        last = 3 + 11 * (turn % 11)  # of three evaluations of 42 objects
        seen.clear()
        escape.clear()
        bpy.ops.render.render()
        assert len(seen) == last and not captured and lit.frame_current == 7
        assert time.perf_counter() - escape[0] < SECONDS


def test_handing_over_stops_between_two_passes(lit, escape, captured, monkeypatch):
    layer = lit.view_layers[0]
    for p in part("drgs_blender.core.passes").PASSES:
        switch = part("addon.view_layer_settings").switch_of
        setattr(*((layer, p.blender) if p.blender else (layer.drgs, switch(p))), True)
    lit.render.resolution_x, lit.render.resolution_y = 2048, 1080
    handed = []
    original = engine.uncancelled

    def watched(items, cancelled):
        def counted():
            for item in items:
                if len(handed) == last:
                    escape.append(time.perf_counter())
                yield item

        for item in original(counted(), cancelled):
            handed.append(item)
            yield item

    monkeypatch.setattr(engine, "uncancelled", watched)
    for turn in range(TIMES):
        last = 1 + turn % 8
        handed.clear()
        escape.clear()
        bpy.ops.render.render()
        assert len(handed) == last
        assert time.perf_counter() - escape[0] < SECONDS
