"""Panoramic cameras: directions and the way back, surfels along curved pictures' rays, regions, motion, files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clouds import blend_all, cloud
from shapes import scene_of, sphere_mesh, sphere_surfels

from drgs_blender.cli.camera_file import read_camera
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import (
    Camera,
    Frame,
    Light,
    MeshState,
    MotionStep,
    ObjectState,
    Pose,
    RenderSettings,
    Visibility,
    World,
)
from drgs_blender.core.materials import Material
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.ipc.codec import decode_frame, encode_frame
from drgs_blender.render import pipeline
from drgs_blender.render.camera import camera_parameters, camera_ray, check_camera, sample_ray
from drgs_blender.render.denoise import noisy_frames
from drgs_blender.render.film.motion_vectors import project
from drgs_blender.render.gbuffer.camera_hits import trace_camera
from drgs_blender.render.gbuffer.surfel_rays import SurfelRays, blend_along_rays
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.progressive import coarse
from drgs_blender.render.scene.ray_masks import ORDINARY
from drgs_blender.render.scene.trace_scene import TraceScene
from drgs_blender.render.surfel_columns import ALBEDO, NORMAL
from drgs_blender.render.surfels.surfel_bvh import SurfelBVH

SETTINGS = RenderSettings(samples=4, subpixel_samples=1, bounces=0)


def panorama(kind: str, width: int = 48, height: int = 24, **more: object) -> Camera:
    """A camera that is turned and stands off the origin, whose picture has everything its lens sees."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    matrix[:3, 0] *= np.sign(np.linalg.det(matrix[:3, :3]))
    matrix[:3, 3] = 0.2, -0.1, 0.15
    fx, fy = {
        "equirectangular": (width / (2 * math.pi), height / math.pi),
        "fisheye": (width / 4.0, height / 4.0),
        "equisolid": (width / 3.2, height / 3.2),
    }[kind]
    fields = {"fov": 4.0 if kind == "fisheye" else 3.6} if kind != "equirectangular" else {}
    return Camera(matrix, width, height, fx, fy, width / 2, height / 2, panorama=kind, **(fields | more))  # type: ignore[arg-type]


KINDS = ("equirectangular", "fisheye", "equisolid")
LENSES = {
    **{kind: {} for kind in KINDS},
    "polynomial": {"lens": (0.0, 1.1, -0.05, 0.02, -0.004)},
}


@pytest.mark.parametrize("name", LENSES)
def test_projection_inverts_the_ray(name: str) -> None:
    p = camera_parameters(panorama(name if name in KINDS else "fisheye", 100, 70, **LENSES[name]), SETTINGS, 0)
    met = 0
    for x, y, depth in np.random.default_rng(0).uniform((0.5, 0.5, 0.5), (99, 69, 60), (80, 3)):
        ray = np.array(camera_ray(p, x, y))
        if not ray[3:].any():
            continue
        met += 1
        assert np.linalg.norm(ray[3:]) == pytest.approx(1)
        assert np.allclose(project(p, *(ray[:3] + depth * ray[3:])), (x, y, depth), atol=1e-6)
    assert met > 40


def test_directions_are_those_of_the_formulas() -> None:
    look = replace(panorama("equirectangular"), matrix_world=np.eye(4))
    p = camera_parameters(look, SETTINGS, 0)
    for (px, py), expected in (
        ((24, 12), (0, 0, -1)), ((36, 12), (1, 0, 0)), ((48, 12), (0, 0, 1)), ((24, 0), (0, 1, 0)),
    ):  # fmt: skip
        assert np.allclose(camera_ray(p, px, py)[3:], expected, atol=1e-12)
    for kind, edge in (("fisheye", 2.0), ("equisolid", 2 * math.sin(0.9))):
        eye = replace(panorama(kind, 64, 64), matrix_world=np.eye(4))
        p = camera_parameters(eye, SETTINGS, 0)
        half = 0.5 * eye.fov
        x = 32 + (edge - 1e-9) * eye.fx
        assert np.allclose(camera_ray(p, x, 32)[3:], (math.sin(half), 0, -math.cos(half)), atol=1e-6)
        assert not np.any(camera_ray(p, 32 + (edge + 1e-6) * eye.fx, 32)[3:])
        assert np.allclose(camera_ray(p, 32, 32)[3:], (0, 0, -1))


@pytest.mark.parametrize(
    "change",
    [
        {"fov": 0.0}, {"fov": math.nan}, {"orthographic": True}, {"lens": (0.1, 0.0, 0.0, 0.0, 0.0)},
        {"lens": (0.0, math.inf, 0.0, 0.0, 0.0)}, {"panorama": "mirror ball"}, {"clip_start": 0.0},
    ],
)  # fmt: skip
def test_a_lens_without_a_picture_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="camera"):
        check_camera(replace(panorama("fisheye"), **change))


def test_surfels_are_blended_as_all_of_them_on_every_ray() -> None:
    posed = cloud(400, opacity=(0.2, 0.9))
    tree = SurfelBVH()
    tree.update(posed)
    camera = panorama("equirectangular", 24, 12)
    p = camera_parameters(camera, SETTINGS, 0)
    samples = blend_along_rays(SurfelRays.of(tree, camera, p), 0, 12)
    rays = np.array([sample_ray(p, pixel, 0) for pixel in range(24 * 12)], np.float32)
    expected = blend_all(posed, rays[:, :3], rays[:, 3:], camera.clip_start, camera.clip_end, gap=3.0)
    alpha, met = samples.alpha.ravel(), expected.object_index >= 0
    assert np.abs(alpha - (1 - expected.through) * met).max() < 1e-3 and met.sum() > 200
    found = samples.surface.reshape(-1, samples.surface.shape[-1])
    same = met & (samples.object_index.ravel() == expected.object_index)
    assert same.sum() > 0.98 * met.sum()
    assert np.quantile(np.abs(samples.depth.ravel() - expected.depth)[same], 0.98) < 1e-3
    assert np.quantile(np.abs(found[:, ALBEDO : ALBEDO + 3] - expected.albedo)[same], 0.98) < 1e-3
    assert np.quantile(np.abs(found[:, NORMAL : NORMAL + 3] - expected.normal)[same], 0.98) < 1e-2
    tree.close()


@pytest.mark.parametrize("kind", KINDS)
def test_from_inside_a_ball_surfels_and_mesh_look_alike(kind: str) -> None:
    """Every direction that the lens sees ends on the unit sphere; light is that of the mesh."""
    scene, posed, tree = scene_of(sphere_mesh(4)), sphere_surfels(1.0, 6000), SurfelBVH()
    tree.update(posed)
    light = EnvironmentLight(World(colour=(0.0, 0.0, 0.0)))
    lamp = np.eye(4)
    lamp[:3, 3] = 0.3, 0.2, 0.0
    lights = Lights([Light("lamp", "point", lamp, power=20.0)])
    names = ("Combined", "Position", "Depth", "Coverage", "Normal")
    camera, settings = panorama(kind), replace(SETTINGS, subpixel_samples=4, samples=16)
    seen = {}
    for sees in ("surfels", "mesh"):
        frame = Frame(
            0, camera, [ObjectState("ball", "key")], settings=replace(settings, camera_sees=sees), passes=names
        )
        prepared = PreparedScene(scene, light, posed, lights, seen_surfels=tree if sees == "surfels" else None)
        seen[sees] = pipeline.render(prepared, frame)
    inside = seen["mesh"]["Coverage"][..., 0] == 1
    assert inside.mean() > (0.99 if kind == "equirectangular" else 0.5)
    for passes in seen.values():
        place = passes["Position"][inside]
        assert np.abs(np.linalg.norm(place, axis=-1) - 1).max() < 0.02
        far = np.linalg.norm(place - camera.matrix_world[:3, 3], axis=-1)
        assert np.abs(passes["Depth"][inside][:, 0] - far).max() < 0.02
        assert ((passes["Normal"][inside] * place).sum(-1) < -0.9).all()
    cover = seen["surfels"]["Coverage"][inside]
    assert cover.min() > 0.9  # of opacity 0.9, most of them one behind the other
    shine, lit = seen["surfels"]["Combined"][inside][:, :3] / cover, seen["mesh"]["Combined"][inside][:, :3]
    assert np.abs(shine / lit - 1).mean() < 0.03
    assert (seen["surfels"]["Coverage"][..., 0][seen["mesh"]["Coverage"][..., 0] == 0] == 0).all()
    tree.close()


def ball_session(folder: Path) -> tuple[Session, str]:
    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.6), np.full(n, 0.5), np.zeros(n))
    surfels, binding, _ = attach(mesh)
    write_asset(folder / "ball.drgs", Asset(surfels, mesh, binding))
    session = Session()
    return session, session.load_asset(folder / "ball.drgs")


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
def test_region_strips_and_order_do_not_change_a_bit(
    tmp_path: Path, rays_see: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ball stands beside a panoramic camera; an ordinary camera before, and a hidden ball, change nothing."""
    session, key = ball_session(tmp_path)
    place = np.eye(4)
    place[:3, 3] = 1.5, 0.5, 0.4
    body = ObjectState("ball", key, place)
    hidden = ObjectState(
        "hidden", key, np.diag([0.1, 0.1, 0.1, 1.0]), visibility=Visibility(camera=False, shadow=False)
    )
    settings = replace(SETTINGS, rays_see=rays_see, filter_width=1.5)
    lamp = np.eye(4)
    lamp[:3, 3] = 0, 0, 3
    camera, lights = panorama("equirectangular", 64, 32), [Light("lamp", "point", lamp, power=40.0, radius=0.2)]
    names = ("Combined", "Depth", "IndexOB", "CryptoObject00")
    frame = Frame(0, camera, [body, hidden], settings=settings, passes=names, lights=lights)
    whole = session.render(frame)
    assert 0.02 < (whole["Depth"] < 1e9).mean() < 0.5
    flat = Camera(camera.matrix_world, 16, 16, 8.0, 8.0, 8.0, 8.0)
    before = session.render(replace(frame, camera=flat))
    part = session.render(replace(frame, camera=replace(camera, region=(5, 9, 60, 20))))
    monkeypatch.setattr(pipeline, "strip_height", lambda width, subpixels: 3)
    again = session.render(frame)
    for name in names:
        assert np.array_equal(again[name], whole[name])
        assert np.array_equal(part[name], whole[name][9:20, 5:60])
    monkeypatch.undo()
    assert all(np.array_equal(session.render(replace(frame, camera=flat))[name], before[name]) for name in names)


def test_beyond_a_fisheye_all_is_black_and_opaque_as_in_cycles() -> None:
    light = EnvironmentLight(World(colour=(0.3, 0.5, 0.7)))
    camera = panorama("fisheye", 40, 40, region=(0, 3, 40, 33))
    posed, tree = sphere_surfels(1.0, 10), SurfelBVH()
    for transparent in (False, True):
        settings = replace(SETTINGS, camera_sees="mesh", film_transparent=transparent, subpixel_samples=4)
        scene = scene_of((np.eye(3, dtype=np.float32) + 500, np.array([[0, 1, 2]], np.int32)))
        frame = Frame(0, camera, [ObjectState("far", "key")], settings=settings, passes=("Combined", "Env"))
        combined = pipeline.render(PreparedScene(scene, light, posed), frame)["Combined"]
        y, x = np.mgrid[3:33, 0:40] + 0.5
        far = np.hypot(x - 20, y - 20)
        assert np.allclose(combined[far > 21], (0, 0, 0, 1)) and (far > 21).any()
        inside = (0, 0, 0, 0) if transparent else (0.3, 0.5, 0.7, 1)
        assert np.allclose(combined[far < 19], inside, atol=1e-6)
    tree.close()


@pytest.mark.parametrize("alpha", [1.0, 0.5])
def test_beyond_a_fisheye_nothing_is_met(alpha: float) -> None:
    """From inside a ball, also one that is half there."""
    scene = TraceScene()
    materials = [Material("Veil", alpha=alpha)]
    mesh = MeshState("Ball", *sphere_mesh(2), np.diag((9, 9, 9, 1))[None], np.zeros(1, np.int32), materials=materials)
    scene.update([], [mesh])
    camera = panorama("fisheye", 40, 40)
    parameters = camera_parameters(camera, SETTINGS, 1)
    owner = trace_camera(scene, parameters, 0, 0, (40, 40, 1), ORDINARY).owner[..., 0]
    y, x = np.mgrid[0:40, 0:40] + 0.5
    far = np.hypot(x - 20, y - 20)
    assert (owner[far > 21] == -1).all() and (owner[far < 19] == 0).mean() > 0.8 * alpha
    scene.close()


def test_motion_goes_the_shorter_way_round(tmp_path: Path) -> None:
    """Behind the camera, where the picture begins and ends, a mesh crosses the seam; a still one does not move."""
    session, _ = ball_session(tmp_path)
    camera = replace(panorama("equirectangular", 90, 45), matrix_world=np.eye(4))
    vertices, faces = sphere_mesh(2)
    now, then = np.eye(4), np.eye(4)
    now[:3, 3], then[:3, 3] = (0.1, 0, 4), (-0.3, 0, 4)
    mesh = MeshState("ball", vertices, faces, now[None], np.zeros(1, np.int32))
    still = MeshState(
        "still",
        vertices,
        faces,
        np.eye(4)[None] + [[[0, 0, 0, 0]] * 2 + [[0, 0, 0, -5]] + [[0] * 4]],
        np.zeros(1, np.int32),
    )
    step = MotionStep(camera, [], [Pose("ball", then[None]), None])
    frame = Frame(0, camera, [], settings=SETTINGS, passes=("Vector", "Depth"), meshes=[mesh, still], previous=step)
    passes = session.render(frame)
    back = passes["Depth"][..., 0] < 1e9
    back[:, 20:70] = False
    # Behind, x grows to the left of the picture's ends: 0.4 m at 3 to 4 m and 14.3 pixels per radian.
    assert (
        back.any() and (np.abs(passes["Vector"][back]).max() < 3) and (np.abs(passes["Vector"][back][:, 0]) > 0.5).all()
    )
    front = passes["Depth"][..., 0] < 1e9
    front[:, :20] = front[:, 70:] = False
    assert front.any() and np.abs(passes["Vector"][front]).max() == 0


def test_coarse_picture_frame_file_and_metadata_keep_the_lens() -> None:
    camera = panorama("fisheye", 64, 40, lens=(0.0, 1.0, 0.1, 0.0, 0.0), region=(8, 4, 40, 36))
    frame = Frame(0, camera, [], settings=SETTINGS)
    small = coarse(frame, 4).camera
    p, q = camera_parameters(small, SETTINGS, 0), camera_parameters(camera, SETTINGS, 0)
    assert np.allclose(camera_ray(p, 3, 2), camera_ray(q, 8 + 12, 4 + 8))
    back = decode_frame(*encode_frame(frame)).camera
    assert (back.panorama, back.fov, back.lens) == (camera.panorama, camera.fov, camera.lens)
    text = noisy_frames.camera_metadata(frame)["camera"]
    assert np.array_equal(noisy_frames._parameters(text)[0][9:16], camera_parameters(camera, RenderSettings(), 0)[9:16])
    assert np.array_equal(noisy_frames._parameters(text)[0][25:], camera_parameters(camera, RenderSettings(), 0)[25:])
    assert (
        len(json.loads(noisy_frames.camera_metadata(replace(frame, camera=replace(camera, panorama="")))["camera"]))
        == 3
    )


@pytest.mark.parametrize(
    ("keys", "rest"),
    [
        ({"panorama": "equirectangular"}, {"fx": 64 / (2 * math.pi), "fy": 32 / math.pi, "fov": 2 * math.pi}),
        ({"panorama": "equirectangular", "fx": 30, "fy": 31, "cx": 7}, {"fx": 30, "fy": 31, "cx": 7}),
        ({"panorama": "fisheye"}, {"fx": 64 / math.pi, "fov": math.pi}),
        (
            {"panorama": "fisheye", "fov": 90, "lens": [0, 1, 0, 0.1, 0]},
            {"fov": math.pi / 2, "lens": (0, 1, 0, 0.1, 0)},
        ),
        ({"panorama": "equisolid", "fov": 180}, {"fx": 64 / (4 * math.sin(math.pi / 4))}),
    ],
)
def test_camera_files_have_panoramas(tmp_path: Path, keys: dict[str, object], rest: dict[str, float]) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"matrix_world": np.eye(4).tolist(), "width": 64, "height": 32} | keys))
    camera = read_camera(path)
    check_camera(camera)
    assert camera.panorama == keys["panorama"]
    for name, value in rest.items():
        assert getattr(camera, name) == pytest.approx(value)


@pytest.mark.parametrize(
    "keys",
    [
        {"panorama": "cube"}, {"panorama": 3}, {"panorama": "fisheye", "fov_x": 40}, {"fov": 90, "fov_x": 40},
        {"panorama": "fisheye", "orthographic": True}, {"panorama": "equisolid", "lens": [0, 1, 0, 0, 0]},
        {"panorama": "fisheye", "lens": [0, 1]}, {"panorama": "fisheye", "fov": 500},
    ],
)  # fmt: skip
def test_camera_files_name_what_does_not_fit(tmp_path: Path, keys: dict[str, object]) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"matrix_world": np.eye(4).tolist(), "width": 64, "height": 32} | keys))
    with pytest.raises(UsageError, match=r"camera\.json"):
        read_camera(path)
