"""Textured meshes made into assets."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drgs_blender.build.make import _net, make_asset, mesh_with_materials
from drgs_blender.build.refine import _TextureFit
from drgs_blender.build.texture import CHANNELS, Materials
from drgs_blender.build.topology import Net, close_marks, edge_lengths, edges, subdivide, survivors, weld
from drgs_blender.core.errors import AssetError
from drgs_blender.core.mip_pyramid import Pyramid
from drgs_blender.formats.files import Image, MaterialFile, MeshFile


def plane(n: int = 4, image: Image | None = None, **options) -> MeshFile:
    """A unit square in the XY plane of n x n x 2 triangles, uv = xy."""
    ticks = np.linspace(0, 1, n + 1)
    x, y = np.meshgrid(ticks, ticks)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], -1)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n + 2], -1), np.stack([a, a + n + 2, a + n + 1], -1)])
    material = MaterialFile("paint", (1.0, 1.0, 1.0), 0.5, 0.0, base_colour_image=image)
    return MeshFile(
        vertices, faces, corner_uvs=vertices[faces][..., :2].astype(np.float32), materials=[material], **options
    )


def ramp(size: int = 64) -> Image:
    """Red grows with u, green with v (up); linear."""
    centres = (np.arange(size) + 0.5) / size
    pixels = np.zeros((size, size, 3), np.float32)
    pixels[..., 0], pixels[..., 1], pixels[..., 2] = centres, centres[::-1, None], 0.25
    return Image(pixels, srgb=False, wrap=("clamp", "clamp"))


def whole(count: int) -> np.ndarray:
    """Where the corners of faces lie in faces that are not divided."""
    return np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))


def torus_net(n: int = 16) -> Net:
    source = trimesh.creation.torus(1.0, 0.4, n, n)
    k = len(source.vertices)
    return Net(
        source.vertices.copy(), np.arange(k), np.zeros((k, 5)), source.faces.astype(np.int64),
        np.zeros((len(source.faces), 3, 2)), np.zeros((len(source.faces), 2), np.int64), whole(len(source.faces)),
    )  # fmt: skip


def test_vertex_colours_are_the_texture_at_their_uv():
    mesh, report = mesh_with_materials(plane(8, ramp()), "plane")
    inner = (np.abs(mesh.vertices[:, :2] - 0.5) < 0.45).all(axis=1)
    np.testing.assert_allclose(mesh.albedo[inner, :2], mesh.vertices[inner, :2], atol=2e-3)
    assert report["degenerate_faces"] == 0 and mesh.groups["paint"].size == len(mesh.vertices)


def test_images_without_coordinates_are_named():
    file = plane(1, ramp())
    file.materials[0].name, file.corner_uvs = "Paint", None
    mesh, report = mesh_with_materials(file, "plane")
    assert report["notes"] == ["no texture coordinates: images of Paint show a single texel. Unwrap the mesh"]
    assert np.ptp(mesh.albedo, axis=0).max() == 0 and mesh.textures is None
    file.materials[0].base_colour_image = None
    assert not mesh_with_materials(file, "plane")[1]["notes"]


def test_what_is_assumed_of_a_mesh_is_said():
    """No axis and no material: both are told, and neither where it is known."""
    file = plane(1, ramp())

    def told(**given: str) -> str:
        return " ".join(make_asset(file, density=1, **given).provenance["report"]["notes"])

    assert "Z is assumed" in told() and "no material" not in told()
    assert "assumed" not in told(up="y")
    file.materials, file.face_material = [], np.full(len(file.faces), -1)
    assert "no material, though it has texture coordinates" in told()


def test_a_mesh_that_is_divided_says_so():
    """With both numbers and the option, by which the file's own mesh can be kept."""
    squares = np.indices((64, 64)).sum(axis=0) // 4 % 2
    image = Image(np.repeat(squares[..., None], 3, axis=2).astype(np.float32), srgb=False)
    file = plane(8, image)
    faces = len(file.faces)
    mesh, report = mesh_with_materials(file, "plane", max_triangles=500)
    (note,) = report["notes"]
    assert faces < len(mesh.faces) <= 500
    assert f"{faces} triangles became {len(mesh.faces)}, of at most 500 (--max-triangles" in note
    kept, report = mesh_with_materials(file, "plane", max_triangles=faces)
    assert len(kept.faces) == faces and not report["notes"]


def test_srgb_images_are_decoded_and_factors_multiply():
    image = Image(np.full((4, 4, 3), 188, np.uint8), srgb=True)
    file = plane(1, image)
    file.materials[0].base_colour = (1.0, 0.5, 0.0)
    file.materials[0].metallic_roughness_image = Image(np.full((2, 2, 3), [0, 128, 255], np.uint8), srgb=False)
    file.materials[0].roughness, file.materials[0].metallic = 1.0, 0.5
    mesh, _ = mesh_with_materials(file, "plane")
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(mesh.albedo, np.tile([linear, linear / 2, 0], (4, 1)), atol=1e-5)
    np.testing.assert_allclose(mesh.roughness, 128 / 255, atol=1e-5)
    np.testing.assert_allclose(mesh.metallic, 0.5, atol=1e-5)


def test_fine_texture_divides_the_mesh_until_it_is_resolved():
    size = 64
    pixels = np.zeros((size, size, 3), np.float32)
    pixels[:, size // 2 :] = 1.0  # a step in the middle
    file = plane(3, Image(pixels, srgb=False, wrap=("clamp", "clamp")))
    mesh, report = mesh_with_materials(file, "plane", tolerance=0.1)
    assert report["rounds"] >= 3 and len(mesh.faces) > 200
    away = np.abs(mesh.vertices[:, 0] - 0.5) > 0.1
    np.testing.assert_allclose(mesh.albedo[away, 0], mesh.vertices[away, 0] > 0.5, atol=1e-3)
    near = np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, 0] - 0.5) < 0.02
    lengths = np.linalg.norm(np.diff(mesh.vertices[mesh.faces][:, [0, 1]], axis=1)[:, 0], axis=1)
    assert np.median(lengths[near]) < 0.1 * np.median(lengths[~near].max())


def test_budget_is_kept_and_what_is_missing_is_told():
    rng = np.random.default_rng(0)
    file = plane(4, Image(rng.random((256, 256, 3)).astype(np.float32), srgb=False))
    mesh, report = mesh_with_materials(file, "plane", max_triangles=500)
    assert 200 < len(mesh.faces) <= 500 and report["unresolved_edges"] > 0


def test_minified_texture_is_averaged_not_sampled():
    checks = (np.indices((256, 256)).sum(axis=0) % 2).astype(np.float32)[..., None].repeat(3, axis=2)
    pyramid = Pyramid(Image(checks, srgb=False))
    rng = np.random.default_rng(0)
    values = pyramid.sample(rng.uniform(0, 256, (500, 2)), np.full(500, 8.0))
    np.testing.assert_allclose(values, 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("wrap", "at", "value"),
    [
        ("repeat", 4.5, 0),
        ("repeat", -0.5, 3),
        ("clamp", 9.5, 3),
        ("clamp", -3.5, 0),
        ("mirror", 4.5, 3),
        ("mirror", 5.5, 2),
    ],
)
def test_wrap_modes(wrap, at, value):
    pixels = np.arange(4, dtype=np.float32)[None, :, None].repeat(3, axis=2).repeat(4, axis=0)
    pyramid = Pyramid(Image(pixels, srgb=False, wrap=(wrap, wrap)))
    assert pyramid.sample(np.array([[at, 1.5]]), np.ones(1))[0, 0] == value


def test_texture_transform_moves_the_lookup():
    image = ramp()
    image.uv_transform = np.array([[0.5, 0, 0.25], [0, 0.5, 0.25]])
    values = Materials([MaterialFile("m", (1, 1, 1), base_colour_image=image)]).sample(
        np.zeros(1, int), np.array([[0.2, 0.8]]), np.zeros((1, 2))
    )
    np.testing.assert_allclose(values[0, :2], [0.35, 0.65], atol=1e-3)


def test_seams_are_merged_hard_edges_and_materials_are_not():
    cube = trimesh.creation.box()
    vertices, faces = cube.vertices[cube.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    hard = np.repeat(cube.face_normals[:, None], 3, axis=1)
    one = np.zeros(12, int)
    assert len(weld(vertices, faces, one, None)[0]) == 8
    source, point, welded = weld(vertices, faces, one, hard)
    assert len(source) == 24 and point.max() + 1 == 8
    np.testing.assert_array_equal(vertices[source][welded], vertices[faces])
    two = (cube.face_normals[:, 2] > 0.5).astype(int)
    assert len(weld(vertices, faces, two, None)[0]) == 12


@pytest.mark.parametrize("seed", range(4))
def test_subdivision_stays_watertight_and_shapely(seed):
    rng = np.random.default_rng(seed)
    net = torus_net()
    volume = trimesh.Trimesh(net.vertices, net.faces, process=False).volume
    smallest = trimesh.Trimesh(net.vertices, net.faces, process=False).face_angles.min()
    for _ in range(6):
        edge, count = edges(net)
        net = subdivide(net, edge, close_marks(edge, edge_lengths(net), rng.random(count) < 0.05))
    mesh = trimesh.Trimesh(net.vertices, net.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volume, rel=1e-9)
    assert mesh.face_angles.min() > 0.45 * smallest


def test_what_a_division_leaves_is_known_and_looked_up_once():
    """Errors of a divided net are to the bit those of one that was never seen before."""
    rng = np.random.default_rng(3)
    pixels = rng.random((64, 64, 3)).astype(np.float32)
    file = plane(6, Image(pixels, srgb=False), vertex_roughness=np.linspace(0, 1, 49).astype(np.float32))
    materials = Materials(file.materials)
    net, _, _ = _net(file, "plane", {"notes": []}, CHANNELS)
    edge, count = edges(net)
    fit, known = _TextureFit(net, edge, edge_lengths(net), materials), 0
    for _ in range(5):
        marked = close_marks(edge, edge_lengths(net), rng.random(count) < 0.03)
        kept, before = survivors(net, edge, marked), net
        net = subdivide(net, edge, marked)
        rows = np.flatnonzero(kept >= 0)
        known += len(rows)
        assert len(kept) == len(net.faces) and len(rows) < len(kept)
        for name in ("faces", "uvs", "tags"):
            np.testing.assert_array_equal(getattr(net, name)[rows], getattr(before, name)[kept[rows]])
        edge, count = edges(net)
        lengths = edge_lengths(net)
        fit = _TextureFit(net, edge, lengths, materials, fit, kept)
        fresh = _TextureFit(net, edge, lengths, materials)
        np.testing.assert_array_equal(fit.errors, fresh.errors)
        np.testing.assert_array_equal(fit.values, fresh.values)
    assert known and fit.errors.max() > 0.1


def test_an_edge_that_both_faces_see_alike_is_looked_up_once_and_a_seam_twice():
    rng = np.random.default_rng(5)
    file = plane(6, Image(rng.random((64, 64, 3)).astype(np.float32), srgb=False))
    net, _, _ = _net(file, "plane", {"notes": []}, CHANNELS)
    net.uvs[::5] += 0.3  # islands of their own
    edge, count = edges(net)
    materials = Materials(file.materials)
    lookups = []
    sample = materials.sample
    materials.sample = lambda material, *rest: lookups.append(len(material)) or sample(material, *rest)
    together = _TextureFit(net, edge, edge_lengths(net), materials).errors
    shared, lookups[:] = sum(lookups), []
    apart = _TextureFit(net, np.arange(edge.size).reshape(edge.shape), edge_lengths(net), materials).errors
    np.testing.assert_array_equal(together, apart)
    assert 0 < sum(lookups) - shared < 3 * (edge.size - count)  # three points an edge, but not at seams


def test_images_of_one_layout_are_found_as_each_alone():
    rng = np.random.default_rng(6)
    colour, rough = (Image(rng.random((16, 8, 3)).astype(np.float32), srgb=False) for _ in range(2))
    uvs, scale, one = rng.normal(size=(500, 2)), rng.random((500, 2)) ** 4, np.zeros(500, int)
    both, first, second = (
        Materials([MaterialFile("m", (1, 1, 1), 1, 1, base_colour_image=a, metallic_roughness_image=b)])
        for a, b in ((colour, rough), (colour, None), (None, rough))
    )
    found = both.sample(one, uvs, scale)
    np.testing.assert_array_equal(found[:, :3], first.sample(one, uvs, scale)[:, :3])
    np.testing.assert_array_equal(found[:, 3:], second.sample(one, uvs, scale)[:, 3:])


def test_no_crack_opens_between_vertices_that_share_a_place():
    cube = trimesh.creation.box()
    vertices, faces = cube.vertices[cube.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    source, point, welded = weld(vertices, faces, np.zeros(12, int), np.repeat(cube.face_normals[:, None], 3, axis=1))
    net = Net(vertices[source], point, np.zeros((24, 5)), welded, np.zeros((12, 3, 2)), np.zeros((12, 2), int),
              whole(12))  # fmt: skip
    rng = np.random.default_rng(1)
    for _ in range(5):
        edge, count = edges(net)
        net = subdivide(net, edge, close_marks(edge, edge_lengths(net), rng.random(count) < 0.1))
    by_place = trimesh.Trimesh(
        net.vertices[np.unique(net.point, return_index=True)[1]], net.point[net.faces], process=False
    )
    assert by_place.is_watertight and by_place.volume == pytest.approx(1)
    by_vertex = trimesh.Trimesh(net.vertices, net.faces, process=False)
    assert len(by_vertex.split(only_watertight=False)) == 6  # hard edges stay hard


def test_bad_faces_are_removed_and_counted():
    file = plane(2)
    vertices = np.concatenate([file.vertices, [[np.nan, 0, 0]]])
    faces = np.concatenate([file.faces, [[0, 0, 1], [0, 1, 2], [0, 1, len(vertices) - 1]]])  # 0, 1, 2 are in line
    mesh, report = mesh_with_materials(MeshFile(vertices, faces), "bad")
    assert len(mesh.faces) == 8 and np.isfinite(mesh.vertices).all()
    assert report["degenerate_faces"] == 2 and report["not_finite_faces"] == 1
    assert "2 faces without area removed" in report["notes"]  # which the command line prints


def test_meshes_without_a_surface_are_refused_by_name():
    with pytest.raises(AssetError, match=r"thing\.obj: has no faces"):
        mesh_with_materials(MeshFile(np.zeros((3, 3)), np.zeros((0, 3))), "thing.obj")
    with pytest.raises(AssetError, match="none with an area"):
        mesh_with_materials(MeshFile(np.zeros((3, 3)), [[0, 1, 2]]), "thing.obj")


@pytest.mark.parametrize("scale", [1e-20, 1e-12, 1e15])
def test_sizes_that_floats_cannot_hold_are_refused(scale):
    with pytest.raises(AssetError, match=r"mesh: measures .* m, at which"):
        file = plane()
        file.vertices *= np.float32(scale)
        make_asset(file)


def test_faces_lost_to_vertices_without_a_place_are_said(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(AssetError, match=r"a\.obj: has no faces that are left \(1 vertices that are NaN"):
        make_asset(path)


def test_y_up_files_are_turned_and_vertex_materials_win():
    file = plane(1)
    file.materials, file.face_material = [], np.full(2, -1)
    n = len(file.vertices)
    file.vertex_colours, file.vertex_roughness = np.full((n, 3), 0.3), np.full(n, 0.9)
    asset = make_asset(file, up="y", density=10)
    np.testing.assert_allclose(asset.mesh.vertices[:, 1], 0, atol=1e-7)
    np.testing.assert_allclose(asset.mesh.albedo, 0.3, atol=1e-6)
    np.testing.assert_allclose(asset.surfels.roughness, 0.9, atol=1e-6)
    assert asset.binding is not None and asset.provenance["report"]["surfels"]["surfels"] == len(asset.surfels)


@pytest.mark.slow
def test_textured_cat_keeps_its_picture(shared_data):
    asset = make_asset(shared_data / "meshes/pbr/egyptian_cat.glb", max_triangles=20_000)
    report = asset.provenance["report"]
    assert 4622 < report["faces"] <= 20_000 and report["vertices"] < 0.55 * report["faces"]
    assert "M_Cat_Statue" in asset.mesh.groups
    assert asset.mesh.albedo.std() > 0.05 and len(asset.surfels) > 20_000
