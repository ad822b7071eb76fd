"""Surfels in USD as Gaussian surflets: by OpenUSD's own schemas, there and back, and of another hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splat_files import covariance, random_splats

from drgs_blender.cli.main import main
from drgs_blender.core.errors import AssetError
from drgs_blender.formats import usd_stage
from drgs_blender.formats.registry import read_surfels
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import SplatMaterials, normals, splats_of
from drgs_blender.formats.usd_splats import write_usd_splats

pytest.importorskip("pxr", reason="usd-core is not installed")
from pxr import Usd, UsdGeom, UsdValidation, UsdVol

GOOD = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def ParticleField "Field" (
    prepend apiSchemas = ["ParticleFieldPositionAttributeAPI", "ParticleFieldScaleAttributeAPI", "{kernel}"]
)
{{
    point3f[] positions = [(0, 0, 0), (0, 2, 0)]
    float3[] scales = [(0.1, 0.2, 5), (0.3, 0.2, 0)]
}}
"""


def test_usd_takes_them_for_surflets_and_finds_nothing_wrong(tmp_path: Path) -> None:
    splats = random_splats(20, 9)
    write_usd_splats(tmp_path / "a.usda", splats, kernel="surflet")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not UsdValidation.ValidationContext(validators).Validate(stage)
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField" and prim.IsA(UsdVol.ParticleField)
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI)
    assert not prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI)
    # The attributes are those of the schemas, not ones that happen to have their names.
    for api, name in (
        (UsdVol.ParticleFieldPositionAttributeAPI, "Positions"),
        (UsdVol.ParticleFieldScaleAttributeAPI, "Scales"),
        (UsdVol.ParticleFieldOrientationAttributeAPI, "Orientations"),
        (UsdVol.ParticleFieldOpacityAttributeAPI, "Opacities"),
    ):
        assert prim.HasAPI(api)
        attribute = getattr(api(prim), f"Get{name}Attr")()
        assert not attribute.IsCustom() and len(attribute.Get()) == 20
    harmonics = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(prim)
    assert harmonics and harmonics.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    assert len(harmonics.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()) == 20 * 9


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_surfels_there_and_back(tmp_path: Path, suffix: str) -> None:
    splats = random_splats(60, 9)
    write_usd_splats(tmp_path / f"a{suffix}", splats, kernel="surflet")
    file = read_surfels(tmp_path / f"a{suffix}")
    assert file.layout == "USD" and file.up == "z"
    surfels = file.surfels
    np.testing.assert_allclose(surfels.centre, splats.centre, atol=1e-6)
    np.testing.assert_allclose(surfels.scale, splats.scale[:, :2], rtol=1e-5)
    np.testing.assert_allclose(np.abs((surfels.rotation * splats.rotation).sum(axis=1)), 1, atol=1e-6)
    np.testing.assert_allclose(normals(surfels.rotation), normals(splats.rotation), atol=1e-5)
    np.testing.assert_allclose(surfels.opacity, splats.opacity, atol=1e-6)
    np.testing.assert_allclose(surfels.sh, splats.sh, atol=1e-6)


def test_materials_stay_with_surflets(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    values = (rng.uniform(0, 1, shape).astype(np.float32) for shape in ((9, 3), 9, 9))
    materials = SplatMaterials(*values)
    write_usd_splats(tmp_path / "a.usdc", replace(random_splats(9), materials=materials), True, "surflet")
    surfels = read_surfels(tmp_path / "a.usdc").surfels
    np.testing.assert_array_equal(surfels.albedo, materials.albedo)
    np.testing.assert_array_equal(surfels.metallic, materials.metallic)


def test_surflets_of_another_hand_are_flat_whatever_their_third_scale(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text(GOOD.format(kernel="ParticleFieldKernelGaussianSurfletAPI"))
    surfels = read_surfels(tmp_path / "a.usda").surfels
    np.testing.assert_allclose(surfels.scale, [[0.1, 0.2], [0.3, 0.2]], rtol=1e-5)
    np.testing.assert_allclose(normals(surfels.rotation), [[0, 0, 1]] * 2, atol=1e-6)
    np.testing.assert_allclose(surfels.opacity, 1, atol=1e-5)
    # The same field of ellipsoids is none of surfels: the first one is long along Z.
    (tmp_path / "b.usda").write_text(GOOD.format(kernel="ParticleFieldKernelGaussianEllipsoidAPI"))
    thick = splats_of(read_surfels(tmp_path / "b.usda").surfels).scale
    np.testing.assert_allclose(sorted(thick[0]), [0.1, 0.2, 5], rtol=1e-4)


@pytest.mark.parametrize(
    ("kernel", "named"),
    [("ParticleFieldKernelConstantSurfletAPI", "ParticleFieldKernelConstantSurfletAPI"), ("SomethingAPI", "none")],
)
def test_other_kernels_are_refused_by_name(tmp_path: Path, kernel: str, named: str) -> None:
    path = tmp_path / "a.usda"
    path.write_text(GOOD.format(kernel=kernel))
    with pytest.raises(AssetError, match=f"a.usda: has /Field with the kernel {named}; Gaussian ones are read"):
        read_surfels(path)


def test_the_kernel_that_a_type_has_is_stronger_than_one_that_is_applied(tmp_path: Path) -> None:
    text = GOOD.replace("def ParticleField ", "def ParticleField3DGaussianSplat ")
    (tmp_path / "a.usda").write_text(text.format(kernel="ParticleFieldKernelGaussianSurfletAPI"))
    arrays = usd_stage.read_stage(str(tmp_path / "a.usda"), Usd, UsdGeom)
    assert "0/centre" in arrays and "0/flat" not in arrays


def test_convert_writes_the_kernel_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = random_splats(10, 1)
    write_splat_ply(tmp_path / "a.ply", splats)
    for kernel, schema in (("surflet", "ParticleField"), ("ellipsoid", "ParticleField3DGaussianSplat")):
        path = tmp_path / f"{kernel}.usda"
        assert main(["convert", str(tmp_path / "a.ply"), str(path), "--kernel", kernel]) == 0
        assert f'def {schema} "Splats"' in path.read_text()
        found = splats_of(read_surfels(path).surfels)
        apart = covariance(found.rotation, found.scale) - covariance(splats.rotation, splats.scale)
        assert np.abs(apart).max() < 0.01 * np.square(splats.scale).max()
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz"), "--kernel", "surflet"]) == 64
    assert "--kernel: is no option of SPZ. Leave it out, or write USD splats" in capsys.readouterr().err
