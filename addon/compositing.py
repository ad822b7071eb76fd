"""DR-GS over the picture of another engine: a second scene that shows the same things, and the nodes that join both.

The second scene is a copy that shares all collections and objects. DR-GS renders it with everything that is not its own
as shadow catchers or holdouts (`view_layer_settings.DrgsViewLayerSettings.others`), so that its picture is cut, sample
by sample, by what stands in front of it; laid over the other engine's picture it is in its place in depth. The other
engine renders no DR-GS objects: they are in a collection that is disabled in renders, but stay in its viewports.
"""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..drgs_blender.core.errors import UsageError
from . import assets

#: Label of the nodes that are made here, and engine of the second scene.
LABEL, ENGINE = "DR-GS Over", "DRGS"
#: Collections of the DR-GS objects: the one of both scenes, and one of the second scene alone.
COLLECTION, RENDERED = "DR-GS Objects", "DR-GS Rendered"
#: Metres, and part of the distance, by which a surface must be nearer to hide another of a depth pass.
NEARER = 0.001
EMPTY = 1e9


def partner_of(scene: bpy.types.Scene) -> bpy.types.Scene | None:
    """The scene that DR-GS renders for `scene`, None where it has none."""
    return next((s for s in bpy.data.scenes if s.drgs.background_scene is scene and s is not scene), None)


def bereft(scene: bpy.types.Scene) -> bool:
    """Whether the second scene of `scene` was deleted by hand: its objects are missing from the picture then."""
    tree = tree_of(scene)
    return tree is not None and any(
        node.label == LABEL and node.bl_idname == "CompositorNodeRLayers" and node.scene is None for node in tree.nodes
    )


def orphaned(scene: bpy.types.Scene) -> bool:
    """Whether `scene` is a second scene whose first one was deleted."""
    own = any(c.name.startswith(RENDERED) for c in scene.collection.children)
    return own and scene.drgs.background_scene is None


def set_up(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, others: str, compare: bool) -> bpy.types.Scene:
    """Have `scene` composited with DR-GS; what an earlier call made is made again, but its render settings are kept.

    Parameters
    ----------
    view_layer : the layer of `scene` over which DR-GS is laid
    others : "CATCHER" or "HOLDOUT", see `view_layer_settings.DrgsViewLayerSettings.others`; with "HOLDOUT" the other
        engine has the meshes of DR-GS objects throw shadows and be reflected
    compare : also hide DR-GS behind what the other engine's depth pass says is nearer

    Returns
    -------
    the second scene
    """
    old = partner_of(scene)
    collection = _gather(scene)
    partner = scene.copy()
    if old is not None:
        _copy(old.drgs, partner.drgs)
    partner.drgs.background_scene = scene
    render = partner.render
    render.engine, render.film_transparent, render.use_compositing, render.use_sequencer = ENGINE, True, False, False
    if bpy.app.version >= (5, 0, 0):
        partner.compositing_node_group = None
    else:
        partner.use_nodes = False
    for layer in list(partner.view_layers):
        if layer.name != view_layer.name:
            partner.view_layers.remove(layer)
    shown = partner.view_layers[0]
    shown.use = True
    # The nodes below read picture and depth alone; who wants mattes of DR-GS objects switches them on in the partner.
    for kind in ("object", "material"):
        name = f"use_pass_cryptomatte_{kind}"
        setattr(shown, name, old is not None and getattr(old.view_layers[0], name))
    shown.use_pass_cryptomatte_asset = False
    if old is not None:
        _copy(old.view_layers[0].drgs, shown.drgs)
        _replace(old, partner, tree_of(scene))
    partner.name = f"{scene.name} DR-GS"
    shown.drgs.others = others
    shown.use_pass_z = True
    rendered = bpy.data.collections.new(RENDERED)
    partner.collection.children.link(rendered)
    for obj in collection.objects:
        rendered.objects.link(obj)
    collection.hide_render = others == "CATCHER"
    for layer in (shown, *scene.view_layers):
        for found in _layer_collections(layer.layer_collection, collection):
            found.exclude, found.indirect_only = False, layer is not shown and others == "HOLDOUT"
    if compare:
        view_layer.use_pass_z = True
    _lay_over(scene, view_layer, partner, compare)
    return partner


def clear(scene: bpy.types.Scene) -> bool:
    """Undo `set_up`; whether there was anything. The objects stay in their collection, which is shown again."""
    partner, tree = partner_of(scene), tree_of(scene)
    found = partner is not None or bereft(scene)
    if tree is not None:
        _take_out(tree)
    for collection in _known(scene):
        collection.hide_render = False
        for view_layer in scene.view_layers:
            for layer in _layer_collections(view_layer.layer_collection, collection):
                layer.indirect_only = False
    if partner is not None:
        _remove(partner)
    return found


def differences(partner: bpy.types.Scene) -> list[str]:
    """Settings of the background scene that have changed since the partner was made, and are not shared by both."""
    below = partner.drgs.background_scene
    kinds = (
        (_drgs(below), [o for c in partner.collection.children if c.name.startswith(RENDERED) for o in c.objects]),
        (below.collection.objects, partner.collection.objects),
        (below.collection.children, partner.collection.children),
    )
    found = [f'"{item.name}"' for new, known in kinds for item in set(new).difference(known)]
    return found + [name for name in ("camera", "world") if getattr(below, name) is not getattr(partner, name)]


def tree_of(scene: bpy.types.Scene, create: bool = False) -> bpy.types.NodeTree | None:
    """The nodes that composite a scene, wherever this Blender keeps them."""
    if bpy.app.version < (5, 0, 0):
        if create:
            scene.use_nodes = True
        return scene.node_tree if scene.use_nodes else None
    if create and scene.compositing_node_group is None:
        scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
    return scene.compositing_node_group


def _gather(scene: bpy.types.Scene) -> bpy.types.Collection:
    """The collection of all DR-GS objects of a scene, which are nowhere else in it then.

    Raises
    ------
    UsageError
        One is in a collection that comes from a library.
    """
    inside = {scene.collection, *scene.collection.children_recursive}
    objects = _drgs(scene)
    for obj in objects:
        for other in obj.users_collection:
            if other in inside and other.library:
                raise UsageError(
                    f'Object "{obj.name}"',
                    f'is in the collection "{other.name}" of a library and cannot be moved to another',
                    "Choose Object > Relations > Make Local, or Library Override > Make",
                )
    known = _known(scene)
    collection = known[0] if known else bpy.data.collections.new(COLLECTION)
    if not known:
        scene.collection.children.link(collection)
    inside_already = set(collection.objects)  # by name a linked object and a local one would be the same
    for obj in objects:
        if obj not in inside_already:
            collection.objects.link(obj)
        for other in [c for c in obj.users_collection if c in inside and c is not collection]:
            other.objects.unlink(obj)
    return collection


def _copy(source: bpy.types.PropertyGroup, target: bpy.types.PropertyGroup) -> None:
    """Set all values of `target` to those of `source`."""
    for prop in source.bl_rna.properties:
        if not prop.is_readonly and prop.identifier not in ("rna_type", "name", "overlay", "background_scene"):
            setattr(target, prop.identifier, getattr(source, prop.identifier))


def _known(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Collections of DR-GS objects that were made here."""
    return [c for c in scene.collection.children_recursive if c.name.startswith(COLLECTION) and not c.library]


def _drgs(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    return [o for o in scene.objects if assets.is_drgs(o)]


def _remove(partner: bpy.types.Scene) -> None:
    """Remove a second scene and the collection that it alone has."""
    for collection in [c for c in partner.collection.children if c.name.startswith(RENDERED)]:
        bpy.data.collections.remove(collection)
    bpy.data.scenes.remove(partner)


def _replace(old: bpy.types.Scene, new: bpy.types.Scene, tree: bpy.types.NodeTree | None) -> None:
    """Remove a second scene; nodes of the artist that read it, such as mattes, read the new one."""
    for node in tree.nodes if tree is not None else ():
        if getattr(node, "scene", None) == old:
            node.scene = new
            if node.bl_idname == "CompositorNodeRLayers":
                node.layer = new.view_layers[0].name
    _remove(old)


def _layer_collections(
    root: bpy.types.LayerCollection, collection: bpy.types.Collection
) -> Iterator[bpy.types.LayerCollection]:
    """Where a view layer has a collection."""
    if root.collection is collection:
        yield root
    for child in root.children:
        yield from _layer_collections(child, collection)


# --- nodes ------------------------------------------------------------------------------------------------------------


def _lay_over(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, partner: bpy.types.Scene, compare: bool) -> None:
    """Put the partner's picture over that of a view layer, before whatever else the nodes do."""
    tree = tree_of(scene, create=True)
    assert tree is not None, "it was asked for"
    _take_out(tree)
    below = _layers(tree, scene, view_layer)
    above = _new(tree, "CompositorNodeRLayers", below.location.x, below.location.y - 420)
    above.scene, above.layer = partner, partner.view_layers[0].name
    over = _new(tree, "CompositorNodeAlphaOver", below.location.x + 560, below.location.y)
    background, foreground = [s for s in over.inputs if s.type == "RGBA"][:2]
    link = tree.links.new
    for old in list(below.outputs["Image"].links):
        target = old.to_socket
        tree.links.remove(old)
        link(over.outputs["Image"], target)
    link(below.outputs["Image"], background)
    link(above.outputs["Image"], foreground)
    if compare:
        factor = next(s for s in over.inputs if s.type == "VALUE")
        link(_nearer(tree, below.outputs["Depth"], above.outputs["Depth"]), factor)
    if not over.outputs["Image"].links:
        link(over.outputs["Image"], _result(tree, over.location.x + 260, over.location.y))


def _take_out(tree: bpy.types.NodeTree) -> None:
    """Remove the nodes made here, and have what they led to follow the picture below them."""
    for over in [n for n in tree.nodes if n.label == LABEL and n.bl_idname == "CompositorNodeAlphaOver"]:
        background = next(s for s in over.inputs if s.type == "RGBA")
        if background.links:
            source = background.links[0].from_socket
            for target in [old.to_socket for old in over.outputs["Image"].links]:
                tree.links.new(source, target)
    for node in [n for n in tree.nodes if n.label == LABEL]:
        tree.nodes.remove(node)


def _layers(tree: bpy.types.NodeTree, scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> bpy.types.Node:
    """The node of a view layer's picture, made where there is none."""
    for node in tree.nodes:
        if node.bl_idname == "CompositorNodeRLayers" and node.scene is scene and node.layer == view_layer.name:
            return node
    node = tree.nodes.new("CompositorNodeRLayers")
    node.scene, node.layer = scene, view_layer.name
    return node


def _result(tree: bpy.types.NodeTree, x: float, y: float) -> bpy.types.NodeSocket:
    """Where the picture of the tree ends, made where there is no such node."""
    kind = "CompositorNodeComposite" if bpy.app.version < (5, 0, 0) else "NodeGroupOutput"
    node = next((n for n in tree.nodes if n.bl_idname == kind), None)
    if kind == "NodeGroupOutput" and not any(i.in_out == "OUTPUT" for i in tree.interface.items_tree):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    if node is None:
        node = tree.nodes.new(kind)
        node.location = x, y
    return node.inputs[0]


def _nearer(tree: bpy.types.NodeTree, below: bpy.types.NodeSocket, above: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """1 where the picture above counts: where its depth is not behind the other's, or where it has none (shadows)."""

    def math(operation: str, first: bpy.types.NodeSocket | float, second: bpy.types.NodeSocket | float) -> object:
        kind = "CompositorNodeMath" if bpy.app.version < (5, 0, 0) else "ShaderNodeMath"
        node = _new(tree, kind, below.node.location.x + 300, below.node.location.y - 300)
        node.operation, node.hide = operation, True
        for socket, value in zip(node.inputs, (first, second)):
            if isinstance(value, bpy.types.NodeSocket):
                tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs[0]

    limit = math("ADD", math("MULTIPLY", below, 1 + NEARER), NEARER)
    hidden = math("MULTIPLY", math("GREATER_THAN", above, limit), math("LESS_THAN", above, EMPTY))
    return math("SUBTRACT", 1.0, hidden)


def _new(tree: bpy.types.NodeTree, kind: str, x: float, y: float) -> bpy.types.Node:
    node = tree.nodes.new(kind)
    node.label, node.location = LABEL, (x, y)
    return node
