"""Compose a Frame from camera, objects, world and settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy

from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.frame import Camera, Frame, Mist
from ...drgs_blender.core.passes import AOVS, pass_of
from .. import assets, compositing, preferences
from ..bakes.requests import Wanted
from ..property_limits import Limited
from ..view_layer_passes import enabled, not_rendered
from .camera import export_camera, picture_of
from .export_cache import ExportCache, uid
from .images import begin_export, end_export
from .instances import Key, Keys, Unrendered, Visible, uncancelled, visible
from .light_links import LightLinks
from .lights import export_light
from .materials import Materials
from .meshes import Meshes
from .motion_steps import FrameSet, add_moments
from .objects import DrgsObjects
from .world import export_world

#: Powers of the distance by the World's Falloff.
FALLOFFS = {"LINEAR": 1.0, "QUADRATIC": 2.0, "INVERSE_QUADRATIC": 0.5}
#: Colour space of everything the engine gets and gives.
WORKING_SPACE = "Linear Rec.709"


def export_frame(
    depsgraph: bpy.types.Depsgraph,
    key_of: Callable[[Path], str],
    warn: Callable[[str], None],
    *,
    camera: Camera | None = None,
    frame_set: FrameSet | None = None,
    cache: ExportCache | None = None,
    is_visible: Callable[[bpy.types.Object], bool] | None = None,
    passes: tuple[str, ...] | None = None,
    cancelled: Callable[[], bool] | None = None,
    wanted: Wanted | None = None,
) -> Frame:
    """Describe the frame that `depsgraph` was evaluated for, without its blur: see `blur_steps`.

    Parameters
    ----------
    key_of : gives the engine's key of the asset at a path
    warn : called with a message for everything that cannot be rendered as the scene has it
    camera : replaces the scene's camera
    frame_set : evaluates the scene at another frame, for passes of motion; without it nothing moves
    cache : of earlier exports of the same depsgraph
    is_visible : whether an evaluated object is in the picture; all are when None
    passes : replace those of the view layer
    cancelled : asked before each object
    wanted : collects what has to be baked for it; None: that is approximated, with warnings

    Raises
    ------
    UsageError
        There is no camera, or it cannot be rendered.
    AssetError
        From `DrgsObjects.add`.
    Cancelled
    """
    scene = depsgraph.scene_eval
    own_camera = camera is None
    if camera is None:
        if scene.camera is None:
            raise UsageError(f'Scene "{scene.name}"', "has no camera", "Add a camera, or make one active with Ctrl 0")
        camera = export_camera(scene.camera.evaluated_get(depsgraph), picture_of(scene))
        _check_features(scene, depsgraph.view_layer, warn)
    layer = depsgraph.view_layer_eval
    # As in Cycles, a view layer may replace all materials and, in later Blenders, the world.
    world = getattr(layer, "world_override", None) or scene.world
    unrendered, lights = Unrendered(), []
    cache = ExportCache() if cache is None else cache
    cache.begin(scene.frame_current)
    begin_export(scene.frame_current)
    passes = passes or tuple(p.name for p in enabled(scene, depsgraph.view_layer))
    aovs = [p for name in passes if name.startswith(AOVS) and (p := pass_of(name))]
    materials = Materials(warn, layer.material_override, aovs)
    objects, links = DrgsObjects(depsgraph, key_of, warn, cache, aovs), LightLinks(depsgraph, warn)
    meshes = Meshes(depsgraph, materials, warn, cache, links, wanted, with_uv_map="UV" in passes)
    shining: list[Key] = []
    others = Limited(depsgraph.view_layer.drgs, f'View layer "{depsgraph.view_layer.name}"', warn).others
    for item in uncancelled(visible(depsgraph), cancelled):
        if is_visible is not None and not is_visible(item.object):
            continue
        item = links.marked(item)
        if others != "SEEN" and not assets.is_drgs(item.object):
            item = _unseen(item, others)
        if item.object.type == "LIGHT":
            light = export_light(item, warn)
            if light is not None:
                shining.append(item.key)
                light = replace(light, **links.numbers_of(item))
                lights.append(light if others == "SEEN" else replace(light, camera=False))
        elif not item.is_rendered:
            unrendered.add(item.object)
        elif item.is_hair:
            meshes.add(item)
        elif assets.is_drgs(item.object):
            objects.add(item)
        else:
            meshes.add(item)
            unrendered.add(item.object)
    unrendered.report(warn)
    if materials.override is not None and objects.states:
        warn(f'View layer "{layer.name}": its Material Override is of meshes; DR-GS objects keep their own materials')
    settings = scene.drgs
    sky = cache.get(("world", uid(world)), (), lambda: export_world(world, warn, wanted))
    if wanted is not None:
        wanted.again(sky.requests)
    seen = others == "SEEN" and not scene.render.film_transparent
    group = "" if world is None else world.lightgroup
    lights += [replace(sun, camera=sun.camera and seen, light_group=group) for sun in sky.suns]
    frame = Frame(
        noise_index=scene.frame_current if settings.use_animated_seed else 0,
        camera=camera,
        objects=objects.states,
        world=replace(sky.world, light_group=group),
        background=sky.background,
        settings=settings.to_settings(scene.render.film_transparent, preferences.read("threads", 0), warn),
        passes=passes,
        meshes=meshes.states(),
        lights=lights,
        images=list(materials.images.values()),
        mist=_mist(scene.world),
    )
    if "UV" in passes and objects.states:
        warn("The pass UV is 0 on DR-GS objects: surfels have no texture coordinates")
    cache.end(end_export())
    if wanted is not None:
        wanted.end()
    cache.keys = Keys(objects.keys, meshes.keys(), shining)
    if frame_set is not None and own_camera:
        add_moments(frame, depsgraph, frame_set, objects.keys, meshes.keys(), cancelled)
    return frame


def _mist(world: bpy.types.World | None) -> Mist:
    """Limits of the pass Mist: of the scene's world, as in Cycles, also where a view layer has another."""
    if world is None:
        return Mist()
    settings = world.mist_settings
    return Mist(settings.start, settings.depth, FALLOFFS[settings.falloff])


def _unseen(item: Visible, others: str) -> Visible:
    """Another engine's object in a picture that is laid over that engine's."""
    catches = others == "CATCHER" and not item.visibility.holdout
    return replace(item, visibility=replace(item.visibility, shadow_catcher=catches, holdout=not catches))


def _check_features(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, warn: Callable[[str], None]) -> None:
    """Say which features of the scene the picture will lack.

    Raises
    ------
    UsageError
        The scene wants several views; all but one would stay black.
    """
    if scene.render.use_multiview:
        raise UsageError(
            f'Scene "{scene.name}"',
            "renders several views, of which DR-GS can render only one",
            "Disable Output > Stereoscopy",
        )
    # From Blender 5.0 on a file may choose its working space.
    space = getattr(getattr(bpy.data, "colorspace", None), "working_space", WORKING_SPACE)
    if space != WORKING_SPACE:
        warn(f"The file works in {space}; DR-GS renders {WORKING_SPACE}, so colours will differ")
    if (other := scene.drgs.background_scene) is not None:
        below = f'Scene "{other.name}"'
        if other.render.engine == compositing.ENGINE:
            warn(f"{below} is rendered by DR-GS itself now, and composited with it: press Remove Compositing")
        elif changed := compositing.differences(scene):
            warn(f"{below} has another {', '.join(changed)} now: press Set Up Compositing again")
    elif view_layer.drgs.others != "SEEN" and compositing.orphaned(scene):
        warn(
            f'Scene "{scene.name}" was laid over a scene that is deleted, and shows DR-GS objects alone. Delete it '
            "too, or set View Layer > Passes > Other Objects to Visible"
        )
    if lacking := not_rendered(view_layer):
        warn(f'View layer "{view_layer.name}": DR-GS has no pass {", ".join(lacking)}')
