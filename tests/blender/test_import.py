"""Assets become objects that Blender's own tools understand."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from scenes import ROOT, asset_of, part, read_exr, select, sphere, write_ball

pytestmark = pytest.mark.blender_api


def channel(mesh, name):
    return part("addon.mesh_arrays").read_channel(mesh, name)


def test_mesh_is_the_assets_in_order_with_its_materials(ball, ball_file):
    asset = part("drgs_blender.core.asset.container").read_asset(ball_file)
    arrays = part("addon.mesh_arrays")
    np.testing.assert_array_equal(arrays.read_vertices(ball.data), asset.mesh.vertices)
    np.testing.assert_array_equal(arrays.read_triangles(ball.data), asset.mesh.faces)
    for name in ("albedo", "roughness", "metallic"):
        np.testing.assert_array_equal(channel(ball.data, name), getattr(asset.mesh, name))
    assert ball.data.normals_domain == "POINT"
    assert ball.drgs.is_drgs and not ball.data.validate()


def test_path_is_relative_and_known_to_blenders_path_tools(ball, ball_file, tmp_path):
    assert ball.drgs.path == "//" + os.path.join("assets", "ball.drgs")
    assert ball.drgs.path in bpy.utils.blend_paths() or str(ball_file) in bpy.utils.blend_paths(absolute=True)
    bpy.ops.file.make_paths_absolute()
    assert Path(ball.drgs.path) == ball_file
    bpy.ops.file.make_paths_relative()
    assert ball.drgs.path.startswith("//")
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    shutil.move(ball_file, moved / "ball.drgs")
    with pytest.raises(part("drgs_blender.core.errors").AssetError, match=r'"ball".*Find Missing Files'):
        part("addon.assets").file_of(ball)
    bpy.ops.file.find_missing_files(directory=str(moved))
    assert part("addon.assets").file_of(ball) == moved / "ball.drgs"


def test_asset_without_a_mesh_is_rendered_by_its_surfels(scene, tmp_path):
    """The object has no vertices; it moves with its matrix."""
    model, path = part("drgs_blender.core.asset"), tmp_path / "leaves.drgs"
    part("drgs_blender.core.asset.container").write_asset(
        path, model.Asset(asset_of(*sphere()).surfels, model.Mesh.empty())
    )
    bpy.ops.import_scene.drgs(filepath=str(path))
    leaves = bpy.context.active_object
    assert leaves.drgs.is_drgs and not len(leaves.data.vertices)
    leaves.location.x = 1.0
    scene.drgs.rays_see, scene.render.film_transparent = "surfels", True
    bpy.ops.render.render(write_still=True)
    alpha = read_exr(scene.render.filepath, 64, 48)[..., 3]
    assert alpha[24, 46] > 0.9 and not alpha[:, :20].any()


def test_packed_asset_renders_without_its_file(ball, ball_file, export, tmp_path):
    expected = ball_file.read_bytes()
    bpy.ops.file.pack_all()
    ball_file.unlink()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "packed.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "packed.blend"))
    path = part("addon.assets").file_of(bpy.data.objects["ball"])
    assert path.read_bytes() == expected
    frame, _ = export()
    assert frame.objects[0].asset == str(path)


def test_anchor_survives_saving_duplicating_and_appending(ball, tmp_path):
    copy = ball.copy()
    bpy.context.collection.objects.link(copy)
    assert copy.drgs.asset == ball.drgs.asset
    saved = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(saved) as (_, target):
        target.objects = ["ball"]
    assert Path(bpy.path.abspath(target.objects[0].drgs.path)) == tmp_path / "assets" / "ball.drgs"


@pytest.mark.parametrize("kind", ["append", "link", "pack"])
def test_the_asset_browser_brings_the_file_along(ball, ball_file, export, tmp_path, kind):
    """As it is dragged from there, in a file that is saved elsewhere and opened again."""
    if kind == "pack" and bpy.app.version < (5, 0, 0):
        pytest.skip("linked data is packed from Blender 5.0 on")
    bpy.ops.drgs.mark_assets()
    library, shot = tmp_path / "library" / "ball.blend", tmp_path / "shots" / "one" / "shot.blend"
    for path in (library, shot):
        path.parent.mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    options = {"link": kind != "append"} | ({"pack": True} if kind == "pack" else {})
    with bpy.data.libraries.load(str(library), assets_only=True, **options) as (source, target):
        target.objects = source.objects
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    for obj in (*target.objects, camera):
        bpy.context.scene.collection.objects.link(obj)
    bpy.context.scene.camera = camera
    for _ in range(2):
        frame, warnings = export()
        assert Path(frame.objects[0].asset).resolve() == ball_file.resolve() and not warnings
        bpy.ops.wm.save_as_mainfile(filepath=str(shot))
        bpy.ops.wm.open_mainfile(filepath=str(shot))


def test_several_files_share_one_anchor_each(scene, tmp_path):
    names = [write_ball(tmp_path / f"{n}.drgs").name for n in ("one", "two")]
    files = [{"name": n} for n in names]
    for _ in range(2):
        bpy.ops.import_scene.drgs(directory=str(tmp_path), files=files)
    assert len(bpy.data.volumes) == 2 and sum(o.type == "MESH" for o in scene.objects) == 4
    assert len(bpy.data.materials) == 1


def test_environment_becomes_a_world_that_gives_the_same_light(scene, tmp_path, export):
    light = np.random.default_rng(1).uniform(0, 40, (8, 16, 3)).astype(np.float32)
    path = write_ball(tmp_path / "lit.drgs", light)
    bpy.ops.import_scene.drgs(filepath=str(path), use_environment=True)
    frame, warnings = export()
    np.testing.assert_allclose(frame.world.environment, light, rtol=1e-6)
    assert not warnings
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    frame, _ = export()
    np.testing.assert_allclose(frame.world.environment, light, rtol=1e-3)  # packed as half floats


def test_damaged_file_is_refused_with_its_name_and_adds_nothing(scene, ball_file):
    data = bytearray(ball_file.read_bytes())
    data[len(data) // 2] ^= 255
    ball_file.write_bytes(data)
    before = len(bpy.data.objects)
    with pytest.raises(RuntimeError, match=r"ball\.drgs"):
        bpy.ops.import_scene.drgs(filepath=str(ball_file))
    assert len(bpy.data.objects) == before
    assert part("addon.messages").history[-1].level == "ERROR"


def test_viewport_material_shows_the_albedo_attribute_in_cycles(ball, scene):
    """A white furnace through Cycles: of a rough non-metal the picture's colour follows the attribute."""
    count = len(sphere()[0])
    arrays = part("addon.mesh_arrays")
    arrays.write_channel(ball.data, "albedo", np.tile(np.float32((0.8, 0.1, 0.1)), (count, 1)))
    arrays.write_channel(ball.data, "roughness", np.ones(count, np.float32))
    arrays.write_channel(ball.data, "metallic", np.zeros(count, np.float32))
    world = bpy.data.worlds.new("White")
    world.color = (1, 1, 1)
    if world.node_tree:
        next(n for n in world.node_tree.nodes if n.type == "BACKGROUND").inputs["Color"].default_value = (1, 1, 1, 1)
    scene.world = world
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.render.resolution_x = scene.render.resolution_y = 16
    bpy.ops.render.render(write_still=True)
    centre = read_exr(scene.render.filepath, 16, 16)[7:9, 7:9].mean((0, 1))
    assert 0.6 < centre[0] < 0.95 and centre[1] < 0.25 and abs(centre[1] - centre[2]) < 0.03


def few_splats(path: Path, count: int = 400) -> Path:
    """The first splats of a captured toy."""
    header, body = (ROOT / "examples" / "playbot" / "playbot.ply").read_bytes().split(b"end_header\n", 1)
    total = int(next(line for line in header.split(b"\n") if line.startswith(b"element vertex")).split()[-1])
    row = len(body) // total
    header = header.replace(b"element vertex %d" % total, b"element vertex %d" % count)
    path.write_bytes(header + b"end_header\n" + body[: row * count])
    return path


def test_surfels_become_an_asset_and_an_object(scene, tmp_path):
    splats = few_splats(tmp_path / "toy.ply")
    assert bpy.ops.drgs.import_parts(surfels=str(splats), up="y") == {"FINISHED"}
    obj = bpy.context.active_object
    assert obj.name == "toy" and obj.drgs.path == "//toy.drgs"
    assert len(part("addon.assets").load(tmp_path / "toy.drgs").surfels) == 400
    before = (tmp_path / "toy.drgs").read_bytes()
    with pytest.raises(RuntimeError, match=r'"toy": is made of .*would be lost'):
        bpy.ops.drgs.import_parts(surfels=str(splats), up="z", out=str(tmp_path / "toy.drgs"))
    assert (tmp_path / "toy.drgs").read_bytes() == before


@pytest.mark.slow
def test_colour_is_estimated_without_an_environment(scene, tmp_path):
    """The light that was found is the asset's, and lights the scene; the panel tells what stays open."""
    splats = few_splats(tmp_path / "toy.ply", 3000)
    made = {"surfels": str(splats), "up": "y", "use_remove_light": True, "use_environment": True}
    assert bpy.ops.drgs.import_parts(**made) == {"FINISHED"}
    asset = part("addon.assets").load(tmp_path / "toy.drgs")
    assert asset.environment is not None and asset.provenance["materials"].startswith("estimated")
    assert scene.world is not None and any(n.type == "TEX_ENVIRONMENT" for n in scene.world.node_tree.nodes)
    assert any("the light is estimated" in m.text for m in part("addon.messages").history)


def test_the_browser_of_import_takes_all_kinds_of_files(scene, tmp_path):
    """Assets as they are, and one that is made of the rest."""
    write_ball(tmp_path / "ball.drgs")
    few_splats(tmp_path / "toy.ply")
    files = [{"name": name} for name in ("ball.drgs", "toy.ply")]
    chosen = {"browse": True, "directory": str(tmp_path), "up": "y"}
    assert bpy.ops.drgs.import_parts(files=files, **chosen) == {"FINISHED"}
    assert bpy.ops.drgs.import_parts(files=files[:1], **chosen) == {"FINISHED"}
    made = sorted(o.name for o in scene.objects if o.type == "MESH")
    assert made == ["ball", "ball.001", "toy"] and sorted(tmp_path.glob("*.drgs")) == [
        tmp_path / "ball.drgs",
        tmp_path / "toy.drgs",
    ]
    with pytest.raises(RuntimeError, match="no file is chosen"):
        bpy.ops.drgs.import_parts(files=[{"name": ""}], **chosen)


def test_a_mesh_is_not_taken_for_a_damaged_asset(scene, tmp_path):
    (tmp_path / "chair.glb").write_bytes(b"glTF" + bytes(60))
    with pytest.raises(RuntimeError, match=r"chair\.glb: is no \.drgs file but a mesh.*drgs make.*Object > Convert"):
        bpy.ops.import_scene.drgs(filepath=str(tmp_path / "chair.glb"))


@pytest.mark.slow
def test_a_file_that_is_imported_again_is_another_object(scene, tmp_path):
    """What the first is made of stays, and what another .blend may be made of."""
    splats = few_splats(tmp_path / "toy.ply")
    assert bpy.ops.drgs.import_parts(surfels=str(splats), up="y") == {"FINISHED"}
    first, before = bpy.context.active_object, (tmp_path / "toy.drgs").read_bytes()
    (tmp_path / "toy.001.drgs").write_bytes(b"another's")
    assert bpy.ops.drgs.import_parts(surfels=str(splats), up="z") == {"FINISHED"}
    second = bpy.context.active_object
    assert (first.drgs.path, second.drgs.path) == ("//toy.drgs", "//toy.002.drgs") and second.name == "toy.002"
    assert (tmp_path / "toy.drgs").read_bytes() == before and (tmp_path / "toy.001.drgs").read_bytes() == b"another's"
    assert np.ptp(part("addon.assets").load(tmp_path / "toy.002.drgs").surfels.centre, axis=0) != pytest.approx(
        np.ptp(part("addon.assets").load(tmp_path / "toy.drgs").surfels.centre, axis=0)
    )
    bpy.data.objects.remove(first)
    assert bpy.ops.drgs.import_parts(surfels=str(splats), up="z") == {"FINISHED"}
    assert bpy.context.active_object.drgs.path == "//toy.drgs"


def test_a_name_once_given_is_not_that_of_the_next_file():
    for operator in (bpy.ops.drgs.import_parts, bpy.ops.drgs.convert, bpy.ops.drgs.reconstruct):
        assert operator.get_rna_type().properties["out"].is_skip_save


def test_a_file_that_a_program_is_writing_is_not_written_by_another(scene, tmp_path):
    assets = part("addon.assets")
    target, pattern = tmp_path / "toy.drgs", tmp_path / "dance_##.drgs"
    assets.announce([target, tmp_path / "dance_02.drgs"])
    assert assets.unused(target) == tmp_path / "toy.001.drgs"
    assert assets.unused(pattern, [1, 2]) == tmp_path / "dance.001_##.drgs" and assets.unused(pattern, [1]) == pattern
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r"toy\.drgs: is being written already"):
        assets.check_unused(target)
    assets.renounce([target, tmp_path / "dance_02.drgs"])
    assert assets.unused(target) == target and assets.unused(pattern, [1, 2]) == pattern


@pytest.mark.slow
def test_names_that_no_file_can_have_are_told(ball, tmp_path):
    """Of some, the system says more than that there is no such file."""
    name = str(tmp_path / ("n" * 300))
    for operator, ending in (
        (bpy.ops.import_scene.drgs, ".drgs"),
        (bpy.ops.drgs.choose_light, ".hdr"),
        (bpy.ops.drgs.save_asset, ".drgs"),
        (bpy.ops.drgs.report, ".txt"),
        (bpy.ops.drgs.reconstruct, ""),
    ):
        with pytest.raises(RuntimeError, match=r"n{300}") as told:
            operator(filepath=name + ending)
        assert "Traceback" not in str(told.value)
    ball.drgs.path = f"{name}.drgs"
    for operator in (bpy.ops.drgs.restore_material, bpy.ops.drgs.bake_light, bpy.ops.render.render):
        with pytest.raises(RuntimeError, match=r'"ball": the asset .* does not exist'):
            operator()


def test_a_failed_conversion_says_why(scene, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises(RuntimeError, match=r"broken\.ply.*could not be made into an asset"):
        bpy.ops.drgs.import_parts(surfels=str(tmp_path / "broken.ply"))
    with pytest.raises(RuntimeError, match="neither surfels nor a mesh"):
        bpy.ops.drgs.import_parts()
    assert not [o for o in scene.objects if o.type == "MESH"]


def test_nothing_is_put_into_a_collection_of_a_library(scene, tmp_path):
    """Blender lets the artist make it the active one; what is new goes beside it."""
    asset = str(write_ball(tmp_path / "ball.drgs"))
    own = bpy.data.collections.new("Library")
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {own})
    bpy.data.collections.remove(own)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.collections = ["Library"]
    layer = bpy.context.view_layer
    scene.collection.children.link(bpy.data.collections["Library"])
    layer.active_layer_collection = layer.layer_collection.children["Library"]
    assert bpy.context.collection.library
    assert bpy.ops.import_scene.drgs(filepath=asset) == {"FINISHED"}
    obj = bpy.context.active_object
    for operator in (bpy.ops.drgs.add_camera, bpy.ops.drgs.bind_to_lattice, bpy.ops.drgs.bind_to_cage):
        select(obj)
        assert operator() == {"FINISHED"}
    assert len(scene.collection.objects) == 5


def test_physics_of_a_linked_object_stay_as_it_is(scene, ball, tmp_path):
    """Blender would change it in memory and lose it with the file."""
    ball.drgs.physics.use = True
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {ball})
    bpy.data.objects.remove(ball)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["ball"]
    linked = bpy.data.objects["ball"]
    scene.collection.objects.link(linked)
    select(linked)
    for operator in (bpy.ops.drgs.physics_row, bpy.ops.drgs.free_physics):
        with pytest.raises(RuntimeError, match=r'"ball".*comes from a library.*Make Local'):
            operator()
    assert not linked.drgs.physics.regions


def test_a_preset_that_cannot_be_used_is_named(scene, monkeypatch, tmp_path):
    (tmp_path / "Broken.py").write_text("import bpy\nbpy.context.scene.drgs.samples = 'many'\n")
    monkeypatch.setattr(bpy.utils, "preset_paths", lambda folder: [str(tmp_path)])
    with pytest.raises(RuntimeError, match=r"Broken.py: cannot be used \(TypeError.*Remove it"):
        bpy.ops.drgs.render_preset(filepath=str(tmp_path / "Broken.py"))


def test_operators_without_a_file_ask_for_one(scene):
    for operator in (bpy.ops.import_scene.drgs, bpy.ops.drgs.choose_light, bpy.ops.drgs.export, bpy.ops.drgs.report):
        with pytest.raises(RuntimeError, match="no file is given"):
            operator()


def test_operators_that_cannot_run_say_what_they_need(scene):
    drgs, mute = bpy.ops.drgs, []
    for name in dir(drgs):
        try:
            if not getattr(drgs, name).poll():
                getattr(drgs, name)()
        except RuntimeError as error:
            mute += [name] if "context is incorrect" in str(error) else []
    assert not mute


@pytest.mark.parametrize("link", [False, True], ids=["append", "link"])
@pytest.mark.parametrize("kind", ["Object", "Collection"])
def test_what_is_appended_or_linked_brings_no_volume_object(ball, tmp_path, link, kind):
    """Blender makes objects of the data that none shows: of the datablock that holds the asset's path."""
    path = str(tmp_path / "library.blend")
    name = ball.name if kind == "Object" else "Balls"
    if kind == "Collection":
        balls = bpy.data.collections.new(name)
        bpy.context.scene.collection.children.link(balls)
        balls.objects.link(ball)
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_homefile(use_empty=True)
    (bpy.ops.wm.link if link else bpy.ops.wm.append)(directory=f"{path}/{kind}/", filename=name)
    if not hasattr(bpy.app.handlers, "blend_import_post"):
        part("addon.assets").remove_instanced_anchors()  # by a timer, which runs with a window
    assert "VOLUME" not in {obj.type for obj in bpy.data.objects}
    assert [volume.name for volume in bpy.data.volumes] == ["ball.drgs"]
    (found,) = [obj for obj in bpy.data.objects if obj.type == "MESH"]
    assert Path(bpy.path.abspath(found.drgs.path)).name == "ball.drgs"


def test_the_volume_object_that_an_older_blender_makes_is_no_volume_that_is_left_out(ball, export):
    volume = bpy.data.objects.new("ball.drgs", ball.drgs.asset)
    bpy.context.scene.collection.objects.link(volume)
    assert export()[1] == []
    volume.data = bpy.data.volumes.new("Smoke")
    assert "Smoke" not in export()[1] and "volume object is not rendered" in export()[1][0]


def test_paths_may_be_relative_to_the_file():
    """Else newer Blenders show them in red."""
    if not part("addon.blend_paths").RELATIVE:
        pytest.skip("this Blender does not ask")
    operators = [getattr(bpy.ops.drgs, name).get_rna_type() for name in dir(bpy.ops.drgs)]
    groups = [
        bpy.types.Object.bl_rna.properties["drgs"].fixed_type,
        bpy.types.Scene.bl_rna.properties["drgs"].fixed_type,
    ]
    red = [
        f"{rna.identifier}.{prop.identifier}"
        for rna in (*operators, *groups)
        for prop in rna.properties
        if prop.type == "STRING"
        and prop.subtype in ("FILE_PATH", "DIR_PATH")
        and not prop.is_hidden
        and not prop.is_path_supports_blend_relative
    ]
    assert red == []


def test_the_pose_of_a_mesh_can_be_chosen(scene, tmp_path, monkeypatch):
    given = []
    operator = part("operators.import_parts").DRGS_OT_import_parts
    monkeypatch.setattr(operator, "start", lambda self, context, arguments, *_: given.append(arguments) or {"FINISHED"})
    for pose in ("rest", "default"):
        bpy.ops.drgs.import_parts(mesh=str(tmp_path / "a.glb"), pose=pose)
    assert "--pose" not in given[0] and given[1][given[1].index("--pose") + 1] == "default"
