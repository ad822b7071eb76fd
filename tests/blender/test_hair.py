"""Hair: what is exported of Curves objects and particle hair, and how it looks beside Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from parity import light, pictures, psnr, set_up
from scenes import mesh_object, part, read_exr, sphere
from test_materials import add, material, picture, shaded, texture_node

pytestmark = pytest.mark.blender_api


def curves(name: str = "Fur", count: int = 20, points: int = 5, radius: float | None = None) -> bpy.types.Object:
    """Strands that stand on a grid in the plane, bent towards +X, a metre high."""
    data = bpy.data.hair_curves.new(name)
    data.add_curves([points] * count)
    along = np.linspace(0, 1, points)
    side = int(np.ceil(np.sqrt(count)))
    roots = np.stack((np.arange(count) % side, np.arange(count) // side, np.zeros(count)), -1) / side - [0.5, 0.5, 0]
    places = roots[:, None] + along[:, None] * [0, 0, 1] + along[:, None] ** 2 * [0.4, 0, 0]
    data.attributes["position"].data.foreach_set("vector", places.astype(np.float32).ravel())
    if radius is not None:
        values = data.attributes.get("radius") or data.attributes.new("radius", "FLOAT", "POINT")
        values.data.foreach_set("value", np.full(count * points, radius, np.float32))
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def furry(name: str = "Furry", count: int = 12, children: int = 0, **settings) -> bpy.types.Object:
    """A ball with particle hair half a metre long."""
    obj = mesh_object(name, *sphere(6, 8))
    with bpy.context.temp_override(object=obj, active_object=obj):
        bpy.ops.object.particle_system_add()
    own = obj.particle_systems[0].settings
    own.type, own.count, own.hair_length, own.radius_scale = "HAIR", count, 0.5, 0.1
    if children:
        own.child_type, own.child_percent, own.rendered_child_count = "SIMPLE", children, 2 * children
    for key, value in settings.items():
        setattr(own, key, value)
    return obj


def hair_of(frame, name: str):
    """The mesh that hair of an object became."""
    return next(m for m in frame.meshes if m.name == name and m.vertex_normals is not None and len(m.vertices) > 200)


def strand_count(mesh) -> int:
    """Pieces of a mesh that hang together, which is where corners meet."""
    _, one = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = one.ravel()[mesh.faces]
    label = np.arange(one.max() + 1)
    while True:
        low = np.minimum.reduceat(label[faces].ravel(), np.arange(0, faces.size, 3))
        new = label.copy()
        np.minimum.at(new, faces.ravel(), np.repeat(low, 3))
        if (new == label).all():
            return len(np.unique(label[faces]))
        label = new


def volume(mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def test_hair_curves_are_a_mesh_of_strands(scene, export):
    obj = curves(radius=0.02)
    obj.pass_index, obj.visible_glossy = 3, False
    obj.matrix_world = Matrix.Translation((1, 2, 3))
    frame, warnings = export()
    (mesh,) = frame.meshes
    assert not warnings and strand_count(mesh) == 20
    np.testing.assert_allclose(mesh.matrices[0], np.array(obj.matrix_world))
    assert mesh.pass_indices.tolist() == [3] and not mesh.visibility.glossy and mesh.visibility.camera
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(1, abs=0.05)
    thin = export_with_radius(obj, None, export)
    assert volume(mesh) / volume(thin) == pytest.approx((0.02 / 0.005) ** 2, rel=0.02), "Cycles' radius without one"


def export_with_radius(obj, radius, export):
    data = obj.data
    if (known := data.attributes.get("radius")) is not None:
        data.attributes.remove(known)
    if radius is not None:
        data.attributes.new("radius", "FLOAT", "POINT").data.foreach_set("value", radius)
    data.update_tag()
    bpy.context.view_layer.update()
    return export()[0].meshes[0]


def test_bad_curves_are_left_out_and_counted(scene, export):
    obj = curves(count=9, radius=0.01)
    places = np.empty(9 * 5 * 3, np.float32)
    position = obj.data.attributes["position"].data
    position.foreach_get("vector", places)
    places = places.reshape(9, 5, 3)
    places[1, 2], places[4] = np.nan, 1.0
    position.foreach_set("vector", places.ravel())
    scene.collection.objects.link(bpy.data.objects.new("Nothing", bpy.data.hair_curves.new("Nothing")))
    frame, warnings = export()
    (mesh,) = frame.meshes
    assert strand_count(mesh) == 7 and np.isfinite(mesh.vertices).all()
    assert [text for text in warnings if '"Fur"' in text and "not finite" in text and " 1 of its 9" in text]
    assert [text for text in warnings if '"Fur"' in text and "no length" in text and " 1 of its 9" in text]
    assert len(warnings) == 2


@pytest.mark.parametrize("scale", [0.0, float("nan")])
def test_an_emitter_without_a_size_breaks_nothing(scene, export, scale):
    furry().scale = (scale, 1, 1)
    bpy.context.view_layer.update()
    frame, _ = export()
    assert frame.meshes and all(np.isfinite(mesh.vertices).all() for mesh in frame.meshes)


def test_particle_hair_is_there_beside_its_object(scene, export):
    obj = furry()
    frame, warnings = export()
    assert not warnings and len(frame.meshes) == 2
    mesh = hair_of(frame, "Furry")
    assert strand_count(mesh) == 12
    size = np.linalg.norm(mesh.vertices, axis=1)
    assert 0.8 < size.min() < 1.05 and size.max() == pytest.approx(1.5, abs=0.1)
    obj.matrix_world = Matrix.Translation((3, 0, 0)) @ Matrix.Diagonal((2, 1, 1, 1))
    bpy.context.view_layer.update()
    moved = hair_of(export()[0], "Furry")
    np.testing.assert_allclose(moved.matrices[0], np.array(obj.matrix_world), atol=1e-6)
    assert 0.8 < np.linalg.norm(moved.vertices, axis=1).min() < 1.1, "in the object's own space"


def test_children_stand_for_their_parents_and_pictures_have_their_own_number(scene, export, captured):
    furry(count=4, children=3)
    assert strand_count(hair_of(export()[0], "Furry")) == 12
    bpy.ops.render.render()
    assert strand_count(hair_of(captured[0], "Furry")) == 24
    bpy.data.objects["Furry"].modifiers[0].show_render = False
    bpy.ops.render.render()
    assert len(captured[1].meshes) == 1


def test_show_emitter_hides_the_object_alone(scene, export):
    obj = furry()
    obj.show_instancer_for_viewport = False
    frame, _ = export()
    assert [len(m.vertices) > 200 for m in frame.meshes] == [True]
    obj.particle_systems[0].settings.render_type = "NONE"
    assert export()[0].meshes == []


def test_hair_grows_on_captured_objects(ball, scene, export):
    with bpy.context.temp_override(object=ball, active_object=ball):
        bpy.ops.object.particle_system_add()
    ball.particle_systems[0].settings.type = "HAIR"
    ball.particle_systems[0].settings.count = 7
    frame, warnings = export()
    assert len(frame.objects) == 1 and not warnings
    (mesh,) = frame.meshes
    assert strand_count(mesh) == 7
    albedo = next(layer for layer in mesh.layers if "albedo" in layer.name).values
    assert len(np.unique(albedo.reshape(-1, 4), axis=0)) == 7, "each has the colour of what it grows on"


def test_instances_of_hair_share_one_shape(scene, export):
    group = bpy.data.collections.new("Group")
    for obj in (furry(), curves()):
        scene.collection.objects.unlink(obj)
        group.objects.link(obj)
    for x in (-2, 3):
        empty = bpy.data.objects.new("Place", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", group, (x, 0, 0)
        scene.collection.objects.link(empty)
    frame, warnings = export()
    assert not warnings and [(m.name, len(m.matrices)) for m in frame.meshes] == [
        ("Furry", 2),
        ("Furry", 2),
        ("Fur", 2),
    ]
    for mesh in frame.meshes:
        assert sorted(mesh.matrices[:, 0, 3].tolist()) == pytest.approx([-2, 3])
        assert np.abs(mesh.vertices).max() < 2


def test_unchanged_hair_is_not_read_again(scene):
    export_frame, cache = part("addon.export").export_frame, part("addon.export.export_cache").ExportCache()
    obj, fur = furry(), curves()

    def exported():
        frame = export_frame(bpy.context.evaluated_depsgraph_get(), str, print, cache=cache)
        return hair_of(frame, "Furry"), hair_of(frame, "Fur")

    first, still = exported()
    fur.location.x = 1
    second, moved = exported()
    assert second.vertices is first.vertices and moved.vertices is still.vertices and moved.matrices[0, 0, 3] == 1
    noted: list = []
    bpy.app.handlers.depsgraph_update_post.append(lambda scene, depsgraph: noted.append(cache.note(depsgraph)))
    try:
        obj.particle_systems[0].settings.hair_length = 1.0
        bpy.context.view_layer.update()
    finally:
        bpy.app.handlers.depsgraph_update_post.pop()
    third, again = exported()
    assert noted and np.abs(third.vertices).max() > np.abs(first.vertices).max() + 0.2
    assert again.vertices is still.vertices


def test_hair_follows_what_bends_its_emitter(scene, captured):
    obj = furry()
    obj.shape_key_add(name="Basis")
    bent = obj.shape_key_add(name="Bent")
    for point in bent.data:
        point.co.x += 0.5 * point.co.z
    for frame, value in ((1, 0.0), (3, 1.0)):
        bent.value = value
        bent.keyframe_insert("value", frame=frame)
    scene.view_layers[0].use_pass_vector = True
    scene.frame_set(2)
    bpy.ops.render.render()
    (frame,) = captured
    at = next(i for i, m in enumerate(frame.meshes) if len(m.vertices) > 200)
    now, before, after = frame.meshes[at].vertices, frame.previous.meshes[at].vertices, frame.next.meshes[at].vertices
    assert before.shape == now.shape == after.shape
    forward, back = after - now, now - before
    assert np.abs(forward).max() > 0.05
    assert np.corrcoef(forward.ravel(), back.ravel())[0, 1] > 0.9, "it goes on as it went"


def test_hair_whose_number_changes_is_rendered(scene):
    """Nobody knows where its points were; the engine takes it as not moved."""
    settings = furry(children=2).particle_systems[0].settings
    for frame, count in ((19, 3), (20, 4), (21, 5)):
        settings.rendered_child_count = count
        settings.keyframe_insert("rendered_child_count", frame=frame)
    tree = curves()
    node = bpy.data.node_groups.new("Grow", "GeometryNodeTree")
    node.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    node.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = node.nodes.new("NodeGroupInput"), node.nodes.new("NodeGroupOutput")
    resample = node.nodes.new("GeometryNodeResampleCurve")
    time = node.nodes.new("GeometryNodeInputSceneTime")
    node.links.new(start.outputs[0], resample.inputs["Curve"])
    node.links.new(time.outputs["Frame"], resample.inputs["Count"])
    node.links.new(resample.outputs[0], end.inputs[0])
    tree.modifiers.new("Grow", "NODES").node_group = node
    scene.view_layers[0].use_pass_vector = scene.render.film_transparent = True
    scene.camera.data.lens = 35
    seen = []
    for frame in (20, 21):
        scene.frame_set(frame)
        bpy.ops.render.render(write_still=True)
        seen.append(read_exr(scene.render.filepath, 64, 48)[..., 3])
    assert seen[0].mean() > 0.1 and not np.array_equal(*seen)


def test_materials_and_textures_of_hair(scene, export):
    tree, principled = material("Painted")
    tree.links.new(texture_node(tree, picture()).outputs["Color"], principled.inputs["Base Color"])
    material("Plain")
    obj = furry(material=2)
    uvs = obj.data.uv_layers.new(name="Map")
    co = np.array([obj.data.vertices[loop.vertex_index].co.xy for loop in obj.data.loops], np.float32)
    uvs.uv.foreach_set("vector", (co * 0.4 + 0.5).ravel())
    for data in (bpy.data.materials["Plain"], bpy.data.materials["Painted"]):
        obj.data.materials.append(data)
    frame, warnings = export()
    mesh = hair_of(frame, "Furry")
    assert not warnings and (mesh.material_index == 1).all() and mesh.materials[1].base_colour_texture
    roots = {}
    for face, uv in zip(mesh.faces, mesh.uvs):
        assert (uv == uv[0]).all()
        roots.setdefault(tuple(uv[0]), []).append(mesh.vertices[face])
    assert len(roots) == 12
    for uv, places in roots.items():
        nearest = min(np.concatenate(places), key=lambda p: abs(np.linalg.norm(p) - 1))
        np.testing.assert_allclose((np.array(uv) - 0.5) / 0.4, nearest[:2], atol=0.12)
    fur = curves()
    fur.data.materials.append(bpy.data.materials["Painted"])
    attribute = fur.data.attributes.new("surface_uv_coordinate", "FLOAT2", "CURVE")
    attribute.data.foreach_set("vector", np.repeat(np.arange(20, dtype=np.float32) / 20, 2))
    mesh = hair_of(export()[0], "Fur")
    assert len(np.unique(mesh.uvs)) == 20
    fur.data.attributes.remove(attribute)
    fur.data.update_tag()
    bpy.context.view_layer.update()
    assert any('"Fur"' in text and "UV" in text for text in export()[1])


def test_materials_that_are_not_on_hair_are_not_told_of(scene, export):
    tree, principled = material("Skin")
    tree.links.new(add(tree, "Attribute", attribute_name="Absent"), principled.inputs["Base Color"])
    material("Hair")
    obj = furry(material=2)
    for name in ("Skin", "Hair"):
        obj.data.materials.append(bpy.data.materials[name])
    assert len(export()[1]) == 1


def test_holdouts_of_hair_are_its_own(scene, export):
    material("Skin")
    tree, _ = material("Hole")
    shaded(tree, add(tree, "Holdout"))
    obj = furry(material=2)
    for name in ("Skin", "Hole"):
        obj.data.materials.append(bpy.data.materials[name])
    frame, warnings = export()
    hair = hair_of(frame, "Furry")
    assert hair.visibility.holdout and not warnings
    assert [m.visibility.holdout for m in frame.meshes if m is not hair] == [False]


def test_hair_info_along_the_strand(scene, export):
    tree, principled = material("Ombre")
    node = tree.nodes.new("ShaderNodeHairInfo")
    tree.links.new(node.outputs["Intercept"], principled.inputs["Metallic"])
    for obj in (mesh_object("Ball", *sphere()), curves()):
        obj.data.materials.append(bpy.data.materials["Ombre"])
    frame, warnings = export()
    mesh = hair_of(frame, "Fur")
    (layer,) = mesh.layers
    assert not warnings
    # The strand bends, so that its length is not quite its height.
    np.testing.assert_allclose(layer.values[..., 0], mesh.vertices[mesh.faces, 2], atol=0.1)


def test_brushed_hair_is_brushed_along_the_strand(scene, export):
    _, principled = material("Silk")
    principled.inputs["Anisotropic"].default_value = 0.8
    obj = curves()
    obj.data.materials.append(bpy.data.materials["Silk"])
    frame, warnings = export()
    (mesh,) = frame.meshes
    (layer,) = mesh.layers
    along = layer.values[..., :3].astype(np.float64)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    steps = mesh.vertices[mesh.faces[:, 2]] - mesh.vertices[mesh.faces[:, 0]]
    cosine = np.abs((along[:, 0] * steps).sum(axis=1)) / np.linalg.norm(steps, axis=1)
    assert not warnings and mesh.materials[0].tangent == layer.name
    assert (
        np.median(cosine) > 0.99
        and np.abs(along[..., None, :] @ mesh.vertex_normals[mesh.faces][..., None]).max() < 0.2
    )


COLOURS = {
    "blond": (0.05, 0.5, lambda c: 0.7 > c[0] > c[1] > c[2] > 0.2),
    "brown": (0.3, 0.5, lambda c: 0.3 > c[0] > 1.5 * c[1] > 3 * c[2]),
    "black": (1.0, 0.5, lambda c: max(c) < 0.03),
}


@pytest.mark.parametrize("kind", COLOURS)
def test_pigment_gives_hair_its_colour(scene, export, kind):
    melanin, redness, fits = COLOURS[kind]
    tree, _ = material("Hair")
    shaded(tree, add(tree, "BsdfHairPrincipled", parametrization="MELANIN"))
    node = next(n for n in tree.nodes if n.type == "BSDF_HAIR_PRINCIPLED")
    node.inputs["Melanin"].default_value, node.inputs["Melanin Redness"].default_value = melanin, redness
    curves().data.materials.append(bpy.data.materials["Hair"])
    frame, warnings = export()
    assert len(warnings) == 1 and "a surface of its colour is used" in warnings[0]
    assert fits(frame.meshes[0].materials[0].base_colour), frame.meshes[0].materials[0].base_colour


def test_absorption_and_colour_are_one(scene, export):
    """The absorption that Cycles makes of a colour gives it back."""
    node_math = part("addon.export.node_math")
    colour, rough = np.array((0.5, 0.2, 0.05)), np.full(3, 0.3)
    absorbed = (np.log(colour) / node_math._roughness_factor(rough)) ** 2
    np.testing.assert_allclose(node_math.hair_colour(absorbed, rough), colour)
    np.testing.assert_allclose(node_math.melanin_colour(np.zeros(3), np.zeros(3), colour, rough), colour)


def test_too_much_hair_is_coarser_and_told(scene, export, monkeypatch):
    hair = part("addon.export.hair")
    curves(count=50, points=9)
    faces = []
    for most in (10**6, 4000, 3000, 100):
        monkeypatch.setattr(hair, "MOST_TRIANGLES", most)
        frame, warnings = export()
        faces.append(len(frame.meshes[0].faces))
        assert len(warnings) == (most < 10**6)
        assert all('"Fur"' in text and f"{faces[-1]:,}" in text and f"{faces[0]:,}" in text for text in warnings)
    assert faces[0] > 1.9 * faces[1] > 1.9 * faces[2] == 1.9 * faces[3] and faces[1] < 4000 and faces[2] < 3000


def stage(scene, kind: str) -> None:
    """Hair on a floor, in a sun that throws its shadow to where the camera sees it."""
    _, principled = material("Hair")
    principled.inputs["Base Color"].default_value = (0.35, 0.16, 0.06, 1)
    if kind == "curves":
        obj = curves(count=300, radius=0.012)
    else:
        obj = furry(count=40, children=8, clump_factor=0.4, kink="WAVE", kink_amplitude=0.05, root_radius=0.25)
        obj.scale, obj.location = (0.45, 0.45, 0.45), (0, 0, 0.5)
    obj.data.materials.append(bpy.data.materials["Hair"])
    floor = mesh_object("Floor", [(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], [(0, 1, 2, 3)])
    floor.data.materials.append(bpy.data.materials["Hair"].copy())
    light(scene)
    set_up(scene, 64, 64)
    scene.camera.location, scene.camera.rotation_euler = (0.3, -4, 2.4), (1.1, 0, 0.07)
    scene.camera.data.lens = 70


@pytest.mark.judged
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["curves", "particles"])
def test_hair_looks_as_in_cycles(scene, kind):
    stage(scene, kind)
    ours, theirs = pictures(scene, "DRGS"), pictures(scene, "CYCLES")
    for obj in scene.objects:
        if obj.type != "CAMERA" and obj.name not in ("Floor", "Sun"):
            obj.hide_render = True
    bald = pictures(scene, "DRGS", (1,))
    differs = np.abs(bald[0, ..., :3] - theirs[..., :3].mean(axis=0)).max(axis=-1) > 0.05
    found, without = psnr(ours, theirs), psnr(np.concatenate((bald, bald)), theirs)
    share = ours[:, differs][..., :3].mean() / theirs[:, differs][..., :3].mean()
    print(f"{kind}: {found:.1f} dB, without hair {without:.1f}, {share:.3f} of their light where hair or its shadow is")
    assert differs.mean() > 0.1 and found > 32 and found > without + 12
    assert share == pytest.approx(1, abs=0.03)


@pytest.mark.judged
@pytest.mark.slow
@pytest.mark.parametrize("melanin", [0.05, 0.2, 0.4])
def test_principled_hair_is_about_as_bright_as_in_cycles(scene, melanin):
    """A surface is no strand that light passes, but it is no other colour either."""
    stage(scene, "curves")
    random = np.random.default_rng(0)
    data = bpy.data.objects["Fur"].data
    data.add_curves([5] * 3700)
    along = np.linspace(0, 1, 5)[:, None]
    roots, lean = random.uniform(-0.6, 0.6, (4000, 1, 3)) * (1, 1, 0), random.normal(0, 0.15, (4000, 1, 3))
    places = roots + along * (0, 0, 0.4) + along**2 * lean
    data.attributes["position"].data.foreach_set("vector", places.astype(np.float32).ravel())
    data.attributes["radius"].data.foreach_set("value", np.full(20000, 0.006, np.float32))
    tree = bpy.data.materials["Hair"].node_tree
    shaded(tree, add(tree, "BsdfHairPrincipled", parametrization="MELANIN"))
    node = next(n for n in tree.nodes if n.type == "BSDF_HAIR_PRINCIPLED")
    node.inputs["Melanin"].default_value = melanin
    cycles = scene.cycles
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 8
    scene.drgs.bounces = 8
    middle = np.s_[:, 28:40, 24:40, :3]
    ours, theirs = (pictures(scene, engine)[middle].mean(axis=(0, 1, 2)) for engine in ("DRGS", "CYCLES"))
    print(f"melanin {melanin}: {ours / theirs} of their light")
    assert (np.abs(np.log(ours / theirs)[:2]) < 0.2).all()
