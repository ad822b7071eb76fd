"""The mesh of an asset as USDZ: an archive as the format wants it, and a surface that USD's own library finds."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from shapes import sphere_mesh

from drgs_blender.core.asset import Mesh
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import UsageError
from drgs_blender.formats.usd_mesh import write_usd_mesh


def painted() -> Mesh:
    """A sphere of two halves."""
    vertices, faces = sphere_mesh(3)
    top = vertices[:, 2] > 0
    n = len(vertices)
    albedo = np.where(top[:, None], [0.8, 0.1, 0.1], [0.1, 0.2, 0.7])
    return Mesh(vertices, faces, albedo, np.where(top, 0.2, 0.7), np.where(top, 1.0, 0.0) * np.ones(n))


def test_the_archive_is_what_the_format_wants(tmp_path: Path) -> None:
    """Nothing compressed, the stage first, data at multiples of 64 bytes; and the same bytes each time."""
    write_usd_mesh(tmp_path / "a.usdz", painted())
    data = (tmp_path / "a.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.testzip() is None
        assert [i.filename for i in archive.infolist()] == ["asset.usda", "textures/color.png", "textures/surface.png"]
        for entry in archive.infolist():
            assert entry.compress_type == zipfile.ZIP_STORED
            name, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
            assert (entry.header_offset + 30 + name + extra) % 64 == 0
    write_usd_mesh(tmp_path / "b.usdz", painted())
    assert (tmp_path / "b.usdz").read_bytes() == data


@pytest.mark.parametrize("layered", [False, True])
def test_usd_finds_the_mesh_and_its_materials(tmp_path: Path, layered: bool) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    mesh = painted()
    top = mesh.vertices[:, 2] > 0
    if layered:
        mesh.opacity, mesh.coat = np.where(top, 0.4, 0.9), np.where(top, 1.0, 0.2)
        mesh.emission = np.where(top[:, None], [8.0, 4.0, 0.0], [0.5, 0.5, 0.5])
    write_usd_mesh(tmp_path / "a.usdz", mesh)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not UsdValidation.ValidationContext(validators).Validate(stage)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Asset/Mesh"))
    np.testing.assert_array_equal(np.array(shape.GetPointsAttr().Get()), mesh.vertices)
    np.testing.assert_array_equal(np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), mesh.faces)
    normals = np.array(shape.GetNormalsAttr().Get())
    assert (normals * mesh.vertices).sum(axis=1).min() > 0.99
    material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource("")[0]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    uvs = np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").ComputeFlattened()).reshape(-1, 3, 2)
    wanted = {"diffuseColor": mesh.albedo, "roughness": mesh.roughness, "metallic": mesh.metallic}
    if layered:
        wanted |= {"opacity": mesh.opacity, "clearcoat": mesh.coat, "emissiveColor": mesh.emission}
    for name, values in wanted.items():
        source, output, _ = surface.GetInput(name).GetConnectedSource()
        shader = UsdShade.Shader(source)
        file = shader.GetInput("file").Get().resolvedPath
        with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
            picture = np.asarray(Image.open(io.BytesIO(archive.read(file.split("[")[1].rstrip("]"))))) / 255
        texel = np.floor(uvs * [1, -1] * len(picture) + [0, len(picture)]).astype(int)
        found = picture[texel[..., 1], texel[..., 0]]
        if output == "rgb":
            found = srgb_to_linear(found[..., :3])
        else:
            found = found[..., "rgba".index(output)]
        scale = 1.0 if not shader.GetInput("scale") else shader.GetInput("scale").Get()[0]
        np.testing.assert_allclose(scale * found, values[mesh.faces], atol=0.006 * scale)


def test_a_mesh_of_one_material_needs_no_textures(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdShade

    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), [0.7, 0.2, 0.1]), np.full(n, 0.3), np.full(n, 1.0))
    write_usd_mesh(tmp_path / "a.usdz", mesh)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/Asset/Material/Surface"))
    np.testing.assert_allclose(surface.GetInput("diffuseColor").Get(), [0.7, 0.2, 0.1], atol=1e-6)
    assert surface.GetInput("metallic").Get() == 1 and surface.GetInput("roughness").Get() == pytest.approx(0.3)


def test_no_faces_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="without faces"):
        write_usd_mesh(tmp_path / "a.usdz", Mesh.empty())
    assert not list(tmp_path.iterdir())
