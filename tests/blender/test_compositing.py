"""DR-GS over another engine's picture: the same picture as that of one engine which renders everything."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from scenes import mesh_object, new_world, part, read_exr
from test_composed import CUBE, SIDES, add_light, painted
from test_panels import Layout

pytestmark = pytest.mark.blender_api

WIDTH, HEIGHT, BLOCK = 64, 48, 8


@pytest.fixture
def shared_scene(ball, scene):
    """The ball on a floor in the sun, a cube in front of a part of it and one behind; Cycles renders."""
    _, background = new_world(scene)
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (1, 1, 1, 1), 0.3
    square = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    floor = painted(mesh_object("Floor", square, [(0, 1, 2, 3)]), (0.5, 0.5, 0.5), 1.0)
    floor.scale, floor.location = (6, 6, 1), (0, 0, -1)
    front = painted(mesh_object("Front", CUBE, SIDES), (0.8, 0.2, 0.1), 1.0)
    front.scale, front.location = (0.3, 0.3, 0.6), (0.5, -1.5, -0.4)
    back = painted(mesh_object("Back", CUBE, SIDES), (0.1, 0.3, 0.8), 1.0)
    back.scale, back.location = (0.5, 0.5, 0.9), (-1.0, 1.8, -0.1)
    add_light(scene, "SUN", 2, (2, -2, 3), angle=0.05)
    scene.camera.location, scene.camera.rotation_euler = (0, -5, 1), (np.pi / 2 - 0.2, 0, 0)
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", 128, False, False
    cycles.pixel_filter_type, cycles.filter_width, cycles.max_bounces = "BOX", 1.0, 0
    settings = scene.drgs
    settings.use_strategy_samples, settings.samples, settings.subpixel_samples, settings.bounces = False, 128, 16, 0
    settings.camera_sees = "mesh"
    return scene


def picture(scene) -> np.ndarray:
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, WIDTH, HEIGHT)


def blocks(image: np.ndarray) -> np.ndarray:
    return image.reshape(HEIGHT // BLOCK, BLOCK, WIDTH // BLOCK, BLOCK, 4).mean(axis=(1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"shadows": "HOLDOUT"}, {"compare": True}])
def test_the_composite_is_the_picture_of_one_engine(shared_scene, options):
    """In front, behind, on the floor: shadows and edges are where Cycles alone has them."""
    alone = blocks(picture(shared_scene))
    assert bpy.ops.drgs.set_up_compositing(**options) == {"FINISHED"}
    both = blocks(picture(shared_scene))
    np.testing.assert_allclose(both, alone, atol=0.03, rtol=0.03)
    bpy.ops.drgs.clear_compositing()
    np.testing.assert_allclose(blocks(picture(shared_scene)), alone, atol=1e-4)
    assert len(bpy.data.scenes) == 1


def test_mattes_of_the_second_scene_are_the_artists_to_switch_on(shared_scene):
    shared_scene.view_layers[0].use_pass_cryptomatte_object = True
    for wanted in (False, True):
        bpy.ops.drgs.set_up_compositing()
        layer = next(s for s in bpy.data.scenes if s is not shared_scene).view_layers[0]
        assert layer.use_pass_cryptomatte_object == wanted
        layer.use_pass_cryptomatte_object = True


def test_nodes_of_the_artist_that_read_the_second_scene_read_what_replaces_it(shared_scene):
    """Its name stays, too."""
    compositing = part("addon.compositing")
    bpy.ops.drgs.set_up_compositing()
    partner = compositing.partner_of(shared_scene)
    name = partner.name
    kinds = ("CompositorNodeRLayers", "CompositorNodeCryptomatteV2")
    nodes = [compositing.tree_of(shared_scene).nodes.new(kind) for kind in kinds]
    for node in nodes:
        node.scene = partner
    for _ in range(2):
        bpy.ops.drgs.set_up_compositing()
        partner = compositing.partner_of(shared_scene)
        assert partner.name == name and all(node.scene == partner for node in nodes)
        assert nodes[0].layer == partner.view_layers[0].name


def test_the_nodes_of_others_stay_between_picture_and_result(shared_scene):
    """What the artist does with the picture is done with both; again and again gives the same nodes."""
    compositing = part("addon.compositing")
    scene = shared_scene
    tree = compositing.tree_of(scene, create=True)
    for node in list(tree.nodes):
        tree.nodes.remove(node)
    below, blur = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeBlur")
    tree.links.new(below.outputs["Image"], blur.inputs["Image"])
    before = {n.name for n in tree.nodes}
    for shadows in ("CATCHER", "HOLDOUT", "CATCHER"):
        bpy.ops.drgs.set_up_compositing(shadows=shadows)
        (over,) = (n for n in tree.nodes if n.bl_idname == "CompositorNodeAlphaOver")
        assert blur.inputs["Image"].links[0].from_node == over
        pictures = [s.links[0].from_node for s in over.inputs if s.type == "RGBA"]
        assert pictures[0] == below and pictures[1].scene == compositing.partner_of(scene)
        assert len(tree.nodes) == len(before) + 2 and len(bpy.data.scenes) == 2
    bpy.ops.drgs.clear_compositing()
    assert {n.name for n in tree.nodes} == before and blur.inputs["Image"].links[0].from_node == below


def test_settings_of_the_second_scene_survive_and_what_it_lacks_is_named(shared_scene, captured, ball):
    scene = shared_scene
    bpy.ops.drgs.set_up_compositing()
    compositing = part("addon.compositing")
    partner = compositing.partner_of(scene)
    partner.drgs.samples = 77
    scene.render.resolution_x, scene.render.use_border, scene.render.border_max_x = 40, True, 0.5
    mesh_object("New", CUBE, SIDES)
    second = ball.copy()
    scene.collection.objects.link(second)
    bpy.ops.render.render()
    (frame,) = captured
    assert (frame.camera.width, frame.camera.region) == (40, (0, 0, 20, HEIGHT)) and frame.settings.sample_count == 77
    assert all(m.visibility.shadow_catcher for m in frame.meshes) and len(frame.objects) == 1
    last = part("addon.messages").history[-1]
    assert '"New"' in last.text and f'"{second.name}"' in last.text and "again" in last.text
    bpy.ops.drgs.set_up_compositing()
    partner = compositing.partner_of(scene)
    assert partner.drgs.samples == 77 and not compositing.differences(partner)
    bpy.ops.render.render()
    assert len(captured[1].objects) == 2 and len(captured[1].meshes) == 4


def test_compositing_that_is_left_over_is_told_with_what_removes_it(shared_scene, export):
    """The scene's engine is DR-GS itself now: nothing is to be set up again."""
    scene = shared_scene
    bpy.ops.drgs.set_up_compositing()
    compositing = part("addon.compositing")
    partner = compositing.partner_of(scene)
    panel = part("addon.panels.compositing").DRGS_PT_compositing
    scene.render.engine = "DRGS"
    warnings = []
    with bpy.context.temp_override(scene=partner, view_layer=partner.view_layers[0]):
        part("addon.export").export_frame(bpy.context.evaluated_depsgraph_get(), str, warnings.append)
    (told,) = [text for text in warnings if "compos" in text.lower()]
    assert "rendered by DR-GS itself now" in told and "Remove Compositing" in told
    assert panel.poll(bpy.context)
    assert bpy.ops.drgs.clear_compositing() == {"FINISHED"}
    assert not panel.poll(bpy.context) and compositing.partner_of(scene) is None


def test_a_linked_object_with_the_name_of_a_local_one_is_in_the_picture(shared_scene, ball, tmp_path):
    compositing = part("addon.compositing")
    path = str(tmp_path / "library.blend")
    bpy.data.libraries.write(path, {ball})
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.objects = [ball.name]
    (linked,) = wanted.objects
    shared_scene.collection.objects.link(linked)
    assert linked.name == ball.name and linked != ball
    for _ in range(2):
        bpy.ops.drgs.set_up_compositing()
        for scene in (shared_scene, compositing.partner_of(shared_scene)):
            assert {linked, ball} <= set(scene.objects)


def test_a_second_scene_that_was_deleted_is_told_and_what_is_left_can_be_removed(shared_scene):
    scene = shared_scene
    compositing = part("addon.compositing")
    bpy.ops.drgs.set_up_compositing(shadows="HOLDOUT")
    nodes = compositing.tree_of(scene).nodes
    assert not compositing.bereft(scene)
    bpy.data.scenes.remove(compositing.partner_of(scene))
    assert compositing.bereft(scene) and bpy.ops.drgs.clear_compositing.poll()
    drawn: list[str] = []
    part("addon.panels.compositing").DRGS_PT_compositing.draw(SimpleNamespace(layout=Layout(drawn)), bpy.context)
    assert drawn.count("operator") == 2 and "label" in drawn and "prop" not in drawn
    assert bpy.ops.drgs.clear_compositing() == {"FINISHED"}
    assert not compositing.bereft(scene) and not bpy.ops.drgs.clear_compositing.poll()
    assert not [node for node in nodes if node.label == compositing.LABEL]
    assert not any(layer.indirect_only for layer in scene.view_layers[0].layer_collection.children)


def test_a_second_scene_alone_says_what_it_shows(shared_scene, export):
    bpy.ops.drgs.set_up_compositing()
    partner = part("addon.compositing").partner_of(shared_scene)
    with bpy.context.temp_override(scene=partner, view_layer=partner.view_layers[0]):
        bpy.data.scenes.remove(shared_scene)
        told: list[str] = []
        part("addon.export").export_frame(bpy.context.evaluated_depsgraph_get(), str, told.append)
        assert [text for text in told if "is deleted" in text and f'"{partner.name}"' in text]
        partner.view_layers[0].drgs.others = "SEEN"
        told.clear()
        part("addon.export").export_frame(bpy.context.evaluated_depsgraph_get(), str, told.append)
        assert not [text for text in told if "is deleted" in text]


def test_what_cannot_be_composited_is_refused_in_words(shared_scene, ball):
    scene = shared_scene
    scene.render.engine = "DRGS"
    with pytest.raises(RuntimeError, match="Choose Cycles or EEVEE"):
        bpy.ops.drgs.set_up_compositing()
    scene.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"
    with pytest.raises(RuntimeError, match="need Cycles"):
        bpy.ops.drgs.set_up_compositing(shadows="HOLDOUT")
    camera, scene.camera = scene.camera, None
    with pytest.raises(RuntimeError, match="has no camera"):
        bpy.ops.drgs.set_up_compositing()
    scene.camera = camera
    bpy.data.objects.remove(ball)
    with pytest.raises(RuntimeError, match="has no DR-GS object"):
        bpy.ops.drgs.set_up_compositing()
    assert len(bpy.data.scenes) == 1
