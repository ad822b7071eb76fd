"""Ordinary meshes in the traced scene: instances equal copies, masks, materials, what is broken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from drgs_blender.compute.jit import njit
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.core.frame import MeshState, Visibility
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.render.scene import ray_masks
from drgs_blender.render.scene.interaction import nearest, position_at, shadowed, surface_at
from drgs_blender.render.scene.ray import Ray
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene

F = np.float32


@njit
def _meet(tracer, geometry, mesh, o, d, mask, t, numbers, out):  # type: ignore[no-untyped-def]
    vertices, faces, places = mesh
    for i in range(len(o)):
        dx, dy, dz = d[i, 0], d[i, 1], d[i, 2]
        ray = Ray((o[i, 0], o[i, 1], o[i, 2]), (dx, dy, dz), F(0.0), F(np.inf), mask)
        hit = nearest(tracer, ray)
        t[i], face, place, u, v, _, _, _ = hit
        blocked = shadowed(tracer, ray)
        numbers[i, 0], numbers[i, 1], numbers[i, 2], numbers[i, 3] = face, place, -1, blocked
        if face >= 0:
            values = surface_at(hit, (dx, dy, dz), geometry)
            nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, er, eg, eb, _, _, _, owner = values
            x, y, z = position_at(face, place, u, v, vertices, faces, places)
            out[i] = np.array([nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, er, eg, eb, x, y, z], np.float32)
            numbers[i, 2] = owner


NORMAL, FLAT, ALBEDO, ROUGHNESS, METALLIC, EMISSION, POSITION = (
    *(slice(0, 3), slice(3, 6), slice(6, 9), 9, 10, slice(11, 14), slice(14, 17)),
)


def meet(scene: TraceScene, origins: np.ndarray, directions: np.ndarray, mask: int = -1) -> tuple:
    """t (n,), (n, 4) face, place, object, blocked, and (n, 17) the surface."""
    o, d = (np.ascontiguousarray(a, np.float32) for a in (origins, directions))
    t, numbers, out = np.empty(len(o), np.float32), np.empty((len(o), 4), np.int32), np.zeros((len(o), 17), np.float32)
    arrays = scene.vertices, scene.faces, scene.instances
    _meet(scene.tracer, scene.geometry, arrays, o, d, np.int32(mask), t, numbers, out)
    return t, numbers, out


def mesh_state(
    vertices: np.ndarray, faces: np.ndarray, *matrices: np.ndarray, name: str = "mesh", **changes: object
) -> MeshState:
    matrices = matrices or (np.eye(4),)
    index = np.arange(10, 10 + len(matrices), dtype=np.int32)
    item = MeshState(name, np.asarray(vertices, np.float32), np.asarray(faces, np.int32), np.stack(matrices), index)
    return replace(item, **changes)  # type: ignore[arg-type]


def trace_object(vertices: np.ndarray, faces: np.ndarray, name: str = "object", **changes: object) -> TraceObject:
    n = len(vertices)
    flat = np.zeros(n, np.float32)
    item = TraceObject(
        name, np.asarray(vertices, np.float32), np.asarray(faces, np.int32), np.full((n, 3), 0.5), flat, flat
    )
    return replace(item, **changes)  # type: ignore[arg-type]


def matrix(shift: tuple, scale: tuple = (1, 1, 1), turn: int = -1) -> np.ndarray:
    out = np.eye(4)
    if turn >= 0:
        out[:3, :3], _ = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))
    out[:3, :3] *= scale
    out[:3, 3] = shift
    return out


def test_normals_of_vertices_are_those_of_their_corners():
    """Bit for bit, also turned and stretched, in one place and in two; unusable ones point up."""
    rng = np.random.default_rng(3)
    vertices, faces = rng.normal(size=(6, 3)).astype(F), np.array([[0, 1, 2], [2, 3, 0], [3, 4, 5]], np.int32)
    faces[2, 2] = 3  # without area
    normals = rng.normal(size=(6, 3)).astype(F)
    stands = matrix((1, 2, 3), (1, 2, 0.5), turn=1), matrix((0, 0, 1), turn=2)
    for where in (stands[:1], stands):
        scenes = TraceScene(), TraceScene()
        given = {"vertex_normals": normals}, {"corner_normals": normals[faces]}
        for scene, arrays in zip(scenes, given):
            scene.update([], [mesh_state(vertices, faces, *where, **arrays)])
        rows = [scene.normals[scene.shading_faces] for scene in scenes]
        np.testing.assert_array_equal(rows[0].view(np.uint32), rows[1].view(np.uint32))
        assert scenes[0].faults[0].empty_faces == scenes[1].faults[0].empty_faces == 1
        bad = normals.copy()
        bad[1], bad[4] = np.nan, 0.0
        scenes[0].update([], [mesh_state(vertices, faces, *where, vertex_normals=bad)])
        again = scenes[0].normals[scenes[0].shading_faces]
        assert np.isfinite(again).all() and not np.array_equal(again, rows[0])
        np.testing.assert_array_equal(again[1, :2].view(np.uint32), rows[0][1, :2].view(np.uint32))
    with pytest.raises(AssetError, match="vertex normals of mesh"):
        scenes[0].update([], [mesh_state(vertices, faces, vertex_normals=normals[:4])])


MATRICES = (
    matrix((0, 0, 0), turn=0),
    matrix((3, 0, 1), (0.3, 0.7, 0.5), 1),
    matrix((0, -3, 0), (-1, 1.2, 0.4), 2),
    matrix((-2, 2, -2), (0.01, 0.01, 0.01), 3),
)


def rays(count: int, seed: int = 0, spread: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    return (rng.normal(size=(count, 3)) * spread).astype(np.float32), (
        direction / np.linalg.norm(direction, axis=1, keepdims=True)
    ).astype(np.float32)


def aimed_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from all around towards the shapes that stand in MATRICES."""
    origins, _ = rays(count, seed, 4.0)
    rng = np.random.default_rng(seed + 1)
    inside = rng.normal(size=(count, 3)) * 0.3
    which = rng.integers(0, len(MATRICES), count)
    targets = np.stack([MATRICES[w][:3, :3] @ p + MATRICES[w][:3, 3] for w, p in zip(which, inside)])
    direction = targets - origins
    return origins, (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)


def lumpy(levels: int = 3) -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(levels)
    v = ball.vertices
    return (v * (1 + 0.1 * np.sin(4 * v[:, [1, 2, 0]]))).astype(np.float32), ball.faces.astype(np.int32)


def painted(vertices: np.ndarray, faces: np.ndarray, smooth: bool) -> dict[str, object]:
    """Texture coordinates, two materials with an image, and corner normals unless smooth."""
    rng = np.random.default_rng(5)
    coloured = Texture("picture", interpolation="closest")
    normals = rng.normal(size=(len(faces), 3, 3)) * 0.3 + vertices[faces]
    return {
        "uvs": rng.random((len(faces), 3, 2)).astype(np.float32),
        "material_index": rng.integers(0, 2, len(faces)).astype(np.int32),
        "materials": [
            Material("plain", (0.1, 0.2, 0.3), 0.4, 0.6, (1.0, 2.0, 3.0)),
            Material("image", (1.0, 1.0, 1.0), 0.3, 0.0, base_colour_texture=coloured),
        ],
        "corner_normals": None if smooth else (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(F),
    }


PICTURE = Image("picture", np.random.default_rng(1).integers(0, 255, (4, 4, 4)).astype(np.uint8))


@pytest.mark.parametrize("smooth", [True, False])
def test_an_instance_is_the_same_mesh_in_that_place(smooth: bool) -> None:
    vertices, faces = lumpy()
    given = painted(vertices, faces, smooth)
    instanced, single = TraceScene(), TraceScene()
    instanced.update([], [mesh_state(vertices, faces, *MATRICES, **given)], [PICTURE])
    copies = [mesh_state(vertices, faces, m, name=f"copy {i}", **given) for i, m in enumerate(MATRICES)]
    single.update([], copies, [PICTURE])
    assert len(instanced.faces) == len(faces) and len(single.faces) == 4 * len(faces)
    assert instanced.extent == pytest.approx(single.extent, rel=0.5)
    origins, directions = aimed_rays(6000)
    t, numbers, out = meet(instanced, origins, directions)
    expected_t, expected, expected_out = meet(single, origins, directions)
    same = np.where(numbers[:, 0] >= 0, numbers[:, 0] + numbers[:, 1] * len(faces), -1) == expected[:, 0]
    assert same.mean() > 0.995  # an edge may fall to either side
    hit = same & (numbers[:, 0] >= 0)
    assert hit.sum() > 4000 and (np.bincount(numbers[hit, 1]) > 200).all()
    np.testing.assert_allclose(t[hit], expected_t[hit], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(numbers[:, 3], numbers[:, 0] >= 0)
    # Barycentrics of a face seen from 400 of its sizes away are good to 1e-3; what varies over it varies with them.
    near = hit & (numbers[:, 1] != 3)
    for part, tolerance in ((FLAT, 1e-5), (ROUGHNESS, 1e-6), (METALLIC, 1e-6), (EMISSION, 1e-6), (POSITION, 1e-5)):
        np.testing.assert_allclose(out[near][:, part], expected_out[near][:, part], atol=tolerance)
    np.testing.assert_allclose(out[near][:, NORMAL], expected_out[near][:, NORMAL], atol=1e-4 if smooth else 1e-3)
    assert (np.abs(out[hit][:, ALBEDO] - expected_out[hit][:, ALBEDO]).max(axis=1) < 1e-5).mean() > 0.998
    # Numbers: four places of one mesh, four meshes.
    np.testing.assert_array_equal(numbers[hit, 2], 1 + numbers[hit, 1])
    np.testing.assert_array_equal(expected[hit, 2], numbers[hit, 1])
    np.testing.assert_array_equal(instanced.pass_index[numbers[hit, 2]], 10 + numbers[hit, 1])


def test_surfaces_face_the_ray_whatever_the_matrix() -> None:
    ball = trimesh.creation.icosphere(4)
    for matrices in (MATRICES[:1], MATRICES[2:3], MATRICES):
        scene = TraceScene()
        scene.update([], [mesh_state(ball.vertices, ball.faces, *matrices)])
        origins, directions = aimed_rays(3000)
        _, numbers, out = meet(scene, origins, directions)
        hit = numbers[:, 0] >= 0
        assert hit.sum() > 500
        for part in (NORMAL, FLAT):
            np.testing.assert_allclose(np.linalg.norm(out[hit][:, part], axis=1), 1, atol=1e-5)
        assert ((out[:, FLAT] * directions).sum(axis=1)[hit] <= 0).all()
        assert ((out[:, FLAT] * out[:, NORMAL]).sum(axis=1)[hit] > 0.9).all()
        # The normal of an ellipsoid: A^-T A^-1 (x - centre), outwards where the ray starts outside.
        place = np.maximum(numbers[:, 1], 0)[hit]
        linear = np.stack([m[:3, :3] for m in matrices])[place]
        centre = np.stack([m[:3, 3] for m in matrices])[place]
        inverse = np.linalg.inv(linear)
        local = np.einsum("nij,nj->ni", inverse, out[hit][:, POSITION] - centre)
        normal = np.einsum("nji,nj->ni", inverse, local)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        outside = np.linalg.norm(np.einsum("nij,nj->ni", inverse, origins[hit] - centre), axis=1) > 1.01
        assert outside.sum() > 400
        assert ((normal * out[hit][:, NORMAL]).sum(axis=1)[outside] > 0.999).all()


def test_what_moves_is_followed_as_if_it_were_new() -> None:
    """After each change the scene has the hits of a scene that saw nothing else; trees are kept while faces are."""
    vertices, faces = lumpy(2)
    other = (vertices * F(0.5)).astype(F)
    lone = mesh_state(vertices, faces, matrix((0, 0, 4)), name="lone")
    many = mesh_state(vertices, faces, *MATRICES, name="many", **painted(vertices, faces, False))
    thing = trace_object(vertices + F([4, 0, 0]), faces)
    scene = TraceScene()
    frames: list[tuple[list, list, bool]] = [
        ([thing], [lone, many], False),
        ([thing], [lone, many], True),
        ([thing], [replace(lone, matrices=lone.matrices + 0.2), many], True),
        ([thing], [lone, replace(many, matrices=many.matrices[::-1] + 0.1)], True),
        ([thing], [lone, replace(many, vertices=other)], True),
        ([replace(thing, vertices=thing.vertices + F(0.3))], [lone, many], True),
        ([thing], [lone, replace(many, matrices=many.matrices[:2], pass_indices=many.pass_indices[:2])], True),
        ([thing], [lone, many], True),
        ([thing], [lone, replace(many, uvs=many.uvs[::-1].copy(), material_index=1 - many.material_index)], True),
        ([thing], [lone, replace(many, materials=many.materials[::-1])], True),
        ([thing], [replace(lone, visibility=Visibility(glossy=False)), many], False),
        ([thing], [replace(lone, matrices=np.stack(MATRICES) + 0.2, pass_indices=np.arange(4)), many], False),
        ([thing], [many, lone], False),
        ([], [many], False),
        ([thing, thing], [], False),
    ]
    origins, directions = aimed_rays(2000)
    for objects, meshes, kept in frames:
        built = scene.bvh.rebuilds
        scene.update(objects, meshes, [PICTURE])
        assert (scene.bvh.rebuilds == built) == kept
        fresh = TraceScene()
        fresh.update(objects, meshes, [PICTURE])
        assert scene.extent == fresh.extent
        np.testing.assert_array_equal(scene.pass_index, fresh.pass_index)
        for mask in (-1, ray_masks.GLOSSY, ray_masks.ORDINARY, ray_masks.SURFELS):
            for a, b in zip(meet(scene, origins, directions, mask), meet(fresh, origins, directions, mask)):
                assert (
                    np.abs(np.nan_to_num(a) - np.nan_to_num(b)).reshape(len(a), -1).max(axis=1) < 1e-4
                ).mean() > 0.998 or np.array_equal(a, b)


def test_visibility_decides_what_rays_meet() -> None:
    """Each kind of ray meets the nearest of several sheets that it sees."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], F)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    at = lambda z: matrix((0, 0, z))  # noqa: E731
    objects = [
        trace_object(square + F([0, 0, 1]), faces, visibility=Visibility(camera=False, shadow=False)),
        trace_object(square + F([0, 0, 2]), faces, visibility=Visibility(glossy=False, shadow_catcher=True)),
    ]
    meshes = [
        mesh_state(square, faces, at(0.5), visibility=Visibility(False, False, False, shadow=True)),
        mesh_state(square, faces, at(0.7), at(9.0), visibility=Visibility(False, False, True, False)),
        mesh_state(square, faces, at(3.0), visibility=Visibility(holdout=True)),
    ]
    scene = TraceScene()
    scene.update(objects, meshes)
    expected = {
        ray_masks.CAMERA: (2.0, 1), ray_masks.DIFFUSE: (1.0, 0), ray_masks.GLOSSY: (0.7, 5), ray_masks.SHADOW: (0.5, 2),
        ray_masks.SURFELS: (1.0, 0), ray_masks.ORDINARY: (3.0, 4), ray_masks.DIFFUSE << ray_masks.WITHOUT: (2.0, 1),
        ray_masks.GLOSSY << ray_masks.WITHOUT: (np.inf, -1), ray_masks.SHADOW << ray_masks.WITHOUT: (2.0, 1),
        -1: (0.5, 2),
    }  # fmt: skip
    for mask, (distance, owner) in expected.items():
        t, numbers, _ = meet(scene, [[0.1, 0.2, 0]], [[0, 0, 1]], mask)
        assert t[0] == pytest.approx(distance, rel=1e-6), mask
        assert (numbers[0, 2], numbers[0, 3]) == (owner, owner >= 0), mask
    np.testing.assert_array_equal(scene.object_flags, [0, ray_masks.CATCHER, 0, 0, ray_masks.HOLDOUT, 0, 0])
    assert scene.any_ordinary


def test_faces_that_a_matrix_flattens_are_counted_while_it_does() -> None:
    vertices, faces = lumpy(2)
    scene = TraceScene()
    mesh = mesh_state(vertices, faces, matrix((0, 0, 0), (1, 1, 1)))
    for scale, lost in (((1, 1, 1), 0), ((0, 0, 0), 1), ((1, 0, 0), 1), ((1e-20,) * 3, 1), ((1e-3,) * 3, 0)):
        mesh = replace(mesh, matrices=np.array([matrix((0, 0, 0), scale)]))
        scene.update([], [mesh])
        assert scene.faults[0].empty_faces == lost * len(faces)


def bad(value: float) -> np.ndarray:
    out = matrix((0, 0, 0))
    out[1, 3] = value
    return out


@pytest.mark.parametrize(
    ("matrices", "usable", "left_out"),
    [
        ([MATRICES[0], bad(np.nan)], 1, 1),
        ([MATRICES[0], bad(np.inf), MATRICES[1]], 2, 1),
        ([MATRICES[0], bad(1e30), MATRICES[1]], 2, 1),
        ([MATRICES[0], matrix((9, 9, 9), (0, 0, 0)), MATRICES[1]], 2, 1),
        ([MATRICES[0], matrix((9, 9, 9), (1, 1, 0)), MATRICES[1]], 2, 1),
        ([MATRICES[0], matrix((9, 9, 9), (1e-30, 1, 1)), MATRICES[1]], 2, 1),
        ([MATRICES[0], matrix((9, 9, 9), (1e30, 1, 1)), MATRICES[1]], 2, 1),
        ([bad(np.nan)], 0, 1),
        ([bad(np.nan), bad(np.nan)], 0, 2),
        ([matrix((0, 0, 0), (1, 1, 0))], 1, 0),  # flat, seen as any face
        ([matrix((0, 0, 0), (0, 0, 0))], 1, 0),  # a point, that nothing meets
        ([matrix((0, 0, 0), (1e-6, 1e-6, 1e-6)), matrix((0, 1, 0), (1e-6, -1e-6, 1e-6))], 2, 0),
    ],
)
def test_matrices_that_cannot_be_used_are_left_out_and_counted(matrices: list, usable: int, left_out: int) -> None:
    vertices, faces = lumpy(2)
    scene = TraceScene()
    good = trace_object(vertices + F([0, 0, 50]), faces)
    for _ in range(2):
        scene.update([good], [mesh_state(vertices, faces, *matrices, name="cup")])
        assert (scene.faults[1].name, scene.faults[1].bad_instances) == ("cup", left_out)
        assert scene.faults[0].bad_instances == 0
        assert len(scene.faces) == len(faces) * (1 + (usable > 0))
        origins, directions = aimed_rays(1000)
        t, numbers, out = meet(scene, origins, directions)
        assert not np.isnan(t).any() and np.isfinite(out).all() and np.isfinite(scene.extent)
        assert np.isfinite(scene.normals).all()
        flat = np.abs(np.linalg.det(np.nan_to_num(matrices[0])[:3, :3])) == 0
        if usable and not flat and left_out:
            assert (numbers[:, 0] >= 0).sum() > 100


def test_bad_vertices_of_meshes_hide_their_faces_and_nothing_else() -> None:
    vertices, faces = lumpy(2)
    broken = vertices.copy()
    broken[7] = np.nan
    broken[9, 1] = -np.inf
    dead = np.isin(faces, (7, 9)).any(axis=1)
    origins, directions = aimed_rays(3000)
    for matrices in (MATRICES[:1], MATRICES):
        scene = TraceScene()
        scene.update([], [mesh_state(vertices, faces, *matrices)])
        t, whole, _ = meet(scene, origins, directions)
        scene.update([], [mesh_state(broken, faces, *matrices)])
        (fault,) = scene.faults
        assert (fault.bad_vertices, fault.bad_faces, fault.empty_faces) == (2, dead.sum(), 0)
        again, numbers, out = meet(scene, origins, directions)
        kept = (whole[:, 0] >= 0) & ~dead[whole[:, 0]]
        np.testing.assert_array_equal(numbers[kept], whole[kept])
        np.testing.assert_array_equal(again[kept], t[kept])
        assert not dead[numbers[numbers[:, 0] >= 0, 0]].any()
        assert np.isfinite(out).all() and np.isfinite(scene.normals).all() and np.isfinite(scene.vertices).all()


def test_meshes_that_do_not_fit_are_named() -> None:
    vertices, faces = lumpy(1)
    state = mesh_state(vertices, faces, name="cup")
    scene = TraceScene()
    for error, change in (
        (UsageError, {"faces": faces + 1}),
        (UsageError, {"matrices": np.eye(4)}),
        (UsageError, {"pass_indices": np.arange(3)}),
        (UsageError, {"materials": []}),
        (UsageError, {"material_index": np.zeros(3, np.int32)}),
        (AssetError, {"uvs": np.zeros((3, 3, 2), F)}),
        (AssetError, {"corner_normals": np.zeros((3, 3, 3), F)}),
        (AssetError, {"vertices": vertices[:, :2]}),
    ):
        with pytest.raises(error, match="cup"):
            scene.update([], [replace(state, **change)])
        scene.update([], [state])
        assert len(scene.faces) == len(faces)


def test_material_indices_beyond_the_materials_take_the_last() -> None:
    vertices, faces = lumpy(1)
    state = mesh_state(
        vertices, faces, materials=[Material("a", (0, 0, 0)), Material("b", (1, 1, 1))],
        material_index=np.full(len(faces), 9, np.int32),
    )  # fmt: skip
    scene = TraceScene()
    scene.update([], [mesh_state(vertices, faces, matrix((5, 0, 0))), state])
    _, _, out = meet(scene, [[0, 0, 5], [5, 0, 5]], [[0, 0, -1]] * 2)
    np.testing.assert_allclose(out[:, ALBEDO], [[1, 1, 1], [0.8, 0.8, 0.8]])


def test_texture_coordinates_that_are_not_finite_are_named_and_0() -> None:
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    uvs = np.float32([[[0.2, np.nan], [1, 0], [np.inf, 1]], [[0, 0], [1, 1], [0, 1]]])
    state = mesh_state(square, [[0, 1, 2], [0, 2, 3]], name="wall", uvs=uvs)
    scene = TraceScene()
    for _ in range(2):  # also where nothing has changed
        scene.update([], [state])
        assert [w for w in scene.mesh_materials.warnings if "coordinates" in w] == [
            "wall: 2 texture coordinates are not finite; 0 is used"
        ]
    np.testing.assert_array_equal(scene.mesh_materials.uvs[0], np.float32([[0.2, 0], [1, 0], [0, 1]]))
    scene.update([], [mesh_state(square, [[0, 1, 2], [0, 2, 3]], uvs=np.zeros((2, 3, 2), np.float32))])
    assert not scene.mesh_materials.warnings
