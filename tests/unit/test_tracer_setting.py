"""Frames whose light meets surfels: through session, integrator and picture, against a blend of all surfels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clouds import blend_all, cloud
from shapes import sphere_mesh, sphere_surfels

from drgs_blender.compute.jit import njit
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh, PosedSurfels, Surfels
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import Camera, Frame, Light, MeshState, ObjectState, RenderSettings, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.deform.attach import attach
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.deform.rigid import pose_by_matrix
from drgs_blender.engine.session import Session
from drgs_blender.render.integrator import intersect
from drgs_blender.render.integrator import wavefront as w
from drgs_blender.render.integrator.records import Scene, Traits
from drgs_blender.render.sampling import F, U, mix
from drgs_blender.render.scene.trace_scene import TraceScene
from drgs_blender.render.surfels.surfel_bvh import SurfelBVH
from drgs_blender.render.surfels.surfel_tracer import tracer_of

Array = np.ndarray
DARK = World(colour=(0.0, 0.0, 0.0))
SETTINGS = RenderSettings(samples=3, bounces=0, subpixel_samples=1, rays_see="surfels")
SHEARED = np.array([[1.2, 0.5, 0.0, 0.1], [0.0, -0.8, 0.3, 0.0], [0.2, 0.0, 1.0, 0.2], [0, 0, 0, 1.0]])


def strewn(n: int, seed: int = 0, size: float = 0.25) -> Surfels:
    """Surfels of every shape and direction in a box, of any opacity."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(n, 4))
    return Surfels(
        rng.uniform(-1, 1, (n, 3)), size * rng.uniform(0.1, 1, (n, 2)),
        turn / np.linalg.norm(turn, axis=1, keepdims=True), rng.uniform(0, 0.6, n),
        rng.uniform(size=(n, 3)), rng.uniform(size=n), rng.uniform(size=n),
    )  # fmt: skip


def quad(name: str, z: float, side: float = 3.0, **material: object) -> MeshState:
    corners = side * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, z]
    return MeshState(
        name, corners.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.eye(4)[None],
        np.zeros(1, np.int32), materials=[Material("it", **material)],
    )  # fmt: skip


def from_above(size: int = 24, height: float = 6.0, scale: float = 8.0) -> Camera:
    matrix = np.eye(4)
    matrix[2, 3] = height
    return Camera(matrix, size, size, scale, scale, size / 2, size / 2, orthographic=True)


def session_with(path: Path, asset: Asset) -> tuple[Session, str]:
    write_asset(path / "it.drgs", asset)
    session = Session()
    return session, session.load_asset(path / "it.drgs")


def test_a_shadow_is_the_transmittance_of_all_surfels(tmp_path: Path) -> None:
    """The sun through a hidden cloud without a mesh, sheared by its object: every pixel of the ground below."""
    surfels = strewn(300)
    session, key = session_with(tmp_path, Asset(surfels, Mesh.empty()))
    matrix = SHEARED.copy()
    matrix[2, 3] = 3.0
    tilt = np.eye(4)
    tilt[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]  # shines along (-0.6, 0, -0.8)
    frame = Frame(
        1, from_above(), [ObjectState("Cloud", key, matrix, visibility=Visibility(camera=False))], DARK,
        replace(SETTINGS, samples=6), ("Combined", "Position"), [quad("Ground", 0.0)],
        [Light("Sun", "sun", tilt, power=3.0)],
    )  # fmt: skip
    passes = session.render(frame)
    frame.objects[0].visibility = Visibility(camera=False, shadow=False)
    bare = session.render(frame)["Combined"][..., 0].ravel()
    points = passes["Position"].reshape(-1, 3)
    points[:, 2] += 1e-5 * np.abs(points).max(axis=1) + 2e-6 * 4.5  # as far above the ground as rays start
    towards = np.tile(np.float32([0.6, 0, 0.8]), (len(points), 1))
    expected = blend_all(pose_by_matrix(surfels, matrix), points, towards).through
    assert expected.min() < 0.2 and expected.max() > 0.95
    np.testing.assert_allclose(passes["Combined"][..., 0].ravel() / bare, expected, atol=1e-4)


def test_the_sky_is_seen_through_surfels_by_every_strategy(tmp_path: Path) -> None:
    """White sky: irradiance is the mean transmittance of cosine-weighted directions, whoever draws them."""
    surfels = strewn(150, seed=2)
    session, key = session_with(tmp_path, Asset(surfels, Mesh.empty()))
    matrix = np.eye(4)
    matrix[2, 3] = 1.5
    unseen = [ObjectState("Cloud", key, matrix, visibility=Visibility(camera=False))]
    rng = np.random.default_rng(0)
    way = rng.normal(size=(4000, 3))
    way = way / np.linalg.norm(way, axis=1, keepdims=True) + [0, 0, 1]
    way = (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)
    camera = from_above(2, scale=1e4)
    for counts in ((1024, 0, 0), (0, 0, 1024)):
        how = replace(SETTINGS, strategy_samples=counts, shading_model="paper")
        frame = Frame(1, camera, unseen, World(), how, meshes=[quad("Ground", 0.0, roughness=1.0, metallic=0.0)])
        lit = session.render(frame)["Combined"][..., 0].mean()
        frame.objects = []
        bare = session.render(frame)["Combined"][..., 0].mean()
        expected = blend_all(pose_by_matrix(surfels, matrix), np.zeros((4000, 3), np.float32), way).through.mean()
        assert 0.3 < expected < 0.8
        assert lit / bare == pytest.approx(expected, abs=0.015), counts


def test_lights_among_surfels_look_the_same_to_both_strategies(tmp_path: Path) -> None:
    """An area light in the middle of a cloud: by its own samples, and by rays that happen to meet it."""
    session, key = session_with(tmp_path, Asset(strewn(150, seed=2), Mesh.empty()))
    matrix = np.eye(4)
    matrix[2, 3] = 1.5
    light = Light("Panel", "area", matrix, power=50.0, shape="square", size_x=1.5)
    found = []
    for counts in ((0, 0, 2048), (8192, 0, 0)):
        how = replace(SETTINGS, strategy_samples=counts, shading_model="paper")
        frame = Frame(
            1, from_above(2, scale=1e4), [ObjectState("Cloud", key, matrix, visibility=Visibility(camera=False))],
            DARK, how, meshes=[quad("Ground", 0.0, roughness=1.0)], lights=[light],
        )  # fmt: skip
        found.append(session.render(frame)["Combined"][..., 0].mean())
        frame.objects = []
        assert found[-1] < 0.8 * session.render(frame)["Combined"][..., 0].mean(), "surfels hide much of it"
    assert found[0] == pytest.approx(found[1], rel=0.02)


@njit
def _meet_all(scene, origins, directions, count, out):  # type: ignore[no-untyped-def]
    rays = w.batch(16)
    s, ints = rays
    for n in range(len(origins)):
        for k in range(count):
            i, c = w.at(3)
            s[i + w.OX], s[i + w.OY], s[i + w.OZ] = origins[n, 0], origins[n, 1], origins[n, 2]
            s[i + w.LX], s[i + w.LY], s[i + w.LZ] = directions[n, 0], directions[n, 1], directions[n, 2]
            ints[c + w.KEY], ints[c + w.OWN] = mix(U(mix(U(n)) + U(k))), U(0xFFFFFFFF)
            through, _, hit = intersect.meet(scene, rays, 3, np.int32(-1))
            out[n, k, 0], out[n, k, 1], out[n, k, 2], out[n, k, 3] = through, hit[0], F(hit[1]), F(hit[17])
            values = hit[5:17]
            for j in range(12):
                out[n, k, 4 + j] = values[j]


@pytest.mark.parametrize("backed", [False, True])
def test_a_ray_meets_the_blend_of_all_surfels_or_the_mesh_behind(backed: bool) -> None:
    """What the integrator's rays meet, with large surfels, which are one surface however far apart."""
    posed = cloud(60, seed=9, size=0.9, opacity=(0.02, 0.25))
    bvh, scene = SurfelBVH(), TraceScene()
    bvh.update(posed)
    scene.update([], [quad("Wall", 0.2, 9.0)] if backed else [])
    rng = np.random.default_rng(4)
    origins = np.concatenate([rng.uniform(-0.3, 0.3, (80, 2)), np.full((80, 1), 4.0)], axis=1).astype(np.float32)
    directions = rng.normal(size=(80, 3)) * 0.1 - [0, 0, 1]
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    out = np.zeros((80, 400, 16), np.float32)
    tracer = intersect.MixedTracer(*scene.tracer, *tracer_of(bvh))
    traits = Traits(F(10), *[False] * 8)
    _meet_all(Scene(tracer, scene.geometry, 0, 0, traits), origins, directions, out.shape[1], out)
    stop = (0.2 - origins[:, 2]) / directions[:, 2] if backed else np.full(80, np.inf)
    share = []
    for n in range(80):
        expected = blend_all(posed, origins[n : n + 1], directions[n : n + 1], 0.0, stop[n], gap=3.0)
        met = out[n][(out[n, :, 2] < 0) & (out[n, :, 0] < 1)]
        share.append((np.mean(out[n, :, 2] >= 0), expected.through[0]))
        assert np.abs(out[n, :, 0] - (0.0 if backed else expected.through[0])).max() < 1e-4
        if not len(met):
            continue
        assert (met[:, 3] == expected.object_index[0]).all()
        for name, columns in (
            ("depth", slice(1, 2)), ("geometric_normal", slice(4, 7)), ("normal", slice(7, 10)),
            ("albedo", slice(10, 13)), ("roughness", slice(13, 14)), ("metallic", slice(14, 15)),
            ("size", slice(15, 16)),
        ):  # fmt: skip
            np.testing.assert_allclose(met[:, columns] - np.ravel(getattr(expected, name)[0]), 0.0, atol=1e-4)
    behind, through = np.array(share).T
    assert through.std() > 0.05
    if backed:
        assert np.abs(behind - through).max() < 0.12 and (behind - through).mean() == pytest.approx(0.0, abs=0.01)
    else:
        assert not behind.any()


def test_a_ball_looks_the_same_by_its_mesh_and_by_its_surfels(tmp_path: Path) -> None:
    """Seen, shadowed, mirrored and lit by the ground, next to an ordinary mesh."""
    vertices, faces = sphere_mesh(4)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), [0.7, 0.3, 0.2]), np.full(n, 0.5), np.zeros(n))
    surfels, binding, _ = attach(mesh, density=40.0)
    surfels.opacity[:] = 0.95
    session, key = session_with(tmp_path, Asset(surfels, mesh, binding))
    rows = np.linspace(0.2, 2.0, 8)[:, None, None]
    world = World(np.broadcast_to(rows, (8, 16, 3)).astype(np.float32) ** -2)
    place = np.eye(4)
    place[2, 3] = 1.05
    how = RenderSettings(samples=256, bounces=1, subpixel_samples=4)
    frame = Frame(
        1, from_above(32, scale=10.0), [ObjectState("Ball", key, place)], world, how,
        meshes=[quad("Ground", 0.0, roughness=0.2)],
    )  # fmt: skip
    pictures = {}
    for camera_sees in ("mesh", "surfels"):
        for tracer in ("mesh", "surfels"):
            frame.settings = replace(how, camera_sees=camera_sees, rays_see=tracer)  # type: ignore[arg-type]
            pictures[camera_sees, tracer] = session.render(frame)["Combined"][..., :3]
    for camera_sees in ("mesh", "surfels"):
        a, b = pictures[camera_sees, "mesh"], pictures[camera_sees, "surfels"]
        assert np.abs(a.mean(axis=(0, 1)) / b.mean(axis=(0, 1)) - 1).max() < 0.02
        assert np.sqrt(np.mean((a - b) ** 2)) < 0.04 * a.mean()
    frame.settings = replace(how, rays_see="mesh")
    np.testing.assert_array_equal(session.render(frame)["Combined"][..., :3], pictures["surfels", "mesh"])


def test_surfels_without_a_mesh_are_seen_by_a_camera_of_surfels_alone(tmp_path: Path) -> None:
    session, key = session_with(tmp_path, Asset(strewn(400, size=0.4), Mesh.empty()))
    frame = Frame(1, from_above(16), [ObjectState("Leaves", key)], World(), replace(SETTINGS, bounces=2))
    frame.settings.film_transparent = True
    picture = session.render(frame)["Combined"]
    assert np.isfinite(picture).all() and picture[6:10, 6:10, 3].min() > 0.8
    assert 0.02 < picture[6:10, 6:10, :3].mean() < 1.0
    frame.settings = replace(SETTINGS, rays_see="mesh", bounces=2)
    sheets = session.render(frame)["Combined"]
    assert np.isfinite(sheets).all() and sheets[6:10, 6:10, 3].min() > 0.8
    frame.settings = replace(SETTINGS, camera_sees="mesh")
    with pytest.raises(AssetError, match=r"Leaves.*no faces.*Set Camera Sees.*to Surfels"):
        session.render(frame)


def test_masks_tell_which_rays_meet_surfels(tmp_path: Path) -> None:
    """Hidden from everything but the camera a ball changes no light; a catcher's shadow is there all the same."""
    ball = sphere_surfels(1.0, 3000)
    turn = np.zeros((3000, 4))
    turn[:, 0] = 1.0
    surfels = Surfels(
        ball.centre, np.full((3000, 2), 0.06), turn, ball.opacity, ball.albedo, ball.roughness, ball.metallic
    )
    session, key = session_with(tmp_path, Asset(surfels, Mesh.empty()))
    place = np.eye(4)
    place[2, 3] = 2.0
    ground = quad("Ground", 0.0)
    how = replace(SETTINGS, samples=512, film_transparent=True)
    frame = Frame(1, from_above(24, scale=6.0), [ObjectState("Ball", key, place)], World(), how, meshes=[ground])

    def render(**seen: bool) -> Array:
        frame.objects[0].visibility = Visibility(**{"camera": False} | seen)
        return session.render(frame)["Combined"]

    bare = render(diffuse=False, glossy=False, shadow=False)
    np.testing.assert_allclose(bare[..., :3], bare[..., :3].mean(), rtol=0.02)
    assert render()[12, 12, 0] < 0.7 * bare[12, 12, 0]
    ground.visibility = Visibility(shadow_catcher=True)
    veil = render()[..., 3]
    assert veil[12, 12] > 0.3 > 0.1 > veil[0, 0]


def test_an_affine_object_poses_surfels_as_its_mesh_would() -> None:
    """Where the whole mesh is moved by a matrix, following the mesh and following the matrix are the same."""
    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
    surfels, binding, _ = attach(mesh, density=4.0)
    world = (vertices @ SHEARED[:3, :3].T + SHEARED[:3, 3]).astype(np.float32)
    a = pose_by_matrix(surfels, SHEARED, 3)
    b = MeshDriven(mesh, surfels, binding).pose(world, matrix_world=SHEARED, object_index=3)
    assert np.linalg.det(SHEARED[:3, :3]) < 0
    np.testing.assert_allclose(a.centre, b.centre, atol=2e-3)  # offsets are scaled along the normal
    np.testing.assert_allclose(a.tangent_u, b.tangent_u, atol=1e-6)
    np.testing.assert_allclose(a.tangent_v, b.tangent_v, atol=1e-6)
    face = np.cross(a.tangent_u, a.tangent_v)
    assert np.abs((a.normal * face).sum(1)).min() / np.linalg.norm(face, axis=1).max() > 0
    assert ((a.normal * b.normal).sum(1) > 0.9).all() and ((a.normal * a.centre).sum(1) > 0).mean() > 0.95
    assert (a.object_index == 3).all() and isinstance(a, PosedSurfels)
    flat = pose_by_matrix(surfels, np.diag([0.0, 0.0, 0.0, 1.0]))
    assert all(np.isfinite(getattr(flat, name)).all() for name in PosedSurfels.__slots__)
