"""Rigs and point caches of the mesh that an asset was made from, vertex by vertex."""

from __future__ import annotations

import struct

import bpy
import numpy as np
import pytest
from scenes import armature_object, asset_of, mesh_object, part, select, sphere
from test_bind import bind, pose, skinned, world_vertices

pytestmark = pytest.mark.blender_api


def two_shells() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two spheres in one place, of separate vertices; (vertices, faces, which shell each vertex is of)."""
    vertices, faces = sphere()
    n = len(vertices)
    return np.concatenate([vertices, vertices]), np.concatenate([faces, faces + n]), np.repeat([0, 1], n)


def renumbered(vertices: np.ndarray, faces: np.ndarray, seed: int = 3):
    """An asset of a mesh with other numbers: (asset, source's vertices, source's faces)."""
    n = len(vertices)
    order = np.random.default_rng(seed).permutation(n)  # asset's number of each vertex of the source
    asset = asset_of(vertices, faces)
    number = np.argsort(order)
    model = part("drgs_blender.core.asset.model")
    asset.mesh.source = model.SourceVertices(number[:, None], np.ones((n, 1)), np.array([n]))
    return asset, vertices[order], number[faces].astype(np.int32)


@pytest.fixture
def shells(scene, tmp_path):
    vertices, faces, shell = two_shells()
    asset, source, source_faces = renumbered(vertices, faces)
    path = tmp_path / "shells.drgs"
    part("drgs_blender.core.asset.container").write_asset(path, asset)
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.object, asset, source, source_faces, shell[np.argsort(asset.mesh.source.index[:, 0])]


def test_shells_in_one_place_follow_their_own_bones(shells):
    """By the nearest place either shell would take the weights of both."""
    obj, asset, vertices, faces, shell = shells
    rig = armature_object({"Low": ((0, 0, -1), (0, 0, 0)), "High": ((0, 0, 0), (0, 0, 1))})
    source = skinned("Source", rig, vertices, faces)
    for i, group in enumerate(source.vertex_groups):
        group.remove(range(len(vertices)))
        group.add(np.flatnonzero(shell == i).tolist(), 1.0, "REPLACE")
    source.shape_key_add(name="Basis")
    key = source.shape_key_add(name="Grow")
    for i in np.flatnonzero(shell == 1):
        key.data[i].co *= 1.5
    bind(obj, source)
    pose(rig)
    for shapes in (source, obj):
        shapes.data.shape_keys.key_blocks["Grow"].value = 1.0
    moved = asset.mesh.source.to_asset(world_vertices(source))
    np.testing.assert_allclose(world_vertices(obj), moved, atol=3e-6)
    assert np.abs(moved - asset.mesh.vertices).max() > 0.3


def test_a_source_that_lies_elsewhere_is_matched_by_place(shells):
    """Its numbers fit, its vertices do not."""
    obj, _, vertices, faces, _ = shells
    rig = armature_object({"Low": ((0, 0, -1), (0, 0, 0)), "High": ((0, 0, 0), (0, 0, 1))})
    turned = np.roll(vertices, 5, axis=0)
    bind(obj, skinned("Source", rig, turned, (faces + 5) % len(vertices)))
    before = world_vertices(obj)
    pose(rig)
    assert np.isfinite(world_vertices(obj)).all() and not np.allclose(world_vertices(obj), before)


def test_sources_that_became_one_surface_keep_their_own_bones(scene, tmp_path):
    """Two boards that touch: the asset has one vertex for both at the seam, and one between the seam and a corner."""
    vertices = np.float32([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0), (1.5, 0, 0)])
    faces = np.int32([(0, 1, 2), (0, 2, 3), (1, 6, 2), (6, 5, 2), (6, 4, 5)])
    asset = asset_of(vertices, faces)
    # The second board's vertices 4 and 7 were merged with 1 and 2 of the first.
    index, weights = np.array([0, 1, 2, 3, 5, 6, 1])[:, None].repeat(2, 1), np.tile((1.0, 0.0), (7, 1))
    index[6], weights[6] = (1, 5), (0.5, 0.5)
    asset.mesh.source = part("drgs_blender.core.asset.model").SourceVertices(index, weights, np.array([8]))
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "boards.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "boards.drgs"))
    obj = bpy.context.object
    rig = armature_object({"Low": ((0, 0, -1), (0, 0, 0)), "High": ((0, 0, 0), (0, 0, 1))})
    board = np.float32([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    sources = []
    for name, x in (("Low", 0), ("High", 1)):
        sources.append(skinned(name, rig, board + np.float32((x, 0, 0)), [(0, 1, 2), (0, 2, 3)]))
        for group in sources[-1].vertex_groups:
            group.remove(range(4))
        sources[-1].vertex_groups[name].add(range(4), 1.0, "REPLACE")
    select(*sources, obj)
    assert bpy.ops.drgs.bind_to_rig() == {"FINISHED"}
    names = [group.name for group in obj.vertex_groups]
    found = [{names[g.group]: g.weight for g in vertex.groups} for vertex in obj.data.vertices]
    assert found == [{"Low": 1.0}] * 4 + [{"High": 1.0}] * 3


def write_pc2(path, frames: np.ndarray, first: float = 1) -> None:
    count, points, _ = frames.shape
    head = struct.pack("<12s2i2fi", b"POINTCACHE2\0", 1, points, first, 1.0, count)
    path.write_bytes(head + frames.astype("<f4").tobytes())


def test_point_caches_of_the_source_play(shells, tmp_path, export):
    obj, asset, vertices, _, _ = shells
    frames = np.stack([vertices * (1 + 0.1 * i) + np.float32((0.2 * i, 0, 0)) for i in range(4)])
    write_pc2(tmp_path / "walk.pc2", frames, 3)
    with pytest.raises(RuntimeError, match="as the mesh it was made from"):
        bpy.ops.drgs.play_point_cache(filepath=str(tmp_path / "walk.pc2"))
    assert bpy.ops.drgs.play_point_cache(filepath=str(tmp_path / "walk.pc2"), vertex_order="SOURCE") == {"FINISHED"}
    for frame, given in zip((3, 5, 6), frames[[0, 2, 3]]):
        bpy.context.scene.frame_set(frame)
        np.testing.assert_allclose(world_vertices(obj), asset.mesh.source.to_asset(given), atol=1e-6)
    assert [m.type for m in obj.modifiers] == ["MESH_CACHE"]
    assert obj.modifiers[0].filepath.startswith("//")
    frame = export()[0]
    np.testing.assert_allclose(frame.objects[0].vertices, asset.mesh.source.to_asset(frames[3]), atol=1e-6)
    assert bpy.ops.drgs.play_point_cache(filepath=str(tmp_path / "walk.pc2"), vertex_order="ASSET") == {"FINISHED"}
    assert len(obj.modifiers) == 1 and obj.modifiers[0].filepath.endswith("walk.pc2")


def test_caches_that_blender_does_not_play_are_named(scene, tmp_path, export):
    """A Mesh Cache modifier by hand, of a mesh with another number of vertices."""
    vertices, faces = sphere()
    asset = asset_of(vertices, faces)
    n = len(vertices)
    model = part("drgs_blender.core.asset.model")
    asset.mesh.source = model.SourceVertices(np.arange(n)[:, None] + 2, np.ones((n, 1)), np.array([n + 5]))
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "ball.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "ball.drgs"))
    obj = bpy.context.object
    write_pc2(tmp_path / "walk.pc2", np.ones((2, n + 5, 3)))
    modifier = obj.modifiers.new("Mine", "MESH_CACHE")
    modifier.cache_format, modifier.filepath = "PC2", str(tmp_path / "walk.pc2")
    (told,) = [text for text in export()[1] if "walk.pc2" in text]
    assert f"has {n + 5} vertices" in told and "Play Point Cache" in told and '"Mine"' in told
    write_pc2(tmp_path / "walk.pc2", np.ones((2, 7, 3)))
    (told,) = [text for text in export()[1] if "walk.pc2" in text]
    assert "choose a cache of this mesh" in told
    for bad, problem in (("none.pc2", "does not exist"), ("bad.pc2", "neither PC2 nor MDD"), ("walk.pc2", "has 7")):
        (tmp_path / "bad.pc2").write_bytes(b"nothing")
        with pytest.raises(RuntimeError, match=problem):
            bpy.ops.drgs.play_point_cache(filepath=str(tmp_path / bad))
    assert bpy.ops.drgs.play_point_cache.poll()
    select(mesh_object("Other", vertices, faces))
    assert not bpy.ops.drgs.play_point_cache.poll()
