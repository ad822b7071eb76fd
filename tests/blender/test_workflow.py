"""The steps between import and picture."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix
from scenes import armature_object, part, select, write_exr

pytestmark = pytest.mark.blender_api


@pytest.fixture
def light(tmp_path) -> Path:
    """A lat-long image with one bright pixel at +X."""
    pixels = np.full((8, 16, 3), 0.1, np.float32)
    pixels[4, 8] = 30
    write_exr(tmp_path / "light.exr", pixels)
    return tmp_path / "light.exr"


def test_a_chosen_light_is_what_the_engine_gets(ball, light, export):
    assert bpy.ops.drgs.choose_light(filepath=str(light), rotation=0.7, strength=2.5) == {"FINISHED"}
    frame, warnings = export()
    assert not warnings and frame.world.environment.shape == (8, 16, 3)
    np.testing.assert_allclose(frame.world.environment.max(), 30, rtol=1e-3)
    np.testing.assert_allclose(frame.world.colour, 2.5)
    np.testing.assert_allclose(frame.world.rotation, np.array(Matrix.Rotation(0.7, 3, "Z")), atol=1e-6)


def test_another_light_keeps_the_nodes_and_their_keyframes(ball, light, tmp_path, scene, export):
    bpy.ops.drgs.choose_light(filepath=str(light))
    world = scene.world
    texture, mapping, _ = part("addon.world_setup").nodes_of(world)
    for number, angle in ((1, 0.0), (11, 1.0)):
        mapping.inputs["Rotation"].default_value[2] = angle
        mapping.inputs["Rotation"].keyframe_insert("default_value", index=2, frame=number)
    mapping.inputs["Rotation"].default_value[2] = 0.3
    count = len(world.node_tree.nodes)
    write_exr(tmp_path / "other.exr", np.ones((4, 8, 3), np.float32))
    bpy.ops.drgs.choose_light(filepath=str(tmp_path / "other.exr"))
    assert scene.world == world and len(world.node_tree.nodes) == count and texture.image.name == "other.exr"
    assert mapping.inputs["Rotation"].default_value[2] == pytest.approx(0.3)
    scene.frame_set(11)
    frame, _ = export()
    np.testing.assert_allclose(frame.world.rotation, np.array(Matrix.Rotation(1.0, 3, "Z")), atol=1e-6)


def test_a_light_that_is_no_image_is_refused_and_the_world_stays(ball, scene, tmp_path):
    (tmp_path / "broken.hdr").write_bytes(b"not an image")
    before = scene.world
    for name in ("broken.hdr", "absent.hdr"):
        with pytest.raises(RuntimeError, match=name):
            bpy.ops.drgs.choose_light(filepath=str(tmp_path / name))
    assert scene.world == before and "broken.hdr" not in bpy.data.images


def test_pose_goes_to_what_bends_the_object(ball, scene):
    with pytest.raises(RuntimeError, match=r'"ball" *: follows no armature'):
        bpy.ops.drgs.pose()
    rig = armature_object({"Bone": ((0, 0, -1), (0, 0, 1))})
    select(rig, ball)
    bpy.ops.drgs.bind_to_armature()
    select(ball)
    assert bpy.ops.drgs.pose() == {"FINISHED"}
    assert bpy.context.mode == "POSE" and bpy.context.active_object == rig
    bpy.ops.object.mode_set(mode="OBJECT")


def test_what_was_just_bound_is_posed_at_the_next_click(ball, scene):
    """Binding leaves the lattice selected, which is what will be moved; of several the one that is selected."""
    bpy.ops.drgs.bind_to_lattice()
    first = bpy.context.active_object
    other = ball.copy()
    other.modifiers.clear()
    scene.collection.objects.link(other)
    select(other)
    bpy.ops.drgs.bind_to_lattice()
    second = bpy.context.active_object
    for lattice in (first, second):
        select(lattice)
        assert bpy.ops.drgs.pose() == {"FINISHED"}
        assert bpy.context.mode == "EDIT_LATTICE" and bpy.context.active_object == lattice
        bpy.ops.object.mode_set(mode="OBJECT")


def test_a_new_camera_sees_the_whole_object(ball, scene):
    ball.location, ball.scale = (3, 2, 1), (0.2, 0.2, 0.2)
    bpy.data.objects.remove(scene.camera)
    assert bpy.ops.drgs.add_camera() == {"FINISHED"}
    bpy.context.view_layer.update()
    from bpy_extras.object_utils import world_to_camera_view

    seen = np.array([world_to_camera_view(scene, scene.camera, ball.matrix_world @ v.co) for v in ball.data.vertices])
    assert (seen[:, :2] > 0).all() and (seen[:, :2] < 1).all() and (seen[:, 2] > 0).all()
    assert np.ptp(seen[:, :2], axis=0).max() > 0.6


@pytest.mark.parametrize("perspective", ["ORTHO", "PERSP"])
def test_a_new_camera_stands_before_what_the_viewport_looks_at(perspective):
    """The view matrices are those that Blender has, from the front at (1, 2, 3), seven metres away."""
    turned = Euler((np.pi / 2, 0, 0)).to_matrix().to_4x4()
    distance = 7.0 if perspective == "PERSP" else 0.0
    matrix = (Matrix.Translation((1, 2, 3)) @ turned @ Matrix.Translation((0, 0, distance))).inverted()
    view = SimpleNamespace(view_matrix=matrix, view_distance=7.0, view_perspective=perspective)
    assert np.allclose(part("operators.workflow").viewpoint(view).translation, (1, -5, 3), atol=1e-4)


def test_show_rendered_makes_drgs_the_engine(ball, scene):
    scene.render.engine = "CYCLES"
    assert bpy.ops.drgs.show_rendered() == {"FINISHED"}
    assert scene.render.engine == "DRGS"


def test_marked_objects_are_assets_that_survive_saving(ball, tmp_path):
    assert bpy.ops.drgs.mark_assets() == {"FINISHED"}
    saved = str(tmp_path / "library.blend")
    bpy.ops.wm.save_as_mainfile(filepath=saved, copy=True)
    with bpy.data.libraries.load(saved, assets_only=True) as (source, _):
        assert source.objects == ["ball"]
    assert [t.name for t in ball.asset_data.tags] == ["DR-GS"]
    ball.asset_data.description = "Mine"
    bpy.ops.drgs.mark_assets()
    assert ball.asset_data.description == "Mine" and len(ball.asset_data.tags) == 1


def expected() -> str:
    """Key of the step that comes next."""
    workflow = part("addon.workflow")
    return workflow.next_step(workflow.steps(bpy.context)).key


def test_the_tour_says_what_comes_next_from_nothing_to_the_picture(scene, ball_file, light, monkeypatch):
    scene.render.engine, scene.camera = "CYCLES", None
    with monkeypatch.context() as without_engine:
        without_engine.setenv("DRGS_ENGINE", "/nowhere")
        assert expected() == "engine"
    assert expected() == "import"
    bpy.ops.import_scene.drgs(filepath=str(ball_file))
    assert expected() == "light"
    bpy.ops.drgs.choose_light(filepath=str(light))
    assert expected() == "view"
    bpy.ops.drgs.show_rendered()
    assert expected() == "render"
    bpy.ops.drgs.add_camera()
    assert expected() == "bind"
    ball = bpy.context.view_layer.objects["ball"]
    select(ball)
    bpy.ops.drgs.bind_to_lattice()
    select(ball)
    assert expected() == "pose"
    bpy.ops.drgs.pose()
    assert bpy.context.mode == "EDIT_LATTICE"
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.active_object.keyframe_insert("location", frame=1)
    assert expected() in ("view", "render")


@pytest.mark.parametrize("name", ["draft", "good", "final"])
def test_presets_set_what_they_say_and_are_refused_elsewhere(scene, name, tmp_path):
    presets = part("addon.presets")
    path = next(f for p in bpy.utils.preset_paths(presets.FOLDER) for f in Path(p).iterdir() if f.stem == name)
    scene.drgs.samples, scene.drgs.bounces = 7, 0
    assert bpy.ops.drgs.render_preset(filepath=str(path), menu_idname="DRGS_PT_presets") == {"FINISHED"}
    assert scene.drgs.samples in (16, 64, 1024) and scene.drgs.bounces > 0 and not scene.drgs.use_strategy_samples
    assert all(f"settings.{value} = " in path.read_text() for value in presets.VALUES if not value.endswith("_samples"))
    assert (scene.drgs.filter_glossy, scene.drgs.clamp_indirect) == ((0, 0) if name == "final" else (1, 10))
    stray = tmp_path / f"{name}.py"
    stray.write_bytes(path.read_bytes())
    with pytest.raises(RuntimeError, match="is no render preset"):
        bpy.ops.drgs.render_preset(filepath=str(stray))


def test_own_settings_are_kept_as_a_preset(scene):
    presets = part("addon.presets")
    scene.drgs.use_strategy_samples, scene.drgs.samples, scene.drgs.clamp_indirect = False, 123, 4.5
    bpy.ops.drgs.render_preset_add(name="My Look")
    scene.drgs.samples, scene.drgs.clamp_indirect = 5, 0
    path = next(f for p in bpy.utils.preset_paths(presets.FOLDER) for f in Path(p).iterdir() if f.stem == "My_Look")
    bpy.ops.drgs.render_preset(filepath=str(path))
    assert scene.drgs.samples == 123 and scene.drgs.clamp_indirect == 4.5
    text = path.read_text()  # as a version would have kept it that did not know one of the settings
    path.write_text("".join(line for line in text.splitlines(True) if "filter_glossy" not in line))
    scene.drgs.samples, scene.drgs.filter_glossy = 5, 1
    bpy.ops.drgs.render_preset(filepath=str(path))
    assert scene.drgs.samples == 123 and scene.drgs.filter_glossy == 0
    path.unlink()


def test_settings_follow_keyframes_and_drivers(ball, scene, export):
    scene.drgs.use_strategy_samples = False
    for number, samples in ((1, 8), (11, 108)):
        scene.drgs.samples = samples
        scene.drgs.keyframe_insert("samples", frame=number)
    driver = scene.driver_add("drgs.clamp_indirect").driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id_type, variable.targets[0].id = "z", "OBJECT", ball
    variable.targets[0].data_path, driver.expression = "location.z", "z"
    ball.location.z = 3
    seen = []
    for number in (1, 6, 11):
        scene.frame_set(number)
        settings = export()[0].settings
        seen.append(settings.sample_count)
        assert settings.clamp_indirect == pytest.approx(3)
    assert seen[0] == 8 and seen[2] == 108 and 8 < seen[1] < 108


def test_dropped_files_go_where_they_belong(tmp_path):
    kind_of = part("operators.import_parts").kind_of
    ply = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n{}end_header\n"
    (tmp_path / "splats.ply").write_text(ply.format("property float x\nproperty float opacity\n"))
    (tmp_path / "scan.ply").write_text(ply.format("property float x\n") + " opacity\n")
    kinds = {
        "splats.ply": "surfels",
        "scan.ply": "mesh",
        "a.glb": "mesh",
        "cloud.glb": "surfels",
        "cloud.gltf": "surfels",
        "sky.exr": "environment",
    }
    (tmp_path / "a.glb").write_bytes(b'glTF{"asset":{}}')
    for name in ("cloud.glb", "cloud.gltf"):
        (tmp_path / name).write_bytes(b'glTF{"extensionsUsed":["KHR_gaussian_splatting"]}')
    filetypes = part("drgs_blender.core.file_types")
    for end in filetypes.extensions("surfels"):  # what only splats have
        if end not in filetypes.extensions("mesh"):
            kinds[f"b{end}"] = "surfels"
    assert {name: kind_of(tmp_path / name) for name in kinds} == kinds


def test_every_kind_of_file_can_be_dropped(scene):
    handlers = [c for m in part("operators").MODULES for c in m.CLASSES if issubclass(c, bpy.types.FileHandler)]
    caught = {end for handler in handlers for end in handler.bl_file_extensions.split(";")}
    wanted = set(part("drgs_blender.core.file_types").extensions("surfels", "mesh")) - {".json"}
    assert wanted | {".drgs", ".hdr", ".exr"} == caught
    for handler in handlers:
        assert not handler.poll_drop(bpy.context)  # there is no window here


def test_dropped_splats_become_an_object(scene, tmp_path):
    from test_import import few_splats

    path = few_splats(tmp_path / "toy.ply")
    assert bpy.ops.drgs.import_parts(filepath=str(path), up="y") == {"FINISHED"}
    assert bpy.context.active_object.name == "toy"


def test_what_goes_on_beside_the_window_cannot_be_adjusted_or_repeated():
    """Blender runs it anew with an operator that it frees meanwhile, and crashes."""
    classes = [c for m in part("operators").MODULES for c in m.CLASSES if hasattr(c, "modal")]
    assert len(classes) > 5
    assert not [c.bl_idname for c in classes if "REGISTER" in getattr(c, "bl_options", {"REGISTER"})]


def test_every_operator_that_changes_the_scene_can_be_undone():
    engine = {"drgs.engine_test", "drgs.engine_stop", "drgs.engine_setup", "drgs.engine_setup_cancel"}
    engine |= {"drgs.engine_choose", "drgs.clear_messages", "drgs.render_preset_add"}
    engine |= {"drgs.copy_messages", "drgs.report"}
    engine |= {"drgs.submit", "drgs.submit_cancel", "drgs.copy_submit", "drgs.print_markers"}  # files and the clipboard
    engine |= {"drgs.show_particles", "drgs.hide_particles", "drgs.cancel_physics"}  # nothing that a file keeps
    engine |= {"drgs.reconstruct_cancel", "drgs.bakes_cancel", "drgs.cancel_command", "drgs.show_sidebar"}
    classes = [c for m in part("operators").MODULES for c in m.CLASSES if issubclass(c, bpy.types.Operator)]
    assert {c.bl_idname for c in classes if "UNDO" not in getattr(c, "bl_options", ())} == engine
    for cls in classes:
        group, name = cls.bl_idname.split(".")
        known = getattr(getattr(bpy.ops, group), name).get_rna_type().properties
        hidden = [p for p in known if p.identifier != "rna_type" and not p.is_hidden and not p.description]
        assert cls.__doc__ and not [p.identifier for p in hidden if p.identifier not in INHERITED], cls


#: Properties whose description is Blender's own business.
INHERITED = {"filepath", "name", "remove_name", "remove_active"}


@pytest.mark.parametrize("loaded", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_every_operator_answers_without_what_it_needs(scene, ball_file, loaded):
    """With no object, or one that is not selected: refused in words, never by a failure of the program."""
    if loaded:
        bpy.ops.import_scene.drgs(filepath=str(ball_file))
        bpy.context.active_object.select_set(False)
        bpy.context.view_layer.objects.active = None
    for module in part("operators").MODULES:
        for cls in module.CLASSES:
            if not issubclass(cls, bpy.types.Operator) or cls.bl_idname == "drgs.engine_setup":
                continue
            group, name = cls.bl_idname.split(".")
            try:
                assert getattr(getattr(bpy.ops, group), name)() <= {"FINISHED", "CANCELLED"}
            except RuntimeError as refused:
                assert "Traceback" not in str(refused), cls
