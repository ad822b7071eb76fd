"""Readers of splat containers: against the programs that wrote them, against the format's definition, and damaged."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from splat_files import covariance, damaged, random_splats, refusals

from drgs_blender.core import own_python
from drgs_blender.core.asset import Surfels
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.core.errors import AssetError, DeviceError
from drgs_blender.formats.axes import surfels_to_z_up
from drgs_blender.formats.files import MeshFile
from drgs_blender.formats.glb import Glb
from drgs_blender.formats.gltf_document import Document
from drgs_blender.formats.gltf_splats import EXTENSION, write_gltf_splats
from drgs_blender.formats.harmonics import rotate_harmonics
from drgs_blender.formats.quaternions import from_smallest_three, to_smallest_three
from drgs_blender.formats.registry import find_format, read, read_surfels
from drgs_blender.formats.splat_scene import encoded
from drgs_blender.formats.splats import Splats, splats_of
from drgs_blender.formats.usd_splats import write_usd_splats


def test_smallest_three_there_and_back() -> None:
    rotation = random_splats(500).rotation
    back = from_smallest_three(*to_smallest_three(rotation))
    np.testing.assert_allclose(np.abs((back * rotation).sum(axis=1)), 1, atol=1e-6)


# SOG


def webp(pixels: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "WEBP", lossless=True, exact=True)
    return data.getvalue()


def square(rows: np.ndarray) -> np.ndarray:
    """(n, 4) bytes as a picture."""
    side = int(np.ceil(np.sqrt(len(rows))))
    picture = np.zeros((side * side, 4), np.uint8)
    picture[: len(rows)] = rows
    return picture.reshape(side, side, 4)


def sog(version: int, n: int = 90) -> tuple[dict, dict[str, bytes], dict[str, np.ndarray]]:
    """(meta, pictures, what they mean) of random splats, by the definition of the format."""
    rng = np.random.default_rng(version)
    byte = lambda width: rng.integers(0, 256, (n, width), np.uint8)  # noqa: E731
    low, high, scales, colours, three = byte(4), byte(4), byte(4), byte(4), byte(3)
    tag = rng.integers(252, 256, n).astype(np.uint8)
    centroids = rng.integers(0, 256, (2, 64 * 3, 4), np.uint8)
    centroids[..., 3] = 255
    label = rng.integers(0, 128, n)
    labels = np.stack([label % 256, label // 256, 0 * label, 255 + 0 * label], axis=1).astype(np.uint8)
    pictures = {
        "means_l.webp": low, "means_u.webp": high, "scales.webp": scales, "sh0.webp": colours,
        "quats.webp": np.concatenate([three, tag[:, None]], axis=1), "shN_labels.webp": labels,
    }  # fmt: skip
    files = {name: webp(square(rows)) for name, rows in pictures.items()} | {"shN_centroids.webp": webp(centroids)}
    mins, maxs = [-1.0, -0.5, 0.1], [1.0, 0.7, 2.0]
    level = (low[:, :3] + 256.0 * high[:, :3]) / 65535
    log = np.array(mins) + (np.array(maxs) - mins) * level
    book = np.sort(rng.normal(size=(3, 256)), axis=1)
    others = (three / 255 * 2 - 1) / np.sqrt(2)
    meta: dict = {"means": {"mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"]}}
    meta |= {key: {"files": [f"{key}.webp"]} for key in ("scales", "quats", "sh0")}
    meta["shN"] = {"files": ["shN_centroids.webp", "shN_labels.webp"]}
    palette = centroids.reshape(128, 3, 4)[..., :3]
    means = {"centre": np.sign(log) * (np.exp(np.abs(log)) - 1)}
    if version == 2:
        meta |= {"version": 2, "count": n}
        for key, row in zip(("scales", "sh0", "shN"), book, strict=True):
            meta[key]["codebook"] = row.tolist()
        means |= {"scale": np.exp(book[0][scales[:, :3]]), "dc": book[1][colours[:, :3]]}
        means |= {"opacity": colours[:, 3] / 255, "rest": book[2][palette[label]]}
    else:
        meta["means"]["shape"] = [n, 3]
        meta["scales"] |= {"mins": [-4, -5, -6], "maxs": [1, 0, -2]}
        meta["sh0"] |= {"mins": [-2, -2, -1, -5], "maxs": [2, 1, 2, 6]}
        meta["shN"] |= {"mins": -0.5, "maxs": 1.5}
        means["scale"] = np.exp([-4, -5, -6] + np.array([5, 5, 4]) * scales[:, :3] / 255)
        means["dc"] = [-2, -2, -1] + np.array([4, 3, 3]) * colours[:, :3] / 255
        means["opacity"] = 1 / (1 + np.exp(5 - 11.0 * colours[:, 3] / 255))
        means["rest"] = -0.5 + 2.0 * palette[label] / 255
    largest = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))
    means["rotation"] = np.stack([np.insert(o, t - 252, g) for o, t, g in zip(others, tag, largest, strict=True)])
    return meta, files, means


def write_sog(path: Path, meta: dict, files: dict[str, bytes]) -> bytes:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, data in files.items():
            archive.writestr(name, data)
    return path.read_bytes()


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("version", [1, 2])
def test_sog_means_what_its_definition_says(tmp_path: Path, version: int, zipped: bool) -> None:
    meta, files, means = sog(version)
    if zipped:
        path = tmp_path / "a.sog"
        write_sog(path, meta, files)
    else:
        path = tmp_path / "meta.json"
        path.write_text(json.dumps(meta, indent=1))
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
    assert find_format(path).name == "SOG"
    found = splats_of(read_surfels(path).surfels)
    np.testing.assert_allclose(found.centre, means["centre"], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.sh[:, 0], means["dc"], atol=1e-5)
    np.testing.assert_allclose(found.sh[:, 1:], means["rest"], atol=1e-5)
    np.testing.assert_allclose(found.opacity, means["opacity"], atol=1e-5)
    wanted = means["rotation"] / np.linalg.norm(means["rotation"], axis=1, keepdims=True)
    wanted = covariance(wanted, means["scale"])
    size = np.trace(wanted, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(covariance(found.rotation, found.scale) / size, wanted / size, atol=1e-5)


def test_a_real_sog_is_the_capture_it_was_made_of(shared_data: Path) -> None:
    packed = read_surfels(shared_data / "splats/playbot_sog/4_0/meta.json").surfels
    source = read_surfels(shared_data / "splats/playbot_lod4.ply").surfels
    assert len(packed) == len(source) and packed.sh is not None and source.sh is not None
    distance, nearest = cKDTree(source.centre).query(packed.centre)
    assert np.quantile(distance, 0.99) < 2e-4
    assert np.quantile(np.abs(packed.opacity - source.opacity[nearest]), 0.95) < 0.01
    # One codebook of 256 colours serves all splats.
    assert np.median(np.abs(packed.sh[:, 0] - source.sh[nearest, 0])) < 0.02
    own, wanted = (covariance(s.rotation, s.scale) for s in (packed, source))
    size = np.trace(wanted[nearest], axis1=1, axis2=2)
    assert np.quantile(np.abs(own - wanted[nearest]).max(axis=(1, 2)) / size, 0.9) < 0.1


@pytest.mark.parametrize("version", [1, 2])
def test_damaged_sog_is_refused_or_read_sensibly(tmp_path: Path, version: int) -> None:
    path = tmp_path / "a.sog"
    meta, files, _ = sog(version)
    assert refusals(path, write_sog(path, meta, files), 120) > 40
    rng = np.random.default_rng(8)
    folder = tmp_path / "meta.json"
    for _ in range(60):  # what a zip's checksums would have caught
        for name, data in files.items():
            (tmp_path / name).write_bytes(damaged(data, rng) if rng.integers(3) == 0 else data)
        text = json.dumps(meta).encode()
        folder.write_bytes(damaged(text, rng) if rng.integers(2) else text)
        try:
            surfels = read_surfels(folder).surfels
        except AssetError:
            continue
        assert np.isfinite(surfels.centre).all()


@pytest.mark.parametrize("count", [10**9, -1, 1.5, None, "90", True])
def test_sog_with_an_impossible_count_is_refused(tmp_path: Path, count: object) -> None:
    meta, files, _ = sog(2)
    write_sog(tmp_path / "a.sog", meta | {"count": count}, files)
    with pytest.raises(AssetError):
        read_surfels(tmp_path / "a.sog")


def test_sog_reads_no_file_elsewhere(tmp_path: Path) -> None:
    meta, files, _ = sog(2)
    meta["quats"]["files"] = ["../secret.webp"]
    (tmp_path / "secret.webp").write_bytes(files["quats.webp"])
    (tmp_path / "b").mkdir()
    for name, data in files.items():
        (tmp_path / "b" / name).write_bytes(data)
    (tmp_path / "b" / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(AssetError, match="no file beside it"):
        read_surfels(tmp_path / "b" / "meta.json")


@pytest.mark.parametrize("name", ["", "a\0b", "\ud800", "x" * 5000])
@pytest.mark.parametrize("zipped", [True, False])
def test_names_that_no_file_can_have_are_refused(tmp_path: Path, name: str, zipped: bool) -> None:
    meta, files, _ = sog(2)
    meta["quats"]["files"] = [name]
    path = tmp_path / ("a.sog" if zipped else "meta.json")
    if zipped:
        write_sog(path, meta, files)
    else:
        path.write_text(json.dumps(meta))
        for other, data in files.items():
            (tmp_path / other).write_bytes(data)
    with pytest.raises(AssetError, match=re.escape(path.name)):
        read_surfels(path)


def test_integers_without_end_are_refused(tmp_path: Path) -> None:
    meta, files, _ = sog(2)
    meta["means"]["mins"] = [10**400, 0, 0]
    write_sog(tmp_path / "a.sog", meta, files)
    with pytest.raises(AssetError, match=r"means\.mins"):
        read_surfels(tmp_path / "a.sog")


# ksplat


def ksplat(level: int, degree: int = 2, n: int = 50) -> tuple[bytes, Splats]:
    """A file of two sections with buckets of 8, the last one partly filled, and what it means."""
    splats = random_splats(2 * n, (degree + 1) ** 2, seed=level)
    number = "<f4" if level == 0 else "<f2"
    body, sections = b"", b""
    block, steps = 0.5, 32767
    for part in range(2):
        rows = slice(part * n, part * n + n)
        centre = splats.centre[rows]
        full, left = divmod(n, 8)
        buckets = full + (left > 0)
        bucket = np.arange(n) // 8
        middle = np.stack([centre[bucket == b][0] for b in range(buckets)])
        if level:
            centre = splats.centre[rows] = middle[bucket] + np.random.default_rng(part).uniform(-0.2, 0.2, (n, 3))
        record = np.zeros(
            n,
            [
                ("p", "<f4" if level == 0 else "<u2", 3), ("s", number, 3), ("q", number, 4), ("c", "u1", 4),
                ("h", "u1" if level == 2 else number, (3 * ((degree + 1) ** 2 - 1),)),
            ],
        )  # fmt: skip
        record["p"] = centre if level == 0 else np.rint((centre - middle[bucket]) / (block / 2) * steps + steps)
        record["s"], record["q"] = splats.scale[rows], splats.rotation[rows]
        colour = 0.28209479177387814 * splats.sh[rows, 0] + 0.5
        record["c"] = np.rint(np.concatenate([colour, splats.opacity[rows, None]], axis=1) * 255)
        bands = [splats.sh[rows, l * l : (l + 1) ** 2].transpose(0, 2, 1).reshape(n, -1) for l in range(1, degree + 1)]
        flat = np.concatenate([np.zeros((n, 0)), *bands], axis=1)
        record["h"] = np.rint((flat + 1) / 2 * 255) if level == 2 else flat
        if level:
            body += struct.pack("<I", left) + middle.astype("<f4").tobytes()
            layout = (8, buckets, block, 12, steps, full, 1)
        else:
            layout = (0, 0, 0.0, 0, 0, 0, 0)
        body += record.tobytes()
        capacity, count, size, storage, range_, whole, partial = layout
        head = struct.pack("<4IfH2xI4x2IH", n, n, capacity, count, size, storage, range_, whole, partial, degree)
        sections += head.ljust(1024, b"\0")
    header = struct.pack("<BB2xIIIIH", 0, 1, 2, 2, 2 * n, 2 * n, level).ljust(36, b"\0") + struct.pack("<2f", -1, 1)
    return header.ljust(4096, b"\0") + sections + body, splats


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_ksplat_means_what_its_definition_says(tmp_path: Path, level: int, degree: int) -> None:
    data, splats = ksplat(level, degree)
    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    found = read_surfels(path).surfels
    precision = 1e-6 if level == 0 else 2e-3
    np.testing.assert_allclose(found.centre, splats.centre, atol=1e-6 if level == 0 else 1e-4)
    np.testing.assert_allclose(found.scale, splats.scale[:, :2], rtol=precision)
    np.testing.assert_allclose(np.abs((found.rotation * splats.rotation).sum(axis=1)), 1, atol=precision)
    np.testing.assert_allclose(found.opacity, splats.opacity, atol=1 / 500)
    np.testing.assert_allclose(found.sh[:, 0], splats.sh[:, 0], atol=1 / 500 / 0.282)
    np.testing.assert_allclose(found.sh[:, 1:], splats.sh[:, 1:], atol=1 / 250 if level == 2 else precision)


def test_the_fixtures_of_one_scene_agree(shared_data: Path) -> None:
    """Four splats as .ksplat and .splat."""
    first, second = (read_surfels(shared_data / f"splats/fixtures/minimal.{s}").surfels for s in ("ksplat", "splat"))
    assert len(first) == len(second) == 4
    np.testing.assert_allclose(first.centre, second.centre, atol=1e-5)
    np.testing.assert_allclose(first.opacity, second.opacity, atol=1e-5)
    np.testing.assert_allclose(first.albedo, second.albedo, atol=1e-5)


@pytest.mark.parametrize("level", [0, 1])
def test_damaged_ksplat_is_refused_or_read_sensibly(tmp_path: Path, level: int) -> None:
    data, _ = ksplat(level)

    def damage(data: bytes, rng: np.random.Generator) -> bytes:
        changed = bytearray(damaged(data, rng))
        for start in (0, 4096, 5120):  # the fields of the headers
            if len(changed) > start + 48 and rng.integers(2):
                changed[start + rng.integers(48)] = rng.integers(256)
        return bytes(changed)

    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    assert refusals(path, data, 200, damage) > 60


# .splat and compressed PLY


def test_splat_means_what_its_definition_says(tmp_path: Path) -> None:
    """Linear scales, colours as shown, rotations wxyz around 128."""
    n, rng = 50, np.random.default_rng(4)
    rows = np.zeros(n, [("p", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    rows["p"], rows["s"] = rng.normal(size=(n, 3)), np.sort(rng.uniform(0.01, 1, (n, 3)))[:, ::-1]
    rows["c"], rows["q"] = rng.integers(1, 255, (n, 4)), rng.integers(0, 256, (n, 4))
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    found = splats_of(read_surfels(tmp_path / "a.splat").surfels)
    np.testing.assert_array_equal(found.centre, rows["p"])
    rotation = (rows["q"] - 128.0) / 128
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    wanted = covariance(rotation, rows["s"])
    np.testing.assert_allclose(covariance(found.rotation, found.scale), wanted, atol=1e-5)
    np.testing.assert_allclose(0.28209479 * found.sh[:, 0] + 0.5, rows["c"][:, :3] / 255, atol=1e-5)
    np.testing.assert_allclose(found.opacity, rows["c"][:, 3] / 255, atol=1e-5)


@pytest.mark.parametrize("coloured", [False, True])
def test_compressed_ply_means_what_its_definition_says(tmp_path: Path, coloured: bool) -> None:
    """Bits of 32, the highest first, between the ends of a chunk of 256; two of them tell the largest of wxyz."""
    n, rng = 300, np.random.default_rng(5)
    names = ["x", "y", "z", "scale_x", "scale_y", "scale_z", *("rgb" if coloured else "")]
    low = np.float32([-1, -2, -3, -6, -5, -4, -0.2, 0.1, 0.2][: len(names)]) + np.float32([[0], [0.5]])
    high = low + np.float32([2, 3, 4, 1, 2, 3, 1, 0.5, 0.25][: len(names)])
    packed = rng.integers(0, 2**32, (n, 4), np.uint32)
    words = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 2"]
    lines += [f"property float {end}_{name}" for end in ("min", "max") for name in names]
    lines += [f"element vertex {n}", *(f"property uint {word}" for word in words), "end_header", ""]
    chunk = np.concatenate([low, high], axis=1)
    path = tmp_path / "a.ply"
    path.write_bytes("\n".join(lines).encode() + chunk.astype("<f4").tobytes() + packed.tobytes())

    def fields(word: int, *widths: int) -> np.ndarray:
        text = f"{word:032b}"
        ends = np.cumsum([0, *widths])
        return np.array([int(text[a:b], 2) / (2 ** (b - a) - 1) for a, b in pairwise(ends)])

    found = splats_of(read_surfels(path).surfels)
    for i, (place, turn, size, colour) in enumerate(packed.tolist()):
        start, span = low[i // 256], (high - low)[i // 256]
        np.testing.assert_allclose(found.centre[i], start[:3] + span[:3] * fields(place, 11, 10, 11), atol=1e-5)
        scale = np.exp(start[3:6] + span[3:6] * fields(size, 11, 10, 11))
        shown = fields(colour, 8, 8, 8, 8)
        three = (fields(turn & (1 << 30) - 1, 2, 10, 10, 10)[1:] - 0.5) * np.sqrt(2)
        rotation = np.insert(three, turn >> 30, np.sqrt(max(0, 1 - three @ three)))[None]
        wanted = covariance(rotation / np.linalg.norm(rotation), scale[None])[0]
        own = covariance(found.rotation[i : i + 1], found.scale[i : i + 1])[0]
        np.testing.assert_allclose(own, wanted, atol=1e-5 * scale.max() ** 2)
        if coloured:
            shown[:3] = start[6:] + span[6:] * shown[:3]
        np.testing.assert_allclose(0.28209479 * found.sh[i, 0] + 0.5, shown[:3], atol=1e-5)
        np.testing.assert_allclose(found.opacity[i], shown[3].clip(1e-6, 1 - 1e-6), atol=1e-5)


def test_compressed_ply_keeps_its_harmonics(tmp_path: Path) -> None:
    n, rng = 300, np.random.default_rng(3)
    stored = rng.integers(0, 256, (n, 24), np.uint8)
    ends = [f"{e}_{c}" for e in ("min", "max") for c in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    chunk = np.tile(np.float32([0, 0, 0, -5, -5, -5, 1, 1, 1, -1, -1, -1]), (2, 1))
    packed = rng.integers(0, 2**32, (n, 4), np.uint32)
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 2", *(f"property float {e}" for e in ends)]
    names = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    lines += [f"element vertex {n}", *(f"property uint {name}" for name in names)]
    lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(24)), "end_header", ""]
    path = tmp_path / "a.compressed.ply"
    path.write_bytes("\n".join(lines).encode() + chunk.tobytes() + packed.tobytes() + stored.tobytes())
    sh = read_surfels(path).surfels.sh
    assert sh.shape == (n, 9, 3)
    wanted = ((stored + 0.5) / 256 - 0.5) * 8
    inner = (stored > 0) & (stored < 255)
    found = sh[:, 1:].transpose(0, 2, 1).reshape(n, 24)
    np.testing.assert_allclose(found[inner], wanted[inner], atol=1e-5)
    assert (found[stored == 0] == -4).all() and (found[stored == 255] == 4).all()


# glTF and USD


def scene(path: Path, splats: Splats, matrix: np.ndarray) -> None:
    """A glTF of `splats` twice: as they are, and below a node with `matrix`."""
    write_gltf_splats(path, splats)
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    document["nodes"].append({"mesh": 0, "matrix": matrix.T.ravel().tolist()})
    document["scenes"][0]["nodes"].append(1)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    path.write_bytes(head + text + rest)


@pytest.mark.parametrize("size", [(2, 2, 2), (2, 1, 0.5), (2, 2, -2), (2, -1, 0.5)])
def test_gltf_splats_stand_where_their_nodes_are(tmp_path: Path, size: tuple[float, float, float]) -> None:
    splats = random_splats(60, 9)
    turn = Rotation.from_euler("xyz", [20, -40, 75], degrees=True).as_matrix()
    linear = turn @ np.diag(size)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, [1, 2, 3]
    scene(tmp_path / "a.glb", splats, matrix)
    assert find_format(tmp_path / "a.glb").name == "glTF splats"
    file = read_surfels(tmp_path / "a.glb")
    assert file.up == "y" and len(file.surfels) == 120
    found = splats_of(file.surfels)
    own = covariance(splats.rotation, splats.scale)
    np.testing.assert_allclose(covariance(found.rotation[:60], found.scale[:60]), own, rtol=1e-3, atol=1e-6)
    moved = linear @ own @ linear.T
    np.testing.assert_allclose(covariance(found.rotation[60:], found.scale[60:]), moved, rtol=1e-3, atol=5e-6)
    np.testing.assert_allclose(found.centre[60:], splats.centre @ linear.T + [1, 2, 3], atol=1e-5)
    np.testing.assert_array_equal(found.sh[:60], splats.sh)
    np.testing.assert_allclose(found.sh[60:], rotate_harmonics(splats.sh, turn @ np.diag(np.sign(size))), atol=1e-5)


def test_viewers_without_the_extension_see_points_in_the_same_colours(tmp_path: Path) -> None:
    """COLOR_0 is linear (glTF), what splats show is not."""
    splats = random_splats(60, 4)
    write_gltf_splats(tmp_path / "a.glb", splats)
    document = Document(tmp_path / "a.glb")
    index = document.item("meshes", 0)["primitives"][0]["attributes"]["COLOR_0"]
    shown = srgb_to_linear((0.5 + 0.28209479 * splats.sh[:, 0]).clip(0, 1))
    wanted = np.column_stack([shown, splats.opacity])
    np.testing.assert_allclose(document.accessor(index, ("VEC4",)), wanted, atol=1e-5)


def test_the_conformance_file_is_read(shared_data: Path) -> None:
    """Every type that attributes may have, one splat a node; it is of a draft whose scales are logarithms."""
    file = read_surfels(shared_data / "splats/fixtures/khr_conformance_matrix.glb")
    assert len(file.surfels) == 15
    assert any("logarithms" in note for note in file.notes) and any("linear colours" in note for note in file.notes)
    assert file.surfels.sh.shape[1] == 16


def test_linear_colours_become_srgb() -> None:
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0] = (0.2140411 - 0.5) / 0.28209479  # half way up in sRGB
    sh[0, 1] = 0.01
    found = encoded(sh)
    np.testing.assert_allclose(0.5 + 0.28209479 * found[0, 0], 0.5, atol=1e-4)
    step = 1e-3
    shifted = sh.copy()
    shifted[0, 0] += step / 0.28209479
    slope = (encoded(shifted) - found)[0, 0] * 0.28209479 / step
    np.testing.assert_allclose(found[0, 1] / sh[0, 1], slope, rtol=5e-3)


def test_damaged_gltf_splats_are_refused_or_read_sensibly(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    write_gltf_splats(path, random_splats(40, 4))
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(200):
        path.write_bytes(damaged(data, rng))
        try:
            found = read(path)
        except AssetError:
            refused += 1
            continue
        centre = found.vertices if isinstance(found, MeshFile) else found.surfels.centre
        assert np.isfinite(centre).all()
    assert refused > 40


def test_compressed_gltf_splats_say_so(tmp_path: Path) -> None:
    glb = Glb()
    primitive = {"mode": 0, "attributes": {}, "extensions": {EXTENSION: {"extensions": {"KHR_x_compression": {}}}}}
    glb.json |= {"extensionsUsed": [EXTENSION], "scenes": [{"nodes": [0]}], "scene": 0}
    glb.json |= {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    glb.write(tmp_path / "a.glb")
    with pytest.raises(AssetError, match="KHR_x_compression"):
        read_surfels(tmp_path / "a.glb")


@pytest.mark.parametrize("suffix", [".usda", ".usdc", pytest.param(".usd", marks=pytest.mark.slow)])
def test_usd_keeps_everything(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    splats = random_splats(60, 9)
    path = tmp_path / f"a{suffix}"
    write_usd_splats(path, splats)
    file = read_surfels(path)
    assert file.layout == "USD" and file.up == "z" and not any("linear" in note for note in file.notes)
    found = splats_of(file.surfels)
    np.testing.assert_allclose(found.centre, splats.centre, atol=1e-6)
    np.testing.assert_allclose(found.opacity, splats.opacity, atol=1e-6)
    np.testing.assert_allclose(found.sh, splats.sh, atol=1e-6)
    own = covariance(splats.rotation, splats.scale)
    np.testing.assert_allclose(covariance(found.rotation, found.scale), own, rtol=1e-3, atol=1e-6)


def test_usd_finds_nothing_wrong_with_the_splats(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdValidation, UsdVol

    write_usd_splats(tmp_path / "a.usdc", random_splats(20, 4))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not UsdValidation.ValidationContext(validators).Validate(stage)
    prim = stage.GetDefaultPrim()
    assert prim.IsA(UsdVol.ParticleField) and Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None) == "srgb_rec709_scene"
    for name in ("positions", "scales", "orientations", "opacities"):
        assert not prim.GetAttribute(name).IsCustom() and len(prim.GetAttribute(name).Get()) == 20


def test_usd_of_another_hand(tmp_path: Path) -> None:
    """The example of the published requirements, in half floats, in centimetres, Y up, below a transform."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    (tmp_path / "a.usda").write_text(
        """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Y"
)
def Xform "Root"
{
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def ParticleField3DGaussianSplat "Splat"
    {
        point3h[] positionsh = [(0, 0, 0), (0, 50, 0)]
        half3[] scalesh = [(10, 20, 1), (10, 20, 1)]
        quath[] orientationsh = [(1, 0, 0, 0), (0.7071, 0, 0, 0.7071)]
        half[] opacitiesh = [0.5, 0.25]
        uniform int radiance:sphericalHarmonicsDegree = 0
        half3[] radiance:sphericalHarmonicsCoefficientsh = [(1, 0, 0), (0, 1, 0)]
    }
}
"""
    )
    file = read_surfels(tmp_path / "a.usda")
    surfels: Surfels = surfels_to_z_up(file.surfels, file.up)
    np.testing.assert_allclose(surfels.centre, [[1, 0, 0], [1, 0, 0.5]], atol=1e-5)
    np.testing.assert_allclose(surfels.scale, [[0.1, 0.2], [0.1, 0.2]], rtol=1e-3)
    np.testing.assert_allclose(surfels.opacity, [0.5, 0.25], atol=1e-4)
    # The second is turned by a quarter about Z of the file, which is -Y here: X becomes Y of the file, Z here.
    np.testing.assert_allclose(covariance(surfels.rotation, surfels.scale)[1], np.diag([0.04, 0, 0.01]), atol=1e-4)
    shown = 0.5 + 0.28209479 * surfels.sh[:, 0]
    text = (
        (tmp_path / "a.usda")
        .read_text()
        .replace('Xform "Root"', 'Xform "Root" (\n    prepend apiSchemas = ["ColorSpaceAPI"]\n)')
    )
    text = text.replace("double3 xform", 'uniform token colorSpace:name = "lin_rec709_scene"\n    double3 xform')
    (tmp_path / "c.usda").write_text(text)
    linear = read_surfels(tmp_path / "c.usda")
    assert any("linear" in note for note in linear.notes)
    encoded_ = 0.5 + 0.28209479 * linear.surfels.sh[:, 0]
    np.testing.assert_allclose(encoded_, linear_to_srgb(shown.clip(0, 1)), atol=1e-4)
    (tmp_path / "b.usda").write_text("#usda 1.0\ndef Xform 'A' {\n")
    with pytest.raises(AssetError, match="USD"):
        read_surfels(tmp_path / "b.usda")


@pytest.mark.parametrize(
    ("bundled", "said"), [([], "pip install usd-core"), ([sys.executable], 'Set Up Engine .* "USD, 3MF and COLLADA"')]
)
def test_usd_without_its_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bundled: list[str], said: str
) -> None:
    """The package hides behind a module of its name that cannot be imported; zips of the extension have none."""
    monkeypatch.setattr(own_python, "bundled", bundled)
    (tmp_path / "pxr.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "pxr", None)
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    with pytest.raises(DeviceError, match=said):
        read_surfels(tmp_path / "a.usda")
    with pytest.raises(DeviceError, match=said):
        write_usd_splats(tmp_path / "b.usda", random_splats(3))


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there are no such limits there")
@pytest.mark.parametrize(
    ("body", "patience", "reason"),
    [
        ("while True: pass", 1000, "busy for longer"),
        ("import time\ntime.sleep(600)", 1, "busy for longer"),
        ("import os\nos.abort()", 20, "crashes"),
        ("import time\ntime.sleep(4)\nraise ImportError", 20, "pip install usd-core"),
    ],
)
def test_usd_that_takes_too_long_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, patience: int, reason: str
) -> None:
    """Its library may never come back from a damaged file, or take the process along; a busy machine is no reason."""
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "pxr.py").write_text(body)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr("drgs_blender.formats.usd_splats.SECONDS", 3.0)
    monkeypatch.setattr("drgs_blender.formats.usd_splats.PATIENCE", patience)
    with pytest.raises((AssetError, DeviceError), match=reason):
        read_surfels(tmp_path / "a.usda")
