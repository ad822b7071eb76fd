"""Objects that push each other: one bake, a cache each, and what keeps them from it."""

from __future__ import annotations

import json
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from physics_scenes import (
    FRAMES,
    bake_job,
    begin_of,
    box_object,
    cache_of,
    cache_state,
    computed_last,
    scene_export,
    settings_export,
    world,
)
from scenes import part, select
from test_panels import Layout

coupling = part("addon.physics.coupling")
errors = part("drgs_blender.core.errors")


@pytest.fixture
def pair(body, scene):
    """A ball that falls onto another one, on a floor."""
    top = body.copy()
    body.name, top.name = "Lower", "Upper"
    together = bpy.data.collections.new("Together")
    scene.collection.children.link(together)
    for obj in (body, top):
        together.objects.link(obj)
    size = float(max(body.dimensions))
    top.location.z = body.location.z + 1.1 * size
    for obj in (body, top):
        obj.drgs.physics.use_floor, obj.drgs.physics.floor = True, body.location.z - 0.55 * size
    top.drgs.physics.velocity = (0, 0, -3 * size)
    body.drgs.physics.coupling = together
    select(top)
    return body, top


def test_who_is_baked_with_whom(pair, scene):
    lower, upper = pair
    together = lower.drgs.physics.coupling
    assert coupling.members(lower) == coupling.members(upper) == [lower, upper], "one of them names the collection"
    assert bake_job.chosen(bpy.context) == [upper] and coupling.apart([lower, upper]) == [upper]
    plain = box_object("Plain", (5, 5, 5), (6, 6, 6))
    together.objects.link(plain)
    assert coupling.members(lower) == [lower, upper] and coupling.idle(upper) == [plain]
    upper.drgs.physics.use = False
    assert coupling.members(lower) == [lower] and coupling.describe(lower) == {}
    upper.drgs.physics.use = True
    bpy.data.objects.remove(plain)
    scene.collection.objects.link(upper)
    together.objects.unlink(upper)
    assert coupling.members(lower) == [lower] and coupling.members(upper) == [upper]
    upper.drgs.physics.coupling = together
    assert coupling.members(upper) == coupling.members(lower) == [lower, upper], "both name it"


@pytest.mark.slow
def test_coupled_objects_push_each_other_into_a_cache_each(pair, scene):
    lower, upper = pair
    size = max(lower.dimensions)
    row = upper.drgs.physics.colliders.add()
    row.object = lower
    assert bpy.ops.drgs.bake_physics() == {"FINISHED"}
    for obj in pair:
        assert cache_of(obj).frames() == list(range(1, FRAMES + 1)), obj.name
        found = cache_state.cached(obj, scene)
        assert found.frames == found.expected == FRAMES and not found.changed and not found.missing
        assert obj.modifiers and [body["name"] for body in cache_of(obj).header().settings["coupled"]] == [
            "Lower",
            "Upper",
        ]
    assert not bake_job.running and not bake_job.waiting
    data = json.loads((settings_export.folder_of(upper) / bake_job.INPUT / scene_export.SETTINGS).read_text())
    assert not data["colliders"], "a body is no collider"
    gap = world(upper, FRAMES)[:, 2].min() - world(lower, FRAMES)[:, 2].max()
    assert abs(gap) < 0.5 * size / 8, "one lies on the other, within half a cell"
    assert world(lower, FRAMES)[:, 2].max() < world(lower, 1)[:, 2].max() - 0.01 * size, "which gives way"
    assert bpy.ops.drgs.bake_physics() == {"FINISHED"} and computed_last(lower) == 0
    scene.frame_set(1)
    # What changes for one is a change for both.
    for name, value in (("friction", 0.9), ("contact", "sticky"), ("density", 700.0)):
        before = getattr(lower.drgs.physics, name)
        setattr(lower.drgs.physics, name, value)
        assert cache_state.cached(upper, scene).changed, name
        setattr(lower.drgs.physics, name, before)
    assert not cache_state.cached(upper, scene).changed
    lower.name = "Renamed"
    assert not cache_state.cached(upper, scene).changed
    lower.drgs.physics.coupling = None
    assert cache_state.cached(upper, scene).changed and cache_state.cached(lower, scene).changed
    lower.drgs.physics.coupling = bpy.data.collections["Together"]
    # One without frames is named.
    cache_of(lower).clear()
    assert cache_state.cached(upper, scene).missing == ("Renamed",)
    assert bpy.ops.drgs.bake_physics() == {"FINISHED"} and computed_last(lower) == FRAMES - 1
    assert bpy.ops.drgs.free_physics() == {"FINISHED"}
    assert not any(cache_of(obj).frames() or obj.modifiers for obj in pair)


def test_a_line_about_one_of_several_bodies_is_told_of_that_one():
    subject_of = part("addon.physics.simulate_process")._subject_of
    both = 'Objects "A", "B"'
    assert subject_of('floor or wall: overlaps body "B" at the start', both) == 'Object "B"'
    assert subject_of('body "A" touches body "B"', both) == subject_of("device cuda: no", both) == both


@pytest.mark.slow
def test_a_coupled_bake_is_cancelled_and_goes_on(pair, scene):
    lower, upper = pair
    for obj in pair:
        obj.drgs.physics.frame_end = 40
    bake = bake_job.Bake(upper, scene)
    assert bake_job.of(lower) is bake_job.of(upper) is bake
    with pytest.raises(errors.UsageError, match="is being baked already"):
        bake_job.Bake(lower, scene)
    begin_of(bake, 3)
    assert bake.cancel() and not bake_job.running
    kept = min(len(cache_of(obj).frames()) for obj in pair)
    assert 3 <= kept < 40 and all(obj.modifiers for obj in pair)
    while part("addon.physics.simulate_process").ending():
        time.sleep(0.05)
    first = {obj.name: cache_of(obj).read(2).points.copy() for obj in pair}
    for obj in pair:
        obj.drgs.physics.frame_end = kept + 1
    select(lower)
    assert bpy.ops.drgs.bake_physics() == {"FINISHED"}
    assert computed_last(lower) < kept, "frames that were there stay"
    for obj in pair:
        assert np.array_equal(cache_of(obj).read(2).points, first[obj.name])
    # A member that goes away ends the bake, by name.
    for obj in pair:
        obj.drgs.physics.frame_end = 400
    bake = begin_of(bake_job.Bake(lower, scene), kept)
    bpy.data.objects.remove(upper)
    with pytest.raises(settings_export.Removed, match='Object "Upper": was removed'):
        while not bake.step(0.05):
            pass
    bake.close()
    assert not bake_job.running


def test_what_keeps_objects_from_being_baked_together_is_named(pair, scene):
    lower, upper = pair
    assert coupling.problem_of(lower) == "" == coupling.problem_of(upper)

    def refused(match):
        assert coupling.problem_of(lower)
        with pytest.raises(RuntimeError, match=match):
            bpy.ops.drgs.bake_physics()
        assert not bake_job.running

    select(lower)
    upper.hide_set(True)
    refused('Object "Upper": is hidden.*baked together')
    upper.hide_set(False)
    upper.drgs.physics.solver = "xpbd"
    refused('Object "Upper": has another solver than MPM.*collider')
    upper.drgs.physics.solver = "mpm"
    upper.drgs.physics.frame_end = FRAMES + 1
    refused('Object "Upper": has other frames than "Lower".*1 to 6')
    upper.drgs.physics.frame_end = FRAMES
    upper.drgs.physics.folder = lower.drgs.physics.folder = "//same"
    with pytest.raises(RuntimeError, match="has the same cache as"):
        bpy.ops.drgs.bake_physics()
    upper.drgs.physics.folder = lower.drgs.physics.folder = ""
    other = bpy.data.collections.new("Other")
    upper.drgs.physics.coupling = other
    refused('Object "Upper": is coupled with two collections')


@pytest.mark.slow
def test_what_the_engine_refuses_names_the_body(pair, scene):
    lower, upper = pair
    upper.location.z = lower.location.z + 0.2 * max(lower.dimensions)
    with pytest.raises(RuntimeError, match=r'body "(Upper|Lower)": overlaps "(Upper|Lower)" at the start'):
        bpy.ops.drgs.bake_physics()
    upper.location.z = lower.location.z + 1.1 * max(lower.dimensions)
    upper.scale = (0.05,) * 3
    with pytest.raises(
        RuntimeError, match=r'body "Upper": is .* cells long.*Raise the resolution of the largest, "Lower"'
    ):
        bpy.ops.drgs.bake_physics()


def test_panels_name_who_is_baked_together_and_what_is_in_the_way(pair, scene):
    lower, upper = pair
    texts: list[str] = []

    class Recorder(Layout):
        def check(self, name, named):
            texts.append(named.get("text") or "")
            return super().check(name, named)

    panels = part("addon.panels.physics")

    def drawn():
        texts.clear()
        panels._draw_bake(Recorder([]), bpy.context)
        panels.DRGS_PT_physics_coupling.draw(SimpleNamespace(layout=Recorder([])), bpy.context)
        return " ".join(filter(None, texts))

    plain = box_object("Plain", (5, 5, 5), (6, 6, 6))
    lower.drgs.physics.coupling.objects.link(plain)
    for own, other in ((lower, "Upper"), (upper, "Lower")):
        select(own)
        text = drawn()
        assert "Bake 2 Objects" in text and f"Baked together with: {other} Plain has no DR-GS Physics" in text
    upper.hide_set(True)
    select(lower)
    assert 'Object "Upper": is hidden' in drawn()
    upper.drgs.physics.coupling = bpy.data.collections.new("Other")
    assert 'Object "Upper": is coupled with two collections' in drawn()
    lower.drgs.physics.coupling = None
    assert "Bake 2" not in drawn() and "Baked together" not in drawn(), "alone again"
