"""Splats with materials, as docs/relightable-splats.md describes them: its own reader reads them, and so do we."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splat_files import random_splats
from test_formats_exchange import asset_on_a_square

from drgs_blender.build.importer import import_asset
from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.errors import AssetError
from drgs_blender.formats import usd_stage
from drgs_blender.formats.axes import UP_AXES
from drgs_blender.formats.gltf_splats import write_gltf_splats
from drgs_blender.formats.registry import read_surfels
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import SplatMaterials, Splats, join_splats, normals
from drgs_blender.formats.usd_splats import write_usd_splats
from drgs_blender.geometry.normals import rotation_matrices

PAGE = Path(__file__).resolve().parents[2] / "docs" / "relightable-splats.md"
WRITERS = {".ply": write_splat_ply, ".glb": write_gltf_splats, ".usdc": write_usd_splats}
FIELDS = ("albedo", "roughness", "metallic")


def relightable(n: int = 80, seed: int = 3) -> Splats:
    """Splats with materials of every value."""
    rng = np.random.default_rng(seed)
    values = (rng.uniform(0, 1, shape).astype(np.float32) for shape in ((n, 3), n, n))
    return replace(random_splats(n, 4, seed), materials=SplatMaterials(*values))


def reader_of_the_page() -> Any:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code.splitlines()) <= 50
    names: dict[str, Any] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    return names["read"]


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_the_reader_of_the_page_reads_what_convert_writes(tmp_path: Path, suffix: str) -> None:
    asset = asset_on_a_square()
    rng = np.random.default_rng(8)
    surfels = asset.surfels
    surfels.albedo[:] = rng.uniform(0, 1, surfels.albedo.shape)
    surfels.roughness[:], surfels.metallic[:] = rng.uniform(0, 1, (2, len(surfels)))
    write_asset(tmp_path / "a.drgs", asset)
    path = tmp_path / f"b{suffix}"
    assert main(["convert", str(tmp_path / "a.drgs"), str(path), "--as", "splats", "--materials"]) == 0
    found = reader_of_the_page()(path)
    turn = UP_AXES["y"].T if suffix == ".glb" else np.eye(3)
    axes = turn @ rotation_matrices(surfels.rotation.astype(np.float64))
    np.testing.assert_allclose(found["centre"], surfels.centre @ turn.T, atol=1e-6)
    np.testing.assert_allclose(found["normal"], axes[..., 2], atol=1e-5)
    np.testing.assert_allclose(rotation_matrices(found["rotation"]), axes, atol=1e-5)
    np.testing.assert_allclose(found["scale"][:, :2], surfels.scale, rtol=1e-5)
    np.testing.assert_allclose(found["scale"][:, 2], 0.01 * surfels.scale.min(axis=1), rtol=1e-5)
    np.testing.assert_allclose(found["opacity"], surfels.opacity, atol=2e-6)
    for name in FIELDS:
        np.testing.assert_array_equal(found[name], getattr(surfels, name))


@pytest.mark.parametrize("suffix", WRITERS)
def test_materials_there_and_back(tmp_path: Path, suffix: str) -> None:
    if suffix == ".usdc":
        pytest.importorskip("pxr", reason="usd-core is not installed")
    splats = relightable()
    WRITERS[suffix](tmp_path / f"a{suffix}", splats, materials=True)
    file = read_surfels(tmp_path / f"a{suffix}")
    assert splats.materials is not None and not file.unknown
    for name, array in zip(FIELDS, splats.materials.arrays(), strict=True):
        np.testing.assert_array_equal(getattr(file.surfels, name), array)
    np.testing.assert_allclose(file.surfels.sh, splats.sh, atol=1e-6)  # the captured colour stays beside them
    np.testing.assert_allclose(normals(file.surfels.rotation), normals(splats.rotation), atol=1e-5)
    assert not any("no materials" in note for note in file.notes) and set(file.surfels.extras) == {"thickness"}
    assert file.layout == "DR-GS"
    asset = import_asset(tmp_path / f"a{suffix}", meshless=True)
    np.testing.assert_array_equal(asset.surfels.albedo, splats.materials.albedo)
    assert asset.provenance["materials"] == "of the surfels"


def test_without_the_option_files_are_as_they_were(tmp_path: Path) -> None:
    bare = replace(relightable(), materials=None)
    for suffix in (".ply", ".glb"):
        WRITERS[suffix](tmp_path / f"a{suffix}", relightable())
        WRITERS[suffix](tmp_path / f"b{suffix}", bare)
        WRITERS[suffix](tmp_path / f"c{suffix}", bare, materials=True)
        first, *others = ((tmp_path / f"{name}{suffix}").read_bytes() for name in "abc")
        assert [d.replace(b'"b"', b'"a"').replace(b'"c"', b'"a"') for d in others] == [first] * 2
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0]
    assert b"albedo" not in header and header.rstrip().endswith(b"rot_3")


def test_names_are_those_of_the_page(tmp_path: Path) -> None:
    """And those of 3DGS come first, in their order, so that readers of fixed rows still find them."""
    write_splat_ply(tmp_path / "a.ply", relightable(), materials=True)
    write_splat_ply(tmp_path / "b.ply", relightable())
    with_, without = (
        re.findall(r"property float (\w+)", (tmp_path / name).read_bytes().split(b"end_header")[0].decode())
        for name in ("a.ply", "b.ply")
    )
    assert with_ == [*without, "albedo_r", "albedo_g", "albedo_b", "roughness", "metallic"]
    write_gltf_splats(tmp_path / "a.glb", relightable(), materials=True)
    data = (tmp_path / "a.glb").read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    kinds = {name: document["accessors"][index]["type"] for name, index in attributes.items()}
    wanted = {"NORMAL": "VEC3", "_ALBEDO": "VEC3", "_ROUGHNESS": "SCALAR", "_METALLIC": "SCALAR"}
    assert wanted.items() <= kinds.items()
    text = PAGE.read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in [*wanted, *with_[-5:]])


def test_usd_has_the_names_of_houdini(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom, UsdValidation

    splats = relightable()
    assert splats.materials is not None
    write_usd_splats(tmp_path / "a.usda", splats, materials=True)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)
    primvars = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim())
    types = {
        "Cd": "color3f[]", "Alpha": "float[]", "scale": "float3[]", "orient": "quatf[]", "N": "normal3f[]",
        "rough": "float[]", "metallic": "float[]",
    }  # fmt: skip
    values = {}
    for name, kind in types.items():
        primvar = primvars.GetPrimvar(name)
        assert str(primvar.GetTypeName()) == kind and primvar.GetInterpolation() == "vertex"
        values[name] = np.array(primvar.Get())
        assert len(values[name]) == len(splats)
    assert primvars.GetPrimvar("Cd").GetAttr().GetColorSpace() == "lin_rec709_scene"
    np.testing.assert_array_equal(values["Cd"], splats.materials.albedo)
    np.testing.assert_array_equal(values["orient"][:, [3, 0, 1, 2]], splats.rotation)
    np.testing.assert_array_equal(values["Alpha"], splats.opacity)
    np.testing.assert_allclose(values["N"], rotation_matrices(splats.rotation)[..., 2], atol=1e-5)
    text = PAGE.read_text(encoding="utf-8")
    assert all(f"`primvars:{name}`" in text for name in types)


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("Cd", "color3f", "(1, 0, 0)"),  # one for all
        ("Cd", "float2[]", "[(1, 0), (0, 1)]"),
        ("rough", "float[]", "[0.5]"),  # too short
        ("metallic", "string", '"no"'),
    ],
)
def test_primvars_of_those_names_that_are_something_else_do_no_harm(
    tmp_path: Path, name: str, kind: str, value: str
) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    good = {"Cd": ("color3f[]", "[(1, 0, 0), (0, 1, 0)]"), "rough": ("float[]", "[0.1, 0.2]")}
    good["metallic"] = ("float[]", "[0, 1]")
    lines = [f"{k} primvars:{n} = {v}" for n, (k, v) in (good | {name: (kind, value)}).items()]
    (tmp_path / "a.usda").write_text(
        '#usda 1.0\ndef ParticleField3DGaussianSplat "S"\n{\n    point3f[] positions = [(0, 0, 0), (0, 1, 0)]\n'
        + "\n".join(lines)
        + "\n}\n"
    )
    arrays = usd_stage.read_stage(str(tmp_path / "a.usda"), Usd, UsdGeom)
    assert len(arrays["0/centre"]) == 2
    assert {n for n in FIELDS if f"0/{n}" in arrays} == {"albedo", "roughness", "metallic"} - {
        {"Cd": "albedo", "rough": "roughness", "metallic": "metallic"}[name]
    }


def test_numbers_that_are_none_are_dropped_and_others_held_in_their_range(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "a.ply", relightable(5), materials=True)
    data = bytearray((tmp_path / "a.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    rows = np.frombuffer(data, "<f4", offset=start).reshape(5, -1)
    rows[1, -5], rows[2, -2], rows[3, -1] = np.nan, 7, -2
    (tmp_path / "a.ply").write_bytes(data)
    file = read_surfels(tmp_path / "a.ply")
    assert len(file.surfels) == 4 and any("1 of 5 splats dropped" in note for note in file.notes)
    assert file.surfels.roughness[1] == 1 and file.surfels.metallic[2] == 0


@pytest.mark.parametrize("change", ["absent", "short", "type"])
def test_gltf_whose_materials_do_not_fit_is_refused_by_name(tmp_path: Path, change: str) -> None:
    write_gltf_splats(tmp_path / "a.glb", relightable(), materials=True)
    data = (tmp_path / "a.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    if change == "absent":
        del attributes["_ROUGHNESS"]
    elif change == "short":
        document["accessors"][attributes["_ROUGHNESS"]]["count"] = 9
    else:
        attributes["_ROUGHNESS"] = attributes["POSITION"]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(head + text + rest)
    with pytest.raises(AssetError, match=r"a\.glb: has (splats without _ROUGHNESS|9 _ROUGHNESS|an accessor VEC3)"):
        read_surfels(tmp_path / "a.glb")


def test_splats_without_materials_beside_others_get_what_is_assumed() -> None:
    first, second = relightable(4), random_splats(3, 1)
    second.sh[:] = (0.5 - 0.5) / 0.28209479
    whole = join_splats([first, second])
    assert whole.materials is not None and first.materials is not None
    np.testing.assert_array_equal(whole.materials.albedo[:4], first.materials.albedo)
    np.testing.assert_allclose(whole.materials.albedo[4:], 0.2140411, atol=1e-5)  # half, decoded from sRGB
    assert (whole.materials.roughness[4:] == 0.5).all() and (whole.materials.metallic[4:] == 0).all()


def test_convert_tells_of_materials_that_are_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_splat_ply(tmp_path / "a.ply", random_splats(10))
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--materials"]) == 0
    said = capsys.readouterr().out
    assert "with materials" in said and "roughness 0.5 and metallic 0 are used" in said
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.glb"), "--materials"]) == 0
    assert "are used" not in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.spz"), "--materials"]) == 64
    said = capsys.readouterr().err
    assert (
        "--materials: is no option of SPZ. Leave it out, or write 3DGS PLY, glTF splats, USD splats or USD sequence"
        in said
    )
