"""Objects that were turned before a camera that stood still: found in the photographs, and their light."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import make, write_nerf
from scipy.ndimage import gaussian_filter, shift
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from capture_cases import balls, camera  # noqa: E402
from shapes import sphere_mesh  # noqa: E402
from test_decouple import sky  # noqa: E402
from test_evaluate_scenes import attach_nothing  # noqa: E402

from drgs_blender.core.asset import Asset, Environment  # noqa: E402
from drgs_blender.core.asset.model import Mesh  # noqa: E402
from drgs_blender.core.errors import UsageError  # noqa: E402
from drgs_blender.core.frame import Camera, World  # noqa: E402
from drgs_blender.evaluate.compare import compare  # noqa: E402
from drgs_blender.reconstruct import checkpoint  # noqa: E402
from drgs_blender.reconstruct.capture.capture import View  # noqa: E402
from drgs_blender.reconstruct.capture.training_views import full_targets, half_target  # noqa: E402
from drgs_blender.reconstruct.capture.turntable import is_turned, light_turns, likeness_of_surroundings  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.estimator import Points  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.gatherer import Gatherer  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.reconstruct.readers import read_capture  # noqa: E402
from drgs_blender.render.lights.environment import EnvironmentLight  # noqa: E402
from drgs_blender.render.scene.triangle_bvh import TriangleBVH  # noqa: E402

TURN = Rotation.from_euler("zyx", [0.7, -0.4, 0.3]).as_matrix()


def noise(seed: int, size: int = 64) -> np.ndarray:
    """(h, w, 3) of a room: blurred noise in .2 to .8 or so."""
    found = gaussian_filter(np.random.default_rng(seed).normal(size=(size, size, 3)), (1.5, 1.5, 0))
    return (0.5 + 0.1 * found / found.std()).clip(0, 1).astype(np.float32)


def views_before(rooms: list[np.ndarray], moved: float = 0.0) -> list[View]:
    """A ball with a pattern of its own before these rooms, photographed by a camera that is moved a little."""
    rng, found = np.random.default_rng(5), []
    for k, room in enumerate(rooms):
        y, x = np.mgrid[:64, :64] - 31.5 + 4 * np.sin(k)
        mask = (x**2 + y**2 < 18**2).astype(np.float32)
        behind = shift(room, (*rng.uniform(-moved, moved, 2), 0), order=1, mode="reflect")
        colour = np.where(mask[..., None] > 0, noise(100 + k), behind)
        found.append(View(f"{k:03d}", camera(k, len(rooms), 64), colour, mask))
    return found


def test_surroundings_that_stay_where_they_are_say_that_the_object_was_turned() -> None:
    still = views_before(16 * [noise(0)])
    assert is_turned(still) and likeness_of_surroundings(still) > 0.9
    assert is_turned(views_before(16 * [noise(0)], moved=6.0))  # a camera in a hand
    around = likeness_of_surroundings(views_before([noise(k) for k in range(16)]))
    assert around is not None and around < 0.35


def test_nothing_is_said_without_surroundings_or_masks_or_where_cameras_are_close() -> None:
    plain = views_before(16 * [np.full((64, 64, 3), 0.7, np.float32)])
    bare = [replace(view, mask=None) for view in views_before(16 * [noise(0)])]
    whole = [replace(view, mask=np.ones((64, 64), np.float32)) for view in views_before(16 * [noise(0)])]
    near = [replace(view, camera=camera(3, 16, 64)) for view in views_before(16 * [noise(0)])]
    for views in (plain, bare, whole, near):
        assert likeness_of_surroundings(views) is None and not is_turned(views)


def test_what_stands_still_to_the_camera_has_one_direction() -> None:
    views = balls(12).views
    seen = np.array([0.3, -0.2, 0.93])
    for view, turn in zip(views, light_turns(views), strict=True):
        matrix = np.asarray(view.camera.matrix_world)[:3, :3]
        np.testing.assert_allclose(turn @ matrix @ seen, np.asarray(views[0].camera.matrix_world)[:3, :3] @ seen)


def test_readers_turn_the_light_where_they_are_told_or_see_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write_nerf(make(tmp_path))
    assert not read_capture(tmp_path).turned and not caplog.messages  # on white: nothing to see
    known = read_capture(tmp_path, turntable="yes")
    assert known.turned and not caplog.messages
    np.testing.assert_allclose(known.views[3].turn, light_turns(known.views)[3])
    with monkeypatch.context() as patch:
        patch.setattr("drgs_blender.reconstruct.readers.is_turned", lambda _: True)
        with caplog.at_level(logging.WARNING):
            assert read_capture(tmp_path).turned
        (said,) = caplog.messages
        assert str(tmp_path) in said and "--turntable no" in said
        assert not read_capture(tmp_path, turntable="no").turned
    with pytest.raises(UsageError, match="turntable"):
        read_capture(tmp_path, turntable="perhaps")


def test_a_real_turntable_is_seen(shared_data: Path) -> None:
    capture = read_capture(shared_data / "multiview" / "ethiopianHead_1000", resolution=64)
    assert capture.turned


def test_a_turn_comes_with_cut_and_halved_views_and_counts_for_checkpoints() -> None:
    capture = balls(8)
    before = checkpoint.fingerprint(capture)
    for view, turn in zip(capture.views, light_turns(capture.views), strict=True):
        view.turn = turn
    assert checkpoint.fingerprint(capture) != before
    for view, target in zip(capture.training, full_targets(capture), strict=True):
        assert target.turn is view.turn and half_target(target).turn is view.turn


def test_surfels_that_turn_with_their_camera_look_alike_where_the_light_does_not() -> None:
    """Turning object and camera is turning the light back."""
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(300, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    colour = rng.uniform(0.2, 0.8, (300, 3))
    light = torch.tensor(rng.normal(size=(6, 3, 32, 32)), dtype=torch.float32)
    seen = camera(2, 8, 40)
    turned = seen.matrix_world.copy()
    turned[:3] = TURN @ seen.matrix_world[:3]

    def drawn(matrix: np.ndarray, rotation: np.ndarray, turn: np.ndarray | None) -> torch.Tensor:
        points = 0.5 * normal @ rotation.T
        surfels = Gaussians.on_surface(points, normal @ rotation.T, colour, 0.08, 0)
        # Round, so that tangents do not matter; mirrors.
        surfels.parameters["tint"].data.fill_(1.0)
        surfels.light = light
        return surfels.render(replace(seen, matrix_world=matrix), torch.zeros(3), 0, turn=turn).colour.detach()

    plain, back = drawn(seen.matrix_world, np.eye(3), None), drawn(turned, TURN, TURN.T)
    assert (plain - drawn(turned, TURN, None)).abs().mean() > 0.05
    assert (plain - back).abs().mean() < 1e-4


def test_light_that_was_turned_is_gathered_from_where_it_was() -> None:
    """As by a picture of the light that is turned itself, from every direction that is drawn."""
    points, triangles = sphere_mesh(2)
    mesh = Mesh(points, triangles, np.full((len(points), 3), 0.5), np.full(len(points), 0.5), np.zeros(len(points)))
    tree = TriangleBVH()
    tree.build(mesh.vertices, mesh.faces[:0])
    normal = np.float32([[0, 0, 1], [0, 0.6, 0.8], [-1, 0, 0]])
    towards = np.float32([[0.6, 0, 0.8], [0, 0, 1], [-0.8, 0.6, 0]])
    alpha2 = np.float32([0.002, 0.1, 0.9])
    image = sky()
    height, width = 64, 128
    z = np.cos(np.pi * (np.arange(height) + 0.5) / height)[:, None]
    angle = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z + 0 * angle], -1)
    resampled = EnvironmentLight(World(image, TURN)).lookup(directions.reshape(-1, 3)).reshape(height, width, 3)

    def sums(turn: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        gatherer = Gatherer(mesh, tree, None, (2048, 2048, 2048))
        key = np.arange(3, dtype=np.uint32)
        return gatherer.run(Points(normal, normal, towards, key, turn), normal, alpha2, radiance)[0].mean(1)

    still = np.empty((0, 3, 3), np.float32)
    expected = sums(still, np.ascontiguousarray(resampled, np.float32))
    turned = sums(np.tile(TURN.astype(np.float32), (3, 1, 1)), image)
    np.testing.assert_allclose(turned, expected, rtol=0.03, atol=0.003)
    assert np.abs(sums(still, image) - expected).max() > 0.2 * expected.max()


def test_views_left_out_are_lit_from_where_the_light_was_then() -> None:
    capture, radiance, seen = balls(8, 16, test_every=2), np.ones((4, 8, 3), np.float32), []
    for view, turn in zip(capture.views, light_turns(capture.views), strict=True):
        view.turn = turn
    mesh = Mesh(np.zeros((3, 3)), np.zeros((1, 3), np.int32), np.zeros((3, 3)), np.zeros(3), np.zeros(3))
    asset = Asset(attach_nothing(), mesh, None, Environment(radiance))

    def renderer(by: Camera, light: World, vertices: np.ndarray | None) -> dict[str, np.ndarray]:
        assert light.environment is radiance and vertices is None
        seen.append((by, light.rotation))
        return {"Combined": np.zeros((16, 16, 4), np.float32), "Coverage": np.zeros((16, 16, 1), np.float32)}

    compare(asset, capture, None, renderer)
    assert len(seen) == 4
    for view, (by, rotation) in zip(capture.testing, seen, strict=True):
        assert by is view.camera
        np.testing.assert_allclose(rotation, view.turn)
    assert np.abs(seen[1][1] - np.eye(3)).max() > 0.1
