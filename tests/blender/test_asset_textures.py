"""Textures of assets in Blender: shown by its own materials as by DR-GS, and kept when an asset is saved."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import bpy
import numpy as np
import parity
import pytest
from scenes import asset_of, part, sphere

pytestmark = pytest.mark.blender_api


def png(pixels: np.ndarray) -> np.ndarray:
    """A PNG file of (h, w, 3) uint8."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")
    return np.frombuffer(b"\x89PNG\r\n\x1a\n" + b"".join(parts), np.uint8)


def textured_ball():
    """A ball in two materials: one with all images, moved and scaled; one with an albedo that goes on as its edge."""
    vertices, faces = sphere(12, 16)
    asset = asset_of(vertices, faces)
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (2, 8, 8, 3), np.uint8)
    coarse[1] = coarse[1] // 3 * 2 + 60
    bumps = np.full((8, 8, 3), (128, 128, 255), np.uint8)
    bumps[::2] += np.array([40, 20, 0], np.uint8)
    images = {"albedo": coarse[0], "surface": coarse[1], "bumps": bumps}
    corners = vertices[faces]
    uvs = np.stack([corners[..., 0] + 0.3 * corners[..., 1], corners[..., 2]], axis=-1)
    transforms = np.tile(np.eye(2, 3), (2, 4, 1, 1))
    transforms[0, :3] = (0.6, 0.2, 0.1), (-0.1, 0.8, 0.3)
    textures = part("drgs_blender.core.asset.textures").MeshTextures(
        uvs, (corners.mean(axis=1)[:, 2] > 0).astype(int), [(0, 1, 1, 2), (0, -1, -1, -1)],
        [(0.9, 0.8, 1, 0.9, 0.5, 0.7), (1, 1, 1, 1, 1, 1)], transforms, [(0, 0, 0, 0), (1, 0, 0, 0)],
        ["below", "above"], {name: png(pixels) for name, pixels in images.items()},
    )  # fmt: skip
    asset.mesh.textures = textures
    return asset


@pytest.fixture
def ball(scene, tmp_path):
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "ball.drgs", textured_ball())
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "ball.drgs"))
    return bpy.context.active_object


def read(path):
    return part("drgs_blender.core.asset.container").read_asset(path).mesh.textures


def image_of(name):
    return next(i for i in bpy.data.images if i.get("drgs_image") == name)


def paint(image, colour):
    """All of an image, as a brush does: in memory, not saved."""
    image.pixels.foreach_set(np.tile(np.float32((*colour, 1)), image.size[0] * image.size[1]))
    image.update()
    image.update_tag()


def test_painted_images_are_sent_until_they_are_as_imported_again(ball, export):
    """Before they are saved, and after."""
    sent = lambda: {i.name: i.pixels for i in export()[0].objects[0].images}  # noqa: E731
    image = image_of("albedo")
    assert not sent()
    before = image.packed_file.data
    paint(image, (0.8, 0.4, 0.2))
    assert sent().keys() == {"albedo"}
    np.testing.assert_array_equal(sent()["albedo"][0, 0, :3], (204, 102, 51))
    image.pack()
    assert not image.is_dirty and sent().keys() == {"albedo"}
    ball.drgs.show_captured = True
    assert not sent()
    ball.drgs.show_captured = False
    image.pack(data=before, data_len=len(before))
    image.reload()
    assert not sent()


def test_images_that_are_not_the_assets_are_told(ball, export):
    image = image_of("albedo")
    image["drgs_image"], image["drgs_textures"] = "another", "0 sRGB"
    assert not [w for w in export()[1] if "of another asset" in w] and not export()[0].objects[0].images
    paint(image, (1, 0, 0))
    image.pack()
    assert [w for w in export()[1] if image.name in w and "of another asset" in w]


def test_viewports_read_what_is_painted_once_and_again_after_each_stroke(ball, monkeypatch):
    """Not when something else moves: an image that is not saved is read whole."""
    exported = lambda: part("addon.viewport.scenes").exported(bpy.context.evaluated_depsgraph_get())  # noqa: E731
    pixels, reads = part("addon.export.image_pixels"), []
    original = pixels.straight
    monkeypatch.setattr(pixels, "straight", lambda image: (reads.append(image.name), original(image))[1])
    image = image_of("albedo")
    exported()
    for value in (0.25, 0.75):
        reads.clear()
        paint(image, (value, value, value))
        bpy.context.view_layer.update()
        (sent,) = exported().frame.objects[0].images
        assert sent.pixels[0, 0, 0] == round(255 * value) and len(reads) == 1
        ball.location.x += 1
        bpy.context.view_layer.update()
        assert exported().frame.objects[0].images[0].pixels is sent.pixels and len(reads) == 1


def test_what_is_painted_looks_as_in_cycles(scene, ball):
    """Through the transform of its texture, on the lower half; the normals are painted flat."""
    parity.light(scene)
    parity.set_up(scene, 64, samples=128, bounces=1)
    scene.camera.location.y = -3.4
    plain = parity.pictures(scene, "DRGS")
    image = image_of("albedo")
    pixels = np.ones((image.size[1], image.size[0], 4), np.float32)
    pixels[..., :3] = (0.9, 0.1, 0.2)
    pixels[::2, :, :3] = (0.1, 0.3, 0.9)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    paint(image_of("bumps"), (0.5, 0.5, 1))
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 40 > parity.psnr(plain, theirs) + 15


def test_an_asset_is_saved_as_it_is_painted(ball, tmp_path, export):
    """Its images, and what vertices have of them; linked to the new file there is nothing painted any more."""
    image = image_of("albedo")
    paint(image, (0.8, 0.4, 0.2))
    path = tmp_path / "painted.drgs"
    assert bpy.ops.drgs.save_asset(filepath=str(path), use_saved=True) == {"FINISHED"}
    asset = part("drgs_blender.core.asset.container").read_asset(path)
    before = textured_ball()
    assert list(asset.mesh.textures.images) == list(before.mesh.textures.images)
    data = asset.mesh.textures.images["albedo"].tobytes()
    assert data == image.packed_file.data != before.mesh.textures.images["albedo"].tobytes()
    assert asset.mesh.textures.images["surface"].tobytes() == before.mesh.textures.images["surface"].tobytes()
    linear = ((np.array([0.8, 0.4, 0.2]) + 0.055) / 1.055) ** 2.4
    above = before.mesh.faces[before.mesh.textures.material == 1]
    rows = np.setdiff1d(above, before.mesh.faces[before.mesh.textures.material == 0])
    np.testing.assert_allclose(asset.mesh.albedo[rows], np.broadcast_to(linear, (len(rows), 3)), atol=5e-3)
    frame, warnings = export()
    assert not frame.objects[0].images and frame.objects[0].albedo is None and not warnings
    paint(image, (0.1, 0.1, 0.1))
    assert [i.name for i in export()[0].objects[0].images] == ["albedo"], "its name is known, though not its content"


def test_an_import_has_uvs_materials_and_packed_images_once(ball, tmp_path):
    textures, mesh = textured_ball().mesh.textures, ball.data
    found = np.empty(6 * len(mesh.polygons), np.float32)
    mesh.uv_layers["UVMap"].uv.foreach_get("vector", found)
    np.testing.assert_array_equal(found.reshape(-1, 3, 2), textures.uvs)
    assert [m.name for m in mesh.materials] == ["DR-GS", "below", "above"]
    index = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", index)
    np.testing.assert_array_equal(index, textures.material + 1)
    images = [i for i in bpy.data.images if i.packed_file]
    assert {i.packed_file.data for i in images} == {data.tobytes() for data in textures.images.values()}
    assert {(i.name, i.colorspace_settings.name, tuple(i.size)) for i in images} == {
        ("albedo.png", "sRGB", (8, 8)), ("surface.png", "Non-Color", (8, 8)), ("bumps.png", "Non-Color", (8, 8)),
    }  # fmt: skip
    counts = len(bpy.data.images), len(bpy.data.materials)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "ball.drgs"))
    assert (len(bpy.data.images), len(bpy.data.materials)) == counts
    assert list(bpy.context.active_object.data.materials) == list(mesh.materials)


def test_cycles_shows_the_imported_materials_as_drgs_the_asset(scene, ball):
    parity.light(scene)
    parity.set_up(scene, 64, samples=128, bounces=1)
    scene.camera.location.y = -3.4
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 40


@pytest.mark.slow
@pytest.mark.parametrize("painted", [False, True])
def test_textured_materials_glow_and_let_light_pass_as_those_of_drgs(scene, tmp_path, painted):
    """Emission and opacity of an asset with images, from the file or painted later."""
    asset, arrays = textured_ball(), part("addon.mesh_arrays")
    height = asset.mesh.vertices[:, 2]
    channels = {"emission": np.outer(height.clip(0), (2.0, 1.0, 0.5)), "opacity": np.clip(0.6 + height, 0, 1)}
    channels = {name: values.astype(np.float32) for name, values in channels.items()}
    if not painted:
        asset.mesh = replace(asset.mesh, **channels)
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "veil.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "veil.drgs"))
    mesh = bpy.context.active_object.data
    if painted:
        for name, values in channels.items():
            arrays.write_channel(mesh, name, values)
        part("addon.viewport_material").update_viewport_material(mesh)
    for material in mesh.materials:
        names = {n.attribute_name for n in material.node_tree.nodes if n.type == "ATTRIBUTE"}
        assert {"emission", "opacity"} <= names
    counts = len(bpy.data.materials)
    part("addon.viewport_material").update_viewport_material(mesh)
    assert len(bpy.data.materials) == counts
    parity.light(scene)
    parity.set_up(scene, 64, samples=256, bounces=2)
    scene.camera.location.y = -3.4
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 50
    veil = np.zeros((64, 64), bool)
    veil[32:] = True
    assert parity.psnr(ours, theirs, veil) > 44
    assert np.abs((ours - theirs)[..., 3].mean()) < 1e-3 and 0.05 < theirs[:, 32:, :, 3].mean() < 0.3


def test_save_keeps_textures_and_what_factors_can_say(ball, tmp_path):
    before = textured_ball().mesh.textures
    assert bpy.ops.drgs.save_asset(filepath=str(tmp_path / "same.drgs")) == {"FINISHED"}
    kept = read(tmp_path / "same.drgs")
    for name in ("uvs", "material", "slots", "factors", "transforms", "extensions"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(before, name), err_msg=name)
    assert {k: v.tobytes() for k, v in kept.images.items()} == {k: v.tobytes() for k, v in before.images.items()}
    ball.drgs.adjustment.tint = (0.5, 1, 1)
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "tint.drgs"))
    kept = read(tmp_path / "tint.drgs")
    np.testing.assert_allclose(kept.factors[:, 0], before.factors[:, 0] / 2, rtol=1e-6)
    np.testing.assert_array_equal(kept.slots, before.slots)
    ball.drgs.adjustment.hue = 0.25
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "hue.drgs"))
    assert (read(tmp_path / "hue.drgs").slots[:, 0] == -1).all()
    last = part("addon.messages").history[-1]
    assert last.level == "WARNING" and "cannot say its adjustments" in last.text


def test_images_of_optional_channels_are_shown_and_saved(scene, tmp_path):
    """Alpha, emission, specular level and coat of the lower material; the upper one has what is at its vertices."""
    asset = textured_ball()
    slots, factors = asset.mesh.textures.slots.copy(), asset.mesh.textures.factors.copy()
    slots[0, 4:], factors[0, 6:] = (1, 0, 1, 1), (0.8, 2.0, 1.0, 0.5, 0.6, 0.7)
    asset.mesh.textures = replace(asset.mesh.textures, slots=slots, factors=factors)
    coat = np.full(len(asset.mesh.vertices), 0.25, np.float32)
    asset.mesh = replace(asset.mesh, coat=coat)
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "all.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "all.drgs"))
    obj = bpy.context.active_object
    inputs = {}
    for material in obj.data.materials[1:]:
        surface = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        linked = {s.name: s.links[0].from_node.type for s in surface.inputs if s.is_linked}
        inputs[material.name] = linked, surface.inputs["Emission Strength"].default_value
    (below, strength), (above, _) = inputs.values()
    shown = {"Alpha", "Emission Color", "Specular IOR Level", "Coat Weight"}
    assert shown <= below.keys() and "ATTRIBUTE" not in {below[name] for name in shown} and strength == 1
    assert above["Coat Weight"] == "ATTRIBUTE" and not shown - {"Coat Weight"} & above.keys()
    obj.drgs.adjustment.opacity = 0.5
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "half.drgs"))
    kept = read(tmp_path / "half.drgs")
    np.testing.assert_array_equal(kept.slots, slots)
    np.testing.assert_allclose(kept.factors[0, 6:], (0.4, 2.0, 1.0, 0.5, 0.6, 0.7), rtol=1e-6)


def test_paint_takes_the_image_of_its_faces(ball, tmp_path):
    arrays = part("addon.mesh_arrays")
    values = arrays.read_channel(ball.data, "albedo").copy()
    values[0] = 0.9, 0.1, 0.1
    arrays.write_channel(ball.data, "albedo", values)
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "painted.drgs"))
    kept, before = read(tmp_path / "painted.drgs"), textured_ball()
    near = (before.mesh.faces == 0).any(axis=1)
    albedo = np.append(kept.slots[:, 0], -1)[kept.material]
    np.testing.assert_array_equal(albedo < 0, near)


def test_other_materials_of_an_asset_stay_its_vertices(scene, tmp_path):
    asset = textured_ball()
    half = asset.mesh.textures.material.copy()
    half[half == 1] = -1
    asset.mesh.textures = replace(asset.mesh.textures, material=half)
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "half.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "half.drgs"))
    index = np.empty(len(half), np.int32)
    bpy.context.active_object.data.polygons.foreach_get("material_index", index)
    np.testing.assert_array_equal(index, half + 1)
