"""Surfels show what a file's textures, normals and normal maps have between the vertices of the asset's mesh."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image as Pillow
from test_build_make import plane, ramp

from drgs_blender.build import make
from drgs_blender.build.make import make_asset, read_mesh_file
from drgs_blender.build.surface_detail import CornerFrames
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset
from drgs_blender.core.errors import AssetError
from drgs_blender.deform.face_frames import Faces, shading_frames
from drgs_blender.formats.files import Image, MaterialFile, MeshFile
from drgs_blender.formats.registry import read_mesh

#: Density at which a square has two thousand surfels, where each of them is to be right.
FEW = 30.0


def shading_normals(asset: Asset) -> np.ndarray:
    """(n, 3) normals with which surfels are shaded at rest, object space."""
    mesh, binding = asset.mesh, asset.binding
    faces = Faces.of(mesh.vertices, mesh.faces)
    frames = shading_frames(faces, mesh.faces, mesh.vertices, binding.face, binding.barycentric.astype(np.float64))
    return np.einsum("nij,nj->ni", frames, binding.normal)


def flat_map(normal: tuple[float, float, float], size: int = 8) -> Image:
    """A normal map of one normal in tangent space."""
    pixels = np.tile(0.5 + 0.5 * np.float32(normal) / np.linalg.norm(normal), (size, size, 1))
    return Image(pixels.astype(np.float32), srgb=False)


def bumped(normal: tuple[float, float, float], uvs=None, strength: float = 1.0) -> MeshFile:
    """A unit square in the XY plane with a normal map of one normal."""
    file = plane(3)
    file.materials = [MaterialFile("bumps", normal_image=flat_map(normal), normal_strength=strength)]
    return file if uvs is None else replace(file, corner_uvs=np.float32(uvs(file.corner_uvs)))


@pytest.mark.parametrize(
    ("uvs", "turn"),
    [
        (lambda uv: uv, np.eye(3)),
        (lambda uv: 3 * uv + 0.4, np.eye(3)),
        (lambda uv: np.stack([uv[..., 1], -uv[..., 0]], -1), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])),
        (lambda uv: uv * np.float32((-1, 1)), np.diag((-1, 1, 1))),  # mirrored
        (lambda uv: uv * np.float32((1, -1)), np.diag((1, -1, 1))),
    ],
)
def test_normal_maps_turn_with_their_texture_coordinates(uvs, turn: np.ndarray) -> None:
    """The first axis of the map is where u grows, the second where v does."""
    normal = np.array((0.5, 0.2, 0.8))
    asset = make_asset(bumped(tuple(normal), uvs), density=FEW)
    expected = np.tile(turn @ normal / np.linalg.norm(normal), (len(asset.surfels), 1))
    np.testing.assert_allclose(shading_normals(asset), expected, atol=2e-3)


@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0, 2.0])
def test_strength_is_that_of_blenders_node(strength: float) -> None:
    """x and y grow with it, z is mixed with 1 up to a strength of 1."""
    normal = np.array((0.5, 0.0, 0.8))
    normal /= np.linalg.norm(normal)
    z = 1 + (normal[2] - 1) * min(strength, 1)
    found = shading_normals(make_asset(bumped((0.5, 0.0, 0.8), strength=strength), density=FEW))
    np.testing.assert_allclose(found[:, 0] / found[:, 2], strength * normal[0] / z, rtol=5e-3, atol=2e-3)


def ball(subdivisions: int, image: Image | None = None) -> MeshFile:
    """A sphere with latitude and longitude as texture coordinates."""
    mesh = trimesh.creation.icosphere(subdivisions)
    v = mesh.vertices[mesh.faces]
    uvs = np.stack([0.5 + np.arctan2(v[..., 1], v[..., 0]) / (2 * np.pi), 0.5 + np.arcsin(v[..., 2]) / np.pi], -1)
    return MeshFile(
        mesh.vertices, mesh.faces, corner_uvs=uvs, materials=[MaterialFile("paint", base_colour_image=image)]
    )


def checker(size: int = 256, cells: int = 32) -> Image:
    pixels = (np.indices((size, size)) // (size // cells)).sum(axis=0) % 2 * 0.6 + 0.2
    return Image(np.repeat(pixels[..., None], 3, axis=2).astype(np.float32), srgb=False)


def test_a_divided_ball_is_shaded_as_smoothly_as_its_file() -> None:
    """Divided faces stay flat; by their own normals the ball would show its 320 faces."""
    asset = make_asset(ball(2, checker()), max_triangles=4000, max_surfels=10_000)
    assert len(asset.mesh.faces) > 2000
    radial = asset.surfels.centre / np.linalg.norm(asset.surfels.centre, axis=1, keepdims=True)
    error = np.degrees(np.arccos(np.clip((shading_normals(asset) * radial).sum(1), -1, 1)))
    flat = Faces.of(asset.mesh.vertices, asset.mesh.faces).normal[asset.binding.face]
    of_faces = np.degrees(np.arccos(np.clip((flat * radial).sum(1), -1, 1)))
    assert np.percentile(error, 99) < 0.9 and np.median(error) < 0.3
    assert np.percentile(of_faces, 99) > 6


def test_normals_of_the_file_shade_a_mesh_that_is_divided() -> None:
    """Corner normals that lean, as those of a bevel do."""
    file = plane(2, ramp())
    lean = np.array((0.3, 0.0, 1.0)) / np.hypot(0.3, 1.0)
    file = replace(file, corner_normals=np.tile(lean.astype(np.float32), (8, 3, 1)))
    asset = make_asset(file)
    assert len(asset.mesh.faces) > 8
    np.testing.assert_allclose(shading_normals(asset), np.tile(lean, (len(asset.surfels), 1)), atol=2e-3)


def test_surfels_show_textures_that_the_mesh_has_no_vertices_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """More surfels, less error; none where nothing is hidden, and never more than the budget."""
    file = plane(2, checker(240, 15))  # its edges are not those of halved triangles

    def error_of(asset: Asset) -> float:
        x, y = asset.surfels.centre[:, :2].T
        cell = (np.floor(x * 15) + np.floor((1 - y) * 15)) % 2 * 0.6 + 0.2
        size = np.linalg.norm(asset.surfels.scale, axis=1)
        return float((np.abs(asset.surfels.albedo[:, 0] - cell) * size**2).sum() / (size**2).sum())

    coarse, fine = (make_asset(file, max_triangles=8, density=10, max_surfels=most) for most in (300, 20_000))
    assert len(coarse.surfels) == 300 and 2000 < len(fine.surfels) <= 20_000
    assert error_of(fine) < 0.35 * error_of(coarse)
    assert coarse.provenance["report"]["surfels"]["hidden_pieces"] > 100
    (note,) = coarse.provenance["report"]["surfels"]["notes"]
    left = coarse.provenance["report"]["surfels"]["hidden_pieces"]
    assert note.startswith(f"{left} of 300 surfels are coarser than the textures") and "--max-surfels 300 is" in note
    dense = make_asset(file, max_triangles=8, density=10, max_surfels=1)
    (note,) = dense.provenance["report"]["surfels"]["notes"]
    assert len(dense.surfels) == 256 and "--density 10 alone makes 256 of them, --max-surfels is 1" in note
    enough = make_asset(plane(2, checker(8, 2)), max_triangles=8, density=10, max_surfels=20_000)
    assert len(enough.surfels) < 20_000 and "notes" not in enough.provenance["report"]["surfels"]
    monkeypatch.setattr(make, "DENSITY", 10.0)
    monkeypatch.setattr(make, "MAX_SURFELS", 1)
    plain = make_asset(file, max_triangles=8)  # defaults that meet are not the user's choice
    assert len(plain.surfels) == 256 and "notes" not in plain.provenance["report"]["surfels"]
    for chosen in ({"density": 10}, {"max_surfels": 1}):
        (note,) = make_asset(file, max_triangles=8, **chosen).provenance["report"]["surfels"]["notes"]
        assert "--density 10 alone makes 256 of them, --max-surfels is 1" in note
    plain = make_asset(plane(2), max_triangles=8, density=10, max_surfels=20_000)
    assert len(plain.surfels) == 256 and "hidden_pieces" not in plain.provenance["report"]["surfels"]


def test_vertex_colours_multiply_and_given_roughness_replaces() -> None:
    file = plane(2, ramp())
    colours = np.full((9, 3), 0.5, np.float32)
    file = replace(file, vertex_colours=colours, vertex_roughness=np.linspace(0.2, 0.8, 9, dtype=np.float32))
    asset = make_asset(file)
    x, y = asset.surfels.centre[:, :2].T
    inner = (np.abs(asset.surfels.centre[:, :2] - 0.5) < 0.4).all(axis=1)
    np.testing.assert_allclose(asset.surfels.albedo[inner, 0], 0.5 * x[inner], atol=5e-3)
    np.testing.assert_allclose(asset.surfels.roughness, 0.2 + 0.15 * x + 0.45 * y, atol=1e-3)


def test_tangents_are_shared_across_faces_but_not_across_mirrored_ones() -> None:
    """Two quads bent like a book: one frame along the fold, two where the texture is mirrored there."""
    vertices = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0.5], [1, 1, 0.5], [-1, 0, 0.5], [-1, 1, 0.5]], float)
    faces = np.array([[0, 2, 3], [0, 3, 1], [4, 0, 1], [4, 1, 5]])
    flat = vertices[:, :2]
    for mirrored in (False, True):
        uvs = flat[faces].copy()
        if mirrored:
            uvs[2:, :, 0] *= -1
        frames = CornerFrames.of(vertices, faces, uvs, None)
        right, left = frames.tangent[0, 0], frames.tangent[2, 1]  # both at vertex 0
        assert frames.side.tolist() == [1, 1, 1 - 2 * mirrored, 1 - 2 * mirrored]
        assert np.allclose(right, left, atol=1e-6) is not mirrored
        np.testing.assert_allclose((frames.tangent * frames.normal).sum(-1), 0, atol=1e-6)


def test_bad_texture_coordinates_do_no_harm() -> None:
    """All at one place, or not finite."""
    for uvs in (lambda uv: np.zeros_like(uv), lambda uv: np.full_like(uv, np.nan), lambda uv: uv * 1e8):
        asset = make_asset(bumped((0.5, 0.2, 0.8), uvs), density=FEW)
        found = shading_normals(asset)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-3)
        assert (found[:, 2] > 0).all()


def leaf(size: int = 128) -> np.ndarray:
    """(size, size) bool, row 0 at the top: a disc of radius .3 in the middle."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size - 0.5
    return np.hypot(x, y) < 0.3


def card(material: MaterialFile) -> MeshFile:
    file = plane(2)
    file.materials = [material]
    return file


def alpha_image(alpha: np.ndarray) -> Image:
    return Image(alpha.astype(np.float32)[..., None], srgb=False, wrap=("clamp", "clamp"))


@pytest.mark.parametrize("said", [True, False])
def test_cut_out_cards_keep_the_leaf_alone(said: bool) -> None:
    """Whether the file says so, or only that it has alpha."""
    file = card(MaterialFile("leaf", alpha_image=alpha_image(leaf()), cut_out=said))
    asset = make_asset(file, max_texture=0)
    mesh = asset.mesh
    area = Faces.of(mesh.vertices, mesh.faces).area.sum()
    assert area == pytest.approx(np.pi * 0.09, rel=0.01)
    far = np.hypot(*(mesh.vertices[mesh.faces].mean(axis=1)[:, :2] - 0.5).T)
    assert far.max() < 0.305
    inside = np.hypot(*(asset.surfels.centre[:, :2] - 0.5).T) < 0.28
    assert asset.surfels.opacity[inside].min() > 0.95
    assert mesh.source_count == 9 and len(mesh.in_own_order(np.ones((9, 3)))) == len(mesh.vertices)
    assert any("cut out" in note for note in asset.provenance["report"]["notes"])
    # With the image, whose alpha cuts, faces that the edge crosses stay; surfels beyond it show nothing.
    whole = make_asset(file)
    kept = Faces.of(whole.mesh.vertices, whole.mesh.faces).area.sum()
    assert area < kept < 2 * area and whole.mesh.textures is not None
    assert whole.mesh.textures.optional == ("opacity",)
    far = np.hypot(*(whole.surfels.centre[:, :2] - 0.5).T)
    assert whole.surfels.opacity[far > 0.32].max() < 0.05 and whole.surfels.opacity[far < 0.28].min() > 0.95


def test_glass_keeps_its_opacity() -> None:
    asset = make_asset(card(MaterialFile("lens", alpha=0.3)), density=FEW)
    assert asset.surfels.opacity.min() > 0.95 and (asset.mesh.opacity == np.float32(0.3)).all()
    veil = make_asset(card(MaterialFile("veil", alpha_image=alpha_image(np.full((4, 4), 0.4)))), density=FEW)
    assert veil.surfels.opacity.min() > 0.95 and len(veil.mesh.faces) == 8
    np.testing.assert_allclose(veil.mesh.opacity, 0.4, atol=1e-6)
    assert make_asset(card(MaterialFile("solid")), density=FEW).mesh.opacity is None


def test_emission_specular_and_coat_are_kept(tmp_path) -> None:
    """Radiance beyond 1 is not cut, and its texture divides the mesh."""
    half = np.zeros((64, 64, 3), np.float32)
    half[:, :32] = 1
    image = Image(half, srgb=False, wrap=("clamp", "clamp"))
    file = card(MaterialFile("lamp", emission=(20.0, 10.0, 0.0), emission_image=image, specular=0.25, coat=0.75))
    asset = make_asset(file)
    left = asset.mesh.vertices[:, 0] < 0.45
    np.testing.assert_allclose(asset.mesh.emission[left], np.tile([20, 10, 0], (left.sum(), 1)), rtol=1e-3)
    assert not asset.mesh.emission[asset.mesh.vertices[:, 0] > 0.55].any() and len(asset.mesh.faces) > 8
    bright = asset.surfels.centre[:, 0] < 0.45
    np.testing.assert_allclose(asset.surfels.emission[bright, 0], 20, rtol=1e-3)
    assert (asset.mesh.specular == 0.25).all() and (asset.surfels.coat == 0.75).all() and asset.mesh.opacity is None
    write_asset(tmp_path / "a.drgs", asset)
    again = read_asset(tmp_path / "a.drgs")
    for name in ("emission", "specular", "coat"):
        np.testing.assert_array_equal(getattr(again.mesh, name), getattr(asset.mesh, name))
        np.testing.assert_array_equal(getattr(again.surfels, name), getattr(asset.surfels, name))


def test_obj_emits(tmp_path) -> None:
    lines = "newmtl glow\nKd 1 1 1\nKe 4 2 1\nd 0.5\nPc 0.3\nnewmtl bad\nKe nan 0 0\n"
    (tmp_path / "m.mtl").write_text(lines)
    text = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl glow\nf 1 2 3\nusemtl bad\nf 1 3 2\n"
    (tmp_path / "a.obj").write_text(text)
    file = read_mesh(tmp_path / "a.obj")
    glow, bad = file.materials
    assert (glow.emission, glow.alpha, glow.coat) == ((4.0, 2.0, 1.0), 0.5, 0.3)
    assert not any(bad.emission) and any("Ke nan" in note for note in file.notes)


def test_nothing_but_holes_is_refused() -> None:
    with pytest.raises(AssetError, match="transparent everywhere"):
        make_asset(card(MaterialFile("gone", alpha_image=alpha_image(np.zeros((4, 4))), cut_out=True)))


def test_obj_knows_alpha_and_normal_maps(tmp_path) -> None:
    pixels = (leaf(32) * 255).astype(np.uint8)
    Pillow.fromarray(np.dstack([np.full((32, 32, 3), 90, np.uint8), pixels])).save(tmp_path / "leaf.png")
    bumps = np.tile(np.uint8([160, 128, 230]), (8, 8, 1))
    bumps[0, 0] = 128, 128, 255
    Pillow.fromarray(bumps).save(tmp_path / "bumps.png")
    Pillow.fromarray(np.full((8, 8), 90, np.uint8)).save(tmp_path / "heights.png")
    (tmp_path / "card.mtl").write_text(
        "newmtl leaf\nKd 1 1 1\nmap_d leaf.png\nnorm -bm 0.5 bumps.png\nnewmtl glass\nd 0.25\nmap_Bump heights.png\n"
    )
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "card.obj").write_text(
        f"mtllib card.mtl\n{corners}usemtl leaf\nf 1/1 2/2 3/3 4/4\nusemtl glass\nf 1 2 3\n"
    )
    file = read_mesh_file(tmp_path / "card.obj")
    material, glass = file.materials
    np.testing.assert_array_equal(material.alpha_image.pixels > 0.5, leaf(32))
    assert material.normal_strength == 0.5 and material.normal_image.pixels.shape == (8, 8, 3)
    assert glass.alpha == 0.25 and glass.normal_image is None
    assert any("heights" in note and "ignored" in note for note in file.notes)


@pytest.mark.parametrize("statement", ["norm", "map_Kd", "bump -bm", "bump -bm nan n.png", "bump -bm x n.png"])
def test_map_statements_without_sense_are_named(tmp_path, statement: str) -> None:
    """Of an MTL file; all others count."""
    file = plane(1)
    (tmp_path / "n.png").write_bytes(png_of(flat_map((0.5, 0.2, 0.8))))
    lines = [f"v {x} {y} {z}" for x, y, z in file.vertices] + [f"vt {x} {y}" for x, y in file.vertices[:, :2]]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in file.faces]
    (tmp_path / "a.obj").write_text("\n".join(["mtllib a.mtl", "usemtl m", *lines]))
    (tmp_path / "a.mtl").write_text(f"newmtl m\n{statement}\nPr 0.25\n")
    asset = make_asset(tmp_path / "a.obj")
    notes = [note for note in asset.provenance["report"]["notes"] if "axis is up" not in note]
    assert len(notes) == 1 and ("not understood" in notes[0] or "not found" in notes[0])
    assert (asset.surfels.roughness == 0.25).all() and (asset.binding.normal == (0, 0, 1)).all()


def png_of(image: Image) -> bytes:
    buffer = io.BytesIO()
    Pillow.fromarray((image.pixels * 255 + 0.5).astype(np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()
