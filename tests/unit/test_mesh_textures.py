"""Textures of assets' meshes: made, kept in files, seen by rays, painted over and adjusted."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from shapes import look_along_y, sphere_mesh

from drgs_blender.build.make import make_asset, mesh_with_materials
from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Mesh, Surfels
from drgs_blender.core.asset.archive import read_archive, write_archive
from drgs_blender.core.asset.container import inspect_asset, read_asset, write_asset
from drgs_blender.core.asset.textures import ALBEDO, MeshTextures, without
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import (
    Adjustment,
    Frame,
    MeshState,
    MotionStep,
    ObjectState,
    Pose,
    RenderSettings,
    World,
)
from drgs_blender.core.material_adjustments import edited_asset
from drgs_blender.engine.asset_textures import TexturedAsset
from drgs_blender.engine.scene_warnings import scene_warnings
from drgs_blender.engine.session import Session
from drgs_blender.formats.files import Image, MaterialFile, MeshFile
from drgs_blender.formats.images import decode_image
from drgs_blender.formats.registry import read_mesh
from drgs_blender.geometry.normals import VertexNormals


def png(pixels: np.ndarray) -> np.ndarray:
    data = io.BytesIO()
    Pillow.fromarray(pixels).save(data, "PNG")
    return np.frombuffer(data.getvalue(), np.uint8)


def grid(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A square of 2 m that faces `look_along_y`, of n x n x 2 triangles."""
    ticks = np.linspace(-1, 1, n + 1)
    x, z = np.meshgrid(ticks, ticks)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n + 2], -1), np.stack([a, a + n + 2, a + n + 1], -1)])
    return np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], -1).astype(np.float32), faces.astype(np.int32)


def textured(images: dict[str, np.ndarray], slots: tuple[int, ...] = (0, 1, 1, -1), **vertices: object) -> Asset:
    """The square with images over all of it, of one material."""
    points, faces = grid()
    n, m = len(points), len(faces)
    channels = {"albedo": np.full((n, 3), 0.5), "roughness": np.full(n, 0.5), "metallic": np.zeros(n)} | vertices
    textures = MeshTextures(
        (points[faces][..., [0, 2]] + 1) / 2, np.zeros(m), [slots], np.ones((1, 6)),
        np.tile(np.eye(2, 3), (1, 4, 1, 1)), np.ones((1, 4)), ["paint"],
        {name: png(pixels) for name, pixels in images.items()},
    )  # fmt: skip
    none, rows = np.empty(0), np.empty((0, 3))
    nothing = Surfels(rows, rows[:, :2], np.empty((0, 4)), none, rows, none, none)
    return Asset(nothing, Mesh(points, faces, **channels, textures=textures))


def uniform(colour: tuple[int, int, int], roughness: int = 128, metallic: int = 64) -> dict[str, np.ndarray]:
    """Images of one colour."""
    surface = np.full((4, 4, 3), (0, roughness, metallic), np.uint8)
    return {"albedo": np.full((4, 4, 3), colour, np.uint8), "surface": surface}


@pytest.fixture
def seen(tmp_path: Path):
    """Albedo, roughness and metallic where the camera meets an asset, and the warnings."""
    session = Session()

    def look(asset: Asset, **state: object) -> tuple[np.ndarray, list[str]]:
        write_asset(tmp_path / "a.drgs", asset)
        key = session.load_asset(tmp_path / "a.drgs")
        settings = RenderSettings(samples=4, camera_sees="mesh", rays_see="mesh", subpixel_samples=1)
        # An orthographic view of the middle of each pixel.
        camera = replace(look_along_y(24, focal=24 / 1.8), orthographic=True)
        frame = Frame(0, camera, [ObjectState("thing", key, **state)], world=World(), settings=settings)
        prepared = session.prepare(frame)[0]
        from drgs_blender.render.camera import camera_parameters
        from drgs_blender.render.gbuffer.mesh import primary_mesh

        buffer = primary_mesh(prepared.scene, camera, camera_parameters(camera, settings, 0), 0, 24)
        assert (buffer.object_index == 0).all() and len(buffer.depth) == 576
        points = buffer.points
        values = np.concatenate([points.albedo, points.roughness[:, None], points.metallic[:, None]], axis=1)
        return values.reshape(24, 24, 5), scene_warnings(session._scene_cache)

    return look


def same(a: Asset, b: Asset) -> None:
    left, right = a.mesh.textures, b.mesh.textures
    assert left is not None and right is not None and left.names == right.names
    for name in ("uvs", "material", "slots", "factors", "transforms", "extensions", "normals"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)
    assert list(left.images) == list(right.images)
    for name, data in left.images.items():
        assert data.tobytes() == right.images[name].tobytes()


def test_files_keep_textures_and_need_the_schema_only_then(tmp_path: Path) -> None:
    asset = textured(uniform((200, 100, 50)))
    write_asset(tmp_path / "a.drgs", asset)
    same(read_asset(tmp_path / "a.drgs"), asset)
    write_asset(tmp_path / "b.drgs", read_asset(tmp_path / "a.drgs"))
    assert (tmp_path / "a.drgs").read_bytes() == (tmp_path / "b.drgs").read_bytes()
    about = inspect_asset(tmp_path / "a.drgs")
    assert about["schema"] == 4 and about["counts"]["images"] == 2
    write_asset(tmp_path / "c.drgs", replace(asset, mesh=replace(asset.mesh, textures=None)))
    about = inspect_asset(tmp_path / "c.drgs")
    assert about["schema"] == 1 and "images" not in about["counts"]
    assert "textures.safetensors" not in about["members"]


def test_damaged_textures_are_refused_or_left_out_by_name(tmp_path: Path) -> None:
    write_asset(tmp_path / "a.drgs", textured(uniform((200, 100, 50))))
    members = {name: view.tobytes() for name, view in read_archive(tmp_path / "a.drgs").items()}
    members["textures.safetensors"] = members["textures.safetensors"][:-1] + b"?"
    write_archive(tmp_path / "a.drgs", [(name, [memoryview(data)]) for name, data in members.items()])
    with pytest.raises(AssetError, match=r"textures\.safetensors: has been altered"):
        read_asset(tmp_path / "a.drgs")
    faults: list[str] = []
    assert read_asset(tmp_path / "a.drgs", faults=faults).mesh.textures is None
    assert len(faults) == 1 and "a.drgs, textures.safetensors" in faults[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uvs": np.full((288, 3, 2), np.nan)}, "uvs: has 1728 values that are NaN"),
        ({"material": np.full(288, 5)}, "material: refer to number 5 of 1"),
        ({"slots": [[7, 0, 0, 0]]}, "slots: refer to number 7 of 2"),
        ({"images": {"a": np.zeros(9), "b": np.zeros(9)}}, "images/a: is neither a PNG nor a JPEG"),
        ({"material": np.zeros(3), "uvs": np.zeros((3, 3, 2))}, "materials of 3 faces for 288"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, change: dict[str, object], message: str) -> None:
    asset = textured(uniform((9, 9, 9)))
    assert asset.mesh.textures is not None
    with pytest.raises(AssetError, match=message):
        asset.mesh.textures = replace(asset.mesh.textures, **change)
        write_asset(tmp_path / "a.drgs", asset)


def test_images_that_cannot_be_decoded_leave_the_values_of_vertices(seen) -> None:
    asset = textured(uniform((200, 100, 50)))
    assert asset.mesh.textures is not None
    asset.mesh.textures.images["albedo"] = asset.mesh.textures.images["albedo"][:40]
    values, warnings = seen(asset)
    np.testing.assert_allclose(values[..., :3], 0.5, atol=1e-6)
    np.testing.assert_allclose(values[..., 3], 128 / 255, atol=1e-6)
    assert any("thing: " in w and "a.drgs, image albedo.png" in w for w in warnings)


def test_rays_meet_the_image_and_not_the_vertices(seen) -> None:
    random = np.random.default_rng(1).integers(0, 255, (6, 6, 3), np.uint8)
    pixels = random.repeat(8, axis=0).repeat(8, axis=1)
    values, warnings = seen(textured({"albedo": pixels, "surface": pixels}))
    assert not warnings
    # Pixel centres, in texels: the picture shows the middle nine tenths of the square, 1.8 texels a pixel.
    at = (0.05 + 0.9 * (np.arange(24) + 0.5) / 24) * 48
    inner = (at % 8 > 1.5) & (at % 8 < 6.5)  # away from edges, where texels are blended
    at = at.astype(int)
    expected, found = pixels[np.ix_(at[inner], at[inner])], values[np.ix_(inner, inner)]
    np.testing.assert_allclose(found[..., :3], srgb_to_linear(expected / 255), atol=1e-3)
    np.testing.assert_allclose(found[..., 3:], expected[..., 1:] / 255, atol=1e-3)


ADJUSTMENTS = (
    Adjustment(tint=(0.5, 0.8, 1.0)),
    Adjustment(value=1.9),
    Adjustment(hue=0.3, saturation=0.7, value=1.1, tint=(1, 0.5, 1)),
    Adjustment(brightness=0.1, contrast=-0.3),
    Adjustment(roughness=(0.5, 0.0, 0.0, 1.0), metallic=(-1.0, 0.9, 0.1, 0.7)),
    Adjustment(roughness=(3.0, 0.0, 0.0, 1.0)),
)


@pytest.mark.parametrize("adjustment", ADJUSTMENTS)
@pytest.mark.parametrize("masked", [False, True])
def test_adjustments_are_those_of_vertices(seen, adjustment: Adjustment, masked: bool) -> None:
    """An image of one colour and vertices of that colour look the same under any adjustment, painted or not."""
    images = uniform((200, 100, 50))
    asset = textured(images)
    n = len(asset.mesh.vertices)
    colour = srgb_to_linear(images["albedo"][0, 0] / 255)
    own = {"albedo": np.tile(colour, (n, 1)), "roughness": np.full(n, 128 / 255), "metallic": np.full(n, 64 / 255)}
    asset = textured(images, **own)
    bare = replace(asset, mesh=replace(asset.mesh, textures=None))
    mask = np.clip(asset.mesh.vertices[:, 0] * 2, 0, 1) if masked else None
    painted = own["roughness"].copy()
    painted[asset.mesh.vertices[:, 2] > 0.5] = 0.9
    state = {"adjustment": replace(adjustment, mask=mask), "roughness": painted.astype(np.float32)}
    found, warnings = seen(asset, **state)
    np.testing.assert_allclose(found, seen(bare, **state)[0], atol=4e-3)
    assert any("in part" in w for w in warnings) == masked


def test_paint_covers_the_image_where_it_is_and_only_its_channel(seen) -> None:
    asset = textured(uniform((200, 100, 50)))
    painted = asset.mesh.albedo.copy()
    above = asset.mesh.vertices[:, 2] > 0
    painted[above] = 0.1, 0.9, 0.2
    values, _ = seen(asset, albedo=painted)
    colour = srgb_to_linear(np.array([200, 100, 50]) / 255)
    for rows, expected in ((values[:9], (0.1, 0.9, 0.2)), (values[13:], colour)):
        np.testing.assert_allclose(rows[..., :3], np.broadcast_to(expected, rows[..., :3].shape), atol=1e-6)
    np.testing.assert_allclose(values[..., 3], 128 / 255, atol=1e-6)


@pytest.mark.parametrize("adjustment", [None, *ADJUSTMENTS])
def test_a_saved_edit_looks_as_it_did(seen, adjustment: Adjustment | None) -> None:
    """Save Edited Asset: painted faces lose their image, factors take what they can."""
    asset = textured(uniform((200, 100, 50)))
    painted = asset.mesh.albedo.copy()
    painted[asset.mesh.vertices[:, 2] > 0] = 0.1, 0.9, 0.2
    colour = srgb_to_linear(np.array([200, 100, 50]) / 255)
    asset.mesh.albedo[:] = colour
    asset.mesh.roughness[:], asset.mesh.metallic[:] = 128 / 255, 64 / 255
    painted[asset.mesh.vertices[:, 2] <= 0] = colour
    before, _ = seen(asset, albedo=painted, adjustment=adjustment)
    after, _ = seen(edited_asset(asset, {"albedo": painted}, adjustment))
    np.testing.assert_allclose(after, before, atol=4e-3)


PASSES = (
    "Combined", "Emit", "DiffDir", "Vector", "IndexOB", "IndexMA", "CryptoObject00", "CryptoMaterial00", "Depth", "UV",
)  # fmt: skip


@pytest.mark.parametrize(
    ("camera_sees", "rays_see", "names"),
    [
        ("mesh", "mesh", ()),
        ("surfels", "mesh", ()),
        ("mesh", "mesh", ("emission", "opacity")),
        ("surfels", "mesh", ("emission", "opacity")),
        ("surfels", "mesh", ("emission",)),
        ("surfels", "surfels", ("emission",)),
    ],
)
def test_a_textured_object_is_the_object_in_every_pass(
    tmp_path: Path, camera_sees: str, rays_see: str, names: tuple[str, ...]
) -> None:
    """With images of the colours of its vertices, an object has the passes that it has without: light, motion, IDs."""
    colour = np.full((4, 4, 3), (200, 100, 50), np.uint8)
    file = square_file(6, Image(colour, srgb=True))
    asset = make_asset(file, density=40, max_triangles=200)
    assert asset.mesh.textures is not None and len(asset.surfels)
    asset.mesh.textures.normals = None
    x = asset.mesh.vertices[:, 0]
    channels = {"emission": np.outer(np.maximum(x, 0), (2.0, 1.0, 0.5)), "opacity": np.clip(0.6 + x, 0, 1)}
    asset = edited_asset(asset, {name: channels[name].astype(np.float32) for name in names})
    assert asset.mesh.textures is not None
    bare = replace(asset, mesh=replace(asset.mesh, textures=None))
    session, found = Session(), []
    moved = (asset.mesh.vertices + np.array((0.3, 0, 0.15))).astype(np.float32)
    turned = np.diag([-0.8, 0.7, 0.9, 1.0])  # mirrored
    floor = MeshState(
        "floor", np.float32([[-3, -3, -1], [3, -3, -1], [3, 3, -1], [-3, 3, -1]]), np.int32([[0, 1, 2], [0, 2, 3]]),
        np.eye(4)[None], np.array([3], np.int32),
    )  # fmt: skip
    for name, own in (("textured", asset), ("bare", bare)):
        write_asset(tmp_path / f"{name}.drgs", own)
        key = session.load_asset(tmp_path / f"{name}.drgs")
        state = ObjectState("thing", key, turned, vertices=asset.mesh.vertices, pass_index=5, material_pass_index=2)
        frame = Frame(
            0, look_along_y(32, focal=45.0), [state], World(),
            RenderSettings(samples=8, bounces=2, camera_sees=camera_sees, rays_see=rays_see),
            PASSES,
            meshes=[floor],
            previous=MotionStep(look_along_y(32, focal=45.0), [Pose("thing", turned[None], moved)], [None]),
        )  # fmt: skip
        found.append(session.render(frame))
        mesh = session._scene_cache.objects[0].mesh
        assert (mesh is not None) == (name == "textured" or bool(names))
        assert name == "bare" or (mesh is not None and mesh.uvs is not None)
    textured_passes, plain_passes = found
    assert textured_passes.keys() == plain_passes.keys() and len(plain_passes) >= 10
    assert (plain_passes["DiffDir"].max() > 0.1) and (plain_passes["Emit"].max() > 0.1) == ("emission" in names)
    assert np.abs(plain_passes["Vector"]).max() > 1
    for name, expected in plain_passes.items():
        np.testing.assert_allclose(textured_passes[name], expected, rtol=2e-3, atol=2e-3, err_msg=name)


@pytest.mark.parametrize("painted", [False, True])
def test_a_textured_surface_glows_and_lets_light_pass(tmp_path: Path, painted: bool) -> None:
    """A quarter of it is there, with the colours of its image and the radiance of its vertices."""
    pixels = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    pixels[:, 8:] = 40, 120, 220
    asset = textured({"albedo": pixels}, (0, -1, -1, -1))
    n = len(asset.mesh.vertices)
    emission, opacity = np.tile(np.float32([3.0, 1.5, 0.25]), (n, 1)), np.full(n, 0.5, np.float32)
    own: dict[str, object] = {"emission": emission, "opacity": opacity}
    if not painted:
        asset.mesh, own = replace(asset.mesh, **own), {}  # type: ignore[arg-type]
    write_asset(tmp_path / "a.drgs", asset)
    assert inspect_asset(tmp_path / "a.drgs")["schema"] == 4
    session = Session()
    key = session.load_asset(tmp_path / "a.drgs")
    change = Adjustment(opacity=0.5, emission=2.0)
    settings = RenderSettings(
        samples=16, camera_sees="mesh", rays_see="mesh", subpixel_samples=64, film_transparent=True
    )
    camera = replace(look_along_y(24, focal=24 / 1.8), orthographic=True)
    passes = ("Combined", "DiffCol", "Emit", "CryptoObject00")
    frame = Frame(0, camera, [ObjectState("thing", key, adjustment=change, **own)], World(), settings, passes)
    picture = session.render(frame)
    assert picture["Combined"][..., 3].mean() == pytest.approx(0.25, abs=0.01)
    np.testing.assert_allclose(picture["Emit"].mean(axis=(0, 1)), 0.25 * np.array((6.0, 3.0, 0.5)), rtol=0.03)
    for columns, colour in ((slice(0, 11), (200, 100, 50)), (slice(13, 24), (40, 120, 220))):
        found = picture["DiffCol"][:, columns].mean(axis=(0, 1))
        whole = srgb_to_linear(np.array(colour) / 255)
        np.testing.assert_allclose(found, 0.24 * whole, rtol=0.06)  # a coat of varnish reflects the rest
    shares = picture["CryptoObject00"][..., 1]
    np.testing.assert_allclose(shares, picture["Combined"][..., 3], atol=1e-5)


def test_normals_follow_the_pose() -> None:
    """Turned by a pose of its vertices, a mesh has the corner normals of its file, turned."""
    vertices, faces = sphere_mesh(2)
    random = np.random.default_rng(2)
    normals = vertices[faces] + 0.2 * random.standard_normal((len(faces), 3, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    n, m = len(vertices), len(faces)
    textures = MeshTextures(
        np.zeros((m, 3, 2)), np.full(m, -1), np.empty((0, 4)), np.empty((0, 6)), np.empty((0, 4, 2, 3)),
        np.empty((0, 4)), [], {}, normals,
    )  # fmt: skip
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n), textures=textures)
    held = TexturedAsset(Asset(None, mesh), "ball")  # type: ignore[arg-type]
    turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    np.testing.assert_array_equal(held.normals(None), textures.normals)
    np.testing.assert_allclose(held.normals((vertices @ turn.T).astype(np.float32)), normals @ turn.T, atol=2e-5)
    broken = vertices.copy()
    broken[3] = np.nan
    assert held.normals(broken) is not None  # the scene leaves its faces out


def square_file(n: int = 4, image: Image | None = None, **material: object) -> MeshFile:
    """The square in the plane of Y, textured, with slanted normals."""
    points, faces = grid(n)
    normals = points[faces] * 0.3 + (0, -1, 0)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    paint = MaterialFile("paint", (1.0, 1.0, 1.0), base_colour_image=image, **material)
    return MeshFile(points, faces, normals, (points[faces][..., [0, 2]] + 1) / 2, materials=[paint], up_axis="Z")


def noise(size: int) -> Image:
    pixels = np.random.default_rng(5).integers(0, 255, (8, 8, 3), np.uint8)
    return Image(pixels.repeat(size // 8, axis=0).repeat(size // 8, axis=1), srgb=True)


def test_coordinates_and_normals_follow_divided_faces() -> None:
    image = noise(64)
    mesh, report = mesh_with_materials(square_file(4, image), "square", max_triangles=4000, max_texture=4096)
    textures = mesh.textures
    assert textures is not None and textures.normals is not None and len(mesh.faces) > 500
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(textures.uvs, (corners[..., [0, 2]] + 1) / 2, atol=1e-6)
    # Normals are linear within a face of the file; one ball of radius 1/0.3 has about these everywhere.
    smooth = corners * 0.3 + (0, -1, 0)
    smooth /= np.linalg.norm(smooth, axis=2, keepdims=True)
    np.testing.assert_allclose(textures.normals, smooth, atol=2e-3)
    (data,) = textures.images.values()
    np.testing.assert_array_equal(decode_image(data.tobytes(), "made"), image.pixels)
    (note,) = report["notes"]
    assert "triangles became" in note


def test_larger_images_are_reduced_and_named() -> None:
    mesh, report = mesh_with_materials(square_file(4, noise(64)), "square", max_triangles=100, max_texture=8)
    assert mesh.textures is not None
    (data,) = mesh.textures.images.values()
    np.testing.assert_array_equal(decode_image(data.tobytes(), "made"), noise(8).pixels)
    assert "paint albedo: 64 x 64 pixels reduced to 8 x 8" in report["notes"]


@pytest.mark.parametrize(
    ("pixels", "kept"),
    [
        (np.zeros((0, 4, 3), np.uint8), False),
        (np.full((1, 30_000, 3), 90, np.uint8), True),
        (np.full((4, 4), 40_000, np.uint16), True),
        (np.full((4, 4, 3), 0.3, np.float32), True),
    ],
)
def test_odd_images(pixels: np.ndarray, kept: bool) -> None:
    if not pixels.size:  # readers give none; only what keeps textures looks at it
        file = square_file(2, noise(8))
        file.materials[0].normal_image = Image(pixels, srgb=False)
    else:
        file = square_file(2, Image(pixels, srgb=True))
    mesh, _ = mesh_with_materials(file, "square", max_triangles=100, max_texture=4096)
    assert mesh.textures is not None and (len(mesh.textures.images) == 1)
    shape = decode_image(next(iter(mesh.textures.images.values())).tobytes(), "made").shape
    assert max(shape) <= 4096 and shape[2] == 3


def test_vertex_colours_win_over_their_faces_textures() -> None:
    file = square_file(4, noise(64))
    colours = np.ones((len(file.vertices), 3), np.float32)
    colours[0] = 0.5
    file.vertex_colours = colours
    mesh, report = mesh_with_materials(file, "square", max_triangles=32, max_texture=4096)
    assert mesh.textures is not None
    bare = mesh.textures.material < 0
    near = (np.linalg.norm(mesh.vertices - (-1, 0, -1), axis=1) < 1e-3)[mesh.faces].any(axis=1)
    np.testing.assert_array_equal(bare, near)
    assert any("vertex colours" in note for note in report["notes"])


def test_no_textures_where_none_are_wanted_or_there(tmp_path: Path) -> None:
    assert make_asset(square_file(2, noise(8)), density=4, max_texture=0).mesh.textures is None
    assert make_asset(square_file(2), density=4).mesh.textures is None


def test_faces_without_images_lose_their_material() -> None:
    textures = textured(uniform((1, 2, 3))).mesh.textures
    assert textures is not None
    some = np.zeros((288, 8), bool)
    some[:10] = True
    some[10:20, ALBEDO] = True
    kept = without(textures, some)
    assert kept is not None and kept.names == ["paint", "paint"]
    assert (kept.material[:10] == -1).all() and (kept.material[10:20] == kept.material[10]).all()
    assert kept.slots[kept.material[10], :4].tolist() == [-1, 1, 1, -1]
    assert kept.slots[kept.material[20], :4].tolist() == [0, 1, 1, -1]
    assert without(textures, np.ones((288, 8), bool)) is None


def converted(tmp_path: Path, asset: Asset, name: str) -> MeshFile:
    """The mesh of an asset as a file of other programs says it, in the axes of the asset."""
    path = tmp_path / name
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(path)]) == 0
    return read_mesh(path)


def slanted(asset: Asset) -> Asset:
    """The square with normals of its own, half of its faces without textures."""
    textures = asset.mesh.textures
    assert textures is not None
    corners = asset.mesh.vertices[asset.mesh.faces] * 0.3 + (0, -1, 0)
    textures.normals = (corners / np.linalg.norm(corners, axis=2, keepdims=True)).astype(np.float32)
    textures.material = np.repeat(np.array([0, -1], np.int32), 144)
    return asset


def test_gltf_has_the_images_and_an_atlas_for_the_rest(tmp_path: Path, capsys) -> None:
    noise_pixels = np.random.default_rng(1).integers(0, 255, (16, 16, 3), np.uint8)
    images = {"albedo": noise_pixels, "surface": noise_pixels[::-1], "bumps": noise_pixels[:, ::-1]}
    asset = slanted(textured(images, (0, 1, 1, 2), albedo=np.random.default_rng(2).random((169, 3))))
    textures = asset.mesh.textures
    assert textures is not None
    textures.factors[0, :6] = 0.5, 0.75, 1, 0.5, 0.25, 0.7
    file = converted(tmp_path, asset, "a.glb")
    assert "1 materials with the images" in (out := capsys.readouterr().out) and "144 others" in out
    own = file.face_material == 0
    assert own.sum() == 144 and len(file.faces) == 288 and file.materials[0].name == "paint"
    corners = asset.mesh.vertices[asset.mesh.faces]
    np.testing.assert_allclose(file.vertices[file.faces], corners, atol=1e-6)
    assert file.corner_normals is not None and file.corner_uvs is not None
    np.testing.assert_allclose(file.corner_normals, textures.normals, atol=1e-6)
    np.testing.assert_allclose(file.corner_uvs[own], textures.uvs[:144], atol=1e-6)
    paint = file.materials[0]
    assert paint.base_colour_image and paint.metallic_roughness_image and paint.normal_image
    for image, name in zip((paint.base_colour_image, paint.metallic_roughness_image, paint.normal_image), images):
        assert image.file == textures.images[name].tobytes() and image.wrap == ("clamp", "clamp")
    np.testing.assert_allclose(paint.base_colour, (0.5, 0.75, 1))
    np.testing.assert_allclose((paint.roughness, paint.metallic, paint.normal_strength), (0.5, 0.25, 0.7))
    # An asset of that file has the same textures.
    again, _ = mesh_with_materials(file, "again", max_triangles=10, max_texture=64)
    assert again.textures is not None
    assert [d.tobytes() for d in again.textures.images.values()][:3] == [d.tobytes() for d in textures.images.values()]


def test_gltf_has_images_with_opacity_and_emission_that_are_alike_in_a_material(tmp_path: Path, capsys) -> None:
    noise_pixels = np.random.default_rng(1).integers(0, 255, (16, 16, 4), np.uint8)
    n = 169
    channels = {"emission": np.tile((3.0, 1.5, 0.25), (n, 1)), "opacity": np.full(n, 0.5), "coat": np.full(n, 0.25)}
    asset = textured({"albedo": noise_pixels}, (0, -1, -1, -1), **channels)
    assert asset.mesh.textures is not None
    file = converted(tmp_path, asset, "a.glb")
    assert "1 materials with the images" in capsys.readouterr().out
    (paint,) = file.materials
    image = paint.base_colour_image
    assert image is not None and image.pixels.shape == (16, 16, 3)  # else its alpha would count, too
    np.testing.assert_array_equal(image.pixels, noise_pixels[..., :3])
    again, _ = mesh_with_materials(file, "again", max_triangles=1000, max_texture=64)
    assert again.textures is not None
    for name, values in channels.items():
        np.testing.assert_allclose(again.channel(name), values[: len(again.vertices)], rtol=1e-3, err_msg=name)
    asset.mesh.opacity = np.linspace(0, 1, n).astype(np.float32)
    assert len(converted(tmp_path, asset, "b.glb").materials) == 1
    assert "0 materials with the images" in capsys.readouterr().out


def test_an_image_that_cannot_be_read_is_named_where_its_alpha_goes(tmp_path: Path, capsys) -> None:
    asset = textured(uniform((200, 100, 50)), opacity=np.full(169, 0.5))
    assert asset.mesh.textures is not None
    asset.mesh.textures.images["albedo"] = np.frombuffer(b"\x89PNG\r\n\x1a\njunk", np.uint8)
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.glb")]) == 65
    assert "image albedo.png: is no image that can be read" in capsys.readouterr().err
    assert not (tmp_path / "a.glb").exists()


def test_gltf_of_channels_that_vary_at_vertices_is_an_atlas(tmp_path: Path, capsys) -> None:
    """Painted albedo under an image of roughness: no material of glTF has both."""
    asset = textured(uniform((9, 9, 9)), (-1, 1, 1, -1), albedo=np.random.default_rng(2).random((169, 3)))
    file = converted(tmp_path, asset, "a.glb")
    assert "0 materials with the images" in capsys.readouterr().out and len(file.materials) == 1
    image = file.materials[0].base_colour_image
    assert image is not None and max(image.pixels.shape) > 16


def test_usd_has_the_images(tmp_path: Path, capsys) -> None:
    usd, shade = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdShade")
    geometry = pytest.importorskip("pxr.UsdGeom")
    noise_pixels = np.random.default_rng(1).integers(0, 255, (16, 16, 3), np.uint8)
    asset = slanted(textured({"albedo": noise_pixels, "bumps": noise_pixels[::-1]}, (0, -1, -1, 1)))
    textures = asset.mesh.textures
    assert textures is not None
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.usdz")]) == 0
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    mesh = geometry.Mesh(stage.GetPrimAtPath("/Asset/Mesh"))
    np.testing.assert_allclose(np.array(mesh.GetNormalsAttr().Get()), textures.normals.reshape(-1, 3), atol=1e-6)
    st = geometry.PrimvarsAPI(mesh).GetPrimvar("st").Get()
    np.testing.assert_allclose(np.array(st)[: 3 * 144], textures.uvs[:144].reshape(-1, 2), atol=1e-6)
    subsets = geometry.Subset.GetAllGeomSubsets(mesh)
    assert [len(s.GetIndicesAttr().Get()) for s in subsets] == [144, 144]
    material, _ = shade.MaterialBindingAPI(subsets[0].GetPrim()).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    assert abs(surface.GetInput("roughness").Get() - 0.5) < 1e-6
    texture = surface.GetInput("diffuseColor").GetConnectedSource()[0].GetPrim()
    path = str(shade.Shader(texture).GetInput("file").Get().resolvedPath)
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.read(path.split("[")[1].rstrip("]")) == textures.images["albedo"].tobytes()


def test_smooth_normals_are_kept_for_what_is_divided() -> None:
    """Of a file without normals, faces that are divided have those that the file's vertices had."""
    vertices, faces = sphere_mesh(1)
    uvs = np.random.default_rng(3).random((len(faces), 3, 2))
    paint = MaterialFile("paint", (1.0, 1.0, 1.0), base_colour_image=noise(64))
    file = MeshFile(vertices, faces, corner_uvs=uvs, materials=[paint])
    mesh, _ = mesh_with_materials(file, "ball", max_triangles=1000, max_texture=64)
    textures = mesh.textures
    assert textures is not None and textures.normals is not None and len(mesh.faces) > len(faces)
    round_ones = mesh.vertices[mesh.faces]
    round_ones /= np.linalg.norm(round_ones, axis=2, keepdims=True)
    flat = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)[mesh.faces]
    kept = np.linalg.norm(textures.normals - round_ones, axis=2).max()
    assert kept < 0.02 < np.linalg.norm(flat - round_ones, axis=2).max()
