"""The traced scene: normals, materials, what moves and what is broken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.surfel_columns import ALBEDO, METALLIC, NORMAL, ROUGHNESS


def trace_object(vertices: np.ndarray, faces: np.ndarray, name: str = "thing", **changes: object) -> TraceObject:
    n = len(vertices)
    item = TraceObject(
        name,
        np.asarray(vertices, np.float32),
        np.asarray(faces, np.int32),
        np.full((n, 3), 0.5, np.float32),
        np.full(n, 0.4, np.float32),
        np.zeros(n, np.float32),
    )
    return replace(item, **changes)  # type: ignore[arg-type]


@pytest.fixture
def sphere() -> TraceObject:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return trace_object(mesh.vertices, mesh.faces, "sphere")


def crumpled(seed: int = 0) -> TraceObject:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(seed)
    return trace_object(mesh.vertices + rng.normal(size=mesh.vertices.shape) * 0.1, mesh.faces[:250], "crumpled")


def test_smooth_normals_are_angle_weighted() -> None:
    item = crumpled()
    scene = TraceScene()
    scene.update([item])
    corner = item.vertices.astype(float)[item.faces]
    unit = lambda a: a / np.linalg.norm(a, axis=-1, keepdims=True)  # noqa: E731
    flat = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    expected = np.zeros((len(item.vertices), 3))
    for k in range(3):
        a, b = unit(corner[:, (k + 1) % 3] - corner[:, k]), unit(corner[:, (k + 2) % 3] - corner[:, k])
        np.add.at(expected, item.faces[:, k], np.arccos((a * b).sum(-1))[:, None] * flat)
    used = np.unique(item.faces)
    np.testing.assert_allclose(scene.shading[used, NORMAL : NORMAL + 3], unit(expected[used]), atol=3e-4)
    assert np.isfinite(scene.shading).all()


@pytest.mark.alone
def test_normals_do_not_depend_on_threads(sphere: TraceObject) -> None:
    before, results = get_num_threads(), []
    try:
        for threads in (1, 2):
            use_threads(threads)
            scene = TraceScene()
            scene.update([sphere])
            results.append(scene.shading.copy())
    finally:
        use_threads(before)
    np.testing.assert_array_equal(*results)


def test_moving_refits_and_new_topology_rebuilds(sphere: TraceObject) -> None:
    scene = TraceScene()
    scene.update([sphere])
    built = scene.bvh.rebuilds
    scene.update([replace(sphere, vertices=sphere.vertices * np.float32(2))])
    assert scene.bvh.rebuilds == built
    assert scene.extent == pytest.approx(2.0, rel=1e-3)
    t, _, _, _ = scene.bvh.intersect(np.zeros((1, 3)), [[0.3, 0.4, 0.5]])
    assert t[0] * np.sqrt(0.5) == pytest.approx(2.0, rel=0.02)
    scene.update([replace(sphere, faces=sphere.faces[:-1])])
    assert scene.bvh.rebuilds == built + 1
    scene.update([sphere, sphere])
    assert scene.bvh.rebuilds == built + 2
    scene.update([])
    assert len(scene.faces) == 0
    assert scene.bvh.intersect(np.zeros((1, 3)), [[0, 0, 1]])[1][0] == -1


def test_every_object_keeps_its_own_faces_and_materials(sphere: TraceObject) -> None:
    other = replace(
        sphere,
        name="other",
        vertices=sphere.vertices + np.float32([5, 0, 0]),
        albedo=np.tile(np.float32([0.9, 2.0, np.nan]), (len(sphere.vertices), 1)),
        roughness=np.full(len(sphere.vertices), -1, np.float32),
        metallic=np.full(len(sphere.vertices), np.nan, np.float32),
        pass_index=7,
    )
    scene = TraceScene()
    scene.update([sphere, other])
    _, face, _, _ = scene.bvh.intersect([[0, 0, 3], [5, 0, 3]], [[0, 0, -1]] * 2)
    np.testing.assert_array_equal(scene.face_object[face], [0, 1])
    np.testing.assert_array_equal(scene.pass_index, [0, 7])
    row = scene.shading[scene.shading_faces[face[1], 0]]
    np.testing.assert_allclose(row[ALBEDO : ALBEDO + 3], [0.9, 1, 0])
    assert row[ROUGHNESS] == 0 and row[METALLIC] == 0
    np.testing.assert_allclose(scene.shading[scene.shading_faces[face[0], 0]][ALBEDO : ALBEDO + 3], 0.5)


def test_given_corner_normals_are_used_and_bad_ones_replaced(sphere: TraceObject) -> None:
    normals = np.zeros((len(sphere.faces), 3, 3), np.float32)
    normals[..., 0] = 2.0
    normals[3, 1] = np.nan
    scene = TraceScene()
    scene.update([sphere, replace(sphere, corner_normals=normals)])
    own = scene.shading_faces[len(sphere.faces) :]
    expected = np.tile(np.float32([1, 0, 0]), (len(own), 3, 1))
    flat = np.cross(*(sphere.vertices[sphere.faces[3, k]] - sphere.vertices[sphere.faces[3, 0]] for k in (1, 2)))
    expected[3, 1] = flat / np.linalg.norm(flat)
    np.testing.assert_allclose(scene.shading[own][..., NORMAL : NORMAL + 3], expected, atol=1e-5)
    np.testing.assert_allclose(scene.shading[own][..., ALBEDO : ALBEDO + 3], 0.5)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
def test_bad_vertices_hide_their_faces_and_nothing_else(sphere: TraceObject, value: float) -> None:
    scene = TraceScene()
    scene.update([sphere])
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    origins = np.zeros_like(directions)
    _, whole, _, _ = scene.bvh.intersect(origins, directions)
    vertices = sphere.vertices.copy()
    vertices[17, 1] = value
    for _ in range(2):
        scene.update([replace(sphere, vertices=vertices)])
        dead = (sphere.faces == 17).any(axis=1)
        (fault,) = scene.faults
        assert (fault.name, fault.bad_vertices, fault.bad_faces, fault.empty_faces) == ("sphere", 1, dead.sum(), 0)
        _, face, _, _ = scene.bvh.intersect(origins, directions)
        np.testing.assert_array_equal(face, np.where(dead[whole], -1, whole))
        assert np.isfinite(scene.shading).all() and np.isfinite(scene.vertices).all()
    scene.update([sphere])
    np.testing.assert_array_equal(scene.bvh.intersect(origins, directions)[1], whole)
    assert scene.faults[0].bad_vertices == 0


def test_faces_without_area_are_counted_and_harmless(sphere: TraceObject) -> None:
    faces = sphere.faces.copy()
    faces[5, 2] = faces[5, 1]
    scene = TraceScene()
    scene.update([replace(sphere, faces=faces)])
    assert scene.faults[0].empty_faces == 1
    assert np.isfinite(scene.shading).all()
    np.testing.assert_allclose(np.linalg.norm(scene.shading[:, NORMAL : NORMAL + 3], axis=1), 1, atol=1e-5)


def test_arrays_that_do_not_fit_are_named(sphere: TraceObject) -> None:
    scene = TraceScene()
    with pytest.raises(UsageError, match="sphere"):
        scene.update([replace(sphere, faces=sphere.faces + 1)])
    with pytest.raises(AssetError, match="albedo of sphere"):
        scene.update([replace(sphere, albedo=sphere.albedo[:-1])])
