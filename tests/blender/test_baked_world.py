"""Worlds that Cycles bakes: maps and suns are what Cycles shows, kept by content, and nothing fails in silence."""

from __future__ import annotations

import os
import signal
import sys
import time

import bpy
import disks
import numpy as np
import pytest
from kept_blender import keep_blender
from mathutils import Vector
from scenes import mesh_object, new_world, part, read_exr
from test_world import cycles_picture, link_sky, picture_of, sky  # noqa: F401 - a fixture

pytestmark = pytest.mark.blender_api
SIZE = 512


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, kept_blenders):
    """Results are kept in a folder of the test; the Blender that bakes is that of the last one."""
    keep_blender(monkeypatch, kept_blenders)
    monkeypatch.setattr(part("addon.bakes.store"), "cache_folder", lambda: tmp_path / "bakes")
    yield tmp_path / "bakes"
    part("addon.bakes").manager.stop()


@pytest.fixture
def bake():
    """Function that exports the current scene as final pictures are; returns (frame, warnings)."""
    export = part("addon.export").export_baked
    bpy.context.scene.drgs.bake_world_size = "512"

    def run(cancelled=None):
        warnings: list[str] = []
        depsgraph = bpy.context.evaluated_depsgraph_get()
        frame = export(depsgraph, str, warnings.append, lambda text, part: None, cancelled=cancelled)
        return frame, warnings

    return run


@pytest.fixture
def jobs(monkeypatch):
    """The jobs that were baked."""
    done: list[dict] = []
    process = part("addon.bakes.blender_process").BlenderProcess
    do = process.do

    def counted(self, job, cancelled):
        done.append(job)
        do(self, job, cancelled)

    monkeypatch.setattr(process, "do", counted)
    return done


def wanted():
    return part("addon.bakes.requests").Wanted(SIZE, SIZE)


def sky_texture(scene, elevation: float = 0.6, disc: bool = True):
    """World of a Sky Texture; returns (tree, background, node)."""
    tree, background = new_world(scene)
    node = tree.nodes.new("ShaderNodeTexSky")
    if "NISHITA" in node.bl_rna.properties["sky_type"].enum_items:
        node.sky_type = "NISHITA"
    node.sun_elevation, node.sun_rotation, node.sun_disc = elevation, 0.7, disc
    tree.links.new(node.outputs["Color"], background.inputs["Color"])
    return tree, background, node


def direction_of(elevation: float, rotation: float) -> np.ndarray:
    """Where the sun of a Sky Texture stands."""
    flat = np.cos(elevation)
    return np.array((flat * np.sin(rotation), flat * np.cos(rotation), np.sin(elevation)))


def psnr(ours: np.ndarray, theirs: np.ndarray) -> float:
    return 10 * np.log10(theirs.max() ** 2 / np.mean((ours - theirs) ** 2))


def noise(scene, path):
    tree, background = new_world(scene)
    node = tree.nodes.new("ShaderNodeTexNoise")
    node.inputs["Scale"].default_value = 2
    tree.links.new(node.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = 1.5
    return tree, background, node


def gradient(scene, path):
    tree, background = new_world(scene)
    coordinates, node = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeTexGradient")
    tree.links.new(coordinates.outputs["Generated"], node.inputs["Vector"])
    tree.links.new(node.outputs["Color"], background.inputs["Color"])


def two_images(scene, path):
    """Two Environment Textures, one turned, mixed by a gradient: all of it in a group."""
    tree, background = new_world(scene)
    group = bpy.data.node_groups.new("Both", "ShaderNodeTree")
    group.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    nodes, links = group.nodes, group.links
    first, second, mapping, coordinates, ramp, mix, end = (
        nodes.new(n)
        for n in (
            *("ShaderNodeTexEnvironment", "ShaderNodeTexEnvironment", "ShaderNodeMapping", "ShaderNodeTexCoord"),
            *("ShaderNodeTexGradient", "ShaderNodeMixRGB", "NodeGroupOutput"),
        )
    )
    first.image = second.image = bpy.data.images.load(path)
    mapping.inputs["Rotation"].default_value = (0.3, 0.5, 1.0)
    links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], second.inputs["Vector"])
    links.new(ramp.outputs["Fac"], mix.inputs[0])
    links.new(first.outputs["Color"], mix.inputs[1])
    links.new(second.outputs["Color"], mix.inputs[2])
    links.new(mix.outputs[0], end.inputs[0])
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    tree.links.new(node.outputs[0], background.inputs["Color"])


def clear_sky(scene, path):
    sky_texture(scene, disc=False)


@pytest.mark.parametrize("make", [noise, gradient, two_images, clear_sky])
def test_a_baked_world_is_what_cycles_shows(scene, bake, sky, make):  # noqa: F811
    make(scene, sky[0])
    scene.camera.data.lens, scene.drgs.bake_world_size = 20, "1024"
    frame, warnings = bake()
    assert not warnings and frame.background is None and not frame.lights
    assert frame.world.environment.shape == (512, 1024, 3)
    assert psnr(picture_of(frame.world, frame.camera), cycles_picture(scene)) > 45


@pytest.mark.slow
def test_the_sun_of_a_sky_is_a_lamp(scene, bake):
    _, background, node = sky_texture(scene)
    background.inputs["Strength"].default_value = 0.25
    frame, warnings = bake()
    (sun,) = frame.lights
    assert not warnings and (sun.kind, sun.camera) == ("sun", True)
    assert np.isclose(sun.angle, node.sun_size, rtol=1e-6)
    np.testing.assert_allclose(sun.matrix_world[:3, 2], direction_of(0.6, 0.7), atol=1e-3)
    assert frame.world.environment.max() < 1e3, "the disc is not in the map"
    # A white diffuse plate that faces the sun, in Cycles: what the disc adds to it.
    plate = mesh_object("Plate", [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], [(0, 1, 2, 3)])
    material = plate.active_material = bpy.data.materials.new("White")
    if material.node_tree is None:
        material.use_nodes = True
    shader = material.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (1, 1, 1, 1)
    material.node_tree.links.new(shader.outputs[0], material.node_tree.get_output_node("ALL").inputs["Surface"])
    turn = direction_of(0.6, 0.7)
    plate.rotation_euler = Vector(turn).to_track_quat("Z", "Y").to_euler()
    scene.camera.location = 5 * turn
    scene.camera.rotation_euler = plate.rotation_euler
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 256, False, False
    scene.cycles.max_bounces = 0
    seen = []
    for node.sun_disc in (True, False):
        bpy.ops.render.render(write_still=True)
        seen.append(read_exr(scene.render.filepath, 8, 8)[..., :3].mean(axis=(0, 1)))
    expected = (seen[0] - seen[1]) * np.pi
    np.testing.assert_allclose(np.array(sun.colour) * sun.power, expected, rtol=0.01)
    node.sun_disc = scene.render.film_transparent = True
    scene.render.engine = "DRGS"
    assert not bake()[0].lights[0].camera


@pytest.mark.slow
def test_a_sun_below_the_horizon_is_none(scene, bake):
    sky_texture(scene, elevation=-0.2)
    frame, warnings = bake()
    assert not warnings and not frame.lights and frame.world.environment is not None


def test_light_paths_split_what_is_seen_from_what_lights(scene, bake, jobs, sky):  # noqa: F811
    """Without procedural textures nothing is baked; with them both sides are."""
    tree, background, *_ = link_sky(scene, sky[0])
    plate, mix, path = (
        tree.nodes.new(n) for n in ("ShaderNodeBackground", "ShaderNodeMixShader", "ShaderNodeLightPath")
    )
    plate.inputs["Color"].default_value = (0.2, 0.4, 0.6, 1)
    output = next(n for n in tree.nodes if n.type == "OUTPUT_WORLD")
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(background.outputs[0], mix.inputs[1])
    tree.links.new(plate.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    frame, warnings = bake()
    assert not warnings and not jobs
    np.testing.assert_array_equal(frame.world.environment, sky[1])
    np.testing.assert_allclose(frame.background.colour, (0.2, 0.4, 0.6), rtol=1e-6)
    wave = tree.nodes.new("ShaderNodeTexWave")
    wave.inputs["Scale"].default_value = 0.5
    tree.links.new(wave.outputs["Color"], plate.inputs["Color"])
    frame, warnings = bake()
    assert not warnings and len(jobs) == 1, "the side that is read directly is not baked"
    np.testing.assert_array_equal(frame.world.environment, sky[1])
    assert psnr(picture_of(frame.background, frame.camera), cycles_picture(scene)) > 45
    scene.render.engine = "DRGS"
    tree.links.new(path.outputs["Is Glossy Ray"], background.inputs["Strength"])
    (warning,) = bake()[1]
    assert 'World "World"' in warning and '"Is Glossy Ray"' in warning


def test_results_are_kept_by_content(scene, bake, jobs, folder):
    tree, background, node = noise(scene, "")
    manager = part("addon.bakes").manager
    first = bake()[0].world
    assert len(jobs) == 1 and len(list(folder.iterdir())) == 1
    node.location, node.label, background.inputs["Strength"].default_value = (500, 20), "Elsewhere", 2
    tree.nodes.new("ShaderNodeTexNoise")  # reaches no output
    again = bake()[0].world
    assert again.environment is first.environment and again.colour == (2, 2, 2)
    manager.stop()  # as another start of Blender
    again = bake()[0].world
    np.testing.assert_array_equal(again.environment, first.environment)
    assert len(jobs) == 1
    node.inputs["Scale"].default_value = 3
    assert not np.array_equal(bake()[0].world.environment, first.environment)
    assert len(jobs) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_damaged_result_is_not_left_open(tmp_path):
    """On Windows it could not be made again."""
    path = tmp_path / "cut.npz"
    np.savez(path, map=np.zeros(300))
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError) as error:
        part("addon.bakes.store").read(path)
    assert error.value.__cause__ is not None, "what holds the file is alive"
    links = (f"/proc/self/fd/{name}" for name in os.listdir("/proc/self/fd"))
    assert str(path) not in {os.readlink(link) for link in links if os.path.lexists(link)}


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "other", "foreign"])
def test_a_damaged_result_is_made_again(scene, bake, jobs, folder, damage):
    gradient(scene, "")
    first = bake()[0].world.environment
    (path,) = folder.iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x55
    if damage == "foreign":
        np.savez(path, map=np.zeros(3))
    else:
        path.write_bytes({"empty": b"", "cut": data[:1000], "flipped": data, "other": b"no archive"}[damage])
    part("addon.bakes").manager.stop()
    frame, warnings = bake()
    assert len(jobs) == 2 and not warnings
    np.testing.assert_array_equal(frame.world.environment, first)


def test_results_that_cannot_be_kept_are_used_all_the_same(scene, bake, folder):
    gradient(scene, "")
    folder.write_bytes(b"a file where the folder should be")
    frame, warnings = bake()
    assert frame.world.environment is not None
    assert len(warnings) == 1 and str(folder) in warnings[0]
    assert not bake()[1], "it is said once"


def test_the_least_used_results_go_first(folder, monkeypatch, tmp_path):
    store = part("addon.bakes.store")
    monkeypatch.setattr(store, "LIMIT", 28_000)
    results = store.Store()
    for number in range(4):
        np.savez(tmp_path / "one.npz", map=np.zeros((20, 25, 4), np.float32), suns=np.zeros((0, 7)), kept=np.array(0))
        results.add(str(number), tmp_path / "one.npz")
        time.sleep(0.02)
        results.forget()
        assert results.find("0") is not None, "it is used"
    assert {path.stem for path in folder.iterdir()} == {"0", "2", "3"}


def test_a_blender_that_fails_is_named_and_the_world_is_approximated(scene, bake, export, monkeypatch):
    gradient(scene, "")
    before, texts = export()
    process = part("addon.bakes.blender_process")
    for command, said in (
        (["/nowhere/blender"], "cannot be started"),
        ([sys.executable, "-c", "import sys; sys.exit('no memory')"], "no memory"),
    ):
        monkeypatch.setattr(process, "command", lambda command=command: command)
        frame, warnings = bake()
        assert warnings[0].startswith('World "World" cannot be baked (') and said in warnings[0]
        assert warnings[1:] == texts and frame.world.colour == before.world.colour
        part("addon.bakes").manager.stop()
    monkeypatch.undo()


def test_esc_ends_the_bake(scene, bake):
    gradient(scene, "")
    scene.drgs.bake_world_size = "8192"
    began, manager = time.monotonic(), part("addon.bakes").manager
    with pytest.raises(part("drgs_blender.core.errors").Cancelled):
        bake(cancelled=lambda: time.monotonic() > began + 1.0)
    assert manager.status() == ("", 0.0) or "Baking" in manager.status()[0]
    until = time.monotonic() + 5
    while manager.status()[0] and time.monotonic() < until:
        time.sleep(0.05)
    assert manager.status() == ("", 0.0), "nothing goes on"


def test_viewports_do_not_wait(scene, jobs):
    """What they cannot show yet is shown when it is there; a value that was left again is not baked."""
    export, bakes = part("addon.export").export_frame, part("addon.bakes")
    scale = noise(scene, "")[2].inputs["Scale"]
    for scale.default_value in (1, 2, 3):
        need, warnings = wanted(), []
        frame = export(bpy.context.evaluated_depsgraph_get(), str, warnings.append, wanted=need)
        bakes.manager.want("view", need.requests)
        assert frame.world.environment is None and not warnings and len(need.requests) == 1
    assert 'World "World"' in bakes.manager.status()[0]
    until = time.monotonic() + 60
    while bakes.manager.status()[0] and time.monotonic() < until:
        time.sleep(0.05)
    keys = [job["key"] for job in jobs]
    assert len(keys) <= 2 and keys[-1] == need.requests[0].key, "one was under way"
    need = wanted()
    frame = export(bpy.context.evaluated_depsgraph_get(), str, warnings.append, wanted=need)
    assert not need.requests and frame.world.environment.shape == (SIZE // 2, SIZE, 3)


def test_cancelled_bakes_are_named(scene, bake):
    gradient(scene, "")
    export, bakes = part("addon.export").export_frame, part("addon.bakes")
    need = wanted()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    export(depsgraph, str, print, wanted=need)
    bakes.manager.want("view", need.requests)
    assert bpy.ops.drgs.bakes_cancel() == {"FINISHED"}
    texts: list[str] = []
    frame = export(depsgraph, str, texts.append, wanted=wanted())
    assert "cancelled" in texts[0] and frame.world.environment is None
    bakes.manager.retry()
    need = wanted()
    export(depsgraph, str, print, wanted=need)
    assert need.requests


def test_values_are_those_of_the_frame(scene, bake, jobs):
    """Keyframes and drivers: each frame has the map of its own values."""
    scale = noise(scene, "")[2].inputs["Scale"]
    for number, value in ((1, 1), (11, 2)):
        scale.default_value = value
        scale.keyframe_insert("default_value", frame=number)
    maps = []
    for number in (1, 11):
        scene.frame_set(number)
        maps.append(bake()[0].world.environment)
    assert len(jobs) == 2 and np.abs(maps[0] - maps[1]).max() > 0.1
    scene.world.node_tree.animation_data_clear()
    scale.default_value = 2
    assert bake()[0].world.environment is maps[1]


def test_painted_and_generated_images_are_baked_as_they_are(scene, bake):
    tree, background = new_world(scene)
    image = bpy.data.images.new("Painted", 32, 16, float_buffer=True)
    image.pixels.foreach_set(np.tile(np.float32((0.75, 0.25, 0.5, 1)), 32 * 16))
    texture, change = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeSeparateXYZ")
    join = tree.nodes.new("ShaderNodeCombineXYZ")
    texture.image = image
    tree.links.new(texture.outputs["Color"], change.inputs[0])
    for i in range(3):
        tree.links.new(change.outputs[i], join.inputs[2 - i])
    tree.links.new(join.outputs[0], background.inputs["Color"])
    frame, warnings = bake()
    assert not warnings
    np.testing.assert_allclose(frame.world.environment[10, 10], (0.5, 0.25, 0.75), rtol=1e-3)


def test_a_world_of_a_library_is_baked_from_there(scene, bake, tmp_path):
    gradient(scene, "")
    expected = bake()[0].world.environment
    path = str(tmp_path / "worlds.blend")
    bpy.data.libraries.write(path, {scene.world})
    bpy.data.worlds.remove(scene.world)
    with bpy.data.libraries.load(path, link=True) as (_, linked):
        linked.worlds = ["World"]
    scene.world = linked.worlds[0]
    part("addon.bakes").manager.store.forget()
    frame, warnings = bake()
    assert not warnings and scene.world.library is not None
    np.testing.assert_array_equal(frame.world.environment, expected)


def test_a_lost_image_among_others_is_named(scene, bake, sky, tmp_path):  # noqa: F811
    two_images(scene, sky[0])
    image = bpy.data.node_groups["Both"].nodes["Environment Texture"].image
    image.filepath = str(tmp_path / "gone.exr")
    image.reload()
    frame, warnings = bake()
    assert frame.world.environment is not None
    assert any(image.name in text and "Find Missing Files" in text for text in warnings)


def test_what_differs_with_the_view_is_named_and_not_baked(scene, bake, export, jobs):
    tree, background = new_world(scene)
    coordinates, node = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeTexGradient")
    tree.links.new(coordinates.outputs["Window"], node.inputs["Vector"])
    tree.links.new(node.outputs["Color"], background.inputs["Color"])
    assert bake()[1] == export()[1] != [] and not jobs


@pytest.mark.slow
@pytest.mark.judged
@pytest.mark.parametrize("make", [noise, clear_sky])
def test_objects_under_a_baked_world_are_lit_as_by_cycles(scene, make, tmp_path):
    """A diffuse and a glossy ball, and the background between them, by F12."""
    make(scene, "")
    scene.drgs.bake_world_size = "2048"
    for x, roughness, metallic in ((-1.1, 1.0, 0.0), (1.1, 0.3, 1.0)):
        bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, location=(x, 0, 0))
        bpy.ops.object.shade_smooth()
        material = bpy.context.object.active_material = bpy.data.materials.new("Ball")
        if material.node_tree is None:
            material.use_nodes = True
        shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        shader.distribution = "GGX"
        shader.inputs["Roughness"].default_value, shader.inputs["Metallic"].default_value = roughness, metallic
    pictures = []
    scene.drgs.use_strategy_samples, scene.drgs.samples, scene.drgs.bounces = False, 512, 0
    scene.drgs.subpixel_samples = 64
    for scene.render.engine in ("CYCLES", "DRGS"):
        scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 1024, False, False
        scene.cycles.max_bounces, scene.cycles.blur_glossy = 0, 0
        bpy.ops.render.render(write_still=True)
        pictures.append(read_exr(scene.render.filepath, 64, 48)[..., :3])
    assert not [m for m in part("addon.messages").history if m.level == "WARNING" and "World" in m.text]
    assert psnr(pictures[1], pictures[0]) > 45


@pytest.mark.slow
def test_a_blender_that_is_killed_is_named_once_and_the_next_try_bakes(scene, bake, folder, monkeypatch):
    """The message of it leaves, too."""
    gradient(scene, "")
    bakes, messages = part("addon.bakes"), part("addon.messages")
    process = part("addon.bakes.blender_process").BlenderProcess
    do = process.do

    def killed(self, job, cancelled):
        os.kill(self.pid, signal.SIGKILL)
        do(self, job, cancelled)

    with monkeypatch.context() as patch:
        patch.setattr(process, "do", killed)
        frame, warnings = bake()
    assert len(warnings) >= 1 and warnings[0].startswith('World "World" cannot be baked (Blender ended')
    assert frame.world.environment is None and len(frame.passes) > 0
    for text in warnings:
        messages.note("WARNING", text)
    bakes._retry()
    frame, warnings = bake()
    assert frame.world.environment is not None and not warnings
    assert not any('"World"' in message.text for message in messages.history)
    messages.history.clear()


@pytest.mark.slow
def test_a_full_disk_is_named_and_what_was_baked_is_used(scene, bake, jobs, folder):
    """Once there is room again, the next result is kept, and nothing is said any more."""
    gradient(scene, "")
    if sys.platform != "linux" or not disks.mount(folder, "size=16k"):
        pytest.skip("no small disk can be mounted")
    try:
        frame, warnings = bake()
        assert frame.world.environment is not None and len(jobs) == 1
        assert len(warnings) == 1 and str(folder) in warnings[0] and "space" in warnings[0]
        assert not list(folder.iterdir()), "no part of it is left"
        disks.mount(folder, "size=64m")
        noise(scene, "")
        frame, warnings = bake()
        assert frame.world.environment is not None and not warnings and len(list(folder.iterdir())) == 1
    finally:
        disks.unmount(folder)


@pytest.mark.slow
def test_a_full_disk_for_what_a_bake_needs_is_named(scene, bake, monkeypatch):
    """Of temporary files, too; the rest is rendered, and the next try bakes."""
    gradient(scene, "")
    with monkeypatch.context() as patch:
        patch.setattr(part("addon.bakes.manager").tempfile, "tempdir", "/dev/full/nowhere")
        frame, warnings = bake()
    assert warnings[0].startswith('World "World" cannot be baked (the files for it cannot be written')
    assert frame.world.environment is None
    part("addon.bakes")._retry()
    frame, warnings = bake()
    assert frame.world.environment is not None and not warnings
