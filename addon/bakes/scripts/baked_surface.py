"""A channel of a material's surface on a mesh as a texture, by the mesh's UV map or one that is made for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import cycles_scene
import node_trees
import numpy as np
from mathutils import Matrix

_SAMPLES = 4
#: Numbers of which 1 is the most.
_UNIT = ("roughness", "metallic", "alpha", "anisotropy", "coat", "coat_roughness", "sheen", "sheen_roughness",
         "transmission", "diffuse_roughness")  # fmt: skip
#: Pixels by which islands are continued, of textures of 1024.
_MARGIN = 8
#: Side of the picture in which faces of a UV map are looked for that overlap, and the part of it that may.
_GRID, _SHARED = 1024, 0.002
#: Largest part of a mesh whose faces have no place in its UV map, and how far that may leave the picture.
_PLACELESS, _OUTSIDE = 0.002, 1e-4
#: Coordinates that a material has by itself, and the attribute that has them here.
_GENERATED = "drgs generated"
#: Nodes that look at Generated coordinates where nothing is linked.
_IMPLICIT = ("TEX_NOISE", "TEX_VORONOI", "TEX_WAVE", "TEX_MAGIC", "TEX_CHECKER", "TEX_BRICK", "TEX_GRADIENT",
             "TEX_GABOR", "TEX_WHITE_NOISE", "TEX_MUSGRAVE", "TEX_ENVIRONMENT", "TEX_SKY")  # fmt: skip


def bake(job: dict[str, Any]) -> None:
    """Write ``pixels`` (h, w, 4), row 0 at the top, their ``factor``, and ``uvs`` (loops, 2), empty for the mesh's own.

    Colours are bytes, encoded as sRGB, numbers are bytes, emission, shader AOVs and heights are float32. With
    ``leaves`` no other shaders count.
    """
    channel, size = job["channel"], job["size"]
    leaves = tuple(map(tuple, job["leaves"])) if "leaves" in job else None
    material = cycles_scene.load(job, "materials")
    found = cycles_scene.evaluated(material, job, node_trees.follow_channel(channel, leaves))
    scene = cycles_scene.set_up(job, _SAMPLES)
    with np.load(Path(job["folder"]) / "mesh.npz", allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    obj = _object(job, arrays, material)
    own = _usable(_uvs(obj.data), arrays) if obj.data.uv_layers.active is not None else False
    if not own:
        _unwrap(obj)
    for tree in found:
        _generated(tree)
    if alone := _input_of(channel):
        _shine_alone(material.node_tree, material.node_tree.nodes[job["output"]].inputs[alone])
    kinds = {node.type for tree in found for node in tree.nodes}

    def weight(counts: Callable[[bpy.types.Node], bool]) -> np.ndarray:
        return _baked(scene, obj, found, lambda node: float(counts(node)), size)

    pixels = _baked(scene, obj, found, lambda node: node_trees.shader_inputs(node, channel, leaves), size)
    whole = None
    if leaves is not None and channel != "weight":
        whole = weight(lambda node: node_trees.leaf_of(node) in leaves)
    elif channel in ("base_colour", "emission", "weight"):
        if "BSDF_TRANSPARENT" in kinds:
            whole = weight(lambda node: node.type != "BSDF_TRANSPARENT")
    elif not alone and channel != "alpha" and kinds.intersection(node_trees.UNSCATTERED):
        whole = weight(lambda node: node.type not in node_trees.UNSCATTERED)
    if whole is not None:
        pixels = np.divide(pixels, whole, out=np.zeros_like(pixels), where=whole > 1e-4)
    uvs = np.empty((0, 2), np.float32) if own else _uvs(obj.data)
    pixels, factor = _encoded(channel, pixels)
    cycles_scene.write(job, pixels=pixels, factor=np.array(factor), uvs=uvs)


def _input_of(channel: str) -> str:
    """The input that is baked by itself, of the job's node; "" where a channel is of the surface's shaders."""
    return "Height" if channel == "height" else channel.removeprefix("aov ") if channel.startswith("aov ") else ""


def _encoded(channel: str, pixels: np.ndarray) -> tuple[np.ndarray, float]:
    """(h, w, 4) of a channel, as `bake` writes it, and what it is to be multiplied with."""
    values = np.nan_to_num(pixels, posinf=0.0, neginf=0.0)
    if not _input_of(channel):
        values = values % 1.0 if channel == "anisotropy_rotation" else np.maximum(values, 0)
    whole = np.ones((*values.shape[:2], 4), np.float32)
    whole[..., :3] = values
    if channel == "emission" or _input_of(channel):
        return whole, 1.0
    factor = 1.0 if channel in _UNIT else max(1.0, float(values.max(initial=0.0)))
    unit = np.minimum(values / factor, 1)
    if channel in node_trees.COLOURS:
        unit = np.where(unit <= 0.0031308, 12.92 * unit, 1.055 * unit ** (1 / 2.4) - 0.055)
    whole[..., :3] = unit
    return np.rint(whole * 255).astype(np.uint8), factor


def _object(job: dict[str, Any], arrays: dict[str, np.ndarray], material: bpy.types.Material) -> bpy.types.Object:
    """The mesh as it was evaluated; the material in the first slot, on the faces that are baked."""
    mesh = bpy.data.meshes.new("Baked")
    vertices, corners, starts = arrays["vertices"], arrays["corner_vertices"], arrays["starts"]
    mesh.vertices.add(len(vertices))
    # One that is not finite would take all others' place in a UV map with it.
    mesh.vertices.foreach_set("co", np.nan_to_num(vertices, posinf=0.0, neginf=0.0).ravel())
    mesh.loops.add(len(corners))
    mesh.loops.foreach_set("vertex_index", corners)
    mesh.polygons.add(len(starts))
    mesh.polygons.foreach_set("loop_start", starts)
    mesh.update(calc_edges=True)
    mesh.materials.append(material)
    mesh.materials.append(None)
    faces = arrays["faces"]
    mesh.polygons.foreach_set("material_index", np.where(faces, 0, 1).astype(np.int32))
    mesh.polygons.foreach_set("select", faces)
    if "normals" in arrays:
        mesh.normals_split_custom_set(arrays["normals"].reshape(-1, 3))
    else:
        mesh.polygons.foreach_set("use_smooth", np.ones(len(starts), bool))
    for number, name in enumerate(job["uv_maps"]):
        layer = mesh.uv_layers.new(name=name, do_init=False)
        layer.data.foreach_set("uv", arrays[f"uv-{number}"].ravel())
        if name == job["active_uv_map"]:
            mesh.uv_layers.active, layer.active_render = layer, True
    for number, (name, kind, domain, prop) in enumerate(job["attributes"]):
        if name not in mesh.attributes:
            mesh.attributes.new(name, kind, domain).data.foreach_set(prop, arrays[f"attribute-{number}"].ravel())
    generated = mesh.attributes.new(_GENERATED, "FLOAT_VECTOR", "POINT")
    generated.data.foreach_set("vector", arrays["generated"].ravel())
    if job["active_colour"] in mesh.color_attributes:
        index = mesh.color_attributes.find(job["active_colour"])
        mesh.color_attributes.render_color_index = mesh.color_attributes.active_color_index = index
    obj = bpy.data.objects.new(job["object"]["name"], mesh)
    obj.matrix_world = Matrix(job["object"]["matrix"])
    obj.color, obj.pass_index = job["object"]["colour"], job["object"]["index"]
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    return obj


def _uvs(mesh: bpy.types.Mesh) -> np.ndarray:
    """(loops, 2) of the active UV map."""
    uvs = np.empty((len(mesh.loops), 2), np.float32)
    mesh.uv_layers.active.data.foreach_get("uv", uvs.ravel())
    return uvs


def _usable(uvs: np.ndarray, arrays: dict[str, np.ndarray]) -> bool:
    """Whether each of the faces has a place of its own in the picture of a UV map."""
    corners = arrays["triangles"]
    if len(corners) == 0 or not np.isfinite(uvs[corners]).all():
        return False
    places = uvs[corners].astype(np.float64)
    if places.min() < -_OUTSIDE or places.max() > 1 + _OUTSIDE:
        return False
    points = arrays["vertices"][arrays["corner_vertices"][corners]].astype(np.float64)
    area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
    one, two = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    flat = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    if area[flat < 1e-12].sum() > _PLACELESS * area.sum():
        return False
    count = _covered(places * _GRID)
    return bool((count > 1).sum() <= _SHARED * max(int((count > 0).sum()), 1))


def _covered(triangles: np.ndarray) -> np.ndarray:
    """(n, n) how many of (m, 3, 2) triangles cover the middle of each pixel."""
    count = np.zeros(_GRID * _GRID, np.int32)
    low = np.floor(triangles.min(axis=1)).astype(np.int64)
    extent = (np.ceil(triangles.max(axis=1)).astype(np.int64) - low).max(axis=1) + 1
    for power in range(_GRID.bit_length() + 1):
        side = 1 << power
        of_size = np.flatnonzero((extent <= side) & (extent > side // 2))
        grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(1, -1, 2)
        for chosen in np.array_split(of_size, max(1, len(of_size) * side * side // 4_000_000)):
            pixels = low[chosen][:, None] + grid
            inside = ((pixels >= 0) & (pixels < _GRID)).all(axis=2)
            signs = []
            for a, b in ((0, 1), (1, 2), (2, 0)):
                start = triangles[chosen, a][:, None]
                edge = triangles[chosen, b][:, None] - start
                away = pixels + 0.5 - start
                signs.append(edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0])
            least, most = np.minimum.reduce(signs), np.maximum.reduce(signs)
            inside &= (least > 1e-6) | (most < -1e-6)
            np.add.at(count, pixels[inside] @ np.array((1, _GRID)), 1)
    return count.reshape(_GRID, _GRID)


def _unwrap(obj: bpy.types.Object) -> None:
    """A new active UV map on which the selected faces lie apart."""
    layer = obj.data.uv_layers.new(name="drgs bake", do_init=False)
    if layer is None:
        raise RuntimeError("the mesh has as many UV maps as Blender allows; remove one")
    obj.data.uv_layers.active = layer
    bpy.context.scene.tool_settings.mesh_select_mode = (False, False, True)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.uv.smart_project(angle_limit=math.radians(66), island_margin=0.004)
    bpy.ops.object.mode_set(mode="OBJECT")


def _generated(tree: node_trees.Tree) -> None:
    """Let the nodes of a tree have the Generated coordinates of the mesh as it was before it was deformed."""
    nodes, links = tree.tree.nodes, tree.tree.links
    targets = [
        node.inputs["Vector"]
        for node in tree.nodes
        if node.type in _IMPLICIT and "Vector" in node.inputs and not node.inputs["Vector"].is_linked
    ]
    for node in tree.nodes:
        if node.type == "TEX_COORD":
            targets += [link.to_socket for link in node.outputs["Generated"].links]
    if targets:
        source = nodes.new("ShaderNodeAttribute")
        source.attribute_name = _GENERATED
        for target in targets:
            links.new(source.outputs["Vector"], target)


def _baked(scene: bpy.types.Scene, obj: bpy.types.Object, found: list[node_trees.Tree], what: Any, size: int) -> Any:
    """(h, w, 3): every shader shining with `what` it says of its node, baked; the trees are as before then."""
    undo = []
    for tree in found:
        for node in tree.nodes:
            if node_trees.is_shader(node) and not node.mute:
                undo.append(_shine(tree.tree, node, what(node)))
    image = bpy.data.images.new("Baked", size, size, float_buffer=True)
    material = obj.data.materials[0]
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    material.node_tree.nodes.active = texture
    margin = max(2, _MARGIN * size // 1024)
    bpy.ops.object.bake(type="EMIT", margin=margin, margin_type="EXTEND", use_clear=True, target="IMAGE_TEXTURES")
    pixels = np.empty((size, size, 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    material.node_tree.nodes.remove(texture)
    bpy.data.images.remove(image)
    for step in undo:
        step()
    return np.ascontiguousarray(pixels[::-1, :, :3])


def _shine_alone(tree: bpy.types.NodeTree, socket: bpy.types.NodeSocket) -> None:
    """Let the material shine with what feeds a socket."""
    emission = tree.nodes.new("ShaderNodeEmission")
    if socket.is_linked:
        tree.links.new(socket.links[0].from_socket, emission.inputs["Color"])
    output = tree.get_output_node("CYCLES") or tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs[0], output.inputs["Surface"])


def _shine(tree: bpy.types.NodeTree, node: bpy.types.Node, what: tuple[str, ...] | float) -> Any:
    """Put an Emission in the place of a shader node; return what undoes that."""
    emission = tree.nodes.new("ShaderNodeEmission")
    colour, strength = emission.inputs["Color"], emission.inputs["Strength"]
    colour.default_value, strength.default_value = (1, 1, 1, 1), 1.0
    if isinstance(what, tuple):
        for name in what:
            own = node.inputs.get(name)
            if own is None:
                own = next((s for s in node.inputs if s.type == "RGBA" and s.enabled), None)
            target = strength if own is not None and own.type == "VALUE" else colour
            if own is None:
                continue
            target.default_value = own.default_value
            if own.is_linked and not own.links[0].is_muted:
                tree.links.new(own.links[0].from_socket, target)
    else:
        strength.default_value = what
    output = next(socket for socket in node.outputs if socket.type == "SHADER")
    moved = [link.to_socket for link in output.links]
    for target in moved:
        tree.links.new(emission.outputs[0], target)

    def undo() -> None:
        for target in moved:
            tree.links.new(output, target)
        tree.nodes.remove(emission)

    return undo
