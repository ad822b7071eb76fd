"""Camera rays against the meshes alone: the alternative to surfels, and what the meshes look like."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.frame import Camera
from ..camera import SUBPIXELS
from ..scene.ray_masks import CAMERA
from ..scene.trace_scene import TraceScene
from .camera_hits import shade_mesh, trace_camera
from .gbuffer import GBuffer, compact
from .layers import lone
from .mesh_hits import MeshHits

Array = np.ndarray


def primary_mesh(
    scene: TraceScene,
    camera: Camera,
    parameters: Array,
    y0: int,
    y1: int,
    trace: Callable[..., MeshHits] = trace_camera,
    shade: Callable[..., None] = shade_mesh,
) -> GBuffer:
    """Trace camera rays through the sub-pixel positions of the rows ``y0 .. y1`` (full-picture pixels).

    Normals and materials are interpolated over the face that is hit. Faces seen from behind are shown, with their
    normals turned to the viewer.

    Parameters
    ----------
    scene : TraceScene
    camera : Camera
    parameters : array
        `camera.camera_parameters`.
    y0, y1 : int
    trace, shade : callable
        Functions that cast the rays, and that find surfaces at their hits.
    """
    x0, _, x1, _ = camera.window
    hits = trace(scene, parameters, x0, y0, (y1 - y0, x1 - x0, int(parameters[SUBPIXELS])), CAMERA)
    layers = lone(hits, scene)
    buffer = compact(layers.first, parameters, x0, y0, None, scene.mesh_materials.table.detailed)
    buffer.alpha = layers.opaque
    shade(scene, hits, parameters, x0, buffer, 0)
    buffer.mark_catchers(scene.object_flags)
    return buffer
