"""Images of assets that are painted over: what vertices, surfels, rays and files then have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import look_along_y
from test_mesh_textures import png, seen, textured, uniform  # noqa: F401 - a fixture

from drgs_blender.build.make import make_asset
from drgs_blender.core.asset import Asset
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.textures import ALBEDO, EXTENSIONS, OPACITY, ROUGHNESS
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.frame import Adjustment, Frame, ObjectState, RenderSettings, World
from drgs_blender.core.materials import Image
from drgs_blender.core.repainted_textures import carried_paint, pictures_of, repainted
from drgs_blender.engine.loaded_assets import LoadedAsset
from drgs_blender.engine.repainted_assets import RepaintedAssets
from drgs_blender.engine.session import Session
from drgs_blender.formats.files import Image as FileImage
from drgs_blender.formats.files import MaterialFile, MeshFile

RED = srgb_to_linear(np.array([255, 0, 0]) / 255)


def with_surfels(size: int = 64) -> tuple[Asset, np.ndarray]:
    """A square of 2 m made from a file, its image of noise, and that image."""
    rng = np.random.default_rng(2)
    noise = np.kron(rng.integers(40, 215, (8, 8, 3), np.uint8), np.ones((size // 8, size // 8, 1), np.uint8))
    points = np.array([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], np.float32)
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    uvs = (points[faces][..., [0, 2]] + 1) / 2
    file = MeshFile(
        points, faces, corner_uvs=uvs, face_material=np.zeros(2, np.int32),
        materials=[MaterialFile("paint", base_colour=(1.0, 1.0, 1.0), base_colour_image=FileImage(noise, srgb=True))],
    )  # fmt: skip
    return make_asset(file, up="z", density=40.0), noise


def painted(asset: Asset, before: np.ndarray, now: np.ndarray) -> Asset:
    textures = asset.mesh.textures
    assert textures is not None
    (name,) = textures.images
    pictures = [pictures_of(textures, [Image(name, pixels, "srgb")]) for pixels in (before, now)]
    return repainted(asset, *pictures, {(name, True): png(now)})


def test_surfels_and_vertices_under_the_brush_take_its_colour_and_others_keep_theirs() -> None:
    """Half of the image is painted red: well inside all is red, well outside all is as it was, to the bit."""
    asset, noise = with_surfels()
    now = noise.copy()
    now[:, 32:] = 255, 0, 0
    made = painted(asset, noise, now)
    for new, own, place in (
        (made.surfels, asset.surfels, asset.surfels.centre), (made.mesh, asset.mesh, asset.mesh.vertices)
    ):  # fmt: skip
        x = place[:, 0]
        inside, outside = (x > 0.2) & (x < 0.8), (x > -0.8) & (x < -0.2)  # the picture repeats at its edges
        assert inside.sum() > 10 and outside.sum() > 10
        np.testing.assert_allclose(new.albedo[inside], np.broadcast_to(RED, (int(inside.sum()), 3)), atol=2e-3)
        np.testing.assert_array_equal(new.albedo[outside], own.albedo[outside])
        np.testing.assert_array_equal(new.roughness, own.roughness)
    assert np.abs(asset.surfels.albedo[:, 1]).min() > 0.01, "no surfel was red before"


def test_a_picture_is_painted_where_it_lies() -> None:
    """Red grows with u and green with v: surfels and vertices have the colour of their place."""
    asset, noise = with_surfels()
    ramp = np.arange(64, dtype=np.uint8) * 4
    now = np.zeros_like(noise)
    now[..., 0], now[..., 1] = ramp, ramp[::-1, None]
    made = painted(asset, noise, now)
    for place, albedo in ((asset.surfels.centre, made.surfels.albedo), (asset.mesh.vertices, made.mesh.albedo)):
        inner = np.abs(place[:, [0, 2]]).max(axis=1) < 0.9
        wanted = srgb_to_linear(((place[inner][:, [0, 2]] + 1) / 2 * 64 - 0.5) * 4 / 255)
        assert inner.sum() > 10
        np.testing.assert_allclose(albedo[inner][:, :2], wanted, atol=0.03)
        assert (albedo[inner][:, 2] < 1e-3).all()


def test_rays_meet_what_is_painted(seen) -> None:  # noqa: F811
    asset = textured(uniform((200, 200, 200)))
    colour = np.full((4, 4, 3), (10, 60, 250), np.uint8)
    values, warnings = seen(asset, images=[Image("albedo", colour, "srgb")])
    np.testing.assert_allclose(
        values[..., :3], np.broadcast_to(srgb_to_linear(colour[0, 0] / 255), (24, 24, 3)), atol=2e-3
    )
    np.testing.assert_allclose(values[..., 3], 128 / 255, atol=1e-3)
    assert not [w for w in warnings if "painted" in w]
    values, _ = seen(asset)
    np.testing.assert_allclose(values[..., :3], srgb_to_linear(np.array(200 / 255)), atol=2e-3)


@pytest.mark.parametrize("sees", ["surfels", "mesh"])
def test_pictures_do_not_know_what_was_painted_before(tmp_path: Path, sees: str) -> None:
    """Plain, red, green and plain again in one session: each picture is that of a new one, to the bit."""
    asset, _ = with_surfels()
    write_asset(tmp_path / "square.drgs", asset)
    textures = asset.mesh.textures
    assert textures is not None
    (name,) = textures.images
    colours = [None, (250, 10, 10), (10, 250, 10), None]

    def picture(session: Session, colour: tuple[int, int, int] | None) -> np.ndarray:
        images = [] if colour is None else [Image(name, np.full((8, 8, 3), colour, np.uint8), "srgb")]
        key = session.load_asset(tmp_path / "square.drgs")
        settings = RenderSettings(samples=4, camera_sees=sees, rays_see="mesh", subpixel_samples=1)  # type: ignore[arg-type]
        camera = replace(look_along_y(32, focal=32 / 1.8), orthographic=True)
        frame = Frame(0, camera, [ObjectState("thing", key, images=images)], world=World(), settings=settings)
        return session.render(frame)["Combined"].copy()

    kept = Session()
    pictures = [picture(kept, colour) for colour in colours]
    for found, colour in zip(pictures, colours, strict=True):
        np.testing.assert_array_equal(found, picture(Session(), colour))
    np.testing.assert_array_equal(pictures[0], pictures[3])
    middle = [p[16, 16] for p in pictures]
    assert middle[1][0] > 3 * middle[1][1] and middle[2][1] > 3 * middle[2][0]


def test_two_objects_of_one_asset_are_painted_apart(tmp_path: Path) -> None:
    """In one picture, side by side."""
    asset, _ = with_surfels()
    write_asset(tmp_path / "square.drgs", asset)
    assert asset.mesh.textures is not None
    (name,) = asset.mesh.textures.images
    session, states = Session(), []
    key = session.load_asset(tmp_path / "square.drgs")
    for x, colour in ((-1, (250, 10, 10)), (1, (10, 250, 10))):
        image = Image(name, np.full((8, 8, 3), colour, np.uint8), "srgb")
        matrix = np.eye(4)
        matrix[0, 3] = x
        states.append(ObjectState(f"at {x}", key, images=[image], matrix_world=matrix))
    settings = RenderSettings(samples=4, camera_sees="mesh", rays_see="mesh", subpixel_samples=1)
    camera = replace(look_along_y(32, focal=32 / 3.6), orthographic=True)
    left, right = session.render(Frame(0, camera, states, world=World(), settings=settings))["Combined"][
        16, [8, 24], :3
    ]
    assert left[0] > 3 * left[1] and right[1] > 3 * right[0]


def test_objects_are_painted_one_after_another(seen) -> None:  # noqa: F811
    """Nothing of a painting stays with the asset."""
    asset = textured(uniform((200, 200, 200)))
    for colour in ((250, 10, 10), (10, 250, 10)):
        values, _ = seen(asset, images=[Image("albedo", np.full((2, 2, 3), colour, np.uint8), "srgb")])
        np.testing.assert_allclose(values[0, 0, :3], srgb_to_linear(np.array(colour) / 255), atol=2e-3)


def test_vertices_painted_over_a_painted_image_keep_their_colour(seen) -> None:  # noqa: F811
    """Vertices of the right half are painted blue, the image red: faces with a blue corner are of the vertices."""
    asset = textured(uniform((200, 200, 200)))
    albedo = asset.mesh.albedo.copy()
    albedo[asset.mesh.vertices[:, 0] > 0.3] = 0, 0, 1
    values, _ = seen(asset, albedo=albedo, images=[Image("albedo", np.full((4, 4, 3), (255, 0, 0), np.uint8), "srgb")])
    np.testing.assert_allclose(values[:, :12, 0], 1.0, atol=2e-3)
    np.testing.assert_allclose(values[:, -6:, 2], 1.0, atol=2e-3)
    assert values[:, -6:, 0].max() < 1e-3


def test_adjustments_come_after_paint(seen) -> None:  # noqa: F811
    asset = textured(uniform((200, 200, 200)))
    image = Image("albedo", np.full((4, 4, 3), (255, 255, 255), np.uint8), "srgb")
    values, _ = seen(asset, images=[image], adjustment=Adjustment(tint=(0.5, 1.0, 0.25)))
    np.testing.assert_allclose(values[3, 3, :3], (0.5, 1.0, 0.25), atol=2e-3)


@pytest.mark.parametrize("image", [
    Image("nothing", np.zeros((2, 2, 3), np.uint8), "srgb"), Image("albedo", np.zeros((2, 2, 3), np.float32), "srgb"),
])  # fmt: skip
def test_what_does_not_fit_is_named_and_not_shown(seen, image: Image) -> None:  # noqa: F811
    values, warnings = seen(textured(uniform((200, 200, 200))), images=[image])
    np.testing.assert_allclose(values[..., :3], srgb_to_linear(np.array(200 / 255)), atol=2e-3)
    assert [w for w in warnings if "thing: its painted image" in w and image.name in w]


def test_a_file_that_is_colour_and_data_is_parted_where_one_is_painted() -> None:
    """Albedo and roughness share a file; painted is the colour: the roughness keeps its own."""
    asset = textured({"both": uniform((200, 128, 50))["albedo"]}, slots=(0, 0, -1, -1))
    textures = asset.mesh.textures
    assert textures is not None
    red = np.full((4, 4, 3), (255, 0, 0), np.uint8)
    now = pictures_of(textures, [Image("both", red, "srgb")])
    made = repainted(asset, {}, now, {key: png(red) for key in now}).mesh.textures
    assert made is not None and now.keys() == {("both", True)}
    files = made.files
    assert files[made.slots[0, ROUGHNESS]][1].tobytes() == textures.images["both"].tobytes()
    assert files[made.slots[0, ALBEDO]][1].tobytes() == png(red).tobytes()


def test_what_is_painted_on_colour_and_on_data_of_one_file_is_met_as_it_is() -> None:
    """To the bit, each in its place, and nowhere encoded."""
    asset = textured({"both": uniform((200, 128, 50))["albedo"]}, slots=(0, 0, -1, -1))
    now = np.random.default_rng(1).integers(0, 256, (2, 64, 64, 3), np.uint8)
    given = [Image("both", now[0], "srgb"), Image("both", now[1], "linear")]
    state = ObjectState("thing", "both.drgs", images=given)
    made, _ = RepaintedAssets().loaded(LoadedAsset(asset, (0, 0, 0)), state)
    held = made.textured_of("both.drgs")
    for slot, pixels in zip((ALBEDO, ROUGHNESS), now, strict=True):
        found = held.image(int(held.textures.slots[0, slot]), slot).pixels
        np.testing.assert_array_equal(found[..., :3], pixels)
        assert (found[..., 3] == 255).all()
    assert not held.faults and sum(len(data) for _, data in held.textures.files) < now.size / 10


def test_albedo_with_its_alpha_is_one_image() -> None:
    """A file that is albedo and, by its alpha, opacity: what is painted on it is both."""
    rgba = np.full((4, 4, 4), (200, 100, 50, 255), np.uint8)
    rgba[:2, :, 3] = 0
    asset = textured({"leaf": rgba}, slots=(0, -1, -1, -1))
    assert asset.mesh.textures is not None
    slots = asset.mesh.textures.slots.copy()
    slots[0, OPACITY] = 0
    textures = replace(asset.mesh.textures, slots=slots)
    now = pictures_of(textures, [Image("leaf", rgba[::-1], "srgb")])
    assert now.keys() == {("leaf", True), ("leaf", False)}
    asset.mesh.textures = textures
    made = repainted(asset, {}, now, {key: png(rgba[::-1]) for key in now}).mesh.textures
    assert made is not None and list(made.images) == ["leaf"] and (made.slots == slots).all()


def test_paint_on_vertices_is_told_from_what_an_image_made_of_them() -> None:
    asset = textured(uniform((200, 200, 200)))
    now = replace(asset.mesh, albedo=asset.mesh.albedo + 0.25)
    values = asset.mesh.albedo.copy()
    values[3] = 1, 0, 0
    found = carried_paint(asset.mesh, now, {"albedo": values, "roughness": None})
    np.testing.assert_array_equal(found["albedo"][3], (1, 0, 0))
    np.testing.assert_array_equal(np.delete(found["albedo"], 3, 0), np.delete(now.albedo, 3, 0))
    assert found["roughness"] is None


def test_what_lets_light_pass_is_painted_at_vertices_and_not_how_surfels_blend() -> None:
    """Surfels have an opacity of their own, which is that of their disk; that of the material is the vertices'."""
    asset, noise = with_surfels()
    textures = asset.mesh.textures
    assert textures is not None
    slots = textures.slots.copy()
    slots[:, OPACITY] = slots[:, ALBEDO]
    opacity = np.ones(len(asset.mesh.vertices), np.float32)
    mesh = replace(asset.mesh, opacity=opacity, textures=replace(textures, slots=slots))
    now = np.dstack([noise, np.full(noise.shape[:2], 128, np.uint8)])
    opaque = np.dstack([noise, np.full(noise.shape[:2], 255, np.uint8)])
    (name,) = textures.images
    mesh.textures = replace(mesh.textures, images={name: png(opaque)})
    made = painted(replace(asset, mesh=mesh), opaque, now)
    np.testing.assert_array_equal(made.surfels.opacity, asset.surfels.opacity)
    np.testing.assert_allclose(made.mesh.opacity, 128 / 255, atol=2e-3)


@pytest.mark.parametrize("same", [True, False])
def test_materials_that_have_one_image_are_painted_each_as_it_has_it(same: bool) -> None:
    """Two materials of an image, the second maybe with its picture moved by half of its width."""
    asset, noise = with_surfels()
    textures = asset.mesh.textures
    assert textures is not None
    names = [*textures.names, "other"]
    both = {name: np.repeat(getattr(textures, name), 2, axis=0) for name in ("slots", "factors", "transforms")}
    both["transforms"][1, :, 0, 2] += 0 if same else 0.5
    upper = (asset.mesh.vertices[asset.mesh.faces].mean(axis=1)[:, 2] > 0).astype(np.int32)
    extensions = np.repeat(textures.extensions, 2, axis=0)
    asset.mesh.textures = replace(textures, names=names, material=upper, extensions=extensions, **both)
    now = noise.copy()
    now[:, 32:] = 255, 0, 0
    made = painted(asset, noise, now)
    x, _, z = asset.surfels.centre.T
    red = (np.abs(made.surfels.albedo - RED) < 5e-3).all(axis=1)
    assert red[(x > 0.2) & (x < 0.8) & (z < -0.2)].all()
    assert red[((x > 0.2) if same else (x < -0.2)) & (np.abs(x) < 0.8) & (z > 0.2)].all()


def test_what_is_painted_is_times_the_factor_of_its_material() -> None:
    """And no more than a surface can reflect."""
    asset, noise = with_surfels()
    assert asset.mesh.textures is not None
    asset.mesh.textures.factors[:, :3] = 0.5, 3.0, 0.25
    made = painted(asset, noise, np.full_like(noise, 255))
    for albedo in (made.surfels.albedo, made.mesh.albedo):
        np.testing.assert_allclose(albedo, np.broadcast_to((0.5, 1.0, 0.25), albedo.shape), atol=2e-3)


def test_surfels_take_the_mean_of_what_they_cover() -> None:
    """Black and white lines of one pixel each are grey on surfels, which are wider."""
    asset, noise = with_surfels()
    now = np.zeros((1024, 1024, 3), np.uint8)
    now[::2] = 255
    albedo = painted(asset, noise, now).surfels.albedo
    assert np.abs(albedo - 0.5).max() < 0.1


def test_images_go_on_past_their_edge_as_those_of_the_asset_do() -> None:
    """The right half is red; moved to the left by all of its width, nothing but its last column is seen."""
    asset, noise = with_surfels()
    assert asset.mesh.textures is not None
    asset.mesh.textures.transforms[:, :, 0, 2] = 1
    asset.mesh.textures.extensions[:] = EXTENSIONS.index("extend")
    now = noise.copy()
    now[:, 32:] = 255, 0, 0
    albedo = painted(asset, noise, now).surfels.albedo
    np.testing.assert_allclose(albedo, np.broadcast_to(RED, albedo.shape), atol=0.02)


@pytest.mark.parametrize("alpha", [True, False])
def test_rays_meet_painted_alpha_where_the_asset_has_any(alpha: bool) -> None:
    """Else the red is the opacity, whatever Blender gives besides."""
    pixels = np.full((4, 4, 4 if alpha else 3), 255, np.uint8)
    asset = textured({"leaf": pixels}, slots=(-1, -1, -1, -1))
    assert asset.mesh.textures is not None
    slots = asset.mesh.textures.slots.copy()
    slots[0, OPACITY] = 0
    asset.mesh.textures = replace(asset.mesh.textures, slots=slots)
    now = np.full((4, 4, 4), (50, 0, 0, 100), np.uint8)
    state = ObjectState("thing", "leaf.drgs", images=[Image("leaf", now, "linear")])
    made, _ = RepaintedAssets().loaded(LoadedAsset(asset, (0, 0, 0)), state)
    textured_now = made.textured_of("leaf.drgs")
    channel = textured_now.textures.channel(OPACITY, 0)
    assert channel == ("a" if alpha else "r")
    assert (textured_now.image(0, OPACITY).pixels[..., "rgba".index(channel)] == (100 if alpha else 50)).all()
