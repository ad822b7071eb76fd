"""The prepared scene: what a frame becomes before it is rendered."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.arrays import Array
from ..core.asset.model import PosedSurfels
from .film.motion_vectors import SceneState
from .film.surfel_motion import SurfelState
from .lights.environment import EnvironmentLight
from .lights.light_sampler import Lights
from .scene.trace_scene import TraceScene
from .surfels.captured import CapturedObject
from .surfels.surfel_bvh import SurfelBVH


@dataclass(slots=True)
class PreparedScene:
    """A frame's shapes, lights and surfels, brought into world space and ready for rays.

    Attributes
    ----------
    scene : TraceScene
        Scene that rays are traced in; its objects are in the order of ``frame.objects``.
    environment : EnvironmentLight
        The frame's world.
    surfels : PosedSurfels
        Surfels of all objects but the captured ones; not used where ``frame.settings.camera_sees`` is "mesh".
    lights : Lights, optional
        All lights but the environment, emitting meshes included.
    surfel_bvh : SurfelBVH, optional
        The surfels that light meets, where ``frame.settings.rays_see`` is "surfels".
    seen_surfels : SurfelBVH, optional
        The surfels that the camera sees along its rays, where it is panoramic.
    background : EnvironmentLight, optional
        What the camera sees of the world, where that differs from ``environment``.
    previous, following : SceneState, optional
        The scene one frame earlier and later, for motion vectors; None: nothing moves.
    unmeshed : SurfelState, optional
        Surfels of the objects without a mesh, for motion vectors.
    captured : tuple of CapturedObject
        Objects that the camera sees unlit, with the colours of their capture.
    emission : (n, 3) float32 array, optional
        Radiance that the surfels send to the camera, linear Rec.709: of ``surfels``, or of ``seen_surfels`` where the
        camera is panoramic; None: none emits.
    """

    scene: TraceScene
    environment: EnvironmentLight
    surfels: PosedSurfels
    lights: Lights | None = None
    surfel_bvh: SurfelBVH | None = None
    seen_surfels: SurfelBVH | None = None
    previous: SceneState | None = None
    following: SceneState | None = None
    unmeshed: SurfelState | None = None
    captured: tuple[CapturedObject, ...] = ()
    emission: Array | None = None
    background: EnvironmentLight | None = None

    @property
    def seen(self) -> EnvironmentLight:
        """The world as the camera sees it."""
        return self.environment if self.background is None else self.background
