"""What leaves Blender as files of other programs, read by Blender's own importers, and what comes back."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Quaternion
from scenes import part, read_exr, write_exr

pytestmark = [pytest.mark.blender_api, pytest.mark.programs]


def imported(operator, path: Path) -> list:
    """What an importer of Blender adds to the scene."""
    before = set(bpy.data.objects)
    assert operator(filepath=str(path)) == {"FINISHED"}
    return [o for o in bpy.data.objects if o not in before]


def world_points(objects) -> np.ndarray:
    """Of meshes, and of the point clouds that Blender makes of splats from 5.3 on."""
    points = []
    for obj in objects:
        if obj.type in ("MESH", "POINTCLOUD"):
            positions = obj.data.attributes["position"].data
            points += [np.array(obj.matrix_world @ element.vector) for element in positions]
    return np.array(points)


def column(obj, name: str) -> np.ndarray:
    """One of splats, by its name in a PLY."""
    return part("addon.splat_attributes").read_splats(obj.data)[name]


def covariances(columns: dict[str, np.ndarray]) -> np.ndarray:
    """(n, 3, 3) of splats as a PLY describes them."""
    turns = np.array([Quaternion(q).to_matrix() for q in zip(*(columns[f"rot_{i}"].tolist() for i in range(4)))])
    axes = turns * np.exp(np.stack([columns[f"scale_{i}"] for i in range(3)], axis=1))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def centres(path: Path) -> np.ndarray:
    """Where the splats of an asset are."""
    return np.array(part("drgs_blender.core.asset.container").read_asset(path).surfels.centre)


def test_splats_stand_in_the_file_as_in_the_scene(ball, ball_file, scene, tmp_path, monkeypatch):
    """Blender's own PLY importer finds them, turned, moved and scaled, in the painted colour."""
    ball.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.5, 4, "X") @ Matrix.Scale(2, 4)
    count = len(ball.data.vertices)
    part("addon.mesh_arrays").write_channel(ball.data, "albedo", np.tile(np.float32((0.9, 0.2, 0.1)), (count, 1)))
    bpy.context.view_layer.update()
    out, temporary = tmp_path / "ball", tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    assert bpy.ops.drgs.export(filepath=str(out), format="3DGS PLY", colour="albedo", scale=10) == {"FINISHED"}
    (cloud,) = imported(bpy.ops.wm.ply_import, tmp_path / "ball.ply")
    matrix = np.array(ball.matrix_world)
    wanted = 10 * (centres(ball_file) @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(world_points([cloud]), wanted, atol=1e-4)
    red = 0.5 + 0.28209479 * column(cloud, "f_dc_0")
    np.testing.assert_allclose(red, 1.055 * 0.9 ** (1 / 2.4) - 0.055, atol=2e-3)
    assert not list(temporary.glob("drgs-export-*"))


@pytest.mark.parametrize(("name", "end"), [("glTF mesh", ".glb"), ("USD mesh", ".usdz")])
def test_the_mesh_opens_with_its_materials(ball, scene, tmp_path, name, end):
    ball.location, ball.rotation_euler = (1, -2, 3), (0.4, 0, 0.2)
    bpy.context.view_layer.update()
    assert bpy.ops.drgs.export(filepath=str(tmp_path / "ball.xyz"), format=name) == {"FINISHED"}
    path = tmp_path / f"ball.xyz{end}"
    found = imported(bpy.ops.import_scene.gltf if end == ".glb" else bpy.ops.wm.usd_import, path)
    points, wanted = world_points(found), world_points([ball])
    apart = np.abs(points[:, None] - wanted[None]).max(axis=2)
    assert apart.min(axis=1).max() < 1e-4 and apart.min(axis=0).max() < 1e-4
    (shape,) = [o for o in found if o.type == "MESH"]
    nodes = shape.data.materials[0].node_tree.nodes
    images = {n.image.size[0] for n in nodes if n.type == "TEX_IMAGE" and n.image}
    assert images and min(images) > 8 and any(n.type == "BSDF_PRINCIPLED" for n in nodes)


def test_splats_in_gltf_are_coloured_points_to_who_knows_no_splats(ball, ball_file, scene, tmp_path):
    """Blender's importer among them: upright, linear colours, opacity in the fourth number."""
    ball.location = (1, -2, 3)
    bpy.context.view_layer.update()
    out = tmp_path / "ball.glb"
    assert bpy.ops.drgs.export(filepath=str(out), format="glTF splats", colour="albedo") == {"FINISHED"}
    found = imported(bpy.ops.import_scene.gltf, out)
    wanted = part("drgs_blender.core.asset.container").read_asset(ball_file).surfels
    np.testing.assert_allclose(world_points(found), wanted.centre + np.float32((1, -2, 3)), atol=1e-5)
    if bpy.app.version < (5, 0):
        return  # the importer of 4.2 leaves out the colours of vertices without faces
    (obj,) = [o for o in found if o.type in ("MESH", "POINTCLOUD")]
    if obj.type == "POINTCLOUD":  # from 5.3 on they are Blender's own splats
        ply = tmp_path / "ball.ply"
        assert bpy.ops.drgs.export(filepath=str(ply), format="3DGS PLY", colour="albedo") == {"FINISHED"}
        attributes = part("addon.splat_attributes")
        shown, written = attributes.read_splats(obj.data), attributes.read_ply(ply)
        np.testing.assert_allclose(covariances(shown), covariances(written), atol=1e-6)
        for name in ("f_dc_0", "f_dc_1", "f_dc_2", "opacity"):
            np.testing.assert_allclose(shown[name], written[name], atol=1e-3)
        return
    points = obj.data
    colour = points.color_attributes["Color"]  # from 5.2 on the importer keeps what is of splats, too
    values = np.empty(4 * len(points.vertices), np.float32)
    colour.data.foreach_get("color", values)
    values = values.reshape(-1, 4)
    np.testing.assert_allclose(values[:, :3], wanted.albedo, atol=0.01)
    np.testing.assert_allclose(values[:, 3], wanted.opacity, atol=0.01)


def test_selected_objects_frame_by_frame_and_back(ball, ball_file, scene, tmp_path):
    other = ball.copy()
    scene.collection.objects.link(other)
    other.location.x = 50
    for number in (3, 5):
        ball.location.z = number
        ball.keyframe_insert("location", frame=number)
    scene.frame_set(1)
    for obj in scene.objects:
        obj.select_set(obj is ball)
    out = str(tmp_path / "walk.spz")
    frames = {"use_animation": True, "frame_start": 3, "frame_end": 5, "frame_step": 2}
    assert bpy.ops.drgs.export(filepath=out, format="SPZ", use_selection=True, **frames) == {"FINISHED"}
    assert sorted(p.name for p in tmp_path.glob("*.spz")) == ["walk_0003.spz", "walk_0005.spz"]
    assert scene.frame_current == 1
    pattern = str(tmp_path / "walk_####.spz")
    assert bpy.ops.drgs.import_parts(surfels=pattern, use_mesh=False) == {"FINISHED"}
    carrier = bpy.data.objects["walk"]
    parts = sorted(carrier.children, key=lambda o: o.name)
    assert [o.name for o in parts] == ["walk_0003", "walk_0005"]
    for number in (3, 5):
        found, rest = centres(tmp_path / f"walk_{number:04d}.drgs"), centres(ball_file)
        np.testing.assert_allclose(found, rest + np.float32([0, 0, number]), atol=2e-4)
    shown = []
    for number in (2, 3, 4, 5, 9):
        scene.frame_set(number)
        shown.append([not o.hide_render for o in parts])
    assert shown == [[True, False], [True, False], [True, False], [False, True], [False, True]]


def test_the_light_of_the_scene_is_in_the_colours(ball, scene, tmp_path):
    """Under a sun from above, in a black world, the upper half of the ball is bright and the lower one black."""
    scene.world = bpy.data.worlds.new("Black")
    scene.world.color = (0, 0, 0)
    if scene.world.node_tree:
        background = next(n for n in scene.world.node_tree.nodes if n.type == "BACKGROUND")
        background.inputs["Color"].default_value = (0, 0, 0, 1)
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy = 3
    scene.collection.objects.link(sun)
    scene.drgs.bounces = 0
    out = tmp_path / "lit.ply"
    assert bpy.ops.drgs.export(filepath=str(out), format="3DGS PLY", colour="relit", samples=32) == {"FINISHED"}
    (cloud,) = imported(bpy.ops.wm.ply_import, out)
    green = 0.5 + 0.28209479 * column(cloud, "f_dc_1")
    height = world_points([cloud])[:, 2]
    assert green[height > 0.5].min() > 0.3 and np.abs(green[height < -0.3]).max() < 0.01


def test_the_world_leaves_as_a_picture(scene, tmp_path):
    """Without any object: turned as the World is."""
    pixels = np.random.default_rng(1).uniform(0, 9, (8, 16, 3)).astype(np.float32)
    write_exr(tmp_path / "sky.exr", pixels)
    bpy.ops.drgs.choose_light(filepath=str(tmp_path / "sky.exr"), rotation=np.pi / 2, strength=2.0)
    assert bpy.ops.drgs.export(filepath=str(tmp_path / "out.exr"), format="OpenEXR") == {"FINISHED"}
    found = read_exr(tmp_path / "out.exr", 16, 8)[..., :3]
    np.testing.assert_allclose(found, 2 * np.roll(pixels, 4, axis=1), rtol=2e-3)


def test_the_dialogs_show_what_goes_with_the_format(ball, scene):
    from test_install import Layout

    shown = []

    class Noted(Layout):
        def prop(self, data, name, **more):
            assert name in bpy.ops.drgs.export.get_rna_type().properties
            shown.append(name)

        column = lambda self, **_: self  # noqa: E731

    operator = part("operators.export").DRGS_OT_export
    values = {"colour": "relit", "use_animation": True, "compress": True, "surfels": True}
    for format_, wanted, unwanted in (
        ("SPZ", {"samples", "scale", "use_selection", "frame_end", "spz_version"}, {"up"}),
        ("3DGS PLY", {"up", "colour", "materials"}, {"spz_version"}),
        ("glTF splats", {"materials", "compress", "spz_version"}, {"up"}),
        ("USD splats", {"materials", "kernel"}, {"compress", "spz_version"}),
        ("glTF mesh", {"scale"}, {"colour", "up"}),
        ("USD sequence", {"frame_end", "surfels", "kernel", "samples"}, {"use_animation", "up"}),
        ("Alembic sequence", {"frame_end", "scale"}, {"surfels", "kernel", "use_animation", "colour"}),
        ("OpenEXR", {"format"}, {"scale", "use_selection", "colour"}),
    ):
        shown.clear()
        stand_in = type("StandIn", (), {"layout": Noted(), "format": format_, **values})()
        operator.draw(stand_in, bpy.context)
        assert wanted <= set(shown) and not unwanted & set(shown)
        stand_in.filepath = "/tmp/a.ply"
        operator.check(stand_in, bpy.context)
        ends = part("drgs_blender.core.file_types").WRITTEN[format_].extensions
        assert Path(stand_in.filepath).suffix in ends


def test_what_cannot_be_exported_is_refused_in_words(ball, scene, tmp_path):
    ball.select_set(False)
    with pytest.raises(RuntimeError, match="no selected object is a DR-GS object"):
        bpy.ops.drgs.export(filepath=str(tmp_path / "a.ply"), use_selection=True)
    with pytest.raises(RuntimeError, match="frames 9 to 2 are none"):
        bpy.ops.drgs.export(filepath=str(tmp_path / "a.ply"), use_animation=True, frame_start=9, frame_end=2)
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(RuntimeError, match=r"folder\.ply"):
        bpy.ops.drgs.export(filepath=str(tmp_path / "folder.ply"))
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix == ".ply") == ["folder.ply"]


@pytest.mark.parametrize("text", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["binary", "text"])
def test_stl_that_blender_writes_becomes_an_object(scene, tmp_path, text):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, location=(1, 2, 3), rotation=(0.3, 0, 0.5))
    ball = bpy.context.active_object
    bpy.context.view_layer.update()
    path = tmp_path / "ball.stl"
    assert bpy.ops.wm.stl_export(filepath=str(path), ascii_format=text, export_selected_objects=True) == {"FINISHED"}
    assert bpy.ops.drgs.import_parts(filepath=str(path)) == {"FINISHED"}
    points, wanted = world_points([bpy.context.active_object]), world_points([ball])
    assert len(points) == len(wanted)  # the corners of triangles are joined again
    apart = np.abs(points[:, None] - wanted[None]).max(axis=2)
    assert apart.min(axis=1).max() < 1e-5 and apart.min(axis=0).max() < 1e-5


@pytest.mark.parametrize("name", ["a.fbx", "a.OBJ", "a.gltf", "a.hdr"])
def test_the_file_browser_keeps_a_foreign_ending_to_be_refused(scene, tmp_path, name):
    """It was made "a.abc.ply", and written without a word. Endings that are part of a name get that of the format."""
    export, stand_in = part("operators.export").DRGS_OT_export, SimpleNamespace(filepath=name, format="3DGS PLY")
    assert not export.check(stand_in, bpy.context) and stand_in.filepath == name
    stand_in.filepath = "chair.v2"
    assert export.check(stand_in, bpy.context) and stand_in.filepath == "chair.v2.ply"
    with pytest.raises(RuntimeError, match=r"cannot be written; understood: \.ply \.spz"):
        bpy.ops.drgs.export(filepath=str(tmp_path / name))


@pytest.mark.parametrize("version", ["3", "4"])
def test_spz_is_of_the_version_that_is_chosen(ball, scene, tmp_path, version):
    path = tmp_path / "a.spz"
    assert bpy.ops.drgs.export(filepath=str(path), format="SPZ", spz_version=version) == {"FINISHED"}
    assert path.read_bytes()[:2] == (b"NG" if version == "4" else b"\x1f\x8b")


@pytest.mark.parametrize("materials", [False, True])
def test_splats_have_materials_where_they_are_asked_for(ball, scene, tmp_path, materials):
    path = tmp_path / "a.ply"
    assert bpy.ops.drgs.export(filepath=str(path), format="3DGS PLY", materials=materials) == {"FINISHED"}
    assert (b"property float albedo_r" in path.read_bytes()) == materials


@pytest.mark.parametrize(("compress", "version"), [(False, "3"), (True, "auto"), (True, "3")])
def test_splats_in_gltf_are_packed_where_that_is_chosen(ball, scene, tmp_path, compress, version):
    path = tmp_path / "a.glb"
    chosen = {"format": "glTF splats", "compress": compress, "spz_version": version}
    assert bpy.ops.drgs.export(filepath=str(path), **chosen) == {"FINISHED"}
    assert (b"KHR_gaussian_splatting_compression_spz_2" in path.read_bytes()) == compress


def test_an_ending_of_another_format_is_told(ball, scene, tmp_path):
    assert bpy.ops.drgs.export(filepath=str(tmp_path / "a.spz"), format="3DGS PLY") == {"FINISHED"}
    assert [file.name for file in tmp_path.glob("a.*")] == ["a.ply"]
    said = [message.text for message in part("addon.messages").history if message.level == "WARNING"]
    assert "a.spz: its format is 3DGS PLY; written as a.ply" in said
