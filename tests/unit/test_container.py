"""The `.drgs` file: what is written comes back, mapped; whatever is damaged or hostile is refused by name."""

from __future__ import annotations

import ast
import json
import os
import struct
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.asset import Asset, Binding, Environment, Mesh, Surfels
from drgs_blender.core.asset.archive import read_archive, write_archive
from drgs_blender.core.asset.container import (
    MANIFEST,
    SCHEMA,
    check_asset,
    digest_asset,
    inspect_asset,
    read_asset,
    write_asset,
)
from drgs_blender.core.asset.tensors import decode, encode
from drgs_blender.core.errors import AssetError, VersionError, WriteError

DATA_MEMBERS = ("surfels.safetensors", "mesh.safetensors", "binding.safetensors", "environment.safetensors")


def unit(rng: np.random.Generator, n: int, width: int) -> np.ndarray:
    """(n, width) random unit vectors."""
    v = rng.normal(size=(n, width))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def make_asset(n: int = 40, vertices: int = 12, faces: int = 20) -> Asset:
    """A random valid asset with every optional part."""
    rng = np.random.default_rng(7)
    f = lambda *shape: rng.random(shape, dtype=np.float32)  # noqa: E731
    barycentric = rng.dirichlet((1, 1, 1), n).astype(np.float32) if n else np.zeros((0, 3))
    return Asset(
        Surfels(
            f(n, 3), f(n, 2), unit(rng, n, 4), f(n), f(n, 3), f(n), f(n), f(n, 4, 3), {"normal2": f(n, 3), "ü x": f(n)}
        ),
        Mesh(f(vertices, 3), rng.integers(0, max(vertices, 1), (faces, 3)), f(vertices, 3), f(vertices), f(vertices)),
        Binding(rng.integers(0, max(faces, 1), n), barycentric, f(n), unit(rng, n, 3)),
        Environment(f(4, 8, 3) * 20),
        {"source": "a.ply", "dropped": {"non-finite": 3}},
    )


def arrays_of(part: object) -> dict[str, np.ndarray]:
    """Every array of one part of an asset."""
    found = {}
    for name in part.__slots__:
        value = getattr(part, name)
        if value is not None:
            found |= {f"{name}/{k}": v for k, v in value.items()} if isinstance(value, dict) else {name: value}
    return found


@pytest.fixture
def file(tmp_path: Path) -> Path:
    asset = make_asset()
    asset.mesh.groups["lid"] = np.array([0, 3, 5], np.int32)
    write_asset(tmp_path / "a.drgs", asset)
    return tmp_path / "a.drgs"


def rewrite(path: Path, change: dict[str, bytes | None], fix: bool = True, manifest: dict | None = None) -> None:
    """Replace members of `path` (None removes); with `fix`, hashes and sizes are made to agree again."""
    import hashlib

    members = {name: view.tobytes() for name, view in read_archive(path).items()}
    described = json.loads(members[MANIFEST])
    for name, data in change.items():
        if data is None:
            members.pop(name)
            described["members"].pop(name, None)
        else:
            members[name] = data
            if fix and name in described["members"]:
                described["members"][name] |= {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    if MANIFEST not in change:
        members[MANIFEST] = json.dumps(described | (manifest or {})).encode()
    write_archive(path, [(name, [memoryview(data)]) for name, data in members.items()])


def test_round_trip_is_exact_mapped_and_aligned(file: Path) -> None:
    asset, back = make_asset(), read_asset(file)
    for part in ("surfels", "mesh", "binding", "environment"):
        expected, found = arrays_of(getattr(asset, part)), arrays_of(getattr(back, part))
        found.pop("groups/lid", None)
        assert expected.keys() == found.keys()
        for name, array in found.items():
            np.testing.assert_array_equal(array, expected[name], err_msg=name)
            assert not array.flags.owndata and not array.flags.writeable, f"{name} is a copy"
    assert back.mesh.groups["lid"].tolist() == [0, 3, 5]
    assert back.provenance == asset.provenance
    assert back.surfels.centre.ctypes.data % 64 == 0
    assert back.mesh.vertices.ctypes.data % 64 == 0


def test_the_same_asset_is_the_same_file_and_a_plain_zip(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "b.drgs"
    write_asset(other, read_asset(file))
    assert other.read_bytes() == file.read_bytes()
    assert digest_asset(other) == digest_asset(file)
    with zipfile.ZipFile(file) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == [MANIFEST, *DATA_MEMBERS]
        assert all(i.compress_type == zipfile.ZIP_STORED for i in archive.infolist())
        for info in archive.infolist():
            head = file.read_bytes()[info.header_offset + 26 : info.header_offset + 30]
            assert (info.header_offset + 30 + sum(struct.unpack("<HH", head))) % 64 == 0


@pytest.mark.parametrize("counts", [(0, 0, 0), (0, 5, 4), (3, 4, 2)])
def test_empty_and_minimal_assets(tmp_path: Path, counts: tuple[int, int, int]) -> None:
    asset = make_asset(*counts)
    asset.binding = asset.environment = asset.surfels.sh = None
    write_asset(tmp_path / "a.drgs", asset)
    back = read_asset(tmp_path / "a.drgs")
    assert (len(back.surfels), len(back.mesh.vertices), len(back.mesh.faces)) == counts
    assert back.binding is None and back.environment is None and back.surfels.sh is None
    assert inspect_asset(tmp_path / "a.drgs")["counts"]["surfels"] == counts[0]


def test_inspect_is_json_and_right(file: Path) -> None:
    about = json.loads(json.dumps(inspect_asset(file), allow_nan=False))
    asset = make_asset()
    counts = {"surfels": 40, "vertices": 12, "source_vertices": 12, "faces": 20, "groups": 1, "sh_coefficients": 4}
    assert about["counts"] == counts
    np.testing.assert_array_equal(
        about["bounds"]["surfels"], [asset.surfels.centre.min(0), asset.surfels.centre.max(0)]
    )
    assert about["extras"] == ["normal2", "ü x"] and about["environment"] == [4, 8] and about["bound"]
    assert about["provenance"] == asset.provenance and set(about["members"]) == set(DATA_MEMBERS)


@pytest.mark.slow
def test_no_flipped_byte_is_accepted(file: Path) -> None:
    """Mutants of the whole file: every one is refused with an AssetError (or VersionError), never accepted."""
    clean = file.read_bytes()
    rng = np.random.default_rng(1)
    places = {*rng.integers(0, len(clean), 1500).tolist(), *range(120), *range(len(clean) - 400, len(clean))}
    accepted = []
    for place in sorted(places):
        mutant = bytearray(clean)
        mutant[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(mutant)
        try:
            read_asset(file)
            accepted.append(place)
        except (AssetError, VersionError) as error:
            assert str(file) in error.subject
    assert accepted == []


def test_no_truncation_is_accepted(file: Path) -> None:
    clean = file.read_bytes()
    for length in {0, 1, 21, 22, 30, len(clean) - 1, *range(0, len(clean), 97)}:
        file.write_bytes(clean[:length])
        with pytest.raises(AssetError):
            read_asset(file, verify=False)
    file.write_bytes(clean + b"\0")
    with pytest.raises(AssetError):
        read_asset(file)


@pytest.mark.slow
@pytest.mark.parametrize("member", DATA_MEMBERS)
def test_mutants_with_hashes_recomputed_never_crash(file: Path, member: str) -> None:
    """A hostile writer can make hashes agree; then the data is refused or is a valid asset."""
    original = file.read_bytes()
    clean = read_archive(file)[member].tobytes()
    rng = np.random.default_rng(len(member))
    header = 8 + struct.unpack("<Q", clean[:8])[0]
    refused = 0
    for i in range(250):
        mutant = bytearray(clean)
        mutant[int(rng.integers(header if i % 2 else len(clean)))] = int(rng.integers(256))
        file.write_bytes(original)
        rewrite(file, {member: bytes(mutant)})
        try:
            check_asset(read_asset(file), "mutant")
        except AssetError:
            refused += 1
    assert refused > 50


def test_mutated_manifests_with_right_crc_never_crash(file: Path) -> None:
    original = file.read_bytes()
    clean = read_archive(file)[MANIFEST].tobytes()
    rng = np.random.default_rng(2)
    for _ in range(300):
        mutant = bytearray(clean)
        mutant[int(rng.integers(len(clean)))] = int(rng.integers(256))
        file.write_bytes(original)
        rewrite(file, {MANIFEST: bytes(mutant)})
        try:
            asset = read_asset(file)
        except (AssetError, VersionError):
            continue
        assert len(asset.surfels) == 40  # only the provenance, the producer or white space can have changed


def set_tensor(file: Path, member: str, name: str, array: np.ndarray | None) -> None:
    """Replace one tensor of a file so that everything else, hashes included, agrees."""
    tensors = dict(decode(np.asarray(read_archive(file)[member]).copy()))
    tensors.pop(name) if array is None else tensors.update({name: array})
    data = b"".join(encode(tensors))
    described = json.loads(read_archive(file)[MANIFEST].tobytes())["members"]
    names = {"<f4": "F32", "<i4": "I32", "<f8": "F64", "<i8": "I64"}
    described[member]["tensors"] = {
        n: {"dtype": names[a.dtype.str], "shape": list(a.shape)} for n, a in tensors.items()
    }
    import hashlib

    described[member] |= {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    rewrite(file, {member: data}, fix=False, manifest={"members": described})


F = np.float32
FAULTS = [
    ("surfels.safetensors", "opacity", None, "missing"),
    ("surfels.safetensors", "opacity", np.zeros(40), "not part of schema"),
    ("surfels.safetensors", "opacity", np.zeros(39, F), "shape"),
    ("surfels.safetensors", "opacity", np.full(40, 2, F), "outside"),
    ("surfels.safetensors", "scale", np.full((40, 2), -1, F), "negative"),
    ("surfels.safetensors", "rotation", np.zeros((40, 4), F), "unit length"),
    ("surfels.safetensors", "centre", np.full((40, 3), np.nan, F), "NaN"),
    ("surfels.safetensors", "sh", np.full((40, 4, 3), np.inf, F), "NaN or infinite"),
    ("surfels.safetensors", "extras/a", np.full(39, 1, F), "one per surfel"),
    ("surfels.safetensors", "secret", np.zeros(40, F), "not part of schema"),
    ("mesh.safetensors", "faces", np.full((20, 3), 12, np.int32), "12"),
    ("mesh.safetensors", "faces", np.full((20, 3), -1, np.int32), "vert"),
    ("mesh.safetensors", "faces", np.zeros((20, 4), np.int32), "shape"),
    ("mesh.safetensors", "groups/lid", np.array([99], np.int32), "99"),
    ("mesh.safetensors", "albedo", np.zeros((11, 3), F), "shape"),
    ("binding.safetensors", "face", np.full(40, 20, np.int32), "20 of 20 faces"),
    ("binding.safetensors", "face", np.zeros((40, 1), np.int32), "shape"),
    ("binding.safetensors", "face", np.zeros(40, np.int64), "not part of schema"),
    ("binding.safetensors", "barycentric", np.ones((40, 3), F), "sum to 1"),
    ("environment.safetensors", "radiance", np.full((4, 8, 3), -1, F), "negative"),
]


@pytest.mark.parametrize("member, name, array, words", FAULTS, ids=[f"{n}: {w}" for _, n, _, w in FAULTS])
def test_each_fault_is_named(file: Path, member: str, name: str, array: np.ndarray | None, words: str) -> None:
    set_tensor(file, member, name, array)
    with pytest.raises(AssetError, match=words) as caught:
        read_asset(file)
    assert str(file) in str(caught.value)
    assert name.split("/")[-1] in str(caught.value)


def test_the_writer_refuses_what_the_reader_would(tmp_path: Path) -> None:
    asset = make_asset()
    asset.surfels.centre[3, 1] = np.nan
    with pytest.raises(AssetError, match=r"centre: has 1 values that are NaN"):
        write_asset(tmp_path / "a.drgs", asset)
    asset = make_asset()
    asset.provenance["when"] = object()
    with pytest.raises(AssetError, match="provenance"):
        write_asset(tmp_path / "a.drgs", asset)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("member", [MANIFEST, "surfels.safetensors", "mesh.safetensors"])
def test_missing_members_are_named(file: Path, member: str) -> None:
    members = [(n, [memoryview(v.tobytes())]) for n, v in read_archive(file).items() if n != member]
    write_archive(file, members)
    with pytest.raises(AssetError, match=f"{member}: is missing"):
        read_asset(file)


def test_unknown_members_and_foreign_conventions_are_refused(file: Path) -> None:
    clean = file.read_bytes()
    rewrite(file, {"run.py": b"print()"})
    with pytest.raises(AssetError, match=r"run\.py: is not a member"):
        read_asset(file)
    file.write_bytes(clean)
    rewrite(file, {}, manifest={"up_axis": "+Y"})
    with pytest.raises(AssetError, match="up_axis"):
        read_asset(file)
    file.write_bytes(clean)
    rewrite(file, {}, manifest={"schema": SCHEMA + 1, "producer": "drgs-blender 9"})
    with pytest.raises(VersionError, match="drgs-blender 9"):
        read_asset(file)


def with_channels() -> Asset:
    asset = make_asset()
    n, k = len(asset.mesh.vertices), len(asset.surfels)
    asset.mesh.emission, asset.mesh.opacity = np.full((n, 3), 20, F), np.full(n, 0.5, F)
    asset.surfels.emission, asset.surfels.coat = np.full((k, 3), 30, F), np.full(k, 0.25, F)
    return asset


def test_optional_channels_need_the_schema_that_has_them(tmp_path: Path) -> None:
    """Files without them are what they were."""
    plain, more = tmp_path / "plain.drgs", tmp_path / "more.drgs"
    write_asset(plain, make_asset())
    write_asset(more, with_channels())
    manifests = [json.loads(read_archive(path)[MANIFEST].tobytes()) for path in (plain, more)]
    assert [manifest["schema"] for manifest in manifests] == [1, 3]
    old = [list(manifest["members"]["mesh.safetensors"]["tensors"]) for manifest in manifests]
    assert old[1][: len(old[0])] == old[0] and set(old[1]) - set(old[0]) == {"opacity", "emission"}
    asset = read_asset(more)
    assert asset.surfels.emission.max() == 30 and asset.mesh.opacity.max() == 0.5 and asset.mesh.coat is None
    write_asset(tmp_path / "again.drgs", asset)
    assert (tmp_path / "again.drgs").read_bytes() == more.read_bytes()
    ranges = inspect_asset(more)["ranges"]
    assert ranges["mesh.emission"] == [20, 20] and "mesh.coat" not in ranges
    rewrite(more, {}, manifest={"schema": 2})
    with pytest.raises(AssetError, match="emission: with type float32 is not part of schema 2"):
        read_asset(more)


@pytest.mark.parametrize(
    ("part", "name", "array", "words"),
    [
        ("mesh", "emission", np.full((12, 3), np.nan, F), "NaN"),
        ("surfels", "emission", np.full((40, 3), -1, F), "negative"),
        ("mesh", "opacity", np.full(12, 1.5, F), "outside"),
        ("surfels", "specular", np.full(40, -1, F), "outside"),
    ],
)
def test_bad_channels_are_refused(tmp_path: Path, part: str, name: str, array: np.ndarray, words: str) -> None:
    asset = with_channels()
    setattr(getattr(asset, part), name, array)
    with pytest.raises(AssetError, match=words) as caught:
        write_asset(tmp_path / "a.drgs", asset)
    assert name in str(caught.value)


@pytest.mark.parametrize("name", ["opacity", "emission", "specular", "coat"])
def test_channels_of_the_wrong_length_are_refused(name: str) -> None:
    asset = make_asset()
    with pytest.raises(AssetError, match=f"mesh {name}.*shape"):
        replace(asset.mesh, **{name: np.zeros((3, 3), F)})


HOSTILE = {
    "absolute": ["/etc/passwd"],
    "parent": ["../x"],
    "inner parent": ["a/../x"],
    "backslash": ["..\\x"],
    "drive": ["C:x"],
    "duplicate": ["x", "x"],
    "case clash": ["Mesh.safetensors", "mesh.safetensors"],
    "empty": [""],
}


@pytest.mark.parametrize("names", HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_names_are_refused(tmp_path: Path, names: list[str]) -> None:
    path = tmp_path / "a.drgs"
    write_archive(path, [(MANIFEST, [memoryview(b"{}")]), *((n, [memoryview(b"1")]) for n in names)])
    with pytest.raises(AssetError, match=r"member name|appears twice"):
        read_archive(path)


def test_other_kinds_of_zip_are_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "a.drgs"
    cases = {"is compressed": zipfile.ZIP_DEFLATED, "not laid out|damaged or unexpected": zipfile.ZIP_STORED}
    for words, method in cases.items():
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.writestr(MANIFEST, "{}" + " " * 1_000_000)
        with pytest.raises(AssetError, match=words):
            read_asset(path)
    with zipfile.ZipFile(path, "w") as archive:
        link = zipfile.ZipInfo("link")
        link.create_system, link.external_attr = 3, 0o120777 << 16
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(AssetError, match="symbolic link"):
        read_asset(path)
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\1\2") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(AssetError, match="encrypted"):
        read_asset(path)


def test_declared_sizes_are_checked_before_anything_is_allocated(file: Path) -> None:
    """A bomb: tensors that claim terabytes in a file of kilobytes."""
    text = json.dumps({"centre": {"dtype": "F32", "shape": [1 << 40, 3], "data_offsets": [0, (1 << 40) * 12]}}).encode()
    bomb = struct.pack("<Q", len(text)) + text
    rewrite(file, {"surfels.safetensors": bomb})
    with pytest.raises(AssetError, match="does not lie"):
        read_asset(file)
    rewrite(file, {"surfels.safetensors": struct.pack("<Q", 1 << 62) + text})
    with pytest.raises(AssetError, match="declares a header"):
        read_asset(file)
    rewrite(file, {MANIFEST: b"[" * 200_000})
    with pytest.raises(AssetError, match="not valid JSON"):
        read_asset(file)


def test_a_failed_write_leaves_the_old_file_and_no_other(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()
    real = os.fsync

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(WriteError, match="No space left") as caught:
        write_asset(file, make_asset(100))
    monkeypatch.setattr(os, "fsync", real)
    assert caught.value.subject == str(file)
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]
    with pytest.raises(WriteError, match="nowhere"):
        write_asset(file.parent / "nowhere" / "a.drgs", make_asset())


@pytest.mark.skipif(os.name == "nt", reason="an open file cannot be replaced there")
def test_writing_replaces_the_file_and_never_changes_it(file: Path) -> None:
    """Who has the old file open or mapped goes on with the old asset."""
    before, number = file.read_bytes(), file.stat().st_ino
    mapped = read_asset(file)
    albedo = np.array(mapped.mesh.albedo)
    with open(file, "rb") as old:
        write_asset(file, make_asset(100))
        assert old.read() == before
    assert np.array_equal(mapped.mesh.albedo, albedo)
    assert file.stat().st_ino != number
    assert len(read_asset(file).surfels) == 100


def test_a_failed_rename_leaves_the_old_file_and_no_other(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, tried = file.read_bytes(), []

    def refuse(source: Path, target: Path) -> None:
        tried.append((Path(source).read_bytes()[:4], Path(source).parent, Path(target)))
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(WriteError, match="Permission denied"):
            write_asset(file, make_asset(100))
    assert tried == [(b"PK\3\4", file.parent, file)], "a whole file of the same folder is renamed"
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def test_not_an_asset(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="does not exist"):
        read_asset(tmp_path / "none.drgs")
    with pytest.raises(AssetError, match="cannot be read"):
        read_asset(tmp_path)
    (tmp_path / "x.drgs").write_bytes(b"ply\nformat ascii 1.0\n" * 9)
    with pytest.raises(AssetError, match=r"is not a \.drgs file"):
        read_asset(tmp_path / "x.drgs")


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        (
            "a.glb",
            b"glTF" + bytes(60),
            r"no \.drgs file but a mesh or splats.*`drgs make a\.glb` or `drgs import a\.glb`",
        ),
        (
            "a.OBJ",
            b"v 0 0 0\n",
            r"but a mesh\. Make one of it by `drgs make a\.OBJ`; in Blender by File > Import > DR-GS",
        ),
        ("a.stl", b"", "but a mesh.*Object > Convert > DR-GS"),
        ("a.3mf", b"PK\3\4" + bytes(60), "but a mesh"),
        ("a.spz", bytes(60), "but splats.*`drgs import a.spz`"),
        ("a.hdr", bytes(60), "is an image, no .drgs file"),
        ("a.fbx", bytes(60), r"is not a \.drgs file.*File > Import and choose Object > Convert > DR-GS"),
    ],
)
def test_files_of_other_kinds_are_called_what_they_are(tmp_path: Path, name: str, data: bytes, told: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(AssetError, match=told):
        read_asset(tmp_path / name)
    with pytest.raises(AssetError, match="does not exist"):
        read_asset(tmp_path / f"none{Path(name).suffix}")


def test_an_asset_of_another_name_is_read(tmp_path: Path) -> None:
    write_asset(tmp_path / "a.glb", make_asset(100))
    assert len(read_asset(tmp_path / "a.glb").surfels) == 100


def test_safetensors_agree_with_the_reference_package_both_ways() -> None:
    reference = pytest.importorskip("safetensors.numpy")
    rng = np.random.default_rng(3)
    tensors = {
        "a": rng.random((5, 3), dtype=np.float32),
        "empty": np.zeros((0, 4), np.int32),
        "ü/é": np.arange(7, dtype=np.int64),
        "scalar": np.array(3.5),
        "odd": np.arange(3, dtype=np.uint8),
        "flag": np.array([True, False]),
        "half": np.ones(3, np.float16),
    }
    ours = b"".join(encode(tensors))
    theirs = reference.save(tensors)
    for read in (reference.load(ours), decode(np.frombuffer(theirs, np.uint8)), decode(np.frombuffer(ours, np.uint8))):
        assert read.keys() == tensors.keys()
        for name, array in tensors.items():
            assert read[name].dtype == array.dtype
            np.testing.assert_array_equal(read[name], array)


@pytest.mark.parametrize(
    "header",
    [
        '{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
        '{"a":{"dtype":"F32","shape":[1],"data_offsets":[4,0]}}',
        '{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,8]}}',
        '{"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}',
        '{"a":{"dtype":"F32","shape":[true],"data_offsets":[0,4]}}',
        '{"a":{"dtype":"F32","shape":[1.0],"data_offsets":[0,4]}}',
        '{"a":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}',
        '{"a":{"dtype":["F32"],"shape":[1],"data_offsets":[0,4]}}',
        '{"a":{"shape":[1],"data_offsets":[0,4]}}',
        '{"a":[]}',
        '{"a":{"dtype":"F32","shape":[NaN],"data_offsets":[0,4]}}',
        "[]",
        "",
        "\ud800",
    ],
)
def test_bad_safetensors_headers_are_refused(header: str) -> None:
    text = header.encode(errors="surrogatepass")
    data = struct.pack("<Q", len(text)) + text + bytes(4)
    with pytest.raises(AssetError):
        decode(np.frombuffer(data, np.uint8))


def test_needs_numpy_only() -> None:
    """The extension imports the container in Blender's Python: nothing but numpy and the standard library."""
    import subprocess

    code = "import sys, drgs_blender.core.asset.container; print(sorted({m.split('.')[0] for m in sys.modules}))"
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60)
    heavy = {"numba", "scipy", "torch", "trimesh", "PIL", "OpenEXR", "safetensors", "bpy"}
    assert "numpy" in done.stdout and not heavy & set(ast.literal_eval(done.stdout)), done.stdout + done.stderr
