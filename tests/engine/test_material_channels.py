"""Objects whose assets have emission, opacity and other optional channels: in pictures, passes and rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pictures import assert_same_bits, with_meshes
from test_motion import moving_frame

from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Mesh, neutral_values
from drgs_blender.core.cryptomatte import name_hash
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import Adjustment, Frame, Layer, Light, MeshState, ObjectState, Visibility, World
from drgs_blender.core.materials import Material, Texture
from drgs_blender.deform.attach import attach
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.engine.level_of_detail import Budget
from drgs_blender.engine.session import Session

RADIANCE = (3.0, 1.5, 0.25)


@pytest.fixture(scope="module")
def save(tmp_path_factory: pytest.TempPathFactory, mesh: Mesh) -> Callable[..., Path]:
    """Function that saves the ball with constant channels, attached again."""

    def make(**channels: object) -> Path:
        n = len(mesh.vertices)
        full = {k: np.full((n, 3) if k == "emission" else n, v, np.float32) for k, v in channels.items()}
        own = replace(mesh, **full)
        surfels, binding, _ = attach(own, density=12.0)
        path = tmp_path_factory.mktemp("channels") / "ball.drgs"
        write_asset(path, Asset(surfels, own, binding))
        return path

    return make


@pytest.fixture(scope="module")
def glowing_path(save) -> Path:
    return save(emission=RADIANCE)


@pytest.fixture(scope="module")
def veil_path(save) -> Path:
    return save(opacity=0.25)


def use(frame: Frame, path: Path) -> Session:
    """A session that knows the asset, which the frame's object gets."""
    frame.objects[0].asset = str(path.resolve())
    made = Session()
    made.load_asset(path)
    return made


@pytest.mark.parametrize(
    "settings", [{}, {"camera_sees": "mesh"}, {"rays_see": "surfels"}, {"panorama": "equirectangular"}], ids=str
)
def test_the_camera_sees_what_is_emitted(glowing_path, make_frame, settings) -> None:
    panorama = settings.pop("panorama", "")
    frame = make_frame(**settings)
    if panorama:
        camera = replace(frame.camera, panorama=panorama, fx=40.0, fy=40.0)
        frame.camera = camera
    frame.passes = ("Combined", "Emit", "Coverage")
    frame.world = World(strength=0.0)
    picture = use(frame, glowing_path).render(frame)
    share = picture["Coverage"]
    assert (share > 0.9).sum() > 100
    np.testing.assert_allclose(picture["Emit"], share * RADIANCE, rtol=1e-4, atol=1e-5)


def lit_floor(frame: Frame, session: Session) -> np.ndarray:
    """Mean light on the floor, under a black world."""
    with_meshes(frame)
    frame.meshes = frame.meshes[:1]
    frame.meshes[0].pass_indices = np.int32([9])
    frame.passes = ("DiffDir", "IndexOB")
    frame.world = World(strength=0.0)
    picture = session.render(frame)
    return picture["DiffDir"][picture["IndexOB"][..., 0] == 9].mean(axis=0)


def test_emission_lights_others_as_a_mesh_of_that_material_does(glowing_path, asset_path, make_frame) -> None:
    frame = make_frame(samples=32, camera_sees="mesh")
    ours = lit_floor(frame, use(frame, glowing_path))
    other = make_frame(samples=32, camera_sees="mesh")
    session = use(other, asset_path)
    made = with_meshes(make_frame()).meshes[0]
    asset = read_asset(asset_path)
    lamp = replace(
        made, name="Lamp", vertices=other.objects[0].vertices, faces=asset.mesh.faces, matrices=np.eye(4)[None]
    )
    lamp.materials = [Material("Lamp", emission=RADIANCE)]
    other.objects[0].visibility = Visibility(camera=False, diffuse=False, glossy=False, shadow=False)
    with_meshes(other)
    other.meshes = [other.meshes[0], lamp]
    other.meshes[0].pass_indices, lamp.pass_indices = np.int32([9]), np.int32([1])
    other.passes, other.world = ("DiffDir", "IndexOB"), World(strength=0.0)
    picture = session.render(other)
    theirs = picture["DiffDir"][picture["IndexOB"][..., 0] == 9].mean(axis=0)
    assert theirs.min() > 0.001
    np.testing.assert_allclose(ours, theirs, rtol=0.02)


@pytest.mark.parametrize("settings", [{}, {"camera_sees": "mesh"}, {"rays_see": "surfels"}], ids=str)
def test_opacity_hides_its_share_of_what_is_behind(veil_path, make_frame, settings) -> None:
    """A closed surface is passed twice."""
    frame = make_frame(samples=22, size=(24, 18), **settings)
    frame.settings.subpixel_samples = 64
    frame.passes = ("Combined", "CryptoObject00")
    picture = use(frame, veil_path).render(frame)
    middle = picture["Combined"][6:12, 9:15, 3]
    assert middle.mean() == pytest.approx(1 - 0.75**2, abs=0.01)
    matte = picture["CryptoObject00"][6:12, 9:15]
    assert (matte[..., 0] == np.array(name_hash("Ball"), np.uint32).view(np.float32)).all()
    np.testing.assert_allclose(matte[..., 1], middle, atol=1e-5)


def test_shadows_are_as_thin_as_what_throws_them(save, make_frame) -> None:
    def shadow(path: Path) -> float:
        frame = make_frame(samples=40, size=(24, 18))
        with_meshes(frame)
        frame.meshes = frame.meshes[:1]
        frame.objects[0].visibility = Visibility(camera=False, diffuse=False, glossy=False)
        frame.passes, frame.settings.bounces = ("DiffDir",), 0
        light = np.zeros((16, 32, 3), np.float32)
        light[0] = 50.0  # straight above
        frame.world = World(light)
        return float(use(frame, path).render(frame)["DiffDir"].mean(axis=2)[-1, 12])

    none, half, all_of_it = (shadow(save(opacity=share)) for share in (0.0, 0.25, 1.0))
    assert all_of_it < 0.3 * none
    assert half == pytest.approx(all_of_it + 0.75**2 * (none - all_of_it), rel=0.06)


def test_neutral_channels_change_no_bit(save, make_frame) -> None:
    plain = save()
    neutral = save(emission=0.0, opacity=1.0, specular=0.5, coat=0.0)
    for settings in ({}, {"rays_see": "surfels"}):
        frame = make_frame(bounces=1, **settings)
        a = use(frame, plain).render(frame)
        b = use(frame, neutral).render(frame)
        assert_same_bits(a, b)
        assert not b.warnings


def test_a_fade_is_opacity(veil_path, save, make_frame) -> None:
    frame = make_frame()
    painted = use(frame, veil_path).render(frame)
    frame.objects[0].adjustment = Adjustment(opacity=0.25)
    faded = use(frame, save()).render(frame)
    assert_same_bits(painted, faded)


def test_painted_emission_takes_the_place_of_the_assets(glowing_path, make_frame) -> None:
    frame = make_frame()
    frame.passes = ("Emit", "Coverage")
    session = use(frame, glowing_path)
    n = len(read_asset(glowing_path).mesh.vertices)
    frame.objects[0].emission = np.full((n, 3), 0.5, np.float32)
    picture = session.render(frame)
    np.testing.assert_allclose(picture["Emit"], picture["Coverage"] * np.full(3, 0.5), rtol=1e-4, atol=1e-6)
    frame.objects[0].adjustment = Adjustment(emission=4.0)
    brighter = session.render(frame)
    np.testing.assert_allclose(brighter["Emit"], 4 * picture["Emit"], rtol=1e-4, atol=1e-6)
    frame.objects[0].emission = None
    frame.objects[0].adjustment = Adjustment(emission=0.0)
    assert not session.render(frame)["Emit"].any()


def test_bad_channels_are_named(save, make_frame) -> None:
    path = save()
    frame = make_frame()
    frame.passes = ("Combined", "Emit")
    session = use(frame, path)
    n = len(read_asset(path).mesh.vertices)
    emission = np.full((n, 3), np.nan, np.float32)
    emission[0] = -1.0
    frame.objects[0].emission = emission
    picture = session.render(frame)
    assert any("emission are not numbers" in text for text in picture.warnings)
    assert not picture["Emit"].any() and np.isfinite(picture["Combined"]).all()
    frame.objects[0].emission = np.zeros((n + 1, 3), np.float32)
    with pytest.raises(AssetError, match="emission"):
        session.render(frame)


def test_what_is_not_shown_or_otherwise_is_said(save, asset_path, make_frame, tmp_path) -> None:
    varnished = save(specular=1.0, coat=0.5)

    def said(path: Path, **settings: object) -> list[str]:
        frame = make_frame(**settings)
        return use(frame, path).render(frame).warnings

    assert said(varnished, camera_sees="mesh") == []
    assert said(varnished) == ["Ball: its specular and coat on surfels are taken from the mesh next to them"]
    only = "its specular and coat are shown to the camera alone; other rays meet surfels without"
    assert said(varnished, camera_sees="mesh", rays_see="surfels") == [f"Ball: {only}"]
    (told,) = said(varnished, shading_model="paper")
    assert told == "Ball: the shading model Cook-Torrance leaves out its specular and coat. Choose Principled"
    told = "Ball: part of it is transparent (such as glass), so the camera sees its mesh instead of its surfels"
    assert said(save(opacity=0.5)) == [told]
    asset = read_asset(asset_path)
    own = replace(asset.surfels, coat=np.ones(len(asset.surfels), np.float32))
    write_asset(tmp_path / "bare.drgs", Asset(own, Mesh.empty()))
    frame = make_frame(rays_see="surfels")
    frame.objects[0].vertices = None
    told = use(frame, tmp_path / "bare.drgs").render(frame).warnings
    assert "Ball: has no mesh, so its coat is not shown" in told


@pytest.mark.parametrize("varied", [False, True])
def test_specular_and_coat_are_those_of_a_mesh_of_that_material(save, mesh, make_frame, varied) -> None:
    """Bit by bit, where an ordinary mesh has the same values at its vertices."""
    frame = make_frame(camera_sees="mesh", samples=8, bounces=1)
    frame.passes = ("Combined", "GlossCol", "GlossDir", "DiffDir")
    n = len(mesh.vertices)
    specular = np.linspace(0, 1, n, dtype=np.float32) if varied else np.full(n, 0.9, np.float32)
    coat = specular[::-1] if varied else np.full(n, 0.5, np.float32)
    path = save(specular=specular, coat=coat)
    ours = use(frame, path).render(frame)
    other = make_frame(camera_sees="mesh", samples=8, bounces=1)
    other.passes = frame.passes

    def layer(name: str, *values: np.ndarray) -> Layer:
        corners = np.ones((len(mesh.faces), 3, 4), np.float32)
        corners[..., : len(values)] = np.stack(values, -1)[mesh.faces]
        return Layer(name, corners)

    layers = [layer("colour", *mesh.albedo.T), layer("lobes", mesh.roughness, mesh.metallic, specular, coat)]
    red, green, blue, alpha = (Texture("", c, layer="lobes") for c in "rgba")
    paint = Material(
        "Paint", (1, 1, 1), 1.0, 1.0, base_colour_texture=Texture("", layer="colour"), roughness_texture=red,
        metallic_texture=green, specular_level=1.0, coat=1.0, textures={"specular_level": blue, "coat": alpha},
    )  # fmt: skip
    ball = MeshState(
        "Ball", mesh.vertices, mesh.faces, np.eye(4)[None], np.zeros(1, np.int32), materials=[paint], layers=layers,
    )  # fmt: skip
    other.objects, other.meshes = [], [ball]
    theirs = Session().render(other)
    for name in frame.passes:
        np.testing.assert_allclose(ours[name], theirs[name], atol=2e-5, err_msg=name)
    plain = make_frame(camera_sees="mesh", samples=8, bounces=1)
    plain.passes = frame.passes
    without = use(plain, save()).render(plain)
    assert np.abs(ours["GlossCol"] - without["GlossCol"]).max() > 0.02


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
def test_surfels_have_the_lobes_of_their_mesh_and_their_own_colours(save, make_frame, rays_see) -> None:
    """Red surfels on a mesh of other colours stay red under a coat, which adds what it adds to the mesh."""

    def pictures(path: Path, **settings: object) -> dict[str, np.ndarray]:
        frame = make_frame(samples=16, bounces=0, **settings)
        frame.passes = ("Combined", "GlossCol", "DiffCol", "GlossDir")
        return use(frame, path).render(frame)

    def red(path: Path, *parts: str) -> Path:
        asset = read_asset(path)
        for part in parts:
            own = getattr(asset, part)
            setattr(asset, part, replace(own, albedo=np.zeros_like(own.albedo) + np.float32([0.9, 0, 0])))
        write_asset(path, asset)
        return path

    bare, coated = red(save(), "surfels"), red(save(coat=1.0), "surfels")
    before, after = pictures(bare, rays_see=rays_see), pictures(coated, rays_see=rays_see)
    bare, coated = red(bare, "mesh"), red(coated, "mesh")
    assert after["DiffCol"][..., 1:].max() == 0 and after["DiffCol"][..., 0].max() > 0.3
    of_mesh = [pictures(p, camera_sees="mesh")["GlossCol"] for p in (bare, coated)]
    middle = slice(12, 24), slice(16, 32)  # surfels overhang the silhouette
    gain = (after["GlossCol"] - before["GlossCol"])[middle].mean()
    assert gain == pytest.approx((of_mesh[1] - of_mesh[0])[middle].mean(), rel=0.08)
    assert after["GlossDir"].mean() > 1.02 * before["GlossDir"].mean()
    assert gain > 0.01


def test_painted_lobes_take_the_place_of_the_assets(save, mesh, make_frame) -> None:
    n = len(mesh.vertices)
    frame = make_frame(camera_sees="mesh")
    expected = use(frame, save(coat=0.5, specular=0.2)).render(frame)
    other = make_frame(camera_sees="mesh")
    session = use(other, save(coat=1.0))
    other.objects[0].coat, other.objects[0].specular = np.full(n, 0.5, np.float32), np.full(n, 0.2, np.float32)
    assert_same_bits(session.render(other), expected)
    other.objects[0].coat, other.objects[0].specular = np.zeros(n, np.float32), np.full(n, 0.5, np.float32)
    neutral = session.render(other)
    plain = make_frame(camera_sees="mesh")
    assert_same_bits(neutral, use(plain, save()).render(plain))


def test_a_surface_of_an_object_moves_with_it(save, make_frame) -> None:
    """Motion of what stands for an object is the object's own."""
    frame, _ = moving_frame(make_frame, camera_sees="mesh")
    plain = use(frame, save()).render(frame)
    moved = use(frame, save(emission=0.01)).render(frame)
    for name in ("Vector", "Previous Position", "IndexOB", "Depth"):
        np.testing.assert_allclose(moved[name], plain[name], atol=1e-4, err_msg=name)


def test_a_holdout_stays_a_hole_where_it_is_dense(veil_path, make_frame) -> None:
    frame = make_frame(size=(24, 18))
    frame.settings.subpixel_samples = 64
    frame.objects[0].visibility = Visibility(holdout=True)
    frame.settings.film_transparent = False
    frame.world = World(colour=(1.0, 1.0, 1.0))
    picture = use(frame, veil_path).render(frame)["Combined"][6:12, 9:15, :3]
    assert picture.mean() == pytest.approx(0.75**2, abs=0.01)


def test_the_viewport_sees_it_too(glowing_path, make_frame) -> None:
    frame = make_frame(size=(96, 72))
    frame.passes = ("Combined", "Emit")
    session = use(frame, glowing_path)
    first = session.view("v", frame)
    assert first["Emit"].max() == pytest.approx(RADIANCE[0], rel=1e-3)
    while first.statistics["view.fraction"] < 1:
        first = session.refine("v")
    assert_same_bits(first, session.render(frame))


def test_neutral_values() -> None:
    assert neutral_values("emission", 2).tolist() == [[0, 0, 0], [0, 0, 0]]
    assert neutral_values("opacity", 2).tolist() == [1, 1]
    assert ObjectState("a", "b").emission is None


@pytest.mark.slow  # its kernels take a minute to compile
def test_a_device_draws_the_same(save, make_frame, monkeypatch) -> None:
    """Warp's processor as the card."""
    pytest.importorskip("warp", reason="warp-lang is not installed")
    monkeypatch.setattr("drgs_blender.render.gpu.select_backend.name_of", lambda device: "cpu")
    for path in (save(emission=RADIANCE), save(emission=RADIANCE, opacity=0.5)):
        pictures = []
        for device in ("cpu", "cuda"):
            frame = make_frame(size=(24, 18), device=device)
            frame.passes = ("Combined", "Emit")
            pictures.append(use(frame, path).render(frame))
        np.testing.assert_allclose(pictures[1]["Emit"], pictures[0]["Emit"], atol=0.02)
        assert np.abs(pictures[1]["Combined"] - pictures[0]["Combined"]).mean() < 0.01


def test_surfels_without_a_mesh_emit_to_the_camera_alone(asset_path, make_frame, tmp_path) -> None:
    asset = read_asset(asset_path)
    own = replace(asset.surfels, emission=np.tile(np.float32(RADIANCE), (len(asset.surfels), 1)))
    write_asset(tmp_path / "bare.drgs", Asset(own, Mesh.empty()))
    frame = make_frame(rays_see="surfels")
    frame.objects[0].vertices = None
    frame.passes = ("Emit", "Coverage")
    picture = use(frame, tmp_path / "bare.drgs").render(frame)
    np.testing.assert_allclose(picture["Emit"], picture["Coverage"] * RADIANCE, rtol=1e-4, atol=1e-5)
    assert any("seen by the camera alone" in text for text in picture.warnings)


def test_a_coarse_view_has_the_emission_of_its_surfels(glowing_path, make_frame) -> None:
    frame = make_frame()
    session = use(frame, glowing_path)
    for pixel in (1, 4, 100):
        budget = Budget(frame.camera, pixel, 500)
        assert len(session._scene_cache.pose(frame, budget=budget)) == len(session._scene_cache.emission)
        assert len(session._scene_cache.emission) < len(session.asset(frame.objects[0].asset).surfels)


def test_linked_lights_know_the_object_behind_its_mesh(glowing_path, make_frame) -> None:
    """A lamp that shines on nothing but the floor lights no object that emits."""
    frame = with_meshes(make_frame(size=(24, 18)))
    lamp = Light("Lamp", "area", np.eye(4), power=200.0, size_x=1.0, size_y=1.0, receivers=0)
    lamp.matrix_world[2, 3] = 3.0
    frame.lights, frame.world = [lamp], World(strength=0.0)
    frame.meshes[0].visibility.lit_by = 1
    frame.passes = ("DiffDir", "IndexOB")
    frame.objects[0].pass_index = 3
    frame.settings.camera_sees = "mesh"
    session = use(frame, glowing_path)
    picture = session.render(frame)
    index = picture["IndexOB"][..., 0]
    floor = picture["DiffDir"][index == 5].mean()
    ball = picture["DiffDir"][index == 3].mean()
    frame.objects[0].visibility.lit_by = 1
    lit = session.render(frame)["DiffDir"][index == 3].mean()
    assert floor > 0.1 and lit > 1.05 * ball


def test_what_an_object_emits_shines_on_all_beside_linked_lights(glowing_path, make_frame) -> None:
    frame = make_frame(samples=32, camera_sees="mesh")
    session = use(frame, glowing_path)
    alone = lit_floor(frame, session)
    lamp = Light("Lamp", "area", np.eye(4), power=1e-6, size_x=1.0, size_y=1.0, receivers=0)
    lamp.matrix_world[2, 3] = 3.0
    frame.lights = [lamp]
    np.testing.assert_allclose(lit_floor(frame, session), alone, rtol=0.05)


def test_surfels_are_not_posed_again_because_the_camera_sees_the_mesh(glowing_path, make_frame, monkeypatch) -> None:
    """Coarse pictures of viewports show meshes, those after them surfels."""
    poses, pose = [], MeshDriven.pose
    monkeypatch.setattr(MeshDriven, "pose", lambda *given, **options: poses.append(1) or pose(*given, **options))
    frame = make_frame()
    session = use(frame, glowing_path)
    first = session.render(frame)
    session.render(replace(frame, settings=replace(frame.settings, camera_sees="mesh")))
    again = session.render(frame)
    assert_same_bits(first, again)
    assert len(poses) == 1


def test_what_is_torn_neither_emits_nor_hides(save, make_frame) -> None:
    path = save(emission=RADIANCE, opacity=0.5)
    frame = make_frame()
    frame.passes = ("Combined", "Emit")
    session = use(frame, path)
    frame.objects[0].vertices[:, 2] *= 40.0
    frame.objects[0].tear = 1e-3
    torn = session.render(frame)
    frame.objects[0].tear = 0.0
    whole = session.render(frame)
    assert whole["Emit"].any() and torn["Emit"].sum() < whole["Emit"].sum()
    assert np.isfinite(torn["Combined"]).all()
    frame.objects[0].vertices = np.random.default_rng(0).permutation(frame.objects[0].vertices) * np.float32(100)
    frame.objects[0].tear = 1e-6
    assert np.isfinite(session.render(frame)["Combined"]).all()
