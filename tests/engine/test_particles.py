"""Surfels that particles carry, in the session: exact, with or without a mesh, and told where they cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pictures import assert_same_bits, fresh

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.core.frame import Particles
from drgs_blender.deform.attach import attach
from drgs_blender.engine import carrier_cache
from drgs_blender.engine.session import Session

#: What all particles do: turned, stretched, sheared and moved.
LINEAR = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.8]])
SHIFT = np.array([0.1, -0.2, 0.3])


def grid(count: int = 13) -> np.ndarray:
    """Particles through the ball and around it."""
    axis = np.linspace(-1.3, 1.3, count)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def moved(rest: np.ndarray, whole: bool = True) -> Particles:
    points = (rest @ LINEAR.T + SHIFT).astype(np.float32)
    return Particles(rest, points, np.tile(LINEAR.astype(np.float32), (len(rest), 1, 1)), whole)


def matrix() -> np.ndarray:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = LINEAR, SHIFT
    return found


def posed(session: Session, frame) -> object:
    session.prepare(frame)
    return session._scene_cache.pose(frame)


@pytest.fixture
def frame(make_frame):
    return make_frame(camera_sees="surfels")


@pytest.fixture(scope="module")
def bare_path(tmp_path_factory, mesh):
    """The ball's surfels without their mesh."""
    path = tmp_path_factory.mktemp("bare") / "bare.drgs"
    write_asset(path, Asset(attach(mesh, density=12.0)[0], Mesh.empty()))
    return path


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("bare", [False, True])
def test_affine_motion_of_particles_is_that_of_the_object(session, frame, bare_path, bare, mirrored):
    """Surfels carried by particles stand as those of an object with that matrix, also inside a mirrored object."""
    state = frame.objects[0]
    if bare:
        state.asset, state.vertices = session.load_asset(bare_path), None
        frame.settings.rays_see = "surfels"
    outer = np.diag([1.0, -1.0, 1.0, 1.0]) if mirrored else np.eye(4)
    by_matrix = replace(frame, objects=[replace(state, matrix_world=outer @ matrix())])
    by_particles = replace(frame, objects=[replace(state, matrix_world=outer, particles=moved(grid()))])
    want = posed(session, by_matrix)
    found = posed(session, by_particles)
    for name in ("centre", "tangent_u", "tangent_v"):
        assert np.abs(getattr(found, name) - getattr(want, name)).max() < 2e-6, name
    assert np.abs(found.opacity - want.opacity).max() == 0
    # A smooth normal of stretched faces is not quite the image of the one at rest.
    assert np.einsum("nc,nc->n", found.normal, want.normal).min() > (0.9999 if bare else 0.98)


def test_only_what_is_off_the_mesh_follows_particles_by_default(session, frame):
    """With a mesh at rest and particles that move, what lies on the mesh stays."""
    state = frame.objects[0]
    fine = grid(9)
    at_rest = posed(session, frame).centre.copy()
    some = posed(session, replace(frame, objects=[replace(state, particles=moved(fine, False))])).centre
    every = posed(session, replace(frame, objects=[replace(state, particles=moved(fine))])).centre
    stays = np.abs(some - at_rest).max(axis=1) == 0
    assert stays.all() and (np.abs(every - at_rest).max(axis=1) > 0.01).mean() > 0.9
    coarse = posed(session, replace(frame, objects=[replace(state, particles=moved(grid(33), False))])).centre
    assert np.abs(coarse - at_rest).max() > 0.1, "faces coarser than the particles do not lead"


def test_history_does_not_show(session, frame, asset_path):
    state = frame.objects[0]
    rest = grid()
    still = replace(frame, objects=[replace(state, particles=Particles(rest, rest, moved(rest).gradients))])
    for given in (replace(frame, objects=[replace(state, particles=moved(rest))]), still, frame, still):
        assert_same_bits(session.render(given), fresh(asset_path, given))


def test_fewer_surfels_follow_as_all_do(session, frame):
    frame.objects[0].particles = moved(grid())
    session.prepare(frame)
    cache = session._scene_cache
    cache.pose(frame)
    loaded, state = cache.objects[0].loaded, cache.objects[0].state
    bound = cache._carriers.carrier(loaded, state).weights.source
    for count in (len(bound) // 2, len(bound) // 5):
        carrier = cache._carriers.carrier(loaded.first(count), state)
        np.testing.assert_array_equal(carrier.weights.source, bound[loaded.detail.order[:count]])


def test_objects_share_what_is_bound_and_nothing_stays(session, frame, monkeypatch):
    """A dozen copies of a simulated object are bound once, whatever arrays say it; what no object has is forgotten."""
    made = []
    bind = carrier_cache.ParticleDriven
    monkeypatch.setattr(carrier_cache, "ParticleDriven", lambda *given: made.append(1) or bind(*given))
    copies = [replace(frame.objects[0], name=f"Ball {i}", particles=moved(grid())) for i in range(12)]
    session.render(replace(frame, objects=copies))
    session.render(replace(frame, objects=[replace(copy, particles=moved(grid())) for copy in copies]))
    assert len(made) == 1 and len(session._scene_cache._carriers._known) == 1
    session.render(frame)
    assert not session._scene_cache._carriers._known


def test_particles_that_vanish_hide_their_surfels_and_are_told(session, frame):
    particles = moved(grid())
    particles.points[particles.rest[:, 0] > 0.5] = np.nan
    frame.objects[0].particles = particles
    frame.passes = ("Combined", "Coverage")
    picture = session.render(frame)
    assert all(np.isfinite(array).all() for name, array in picture.items())
    told = [warning for warning in picture.warnings if "particles" in warning]
    assert len(told) == 1 and "surfels are left out" in told[0] and "Ball" in told[0]
    whole = session.render(replace(frame, objects=[replace(frame.objects[0], particles=moved(grid()))]))
    assert not [warning for warning in whole.warnings if "particles" in warning]
    assert picture["Coverage"].sum() < 0.9 * whole["Coverage"].sum()


def test_particles_that_do_not_fit_are_refused(session, frame):
    rest = grid()
    fewer = moved(rest)
    fewer.points = fewer.points[:-1]
    frame.objects[0].particles = fewer
    with pytest.raises(AssetError, match=r"object Ball.*were 2197 at rest.*Bake"):
        session.render(frame)
    none = np.empty((0, 3), np.float32)
    frame.objects[0].particles = Particles(none, none, np.empty((0, 3, 3), np.float32))
    with pytest.raises(UsageError, match="object Ball"):
        session.render(frame)
    frame.objects[0].particles = None
    session.render(frame)
