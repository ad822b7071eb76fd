"""Motion vectors of surfels that hang on no mesh, and light that follows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pictures import assert_same_bits

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import MotionStep, Particles, Pose, ProxyMesh
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.film.motion_vectors import project

PASSES = ("Combined", "Vector", "Previous Position", "Position", "Coverage")
LINEAR = 1.2 * trimesh.transformations.rotation_matrix(0.15, (1.0, 2.0, 3.0))[:3, :3]
SHIFT = np.array([0.05, 0.0, -0.1])


@pytest.fixture(scope="module")
def bare_path(tmp_path_factory, mesh):
    path = tmp_path_factory.mktemp("bare") / "bare.drgs"
    write_asset(path, Asset(attach(mesh, density=12.0)[0], Mesh.empty()))
    return path


@pytest.fixture
def frame(make_frame, session: Session, bare_path):
    frame = make_frame(camera_sees="surfels", samples=1)
    frame.settings.rays_see = "surfels"
    frame.objects[0].asset, frame.objects[0].vertices = session.load_asset(bare_path), None
    frame.passes = PASSES
    return frame


def moved(places):
    return places @ LINEAR.T + SHIFT


def matrix() -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = LINEAR, SHIFT
    return made


def proxy(move=lambda rest: rest) -> ProxyMesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.05)
    rest = np.ascontiguousarray(ball.vertices, np.float32)
    return ProxyMesh(rest, np.array(move(rest), np.float32), np.ascontiguousarray(ball.faces, np.int32))


def cloud(move=lambda rest: rest, gradient=None) -> Particles:
    axis = np.linspace(-1.2, 1.2, 9)
    rest = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3).astype(np.float32)
    gradients = np.broadcast_to(np.float32(np.eye(3) if gradient is None else gradient), (len(rest), 3, 3)).copy()
    return Particles(rest, np.array(move(rest), np.float32), gradients, all=True)


def bent(rest):
    angle = 0.4 * rest[:, 2:]
    x, y, z = rest.T
    return np.stack(
        [x * np.cos(angle.T[0]) - y * np.sin(angle.T[0]), x * np.sin(angle.T[0]) + y * np.cos(angle.T[0]), z], 1
    )


def surfels(session, frame):
    session.prepare(frame)
    return session._scene_cache.objects[0].posed


def seen(pictures):
    return pictures["Coverage"][..., 0] > 0


WAYS = {
    "matrix": (dict, lambda: {"matrices": matrix()[None]}),
    "proxy": (dict, lambda: {"proxy": proxy(moved)}),
    "proxy that is at rest then": (lambda: {"proxy": proxy(moved)}, lambda: {"proxy": proxy()}),
    "particles": (lambda: {"particles": cloud()}, lambda: {"particles": cloud(moved, LINEAR)}),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_point_moves_as_what_carries_its_surfels(session, frame, way):
    """Turned, scaled and moved, exactly; before and after, in Blender's signs."""
    now, then = (make() for make in WAYS[way])
    frame.objects[0] = replace(frame.objects[0], **now)
    step = MotionStep(frame.camera, [Pose("Ball", **{"matrices": np.eye(4)[None]} | then)])
    frame.previous = frame.next = step
    pictures = session.render(frame)
    position = pictures["Position"].astype(np.float64)
    there = moved(position) if way != "proxy that is at rest then" else (position - SHIFT) @ np.linalg.inv(LINEAR).T
    assert np.abs(pictures["Previous Position"] - there)[seen(pictures)].max() < 1e-4
    p = camera_parameters(frame.camera, frame.settings, 1)
    for y, x in np.argwhere(seen(pictures))[::20]:
        vector = np.subtract(project(p, *there[y, x])[:2], project(p, *position[y, x])[:2])
        assert pictures["Vector"][y, x] == pytest.approx([*vector * [1, -1], *vector * [-1, 1]], abs=5e-3)
    assert np.abs(pictures["Vector"]).max() > 1


def test_bending_is_followed_to_second_order(session, frame):
    frame.previous = MotionStep(frame.camera, [Pose("Ball", np.eye(4)[None], proxy=proxy(bent))])
    pictures = session.render(frame)
    shown = seen(pictures)
    away = np.linalg.norm(pictures["Previous Position"] - pictures["Position"], axis=-1)[shown]
    there = bent(pictures["Position"][shown].astype(np.float64))
    error = np.linalg.norm(pictures["Previous Position"][shown] - there, axis=-1)
    carried = bent(surfels(session, frame).centre.astype(np.float64))
    frame.objects[0] = replace(frame.objects[0], proxy=proxy(bent))
    own = np.linalg.norm(surfels(session, frame).centre - carried, axis=-1)  # of what carries the surfels
    assert error.mean() < 2 * own.mean() and error.mean() < 0.06 * away.mean()


@pytest.mark.parametrize("then", [
    {}, {"matrices": np.full((1, 4, 4), np.nan)}, {"matrices": np.eye(4)[None, :3]},
    {"particles": Particles(np.zeros((4, 3)), np.zeros((3, 3)), np.zeros((4, 3, 3)), True)},
])  # fmt: skip
def test_what_says_nothing_stands_still(session, frame, then):
    frame.previous = MotionStep(frame.camera, [Pose("Ball", **{"matrices": np.eye(4)[None]} | then)])
    pictures = session.render(frame)
    assert (pictures["Vector"] == 0).all() and (pictures["Previous Position"] == pictures["Position"]).all()


def test_particles_that_vanish_leave_the_rest(session, frame):
    """A tenth of them is not finite then; what the others carry still moves, and nothing is NaN."""
    broken = cloud(moved, LINEAR)
    broken.points[::10] = np.nan
    frame.objects[0] = replace(frame.objects[0], particles=cloud())
    frame.previous = MotionStep(frame.camera, [Pose("Ball", np.eye(4)[None], particles=broken)])
    pictures = session.render(frame)
    assert all(np.isfinite(pictures[name]).all() for name in PASSES)
    rows = (pictures["Vector"] != 0).any(-1) & seen(pictures)
    assert rows.any()
    there = moved(pictures["Position"][rows].astype(np.float64))
    away = np.abs(pictures["Previous Position"][rows] - there)
    assert np.median(away) < 1e-6 and away.max() < 0.02  # of pixels in which only a part is carried


def test_the_frame_is_the_same_afterwards(session, frame):
    """Looking at another time leaves no trace in what is drawn."""
    frame.objects[0] = replace(frame.objects[0], proxy=proxy(bent))
    before = session.render(frame)
    frame.previous = MotionStep(frame.camera, [Pose("Ball", matrix()[None], proxy=proxy(moved))])
    moving = session.render(frame)
    assert_same_bits({"Combined": before["Combined"]}, {"Combined": moving["Combined"]})
    frame.previous = None
    assert_same_bits(before, session.render(frame))


def test_light_follows_surfels_without_a_mesh(session, make_frame, frame):
    """In viewports: a drifting object is cleaner with what earlier pictures saw of it, and leaves no ghost."""
    noise = {"view": 0.0, "": 0.0}
    frame.passes = ("Combined",)
    for k in range(8):
        place = np.eye(4)
        place[0, 3], place[2, 3] = 0.15 * k - 0.2, 0.08 * k
        state = replace(frame.objects[0], matrix_world=place)
        clean = replace(frame, objects=[state], settings=replace(frame.settings, samples=256))
        truth = session.render(clean)["Combined"] if k >= 4 else None
        for history in noise:
            settings = replace(frame.settings, denoise="svgf")
            noisy = replace(frame, noise_index=k, history=history, objects=[state], settings=settings)
            picture = session.render(noisy)["Combined"]
            if truth is not None:
                noise[history] += float(np.sqrt(np.mean((picture - truth) ** 2)))
    assert noise["view"] < 0.83 * noise[""]
