"""Compose a Frame from camera, objects, world and settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from ...drgs_blender.errors import UsageError
from ...drgs_blender.frame import Camera, Frame
from .. import assets, preferences
from ..passes import enabled
from .camera import export_camera
from .images import end_export
from .instances import UNRENDERED, Unrendered, visible
from .lights import export_light
from .materials import Materials
from .meshes import Meshes
from .objects import DrgsObjects
from .world import export_world

#: Colour space of everything the engine gets and gives.
WORKING_SPACE = "Linear Rec.709"


def export_frame(
    depsgraph: bpy.types.Depsgraph,
    key_of: Callable[[Path], str],
    warn: Callable[[str], None],
    camera: Camera | None = None,
) -> Frame:
    """Describe the frame that `depsgraph` was evaluated for.

    Parameters
    ----------
    key_of : gives the engine's key of the asset at a path
    warn : told of everything that cannot be rendered as the scene has it
    camera : replaces the scene's camera

    Raises
    ------
    UsageError
        There is no camera, or it cannot be rendered.
    AssetError
        From `DrgsObjects.add`.
    """
    scene = depsgraph.scene_eval
    if camera is None:
        if scene.camera is None:
            raise UsageError(f'Scene "{scene.name}"', "has no camera", "Add a camera, or make one active with Ctrl 0")
        camera = export_camera(scene.camera.evaluated_get(depsgraph), scene.render)
        _check_features(scene, warn)
    materials, unrendered, lights = Materials(warn), Unrendered(), []
    objects, meshes = DrgsObjects(depsgraph, key_of, warn), Meshes(depsgraph, materials, warn)
    for item in visible(depsgraph):
        if item.object.type == "LIGHT":
            light = export_light(item, warn)
            if light is not None:
                lights.append(light)
        elif item.object.type in UNRENDERED:
            unrendered.add(item.object)
        elif assets.is_drgs(item.object):
            objects.add(item)
        else:
            meshes.add(item)
            unrendered.add(item.object)
    unrendered.tell(warn)
    settings = scene.drgs
    frame = Frame(
        number=scene.frame_current if settings.use_animated_seed else 0,
        camera=camera,
        objects=objects.states,
        world=export_world(scene.world, warn),
        settings=settings.to_settings(scene.render.film_transparent, preferences.read("threads", 0)),
        passes=tuple(p.name for p in enabled(depsgraph.view_layer)),
        meshes=meshes.states(),
        lights=lights,
        images=list(materials.images.values()),
    )
    end_export()
    return frame


def _check_features(scene: bpy.types.Scene, warn: Callable[[str], None]) -> None:
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
    if scene.render.use_motion_blur:
        warn("Motion blur is not rendered by DR-GS")
    if scene.camera.data.dof.use_dof:
        warn(f'Depth of field of camera "{scene.camera.name}" is not rendered by DR-GS')
