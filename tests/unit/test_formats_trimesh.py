"""STL, OFF, 3MF and COLLADA: exact shapes from files by the book; damaged and hostile ones are refused by name."""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fuzz_files import square
from PIL import Image as Pillow
from scene_files import binary_stl, collada, model, off, text_stl, threemf

from drgs_blender.cli.main import main
from drgs_blender.core import own_python
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError, DeviceError
from drgs_blender.formats.files import MeshFile
from drgs_blender.formats.registry import find_format, read_mesh

pytest.importorskip("lxml")
pytest.importorskip("collada")

MESH = square()
VERTICES, FACES = MESH.vertices.astype(np.float32), MESH.faces
SOUP = VERTICES[FACES]
TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read(tmp_path: Path, name: str, data: bytes) -> MeshFile:
    (tmp_path / name).write_bytes(data)
    return read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.stl", binary_stl(SOUP)),
        ("b.stl", binary_stl(SOUP, b"solid as some programs begin binary ones, too\nfacet")),
        ("c.stl", text_stl(SOUP)),
        ("d.stl", text_stl(SOUP).upper().replace(b"\n", b"\r\n\t ").replace(b"E-", b"e-")),
        ("no name", binary_stl(SOUP)),
        ("no name either", text_stl(SOUP)),
    ],
    ids=["binary", "binary like text", "text", "upper case, Windows", "binary by content", "text by content"],
)
def test_stl_is_welded_where_corners_are_exactly_equal(tmp_path: Path, name: str, data: bytes) -> None:
    mesh = read(tmp_path, name, data)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SOUP)
    assert len(mesh.vertices) == len(VERTICES) and mesh.up_axis == "unknown"
    assert f"{3 * len(SOUP)} corners of separate triangles joined to {len(VERTICES)} vertices" in mesh.notes[-1]


def test_corners_that_differ_by_one_bit_stay_apart(tmp_path: Path) -> None:
    soup = np.stack([TRIANGLE, TRIANGLE]).astype(np.float32)
    soup[1, 1, 0] = np.nextafter(np.float32(1), np.float32(2))
    soup[1, 0, 1] = -0.0  # which is 0
    mesh = read(tmp_path, "a.stl", binary_stl(soup))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 3, 2]]


def test_solids_are_parts_whatever_they_are_called(tmp_path: Path) -> None:
    data = text_stl(SOUP[:5], "vertex normal endsolid") + text_stl(SOUP[5:], "b") + text_stl(SOUP[:0], "empty")
    mesh = read(tmp_path, "a.stl", data)
    assert mesh.parts == [("vertex normal endsolid", 0, 5), ("b", 5, len(SOUP))]
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SOUP)


def test_colours_and_bytes_that_are_ignored_are_named(tmp_path: Path) -> None:
    mesh = read(tmp_path, "a.stl", binary_stl(SOUP, attribute=0x8123) + b"more")
    assert mesh.notes[:2] == ["4 bytes behind the last triangle ignored", f"colours of {len(SOUP)} faces left out"]


def test_places_that_are_no_numbers_go_with_their_faces(tmp_path: Path) -> None:
    soup = SOUP.copy()
    soup[2, 1] = np.nan
    for data in (binary_stl(soup), text_stl(soup)):
        mesh = read(tmp_path, "a.stl", data)
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], np.delete(SOUP, 2, axis=0))
        assert any("NaN" in note for note in mesh.notes)


def test_off_is_read_as_it_is(tmp_path: Path) -> None:
    mesh = read(tmp_path, "a.off", off(VERTICES.astype(float), FACES))
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    quads = b"# by hand\nOFF\n\n5 2 0 # counts\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n4 0 1 2 3 255 0 0\n3 0 1 4\n"
    mesh = read(tmp_path, "quads", quads)
    area = np.linalg.norm(np.cross(*np.diff(mesh.vertices[mesh.faces], axis=1).swapaxes(0, 1)), axis=1) / 2
    assert sorted(area.tolist()) == [0.5, 0.5, 0.5] and mesh.notes == ["colours of faces left out"]


@pytest.mark.parametrize(
    ("header", "row"),
    [("COFF", "{} 255 128 0 255"), ("COFF", "{} 1.0 0.50196078431 0.0"), ("CNOFF", "{} 0 0 1 255 128 0 255")],
)
def test_colours_of_vertices_are_srgb(tmp_path: Path, header: str, row: str) -> None:
    rows = [row.format(" ".join(map(str, v))) for v in TRIANGLE.tolist()]
    mesh = read(tmp_path, "a.off", "\n".join([header, "3 1 0", *rows, "3 0 1 2"]).encode())
    np.testing.assert_allclose(mesh.vertex_colours, np.tile(srgb_to_linear(np.array([1, 128 / 255, 0])), (3, 1)))


def test_3mf_is_placed_in_metres(tmp_path: Path) -> None:
    objects = model(TRIANGLE, np.array([[0, 1, 2]]))
    objects += '<object id="2"><components><component objectid="1" transform="2 0 0 0 2 0 0 0 2 1 0 0"/>'
    objects += '<component objectid="1"/></components></object><basematerials id="9"><base name="a"/></basematerials>'
    items = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 5"/><item objectid="1"/>'
    mesh = read(tmp_path, "a.3mf", threemf(objects, items, "inch"))
    assert mesh.up_axis == "Z" and len(mesh.parts) == 3
    moved = [TRIANGLE * 2 + [1, 0, 0], TRIANGLE]  # rows times the matrix of 3MF
    turned = [piece @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [0, 0, 5] for piece in moved]
    found = sorted(np.round(t / 0.0254, 4).tolist() for t in mesh.vertices[mesh.faces])
    np.testing.assert_allclose(found, sorted(np.round(t, 4).tolist() for t in (*turned, TRIANGLE)), atol=1e-4)
    assert mesh.notes == ["colours and materials left out", "lengths converted from 0.0254 m to metres"]


def test_collada_keeps_textures_normals_and_colours(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (4, 4, 3), np.uint8)
    (tmp_path / "maps").mkdir()
    Pillow.fromarray(pixels).save(tmp_path / "maps" / "a b.png")
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]])
    polygons = [[0, 1, 2, 3], [0, 1, 4]]
    uvs, colours = np.arange(14).reshape(7, 2) / 16, np.tile([0.5, 1.0, 0.25], (7, 1))
    normals = np.repeat([[0.0, 0, 1], [0, -1, 0]], [4, 3], axis=0)
    data = collada(
        vertices, polygons, uvs=uvs, normals=normals, colours=colours, up="Y_UP", metres=0.01,
        diffuse='<texture texture="t" texcoord="UVMap"/>',
        images='<image id="i"><init_from>maps/a%20b.png</init_from></image>',
        place='<matrix sid="transform">2 0 0 10 0 2 0 0 0 0 2 0 0 0 0 1</matrix>',
    )  # fmt: skip
    mesh = read(tmp_path, "a.dae", data)
    corners = [0, 1, 2, 0, 2, 3, 4, 5, 6]
    flat = np.array([0, 1, 2, 3, 0, 1, 4])[corners]
    places = (vertices[flat] * 2 + [10, 0, 0]) @ TURN.T / 100
    np.testing.assert_allclose(mesh.vertices[mesh.faces].reshape(-1, 3), places, atol=1e-7)
    np.testing.assert_allclose(mesh.corner_uvs.reshape(-1, 2), uvs[corners])
    np.testing.assert_allclose(mesh.corner_normals.reshape(-1, 3), normals[corners] @ TURN.T, atol=1e-7)
    np.testing.assert_allclose(mesh.vertex_colours, np.tile(srgb_to_linear(np.array([0.5, 1, 0.25])), (5, 1)))
    assert len(mesh.vertices) == 5 and mesh.up_axis == "Z"
    np.testing.assert_array_equal(mesh.materials[0].base_colour_image.pixels, pixels)
    assert mesh.materials[0].base_colour == (1, 1, 1) and mesh.face_material.tolist() == [0, 0, 0]


@pytest.mark.slow
def test_collada_has_base_colours_axes_and_mirrors(tmp_path: Path) -> None:
    mesh = read(tmp_path, "a.dae", collada(TRIANGLE, [[0, 1, 2]], up="X_UP", place="<scale>1 1 -1</scale>"))
    np.testing.assert_allclose(mesh.materials[0].base_colour, (0.2, 0.4, 0.6), atol=1 / 509)  # of 8 bits in between
    # X up, -Y to the right: x is up and y is to the left; the face that was mirrored is turned over
    np.testing.assert_allclose(mesh.vertices[mesh.faces][0], np.array([[0, 0, 0], [0, 0, 1], [-1, 0, 0]])[::-1])
    assert mesh.corner_uvs is None and mesh.corner_normals is None and mesh.vertex_colours is None


@pytest.mark.slow
def test_textures_are_read_through_the_guards_alone(tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    for name, said in (("/etc/passwd", "texture /etc/passwd not found"), ("bad.png", "texture left out")):
        data = collada(
            TRIANGLE, [[0, 1, 2]], uvs=TRIANGLE[:, :2], diffuse='<texture texture="t" texcoord="U"/>',
            images=f'<image id="i"><init_from>{name}</init_from></image>',
        )  # fmt: skip
        mesh = read(tmp_path, "a.dae", data)
        assert any(said in note for note in mesh.notes), mesh.notes
        assert mesh.materials[0].base_colour_image is None and len(mesh.faces) == 1


GOOD_STL, GOOD_OFF = text_stl(SOUP), off(VERTICES.astype(float), FACES)
BAD = {
    "a.stl": [
        (binary_stl(SOUP)[:-9], "says that it has 128 triangles, and has the bytes of 127"),
        (binary_stl(SOUP)[:80] + b"\xff" * 4, "says that it has 4294967295 triangles"),
        (binary_stl(SOUP)[:40], "says that it has 0 triangles"),
        (GOOD_STL[: len(GOOD_STL) // 2], "triangles, of which 0 are whole"),
        (GOOD_STL.replace(b"vertex", b"vertex x", 1), "is no STL that can be read"),
        (GOOD_STL.replace(b"endfacet\n", b"endfacet\nfacet normal 0 0 0\nendfacet\n", 1), "of which 128 are whole"),
        (text_stl(SOUP[:0]), "has no triangles"),
        (b"", "is empty"),
    ],
    "a.off": [
        (GOOD_OFF[: len(GOOD_OFF) // 2], "says that it has 81 vertices and 128 faces, and has"),
        (GOOD_OFF.replace(b"128", b"99999999999"), "and has 209 lines"),
        (GOOD_OFF.replace(b"81 128", b"-81 128"), "does not say how many"),
        (GOOD_OFF[:-1] + b"100", "outside the range|out of bounds|other vertices"),
        (GOOD_OFF[: GOOD_OFF.rindex(b" ")] + b" -1", "is no OFF|other vertices"),
        (b"OFF BINARY\n\0\0\0\3", "is OFF that is binary"),
        (b"4OFF\n1 0 0\n0 0 0 0\n", "not of three dimensions"),
        (b"OFF", "does not say how many"),
        ("OFF ² 1 0\n".encode("latin-1"), "does not say how many"),
    ],
    "a.3mf": [
        (threemf(model(TRIANGLE, np.array([[0, 1, 7]]))), "faces of vertices that are not there"),
        (threemf(model(TRIANGLE, np.array([[0, 1, 2]])), unit="parsec"), "unknown unit 'parsec'"),
        (threemf(""), "cannot be read as 3MF|places objects 1 times, of which 0"),
        (threemf(model(TRIANGLE, np.array([[0, 1, 2]])), ""), "places none of its objects"),
        (threemf("<object"), "cannot be read as 3MF"),
        (threemf(model(TRIANGLE, np.array([[0, 1, 2]])))[:-60], "cannot be read as 3MF"),
    ],
    "a.dae": [
        (collada(TRIANGLE, [[0, 1, 2]])[:-400], "cannot be read as COLLADA"),
        (collada(TRIANGLE, [[0, 1, 2]], up="W_UP"), "up axis 'W_UP'"),
        (collada(TRIANGLE, [[0, 1, 2]], metres=0.0), "a unit of 0 m"),
        (collada(TRIANGLE, [[0, 1, 2]]).replace(b"instance_geometry", b"instance_controller"), "but skinned"),
        (collada(TRIANGLE, [[0, 1, 2]]).replace(b"<COLLADA", b'<!DOCTYPE a [<!ENTITY b "c">]><COLLADA'), "entities"),
    ],
}


@pytest.mark.parametrize(
    ("name", "number"),
    [
        # those read apart start a process
        pytest.param(name, i, marks=[pytest.mark.slow] if name in ("a.3mf", "a.dae") and i else [])
        for name, cases in BAD.items()
        for i in range(len(cases))
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path: Path, name: str, number: int) -> None:
    data, problem = BAD[name][number]
    with pytest.raises(AssetError, match=rf"{name}: .*({problem})") as caught:
        read(tmp_path, name, data)
    assert caught.value.remedy


def test_objects_are_not_placed_without_end(tmp_path: Path) -> None:
    """Each of thirty objects is two of the next."""
    objects = model(TRIANGLE, np.array([[0, 1, 2]]))
    for i in range(2, 32):
        objects += f'<object id="{i}"><components>{f"""<component objectid="{i - 1}"/>""" * 2}</components></object>'
    with pytest.raises(AssetError, match=r"a\.3mf: places its objects 1073741824 times"):
        read(tmp_path, "a.3mf", threemf(objects, '<item objectid="31"/>'))
    circle = '<object id="1"><components><component objectid="1"/></components></object>'
    with pytest.raises(AssetError, match=r"b\.3mf: has objects that contain themselves"):
        read(tmp_path, "b.3mf", threemf(circle))


@pytest.mark.slow
def test_nodes_that_are_placed_without_end_take_a_while_at_most(tmp_path: Path) -> None:
    nodes = '<node id="k0"><instance_geometry url="#g"/></node>'
    for i in range(1, 30):
        nodes += f'<node id="k{i}">{f"""<instance_node url="#k{i - 1}"/>""" * 2}</node>'
    with pytest.raises(AssetError, match=r"c\.dae: (keeps|cannot|places)"):
        read(tmp_path, "c.dae", collada(TRIANGLE, [[0, 1, 2]], nodes=nodes, place='<instance_node url="#k29"/>'))


def test_small_files_do_not_unpack_to_large_ones(tmp_path: Path) -> None:
    data = io.BytesIO(threemf(model(TRIANGLE, np.array([[0, 1, 2]]))))
    with zipfile.ZipFile(data, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/other.model", bytes(100 << 20))
    with pytest.raises(AssetError, match="unpacks to more than such files hold"):
        read(tmp_path, "a.3mf", data.getvalue())


@pytest.mark.parametrize(
    ("bundled", "said"),
    [([], "pip install lxml pycollada"), ([sys.executable], 'Set Up Engine .* "USD, 3MF and COLLADA"')],
)
def test_without_its_packages_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bundled: list[str], said: str
) -> None:
    monkeypatch.setattr(own_python, "bundled", bundled)
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['lxml'] = None\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(DeviceError, match=rf"a\.3mf: needs the packages .* {said}"):
        read(tmp_path, "a.3mf", threemf(model(TRIANGLE, np.array([[0, 1, 2]]))))


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.stl", binary_stl(SOUP)),
        ("a.off", GOOD_OFF),
        pytest.param("a.3mf", threemf(model(VERTICES.astype(float) * 1000, FACES)), marks=pytest.mark.slow),
        pytest.param("a.dae", collada(VERTICES.astype(float), FACES.tolist()), marks=pytest.mark.slow),
    ],
)
def test_commands_take_them_where_they_take_obj(
    tmp_path: Path, name: str, data: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    assert find_format(path).kind == "mesh"
    assert main(["inspect", str(path)]) == 0
    assert f"{len(FACES)}" in capsys.readouterr().out
    assert main(["convert", str(path), str(tmp_path / "o.glb"), "--scale", "2"]) == 0
    again = read_mesh(tmp_path / "o.glb")
    np.testing.assert_allclose(np.ptp(again.vertices, axis=0), 2 * np.ptp(VERTICES, axis=0), atol=1e-5)
    assert main(["make", str(path), "--density", "20", "--out", str(tmp_path / "a.drgs")]) == 0
    assert main(["inspect", str(tmp_path / "a.drgs")]) == 0
