"""The shadow terminator of smooth meshes: a coarse ball under a sun is shaded as the ball that it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import sphere_mesh

from drgs_blender.core.frame import Camera, Frame, Light, MeshState, RenderSettings, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.engine.session import Session
from drgs_blender.render.scene.terminator import height

DARK = World(colour=(0.0, 0.0, 0.0))


def at(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


@pytest.fixture(scope="module")
def balls() -> Frame:
    """Two coarse white balls, one of them an instance twice as large; a sun from the side."""
    vertices, faces = sphere_mesh(1)
    small = MeshState(
        "ball", vertices.astype(np.float32), faces, np.stack([at(-1.2, 0, 0), np.diag([1.5, 1.5, 1.5, 1.0])]),
        np.array([1, 2], np.int32), materials=[Material("white", (1.0, 1.0, 1.0), 1.0)],
    )  # fmt: skip
    small.matrices[1, 0, 3] = 1.5
    turned = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)  # a sun's -Z becomes -Y
    sun = np.eye(4)
    sun[:3, :3] = turned
    camera = Camera(at(0, 0, 6), 48, 24, 6.0, 6.0, 24.0, 12.0, orthographic=True)
    settings = RenderSettings(samples=32, subpixel_samples=16, bounces=0, camera_sees="mesh")
    names = ("Combined", "IndexOB", "Normal", "DiffDir")
    return Frame(0, camera, [], DARK, settings, names, [small], [Light("sun", "sun", sun, power=np.pi)])


def error(frame: Frame) -> np.ndarray:
    """Of grazing light without the surface's colour, to the cosine with the smooth normal; of either ball."""
    found = Session().render(frame)
    cosine = np.maximum(found["Normal"][..., 1], 0)
    inner = [(found["IndexOB"][..., 0] == index) & (cosine > 0) & (cosine < 0.4) for index in (1, 2)]
    return np.array([np.abs(found["DiffDir"][..., 0] - cosine)[own].mean() for own in inner])


def test_coarse_balls_are_shaded_as_round_ones(balls: Frame) -> None:
    faceted = error(balls)
    smooth = error(replace(balls, meshes=[replace(balls.meshes[0], terminator_offset=0.1)]))
    print(faceted, smooth)
    assert (smooth < 0.5 * faceted).all()


def test_other_things_still_throw_shadows(balls: Frame) -> None:
    """A screen before the sun leaves nothing; offsets of an object move no rays of others."""
    corners = 5 * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32)
    screen = MeshState(
        "screen", corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), at(0, 4, 0)[None], np.array([3], np.int32),
        visibility=Visibility(camera=False),
    )  # fmt: skip
    ball = replace(balls.meshes[0], terminator_offset=0.1)
    shaded = Session().render(replace(balls, meshes=[ball, screen]))["Combined"]
    assert shaded[..., :3].max() == 0.0
    other = replace(screen, terminator_offset=1.0)
    before, after = (Session().render(replace(balls, meshes=[balls.meshes[0], s])) for s in (screen, other))
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_height_of_flat_and_round_triangles() -> None:
    f = np.float32
    corners = tuple(tuple(map(f, row)) for row in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    up = tuple(f(3**-0.5) for _ in range(3))
    assert height(corners, (up, up, up), f(0.3), f(0.3), f(1)) == pytest.approx(0, abs=1e-6)
    third = f(1 / 3)
    middle = height(corners, corners, third, third, f(1))  # an eighth of a unit sphere
    assert 0 < middle <= 1 - 3**-0.5 + 0.25
    assert height(corners, corners, f(0), f(0), f(1)) == pytest.approx(0, abs=1e-6)
    inwards = tuple(tuple(-x for x in row) for row in corners)
    assert height(corners, inwards, third, third, f(-1)) == pytest.approx(-middle)


def test_offsets_that_are_no_numbers_are_none(balls: Frame) -> None:
    plain = Session().render(balls)["Combined"]
    odd = Session().render(replace(balls, meshes=[replace(balls.meshes[0], terminator_offset=float("nan"))]))[
        "Combined"
    ]
    assert np.array_equal(plain, odd)


def test_paths_start_shadow_rays_where_batches_do(balls: Frame) -> None:
    """A coat out of sight has the same scene shaded path by path; light of a sun has little noise."""
    ball = replace(balls.meshes[0], terminator_offset=0.1)
    far = replace(ball, name="far", materials=[Material("coated", coat=0.5)], visibility=Visibility(camera=False))
    far.matrices = np.diag([1e-3, 1e-3, 1e-3, 1.0])[None]
    far.matrices[0, 2, 3], far.pass_indices = -20.0, np.zeros(1, np.int32)
    for bounces, samples in ((0, 32), (1, 512)):
        settings = replace(balls.settings, bounces=bounces, samples=samples)
        batches, paths = (
            Session().render(replace(balls, meshes=meshes, settings=settings)) for meshes in ([ball], [ball, far])
        )
        cosine = batches["Normal"][..., 1]
        grazing = (batches["IndexOB"][..., 0] > 0) & (cosine > 0) & (cosine < 0.4)
        one, two = (found["Combined"][grazing][:, 0] for found in (batches, paths))
        assert two.mean() == pytest.approx(one.mean(), rel=0.005)
        assert np.abs(one - two).mean() < 0.03 * one.mean()
        assert not np.array_equal(one, two)
    assert (error(replace(balls, meshes=[ball, far])) < 0.5 * error(balls)).all()
