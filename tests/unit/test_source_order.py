"""Assets keep the vertices of the mesh they are made from, in its order, or know where those went."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from test_build_make import plane

from drgs_blender.build.make import make_asset, mesh_with_materials, scale_mesh
from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import inspect_asset, read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Environment, Mesh, SourceVertices
from drgs_blender.core.errors import EXIT_BAD_ASSET, EXIT_USAGE, AssetError
from drgs_blender.core.frame import Camera, Frame, ObjectState, Pose, RenderSettings
from drgs_blender.deform.attach import attach
from drgs_blender.engine.scene_objects import moved_vertices
from drgs_blender.engine.session import Session
from drgs_blender.formats.files import Image, MeshFile
from drgs_blender.formats.point_cache import read_point_cache, write_point_cache


def shuffled(mesh: trimesh.Trimesh, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a mesh in another order."""
    order = np.random.default_rng(seed).permutation(len(mesh.vertices))
    return mesh.vertices[order].astype(np.float32), np.argsort(order)[mesh.faces]


def bent(vertices: np.ndarray) -> np.ndarray:
    """The same bend wherever a vertex is numbered."""
    x, y, z = np.asarray(vertices, np.float64).T
    return np.stack([x + 0.3 * z * z, y * (1 + 0.2 * x), z + 0.1 * np.sin(3 * x)], axis=1).astype(np.float32)


def flat_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normals = trimesh.Trimesh(vertices, faces, process=False).face_normals
    return np.repeat(normals[:, None], 3, axis=1)


def board_image(size: int = 32) -> Image:
    """A checkerboard, which asks for subdivision."""
    pixels = np.indices((size, size)).sum(axis=0) // 4 % 2 * 200 + 20
    return Image(np.repeat(pixels[..., None], 3, axis=2).astype(np.uint8), srgb=True)


def checkered(seed: int = 0) -> MeshFile:
    """A square of 3 x 3 x 2 triangles with a checkerboard."""
    file = plane(3, board_image())
    vertices, faces = shuffled(trimesh.Trimesh(file.vertices, file.faces, process=False), seed)
    return replace(file, vertices=vertices, faces=faces)


@pytest.mark.parametrize("seed", range(4))
def test_a_mesh_that_need_not_change_keeps_its_numbers(seed: int) -> None:
    vertices, faces = shuffled(trimesh.creation.icosphere(2), seed)
    mesh, _ = mesh_with_materials(MeshFile(vertices, faces), "ball")
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert mesh.source is None and mesh.in_own_order(vertices) is vertices


def test_hard_edges_add_vertices_after_those_of_the_source() -> None:
    vertices, faces = shuffled(trimesh.creation.box(), 1)
    mesh, _ = mesh_with_materials(MeshFile(vertices, faces, flat_normals(vertices, faces)), "box")
    assert len(mesh.vertices) == 24
    np.testing.assert_array_equal(mesh.vertices[:8], vertices)
    np.testing.assert_array_equal(mesh.in_own_order(bent(vertices)), bent(mesh.vertices))


@pytest.mark.parametrize("seed", range(3))
def test_merged_vertices_take_the_pose_of_the_source(seed: int) -> None:
    """As of glTF, which has a vertex of its own on either side of each seam."""
    ball = trimesh.creation.icosphere(2)
    soup = trimesh.Trimesh(ball.vertices[ball.faces].reshape(-1, 3), np.arange(960).reshape(-1, 3), process=False)
    vertices, faces = shuffled(soup, seed)
    mesh, _ = mesh_with_materials(MeshFile(vertices, faces), "ball")
    assert len(mesh.vertices) == 162 and mesh.source.index.shape == (162, 1)
    np.testing.assert_array_equal(mesh.in_own_order(vertices), mesh.vertices)
    np.testing.assert_allclose(mesh.in_own_order(bent(vertices))[mesh.faces], bent(vertices)[faces], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_divided_faces_follow_the_faces_of_the_source(seed: int) -> None:
    """A new vertex lies in its face, at the place of which the checkerboard's colour is known by its UV."""
    file = checkered(seed)
    mesh, report = mesh_with_materials(file, "board")
    assert report["rounds"] > 2 and len(mesh.vertices) > 200
    np.testing.assert_array_equal(mesh.vertices[: len(file.vertices)], file.vertices)
    np.testing.assert_array_equal(mesh.in_own_order(file.vertices), mesh.vertices)
    pose = bent(file.vertices) + np.random.default_rng(seed).normal(0, 0.1, file.vertices.shape).astype(np.float32)
    moved = mesh.in_own_order(pose)
    np.testing.assert_array_equal(moved[: len(pose)], pose)
    for face in file.faces:  # barycentric coordinates at rest place the vertex in the pose
        a, b, c = file.vertices[face, :2].astype(np.float64)
        part = np.linalg.solve(np.stack([b - a, c - a], 1), (mesh.vertices[:, :2] - a).T).T
        weights = np.concatenate([1 - part.sum(1, keepdims=True), part], 1)
        inside = (weights > -1e-6).all(axis=1)
        np.testing.assert_allclose(moved[inside], weights[inside] @ pose[face], atol=1e-5)


def test_what_is_left_out_does_not_shift_the_rest() -> None:
    """Loose vertices, also ones that are not finite, faces without area and vertices that only those have."""
    vertices, faces = shuffled(trimesh.creation.icosphere(1), 2)
    loose = np.float32([[9, 9, 9], [np.nan, 0, 0], [3, 3, 3], [4, 4, 4]])
    all_vertices = np.concatenate([loose[:2], vertices, loose[2:]])
    all_faces = np.concatenate([[[44, 45, 44]], faces + 2, [[2, 2, 3]]])
    mesh, report = mesh_with_materials(MeshFile(all_vertices, all_faces), "ball")
    assert report["degenerate_faces"] == 2 and mesh.source.count[0] == 46
    np.testing.assert_array_equal(mesh.in_own_order(all_vertices), vertices)
    np.testing.assert_array_equal(mesh.vertices, vertices)


def made(file: MeshFile) -> Asset:
    mesh, _ = mesh_with_materials(file, "board")
    surfels, binding, _ = attach(mesh, density=20)
    return Asset(surfels, mesh, binding)


def test_the_file_keeps_where_vertices_come_from(tmp_path) -> None:
    asset = made(checkered())
    write_asset(tmp_path / "board.drgs", asset)
    source = read_asset(tmp_path / "board.drgs").mesh.source
    for name in ("index", "weights", "count"):
        np.testing.assert_array_equal(getattr(source, name), getattr(asset.mesh.source, name))
    write_asset(tmp_path / "own.drgs", replace(asset, mesh=replace(asset.mesh, source=None)))
    assert read_asset(tmp_path / "own.drgs").mesh.source is None


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"index": lambda a: a[:-1], "weights": lambda a: a[:-1]}, "rows for"),
        ({"index": lambda a: a + 1000}, "refers to number"),
        ({"index": lambda a: a - 1000}, "refers to number"),
        ({"weights": lambda a: 2 * a}, "do not sum to 1"),
        ({"weights": lambda a: np.tile(np.float32((-4, 5, 0)), (len(a), 1))}, "negative value -4"),
        ({"transform": lambda a: 0 * a}, "flattens"),
        ({"transform": lambda a: a @ np.diag([1, 1, 0])}, "flattens"),
        ({"transform": lambda a: a + np.float32(np.inf)}, "NaN"),
        ({"weights": lambda a: a * np.float32(np.nan)}, "NaN"),
        ({"count": lambda a: a - 10}, "refers to number"),
        ({"count": lambda a: a - 1000}, "have the count"),
    ],
)
def test_a_source_that_fits_no_mesh_is_refused(tmp_path, change, problem: str) -> None:
    asset = made(checkered())
    source = asset.mesh.source
    values = {name: getattr(source, name) for name in ("index", "weights", "count", "transform")}
    values |= {name: alter(values[name]) for name, alter in change.items()}
    with pytest.raises(AssetError, match=problem):
        asset.mesh.source = SourceVertices(**values)
        write_asset(tmp_path / "board.drgs", asset)


def render(session: Session, key: str, vertices: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = 0.5, 0.5, 3
    camera = Camera(matrix, 24, 24, 48.0, 48.0, 12.0, 12.0)
    state = ObjectState("board", key, vertices=vertices)
    return session.render(Frame(1, camera, [state], settings=RenderSettings(samples=4)))["Combined"]


def test_a_frame_takes_poses_in_either_order(tmp_path) -> None:
    file = checkered()
    asset = made(file)
    write_asset(tmp_path / "board.drgs", asset)
    session = Session()
    key = session.load_asset(tmp_path / "board.drgs")
    pose = bent(file.vertices)
    own = asset.mesh.in_own_order(pose)
    np.testing.assert_array_equal(render(session, key, pose), render(session, key, own))
    assert not np.array_equal(render(session, key, own), render(session, key, asset.mesh.vertices))
    moved = Pose("board", np.eye(4)[None], pose)
    np.testing.assert_array_equal(moved_vertices(ObjectState("board", key, vertices=own), asset, moved), own)
    for shape in ((16,), (16, 1), (16, 4)):
        with pytest.raises(AssetError, match="object board"):
            render(session, key, np.zeros(shape, np.float32))
    with pytest.raises(AssetError, match=f"has 5 vertices, its asset has {len(own)}, the mesh it was made from 16"):
        render(session, key, pose[:5])


def test_the_command_line_takes_either_order_and_asks_where_both_fit(tmp_path, capsys) -> None:
    vertices, faces = shuffled(trimesh.creation.icosphere(2), 3)
    n = len(vertices)
    turned = np.roll(np.arange(n), 1)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
    mesh.source = SourceVertices(np.argsort(turned)[:, None], np.ones((n, 1)), np.array([n]))
    surfels, binding, _ = attach(mesh, density=20)
    write_asset(tmp_path / "ball.drgs", Asset(surfels, mesh, binding))
    np.save(tmp_path / "source.npy", bent(vertices)[turned])
    np.save(tmp_path / "own.npy", bent(vertices))
    np.save(tmp_path / "few.npy", vertices[:7])
    command = ["convert", str(tmp_path / "ball.drgs"), str(tmp_path / "out.glb"), "--as", "mesh", "--vertices"]

    def converted(name: str, *options: str) -> bytes:
        assert main([*command, str(tmp_path / name), *options]) == 0
        return (tmp_path / "out.glb").read_bytes()

    assert converted("source.npy", "--vertex-order", "source") == converted("own.npy", "--vertex-order", "asset")
    for name, code, problem in (
        ("own.npy", EXIT_USAGE, "whose orders differ"),
        ("few.npy", EXIT_BAD_ASSET, f"7 vertices; the asset has {n}"),
    ):
        assert main([*command, str(tmp_path / name)]) == code
        assert problem in capsys.readouterr().err
    (tmp_path / "front.json").write_text(
        json.dumps({"matrix_world": np.eye(4).tolist(), "width": 8, "height": 8, "fov_x": 30})
    )
    relight = ["relight", str(tmp_path / "ball.drgs"), "--camera", str(tmp_path / "front.json")]
    assert main([*relight, "--out", str(tmp_path / "o.exr"), "--vertex-order", "source"]) == EXIT_USAGE
    assert "there are none" in capsys.readouterr().err


@pytest.mark.parametrize("up", ["y", "-y", "-z"])
def test_poses_turn_and_grow_as_the_mesh_did(tmp_path, up: str) -> None:
    """A pose of the file is in the file's axes and unit."""
    file = checkered()
    trimesh.Trimesh(file.vertices, file.faces, process=False).export(tmp_path / "board.ply")
    asset = make_asset(tmp_path / "board.ply", up=up, scale=0.3)
    read = asset.mesh
    np.testing.assert_array_equal(read.source.to_asset(file.vertices), read.vertices)
    assert read.source.in_order
    np.testing.assert_array_equal(read.in_own_order(file.vertices), file.vertices)  # one that fits both is the mesh's


def test_vertices_that_a_reader_leaves_out_or_joins_keep_their_numbers(tmp_path) -> None:
    ball = trimesh.creation.icosphere(1)
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices]
    lines[3:3] = ["v nan 0 0", "v 0 inf 0"]
    faces = ball.faces + np.where(ball.faces >= 3, 3, 1)
    (tmp_path / "ball.obj").write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces)]))
    read = make_asset(tmp_path / "ball.obj").mesh
    assert read.source_count == 44
    given = np.insert(ball.vertices, [3, 3], 0, axis=0)
    np.testing.assert_allclose(read.in_own_order(given), read.vertices, atol=1e-6)

    ball.export(tmp_path / "ball.stl")
    read = make_asset(tmp_path / "ball.stl").mesh
    assert (len(read.vertices), read.source_count) == (42, 240)
    np.testing.assert_array_equal(read.in_own_order(ball.triangles.reshape(-1, 3).astype(np.float32)), read.vertices)


def test_only_files_that_know_their_source_need_a_newer_reader(tmp_path) -> None:
    asset = made(checkered())
    write_asset(tmp_path / "with.drgs", asset)
    write_asset(tmp_path / "without.drgs", replace(asset, mesh=replace(asset.mesh, source=None)))
    assert [inspect_asset(tmp_path / f"{name}.drgs")["schema"] for name in ("with", "without")] == [2, 1]


@pytest.fixture
def board(tmp_path):
    """Asset of a checkerboard in a file, and a walk of three frames of the mesh that it was made from."""
    file = checkered()
    asset = made(file)
    write_asset(tmp_path / "board.drgs", asset)
    walk = np.stack([bent(file.vertices) + np.float32(step) for step in range(3)])
    return asset, walk


@pytest.mark.parametrize("name", ["walk.pc2", "walk.mdd"])
def test_point_caches_of_the_source_are_written_in_the_order_of_the_asset(tmp_path, board, name: str, capsys) -> None:
    asset, walk = board
    write_point_cache(tmp_path / name, iter(walk), 3, 16, 5, 25.0)
    first = 5 if name.endswith("pc2") else 1
    command = ["convert", str(tmp_path / "board.drgs"), str(tmp_path / "own.pc2"), "--vertices", str(tmp_path / name)]
    assert main(command) == 0
    read = read_point_cache(tmp_path / "own.pc2")
    assert read.first == first
    np.testing.assert_array_equal(read.frames, [asset.mesh.in_own_order(pose) for pose in walk])
    assert main([*command, "--frames", f"{first + 1}-{first + 2}", "--scale", "2"]) == 0
    read = read_point_cache(tmp_path / "own.pc2")
    np.testing.assert_array_equal(read.frames, [2 * asset.mesh.in_own_order(pose) for pose in walk[1:]])
    assert read.first == first + 1

    meshes = ["convert", str(tmp_path / "board.drgs"), str(tmp_path / "m_##.glb"), "--vertices", str(tmp_path / name)]
    assert main([*meshes, "--frames", str(first)]) == 0
    np.save(tmp_path / "pose.npy", walk[0])
    same = tmp_path / "same" / f"m_{first:02}.glb"  # the name is in the file
    same.parent.mkdir()
    assert main([*meshes[:2], str(same), "--vertices", str(tmp_path / "pose.npy")]) == 0
    assert (tmp_path / same.name).read_bytes() == same.read_bytes()
    assert main(meshes) == 0 and len(list(tmp_path.glob("m_*.glb"))) == 3
    capsys.readouterr()
    for bad, problem in (
        ([*command, "--frames", "1-40"], "wants frame"),
        ([*command, "--frames", f"{first},{first + 2}"], "skips frames"),
        ([*command, "--up", "y"], "--up"),
        ([*meshes[:2], str(tmp_path / "one.glb"), *meshes[3:]], "Say which"),
        ([*command[:3], "--vertices", str(tmp_path / "pose.npy")], "is written of a point cache"),
        ([*command[:4], str(tmp_path / "none.pc2")], "does not exist"),
        ([*command[:2], str(tmp_path / "own_##.pc2"), *command[3:]], "has no number"),
    ):
        assert main(bad) == EXIT_USAGE
        assert problem in capsys.readouterr().err


def test_frame_numbers_that_an_mdd_cannot_keep_are_told(tmp_path, board, capsys) -> None:
    _, walk = board
    write_point_cache(tmp_path / "walk.pc2", iter(walk), 3, 16, 5, 25.0)
    command = ["convert", str(tmp_path / "board.drgs"), str(tmp_path / "own.mdd")]
    command += ["--vertices", str(tmp_path / "walk.pc2")]
    assert main(command) == 0
    assert read_point_cache(tmp_path / "own.mdd").first == 1
    printed = capsys.readouterr()
    assert "3 frames from 1 on" in printed.out and "MDD keeps no frame numbers; frame 5 of" in printed.err
    assert main([*command[:2], str(tmp_path / "own.pc2"), *command[3:]]) == 0
    assert "no frame numbers" not in capsys.readouterr().err


def test_poses_that_are_not_finite_are_told(tmp_path, board, capsys) -> None:
    """The rest of them is written: in a sequence one bad frame does not cost the others."""
    asset, walk = board
    walk[1, 3] = np.nan
    write_point_cache(tmp_path / "walk.pc2", iter(walk), 3, 16, 1, 25.0)
    command = ["convert", str(tmp_path / "board.drgs"), str(tmp_path / "own.pc2")]
    command += ["--vertices", str(tmp_path / "walk.pc2")]
    assert main(command) == 0
    assert "walk.pc2: 1 frames, the first 2, have vertices that are NaN" in capsys.readouterr().err
    np.testing.assert_array_equal(read_point_cache(tmp_path / "own.pc2").frames[2], asset.mesh.in_own_order(walk[2]))
    told = []
    for frame in ("1", "2"):
        splats = [*command[:2], str(tmp_path / "own.ply"), *command[3:], "--frames", frame]
        assert main(splats) == 0
        printed = capsys.readouterr()
        told.append("NaN or infinite; what hangs on them is left out" in printed.out + printed.err)
    assert told == [False, True]


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda data: data[:20], "truncated in its header"),
        (lambda data: data[:100], "is truncated: 3 frames are announced, 0 are there"),
        (lambda data: data[:24] + np.float32(2).tobytes() + data[28:], "a sample per 2 frames"),
        (lambda data: data[:28] + np.int32(-1).tobytes() + data[32:], "says that it has -1 frames"),
        (lambda data: b"x" * 100, "neither PC2 nor MDD"),
        (lambda data: data[:16] + np.int32(2**31 - 1).tobytes() + data[20:], "is truncated"),
    ],
)
def test_damaged_point_caches_are_named(tmp_path, board, damage, problem: str, capsys) -> None:
    _, walk = board
    path = tmp_path / "walk.pc2"
    write_point_cache(path, iter(walk), 3, 16, 5, 25.0)
    path.write_bytes(damage(path.read_bytes()))
    command = ["convert", str(tmp_path / "board.drgs"), str(tmp_path / "own.pc2"), "--vertices", str(path)]
    assert main(command) == EXIT_BAD_ASSET
    error = capsys.readouterr().err
    assert problem in error and "walk.pc2" in error
    assert not (tmp_path / "own.pc2").exists()


def test_pictures_of_a_point_cache(tmp_path, board) -> None:
    asset, walk = board
    write_point_cache(tmp_path / "walk.pc2", iter(walk), 3, 16, 5, 25.0)
    (tmp_path / "camera.json").write_text(
        json.dumps({"matrix_world": np.eye(4).tolist(), "width": 4, "height": 4, "fov_x": 30})
    )
    asset.environment = Environment(np.ones((4, 8, 3)))
    write_asset(tmp_path / "board.drgs", asset)
    command = ["relight", str(tmp_path / "board.drgs"), "--camera", str(tmp_path / "camera.json"), "--samples", "1"]
    command += ["--vertices", str(tmp_path / "walk.pc2")]
    assert main([*command, "--frames", "6-7", "--out", str(tmp_path / "f_##.png")]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["f_06.png", "f_07.png"]
    assert main([*command, "--out", str(tmp_path / "one.png")]) == EXIT_USAGE


@pytest.mark.parametrize("vertices", [np.full((3, 3), np.nan), 1e-9 * np.eye(3), 1e12 * np.eye(3)])
def test_sizes_are_checked_also_where_no_length_is_changed(vertices: np.ndarray) -> None:
    mesh = Mesh(vertices, [[0, 1, 2]], np.ones((3, 3)), np.ones(3), np.zeros(3))
    with pytest.raises(AssetError, match="board"):
        scale_mesh(mesh, 1.0, "board")
    assert mesh.source is None
