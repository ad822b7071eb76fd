"""Normal maps, bump maps and layers of ordinary meshes: closed forms, what they leave alone, and broken input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_surface import MATRICES, aimed_rays, lumpy, matrix, meet, mesh_state

from drgs_blender.compute.jit import njit, plain
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.core.frame import Layer
from drgs_blender.core.materials import Image, Material, SurfaceDetail, Texture
from drgs_blender.render.memory import address
from drgs_blender.render.scene.tangents import WORDS, corner_tangents, tangent_at
from drgs_blender.render.scene.trace_scene import TraceScene

SQUARE = np.float32([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
FACES = np.int32([[0, 1, 2], [0, 2, 3]])
UVS = np.float32([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
RNG = np.random.default_rng(5)


def square(*details: SurfaceDetail, place: np.ndarray | None = None, **changes):
    material = Material("m", (0.5, 0.5, 0.5), details=list(details))
    places = (np.eye(4) if place is None else place,)
    return mesh_state(SQUARE, FACES, *places, uvs=UVS, materials=[changes.pop("material", material)], **changes)


def from_above(states: list, images: list[Image] = [], count: int = 200) -> tuple[np.ndarray, np.ndarray, TraceScene]:  # noqa: B006
    """Places (n, 2) on a square at the origin and the surfaces (n, 17) that rays from above find there."""
    scene = TraceScene()
    scene.update([], states, images)
    where = np.random.default_rng(1).uniform(0.05, 1.95, (count, 2)).astype(np.float32)
    origins = np.column_stack([where, np.full(count, 3.0)])
    _, numbers, surface = meet(scene, origins, np.tile((0.0, 0.0, -1.0), (count, 1)))
    assert (numbers[:, 0] >= 0).all()
    return where, surface, scene


def ramp() -> Image:
    """Heights that rise by 1 along u and fall by half of it along v, of 64 texels a side."""
    v, u = (np.mgrid[0:64, 0:64] + 0.5) / 64
    pixels = np.ones((64, 64, 4), np.float32)
    pixels[..., :3] = (u - 0.5 * (1 - v))[..., None]
    return Image("ramp", pixels)


def test_a_bump_map_is_the_slope_of_its_height():
    """Over two metres the height rises by distance times 1: the normal leans by its derivative."""
    detail = SurfaceDetail("bump", Texture("ramp", "r", extension="extend"), distance=0.6)
    _, surface, scene = from_above([square(detail)], [ramp()])
    inside = (surface[:, 14:16] > 0.1).all(axis=1) & (surface[:, 14:16] < 1.9).all(axis=1)
    expected = np.array((-0.6 / 2, 0.5 * 0.6 / 2, 1.0))
    np.testing.assert_allclose(
        surface[inside, :3], np.tile(expected / np.linalg.norm(expected), (inside.sum(), 1)), atol=2e-5
    )
    scene.close()


@pytest.mark.parametrize("transform", [np.eye(2, 3), np.array([[0.0, 2.0, 0.1], [-0.7, 0.3, 0.2]])])
@pytest.mark.parametrize("extension", ["repeat", "mirror", "extend"])
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_slopes_are_those_of_the_lookup(transform, extension, encoding):
    """Of random texels: differences of the heights that the same texture shows as colours."""
    image = Image("i", RNG.integers(0, 255, (5, 7, 4), dtype=np.uint8), encoding)
    texture = Texture("i", "g", transform, extension=extension)
    detail = SurfaceDetail("bump", texture)
    where, surface, scene = from_above([square(detail)], [image], 400)
    scene.close()
    paint = Material("p", (1, 1, 1), base_colour_texture=texture)
    table_scene = TraceScene()
    table_scene.update([], [square(material=paint)], [image])
    step = 2e-3

    def height(dx: float, dy: float) -> np.ndarray:
        uv = (where + np.array((dx, dy))) / 2
        return table_scene.mesh_materials.table.lookup(np.zeros(len(uv), int), uv)[:, 0].astype(float)

    slope_x = (height(step, 0) - height(-step, 0)) / (2 * step)
    slope_y = (height(0, step) - height(0, -step)) / (2 * step)
    expected = np.stack([-slope_x, -slope_y, np.ones(len(where))], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    table_scene.close()
    # Where the four texels change within a step there is an edge.
    close = np.abs(surface[:, :3] - expected).max(axis=1) < 5e-3
    assert close.mean() > 0.9


def test_flat_maps_change_nothing_and_plain_materials_beside_them_stay_as_they_are():
    vertices, faces = lumpy()
    uvs = RNG.uniform(0, 1, (len(faces), 3, 2)).astype(np.float32)
    flat = Image("flat", np.full((2, 2, 4), (0.5, 0.5, 1.0, 1.0), np.float32))
    details = [SurfaceDetail("tangent", Texture("flat")), SurfaceDetail("bump", Texture("flat", "b"))]
    # A stretched shape has its normals blended before the matrix with a map, as in Cycles, and after it without.
    places = MATRICES[0], MATRICES[3]
    plain = [mesh_state(vertices, faces, *places, uvs=uvs, materials=[Material("plain")])]
    mapped = [replace(plain[0], materials=[Material("mapped", details=details)])]
    beside = [*plain, mesh_state(SQUARE + 50, FACES, uvs=UVS, materials=mapped[0].materials)]
    found = []
    for states in (plain, mapped, beside):
        scene = TraceScene()
        scene.update([], states, [flat])
        found.append(meet(scene, *aimed_rays(2000))[2])
        scene.close()
    np.testing.assert_array_equal(found[2], found[0])
    np.testing.assert_allclose(found[1][:, :3], found[0][:, :3], atol=2e-6)
    np.testing.assert_array_equal(found[1][:, 3:], found[0][:, 3:])


@pytest.mark.parametrize("kind", ["tangent", "object", "blender_object"])
def test_instances_are_shaded_as_copies(kind):
    """Turned, stretched and mirrored: one shape in several places is each of them alone."""
    vertices, faces = lumpy()
    image = Image("i", RNG.integers(60, 200, (3, 3, 4), dtype=np.uint8))
    uvs = (0.4 * vertices[:, :2]).astype(np.float32)[faces]
    details = [SurfaceDetail(kind, Texture("i"), strength=0.7), SurfaceDetail("bump", Texture("i", "r"), distance=0.1)]
    shape = mesh_state(vertices, faces, *MATRICES, uvs=uvs, materials=[Material("m", details=details)])
    copies = [replace(shape, name=f"{i}", matrices=m[None], pass_indices=np.int32([i])) for i, m in enumerate(MATRICES)]
    found = []
    for states in ([shape], copies):
        scene = TraceScene()
        scene.update([], states, [image])
        found.append(meet(scene, *aimed_rays(4000))[2][:, :3])
        scene.close()
    # Both trees may find another face along an edge.
    assert (np.abs(found[0] - found[1]).max(axis=1) < 2e-3).mean() > 0.995


@njit
def _at_corners(faces, rows, normals, layers, out):  # type: ignore[no-untyped-def]
    for face in range(len(faces)):
        corners = (3 * np.int64(rows[face, 0]), 3 * np.int64(rows[face, 1]), 3 * np.int64(rows[face, 2]))
        for k in range(3):
            place = np.float32(0), np.float32(0), face, np.float32(k == 1), np.float32(k == 2)
            x, y, z, sign = tangent_at(np.int64(0), corners, place, normals, layers)
            out[face, k, 0], out[face, k, 1], out[face, k, 2], out[face, k, 3] = x, y, z, sign


def tangents(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """(m, 3, 4) tangents and signs as shading reads them, of (m, 3, 3) normals of the corners."""
    normals, rows = (
        np.ascontiguousarray(normals.reshape(-1, 3)),
        np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3),
    )
    words = corner_tangents(vertices, faces, normals, rows, uvs)
    layers, out = np.array([[address(words), WORDS]], np.int64), np.empty((len(faces), 3, 4), np.float32)
    _at_corners(plain(faces), rows, address(normals), address(layers), out)
    return out


def test_tangents_of_flat_triangles_are_derivatives_by_u():
    """Of each alone, in closed form; the sign is which way round it lies in the texture."""
    rng = np.random.default_rng(11)
    places = rng.normal(size=(3000, 3, 3)).astype(np.float32)
    places[:6, :, 2], places[:2, :, 0] = 0, 0  # along axes, where frames and quarters end
    places[:2, :, 2] = rng.normal(size=(2, 3))
    uvs = rng.normal(size=(3000, 3, 2)).astype(np.float32)
    uvs[2], uvs[3] = places[2, :, :2], places[3, :, :2] * (-1, 1)
    uvs[4], uvs[5] = places[4, :, 1::-1], places[5, :, 1::-1] * (-1, 1)
    a, b = (places[:, i].astype(float) - places[:, 0] for i in (1, 2))
    normals = np.cross(a, b)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    (au, av), (bu, bv) = ((uvs[:, i].astype(float) - uvs[:, 0]).T[..., None] for i in (1, 2))
    area = au * bv - av * bu
    expected = np.sign(area) * (bv * a - av * b)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    faces = np.arange(9000, dtype=np.int32).reshape(-1, 3)
    at_corners = np.repeat(normals[:, None], 3, axis=1).astype(np.float32)
    found = tangents(places.reshape(-1, 3), faces, at_corners, uvs)
    usual = np.abs(area[:, 0]) > 1e-2
    np.testing.assert_allclose(found[usual, :, :3], np.repeat(expected[usual, None], 3, axis=1), atol=3e-5)
    np.testing.assert_allclose(np.linalg.norm(found[..., :3], axis=2), 1, atol=3e-7)
    np.testing.assert_allclose((found[..., :3] * at_corners).sum(axis=2), 0, atol=3e-7)
    np.testing.assert_array_equal(found[..., 3], np.repeat(np.sign(area), 3, axis=1))


def test_a_face_that_is_a_point_in_the_texture_has_the_tangent_of_mikktspace():
    found = tangents(SQUARE, FACES, np.tile(np.float32([0.6, 0, 0.8]), (2, 3, 1)), np.full((2, 3, 2), 0.5, np.float32))
    np.testing.assert_array_equal(found, np.tile(np.float32([1, 0, 0, 1]), (2, 3, 1)))


def test_tangents_follow_u_over_a_sphere():
    """Where u runs around the axis, tangents point east, and the bitangents north; mirrored in u, west."""
    vertices, faces = lumpy()
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    away = np.abs(vertices[faces][..., 2]).max(axis=1) < 0.9
    turn = np.arctan2(vertices[faces][..., 1], vertices[faces][..., 0])
    faces, turn = faces[away & (np.ptp(turn, axis=1) < 3)], turn[away & (np.ptp(turn, axis=1) < 3)]
    normals = vertices[faces].astype(np.float32)
    for sign in (1, -1):
        uvs = np.stack([sign * turn, vertices[faces][..., 2]], axis=-1).astype(np.float32)
        found = tangents(vertices.astype(np.float32), faces, normals, uvs)
        east = np.cross((0, 0, 1), normals)
        east /= np.linalg.norm(east, axis=-1, keepdims=True)
        cosine = (found[..., :3] * east).sum(axis=-1) * sign
        assert np.median(cosine) > 0.998 and cosine.min() > 0.9
        assert (found[..., 3] == sign).all()


def test_layers_are_blended_and_placed():
    """Colours at corners, and images by other coordinates than the mesh's own."""
    colours = RNG.uniform(0, 1, (2, 3, 4)).astype(np.float32)
    other = np.ascontiguousarray(1 - UVS)
    image = Image("i", RNG.integers(0, 255, (4, 4, 4), dtype=np.uint8))
    layers = [Layer("paint", colours), Layer("other", other)]
    material = Material(
        "m", (1, 1, 1), 1.0, 1.0, (1, 1, 1),
        base_colour_texture=Texture("", layer="paint"), roughness_texture=Texture("", "a", layer="paint"),
        metallic_texture=Texture("i", "r", layer="other"), emission_texture=Texture("i"),
    )  # fmt: skip
    where, surface, scene = from_above([square(material=material, layers=layers)], [image])
    low = where[:, 0] > where[:, 1]
    u, v = where[:, 0] / 2, where[:, 1] / 2
    weights = np.where(low[:, None], np.stack([1 - u, u - v, v], 1), np.stack([1 - v, u, v - u], 1))
    blended = np.einsum("nc,ncd->nd", weights, np.where(low[:, None, None], colours[0], colours[1]))
    np.testing.assert_allclose(surface[:, 6:9], blended[:, :3], atol=2e-6)
    np.testing.assert_allclose(surface[:, 9], blended[:, 3], atol=2e-6)
    table = scene.mesh_materials.table
    by_own = table.lookup(np.zeros(len(u), int), np.stack([u, v], 1))[:, 5:]
    np.testing.assert_allclose(surface[:, 11:14], by_own, atol=1e-5)
    turned = table.lookup(np.zeros(len(u), int), np.stack([1 - u, 1 - v], 1))[:, 5]
    np.testing.assert_allclose(surface[:, 10], turned, atol=1e-4)
    assert not scene.mesh_materials.warnings
    scene.close()


def test_layers_follow_the_mesh_and_are_not_read_again():
    """Other values, other layers and other layouts, from frame to frame, are those of a scene of their own."""
    red, green = (np.full((2, 3, 4), colour, np.float32) for colour in ((1, 0, 0, 1), (0, 1, 0, 1)))
    painted = Material("m", (1, 1, 1), base_colour_texture=Texture("", layer="paint"))
    first = square(material=painted, layers=[Layer("paint", red)])
    other = square(material=painted, layers=[Layer("more", red), Layer("paint", green)])
    before = mesh_state(SQUARE + 9, FACES, name="before")
    scene = TraceScene()
    for states, expected in (
        ([first], (1, 0, 0)),
        ([other], (0, 1, 0)),
        ([before, other], (0, 1, 0)),
        ([first], (1, 0, 0)),
    ):
        scene.update([], states)
        _, numbers, surface = meet(scene, np.float32([[1, 0.5, 3]]), np.float32([[0, 0, -1]]))
        assert numbers[0, 0] >= 0
        np.testing.assert_allclose(surface[0, 6:9], expected, atol=1e-6)
    scene.close()


def test_tangents_follow_faces_between_the_same_vertices():
    """Of an edge that is rotated, with the coordinates of all faces alike."""
    vertices = SQUARE + np.float32([[0, 0, 0], [0, 0, 0.5], [0, 0, 0], [0, 0, 0.7]])
    uvs = np.repeat(UVS[:1], 2, axis=0)
    ways = FACES, np.int32([[1, 2, 3], [1, 3, 0]])
    for array in (vertices, uvs, *ways):
        array.setflags(write=False)
    image = Image("normals", np.random.default_rng(3).integers(90, 165, (8, 8, 4), dtype=np.uint8))
    material = Material("m", details=[SurfaceDetail("tangent", Texture("normals"))])
    states = [mesh_state(vertices, faces, np.eye(4), uvs=uvs, materials=[material]) for faces in ways]
    origins = np.column_stack([np.random.default_rng(1).uniform(0.05, 1.95, (200, 2)), np.full(200, 3.0)])
    rays = origins.astype(np.float32), np.tile(np.float32([0, 0, -1]), (200, 1))
    lasting, fresh = TraceScene(), TraceScene()
    for state in states:
        lasting.update([], [state], [image])
    fresh.update([], states[1:], [image])
    np.testing.assert_array_equal(meet(lasting, *rays)[2], meet(fresh, *rays)[2])
    lasting.close()
    fresh.close()


def test_broken_details_are_named_and_stop_nothing():
    bad = np.full((2, 3, 4), np.nan, np.float32)
    bad[0] = 0.25
    infinite = UVS.copy()
    infinite[0, 0, 0] = np.inf
    details = [
        SurfaceDetail("tangent", Texture("gone"), tangents="absent"),
        SurfaceDetail("tangent", Texture("gone"), tangents="infinite"),
        SurfaceDetail("bump", Texture("empty", "r"), distance=np.nan),
        SurfaceDetail("bump", Texture("", "r", layer="bad"), strength=1e30),
        SurfaceDetail("object", Texture("huge"), colour=(1e9, 1, 1)),
        SurfaceDetail("world", None, (0.5, 0.5, 0.5)),
        SurfaceDetail("bump", Texture("", "r", layer="bad")),
    ]
    paint = {"base_colour_texture": Texture("", layer="bad"), "roughness_texture": Texture("", "r", layer="lost")}
    material = Material("broken", (1, 1, 1), details=details, **paint)
    images = [Image("empty", np.zeros((0, 4, 4), np.uint8)), Image("huge", np.full((1, 1, 4), 1e30, np.float32))]
    state = square(material=material, layers=[Layer("bad", bad), Layer("infinite", infinite)])
    _, surface, scene = from_above([state], images)
    assert np.isfinite(surface).all()
    np.testing.assert_allclose(np.linalg.norm(surface[:, :3], axis=1), 1, atol=1e-5)
    said = "\n".join(scene.mesh_materials.warnings)
    for words in ("'absent'", "'lost'", 'mesh: 12 values "bad"', "'gone' is missing", "no usable number", "'empty'"):
        assert words in said, said
    scene.close()


@pytest.mark.parametrize(
    "values, error",
    [(np.zeros((2, 3, 3)), UsageError), (np.zeros((1, 3, 4)), AssetError), (np.zeros((6, 4)), UsageError)],
)
def test_layers_that_do_not_fit_are_refused(values, error):
    scene = TraceScene()
    material = Material("m", base_colour_texture=Texture("", layer="paint"))
    with pytest.raises(error, match="paint"):
        scene.update([], [square(material=material, layers=[Layer("paint", values)])])
    scene.update([], [square(material=material, layers=[Layer("paint", np.zeros((2, 3, 4)))])])
    scene.close()
    with pytest.raises(UsageError, match="kind"):
        TraceScene().update([], [square(SurfaceDetail("sideways"))])  # type: ignore[arg-type]


def test_a_detailed_face_seen_from_behind_and_moved():
    """What leans towards +X from above leans towards +X from below, too: the surface is the same."""
    image = Image("i", np.full((1, 1, 4), (0.8, 0.5, 0.9, 1.0), np.float32))
    detail = SurfaceDetail("tangent", Texture("i"))
    for place in (np.eye(4), matrix((0, 0, 0), (-1, 1, 1))):
        scene = TraceScene()
        scene.update([], [square(detail, place=place)], [image])
        x = place[0, 0]
        origins = np.float32([[x, 0.5, 3], [x, 0.5, -3]])
        _, _, surface = meet(scene, origins, np.float32([[0, 0, -1], [0, 0, 1]]))
        lean = np.array((0.6 * x, 0, 0.8)) / 1.0
        np.testing.assert_allclose(surface[0, :3], lean, atol=1e-5)
        np.testing.assert_allclose(surface[1, :3], -lean, atol=1e-5)
        scene.close()
