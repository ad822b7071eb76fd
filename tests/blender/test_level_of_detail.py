"""Level of detail in viewports: what is asked of the engine, what is said, and that final frames do not know of it."""

from __future__ import annotations

import time
from types import SimpleNamespace

import bmesh
import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import new_world, part, read_exr
from test_viewport import bits
from test_viewport_blur import asked, converged

pytestmark = pytest.mark.blender_api

MOST = 1000


@pytest.fixture
def views():
    module = part("addon.viewport.views")
    module.forget()
    yield module
    module.stop()
    part("addon.engine_link").stop()


@pytest.fixture
def dense(ball, ball_file):
    """The ball with more surfels than the least limit."""
    assets, containers = part("addon.assets"), part("drgs_blender.core.asset.container")
    asset = containers.read_asset(ball_file)
    parts = part("drgs_blender.core.asset.part")
    many = np.repeat(np.arange(len(asset.surfels)), 1 + 4 * MOST // len(asset.surfels))
    containers.write_asset(ball_file, parts.with_surfels(asset, many))
    assets.forget()
    new_world(bpy.context.scene)
    return ball


def until(condition):
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_settings_are_asked_for_and_limited(scene, ball, views):
    settings, limit = scene.drgs, part("drgs_blender.core.level_of_detail").MOST_SURFELS
    assert settings.level_of_detail == "AUTOMATIC"
    assert asked(views, scene).most == limit
    assert asked(views, scene) is None
    settings.viewport_surfels = 5
    assert asked(views, scene).most == settings.viewport_surfels == MOST, "the least that there is"
    settings.level_of_detail = "FULL"
    assert asked(views, scene).most == 0
    settings.viewport_surfels = 2000
    assert asked(views, scene) is None, "nothing of it counts then"


def test_what_moves_has_fewer_surfels_and_says_so_until_it_rests(scene, dense, views, monkeypatch):
    worker = part("addon.viewport.worker")
    scene.drgs.viewport_surfels = MOST
    monkeypatch.setattr(worker, "REST_SECONDS", 1e6)  # it does not rest yet
    request = asked(views, scene)
    until(lambda: views.worker.picture("view") is not None)
    picture = views.worker.picture("view")
    few, whole = picture.surfels
    assert 0 < few <= MOST < whole and picture.fraction == 0.0
    assert views.reduction("view") == f"{few:,} of {whole:,} surfels"
    assert views.worker._next() is None, "all are not begun while it moves"
    monkeypatch.setattr(worker, "REST_SECONDS", 0.0)
    with views.worker._changed:
        views.worker._changed.notify()
    last = converged(views, request)
    assert views.worker.picture("view").surfels == (whole, whole)
    assert views.reduction("view") == ""
    bpy.ops.render.render(write_still=True)
    np.testing.assert_allclose(last, read_exr(scene.render.filepath, 64, 48), rtol=1e-3, atol=1e-4)


def test_full_shows_all_from_the_first(scene, dense, views):
    scene.drgs.level_of_detail = "FULL"
    asked(views, scene)
    until(lambda: views.worker.picture("view") is not None)
    shown, whole = views.worker.picture("view").surfels
    assert shown == whole > MOST and views.reduction("view") == ""


def test_final_frames_are_the_same_to_the_last_bit(scene, dense, export):
    pictures, frames = [], []
    for level in ("AUTOMATIC", "FULL"):
        scene.drgs.level_of_detail, scene.drgs.viewport_surfels = level, MOST
        frames.append(bits(export()[0]))
        bpy.ops.render.render(write_still=True)
        pictures.append(read_exr(scene.render.filepath, 64, 48))
    assert frames[0] == frames[1]
    assert pictures[0].tobytes() == pictures[1].tobytes()


def test_splats_are_no_more_than_the_limit_and_cover_as_much(dense, ball_file):
    surfels, asset = part("addon.viewport.surfels"), part("addon.assets").load(ball_file)
    count = len(asset.surfels)
    rows, growth = surfels.first_rows(asset, 0.25)
    assert len(rows) == len(growth) == round(0.25 * count) == len(np.unique(rows))
    assert (asset.surfels.scale.prod(axis=1)[rows] * growth).sum() > asset.surfels.scale.prod(axis=1).sum()
    again, _ = surfels.first_rows(asset, 0.25)
    assert np.array_equal(rows, again)
    assert surfels.first_rows(asset, 1.0) == (slice(None), 1.0)
    assert len(surfels.first_rows(asset, 1e-9)[0]) == 1
    twin = bpy.data.objects.new("Twin", dense.data)
    twin.drgs.asset = dense.drgs.asset
    bpy.context.scene.collection.objects.link(twin)
    assert surfels.number(bpy.context.evaluated_depsgraph_get()) == 2 * count
    surfels.forget()


def test_what_was_cut_away_does_not_count(dense, ball_file):
    """What an object has left is not reduced where that alone is within the limit."""
    surfels, asset = part("addon.viewport.surfels"), part("addon.assets").load(ball_file)
    surfels.forget()
    edited = bmesh.new()
    edited.from_mesh(dense.data)
    bmesh.ops.delete(edited, geom=[f for f in edited.faces if f.calc_center_median().x > 0], context="FACES")
    edited.to_mesh(dense.data)
    left = surfels.number(bpy.context.evaluated_depsgraph_get())
    assert 0 < left < 0.7 * len(asset.surfels)
    surfels.forget()


def test_splats_that_are_drawn_are_read_once_and_as_many_as_allowed(scene, dense, ball_file, monkeypatch):
    """A redraw reads nothing again, another limit not the object; without a limit all are drawn."""
    surfels, asset = part("addon.viewport.surfels"), part("addon.assets").load(ball_file)
    surfels.forget()
    read, drawn, original = [], [], surfels.shown_asset
    monkeypatch.setattr(surfels, "shown_asset", lambda *given: read.append(1) or original(*given))
    monkeypatch.setattr(surfels.draw, "disc_batch", lambda places, colours, sizes: (places, sizes))
    monkeypatch.setattr(surfels.draw, "discs", lambda batch, *_: drawn.append(len(batch[0])))
    identity = Matrix.Identity(4)
    view = SimpleNamespace(
        window_matrix=identity, perspective_matrix=identity, view_matrix=identity, is_perspective=True
    )
    region = SimpleNamespace(type="WINDOW", height=100, as_pointer=lambda: 7)
    context = SimpleNamespace(region=region, region_data=view, area=SimpleNamespace(regions=[]))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for limit in (MOST, MOST, 2 * MOST, 10**9):
        scene.drgs.viewport_surfels = limit
        surfels.show(context, depsgraph)
    assert drawn == [MOST, MOST, 2 * MOST, len(asset.surfels)] and len(read) == 1
    surfels.forget()


@pytest.mark.parametrize("limits", [(MOST, MOST), (MOST, 10**9)])
def test_viewports_of_two_scenes_each_say_what_they_leave_out_and_then_rest(scene, dense, limits):
    """Another window shows another scene: neither has the other drawn again."""
    surfels, views = part("addon.viewport.surfels"), part("addon.viewport.views")
    surfels.forget()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    whole = surfels.number(depsgraph)
    tagged, windows = [], []
    for number, limit in enumerate(limits):
        header = SimpleNamespace(type="HEADER", tag_redraw=lambda: tagged.append(True))
        window = SimpleNamespace(type="WINDOW", as_pointer=lambda number=number: number)
        space = SimpleNamespace(area=SimpleNamespace(regions=[header, window]), region=window)
        windows.append((space, SimpleNamespace(scene=depsgraph.scene), limit))
    for _ in range(3):
        for context, of, limit in windows:
            of.scene.drgs.viewport_surfels = limit
            share = surfels._share(context, depsgraph)
            assert share == min(1.0, limit / whole)
            said = surfels.reduction(views.name_of(context.region))
            assert said == (f"{limit:,} of {whole:,} surfels" if share < 1 else "")
    assert len(tagged) == sum(limit < whole for limit in limits)
    surfels.forget()


def test_header_says_what_splats_leave_out(scene, ball, monkeypatch):
    surfels, header = part("addon.viewport.surfels"), part("addon.panels.header")
    space = SimpleNamespace(shading=SimpleNamespace(type="SOLID"))
    window = SimpleNamespace(type="WINDOW", as_pointer=lambda: 7)
    context = SimpleNamespace(scene=scene, space_data=space, area=SimpleNamespace(regions=[window]))
    monkeypatch.setitem(surfels._reductions, part("addon.viewport.views").name_of(window), "500 of 1,000 surfels")
    for overlay, said in (("OFF", ""), ("SURFELS", "500 of 1,000 surfels"), ("LIT", "")):
        scene.drgs.overlay = overlay
        assert header._reduction(context) == said
    space.shading.type = "RENDERED"
    scene.drgs.overlay = "SURFELS"
    assert header._reduction(context) == ""
