"""Images of opacity, emission, specular level and coat on assets' meshes: made, kept, rendered, converted."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from shapes import look_along_y
from test_mesh_textures import converted, png, same, square_file, textured

from drgs_blender.build.make import make_asset, mesh_with_materials
from drgs_blender.core.asset import Asset
from drgs_blender.core.asset.archive import read_archive, write_archive
from drgs_blender.core.asset.container import inspect_asset, read_asset, write_asset
from drgs_blender.core.asset.schema import SINCE, TEXTURES
from drgs_blender.core.asset.textures import COAT, EMISSION, FACTOR_COUNT, OPACITY, SPECULAR, MeshTextures
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import Adjustment, Frame, ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.formats.files import Image, MeshFile
from drgs_blender.formats.images import decode_image
from drgs_blender.formats.registry import read_mesh

#: Left half and right half of the images: colour, opacity, radiance, specular level and coat.
LEFT, RIGHT = ((200, 100, 50), 64, (10, 200, 90), 0, 255), ((40, 120, 220), 255, (0, 0, 0), 255, 0)


def halves(*values: object) -> np.ndarray:
    """A picture of two halves."""
    pixels = np.zeros((16, 16, np.size(values[0])), np.uint8)
    pixels[:, :8], pixels[:, 8:] = np.atleast_1d(values[0]), np.atleast_1d(values[1])
    return pixels[..., 0] if pixels.shape[2] == 1 else pixels


def pictures() -> dict[str, np.ndarray]:
    """Images of all kinds; the first has the opacity as its alpha."""
    colour = halves((*LEFT[0], LEFT[1]), (*RIGHT[0], RIGHT[1]))
    return {
        "albedo": colour, "emission": halves(LEFT[2], RIGHT[2]), "specular": halves(LEFT[3], RIGHT[3]),
        "coat": halves(LEFT[4], RIGHT[4]),
    }  # fmt: skip


def of_everything(**changes: object) -> Asset:
    """The square with all of them."""
    asset = textured(pictures(), (0, -1, -1, -1, 0, 1, 2, 3))
    assert asset.mesh.textures is not None
    asset.mesh.textures.factors[0, 6:] = 1.0, 2.0, 1.5, 1.0, 0.8, 0.5
    asset.mesh.textures = replace(asset.mesh.textures, extensions=np.ones((1, 8)), **changes)
    return asset


def render(tmp_path: Path, asset: Asset, passes: tuple[str, ...] = ("Combined", "Emit"), **state: object):
    write_asset(tmp_path / "a.drgs", asset)
    session = Session()
    key = session.load_asset(tmp_path / "a.drgs")
    settings = RenderSettings(
        samples=4, camera_sees="mesh", rays_see="mesh", subpixel_samples=64, film_transparent=True, bounces=0
    )
    camera = replace(look_along_y(12, focal=12 / 1.8), orthographic=True)
    frame = Frame(0, camera, [ObjectState("thing", key, **state)], World(), settings, passes)
    return session.render(frame)


def sides(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of the left and the right half, without the middle."""
    return values[:, :5].mean(axis=(0, 1)), values[:, 7:].mean(axis=(0, 1))


def test_files_need_the_schema_of_the_slots_only_with_them(tmp_path: Path) -> None:
    asset = of_everything()
    write_asset(tmp_path / "a.drgs", asset)
    assert inspect_asset(tmp_path / "a.drgs")["schema"] == 5
    same(read_asset(tmp_path / "a.drgs"), asset)
    assert {SINCE[TEXTURES, n] for n in inspect_asset(tmp_path / "a.drgs")["members"][TEXTURES]["tensors"]
            if "/" not in n} == {4, 5}  # fmt: skip
    four = textured(pictures(), (0, -1, -1, -1))
    write_asset(tmp_path / "b.drgs", four)
    assert inspect_asset(tmp_path / "b.drgs")["schema"] == 4
    kept = read_asset(tmp_path / "b.drgs").mesh.textures
    assert kept is not None and kept.slots.shape == (1, 8) and kept.optional == ()
    assert asset.mesh.textures is not None
    assert asset.mesh.textures.optional == ("opacity", "emission", "specular", "coat")


def test_slots_that_do_not_fit_are_named(tmp_path: Path) -> None:
    from drgs_blender.core.asset.tensors import decode, encode

    write_asset(tmp_path / "a.drgs", of_everything())
    members = {name: view.tobytes() for name, view in read_archive(tmp_path / "a.drgs").items()}
    whole = decode(np.frombuffer(members[TEXTURES], np.uint8), "a")
    for change in ({"optional_slots": None}, {"optional_factors": whole["optional_factors"][:0]}):
        tensors = {k: v for k, v in (whole | change).items() if v is not None}
        data = b"".join(bytes(part) for part in encode(tensors))
        manifest = json.loads(members["manifest.json"])
        import hashlib

        entry = manifest["members"][TEXTURES]
        entry |= {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        shapes = {k: {"dtype": entry["tensors"][k]["dtype"], "shape": list(v.shape)} for k, v in tensors.items()}
        entry["tensors"] = shapes
        new = members | {"manifest.json": json.dumps(manifest).encode(), TEXTURES: data}
        write_archive(tmp_path / "b.drgs", [(name, [memoryview(part)]) for name, part in new.items()])
        with pytest.raises(AssetError, match=r"optional_\w+: does not fit"):
            read_asset(tmp_path / "b.drgs")


def test_rays_meet_the_images(tmp_path: Path) -> None:
    passes = ("Combined", "Emit", "DiffCol", "GlossCol")
    found = render(tmp_path, of_everything(), passes)
    assert not found.warnings
    (left, right), (glow, dark) = sides(found["Combined"]), sides(found["Emit"])
    share = LEFT[1] / 255
    assert left[3] == pytest.approx(share, abs=0.01) and right[3] == pytest.approx(1, abs=1e-4)
    radiance = srgb_to_linear(np.array(LEFT[2]) / 255) * (2.0, 1.5, 1.0)
    np.testing.assert_allclose(glow, share * radiance, rtol=0.03, atol=1e-4)
    assert not dark.any()
    # On the left no reflection but that of half a coat, on the right a specular level of 0.8 without one.
    bare, (coated, strong) = render(tmp_path, textured(pictures(), (0, -1, -1, -1)), passes), sides(found["GlossCol"])
    plain = sides(bare["GlossCol"])
    assert coated.mean() / share == pytest.approx(0.5 * 0.04, rel=0.15)
    np.testing.assert_allclose(strong, 1.6 * plain[1], rtol=0.06)


def test_adjustments_and_paint_are_those_of_vertices(tmp_path: Path) -> None:
    change = Adjustment(opacity=0.5, emission=3.0)
    before, after = render(tmp_path, of_everything()), render(tmp_path, of_everything(), adjustment=change)
    np.testing.assert_allclose(sides(after["Combined"])[1][3], 0.5, atol=0.01)
    np.testing.assert_allclose(sides(after["Emit"])[0], 1.5 * sides(before["Emit"])[0], rtol=0.05)
    n = len(of_everything().mesh.vertices)
    painted = render(tmp_path, of_everything(), opacity=np.full(n, 0.75, np.float32))
    np.testing.assert_allclose([side[3] for side in sides(painted["Combined"])], 0.75, atol=0.01)
    lit = render(tmp_path, of_everything(), emission=np.full((n, 3), 2.0, np.float32))
    np.testing.assert_allclose(sides(lit["Emit"])[1], 2.0, rtol=1e-3)


@pytest.mark.parametrize("slot", [OPACITY, EMISSION, SPECULAR, COAT])
def test_an_image_that_cannot_be_decoded_is_named_and_the_rest_is_there(tmp_path: Path, slot: int) -> None:
    asset = of_everything()
    textures = asset.mesh.textures
    assert textures is not None
    slots = textures.slots.copy()
    slots[0, 0], name = -1, list(textures.images)[slots[0, slot]]
    asset.mesh.textures = replace(textures, slots=slots, images=textures.images | {name: textures.images[name][:40]})
    found = render(tmp_path, asset)
    (told,) = found.warnings
    assert f"image {name}.png" in told and "thing: " in told
    left, _ = sides(found["Combined"])
    assert np.isfinite(found["Combined"]).all() and (left[3] > 0.99) == (slot == OPACITY)


def material_images() -> dict[str, Image]:
    """Images of a material as readers give them."""
    made = {name: Image(pixels, srgb=name in ("albedo", "emission")) for name, pixels in pictures().items()}
    made["albedo"].file = png(pictures()["albedo"]).tobytes()
    alpha = made["albedo"].alpha
    assert alpha is not None
    return {
        "base_colour_image": made["albedo"], "alpha_image": alpha, "emission_image": made["emission"],
        "specular_image": replace(made["specular"], pixels=(made["specular"].pixels / np.float32(255))),
        "coat_image": made["coat"],
    }  # fmt: skip


def square_of_everything(**changes: object) -> MeshFile:
    file = square_file(4, Image(pictures()["albedo"], srgb=True))
    file.materials[0] = replace(
        file.materials[0], **material_images(), emission=(2.0, 1.5, 1.0), coat=0.5, specular=0.8, alpha=0.9, **changes
    )
    return file


def test_an_asset_keeps_the_images_of_its_file() -> None:
    mesh, report = mesh_with_materials(square_of_everything(), "square", max_triangles=400, max_texture=64)
    textures = mesh.textures
    assert textures is not None and textures.optional == ("opacity", "emission", "specular", "coat")
    (slots,), files = textures.slots, list(textures.images.values())
    assert slots[OPACITY] == slots[0] and files[slots[0]].tobytes() == material_images()["base_colour_image"].file
    assert textures.channel(OPACITY, slots[OPACITY]) == "a" and textures.channel(SPECULAR, slots[SPECULAR]) == "r"
    for slot, name in ((EMISSION, "emission"), (SPECULAR, "specular"), (COAT, "coat")):
        pixels = decode_image(files[slots[slot]].tobytes(), name)
        np.testing.assert_array_equal(pixels[..., 0], pictures()[name].reshape(16, 16, -1)[..., 0])
    np.testing.assert_allclose(textures.factors[0, 6:], (0.9, 2.0, 1.5, 1.0, 0.8, 0.5))
    (note,) = report["notes"]
    assert "triangles became" in note


def test_what_is_cut_out_keeps_its_edges_and_loses_what_is_nowhere() -> None:
    colour = pictures()["albedo"]
    colour[:, :8, 3] = 0
    file = square_of_everything(cut_out=True)
    m = file.materials[0]
    m.base_colour_image = Image(colour, srgb=True, wrap=("clamp", "clamp"))
    m.alpha_image, m.alpha = m.base_colour_image.alpha, 1.0
    mesh, report = mesh_with_materials(file, "square", max_triangles=400, max_texture=64)
    textures = mesh.textures
    assert textures is not None and "opacity" in textures.optional and mesh.opacity is not None
    assert any("transparent faces" in note for note in report["notes"])
    corners = mesh.vertices[mesh.faces][..., 0]
    assert corners.max(axis=1).min() > -0.1  # none lies in the transparent half
    assert corners.min() < 0 and mesh.opacity[mesh.vertices[:, 0] > 0.1].min() == 1
    bare, _ = mesh_with_materials(file, "square", max_triangles=400, max_texture=0)
    assert bare.opacity is None and bare.textures is None


def test_gltf_and_back_keeps_all_channels(tmp_path: Path, capsys) -> None:
    asset = of_everything()
    file = converted(tmp_path, asset, "a.glb")
    assert "1 materials with the images" in capsys.readouterr().out
    (m,) = file.materials
    assert m.base_colour_image is not None and asset.mesh.textures is not None
    assert m.base_colour_image.file == asset.mesh.textures.images["albedo"].tobytes()
    again = make_asset(file, density=20, max_triangles=400, max_texture=64)
    textures = again.mesh.textures
    assert textures is not None and textures.optional == ("opacity", "emission", "specular", "coat")
    np.testing.assert_allclose(textures.factors[0, 6:], asset.mesh.textures.factors[0, 6:], rtol=1e-5)
    once, twice = render(tmp_path, asset), render(tmp_path, again)
    for name in ("Combined", "Emit"):
        for before, after in zip(sides(once[name]), sides(twice[name])):
            np.testing.assert_allclose(after, before, rtol=0.03, atol=3e-3, err_msg=name)


def test_gltf_joins_an_image_of_opacity_with_that_of_the_colours(tmp_path: Path) -> None:
    images = pictures() | {"veil": halves(64, 255)}
    images["albedo"] = images["albedo"][..., :3]
    for slots in ((0, -1, -1, -1, 4, -1, -1, -1), (-1, -1, -1, -1, 4, -1, -1, -1)):
        asset = textured(images, slots)
        assert asset.mesh.textures is not None
        asset.mesh.textures.extensions[:] = 1
        (m,) = converted(tmp_path, asset, "a.glb").materials
        assert m.base_colour_image is not None and m.alpha_image is not None
        np.testing.assert_allclose(m.alpha_image.pixels, halves(64, 255) / np.float32(255), atol=1e-6)
        expected = images["albedo"] if slots[0] == 0 else np.full((16, 16, 3), 255)
        np.testing.assert_array_equal(m.base_colour_image.pixels[..., :3], expected)


def test_usd_has_the_images_of_opacity_emission_and_coat(tmp_path: Path, capsys) -> None:
    from drgs_blender.cli.main import main

    write_asset(tmp_path / "a.drgs", of_everything())
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.usdz")]) == 0
    assert "specular" in capsys.readouterr().out
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        stage, names = archive.read("asset.usda").decode(), archive.namelist()
    for line in (
        "float inputs:opacity.connect = </Asset/Material/Color.outputs:a>",
        "color3f inputs:emissiveColor.connect = </Asset/Material/Emission.outputs:rgb>",
        "float inputs:clearcoat.connect = </Asset/Material/Layers.outputs:r>",
        "float4 inputs:scale = (2, 1.5, 1, 1)",
    ):
        assert line in stage, line
    assert sum(name.endswith(".png") for name in names) == 3


def test_obj_has_images_of_opacity_and_emission(tmp_path: Path) -> None:
    Pillow.fromarray(halves(64, 255)).save(tmp_path / "veil.png")
    Pillow.fromarray(halves(LEFT[2], RIGHT[2])).save(tmp_path / "glow.png")
    (tmp_path / "a.mtl").write_text("newmtl veil\nKd 0.5 0.5 0.5\nmap_d veil.png\nmap_Ke glow.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl veil\n"
        "f 1/1 2/2 3/3 4/4\n"
    )
    asset = make_asset(tmp_path / "a.obj", density=20, max_triangles=200, up="z")
    textures = asset.mesh.textures
    assert textures is not None and textures.optional == ("opacity", "emission")
    assert {d.tobytes() for d in textures.images.values()} == {
        (tmp_path / name).read_bytes() for name in ("veil.png", "glow.png")
    }
    assert textures.channel(OPACITY, textures.slots[0, OPACITY]) == "r"


def test_gltf_names_what_assets_do_not_have(tmp_path: Path) -> None:
    from drgs_blender.formats.glb import Glb

    glb = Glb()
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    attributes = {"POSITION": glb.accessor(corners, bounds=True)}
    extensions = {"KHR_materials_transmission": {"transmissionFactor": 1.0}, "KHR_materials_ior": {"ior": 1.33}}
    glb.json |= {
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "material": 0}]}],
        "materials": [{"name": "glass", "extensions": extensions}],
    }  # fmt: skip
    glb.write(tmp_path / "a.glb")
    file = read_mesh(tmp_path / "a.glb")
    assert file.materials[0].specular == pytest.approx(0.5 * (0.33 / 2.33 / 0.2) ** 2)
    assert "glass: KHR_materials_transmission ignored: its glass is opaque" in file.notes
    assert "glass: IOR 1.33 becomes a specular level" in file.notes


def image_alone(data: bytes) -> MeshTextures:
    """Textures of no face with one image."""
    shapes = {"uvs": (0, 3, 2), "material": (0,), "slots": (0, 8), "factors": (0, FACTOR_COUNT)}
    shapes |= {"transforms": (0, 8, 2, 3), "extensions": (0, 8)}
    arrays = {name: np.zeros(shape) for name, shape in shapes.items()}
    return MeshTextures(**arrays, names=[], images={"image": np.frombuffer(data, np.uint8)})


def test_alpha_of_png_files_is_known_without_decoding() -> None:
    for mode, colour in (("RGB", (1, 2, 3)), ("RGBA", (1, 2, 3, 4)), ("L", 5), ("LA", (5, 6)), ("P", 7)):
        data = io.BytesIO()
        Pillow.new(mode, (3, 2), colour).save(data, "PNG")
        channel = image_alone(data.getvalue()).channel(OPACITY, 0)
        assert (channel == "a") == (decode_image(data.getvalue(), "a").shape[2] == 4), mode
    data = io.BytesIO()
    Pillow.new("P", (3, 2), 7).save(data, "PNG", transparency=7)
    assert image_alone(data.getvalue()).channel(OPACITY, 0) == "a"
    data = io.BytesIO()
    Pillow.new("RGB", (3, 2)).save(data, "JPEG")
    assert image_alone(data.getvalue()).channel(SPECULAR, 0) == "r"
