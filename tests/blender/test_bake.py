"""Bake Light: through Blender's evaluation and the program, back to attributes and images."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import new_world, part, read_exr, select, write_ball

pytestmark = pytest.mark.blender_api


@pytest.fixture
def lit(ball, scene):
    """The ball, white and rough, under a world whose strength grows with the frames."""
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    for number in (1, 2):
        background.inputs["Strength"].default_value = number
        background.inputs["Strength"].keyframe_insert("default_value", frame=number)
    for name, value in (("albedo", (0.5, 0.25, 0.1, 1)), ("roughness", 1.0), ("metallic", 0.0)):
        values = np.tile(np.float32(value), (len(ball.data.vertices), 1)).ravel()
        ball.data.attributes[name].data.foreach_set("color" if name == "albedo" else "value", values)
    ball.data.update_tag()
    scene.drgs.shading_model, scene.drgs.bounces = "paper", 0
    scene.frame_start, scene.frame_end = 1, 2
    scene.frame_set(1)
    return ball


def colours(obj, name: str) -> np.ndarray:
    values = np.empty(4 * len(obj.data.vertices), np.float32)
    obj.data.attributes[name].data.foreach_get("color", values)
    return values.reshape(-1, 4)


def test_what_is_said_names_no_file_that_goes_with_the_work(lit, capfd):
    assert bpy.ops.drgs.bake_light(samples=3) == {"FINISHED"}
    said = capfd.readouterr().out
    assert "\n86 vertices of " in f"\n{said}" and "Baked the light of 1 frame on 1 object\n" in said
    assert "drgs-bake-" not in said and ".npy" not in said


@pytest.mark.slow
def test_a_frame_and_an_animation_go_to_attributes_of_all_objects(lit, scene, tmp_path):
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    second = bpy.context.active_object
    second.location.x = 50
    select(second, lit)
    assert bpy.ops.drgs.bake_light(light="diffuse", samples=1024) == {"FINISHED"}
    np.testing.assert_allclose(colours(lit, "relit"), np.tile([0.5, 0.25, 0.1, 1], (86, 1)), rtol=0.03)
    assert np.ptp(colours(second, "relit")[:, 0]) > 0.2  # its colours vary over the mesh
    select(lit)
    assert bpy.ops.drgs.bake_light(light="diffuse", samples=1024, use_animation=True) == {"FINISHED"}
    for number in (1, 2):
        np.testing.assert_allclose(colours(lit, f"relit.{number:04}")[:, 0], 0.5 * number, rtol=0.03)
    assert scene.frame_current == 1 and "relit.0001" not in second.data.attributes


def test_images_are_written_by_the_uv_map(lit, scene, tmp_path):
    with pytest.raises(RuntimeError, match="has no UV map"):
        bpy.ops.drgs.bake_light(target="IMAGE", directory=str(tmp_path))
    with_uvs(lit)
    options = {"target": "IMAGE", "directory": str(tmp_path), "size": 32, "samples": 32, "light": "diffuse"}
    assert bpy.ops.drgs.bake_light(**options, use_animation=True) == {"FINISHED"}
    first, second = (read_exr(tmp_path / f"ball_{number:04}.exr", 32, 32)[8:24, 8:24] for number in (1, 2))
    # Smooth normals of coarse faces lose what lies below the face itself, in the renderer as well: at most a tenth.
    assert 0.45 < first[..., 0].mean() < 0.5 and (first[..., 3] == 1).all()
    np.testing.assert_allclose(first[..., 1:3], first[..., :1] * [0.5, 0.2], rtol=1e-3)
    np.testing.assert_allclose(second[..., :3].mean(), 2 * first[..., :3].mean(), rtol=0.02)
    image = bpy.data.images["ball_0001.exr"]
    assert image.source == "SEQUENCE"


def with_uvs(obj):
    layer = obj.data.uv_layers.new(name="Box")
    corners = np.array([v.co[:2] for v in obj.data.vertices])[[loop.vertex_index for loop in obj.data.loops]]
    layer.uv.foreach_set("vector", (corners / 2 + 0.5).astype(np.float32).ravel())


@pytest.mark.slow
def test_an_image_shows_what_was_baked_last(lit, scene, tmp_path):
    """Whatever it was before: other pixels, another size, another colour space, packed."""
    with_uvs(lit)
    options = {"target": "IMAGE", "directory": str(tmp_path), "samples": 8, "light": "diffuse"}
    bpy.ops.drgs.bake_light(**options, size=32)
    image = bpy.data.images["ball_0001.exr"]
    dark = np.array(image.pixels).reshape(32, 32, 4)[8:24, 8:24].mean(axis=(0, 1))
    image.pack()
    image.colorspace_settings.name = "Non-Color"
    scene.frame_set(2)
    tmp_path.joinpath("ball_0001.exr").rename(tmp_path / "ball_0002.exr")
    image.filepath = str(tmp_path / "ball_0002.exr")
    bpy.ops.drgs.bake_light(**options, size=64)
    assert [i.name for i in bpy.data.images if "ball" in i.name] == [image.name] and tuple(image.size) == (64, 64)
    assert image.colorspace_settings.name == "Linear Rec.709" and image.packed_file is None
    bright = np.array(image.pixels).reshape(64, 64, 4)[16:48, 16:48].mean(axis=(0, 1))
    np.testing.assert_allclose(bright[:3], 2 * dark[:3], rtol=0.1)


def test_one_object_does_not_get_the_light_of_another(lit, scene, tmp_path):
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    second = bpy.context.active_object
    lit.name, second.name = "A ball", "a_ball"
    select(lit, second)
    with pytest.raises(RuntimeError, match='"A ball" and "a_ball": would be baked to the same files') as told:
        bpy.ops.drgs.bake_light(target="IMAGE", directory=str(tmp_path))
    assert "Rename one" in str(told.value)
    twin = second.copy()
    scene.collection.objects.link(twin)
    select(twin, second)
    with pytest.raises(RuntimeError, match="share the mesh"):
        bpy.ops.drgs.bake_light()
    lit.name, second.name = "Tür", "Tör"
    with_uvs(lit)
    with_uvs(second)
    select(lit, second)
    bpy.ops.drgs.bake_light(target="IMAGE", directory=str(tmp_path), size=16, samples=3)
    assert sorted(path.name for path in tmp_path.glob("*.exr")) == ["Tör_0001.exr", "Tür_0001.exr"]


def test_nothing_is_baked_over_a_material_or_of_what_is_not_rendered(lit):
    for name in ("", "albedo"):
        with pytest.raises(RuntimeError, match="Choose another"):
            bpy.ops.drgs.bake_light(name=name)
    too_long = ("n" * 68,) if bpy.app.version < (5, 2) else ()  # for Blender's attributes
    for name in ("position", "sharp_face", ".hidden", *too_long):
        with pytest.raises(RuntimeError, match=f'"{name}" is none for baked light'):
            bpy.ops.drgs.bake_light(name=name)
    with_uvs(lit)
    lit.vertex_groups.new(name="Group")
    for name in ("Box", "Group"):
        with pytest.raises(RuntimeError, match=f'"ball": has "{name}" already'):
            bpy.ops.drgs.bake_light(name=name)
    assert len(lit.data.uv_layers) == 1
    lit.visible_camera = lit.visible_diffuse = lit.visible_glossy = lit.visible_shadow = False
    with pytest.raises(RuntimeError, match="is not rendered"):
        bpy.ops.drgs.bake_light()
    assert "relit" not in lit.data.attributes


@pytest.mark.slow
def test_a_mesh_that_is_edited_during_a_bake_is_told(lit, monkeypatch):
    program = part("operators.engine_command").CommandOperator
    finish = program._finish

    def edited(self, context):
        bpy.ops.object.mode_set(mode="EDIT")
        if count < len(lit.data.vertices):
            bpy.ops.mesh.delete(type="FACE")
        return finish(self, context)

    monkeypatch.setattr(program, "_finish", edited)
    count = len(lit.data.vertices)
    assert bpy.ops.drgs.bake_light(samples=3) == {"FINISHED"} and "relit" in lit.data.attributes
    count, messages = 0, part("addon.messages")
    bpy.ops.drgs.bake_light(samples=3, name="second")
    assert 'Object "ball" has other vertices' in messages.history[-1].text and "second" not in lit.data.attributes


def test_a_cut_object_is_baked_by_what_is_left_of_its_uv_map(lit, scene, tmp_path):
    """Half of it deleted, triangles merged to quads, a hole filled: texels show the place that they are of."""
    import bmesh

    with_uvs(lit)
    albedo = np.ones((len(lit.data.vertices), 4), np.float32)
    albedo[:, :2] = [[0.5 + 0.4 * v.co.x, 0.5 + 0.4 * v.co.y] for v in lit.data.vertices]
    lit.data.attributes["albedo"].data.foreach_set("color", albedo.ravel())
    mesh = bmesh.new()
    mesh.from_mesh(lit.data)
    bmesh.ops.delete(mesh, geom=[v for v in mesh.verts if v.co.z < -0.1], context="VERTS")
    bmesh.ops.join_triangles(mesh, faces=mesh.faces[:], angle_face_threshold=3, angle_shape_threshold=3)
    rim = [edge for edge in mesh.edges if edge.is_boundary]
    middle = mesh.verts.new((0, 0, -0.5))
    for edge in rim:
        mesh.faces.new((*edge.verts, middle))
    mesh.to_mesh(lit.data)
    mesh.free()
    assert max(len(p.vertices) for p in lit.data.polygons) == 4
    options = {"target": "IMAGE", "directory": str(tmp_path), "size": 32, "samples": 64, "light": "diffuse"}
    assert bpy.ops.drgs.bake_light(**options) == {"FINISHED"}
    image = read_exr(tmp_path / "ball_0001.exr", 32, 32)[8:24, 8:24]
    place = (np.arange(8, 24) + 0.5) / 16 - 1
    assert (image[..., 3] == 1).all()
    np.testing.assert_allclose(image[..., 0] / image[..., 2], (0.5 + 0.4 * place)[None] * np.ones((16, 1)), atol=0.03)
    np.testing.assert_allclose(image[..., 1] / image[..., 2], (0.5 - 0.4 * place)[:, None] * np.ones(16), atol=0.03)
    new = len(lit.data.vertices) - 1  # of vertices, the one in the middle has no light
    of_asset = np.arange(1, 3 * new + 1, dtype=np.float32).reshape(-1, 3)
    found = part("operators.bake").of_all(lit, of_asset)
    assert (found[new] == 0).all() and (found[:new] == of_asset).all()
    assert part("operators.bake").of_all(lit, of_asset[1:]) is None
