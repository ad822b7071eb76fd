"""The mesh of an asset as glTF: the textures show what the vertices say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from shapes import sphere_mesh

from drgs_blender.build.texture import Materials
from drgs_blender.core.asset import Mesh
from drgs_blender.core.errors import UsageError
from drgs_blender.formats.atlas import bake_atlas
from drgs_blender.formats.axes import vectors_from_z_up
from drgs_blender.formats.gltf_mesh import write_gltf_mesh
from drgs_blender.formats.registry import read_mesh


def painted() -> Mesh:
    """A sphere whose materials vary from vertex to vertex."""
    vertices, faces = sphere_mesh(3)
    rng = np.random.default_rng(1)
    n = len(vertices)
    return Mesh(vertices, faces, rng.uniform(0.2, 0.8, (n, 3)), rng.uniform(0.1, 0.9, n), rng.uniform(0, 1, n))


def random_points(faces: int, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """(face, barycentric) of points, some of them on edges and corners."""
    rng = np.random.default_rng(2)
    weights = rng.dirichlet((1, 1, 1), count)
    weights[: count // 4, rng.integers(3)] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    weights[:30] = np.eye(3)[rng.integers(0, 3, 30)]
    return rng.integers(0, faces, count), weights


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_filtering_the_atlas_interpolates_the_corners(count: int) -> None:
    """Exactly, but where the fourth corner of a parallelogram would be out of range: by a quarter of that at most."""
    rng = np.random.default_rng(count)
    values = rng.uniform(0, 1, (count, 3, 2)).astype(np.float32)
    fourth = values[:, 1] + values[:, 2] - values[:, 0]
    beyond = np.abs(fourth - fourth.clip(0, 1))
    texels, uvs = bake_atlas(values, "mesh")
    face, weights = random_points(count)
    place = np.einsum("nk,nkj->nj", weights, uvs[face]) * len(texels) - 0.5
    low = np.floor(place).astype(int)
    part = place - low
    found = np.zeros((len(face), 2))
    for i in (0, 1):
        for j in (0, 1):
            weight = np.where(i, part[:, 0], 1 - part[:, 0]) * np.where(j, part[:, 1], 1 - part[:, 1])
            column, row = np.minimum(low + np.array([i, j]), len(texels) - 1).T
            found += weight[:, None] * texels[row, column]
    error = np.abs(found - np.einsum("nk,nkj->nj", weights, values[face]))
    assert (error <= 2e-4 + beyond[face] / 4).all()


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_mip_maps_of_the_atlas_mix_in_no_other_colour(count: int) -> None:
    """Of a mesh of few colours, every texel is one of them."""
    texels, _ = bake_atlas(np.full((count, 3, 2), 0.75, np.float32), "mesh")
    np.testing.assert_array_equal(texels, np.float32(0.75))


def test_a_mesh_comes_back_with_its_materials(tmp_path: Path) -> None:
    mesh = painted()
    turned = vectors_from_z_up(mesh.vertices, "y")
    write_gltf_mesh(tmp_path / "a.glb", Mesh(turned, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic))
    file = read_mesh(tmp_path / "a.glb")
    assert len(file.faces) == len(mesh.faces) and file.corner_uvs is not None and file.corner_normals is not None
    np.testing.assert_allclose(file.vertices[file.faces], mesh.vertices[mesh.faces], atol=1e-6)
    outwards = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (file.corner_normals * outwards[mesh.faces]).sum(axis=-1).min() > 0.99
    corners = np.arange(3 * len(mesh.faces))
    uvs = file.corner_uvs.reshape(-1, 2)[corners]
    found = Materials(file.materials).sample(np.zeros(len(uvs), np.int64), uvs, np.zeros((len(uvs), 2)))
    wanted = np.concatenate([mesh.albedo, mesh.roughness[:, None], mesh.metallic[:, None]], axis=1)[mesh.faces.ravel()]
    # Eight bits: of sRGB for the albedo, which is coarser where it is bright.
    np.testing.assert_allclose(found[:, :3], wanted[:, :3], atol=0.005)
    np.testing.assert_allclose(found[:, 3:], wanted[:, 3:], atol=0.003)


def layered(mesh: Mesh) -> Mesh:
    """The mesh with all optional channels, of values that vary."""
    rng = np.random.default_rng(3)
    n = len(mesh.vertices)
    more = {"opacity": rng.uniform(0.2, 0.8, n), "specular": rng.uniform(0.3, 0.9, n), "coat": rng.uniform(0, 1, n)}
    return replace(mesh, **more, emission=rng.uniform(1, 7, (n, 3)))


def test_optional_channels_come_back(tmp_path: Path) -> None:
    mesh = layered(painted())
    write_gltf_mesh(tmp_path / "a.glb", replace(mesh, vertices=vectors_from_z_up(mesh.vertices, "y")))
    file = read_mesh(tmp_path / "a.glb")
    assert not file.notes
    materials = Materials(file.materials)
    uvs = file.corner_uvs.reshape(-1, 2)
    found = materials.sample(np.zeros(len(uvs), np.int64), uvs, np.zeros((len(uvs), 2)))
    for name, limit in {"opacity": 0.003, "specular": 0.004, "coat": 0.003, "emission": 0.04}.items():
        values = found[:, materials.columns[name]].reshape(getattr(mesh, name)[mesh.faces.ravel()].shape)
        np.testing.assert_allclose(values, getattr(mesh, name)[mesh.faces.ravel()], atol=limit, err_msg=name)


def test_optional_channels_of_one_value_come_back(tmp_path: Path) -> None:
    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.3), np.full(n, 1.0))
    mesh.opacity, mesh.specular, mesh.coat = np.full(n, 0.25), np.full(n, 0.8), np.full(n, 0.5)
    mesh.emission = np.full((n, 3), [0.0, 2.0, 8.0])
    write_gltf_mesh(tmp_path / "a.glb", mesh)
    material = read_mesh(tmp_path / "a.glb").materials[0]
    np.testing.assert_allclose(material.emission, [0, 2, 8], rtol=1e-6)
    given = material.alpha, material.specular, material.coat
    np.testing.assert_allclose(given, [0.25, 0.8, 0.5], rtol=1e-6)


def test_another_reader_finds_the_same_object(tmp_path: Path) -> None:
    mesh = painted()
    write_gltf_mesh(tmp_path / "a.glb", mesh)
    found = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    assert len(found.faces) == len(mesh.faces)
    np.testing.assert_allclose(found.triangles, mesh.vertices[mesh.faces], atol=1e-6)
    material = found.visual.material
    assert material.baseColorTexture.size == material.metallicRoughnessTexture.size
    assert material.doubleSided


def test_a_mesh_of_one_material_needs_no_textures(tmp_path: Path) -> None:
    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    write_gltf_mesh(
        tmp_path / "a.glb", Mesh(vertices, faces, np.full((n, 3), [0.7, 0.2, 0.1]), np.full(n, 0.3), np.full(n, 1.0))
    )
    file = read_mesh(tmp_path / "a.glb")
    assert len(file.vertices) == n and len(file.faces) == len(faces)
    material = file.materials[0]
    assert material.base_colour_image is None and material.metallic_roughness_image is None
    np.testing.assert_allclose(material.base_colour, [0.7, 0.2, 0.1], atol=1e-6)
    assert (material.roughness, material.metallic) == (pytest.approx(0.3), 1.0)


def test_a_mesh_without_faces_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="without faces"):
        write_gltf_mesh(tmp_path / "a.glb", Mesh.empty())
    assert not (tmp_path / "a.glb").exists()
