"""Splats in glTF packed as SPZ: as the draft of the extension has them, back again, and damaged."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splat_files import covariance, random_splats, refusals

from drgs_blender.cli.main import main
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.formats import gltf_document
from drgs_blender.formats.axes import surfels_to_z_up
from drgs_blender.formats.glb import Glb
from drgs_blender.formats.gltf_splats import EXTENSION, write_gltf_splats
from drgs_blender.formats.gltf_spz import EXTENSION as COMPRESSION
from drgs_blender.formats.gltf_spz import turned
from drgs_blender.formats.harmonics import basis
from drgs_blender.formats.registry import find_format, read_surfels
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import SplatMaterials, splats_of


def parts(path: Path) -> tuple[dict, bytes]:
    """The document of a GLB, and its bulk."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def changed(path: Path, change: Callable[[dict], Any], bulk: bytes | None = None) -> None:
    """Write a GLB again with another document, or other bulk."""
    document, own = parts(path)
    change(document)
    bulk = own if bulk is None else bulk
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(bulk), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(bulk), b"BIN\0") + bulk)


def settings(document: dict) -> dict:
    return document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]


@pytest.mark.parametrize("coefficients", [1, 4, 16])
@pytest.mark.parametrize("version", [2, 3])
def test_the_document_is_as_the_draft_says(tmp_path: Path, version: int, coefficients: int) -> None:
    splats = random_splats(70, coefficients)
    write_gltf_splats(tmp_path / "a.glb", splats, compress=True, spz_version=version)
    document, bulk = parts(tmp_path / "a.glb")
    assert set(document["extensionsUsed"]) == {EXTENSION, COMPRESSION} == set(document["extensionsRequired"])
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    given = settings(document)
    assert given["extensions"] == {COMPRESSION: {"bufferView": 0}}
    assert {"kernel", "colorSpace"} <= set(given)
    own = [f"{EXTENSION}:{name}" for name in ("SCALE", "ROTATION", "OPACITY")]
    own += [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{i}" for l in range(4) for i in range(2 * l + 1)][:coefficients]
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0", *own}
    for accessor in document["accessors"]:
        assert accessor["count"] == 70 and "bufferView" not in accessor
    # What lies in the view is a file of SPZ in its own axes: half a turn about Y from those of glTF.
    view = document["bufferViews"][0]
    (tmp_path / "a.spz").write_bytes(bulk[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])
    header = struct.unpack("<4sIIBBBB", gzip.decompress((tmp_path / "a.spz").read_bytes())[:16])
    assert header[:3] == (b"NGSP", version, 70)
    stored = read_surfels(tmp_path / "a.spz").surfels
    np.testing.assert_allclose(stored.centre * [-1, 1, -1], splats.centre, atol=1.001 / 8192)
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose(position["min"], (stored.centre * [-1, 1, -1]).min(axis=0), atol=1e-6)
    np.testing.assert_allclose(position["max"], (stored.centre * [-1, 1, -1]).max(axis=0), atol=1e-6)


@pytest.mark.parametrize("version", [None, 2, 3])
def test_packed_splats_come_back(tmp_path: Path, version: int | None) -> None:
    splats = random_splats(300)
    write_gltf_splats(tmp_path / "a.glb", splats, compress=True, spz_version=version)
    write_gltf_splats(tmp_path / "b.glb", splats)
    assert find_format(tmp_path / "a.glb").name == "glTF splats"
    assert (tmp_path / "a.glb").stat().st_size < 0.5 * (tmp_path / "b.glb").stat().st_size
    file = read_surfels(tmp_path / "a.glb")
    assert file.up == "y" and file.layout == EXTENSION and not any("draft" in note for note in file.notes)
    found = splats_of(file.surfels)
    np.testing.assert_allclose(found.centre, splats.centre, atol=1.001 / 8192)
    np.testing.assert_allclose(found.opacity, splats.opacity, atol=1.001 / 510)
    np.testing.assert_allclose(found.sh[:, 0], splats.sh[:, 0], atol=1.001 / (510 * 0.15))
    # Steps of half a quarter, and turning back adds up a few of them.
    assert np.abs(found.sh[:, 1:] - splats.sh[:, 1:]).max() < 0.3
    assert np.sqrt(np.square(found.sh[:, 1:] - splats.sh[:, 1:]).mean()) < 0.06
    wanted = covariance(splats.rotation, splats.scale)
    size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    assert (np.abs(covariance(found.rotation, found.scale) - wanted) / size).max() < 0.12


def test_the_half_turn_is_one() -> None:
    """Of places, axes and colours alike; twice it is nothing."""
    splats = random_splats(40)
    there, back = turned(splats), turned(turned(splats))
    half = np.diag([-1.0, 1, -1])
    np.testing.assert_allclose(there.centre, splats.centre @ half.T, atol=1e-6)
    own = covariance(splats.rotation, splats.scale)
    np.testing.assert_allclose(covariance(there.rotation, there.scale), half @ own @ half.T, atol=1e-6)
    look = np.random.default_rng(1).normal(size=(9, 3))
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    np.testing.assert_allclose(
        np.einsum("dk,nkc->ndc", basis(look @ half.T, 3), there.sh),
        np.einsum("dk,nkc->ndc", basis(look, 3), splats.sh),
        atol=1e-5,
    )
    np.testing.assert_allclose(back.sh, splats.sh, atol=1e-5)
    np.testing.assert_allclose(np.abs((back.rotation * splats.rotation).sum(axis=1)), 1, atol=1e-6)


def test_files_without_what_the_base_extension_asks_for_keep_their_coordinates(tmp_path: Path) -> None:
    """As Cesium writes and shows them; said in a note, since it cannot be known."""
    splats = random_splats(30, 1)
    write_gltf_splats(tmp_path / "a.glb", splats, compress=True)

    def older(document: dict) -> None:
        given = settings(document)
        packed = given.pop("extensions")
        given.clear()
        given["extensions"] = {"KHR_gaussian_splatting_compression_spz": packed[COMPRESSION]}

    changed(tmp_path / "a.glb", older)
    file = read_surfels(tmp_path / "a.glb")
    np.testing.assert_allclose(file.surfels.centre * [-1, 1, -1], splats.centre, atol=1.001 / 8192)
    assert any("as they are stored" in note for note in file.notes)


def test_materials_stay_beside_what_is_packed(tmp_path: Path) -> None:
    splats, rng = random_splats(50, 4), np.random.default_rng(2)
    values = (rng.uniform(0, 1, shape).astype(np.float32) for shape in ((50, 3), 50, 50))
    materials = SplatMaterials(*values)
    write_gltf_splats(tmp_path / "a.glb", replace(splats, materials=materials), materials=True, compress=True)
    found = read_surfels(tmp_path / "a.glb").surfels
    np.testing.assert_array_equal(found.albedo, materials.albedo)
    np.testing.assert_array_equal(found.roughness, materials.roughness)
    np.testing.assert_array_equal(found.metallic, materials.metallic)


def point(document: dict, value: object) -> None:
    settings(document)["extensions"][COMPRESSION]["bufferView"] = value


DAMAGE: dict[str, tuple[Callable[[dict], Any], str]] = {
    "no such view": (lambda d: point(d, 7), "refers to number 7 of 1 bufferViews"),
    "no view": (lambda d: settings(d)["extensions"][COMPRESSION].clear(), "bufferViews"),
    "a word": (lambda d: point(d, "x"), "of the wrong type"),
    "another count": (lambda d: d["accessors"][0].update(count=9), "says it has 9 splats, of which SPZ holds 40"),
    "too short": (lambda d: d["bufferViews"][0].update(byteLength=300), "SPZ of buffer view 0: is"),
    "no SPZ": (lambda d: d["bufferViews"][0].update(byteOffset=8, byteLength=400), "SPZ of buffer view 0: is"),
    "beyond the end": (lambda d: d["bufferViews"][0].update(byteLength=1 << 40), "beyond the end of its buffer"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_what_does_not_fit_is_refused_by_name(tmp_path: Path, damage: str) -> None:
    change, reason = DAMAGE[damage]
    write_gltf_splats(tmp_path / "a.glb", random_splats(40), compress=True)
    changed(tmp_path / "a.glb", change)
    with pytest.raises(AssetError, match=reason) as caught:
        read_surfels(tmp_path / "a.glb")
    assert str(tmp_path / "a.glb") in str(caught.value)


def test_a_place_is_not_unpacked_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither by primitives that name one view, nor by views that name one place."""
    monkeypatch.setattr(gltf_document, "_COPIES", 1 << 20)
    splats = random_splats(40, 1)
    for count in (8, 3000):
        for views in (False, True):
            path = tmp_path / f"{count}-{views}.glb"
            write_gltf_splats(path, splats, compress=True)

            def repeat(document: dict, count: int = count, views: bool = views) -> None:
                (primitive,) = document["meshes"][0]["primitives"]
                primitives = [json.loads(json.dumps(primitive)) for _ in range(count)]
                if views:
                    document["bufferViews"] *= count
                    for i, one in enumerate(primitives):
                        one["extensions"][EXTENSION]["extensions"][COMPRESSION]["bufferView"] = i
                document["meshes"][0]["primitives"] = primitives

            changed(path, repeat)
            if count == 8:
                assert len(read_surfels(path).surfels) == 8 * 40
            else:
                with pytest.raises(AssetError, match="repeats its meshes"):
                    read_surfels(path)


def test_damaged_copies_are_refused_or_read_sensibly(tmp_path: Path) -> None:
    write_gltf_splats(tmp_path / "a.glb", random_splats(60, 4), compress=True)
    data = (tmp_path / "a.glb").read_bytes()
    assert refusals(tmp_path / "a.glb", data, 200, within) > 60


def within(data: bytes, rng: np.random.Generator) -> bytes:
    """A copy whose bulk is damaged; a damaged document may be a mesh."""
    changed_ = bytearray(data)
    start = data.index(b"BIN\0") + 4
    for _ in range(rng.integers(1, 6)):
        changed_[rng.integers(start, len(data))] = rng.integers(256)
    return bytes(changed_)


def test_other_compressions_say_what_is_read(tmp_path: Path) -> None:
    glb = Glb()
    primitive = {"mode": 0, "attributes": {}, "extensions": {EXTENSION: {"extensions": {"KHR_x_compression": {}}}}}
    glb.json |= {"extensionsUsed": [EXTENSION], "scenes": [{"nodes": [0]}], "scene": 0}
    glb.json |= {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    glb.write(tmp_path / "a.glb")
    with pytest.raises(AssetError, match=f"KHR_x_compression.*only {COMPRESSION} is read"):
        read_surfels(tmp_path / "a.glb")


def test_convert_packs_where_it_is_asked_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = random_splats(30)
    write_splat_ply(tmp_path / "a.ply", splats)
    convert = ["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.glb")]
    assert main([*convert, "--compress", "--spz-version", "3"]) == 0
    file = read_surfels(tmp_path / "a.glb")
    np.testing.assert_allclose(surfels_to_z_up(file.surfels, "y").centre, splats.centre, atol=2e-4)
    (tmp_path / "a.glb").unlink()
    for more, reason in (
        (
            ["--compress", "--spz-version", "4"],
            "--spz-version: is 4, which SPZ in glTF cannot be. Choose",
        ),
        (["--spz-version", "3"], "--spz-version: is 3, which says nothing of this glTF. Give --compress with it"),
    ):
        assert main([*convert, *more]) == 64
        assert reason in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--compress"]) == 64
    assert "--compress: is no option of 3DGS PLY. Leave it out, or write glTF splats" in capsys.readouterr().err
    assert not (tmp_path / "a.glb").exists() and not (tmp_path / "b.ply").exists()
    with pytest.raises(UsageError):
        write_gltf_splats(tmp_path / "a.glb", splats, compress=True, spz_version=5)
