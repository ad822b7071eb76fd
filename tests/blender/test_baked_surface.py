"""Materials that Cycles bakes: what is on the mesh is what Cycles shows, kept by content, and nothing is silent."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from scenes import mesh_object, part, read_exr, sphere
from test_baked_world import folder, jobs  # noqa: F401 - fixtures

pytestmark = [pytest.mark.blender_api, pytest.mark.programs]
SQUARE = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]


@pytest.fixture
def bake(scene):
    """Function that exports the current scene as final pictures are; returns (frame, warnings)."""
    export = part("addon.export").export_baked
    scene.drgs.bake_texture_size = "512"

    def run():
        warnings: list[str] = []
        frame = export(bpy.context.evaluated_depsgraph_get(), str, warnings.append, lambda text, part: None)
        return frame, warnings

    return run


def material(name: str = "Odd"):
    """A material with nodes; returns (material, tree, its Principled BSDF)."""
    made = bpy.data.materials.new(name)
    if made.node_tree is None:
        made.use_nodes = True
    return made, made.node_tree, next(n for n in made.node_tree.nodes if n.type == "BSDF_PRINCIPLED")


def square(uvs=((0, 0), (1, 0), (1, 1), (0, 1))):
    """A square of two metres, seen from above by the camera, pixel by pixel."""
    obj = mesh_object("Square", SQUARE, [(0, 1, 2, 3)])
    if uvs is not None:
        obj.data.uv_layers.new().data.foreach_set("uv", np.ravel(uvs))
    scene = bpy.context.scene
    scene.camera.location, scene.camera.rotation_euler = (0, 0, 5), (0, 0, 0)
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 2
    scene.render.resolution_x = scene.render.resolution_y = 64
    return obj


def noise(tree, target, coordinates: str | None = None, scale: float = 3.0):
    """Colours of a Noise Texture as an input."""
    node = tree.nodes.new("ShaderNodeTexNoise")
    node.inputs["Scale"].default_value = scale
    if coordinates is not None:
        source = tree.nodes.new("ShaderNodeTexCoord")
        tree.links.new(source.outputs[coordinates], node.inputs["Vector"])
    tree.links.new(node.outputs["Color"], target)
    return node


def shining(obj, socket_of) -> np.ndarray:
    """(h, w, 3): the input of a material as Cycles shows it, by an Emission instead of its shader."""
    scene, made = bpy.context.scene, obj.data.materials[0]
    tree, output = made.node_tree, made.node_tree.get_output_node("ALL")
    emission, before = tree.nodes.new("ShaderNodeEmission"), output.inputs["Surface"].links[0].from_socket
    socket = socket_of
    target = emission.inputs["Strength" if socket.type == "VALUE" else "Color"]
    tree.links.new(socket.links[0].from_socket, target)
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    bpy.ops.render.render(write_still=True)
    tree.links.new(before, output.inputs["Surface"])
    tree.nodes.remove(emission)
    scene.render.engine = "DRGS"
    return read_exr(scene.render.filepath, 64, 64)[..., :3]


def texture_of(frame, state, name: str):
    """(image, uvs (m, 3, 2)) of a channel of the first material of a mesh."""
    texture = getattr(state.materials[0], f"{name}_texture")
    image = next(i for i in frame.images if i.name == texture.image)
    layer = {layer.name: layer.values for layer in state.layers}
    return image, layer[texture.layer] if texture.layer else state.uvs


def seen(frame, name: str = "base_colour") -> np.ndarray:
    """(64, 64, 3): a channel of the square as the camera sees it, by bilinear lookups."""
    (state,) = frame.meshes
    image, uvs = texture_of(frame, state, name)
    pixels = image.pixels.astype(np.float64)[..., :3]
    if image.pixels.dtype == np.uint8:
        pixels /= 255
    if image.encoding == "srgb":
        pixels = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    points = state.vertices[state.faces][..., :2].astype(np.float64)
    x = (np.arange(64) + 0.5) / 32 - 1
    places = np.stack(np.meshgrid(x, -x), axis=-1).reshape(-1, 2)
    found = np.zeros((len(places), 2))
    for corners, uv in zip(points, uvs):
        inverse = np.linalg.inv((corners[1:] - corners[0]).T)
        weights = (places - corners[0]) @ inverse.T
        inside = (weights >= -1e-9).all(axis=1) & (weights.sum(axis=1) <= 1 + 1e-9)
        found[inside] = uv[0] + weights[inside] @ (uv[1:] - uv[0])
    height, width = pixels.shape[:2]
    column, row = found[:, 0] * width - 0.5, (1 - found[:, 1]) * height - 0.5
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    a, b = (row - i)[:, None], (column - j)[:, None]

    def at(r, c):
        return pixels[np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)]

    value = (1 - a) * ((1 - b) * at(i, j) + b * at(i, j + 1)) + a * ((1 - b) * at(i + 1, j) + b * at(i + 1, j + 1))
    return value.reshape(64, 64, 3) * np.array(getattr(state.materials[0], name))


def psnr(ours: np.ndarray, theirs: np.ndarray) -> float:
    return 10 * np.log10(theirs.max() ** 2 / np.mean((ours - theirs) ** 2))


UVS = {
    "own": ((0, 0), (1, 0), (1, 1), (0, 1)),
    "none": None,
    "tiled": ((0, 0), (3, 0), (3, 3), (0, 3)),
    "one place": ((0, 0), (0, 0), (0, 0), (0, 0)),
}


@pytest.mark.parametrize("kind", UVS)
@pytest.mark.parametrize("coordinates", [None, "Object"])
def test_a_procedural_colour_is_what_cycles_shows(scene, bake, kind, coordinates):
    obj = square(UVS[kind])
    made, tree, shader = material()
    obj.data.materials.append(made)
    noise(tree, shader.inputs["Base Color"], coordinates)
    frame, warnings = bake()
    assert not warnings and psnr(seen(frame), shining(obj, shader.inputs["Base Color"])) > 40
    assert (frame.meshes[0].uvs is None) == (kind != "own"), "another map is made where the own one is of no use"


def test_vertices_that_are_nowhere_do_not_take_the_others_with_them(scene, bake):
    """A UV map is made for the mesh, with a place for every face that there is."""
    vertices, faces = sphere()
    vertices[33:44] = np.nan
    obj = mesh_object("Sphere", vertices, faces)
    made, tree, shader = material()
    obj.data.materials.append(made)
    noise(tree, shader.inputs["Base Color"], "Object")
    frame, _ = bake()
    _, uvs = texture_of(frame, frame.meshes[0], "base_colour")
    there = np.isfinite(vertices[faces]).all(axis=(1, 2))
    assert np.isfinite(uvs).all() and (np.ptp(uvs[there], axis=1) > 0).all()


def test_faces_that_overlap_get_places_of_their_own(scene, bake):
    """Two halves of a square, mirrored onto each other in the UV map."""
    obj = mesh_object("Halves", [*SQUARE, (0, -1, 0), (0, 1, 0)], [(0, 4, 5, 3), (4, 1, 2, 5)])
    uvs = [(0, 0), (1, 0), (1, 1), (0, 1), (1, 0), (0, 0), (0, 1), (1, 1)]
    obj.data.uv_layers.new().data.foreach_set("uv", np.ravel(uvs))
    bpy.data.objects.remove(square())
    made, tree, shader = material()
    obj.data.materials.append(made)
    noise(tree, shader.inputs["Base Color"])
    frame, warnings = bake()
    assert not warnings and frame.meshes[0].layers
    assert psnr(seen(frame), shining(obj, shader.inputs["Base Color"])) > 40


def test_numbers_and_what_shines_are_baked_and_the_rest_is_read(scene, bake, jobs):  # noqa: F811
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    shader.inputs["Base Color"].default_value = (0.1, 0.2, 0.3, 1)
    noise(tree, shader.inputs["Roughness"])
    noise(tree, shader.inputs["Emission Color"], scale=2)
    shader.inputs["Emission Strength"].default_value = 5
    frame, warnings = bake()
    found = frame.meshes[0].materials[0]
    assert not warnings and sorted(job["channel"] for job in jobs) == ["emission", "roughness"]
    np.testing.assert_allclose(found.base_colour, (0.1, 0.2, 0.3), rtol=1e-6)
    assert found.base_colour_texture is None and found.metallic_texture is None
    assert psnr(seen(frame, "roughness"), shining(obj, shader.inputs["Roughness"])) > 40
    assert psnr(seen(frame, "emission"), 5 * shining(obj, shader.inputs["Emission Color"])) > 40


def test_procedural_heights_are_baked(scene, bake):
    """Of each Bump node by itself, also below 0, as floats; the object may move without another bake."""
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    bumps = [tree.nodes.new("ShaderNodeBump") for _ in range(2)]
    for bump, scale in zip(bumps, (3.0, 7.0)):
        deeper = tree.nodes.new("ShaderNodeMath")
        deeper.operation, deeper.inputs[1].default_value = "SUBTRACT", 0.5
        noise(tree, deeper.inputs[0], "Generated", scale)
        tree.links.new(deeper.outputs[0], bump.inputs["Height"])
    tree.links.new(bumps[0].outputs["Normal"], bumps[1].inputs["Normal"])
    tree.links.new(bumps[1].outputs["Normal"], shader.inputs["Normal"])
    frame, warnings = bake()
    (state,) = frame.meshes
    first, second = state.materials[0].details
    assert first.kind == second.kind == "bump" and first.texture.image != second.texture.image and not warnings
    for detail, bump in zip((first, second), bumps):
        state.materials[0].base_colour_texture, state.materials[0].base_colour = detail.texture, detail.colour
        heights, expected = seen(frame), shining(obj, bump.inputs["Height"])
        low = expected.min(axis=2) <= 0  # a surface shines with nothing below
        assert heights.min() < -0.05 and 0.1 < low.mean() < 0.9
        np.testing.assert_allclose(heights[~low], expected[~low], atol=0.02)
    obj.location.x = 0.1
    again, _ = bake()
    assert [d.texture.image for d in again.meshes[0].materials[0].details] == [
        first.texture.image,
        second.texture.image,
    ]


def test_mixed_shaders_within_groups_are_baked(scene, bake):
    """A noise between a red and a blue surface, the mix in a group; half of the light of a glowing part is its own."""
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    group = bpy.data.node_groups.new("Mixed", "ShaderNodeTree")
    group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    mix, red, blue, end = (
        group.nodes.new(n)
        for n in ("ShaderNodeMixShader", "ShaderNodeBsdfDiffuse", "ShaderNodeBsdfDiffuse", "NodeGroupOutput")
    )
    red.inputs["Color"].default_value, blue.inputs["Color"].default_value = (0.8, 0.1, 0.1, 1), (0.1, 0.1, 0.9, 1)
    texture = noise(group, mix.inputs[0])
    group.links.new(texture.outputs[0], mix.inputs[0])
    group.links.new(red.outputs[0], mix.inputs[1])
    group.links.new(blue.outputs[0], mix.inputs[2])
    group.links.new(mix.outputs[0], end.inputs[0])
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    tree.links.new(node.outputs[0], tree.get_output_node("ALL").inputs["Surface"])
    frame, warnings = bake()
    assert not warnings
    found = seen(frame)
    scalar = tree.nodes.new("ShaderNodeTexNoise")
    scalar.inputs["Scale"].default_value = 3
    tree.links.new(scalar.outputs[0], shader.inputs["Roughness"])
    share = shining(obj, shader.inputs["Roughness"])
    assert psnr(found, (1 - share) * (0.8, 0.1, 0.1) + share * (0.1, 0.1, 0.9)) > 40


def lone_image(frame, texture) -> np.ndarray:
    """(64, 64): the first channel of a baked picture of the whole square, at the pixels of the camera."""
    pixels = next(i for i in frame.images if i.name == texture.image).pixels[..., 0] / 255
    size = len(pixels) // 64
    return pixels.reshape(64, size, 64, size).mean(axis=(1, 3))


@pytest.mark.parametrize("name, field", [
    ("Alpha", "alpha"), ("IOR", "ior"), pytest.param("Transmission Weight", "transmission", marks=pytest.mark.slow),
    pytest.param("Coat Weight", "coat", marks=pytest.mark.slow),
])  # fmt: skip
def test_procedural_numbers_of_all_lobes_are_baked(scene, bake, jobs, name, field):  # noqa: F811
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    texture = noise(tree, shader.inputs[name])
    stretched = tree.nodes.new("ShaderNodeMath")
    stretched.operation = "MULTIPLY"
    stretched.inputs[1].default_value = 2.4 if field == "ior" else 0.9
    tree.links.new(texture.outputs[0], stretched.inputs[0])
    tree.links.new(stretched.outputs[0], shader.inputs[name])
    frame, warnings = bake()
    found = frame.meshes[0].materials[0]
    assert not warnings and [job["channel"] for job in jobs] == [field]
    texture = found.alpha_texture if field == "alpha" else found.textures[field]
    ours = lone_image(frame, texture) * getattr(found, field)
    theirs = shining(obj, shader.inputs[name])[..., 0]
    assert psnr(ours, theirs) > 40 and theirs.std() > 0.05


def test_a_procedural_mix_with_what_is_clear_is_baked(scene, bake):
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    mix, clear = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfTransparent")
    texture = noise(tree, shader.inputs["Roughness"])
    tree.links.remove(shader.inputs["Roughness"].links[0])
    tree.links.new(texture.outputs[0], mix.inputs[0])
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(shader.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.get_output_node("ALL").inputs["Surface"])
    frame, warnings = bake()
    found = frame.meshes[0].materials[0]
    assert not warnings and found.alpha == 1 and found.base_colour_texture is None
    tree.links.new(texture.outputs[0], shader.inputs["Roughness"])
    assert psnr(lone_image(frame, found.alpha_texture), shining(obj, shader.inputs["Roughness"])[..., 0]) > 40


def test_procedural_weights_and_colours_of_parts_are_baked(scene, bake, jobs):  # noqa: F811
    """A noise between glass of another noise and a diffuse surface: each of the two, and only what it has."""
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    mix, glass, paint = (tree.nodes.new(f"ShaderNode{n}") for n in ("MixShader", "BsdfGlass", "BsdfDiffuse"))
    paint.inputs["Color"].default_value = (0.1, 0.2, 0.3, 1)
    texture = noise(tree, glass.inputs["Color"])
    tree.links.new(texture.outputs[0], mix.inputs[0])
    tree.links.new(glass.outputs[0], mix.inputs[1])
    tree.links.new(paint.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.get_output_node("ALL").inputs["Surface"])
    frame, warnings = bake()
    found = frame.meshes[0].materials[0]
    assert not warnings and sorted(job["channel"] for job in jobs) == ["base_colour", "weight", "weight"]
    first, second = found.parts
    assert (first.material.kind, second.material.kind) == ("glass", "diffuse")
    assert not first.inverted and not second.inverted
    assert second.material.base_colour == pytest.approx((0.1, 0.2, 0.3)) and not second.material.base_colour_texture
    tree.links.new(texture.outputs[0], shader.inputs["Roughness"])
    share = shining(obj, shader.inputs["Roughness"])[..., 0]
    tree.links.new(mix.outputs[0], tree.get_output_node("ALL").inputs["Surface"])
    assert psnr(lone_image(frame, first.weight_texture), 1 - share) > 40
    assert psnr(lone_image(frame, second.weight_texture), share) > 40
    frame.meshes[0].materials[0] = first.material
    assert psnr(seen(frame), shining(obj, glass.inputs["Color"])) > 40


@pytest.mark.slow
def test_results_are_kept_by_content(scene, bake, jobs):  # noqa: F811
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    texture = noise(tree, shader.inputs["Base Color"])
    image = bake()[0].images[0]
    texture.location, shader.inputs["Roughness"].default_value = (90, 10), 0.1
    obj.location.x, obj.data.vertices[0].co.z = 3, 0.0
    again = bake()[0]
    assert len(jobs) == 1 and again.images[0].pixels is image.pixels, "neither place nor another channel matters"
    obj.location.x = 0
    texture.inputs["Scale"].default_value = 5
    bake()
    assert len(jobs) == 2
    tree.links.new(tree.nodes.new("ShaderNodeNewGeometry").outputs["Position"], texture.inputs["Vector"])
    bake()
    obj.location.x = 1
    bake()
    assert len(jobs) == 4, "a place that matters does"


def test_each_material_of_a_mesh_has_its_faces(scene, bake):
    obj = mesh_object("Two", [*SQUARE, (0, -1, 0), (0, 1, 0)], [(0, 4, 5, 3), (4, 1, 2, 5)])
    bpy.data.objects.remove(square())
    for i, value in enumerate((0.2, 0.6)):
        made, tree, shader = material(f"Part {i}")
        obj.data.materials.append(made)
        checker = tree.nodes.new("ShaderNodeTexChecker")
        for socket in ("Color1", "Color2"):
            checker.inputs[socket].default_value = (value, value, value, 1)
        checker.inputs["Color2"].default_value = (value / 2, 0, 0, 1)
        checker.inputs["Scale"].default_value = 0.0
        tree.links.new(checker.outputs["Color"], shader.inputs["Base Color"])
    obj.data.polygons[1].material_index = 1
    frame, warnings = bake()
    (state,) = frame.meshes
    assert not warnings and len(state.layers) == 2
    for i, found in enumerate(state.materials):
        image = next(p for p in frame.images if p.name == found.base_colour_texture.image)
        layer = next(k for k in state.layers if k.name == found.base_colour_texture.layer).values
        places = layer[state.material_index == i].reshape(-1, 2).mean(axis=0) * 511
        assert image.pixels[511 - int(places[1]), int(places[0]), 0] in (124, 204, 89, 149), "no empty part of it"


def test_what_is_another_for_each_ray_is_named_and_not_baked(scene, bake, export, jobs):  # noqa: F811
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    weight, ramp = tree.nodes.new("ShaderNodeLayerWeight"), tree.nodes.new("ShaderNodeValToRGB")
    tree.links.new(weight.outputs["Facing"], ramp.inputs[0])
    tree.links.new(ramp.outputs[0], shader.inputs["Base Color"])
    _, warnings = bake()
    assert not jobs and warnings == export()[1] and 'node "Layer Weight"' in warnings[0]


def test_a_failed_bake_is_named_and_the_rest_is_rendered(scene, bake, export, monkeypatch):
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    noise(tree, shader.inputs["Base Color"])
    _, before = export()
    monkeypatch.setattr(part("addon.bakes.blender_process"), "command", lambda: ["/nowhere/blender"])
    frame, warnings = bake()
    assert warnings[0].startswith('Material "Odd" on "Square": its base colour cannot be baked (')
    assert (
        warnings[1:] == before and len(frame.meshes) == 1 and frame.meshes[0].materials[0].base_colour_texture is None
    )


def test_an_approximation_is_named_until_it_is_baked(scene, bake, monkeypatch):
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    noise(tree, shader.inputs["Base Color"])
    log, manager = part("addon.messages"), part("addon.bakes").manager
    with monkeypatch.context() as broken:
        broken.setattr(part("addon.bakes.blender_process"), "command", lambda: ["/nowhere/blender"])
        _, warnings = bake()
    for text in (*warnings, "another"):
        log.note("WARNING", text)
    assert len(warnings) == 2 and "Noise Texture" in warnings[1]
    manager.retry()
    assert bake()[1] == []
    assert {m.text for m in log.history}.intersection([*warnings, "another"]) == {"another"}


def test_a_message_leaves_with_the_last_bake_that_it_depends_on():
    """One material on two meshes says once how its node is approximated."""
    log, requests = part("addon.messages"), part("addon.bakes.requests")
    source = SimpleNamespace(told={}, failed={}, find=lambda key: {})
    wanted = requests.Wanted(1, 1, source)
    first, second = (SimpleNamespace(key=name, label=name) for name in ("first", "second"))
    log.note("WARNING", "plain")
    for made in (first, second):
        wanted.depends(made, "plain")
    for made, left in ((first, True), (second, False)):
        wanted.find(made)
        assert any(m.text == "plain" for m in log.history) == left


@pytest.mark.slow
def test_instances_of_what_depends_on_its_place_are_named(scene, bake):
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    texture = noise(tree, shader.inputs["Base Color"])
    other = bpy.data.objects.new("Other", obj.data)
    other.location.x = 3
    scene.collection.objects.link(other)
    assert not bake()[1]
    tree.links.new(tree.nodes.new("ShaderNodeNewGeometry").outputs["Position"], texture.inputs["Vector"])
    (warning,) = bake()[1]
    assert '"Square"' in warning and "2 instances" in warning


@pytest.mark.slow
def test_deformed_meshes_keep_their_generated_coordinates(scene, bake, jobs):  # noqa: F811
    """What sticks to the surface is baked once for all poses."""
    obj = square()
    made, tree, shader = material()
    obj.data.materials.append(made)
    noise(tree, shader.inputs["Base Color"])
    first = seen(bake()[0])
    modifier = obj.modifiers.new("Bend", "SIMPLE_DEFORM")
    modifier.deform_method, modifier.angle = "TWIST", 1.0
    frame, warnings = bake()
    assert not warnings and len(jobs) == 1
    frame.meshes[0].vertices = np.float32(SQUARE)
    np.testing.assert_allclose(seen(frame), first, atol=1e-6)
