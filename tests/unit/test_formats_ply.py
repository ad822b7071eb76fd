"""PLY: every encoding of the same thing reads the same; damaged files are refused, never crash."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.formats.ply import TYPES, parse_header, read_ply
from drgs_blender.formats.ply_mesh import read_ply_mesh
from drgs_blender.formats.registry import read

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
POLYGONS = [[0, 1, 2, 3], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
TRIANGLES = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
NAMES = {code: name for name, code in reversed(TYPES.items())}


def write(
    path: Path, encoding: str, vertex: str = "f4", count: str = "u1", index: str = "i4", newline: str = "\n"
) -> Path:
    """A pyramid with a face property after the list and a comment, in any encoding and types."""
    header = [
        "ply",
        f"format {encoding} 1.0",
        "comment made for a test",
        f"element vertex {len(VERTICES)}",
        *(f"property {NAMES[vertex]} {a}" for a in "xyz"),
        f"element face {len(POLYGONS)}",
        f"property list {NAMES[count]} {NAMES[index]} vertex_indices",
        "property uchar flags",
        "end_header",
        "",
    ]
    data = newline.join(header).encode()
    if encoding == "ascii":
        rows = [" ".join(f"{x:.9g}" for x in v) for v in VERTICES]
        rows += [f"{len(p)} {' '.join(map(str, p))} 7" for p in POLYGONS]
        data += newline.join([*rows, ""]).encode()
    else:
        order = "<" if "little" in encoding else ">"
        data += VERTICES.astype(order + vertex).tobytes()
        for p in POLYGONS:
            data += np.array(len(p), order + count).tobytes() + np.array(p, order + index).tobytes() + b"\x07"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    "vertex, count, index", [("f4", "u1", "i4"), ("f8", "i4", "u2"), ("f4", "u2", "u1"), ("f8", "i1", "u4")]
)
def test_every_encoding_reads_the_same(
    tmp_path: Path, encoding: str, vertex: str, count: str, index: str, newline: str
) -> None:
    path = write(tmp_path / "a.ply", encoding, vertex, count, index, newline)
    mesh = read_ply_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, VERTICES.astype(np.float32))
    np.testing.assert_array_equal(mesh.faces, TRIANGLES)
    header, rows = read_ply(path)
    assert header.comments == ("made for a test",)
    assert rows["face"].columns["flags"].tolist() == [7] * 5
    assert rows["vertex"].columns["x"].dtype.newbyteorder("=") == np.dtype(vertex)


def test_colours_uvs_normals_and_our_channels(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\n"
        "property double x\nproperty double y\nproperty double z\n"
        "property float nx\nproperty float ny\nproperty float nz\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float s\nproperty float t\n"
        "element face 1\nproperty list uchar int vertex_index\nend_header\n"
        "0 0 0 0 0 2 255 128 0 0 0\n1 0 0 0 0 2 255 128 0 1 0\n0 1 0 0 0 2 255 128 0 0 1\n3 0 1 2\n"
    )
    mesh = read_ply_mesh(path)
    np.testing.assert_allclose(mesh.vertex_colours[0], srgb_to_linear(np.array([1, 128 / 255, 0])), atol=1e-7)
    np.testing.assert_array_equal(mesh.corner_normals, np.broadcast_to([0, 0, 1], (1, 3, 3)))
    np.testing.assert_array_equal(mesh.corner_uvs[0], [[0, 0], [1, 0], [0, 1]])
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "property float albedo_r\nproperty float albedo_g\nproperty float albedo_b\n"
        "property float roughness\nproperty float metallic\nend_header\n0 0 0 .1 .2 1.5 .4 .5\n"
    )
    mesh = read_ply_mesh(path)
    np.testing.assert_allclose(mesh.vertex_colours, [[0.1, 0.2, 1.0]])
    assert mesh.vertex_roughness[0] == np.float32(0.4) and mesh.vertex_metallic[0] == 0.5
    assert "1 values of albedo outside [0, 1] clipped" in mesh.notes and len(mesh.faces) == 0


def test_triangle_strips_keep_their_orientation(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
        "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        "0 0 0\n0 1 0\n1 0 0\n1 1 0\n2 0 0\n2 1 0\n9 0 2 1 3 -1 2 4 3 5\n"
    )
    mesh = read_ply_mesh(path)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert len(mesh.faces) == 4
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_texture_coordinates_of_faces_follow_the_fan(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 8 0 0 1 0 1 1 0 1\n"
    )
    mesh = read_ply_mesh(path)
    np.testing.assert_array_equal(mesh.corner_uvs, mesh.vertices[mesh.faces][..., :2])


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_truncated_files_are_refused(tmp_path: Path, encoding: str) -> None:
    path = write(tmp_path / "a.ply", encoding)
    data = path.read_bytes()
    last = len(data.rstrip()) - 1 if encoding == "ascii" else len(data)
    for length in range(4, last, 3):
        path.write_bytes(data[:length])
        with pytest.raises(AssetError):
            read(path)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_mutants_never_crash(tmp_path: Path, encoding: str) -> None:
    path = write(tmp_path / "a.ply", encoding)
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    for _ in range(300):
        mutant = bytearray(data)
        for place in rng.integers(4, len(data), rng.integers(1, 4)):
            mutant[place] = rng.integers(256)
        path.write_bytes(mutant)
        try:
            mesh = read(path, kind="mesh")
        except AssetError:
            continue
        assert np.isfinite(mesh.vertices).all()
        assert not len(mesh.faces) or (mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices))


BAD = {
    "count": "element vertex 999999999999\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
    "negative": "element vertex -1\nproperty float x\nend_header\n",
    "type": "element vertex 1\nproperty quaternion x\nend_header\n",
    "twice": "element vertex 1\nproperty float x\nproperty float x\nend_header\n1 1",
    "no element": "property float x\nend_header\n1",
    "float count": "element face 1\nproperty list float int vertex_indices\nend_header\n1 0",
    "no end": "element vertex 1\nproperty float x\n",
    "no vertices": "element face 1\nproperty list uchar int vertex_indices\nend_header\n3 0 1 2",
    "index": "element vertex 1\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n0 0 0 3 0 0 1",
    "huge list": "element vertex 1\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    "property list int int vertex_indices\nend_header\n0 0 0 2000000000 0 0 1",
    "words": "element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 zero 0",
}


@pytest.mark.parametrize("body", BAD.values(), ids=BAD.keys())
def test_nonsense_is_refused(tmp_path: Path, body: str) -> None:
    path = tmp_path / "a.ply"
    path.write_text("ply\nformat ascii 1.0\n" + body)
    with pytest.raises(AssetError, match=r"a\.ply"):
        read_ply_mesh(path)


def test_vertices_that_are_not_finite_are_removed_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\nnan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
    )
    mesh = read(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and mesh.faces.tolist() == [[0, 1, 2]]
    assert mesh.notes == ["1 vertices that are NaN or infinite removed, with 1 faces"]


def test_a_header_may_come_in_old_macintosh_lines() -> None:
    text = b"ply\rformat ascii 1.0\relement vertex 2\rproperty float x\rend_header\r"
    header = parse_header(text + b"1\r2\r", "a")
    assert header.element("vertex").count == 2 and header.size == len(text)
