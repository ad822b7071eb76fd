"""Motion of surfaces, light gathered over frames: what it must keep, what it must forget, how much it gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.frame import Camera, RenderSettings
from drgs_blender.render.camera import camera_parameters, camera_ray
from drgs_blender.render.denoise import svgf_window
from drgs_blender.render.denoise.demodulation import CERTAINTY, LIGHT, PAD, POSITION, SOURCE, VARIANCE, Signal
from drgs_blender.render.denoise.kept_light import SETTLED, to_trace
from drgs_blender.render.denoise.svgf_reprojection import warp
from drgs_blender.render.denoise.svgf_spatial import prepare
from drgs_blender.render.denoise.svgf_temporal import (
    BIAS,
    NOW,
    PAST,
    RADIUS,
    NoisyPicture,
    denoise_next,
    find_change,
)
from drgs_blender.render.denoise.svgf_window import _neighbours, window
from drgs_blender.render.film.guides import Guides
from drgs_blender.render.film.motion_vectors import Motion, MotionFilm, SceneState, previous_positions, project
from drgs_blender.render.film.motion_vectors import motion as motion_of
from drgs_blender.render.gbuffer.gbuffer import GBuffer, compact
from drgs_blender.render.shading_points import CATCHER

H, W = 48, 64
PITCH = 1e-3  # metres a pixel


def camera(**changes: object) -> Camera:
    """Looks along +Y at the wall Y = 0 from one metre away."""
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    matrix[:3, 3] = 0, -1, 0
    values: dict = {"matrix_world": matrix, "width": W, "height": H, "fx": 1000.0, "fy": 1000.0, "cx": W / 2}
    return Camera(**(values | {"cy": H / 2} | changes))


def parameters(**changes: object) -> np.ndarray:
    return camera_parameters(camera(**changes), RenderSettings(), 1)


def wall(shift: float = 0.0, box: bool = False) -> Guides:
    """The wall Y = 0, a millimetre a pixel, painted in stripes and moved by `shift` pixels to the right.

    With `box`, a second object stands 50 mm before it, ten pixels wide, and only it moves.
    """
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    position = np.stack([(x - W / 2) * PITCH, np.zeros((H, W)), (H / 2 - y) * PITCH], -1)
    on_box = (np.abs(x - (W / 2 + shift)) < 5) & box
    paint = 0.2 + 0.6 * (np.floor((x - (0.0 if box else shift)) / 4) % 2)
    position[on_box] *= 0.95
    position[on_box, 1] = -0.05
    return Guides(
        *(
            np.array(a, np.float32)
            for a in (
                np.ones((H, W)), position, np.broadcast_to([0, -1, 0], (H, W, 3)), np.repeat(paint[..., None], 3, 2),
                np.full((H, W), 0.5), np.zeros((H, W)), on_box, np.where(on_box, 0.95, 1.0) * PITCH,
            )
        )
    )  # fmt: skip


def still(guides: Guides) -> Motion:
    return Motion(np.zeros((H, W, 2), np.float32), guides.position.copy())


def moved(guides: Guides, pixels: float, where: object = True) -> Motion:
    """Everything (or `where`) has moved by `pixels` to the right since the frame before."""
    motion = still(guides)
    mask = np.broadcast_to(where, (H, W))  # type: ignore[arg-type]
    motion.vector[mask, 0] = -pixels
    motion.previous[mask, 0] -= (pixels * guides.footprint)[mask]
    return motion


def picture(
    guides: Guides, value: float | np.ndarray, noise: float, seed: int, motion: Motion | None = None
) -> NoisyPicture:
    """Irradiance `value` on the guides' surfaces with noise of the given deviation, and its variance."""
    rng = np.random.default_rng(seed)
    light = np.broadcast_to(value, (H, W)) + noise * rng.normal(size=(H, W))
    components = np.zeros((H, W, 4, 3), np.float32)
    components[:, :, 0] = light[..., None] * guides.albedo
    components[:, :, 2] = 0.04 * light[..., None]
    variance = np.zeros((H, W, 2), np.float32)
    variance[..., 0] = (noise * guides.albedo[..., 0]) ** 2
    variance[..., 1] = (noise * 0.04) ** 2
    return NoisyPicture(components, variance, guides, motion)


def gathered(pictures: list[NoisyPicture], still: bool = False) -> Signal:
    """What is known after all `pictures`, before any filter over the picture."""
    signal: Signal | None = None
    for s in pictures:
        _, signal = denoise_next(s, signal, split=False, still=still)
    assert signal is not None
    return signal


def diffuse(signal: Signal) -> np.ndarray:
    """(h, w) demodulated diffuse light, first colour."""
    return signal.light[:, LIGHT, PAD : PAD + W]


# --- motion ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orthographic", [False, True])
def test_projection_inverts_the_camera_ray(orthographic: bool) -> None:
    rng = np.random.default_rng(0)
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix[:3, 3] = rng.normal(size=3)
    p = parameters(matrix_world=matrix, fx=70.0, fy=55.0, cx=20.0, orthographic=orthographic)
    for x, y, depth in rng.uniform(0.5, 60, (50, 3)):
        o = np.array(camera_ray(p, x, y))
        assert np.allclose(project(p, *(o[:3] + depth * o[3:])), (x, y, depth), atol=1e-9)


def scene_state(vertices: np.ndarray | None = None, places: object = (), **changes: object) -> SceneState:
    """The given shapes before the camera."""
    shapes = np.zeros((0, 3), np.float32) if vertices is None else vertices
    return SceneState(shapes, np.array(places, np.float32).reshape(-1, 3, 4), parameters(**changes))


def mesh(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return rng.normal(size=(60, 3)).astype(np.float32), rng.permutation(60).reshape(20, 3).astype(np.int32)


def test_points_move_with_their_faces() -> None:
    rng = np.random.default_rng(1)
    vertices, faces = mesh(rng)
    face = rng.integers(0, 20, 200).astype(np.int32)
    weights = rng.dirichlet([1, 1, 1], 200).astype(np.float32)
    corners = vertices[faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    on = (weights[:, :, None] * corners).sum(1)
    tilt = 0.05 * (corners[:, 1] - corners[:, 0]) + 0.02 * normal
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    before = (vertices @ turn.T + [1, 2, 3]).astype(np.float32)
    for points in (on, on + tilt):  # on the mesh, and off it
        tied = face, np.full(200, -1, np.int32), weights[:, 1:]
        found = previous_positions(faces, scene_state(vertices), scene_state(before), *tied, points.astype(np.float32))
        assert np.abs(found - (points @ turn.T + [1, 2, 3])).max() < 2e-5
    # Any affine map: what lies in the face's plane follows exactly, what stands off keeps its distance.
    matrix = rng.normal(size=(3, 3))
    before = (vertices @ matrix.T).astype(np.float32)
    shifted = on + 0.05 * (corners[:, 1] - corners[:, 0])
    found = previous_positions(faces, scene_state(vertices), scene_state(before), *tied, shifted.astype(np.float32))
    assert np.abs(found - shifted @ matrix.T).max() < 2e-4


def test_points_without_a_face_stand_still_and_flat_faces_do_no_harm() -> None:
    vertices, faces = mesh(np.random.default_rng(2))
    vertices[faces[3]] = vertices[faces[3, 0]]
    points = np.random.default_rng(3).normal(size=(2, 3)).astype(np.float32)
    third = np.full((2, 2), 1 / 3, np.float32)
    tied = np.array([-1, 3], np.int32), np.array([-1, -1], np.int32), third
    found = previous_positions(faces, scene_state(vertices), scene_state(vertices + np.float32(1)), *tied, points)
    assert (found[0] == points[0]).all()
    assert np.allclose(found[1], points[1] + 1, atol=1e-5)


def test_vectors_lead_to_the_place_in_the_picture_before() -> None:
    guides = wall()
    film = MotionFilm((H, W), (0, 0), scene_state(), scene_state())
    rest = film.motion(guides.position, guides.coverage)
    assert (rest.vector == 0).all() and (rest.previous == guides.position).all()
    matrix = camera().matrix_world.copy()
    matrix[0, 3] = 3 * PITCH  # the camera was three pixels further right: the wall, further left in its picture
    film.then = scene_state(matrix_world=matrix)
    found = film.motion(guides.position, guides.coverage)
    assert np.allclose(found.vector, [-3, 0], atol=1e-4)
    film.displacement[..., 2] = 2 * PITCH  # the wall was higher
    film.then = scene_state()
    found = film.motion(guides.position, guides.coverage)
    assert np.allclose(found.vector, [0, -2], atol=1e-4)
    film.displacement[..., 1] = -5  # it was behind the camera
    found = film.motion(guides.position, np.where(np.arange(W) < 5, 0, guides.coverage))
    assert np.isnan(found.vector).all()


def test_samples_make_up_a_pixels_motion_as_they_make_up_its_position() -> None:
    """Two samples near, one far behind, one of a shadow catcher in front: the near ones count, by weight."""
    from drgs_blender.render.gbuffer.gbuffer import compact
    from drgs_blender.render.shading_points import CATCHER

    alpha = np.zeros((H, W, 4), np.float32)
    alpha[7, 9] = 1.0
    p = parameters()
    buffer = compact(alpha, p, 0, 0)
    buffer.position[:] = 0
    buffer.depth[:] = [1.0, 1.001, 2.0, 0.5]
    buffer.points.weight[:] = [0.25, 0.75, 1.0, 1.0]
    buffer.points.flags[3] = CATCHER
    previous = np.float32([[4, 0, 0], [0, 4, 0], [9, 9, 9], [7, 7, 7]])
    film = MotionFilm((H, W), (0, 0), scene_state(), scene_state())
    buffer.face[:] = 3
    film.displace(buffer, previous, buffer.face)
    assert np.allclose(film.displacement[7, 9], [1, 3, 0])
    buffer.face[1] = -1  # of a surfel off the mesh: it follows the others
    film.displace(buffer, previous, buffer.face)
    assert np.allclose(film.displacement[7, 9], [4, 0, 0])
    film.displacement[7, 9] = 0
    assert (film.displacement == 0).all()


# --- accumulation ---------------------------------------------------------------------------------------------------


def test_a_constant_stays_one() -> None:
    pictures = [picture(wall(1.3 * k), 2.0, 0.0, k, moved(wall(1.3 * k), 1.3)) for k in range(4)]
    history = None
    for s in pictures:
        out, history = denoise_next(s, history)
        assert np.allclose(out, s.components, rtol=2e-5, atol=1e-7)


def test_noise_falls_as_the_root_of_the_frames() -> None:
    guides = wall()
    for n in (2, 4, 16):
        left = diffuse(gathered([picture(guides, 2.0, 0.5, k, still(guides)) for k in range(n)], still=True)) - 2.0
        assert abs(left.std() * np.sqrt(n) / 0.5 - 1) < 0.08, n
        assert abs(left.mean()) < 4 * 0.5 / np.sqrt(n * H * W)


def test_the_variance_it_reports_is_the_one_it_has() -> None:
    guides = wall()
    signal = gathered([picture(guides, 2.0, 0.5, k, still(guides)) for k in range(6)])
    reported = signal.light[:, 2, PAD : PAD + W].mean()
    assert abs(reported / diffuse(signal).var() - 1) < 0.15


def test_noise_alone_counts_as_hardly_any_change() -> None:
    """The square of a normal error beyond its variance, where it is beyond, is .484 of that variance in the mean."""
    guides = wall()
    now, before = (
        prepare(p.components, p.variance, guides, False) for p in (picture(guides, 2, 0.3, k) for k in (0, 1))
    )
    past, source = warp(before, now, np.zeros((H, W, 2), np.float32), guides.position)
    change = find_change(now, past, source)[8:-8, :, PAD + 8 : PAD + W - 8]
    expected = 0.484 * (change[:, NOW] + change[:, PAST]) / (2 * RADIUS + 1) ** 2
    assert change[:, BIAS].mean() == pytest.approx(expected.mean(), rel=0.15)


@pytest.mark.parametrize("pixels", [3.0, 2.4])
def test_texture_moves_without_a_ghost(pixels: float) -> None:
    """Stripes of contrast one to four move a few pixels a frame; their light does not."""
    guides = [wall(pixels * k) for k in range(6)]
    pictures = [picture(g, 2.0, 0.3, k, moved(g, pixels)) for k, g in enumerate(guides)]
    found = diffuse(gathered(pictures)) - 2.0
    seen = slice(int(pixels * 5) + 2, W)  # the rest came in from the left
    assert found[:, seen].std() < 0.3 / np.sqrt(6) * 1.15
    stripes = [found[:, seen][guides[-1].albedo[:, seen, 0] < 0.5], found[:, seen][guides[-1].albedo[:, seen, 0] > 0.5]]
    assert abs(stripes[0].mean() - stripes[1].mean()) < 0.02


def test_what_comes_into_view_starts_anew() -> None:
    """A box moves before a wall of other light: what it uncovers is the present alone, the rest is gathered."""
    step = 4.0
    pictures = []
    for k in range(5):
        g = wall(step * k - 8, box=True)
        on_box = g.object == 1
        pictures.append(picture(g, np.where(on_box, 0.5, 3.0), 0.2, k, moved(g, step, on_box)))
    last = pictures[-1].guides
    found = diffuse(gathered(pictures))
    x = np.arange(W) + 0.5
    box = np.abs(x - (W / 2 + 8)) < 5
    fresh = (np.abs(x - (W / 2 + 4)) < 5) & ~box
    assert (last.object[0] == box).all() and fresh.sum() == 4
    present = prepare(pictures[-1].components, pictures[-1].variance, last, split=False)
    assert (found[:, fresh] == diffuse(present)[:, fresh]).all()
    old = np.abs(x - W / 2) > 20
    assert found[:, old].std() < 0.2 / np.sqrt(5) * 1.15
    assert found[:, box].std() < 0.2 / np.sqrt(5) * 1.15
    assert abs(found[:, box].mean() - 0.5) < 0.01 and abs(found[:, ~box].mean() - 3.0) < 0.01


def test_surfaces_that_turn_away_or_change_places_are_not_mixed() -> None:
    before, now = wall(), wall()
    now.normal[:, : W // 2] = [0.9, -np.sqrt(1 - 0.81), 0]
    now.object[: H // 2] = 7
    now.position[:, -6:, 1] += 0.05  # something else of the same object, behind
    found = diffuse(gathered([picture(before, 5.0, 0.1, 0), picture(now, 1.0, 0.1, 1, still(now))]))
    present = diffuse(gathered([picture(now, 1.0, 0.1, 1)]))
    alone = np.ones((H, W), bool)
    alone[H // 2 :, W // 2 : -6] = False
    assert not (found[~alone] == present[~alone]).any()
    assert (found[alone] == present[alone]).all()


def test_light_that_changes_is_followed() -> None:
    """A steady light is gathered; one that jumps is taken up at once, not over ten frames."""
    guides = wall()
    pictures = [picture(guides, 2.0, 0.2, k, still(guides)) for k in range(8)]
    jump = gathered([*pictures, picture(guides, 4.0, 0.2, 9, still(guides))])
    assert abs(diffuse(jump).mean() - 4.0) < 0.05
    slow = [picture(guides, 2.0 + 0.04 * k, 0.2, k, still(guides)) for k in range(20)]
    found = diffuse(gathered(slow))
    assert abs(found.mean() - (2 + 0.04 * 19)) < 0.1 and found.std() < 0.15


def test_numbers_that_are_none_take_the_past() -> None:
    guides = wall()
    pictures = [picture(guides, 2.0, 0.1, k, still(guides)) for k in range(3)]
    pictures[1].components[5, 6, 0, 1] = np.nan
    pictures[2].components[9, 30, 2] = np.inf
    pictures[2].variance[30, 9, 1] = np.nan
    signal = gathered(pictures)
    assert np.isfinite(signal.light).all()
    for y, x in ((5, 6), (9, 30), (30, 9)):
        assert abs(diffuse(signal)[y, x] - 2.0) < 0.4
    broken = still(guides)
    broken.vector[3] = np.nan
    broken.previous[4] = np.nan
    again = gathered([pictures[0], picture(guides, 2.0, 0.1, 8, broken)])
    assert np.isfinite(again.light).all()
    assert np.isfinite(window([None, pictures[0], pictures[1], pictures[2], None])).all()


def test_a_picture_of_another_size_is_no_history() -> None:
    guides = wall()
    _, history = denoise_next(picture(guides, 2.0, 0.1, 0), None, split=True)
    fresh, _ = denoise_next(picture(guides, 2.0, 0.1, 1, still(guides)), None, split=False)
    found, _ = denoise_next(picture(guides, 2.0, 0.1, 1, still(guides)), history, split=False)
    assert (found == fresh).all()


@pytest.mark.alone
def test_results_do_not_depend_on_threads() -> None:
    pictures = [picture(wall(1.7 * k), 2.0, 0.3, k, moved(wall(1.7 * k), 1.7)) for k in range(5)]
    results = []
    before = get_num_threads()
    try:
        for threads in (1, 2):
            use_threads(threads)
            results.append((gathered(pictures).light, window(pictures)))
    finally:
        use_threads(before)
    for one, two in zip(*results):
        assert (one == two).all()


# --- window ---------------------------------------------------------------------------------------------------------


def test_window_gathers_five_frames_of_what_moves() -> None:
    guides = [wall(2.4 * k) for k in range(5)]
    pictures = [picture(g, 2.0, 0.3, k, moved(g, 2.4)) for k, g in enumerate(guides)]
    alone = [window([None, None, s, None, None])[:, 16:-16, 0, 0] for s in pictures[2:3]]
    both = window(pictures)[:, 16:-16, 0, 0]
    truth = 2.0 * guides[2].albedo[:, 16:-16, 0]
    assert np.abs(both - truth).mean() < 0.62 * np.abs(alone[0] - truth).mean()
    assert abs((both / truth).mean() - 1) < 0.01


def test_the_variance_that_a_window_reports_is_the_one_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    gathered: list[Signal] = []
    monkeypatch.setattr(svgf_window, "smooth", lambda signal, check: gathered.append(signal) or signal)
    guides = wall()
    window([picture(guides, 2.0, 0.5, k, still(guides)) for k in range(5)])
    (signal,) = gathered
    reported = signal.light[:, VARIANCE, PAD : PAD + W].mean()
    assert abs(reported / diffuse(signal).var() - 1) < 0.15


def test_window_does_not_lag() -> None:
    """Light that grows steadily: the frames before and after cancel."""
    guides = wall()
    pictures = [picture(guides, 2.0 + 0.02 * k, 0.2, k, still(guides)) for k in range(5)]
    found = window(pictures)[:, :, 0, 0] / guides.albedo[..., 0]
    assert abs(found.mean() - 2.04) < 0.005


def test_window_does_not_mix_what_is_hidden_in_other_frames() -> None:
    pictures = []
    for k in range(5):
        g = wall(5.0 * k - 10, box=True)
        on_box = g.object == 1
        pictures.append(picture(g, np.where(on_box, 0.5, 3.0), 0.05, k, moved(g, 5.0, on_box)))
    found = window(pictures)[:, :, 0, 0]
    on_box = pictures[2].guides.object == 1
    albedo = pictures[2].guides.albedo[..., 0]
    assert np.abs(found / albedo - np.where(on_box, 0.5, 3.0)).max() < 0.15


def test_window_follows_what_grows_and_comes_nearer() -> None:
    """Places and world positions two frames before and after, of a wall that grows by a tenth and comes by 20 mm."""
    grown, near = 1.1, 0.02
    x, y = np.meshgrid(np.arange(W) + 0.5 - W / 2, np.arange(H) + 0.5 - H / 2)
    from_centre = np.stack([x, y], -1)

    def at(frame: float) -> np.ndarray:
        """World position of what the middle frame has in each pixel."""
        scale = grown ** (frame - 2)
        return np.stack([x * PITCH * scale, np.full_like(x, -near * frame), -y * PITCH * scale], -1)

    pictures = []
    for k in range(5):
        guides = wall()
        guides.position[..., 1] = -near * k
        motion = still(guides)
        motion.vector[:] = from_centre * (1 / grown - 1)
        motion.previous[..., ::2] /= grown
        motion.previous[..., 1] += near
        pictures.append(picture(guides, 2.0, 0.0, k, motion))
    found = [(one, vector.copy(), expected.copy()) for _, one, vector, expected in _neighbours(pictures)]
    inner = slice(12, -12), slice(16, -16)
    for frame, (one, vector, expected) in zip((1, 0, 3, 4), found, strict=True):
        assert one is pictures[frame]
        np.testing.assert_allclose(vector[inner], (from_centre * (grown ** (frame - 2) - 1))[inner], atol=0.11)
        np.testing.assert_allclose(expected[inner], at(frame)[inner], atol=0.6 * PITCH)


def gliding(roughness: float, stripes: float, world: bool = False) -> tuple[list[NoisyPicture], np.ndarray]:
    """A plate that turns by five degrees a frame, or its world by ten; stripes of four pixels glide by one and a half.

    Five pictures, and the glossy light (w,) of the middle one without its noise.
    """

    def shine(frame: int) -> np.ndarray:
        return 0.3 + stripes * np.sin(np.pi / 2 * (np.arange(W) + 1.5 * frame))

    pictures = []
    for k in range(-2, 3):
        guides, (angle, before) = wall(), np.radians([0.0, 0.0] if world else [5.0 * k, 5.0 * (k - 1)])
        guides.normal[:] = [np.sin(angle), -np.cos(angle), 0]
        guides.position[..., 1] = -np.tan(angle) * guides.position[..., 0]
        guides.roughness[:] = roughness
        motion = still(guides)
        motion.previous[..., 1] = -np.tan(before) * guides.position[..., 0]
        one = picture(guides, 0.0, 0.0, k + 2, motion)
        one.world_turn = np.radians(10.0) if world else 0.0
        noise = 0.03 * np.random.default_rng(k + 2).normal(size=(H, W))
        one.components[:, :, 2] = (shine(k) + noise)[..., None]
        one.variance[..., 1] = 0.03**2
        pictures.append(one)
    return pictures, shine(0)


@pytest.mark.parametrize("over", ["window", "time", "time, of a world that turns"])
@pytest.mark.parametrize(("roughness", "stripes"), [(0.15, 0.2), (0.5, 0.0)])
def test_reflections_that_glide_are_left_and_broad_lobes_gathered(over: str, roughness: float, stripes: float) -> None:
    pictures, truth = gliding(roughness, stripes, "world" in over)
    alone = window([None, None, pictures[2], None, None])
    if over == "window":
        together = window(pictures)
    else:
        signal = None
        for one in pictures[:3]:
            together, signal = denoise_next(one, signal)
    errors = [np.abs(p[8:-8, 12:-12, 2, 0] - truth[12:-12]).mean() for p in (together, alone)]
    assert errors[0] < (1.05 if stripes else 0.9) * errors[1] and errors[1] < 0.02


def part_kept_of(guides: Guides, before: Guides, moved_by: float = 0.01) -> np.ndarray:
    """(2, h, w): part of the light of a picture before that counts, diffuse and glossy, on a wall that moved (m)."""
    now, then = (
        prepare(p.components, p.variance, p.guides, True) for p in (picture(g, 1.0, 0.0, 0) for g in (guides, before))
    )
    expected = guides.position - np.array([0, moved_by, 0], np.float32)
    then.guide[:, POSITION + 1] -= moved_by
    light, _ = warp(then, now, np.zeros((H, W, 2), np.float32), expected.astype(np.float32))
    return light[8:-8, CERTAINTY : CERTAINTY + 2, PAD + 8 : PAD + W - 8].swapaxes(0, 1)


@pytest.mark.parametrize("roughness", [0.4, 0.1, 0.0])
def test_what_is_kept_of_glossy_light_falls_with_the_turn_in_widths_of_the_lobe(roughness: float) -> None:
    """1/e where the reflection turned by two widths, the roughness squared, .0025 at least; all of diffuse light."""
    guides, before = wall(), wall()
    guides.roughness[:] = roughness
    width = max(roughness, 0.05) ** 2
    for widths in (0.0, 1.0, 2.0, 3.0):
        turn = widths * width / 2
        before.normal[:] = [np.sin(turn), -np.cos(turn), 0]
        diffuse_part, glossy_part = part_kept_of(guides, before)
        np.testing.assert_allclose(glossy_part, np.exp(-((widths / 2) ** 2)), atol=0.02 if roughness > 0.05 else 0.1)
        assert (diffuse_part == 1).all()


def test_what_stands_still_has_not_turned() -> None:
    """Though its normals, means over a pixel's samples, jitter."""
    random = np.random.default_rng(2)

    def bumpy() -> Guides:
        guides = wall()
        guides.roughness[:] = 0.2
        normal = np.array([0, -1, 0]) + np.radians(2) * random.normal(size=(H, W, 3))
        guides.normal[:] = normal / np.linalg.norm(normal, axis=2, keepdims=True)
        return guides

    one, other = bumpy(), bumpy()
    assert (part_kept_of(one, other, moved_by=0.0) == 1).all()
    assert (part_kept_of(one, other)[1] < 1).all()


def test_a_roughness_that_is_no_number_spoils_its_own_picture_alone() -> None:
    signal = None
    for k in range(4):
        guides = wall()
        guides.roughness[10, 10] = np.nan if k == 1 else 0.5
        light, signal = denoise_next(replace(picture(guides, 1.0, 0.1, k, moved(guides, 0.0)), world_turn=0.1), signal)
    assert np.isfinite(light).all()


def test_a_world_that_turns_leaves_diffuse_light_gathered() -> None:
    guides = wall()
    still_light, turned = (
        gathered([replace(picture(guides, 2.0, 0.3, k, moved(guides, 0.0)), world_turn=angle) for k in range(5)])
        for angle in (0.0, 0.5)
    )
    np.testing.assert_array_equal(diffuse(turned), diffuse(still_light))


def test_window_depends_on_its_frames_alone() -> None:
    """Whoever renders a frame, and in which run, gets the same bits; the frames' order of creation is irrelevant."""
    pictures = [picture(wall(k), 2.0, 0.3, k, moved(wall(k), 1.0)) for k in range(7)]
    padded: list[NoisyPicture | None] = [None, None, *pictures, None, None]
    whole = [window(padded[k : k + 5]) for k in range(7)]
    for k in (6, 0, 3):
        assert (window(padded[k : k + 5]) == whole[k]).all()
    with pytest.raises(ValueError):
        window([*padded[2:4], None, *padded[5:7]])


def test_light_passes_stay_a_sum_and_gather_alike() -> None:
    guides = wall()
    pictures = [picture(guides, 2.0, 0.3, k, still(guides)) for k in range(3)]
    for s in pictures:
        s.components[:, :, 1] = 0.25 * s.components[:, :, 0]
        s.components[:, :, 3] = 0.25 * s.components[:, :, 2]
    history: dict[bool, Signal | None] = {True: None, False: None}
    out: dict[bool, np.ndarray] = {}
    for s in pictures:
        for split in (True, False):
            out[split], history[split] = denoise_next(s, history[split], split)
    assert np.allclose(out[True][:, :, 0] + out[True][:, :, 1], out[False][:, :, 0], rtol=1e-4)
    assert np.allclose(out[True][:, :, 1], 0.25 * out[True][:, :, 0], rtol=1e-4)


# --- light that is kept ---------------------------------------------------------------------------------------------


def seen_by(guides: Guides) -> GBuffer:
    """The guides' surfaces as a picture with one sample a pixel."""
    buffer = compact(np.ones((H, W, 1), np.float32), parameters(), 0, 0)
    buffer.position[:], buffer.points.normal[:] = guides.position.reshape(-1, 3), guides.normal.reshape(-1, 3)
    buffer.object_index[:] = guides.object.reshape(-1)
    return buffer


def traced(guides: Guides, before: Guides, turn: int = 0, pixels: float = 0.0, age: int = SETTLED) -> np.ndarray:
    """(H, W) bool: pixels that get light of their own, the view having gone `pixels` to the left since `before`."""
    matrix = camera().matrix_world.copy()
    matrix[0, 3] = pixels * PITCH  # where it was
    cameras = parameters(), parameters(matrix_world=matrix)
    numbers = np.arange(2, dtype=np.int32)
    given = seen_by(guides), numbers, signal_of(before), cameras, turn, (0, 0, W)
    return to_trace(*given, (np.full((H, W), age, np.uint8), np.zeros((H, W), np.uint8))).reshape(H, W)


def signal_of(guides: Guides) -> Signal:
    noisy = picture(guides, 0.5, 0.1, 1)
    return prepare(noisy.components, noisy.variance, noisy.guides)


def test_every_second_pixel_keeps_its_light_and_the_others_the_next_time() -> None:
    chess = np.indices((H, W)).sum(axis=0) % 2 == 0
    np.testing.assert_array_equal(traced(wall(), wall()), chess)
    np.testing.assert_array_equal(traced(wall(), wall(), turn=7), ~chess)


def test_what_comes_into_view_is_traced() -> None:
    """At the border of the picture, and behind what stood before it."""
    chess = np.indices((H, W)).sum(axis=0) % 2 == 0
    found = traced(wall(), wall(), pixels=6.0)
    assert found[:, :6].all()
    np.testing.assert_array_equal(found[:, 6:], chess[:, 6:])
    uncovered = traced(wall(), wall(box=True))
    box = wall(box=True).object != 0
    assert uncovered[box].all()
    np.testing.assert_array_equal(uncovered[~box], chess[~box])
    other = wall()._replace(object=np.where(box, 1.0, 0.0).astype(np.float32))  # on the wall itself
    np.testing.assert_array_equal(traced(wall(), other), chess | box)


def test_light_of_few_pictures_is_not_kept() -> None:
    assert traced(wall(), wall(), age=SETTLED - 1).all()
    ages = [np.full((H, W), 1, np.uint8), np.zeros((H, W), np.uint8)]
    shifted = camera().matrix_world.copy()
    shifted[0, 3] = 6 * PITCH
    for turn in range(4):  # the view goes on by six pixels with every picture
        cameras = parameters(), parameters(matrix_world=shifted)
        to_trace(seen_by(wall()), np.zeros(1, np.int32), signal_of(wall()), cameras, turn, (0, 0, W), tuple(ages))
        assert (ages[1][:, :6] == 1).all()
        assert (ages[1][:, -6:] == min(turn + 2, SETTLED)).all()
        ages.reverse()


def test_surfaces_in_two_layers_and_catchers_are_traced() -> None:
    buffer = seen_by(wall())
    buffer.points.flags[1] = CATCHER
    buffer.points.pixel[4] = 3  # two points of one pixel
    cameras = parameters(), parameters()
    ages = np.full((H, W), SETTLED, np.uint8), np.zeros((H, W), np.uint8)
    found = to_trace(buffer, np.zeros(1, np.int32), signal_of(wall()), cameras, 0, (0, 0, W), ages)
    assert found[[1, 3, 4]].all()
    assert not found[5]


def test_pixels_without_light_of_their_own_find_their_past() -> None:
    """Whoever is not traced is found again by the filter, wherever the view goes."""
    for pixels in (0.3, 0.5, 2.49, 2.51):
        before, now = wall(), wall()
        chosen = traced(now, before, pixels=pixels)
        matrix = camera().matrix_world.copy()
        matrix[0, 3] = pixels * PITCH
        motion = motion_of(
            now.position, now.position.copy(), now.coverage, parameters(), parameters(matrix_world=matrix)
        )
        noisy = picture(now, 0.5, 0.0, 2, motion)
        noisy.components[~chosen] = np.nan
        out, signal = denoise_next(noisy, signal_of(before), turned=True)
        assert np.isfinite(out).all()
        known = signal.guide[:, SOURCE, PAD:-PAD]
        assert (known == now.object).all(), pixels
        assert abs(out[:, :, 0].sum() / picture(now, 0.5, 0.0, 2).components[:, :, 0].sum() - 1.0) < 0.03


def test_fewer_taps_keep_a_constant_and_edges() -> None:
    guides = wall(box=True)
    value = np.where(guides.object != 0, 3.0, 0.5)
    before = denoise_next(picture(guides, value, 0.0, 1), None)[1]
    out, _ = denoise_next(picture(guides, value, 0.0, 2, still(guides)), before, turned=True)
    np.testing.assert_allclose(out, picture(guides, value, 0.0, 2).components, rtol=1e-4, atol=1e-6)
