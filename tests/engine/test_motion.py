"""Motion of a frame's shapes and camera as passes, and light that follows them from picture to picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pictures import assert_same_bits, fresh, with_meshes
from scipy.spatial.transform import Rotation

from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.core.frame import MotionStep, Pose, World
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.denoise import svgf_temporal
from drgs_blender.render.denoise.kept_light import SETTLED
from drgs_blender.render.film.motion_vectors import project
from drgs_blender.render.pipeline import Batches

PASSES = ("Combined", "Vector", "Previous Position", "Position", "Coverage", "IndexOB", "Depth")


def rigid(seed: int, turn: float = 0.1, shift: float = 0.05) -> np.ndarray:
    """(4, 4) of a small motion."""
    rng = np.random.default_rng(seed)
    x, y, z = rng.normal(size=3) * turn
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(np.eye(3) + skew)[0]
    matrix[:3, :3] *= np.sign(np.diag(matrix[:3, :3]))
    matrix[:3, 3] = rng.normal(size=3) * shift
    return matrix


def moving_frame(make_frame, **settings):
    """The ball, a floor and two squares; what each of them and the camera was before and will be after, and
    the maps of the world, by pass index."""
    frame = with_meshes(make_frame(0.1, **settings))
    frame.passes = PASSES
    frame.objects[0].matrix_world = rigid(1)
    frame.objects[0].pass_index = 1
    upright = np.array([[1.0, 0, 0, 0], [0, 0, -1, -1.5], [0, 1, 0, 0], [0, 0, 0, 1]])  # and before the ball
    frame.meshes[1].matrices = upright @ frame.meshes[1].matrices
    maps, moments = [], []
    for base in (10, 20):
        ball, floor, left, right, camera = (rigid(base + k) for k in range(5))
        moved = replace(frame.camera, matrix_world=camera @ frame.camera.matrix_world)
        poses = [Pose("Ball", (ball @ frame.objects[0].matrix_world)[None])]
        squares = np.stack([left, right]) @ frame.meshes[1].matrices
        meshes = [Pose("Floor", floor @ frame.meshes[0].matrices), Pose("Squares", squares)]
        moments.append(MotionStep(moved, poses, meshes))
        maps.append({1: ball, 5: floor, 6: left, 7: right})
    frame.previous, frame.next = moments
    return frame, maps


def expected(pictures, maps, camera, settings):
    """(h, w, 3) positions and (h, w, 2) pixel places after `maps`, seen by `camera`."""
    h, w = pictures["Coverage"].shape[:2]
    position, place = pictures["Position"].astype(np.float64), np.zeros((h, w, 2))
    parameters = camera_parameters(camera, settings, 1)
    there = position.copy()
    for y, x in np.ndindex(h, w):
        matrix = maps.get(int(pictures["IndexOB"][y, x, 0]), np.eye(4))
        there[y, x] = matrix[:3, :3] @ position[y, x] + matrix[:3, 3]
        place[y, x] = project(parameters, *there[y, x])[:2]
    return there, place


def of_one_surface(pictures):
    """(h, w) bool: covered pixels whose neighbours show the same object; others may be the mean of two."""
    index = np.where(pictures["Coverage"][..., 0] > 0, pictures["IndexOB"][..., 0], -1)
    padded = np.pad(index, 1, mode="edge")
    h, w = index.shape
    alike = [padded[y : y + h, x : x + w] == index for y in range(3) for x in range(3)]
    return (index >= 0) & np.all(alike, axis=0)


@pytest.mark.parametrize("camera_sees", ["surfels", "mesh"])
def test_everything_moves_as_its_shape_and_the_camera(session, make_frame, camera_sees):
    """DR-GS objects, meshes and instances; Blender's signs: previous less present, present less next, y up."""
    frame, maps = moving_frame(make_frame, camera_sees=camera_sees)
    pictures = session.render(frame)
    seen = of_one_surface(pictures)
    assert set(np.unique(pictures["IndexOB"][seen])) == {1, 5, 6, 7}
    unmoved = {index: np.eye(4) for index in maps[0]}
    _, here = expected(pictures, unmoved, frame.camera, frame.settings)
    there, before = expected(pictures, maps[0], frame.previous.camera, frame.settings)
    _, after = expected(pictures, maps[1], frame.next.camera, frame.settings)
    assert np.abs(pictures["Previous Position"] - there)[seen].max() < 2e-5
    vector = pictures["Vector"]
    up = [1, -1]
    assert np.abs(vector[..., :2] - up * (before - here))[seen].max() < 2e-3
    assert np.abs(vector[..., 2:] - up * (here - after))[seen].max() < 2e-3
    assert np.abs(vector[seen]).min(axis=1).max() > 0.5 and (vector[pictures["Coverage"][..., 0] == 0] == 0).all()


def test_vertices_of_another_time_carry_the_surface(session, make_frame):
    """An affine map of the vertices, of the object and of a mesh that stands in several places."""
    frame, _ = moving_frame(make_frame, camera_sees="mesh")
    shear = np.float32([[1.0, 0.1, 0], [0, 0.9, 0.05], [0.08, 0, 1.1]])
    for state, pose in ((frame.objects[0], frame.previous.objects[0]), (frame.meshes[1], frame.previous.meshes[1])):
        pose.vertices = state.vertices @ shear.T
        pose.matrices = np.array(np.atleast_3d(state.matrix_world)[..., 0] if pose.name == "Ball" else state.matrices)
        pose.matrices = pose.matrices.reshape(-1, 4, 4)
    frame.previous.meshes[0] = None
    linear = np.eye(4)
    linear[:3, :3] = shear
    maps = {
        index: matrix @ linear @ np.linalg.inv(matrix)
        for index, matrix in zip((1, 6, 7), (frame.objects[0].matrix_world, *frame.meshes[1].matrices))
    }
    pictures = session.render(frame)
    seen = of_one_surface(pictures)
    there, _ = expected(pictures, maps, frame.previous.camera, frame.settings)
    assert np.abs(pictures["Previous Position"] - there)[seen].max() < 2e-5
    assert np.abs(there - pictures["Position"])[seen].max() > 0.05


def test_nothing_moves_where_nothing_is_said(session, make_frame, asset_path):
    """Zero to the last bit without moments, with moments that equal the frame, and for unusable poses."""
    frame = with_meshes(make_frame(0.1))
    frame.passes = PASSES
    pictures = session.render(frame)
    assert (pictures["Vector"] == 0).all() and (pictures["Previous Position"] == pictures["Position"]).all()
    state = frame.objects[0]
    bad = state.vertices.copy()
    bad[3:9] = np.nan
    for vertices, matrices in (
        (state.vertices, state.matrix_world),
        (bad[:7], np.eye(4)),
        (None, np.full((4, 4), np.nan)),
    ):
        same = [Pose(m.name, m.matrices.copy(), m.vertices.copy()) for m in frame.meshes]
        frame.previous = frame.next = MotionStep(frame.camera, [Pose("Ball", matrices[None], vertices)], same)
        again = session.render(frame)
        assert (again["Vector"] == 0).all() and (again["Previous Position"] == again["Position"]).all()
        assert_same_bits(again, fresh(asset_path, frame))
    frame.previous.objects[0] = Pose("Ball", np.eye(4)[None], bad)
    assert np.isfinite(session.render(frame)["Vector"]).all()
    frame.previous.meshes.pop()
    with pytest.raises(UsageError, match="motion of meshes"):
        session.render(frame)


def test_what_was_behind_the_camera_has_no_vector(session, make_frame):
    frame = make_frame(size=(16, 12))
    frame.passes = PASSES
    away = frame.camera.matrix_world.copy()
    away[1, 3] = 40.0  # looks along +Y from beyond the ball
    frame.previous = MotionStep(replace(frame.camera, matrix_world=away), [None])
    pictures = session.render(frame)
    assert (pictures["Vector"] == 0).all() and (pictures["Coverage"] > 0).any()


# --- history --------------------------------------------------------------------------------------------------------


def noise(pictures, truth):
    return float(np.sqrt(np.mean((pictures["Combined"][..., :3] - truth["Combined"][..., :3]) ** 2)))


def still_frame(make_frame, number, history="view", **settings):
    frame = make_frame(0.1, samples=1, denoise="svgf", film_transparent=True, **settings)
    frame.passes, frame.noise_index, frame.history = ("Combined",), number, history
    return frame


@pytest.fixture(scope="module")
def truth(make_frame, asset_path):
    return fresh(asset_path, make_frame(0.1, samples=256))


def test_a_picture_that_stands_still_gets_cleaner(session, make_frame, asset_path, truth):
    pictures = [session.render(still_frame(make_frame, k)) for k in range(16)]
    assert [p.statistics["history"] for p in pictures] == list(range(16))
    alone = np.mean([noise(fresh(asset_path, still_frame(make_frame, k, "")), truth) for k in range(4)])
    assert noise(pictures[-1], truth) < 0.6 * alone
    assert_same_bits(pictures[0], fresh(asset_path, still_frame(make_frame, 0, "")))


def test_light_follows_what_moves(session, make_frame, asset_path):
    """The ball bends and the camera drifts: pictures are better than alone, and no ghost is left."""
    results = {"view": 0.0, "": 0.0}
    for k in range(8):
        for history in results:
            frame = still_frame(make_frame, k, history)
            frame.objects[0].vertices[:, 0] += np.float32(0.01 * k)
            frame.camera.matrix_world[0, 3] = 0.02 * k
            picture = session.render(frame)
            if k >= 4:
                clean = replace(frame, settings=make_frame(samples=128).settings, history="")
                results[history] += noise(picture, session.render(clean))
    assert results["view"] < 0.9 * results[""]


def test_the_denoiser_knows_by_how_much_the_world_turned(session, make_frame, monkeypatch):
    told, real = [], svgf_temporal.mixture_rules

    def rules(still, world_turn):
        told.append((still, world_turn))
        return real(still, world_turn)

    monkeypatch.setattr(svgf_temporal, "mixture_rules", rules)
    for k, degrees in enumerate((10, 10, 25, 22)):
        frame = still_frame(make_frame, k)
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        frame.world = World(frame.world.environment, turn, strength=frame.world.strength)
        session.render(frame)
    (first, no_turn), (second, further), (third, back) = told
    assert (first, second, third) == (True, False, False)
    np.testing.assert_allclose([no_turn, further, back], np.radians([0, 15, 3]), atol=1e-6)


def test_histories_are_told_apart_and_end_where_they_do_not_fit(session, make_frame, asset_path):
    for k in range(3):
        session.render(still_frame(make_frame, k))

    def count(**changes):
        frame = still_frame(make_frame, 9)
        for name, value in changes.items():
            setattr(frame, name, value)
        return session.render(frame).statistics.get("history")

    assert count(history="other") == 0
    assert count() == 3
    assert count(history="") is None
    smaller = replace(still_frame(make_frame, 9).camera, width=40)
    assert count(camera=smaller) == 0
    assert count() == 0
    assert count(passes=("Combined", "DiffDir")) == 0
    assert count() == 0 and count() == 1
    for region in ((4, 4, 24, 24), (8, 6, 28, 26)):  # of one size
        assert count(camera=replace(still_frame(make_frame, 9).camera, region=region)) == 0
    assert count() == 0
    assert count(settings=replace(still_frame(make_frame, 9).settings, camera_sees="mesh")) == 0
    for name in "abcd":
        count(history=name)
    assert count() == 0  # only the last few names are kept
    frame = with_meshes(still_frame(make_frame, 9))
    assert session.render(frame).statistics["history"] == 0
    assert_same_bits(session.render(still_frame(make_frame, 4, "")), fresh(asset_path, still_frame(make_frame, 4, "")))


def test_a_cancelled_picture_leaves_the_history_as_it_was(session, make_frame):
    session.render(still_frame(make_frame, 0))
    calls = iter(range(10**6))
    with pytest.raises(Cancelled):
        session.render(still_frame(make_frame, 1, size=(96, 72)), cancelled=lambda: next(calls) > 12)
    again = session.render(still_frame(make_frame, 1))
    assert again.statistics["history"] == 1


# --- light that is kept while the view turns ------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """How many points each picture traced."""
    counts = []
    real = Batches.trace

    def trace(self, points, part):
        counts.append(len(points))
        return real(self, points, part)

    monkeypatch.setattr(Batches, "trace", trace)
    return counts


def turned_frame(make_frame, number):
    """The view gone on by some pixels with every picture; one sample a pixel."""
    frame = still_frame(make_frame, number, subpixel_samples=1)
    frame.camera.matrix_world[0, 3] = 0.02 * number
    return frame


def test_a_view_that_turns_traces_half_and_stays_as_good(session, make_frame, counted):
    error = {"view": 0.0, "": 0.0}
    for number in range(8):
        frame = turned_frame(make_frame, number)
        counted.clear()
        picture = session.render(frame)
        traced, every = sum(counted), np.count_nonzero(picture["Combined"][..., 3])
        assert traced > 0.9 * every if number <= SETTLED else 0.4 * every < traced < 0.7 * every
        assert np.isfinite(picture["Combined"]).all()
        if number >= 4:
            clean = session.render(replace(frame, settings=make_frame(samples=128).settings, history=""))
            error["view"] += noise(picture, clean)
            error[""] += noise(session.render(replace(frame, history="")), clean)
    assert error["view"] < 0.9 * error[""]


def test_nothing_is_kept_where_more_than_the_camera_changes(session, make_frame, counted):
    """An object that moves, a light, and a picture with passes that kept light cannot make."""

    def part(number, change):
        frame = turned_frame(make_frame, number)
        change(frame)
        counted.clear()
        picture = session.render(frame)
        return sum(counted) / np.count_nonzero(picture["Combined"][..., 3])

    def move(frame):
        frame.objects[0].vertices[:, 0] += np.float32(0.01)

    def brighten(frame):
        move(frame)
        frame.world.strength *= 2.0

    def ask(frame):
        brighten(frame)
        frame.passes = ("Combined", "Variance")

    number = 0
    for change in (lambda frame: None, move, brighten):
        parts = [part(number := number + 1, change) for _ in range(SETTLED + 2)]
        assert min(parts[:-1]) > 0.9
        assert parts[-1] < 0.7
    assert part(number + 1, ask) > 0.9
