"""SPZ of versions 2 and 3, written: by the published layout, byte by byte, and back to the stated precision."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from splat_files import covariance, old_spz, random_splats

from drgs_blender.cli.main import main
from drgs_blender.core.errors import UsageError
from drgs_blender.formats.registry import find_format, read_surfels
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import Splats, splats_of
from drgs_blender.formats.spz_writer import write_spz
from drgs_blender.geometry.normals import rotation_matrices

HARMONICS = {1: 0, 4: 9, 9: 24, 16: 45}


def attributes(path: Path) -> tuple[tuple, dict[str, np.ndarray]]:
    """The header of 16 bytes, and the attributes behind it in the order of the README, as bytes (n, width)."""
    data = gzip.decompress(path.read_bytes())
    header = struct.unpack("<IIIBBBB", data[:16])
    _, version, n, degree, *_ = header
    widths = {"positions": 9, "alphas": 1, "colors": 3, "scales": 3, "rotations": 3 if version == 2 else 4}
    widths["sh"] = 3 * ((degree + 1) ** 2 - 1)
    assert len(data) == 16 + n * sum(widths.values())
    parts, start = {}, 16
    for name, width in widths.items():
        parts[name] = np.frombuffer(data, np.uint8, n * width, start).reshape(n, width)
        start += n * width
    return header, parts


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("version", [2, 3])
def test_bytes_are_those_of_the_published_layout(tmp_path: Path, version: int, coefficients: int) -> None:
    splats = random_splats(40, coefficients)
    write_spz(tmp_path / "a.spz", splats, version)
    header, parts = attributes(tmp_path / "a.spz")
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[coefficients]
    assert header == (0x5053474E, version, 40, degree, 12, 0, 0)
    for i, (centre, opacity) in enumerate(zip(splats.centre.tolist(), splats.opacity.tolist(), strict=True)):
        for axis, value in enumerate(centre):  # fixed point, little endian, signed
            stored = int.from_bytes(parts["positions"][i, 3 * axis : 3 * axis + 3].tobytes(), "little", signed=True)
            assert abs(stored / 4096 - value) <= 0.5 / 4096 + 1e-7
        assert abs(int(parts["alphas"][i, 0]) - 255 * opacity) <= 0.5001
    np.testing.assert_allclose(parts["colors"], 255 * (0.5 + 0.15 * splats.sh[:, 0]), atol=0.501)
    if coefficients > 1:  # coefficients outside, channels inside
        sh = (parts["sh"].astype(float) - 128).reshape(40, coefficients - 1, 3) / 128
        np.testing.assert_allclose(sh, splats.sh[:, 1:], atol=0.5 / 8 + 0.5 / 128 + 1e-6)
    scale, rotation = np.exp(parts["scales"] / 16.0 - 10), parts["rotations"]
    for i in range(40):
        if version == 2:
            x, y, z = rotation[i] / 127.5 - 1
            wxyz = np.array([np.sqrt(max(0, 1 - x * x - y * y - z * z)), x, y, z])
        else:
            word = int.from_bytes(rotation[i].tobytes(), "little")
            xyzw, largest = [], word >> 30
            for field in (word >> 20 & 1023, word >> 10 & 1023, word & 1023):
                xyzw.append((-1 if field & 512 else 1) * (field & 511) / 511 * np.sqrt(0.5))
            xyzw.insert(largest, np.sqrt(1 - np.square(xyzw).sum()))
            wxyz = np.array(xyzw)[[3, 0, 1, 2]]
            np.testing.assert_allclose(scale[i], splats.scale[i], rtol=0.033)
        found = covariance(wxyz[None] / np.linalg.norm(wxyz), scale[i : i + 1])[0]
        wanted = covariance(splats.rotation[i : i + 1], splats.scale[i : i + 1])[0]
        assert np.abs(found - wanted).max() < (0.11 if version == 2 else 0.08) * np.abs(wanted).max()


@pytest.mark.parametrize("version", [2, 3, 4])
def test_all_versions_lose_what_the_documentation_says(tmp_path: Path, version: int) -> None:
    splats = random_splats(20_000, 4)
    write_spz(tmp_path / "a.spz", splats, version)
    assert find_format(tmp_path / "a.spz").name == "SPZ"
    file = read_surfels(tmp_path / "a.spz")
    assert file.up == "y" and len(file.surfels) == 20_000
    assert np.abs(file.surfels.centre - splats.centre).max() <= 1 / 8192 * 1.001
    assert np.abs(file.surfels.opacity - splats.opacity).max() <= 1 / 510 * 1.001
    # Normals; the tangents of version 2 may be others of the same ellipse.
    normals = (rotation_matrices(r.astype(np.float64))[..., 2] for r in (file.surfels.rotation, splats.rotation))
    apart = np.degrees(np.arccos(np.clip(np.sum(np.prod(list(normals), axis=0), axis=1), -1, 1)))
    assert apart.max() < (1.8 if version == 2 else 0.4)


def test_rotations_of_version_2_stay_exact_where_the_real_part_is_small(tmp_path: Path) -> None:
    """x, y, z of a half turn say next to nothing of w: as they are, they would be wrong by some ten degrees."""
    splats = random_splats(500)
    splats.rotation[:, 0] = np.linspace(-0.02, 0.02, 500)
    splats.rotation /= np.linalg.norm(splats.rotation, axis=1, keepdims=True)
    write_spz(tmp_path / "a.spz", splats, 2)
    found = splats_of(read_surfels(tmp_path / "a.spz").surfels)
    normals = (rotation_matrices(r.astype(np.float64))[..., 2] for r in (found.rotation, splats.rotation))
    assert np.sum(np.prod(list(normals), axis=0), axis=1).min() > np.cos(np.radians(1.8))  # also the side
    naive = np.rint(splats.rotation[:, 1:] * np.where(splats.rotation[:, :1] < 0, -127.5, 127.5) + 127.5) / 127.5 - 1
    real = np.sqrt(np.maximum(1 - np.square(naive).sum(axis=1), 0))
    assert real.max() > 0.08  # the test is of what it says


def test_version_3_is_version_4_in_one_stream(tmp_path: Path) -> None:
    """The same attributes, so that what is proven of one holds for the other."""
    splats = random_splats(100, 9)
    for version in (3, 4):
        write_spz(tmp_path / f"{version}.spz", splats, version)
    three, four = ((tmp_path / f"{version}.spz").read_bytes() for version in (3, 4))
    ours, turned = gzip.decompress(three), gzip.decompress(old_spz(four, 3))
    assert ours[16:] == turned[16:] and three[:2] == b"\x1f\x8b" and four[:4] == b"NGSP"
    write_spz(tmp_path / "again.spz", splats, 3)
    assert (tmp_path / "again.spz").read_bytes() == three  # no time in it


@pytest.mark.parametrize("version", [2, 3])
def test_none_and_far_ones_are_written(tmp_path: Path, version: int) -> None:
    none = Splats(*(getattr(random_splats(3), name)[:0] for name in ("centre", "scale", "rotation", "opacity", "sh")))
    write_spz(tmp_path / "a.spz", none, version)
    assert len(read_surfels(tmp_path / "a.spz").surfels) == 0
    splats = random_splats(50)
    splats.centre[0] = (50_000, -3, 2)
    write_spz(tmp_path / "b.spz", splats, version)
    assert np.abs(read_surfels(tmp_path / "b.spz").surfels.centre - splats.centre).max() <= 0.5 / 128


def test_a_version_that_there_is_not_is_refused(tmp_path: Path) -> None:
    for version in (1, 5):
        with pytest.raises(UsageError, match=f"a.spz: cannot be SPZ of version {version}"):
            write_spz(tmp_path / "a.spz", random_splats(3), version)
    assert not (tmp_path / "a.spz").exists()


def test_convert_writes_the_version_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_splat_ply(tmp_path / "a.ply", random_splats(30))
    for version in (2, 3, 4):
        out = tmp_path / f"{version}.spz"
        assert main(["convert", str(tmp_path / "a.ply"), str(out), "--spz-version", str(version)]) == 0
        data = out.read_bytes()
        assert struct.unpack_from("<I", data if version == 4 else gzip.decompress(data), 4)[0] == version
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.sog"), "--spz-version", "3"]) == 64
    assert "--spz-version: is no option of SOG. Leave it out, or write SPZ" in capsys.readouterr().err
    assert not (tmp_path / "a.sog").exists()
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.spz"), "--spz-version", "1"]) == 64
