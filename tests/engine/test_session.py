"""The session: what it keeps never shows in a picture."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from drgs_blender.asset.container import read_asset, write_asset
from drgs_blender.asset.model import Asset, Mesh, Surfels
from drgs_blender.engine.objects import traced_object
from drgs_blender.engine.session import Session
from drgs_blender.errors import AssetError, Cancelled, UsageError
from drgs_blender.frame import ObjectState, World


@pytest.fixture
def session(asset_path):
    made = Session()
    made.load_asset(asset_path)
    return made


def fresh(asset_path, frame):
    """The frame in a session that has seen nothing else."""
    made = Session()
    made.load_asset(asset_path)
    return made.render(frame)


def assert_same_bits(a, b):
    assert {name: array.tobytes() for name, array in a.items()} == {name: array.tobytes() for name, array in b.items()}


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_history_does_not_show(session, make_frame, asset_path):
    """After every kind of change a frame has the bits it has in a fresh session."""
    frames = [make_frame(bend) for bend in (0.0, 0.3, 0.3)]
    frames[1].world.rotation = turned(40)
    frames[2].world.strength = 3.0
    two = make_frame(0.1)
    second = ObjectState("Second", two.objects[0].asset)
    second.matrix_world[:3, 3] = 1.5, 1.0, 0.0
    two.objects.append(second)
    swapped = make_frame(0.1)
    swapped.objects = [second, two.objects[0]]
    mesh = make_frame(0.2, primary="mesh")
    constant = make_frame(0.2)
    constant.world = World(colour=(0.2, 0.4, 0.8))
    painted = make_frame()
    painted.objects[0].albedo = np.full_like(painted.objects[0].vertices, 0.9)
    twins = make_frame(0.1)
    twins.objects = [two.objects[0], ObjectState("Ball", second.asset, second.matrix_world)]
    for frame in (*frames, two, swapped, twins, mesh, constant, painted, frames[0]):
        assert_same_bits(session.render(frame), fresh(asset_path, frame))


def test_array_changed_in_place_is_noticed(session, make_frame, asset_path):
    frame = make_frame()
    before = session.render(frame)["Combined"].copy()
    frame.world.environment[:8] *= 2
    brighter = session.render(frame)
    assert brighter["Combined"][..., :3].sum() > before[..., :3].sum()
    assert_same_bits(brighter, fresh(asset_path, frame))


def test_nothing_is_made_again_when_nothing_changed(session, make_frame):
    session.render(make_frame(0.1))
    light, objects = session._light, list(session._objects)
    frame = make_frame(0.1)
    frame.camera.matrix_world[0, 3] = 0.4
    session.render(frame)
    assert session._light is light
    assert session._objects == objects and session._objects[0] is objects[0]
    frame.world.rotation = turned(10)
    session.render(frame)
    assert session._light is light


def test_vanished_objects_are_dropped(session, make_frame):
    frame = make_frame()
    session.render(frame)
    frame.objects = []
    empty = session.render(frame)
    assert session._objects == []
    assert empty.statistics["triangles"] == 0
    np.testing.assert_allclose(empty["Depth"], 1e10)


def test_rewritten_asset_is_loaded_again(tmp_path, session, make_frame, asset_path):
    path = tmp_path / "copy.drgs"
    shutil.copy(asset_path, path)
    key = session.load_asset(path)
    frame = make_frame()
    frame.objects[0].asset = key
    before = session.render(frame)["Combined"]
    kept = session.asset(key)
    assert session.load_asset(path) == key
    assert session.asset(key) is kept
    asset = read_asset(path)
    surfels = asset.surfels
    surfels.albedo = 1 - surfels.albedo
    write_asset(path, Asset(surfels, asset.mesh, asset.binding))
    assert session.load_asset(path) == key
    assert not np.array_equal(session.render(frame)["Combined"], before)


def test_mirrored_object_is_lit_from_outside(session, make_frame, mesh):
    """A mirrored copy of a symmetric mesh keeps its faces and corner normals outward."""
    asset = session.asset(make_frame().objects[0].asset)
    state = ObjectState("Ball", "k", np.diag([-2.0, 1.0, 1.0, 1.0]))
    corners = mesh.vertices[mesh.faces]
    state.corner_normals = (corners / np.linalg.norm(corners, axis=2, keepdims=True)).astype(np.float32)
    traced = traced_object(state, asset)
    a, b, c = (traced.vertices[traced.faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", face_normals, a + b + c) > 0).all()
    assert traced.corner_normals is not None
    assert (np.einsum("ij,ikj->ik", face_normals, traced.corner_normals) > 0).mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(traced.corner_normals, axis=2), 1, atol=1e-5)


def test_unfit_objects_are_named_with_both_counts(session, make_frame):
    def refused(error, *words, **change):
        frame = make_frame()
        for name, value in change.items():
            setattr(frame.objects[0], name, value)
        with pytest.raises(error) as caught:
            session.render(frame)
        text = str(caught.value)
        assert all(word in text for word in ("Ball", *words)), text
        assert caught.value.remedy

    count = len(make_frame().objects[0].vertices)
    refused(AssetError, "7", str(count), vertices=np.zeros((7, 3), np.float32))
    refused(AssetError, "albedo", str(count), albedo=np.zeros((3, 3), np.float32))
    refused(AssetError, "corner normals", corner_normals=np.zeros((2, 3, 3), np.float32))
    refused(AssetError, "not loaded", asset="/nowhere.drgs")
    refused(UsageError, "matrix", matrix_world=np.full((4, 4), np.nan))


def test_unusable_settings_are_refused(session, make_frame):
    for name, value in (("cosine", -1), ("bounces", -2)):
        frame = make_frame()
        setattr(frame.settings, name, value)
        with pytest.raises(UsageError, match="negative"):
            session.render(frame)
    frame = make_frame()
    frame.passes = ("Combined", "Nonsense")
    with pytest.raises(UsageError, match="Nonsense"):
        session.render(frame)


def test_vertices_of_a_huge_object_are_not_called_infinite_alone(session, make_frame, caplog):
    frame = make_frame(primary="mesh")
    frame.objects[0].matrix_world[:3, :3] *= 1e20
    (text,) = session.render(frame).warnings
    assert text.startswith("Ball: ") and "not finite or too far away" in text
    frame = make_frame()
    frame.objects[0].vertices[1] = np.nan
    session.render(frame)
    assert not [r for r in caplog.records if r.levelname == "WARNING"], "the user reads the frame's warnings"


@pytest.mark.parametrize(("part", "problem"), [("surfels", "has no surfels"), ("faces", "has no faces")])
def test_asset_of_which_nothing_would_be_seen_is_refused(tmp_path, session, make_frame, asset_path, part, problem):
    asset = read_asset(asset_path)
    flat, wide = np.empty(0, np.float32), np.empty((0, 3), np.float32)
    mesh, none = asset.mesh, Surfels(wide, wide[:, :2], np.empty((0, 4), np.float32), flat, wide, flat, flat)
    if part == "faces":
        mesh = Mesh(mesh.vertices, mesh.faces[:0], mesh.albedo, mesh.roughness, mesh.metallic)
    path = tmp_path / "empty.drgs"
    write_asset(path, Asset(none, mesh))
    frame = make_frame()
    frame.objects[0].asset = session.load_asset(path)
    with pytest.raises(AssetError, match=f"Ball.*{problem}"):
        session.render(frame)
    frame.settings.primary = "mesh"
    if part == "surfels":
        assert session.render(frame)["Combined"][..., 3].max() > 0.9
    else:
        with pytest.raises(AssetError, match=f"Ball.*{problem}"):
            session.render(frame)


def test_frame_without_an_object_says_so(session, make_frame):
    frame = make_frame()
    frame.objects = []
    assert [text for text in session.render(frame).warnings if "no DR-GS object" in text]


def test_bad_vertices_are_counted_and_leave_no_bad_pixel(session, make_frame):
    frame = make_frame()
    frame.objects[0].vertices[[1, 5]] = np.nan, np.inf, 0.0
    passes = session.render(frame)
    (text,) = passes.warnings
    assert text.startswith("Ball: 2 vertices are not finite or too far away; ") and "surfels are left out" in text
    assert all(np.isfinite(array).all() for array in passes.values())
    assert session.render(make_frame()).warnings == []


def test_unbound_surfels_need_binding_or_the_mesh(tmp_path, session, make_frame, asset_path):
    asset = read_asset(asset_path)
    path = tmp_path / "unbound.drgs"
    write_asset(path, Asset(asset.surfels, asset.mesh))
    frame = make_frame()
    frame.objects[0].asset = session.load_asset(path)
    with pytest.raises(AssetError, match=r"Ball.*not bound"):
        session.render(frame)
    frame.settings.primary = "mesh"
    assert session.render(frame)["Combined"][..., 3].max() > 0.9


def test_cancelled_between_stages(session, make_frame):
    with pytest.raises(Cancelled):
        session.render(make_frame(), cancelled=lambda: True)


def test_statistics_and_stages(session, make_frame):
    passes = session.render(make_frame(primary="surfels"))
    stages = ("seconds.deform", "seconds.light", "seconds.render", "seconds.total")
    assert all(passes.statistics[name] >= 0 for name in stages)
    assert passes.statistics["surfels"] == len(session.asset(make_frame().objects[0].asset).surfels)
    assert passes.statistics["samples"] == 48 * 36 * 6
