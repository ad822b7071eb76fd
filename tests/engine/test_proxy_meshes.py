"""Surfels without a mesh that a proxy mesh bends, in the session."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pictures import assert_same_bits

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import ProxyMesh
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session

LINEAR = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.8]])
SHIFT = np.array([0.1, -0.2, 0.3])


@pytest.fixture(scope="module")
def bare_path(tmp_path_factory, mesh):
    """The ball's surfels without their mesh."""
    path = tmp_path_factory.mktemp("bare") / "bare.drgs"
    write_asset(path, Asset(attach(mesh, density=12.0)[0], Mesh.empty()))
    return path


@pytest.fixture
def frame(make_frame, session: Session, bare_path):
    frame = make_frame(camera_sees="surfels")
    frame.settings.rays_see = "surfels"
    frame.objects[0].asset, frame.objects[0].vertices = session.load_asset(bare_path), None
    return frame


def proxy_of(move=lambda rest: rest) -> ProxyMesh:
    """A ball of few faces around the object."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.05)
    rest = np.ascontiguousarray(ball.vertices, np.float32)
    return ProxyMesh(rest, np.array(move(rest), np.float32), np.ascontiguousarray(ball.faces, np.int32))


def bent(rest: np.ndarray) -> np.ndarray:
    """Turned about z by what is above."""
    angle = 0.5 * rest[:, 2]
    x = np.cos(angle) * rest[:, 0] - np.sin(angle) * rest[:, 1]
    y = np.sin(angle) * rest[:, 0] + np.cos(angle) * rest[:, 1]
    return np.stack([x, y, rest[:, 2]], axis=1)


def posed(session: Session, frame, **changes):
    given = replace(frame, objects=[replace(frame.objects[0], **changes)])
    session.prepare(given)
    return session._scene_cache.pose(given)


def test_an_affine_proxy_does_that_to_the_surfels(session, frame):
    """Also across its surface, and without any matrix of the object."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = LINEAR, SHIFT
    want = posed(session, frame, matrix_world=matrix)
    found = posed(session, frame, proxy=proxy_of(lambda rest: rest @ LINEAR.T + SHIFT))
    for name in ("centre", "tangent_u", "tangent_v"):
        assert np.abs(getattr(found, name) - getattr(want, name)).max() < 1e-5, name
    assert np.einsum("nc,nc->n", found.normal, want.normal).min() > 0.99999


@pytest.mark.parametrize("faces", [slice(None), slice(0, 8)])
def test_a_proxy_of_few_corners_does_the_same(session, frame, faces):
    """A box, whole and with open sides: its faces move what is inside, not its eight corners alone."""
    box = trimesh.creation.box((2.4, 2.4, 2.4))
    rest = np.ascontiguousarray(box.vertices, np.float32)
    proxy = ProxyMesh(
        rest, np.array(rest @ LINEAR.T + SHIFT, np.float32), np.ascontiguousarray(box.faces[faces], np.int32)
    )
    before = posed(session, frame).centre.copy()
    assert np.abs(posed(session, frame, proxy=proxy).centre - (before @ LINEAR.T + SHIFT)).max() < 1e-4


def test_a_twisted_proxy_twists_what_is_inside(session, frame):
    rest = posed(session, frame).centre.copy()
    found = posed(session, frame, proxy=proxy_of(bent)).centre
    away = np.abs(found - bent(rest)).max(axis=1)
    assert away.max() < 0.02 and away.mean() < 0.006
    assert np.abs(bent(rest) - rest).max() > 0.25


def test_a_sheet_turns_what_lies_beside_it(session, frame):
    """All points of a cloth lie in a plane: only its normals say how space beside it turns."""
    axis = np.linspace(-1.1, 1.1, 12)
    rest = np.stack([*np.meshgrid(axis, axis), np.zeros((12, 12))], -1).reshape(-1, 3).astype(np.float32)
    first = (12 * np.arange(11)[:, None] + np.arange(11)).reshape(-1, 1)
    faces = np.concatenate([first + np.array((0, 1, 13)), first + np.array((0, 13, 12))]).astype(np.int32)
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    before = posed(session, frame).centre.copy()
    found = posed(session, frame, proxy=ProxyMesh(rest, np.array(rest @ turn.T, np.float32), faces)).centre
    assert np.abs(found - before @ turn.T).max() < 1e-3


def test_points_without_faces_carry_as_well(session, frame):
    proxy = proxy_of(lambda rest: rest @ LINEAR.T + SHIFT)
    proxy.faces = proxy.faces[:0]
    before = posed(session, frame).centre.copy()
    assert np.abs(posed(session, frame, proxy=proxy).centre - (before @ LINEAR.T + SHIFT)).max() < 1e-4


def test_two_leaves_near_each_other_move_apart(session, frame, tmp_path):
    """What hangs on one part of a proxy does not follow the other, a few cells away."""
    from drgs_blender.core.asset.container import read_asset

    leaf = trimesh.creation.box((2.0, 0.5, 0.02)).subdivide().subdivide().subdivide()
    rest = np.concatenate([leaf.vertices, leaf.vertices + np.array((0, 0, 0.3))]).astype(np.float32)
    faces = np.concatenate([leaf.faces, leaf.faces + len(leaf.vertices)]).astype(np.int32)
    upper = np.arange(len(rest)) >= len(leaf.vertices)
    asset = read_asset(Path(frame.objects[0].asset))
    count = len(asset.surfels)
    centre = np.random.default_rng(0).uniform((-0.9, -0.2, 0), (0.9, 0.2, 0), (count, 3)).astype(np.float32)
    above = np.arange(count) % 2 == 1
    centre[above, 2] = 0.3
    path = tmp_path / "leaves.drgs"
    write_asset(path, Asset(replace(asset.surfels, centre=centre), Mesh.empty()))
    frame.objects[0].asset = session.load_asset(path)
    now = np.where(upper[:, None], rest + np.array((0, 0, 0.5)), rest).astype(np.float32)
    found = posed(session, frame, proxy=ProxyMesh(rest, now, faces)).centre
    assert np.abs(found[~above] - centre[~above]).max() < 1e-4
    assert np.abs(found[above] - centre[above] - (0, 0, 0.5)).max() < 1e-4


def test_a_proxy_at_rest_changes_nothing(session, frame):
    want = posed(session, frame)
    found = posed(session, frame, proxy=proxy_of())
    for name in ("centre", "tangent_u", "tangent_v", "normal"):
        assert np.abs(getattr(found, name) - getattr(want, name)).max() < 1e-5, name


def test_a_frame_drawn_again_is_the_same(session, frame):
    frame.objects[0].proxy = proxy_of(bent)
    first = session.render(frame)
    item = session._scene_cache.objects[0]
    assert_same_bits(session.render(replace(frame, objects=[replace(frame.objects[0], proxy=proxy_of(bent))])), first)
    assert session._scene_cache.objects[0] is item, "an equal proxy poses again"


def test_a_vertex_that_is_not_finite_hides_what_it_carries_and_is_told(session, frame):
    proxy = proxy_of()
    proxy.vertices[0] = np.nan
    frame.objects[0].proxy = proxy
    result = session.render(frame)
    assert any("surfels are left out" in warning for warning in result.warnings)
    shown = session._scene_cache.objects[0].posed.opacity > 0
    assert 0.5 < shown.mean() < 1


def broken(what: str) -> ProxyMesh:
    proxy = proxy_of()
    if what == "other vertices":
        proxy.vertices = proxy.vertices[:-1]
    elif what == "not finite at rest":
        proxy.rest[3] = np.inf
    elif what == "faces of nothing":
        proxy.faces = proxy.faces + len(proxy.rest)
    elif what == "no vertices":
        proxy = ProxyMesh(proxy.rest[:0], proxy.vertices[:0], proxy.faces[:0])
    return proxy


@pytest.mark.parametrize("what", ["other vertices", "not finite at rest", "faces of nothing", "no vertices"])
def test_what_is_no_proxy_is_refused_by_name(session, frame, what):
    frame.objects[0].proxy = broken(what)
    with pytest.raises(AssetError, match=frame.objects[0].name):
        session.render(frame)


def test_another_proxy_of_as_many_vertices_is_not_taken_for_the_last_one(session, frame):
    """A proxy made anew: where its vertices are at rest counts."""
    posed(session, frame, proxy=proxy_of(bent))
    other = proxy_of(lambda rest: 1.1 * rest + (0, 0, 0.5))
    other.rest = np.ascontiguousarray(np.float32(1.1) * other.rest)
    before = posed(session, frame).centre.copy()
    posed(session, frame, proxy=proxy_of(bent))
    assert np.abs(posed(session, frame, proxy=other).centre - before - (0, 0, 0.5)).max() < 1e-4


def test_a_proxy_is_fitted_once_for_all_frames_and_objects(session, frame):
    """Two objects that move apart share it; without them it is forgotten."""
    proxies = session._scene_cache._proxies
    posed(session, frame, proxy=proxy_of())
    (known,) = proxies._known
    first = replace(frame.objects[0], proxy=proxy_of(bent))
    both = replace(frame, objects=[first, replace(first, name="other", proxy=proxy_of(lambda rest: rest + 1))])
    session.prepare(both)
    assert [each.fit is known.fit for each in proxies._known] == [True]
    posed(session, frame)
    assert not proxies._known
