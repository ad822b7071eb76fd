"""Files of ours in other programs, and theirs here: the library of SPZ, PlayCanvas's splat-transform, and the Khronos
validator of glTF. They are npm's: `tools/dev.py test` fetches them where npm is; without them these tests are skipped.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapes import sphere_mesh
from splat_files import covariance, random_splats

from drgs_blender.core.asset import Mesh
from drgs_blender.formats.axes import multiply_quaternions, vectors_from_z_up
from drgs_blender.formats.gltf_document import Document
from drgs_blender.formats.gltf_mesh import write_gltf_mesh
from drgs_blender.formats.gltf_splats import EXTENSION, write_gltf_splats
from drgs_blender.formats.harmonics import rotate_harmonics
from drgs_blender.formats.registry import find_format, read_surfels
from drgs_blender.formats.sog_writer import write_sog
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import SplatMaterials, Splats, splats_of
from drgs_blender.formats.spz_writer import write_spz

FOLDER = Path(os.environ.get("DRGS_NODE", Path(__file__).resolve().parents[2] / ".venv-node"))
WRITERS = {".ply": write_splat_ply, ".spz": write_spz, ".sog": write_sog}


def needs(package: str) -> pytest.MarkDecorator:
    there = shutil.which("node") and (FOLDER / "node_modules" / package).is_dir()
    return pytest.mark.skipif(not there, reason=f"{package} of npm is not in {FOLDER} (set DRGS_NODE)")


def node(script: str, *arguments: object) -> str:
    """What a script prints that finds the packages."""
    command = ["node", "--input-type=module", "-e", script, *map(str, arguments)]
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, timeout=120)
    assert not done.returncode, done.stderr[-2000:]
    return done.stdout


def splat_transform(*arguments: Path | str) -> None:
    """Its command line: inputs with their options, then the output."""
    program = FOLDER / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    done = subprocess.run(["node", program, "-w", "-g", "cpu", *arguments], capture_output=True, text=True, timeout=120)
    assert not done.returncode and Path(arguments[-1]).exists(), done.stdout[-1000:] + done.stderr[-2000:]


# the library of SPZ

_READ = """
import fs from 'fs';
const spz = await (await import('@adobe/spz')).default();
const to = spz.CoordinateSystem[process.argv[3] ?? 'RUB'];
const cloud = await spz.loadSpzFromBuffer(fs.readFileSync(process.argv[1]), {to});
const parts = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'].map(name => cloud[name]);
fs.writeFileSync(process.argv[2], Buffer.concat(parts.map(a => Buffer.from(a.buffer, a.byteOffset, a.byteLength))));
console.log(cloud.numPoints, cloud.shDegree);
"""
_WRITE = """
import fs from 'fs';
const spz = await (await import('@adobe/spz')).default();
const bytes = fs.readFileSync(process.argv[1]);
const all = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);
const [n, degree, version] = process.argv.slice(3).map(Number);
let at = 0;
const take = width => all.slice(at, at += n * width);
const cloud = {numPoints: n, shDegree: degree, antialiased: false, extensions: [], positions: take(3), scales: take(3),
    rotations: take(4), alphas: take(1), colors: take(3), sh: take(3 * ((degree + 1) ** 2 - 1))};
const options = {version, from: spz.CoordinateSystem.RUB, sh1Bits: 8, shRestBits: 8};
fs.writeFileSync(process.argv[2], spz.saveSpzToBuffer(cloud, options));
"""


@needs("@adobe/spz")
@pytest.mark.parametrize(("version", "degree"), [(4, 0), (4, 1), (4, 2), (4, 3), (3, 3), (2, 0), (2, 3)])
def test_the_library_of_spz_reads_what_we_write(tmp_path: Path, version: int, degree: int) -> None:
    n, k = 200, (degree + 1) ** 2
    splats = random_splats(n, k)
    write_spz(tmp_path / "a.spz", splats, version)
    said = node(_READ, tmp_path / "a.spz", tmp_path / "a.bin")
    assert said.split()[-2:] == [str(n), str(degree)]
    sizes = np.cumsum([n * width for width in (3, 3, 4, 1, 3, 3 * (k - 1))])
    parts = np.split(np.fromfile(tmp_path / "a.bin", np.float32), sizes)
    centre, scale, rotation, opacity, colour, sh = (part.reshape(n, -1) for part in parts[:6])
    assert not len(parts[6])
    np.testing.assert_allclose(centre, splats.centre, atol=1.001 / 8192)
    if version == 2:  # the same ellipsoids, by other rotations
        same_shapes(replace(splats, rotation=rotation[:, [3, 0, 1, 2]], scale=np.exp(scale)), splats, 0.1)
    else:
        np.testing.assert_allclose(scale, np.log(splats.scale), atol=1.001 / 32)
        assert np.abs((rotation[:, [3, 0, 1, 2]] * splats.rotation).sum(axis=1)).min() > np.cos(np.radians(0.2))
    np.testing.assert_allclose(1 / (1 + np.exp(-opacity[:, 0])), splats.opacity, atol=1.01 / 510)
    np.testing.assert_allclose(colour, splats.sh[:, 0], atol=1.01 / (510 * 0.15))
    np.testing.assert_allclose(sh.reshape(n, k - 1, 3), splats.sh[:, 1:], atol=0.5 / 8 + 0.01)


@needs("@adobe/spz")
@pytest.mark.parametrize("version", [2, 3])
def test_the_library_of_spz_reads_what_lies_in_gltf(tmp_path: Path, version: int) -> None:
    """To LUF, as the draft of the extension says: what glTF without compression has."""
    splats = random_splats(200, 16)
    write_gltf_splats(tmp_path / "a.glb", splats, compress=True, spz_version=version)
    data, place = Document(tmp_path / "a.glb").view(0)
    assert place == (0, 0)
    data.tofile(tmp_path / "a.spz")
    node(_READ, tmp_path / "a.spz", tmp_path / "a.bin", "LUF")
    sizes = np.cumsum([200 * width for width in (3, 3, 4, 1, 3)])
    parts = np.split(np.fromfile(tmp_path / "a.bin", np.float32), sizes)
    centre, scale, rotation, _, _, sh = (part.reshape(200, -1) for part in parts)
    np.testing.assert_allclose(centre, splats.centre, atol=1.001 / 8192)
    same_shapes(replace(splats, rotation=rotation[:, [3, 0, 1, 2]], scale=np.exp(scale)), splats, 0.11)
    apart = sh.reshape(200, 15, 3) - splats.sh[:, 1:]
    assert np.sqrt(np.square(apart).mean()) < 0.06  # in other axes it would be ten times as much


@needs("@adobe/spz")
@pytest.mark.parametrize("version", [2, 3, 4])
def test_we_read_what_the_library_of_spz_writes(tmp_path: Path, version: int) -> None:
    splats = random_splats(200, 16)
    logit = np.log(splats.opacity / (1 - splats.opacity))
    rows = (splats.centre, np.log(splats.scale), splats.rotation[:, [1, 2, 3, 0]], logit, splats.sh[:, 0])
    np.concatenate([r.ravel() for r in (*rows, splats.sh[:, 1:])]).astype("<f4").tofile(tmp_path / "a.bin")
    node(_WRITE, tmp_path / "a.bin", tmp_path / "a.spz", len(splats), 3, version)
    file = read_surfels(tmp_path / "a.spz")
    found = splats_of(file.surfels)
    assert file.up == "y"
    np.testing.assert_allclose(found.centre, splats.centre, atol=1.001 / 8192)
    np.testing.assert_allclose(found.opacity, splats.opacity, atol=1.01 / 510)
    np.testing.assert_allclose(found.sh[:, 0], splats.sh[:, 0], atol=1.01 / (510 * 0.15))
    np.testing.assert_allclose(found.sh[:, 1:], splats.sh[:, 1:], atol=1.01 / 128)
    same_shapes(found, splats, 0.15 if version == 2 else 0.1)


# splat-transform


def turned(splats: Splats, sign: tuple[int, int, int]) -> Splats:
    """The same splats after half a turn, by the signs that coordinates get."""
    flips = np.float32(sign)
    # Half a turn about an axis times a rotation is a product of quaternions whose factors are 0 and 1.
    axis = np.append(0, flips > 0)
    rotation = multiply_quaternions(axis, splats.rotation).astype(np.float32)
    sh = rotate_harmonics(splats.sh, np.diag(flips))
    return Splats(splats.centre * flips, splats.scale, rotation, splats.opacity, sh)


def same_shapes(found: Splats, wanted: Splats, tolerance: float) -> None:
    """Covariances, to a part of the largest axis."""
    size = np.square(wanted.scale).max(axis=1)[:, None, None]
    apart = covariance(found.rotation, found.scale) - covariance(wanted.rotation, wanted.scale)
    assert np.abs(apart / size).max() < tolerance


@needs("@playcanvas/splat-transform")
@pytest.mark.parametrize("suffix", WRITERS)
def test_splat_transform_reads_what_we_write(tmp_path: Path, suffix: str) -> None:
    """The numbers that we read back; of SPZ, which is Y up, in the axes of PLY, where Y is down."""
    WRITERS[suffix](tmp_path / f"a{suffix}", random_splats(500))
    splat_transform(tmp_path / f"a{suffix}", tmp_path / "b.ply")
    ours, theirs = (splats_of(read_surfels(tmp_path / name).surfels) for name in (f"a{suffix}", "b.ply"))
    if suffix == ".spz":
        theirs = turned(theirs, (1, -1, -1))
    for name in ("centre", "opacity", "sh"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), atol=1e-5)
    same_shapes(theirs, ours, 1e-4)


@pytest.mark.slow
@needs("@playcanvas/splat-transform")
@pytest.mark.parametrize(
    ("name", "layout", "sign"),
    [
        ("b.compressed.ply", "compressed PLY", (1, 1, 1)),
        ("b.sog", "SOG", (1, 1, 1)),
        ("b.spz", "SPZ", (1, -1, -1)),
        ("b.glb", "KHR_gaussian_splatting", (-1, -1, 1)),
    ],
)
def test_we_read_what_splat_transform_writes(
    tmp_path: Path, name: str, layout: str, sign: tuple[int, int, int]
) -> None:
    """In the axes of each format: Y is down in PLY, and up in SPZ and glTF."""
    splats = random_splats(600)
    write_splat_ply(tmp_path / "a.ply", splats)
    splat_transform(tmp_path / "a.ply", tmp_path / name)
    file = read_surfels(tmp_path / name)
    assert file.layout == layout
    found, wanted = splats_of(file.surfels), splats if sign == (1, 1, 1) else turned(splats, sign)
    apart, order = cKDTree(found.centre).query(wanted.centre)
    assert len(np.unique(order)) == len(splats) and apart.max() < 0.01
    found = Splats(*(getattr(found, field)[order] for field in ("centre", "scale", "rotation", "opacity", "sh")))
    np.testing.assert_allclose(found.opacity, wanted.opacity, atol=0.005)
    np.testing.assert_allclose(found.sh[:, 0], wanted.sh[:, 0], atol=0.02)
    # These harmonics are noise, of which a palette holds little; in another order they would be 0.7 apart.
    assert np.sqrt(np.square(found.sh - wanted.sh).mean()) < (0.2 if layout == "SOG" else 0.05)
    same_shapes(found, wanted, 0.15)


# glTF

_VALIDATE = """
import fs from 'fs';
const validator = (await import('gltf-validator')).default;
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])));
console.log(JSON.stringify(report.issues));
"""


SPLAT_ATTRIBUTES = [
    "ROTATION",
    "SCALE",
    "OPACITY",
    *(f"SH_DEGREE_{l}_COEF_{i}" for l in range(4) for i in range(2 * l + 1)),
]


@needs("gltf-validator")
@pytest.mark.parametrize("kind", ["splats", "packed splats", "plain mesh", "painted mesh"])
def test_khronos_finds_nothing_wrong(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.glb"
    if kind.endswith("splats"):
        n = 50
        materials = SplatMaterials(np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
        write_gltf_splats(
            path, replace(random_splats(n), materials=materials), materials=True, compress=kind != "splats"
        )
        assert find_format(path).name == "glTF splats"
    else:
        vertices, faces = sphere_mesh(2)
        n = len(vertices)
        albedo = np.full((n, 3), 0.5) if kind == "plain mesh" else np.random.default_rng(1).uniform(0, 1, (n, 3))
        write_gltf_mesh(path, Mesh(vectors_from_z_up(vertices), faces, albedo, np.full(n, 0.5), np.zeros(n)))
    issues = json.loads(node(_VALIDATE, path))
    # It does not know the extension for splats, whose attributes it takes for misspelt ones. 2 and 3 are remarks.
    worse = [m for m in issues["messages"] if m["severity"] < 2 and EXTENSION not in m["pointer"]]
    assert not worse
    assert (
        issues["numErrors"] == (len(SPLAT_ATTRIBUTES) if kind.endswith("splats") else 0) and not issues["numWarnings"]
    )
