"""Passes of light groups: the part of Combined that lamps, meshes that emit and the world of one group make.

As in Cycles, they hold all light that belongs to the group: direct and indirect, of both lobes, what seen surfaces and
lamps emit, and the world where it is seen. They are not denoised; all groups, and the light of none, add up to the
picture before denoising.
"""

from __future__ import annotations

import numpy as np

from ...compute.threads import ROWS, over_range
from ...core.frame import Frame, MeshState, ObjectState
from ...core.passes import LIGHT_GROUP
from ..gbuffer.gbuffer import GBuffer
from ..gbuffer.visible_lights import visible_lights
from ..lights.light_groups import groups_of, lamps_alone
from ..lights.light_sampler import Lights
from ..scene.trace_scene import TraceScene
from ..shading_points import Radiance
from .surface_film import mean_of_points

Array = np.ndarray


class LightGroupFilm:
    """The passes of the light groups that a frame asks for, of the camera's window.

    Parameters
    ----------
    scene : TraceScene
    lights : Lights, optional
    frame : Frame
    parameters : array
        `camera.camera_parameters`.
    """

    def __init__(self, scene: TraceScene, lights: Lights | None, frame: Frame, parameters: Array) -> None:
        x0, y0, x1, y1 = frame.camera.window
        self._scene, self._frame, self._parameters, self._origin = scene, frame, parameters, (x0, y0)
        self._names = groups_of(frame.passes)
        self._pixels = np.zeros((y1 - y0, x1 - x0, 3 * len(self._names)), np.float32)
        of_lamp = [light.light_group for light in frame.lights]
        seen = lights if lights is not None and lights.seen else None
        self._lamps = [] if seen is None else [lamps_alone(seen, of_lamp, name) for name in self._names]

    def add(self, buffer: GBuffer, radiance: Radiance) -> None:
        """Take a strip with the light of its points."""
        if not self._names:
            return
        (x0, top), (y0, y1) = self._origin, buffer.rows
        count, rows = len(self._names), slice(y0 - top, y1 - top)
        values = np.zeros((len(buffer.points), count, 3), np.float32)
        if radiance.groups is not None:
            values += radiance.groups[:, :count]
        frame, source = self._frame, self._scene.source[buffer.object_index]
        shapes: list[ObjectState | MeshState] = [*frame.objects, *frame.meshes]
        emitted = np.array([shape.light_group for shape in shapes])
        for i, name in enumerate(self._names):
            own = np.append(emitted == name, False)[np.minimum(source, len(emitted))]
            values[own, i] += buffer.emission[own]
        given = buffer.point_rows(x0, frame.camera.width), values.reshape(len(values), 3 * count)
        over_range(mean_of_points, y1 - y0, *given, self._pixels[rows], fewest=ROWS)
        for i, tables in enumerate(self._lamps):
            self._pixels[rows, :, 3 * i : 3 * i + 3] += visible_lights(tables, self._parameters, x0, buffer)

    def passes(self, environment: Array) -> dict[str, Array]:
        """Name -> (h, w, 3) float32; `environment` is the light straight from the world."""
        found = {}
        for i, name in enumerate(self._names):
            own = self._pixels[:, :, 3 * i : 3 * i + 3]
            found[LIGHT_GROUP + name] = own + environment if self._frame.world.light_group == name else own.copy()
        return found
