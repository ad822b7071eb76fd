"""The session: one frame after the other, composed of the stages; keeps what did not change. The engine's only state.

Usable without the process: ``Session().render(frame)`` gives the same bits as a client's ``render``.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..compute.folders import cache_folder
from ..compute.prepare import prepare_kernels
from ..compute.threads import use_threads
from ..core.asset.model import Asset, PosedSurfels
from ..core.errors import Cancelled, UsageError
from ..core.frame import Frame, Light, MeshState, ObjectState, RenderSettings
from ..core.level_of_detail import MOST_SURFELS
from ..ipc.change_detection import reuse_equal
from ..ipc.protocol import Passes
from ..render.backend import CPU, RenderBackend, needs_paths
from ..render.gpu.select_backend import Backends
from ..render.integrator.adaptive import part_count
from ..render.pipeline import Progress, render
from ..render.prepared_scene import PreparedScene
from ..render.scene.trace_scene import TraceObject
from .denoise_history import Histories
from .kernel_jobs import jobs_of
from .level_of_detail import Budget, check_most, is_detailed, too_many
from .optional_channels import surfel_emission
from .progressive_view import Pace, Rough, View
from .scene_cache import SceneCache
from .scene_warnings import scene_warnings

logger = logging.getLogger(__name__)

Array = np.ndarray
OnProgress = Callable[[str, float], None]
IsCancelled = Callable[[], bool]

#: Views whose samples are kept.
_VIEWS = 4


@dataclass(slots=True)
class PosedObject:
    """An object of a frame as it stands in the world.

    Attributes
    ----------
    state : ObjectState
        The object's state in the frame.
    mesh : TraceObject
        As rays see it, with the frame's materials.
    surfels : PosedSurfels
        Posed; of `asset`, one each.
    channels : dict of str to array
        Optional channels of the vertices that are not neutral everywhere.
    emission : (n, 3) float32 array, optional
        Radiance of the surfels.
    """

    state: ObjectState
    asset: Asset
    mesh: TraceObject
    surfels: PosedSurfels
    channels: dict[str, Array] = field(default_factory=dict)
    emission: Array | None = None


class _StageTimer:
    """Seconds per stage; cancellation is checked between stages."""

    def __init__(self, cancelled: IsCancelled | None) -> None:
        self.seconds: dict[str, float] = {}
        self._cancelled, self._clock = cancelled, time.perf_counter()

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[f"seconds.{stage}"], self._clock = now - self._clock, now
        self.check()

    def check(self) -> None:
        """Raise `Cancelled` where that is asked for."""
        if self._cancelled is not None and self._cancelled():
            raise Cancelled


class Session:
    """Renders frames; keeps loaded assets, the trace scene, posed surfels and the light between them.

    A frame's picture does not depend on what was rendered before, unless it names a ``history`` to continue.
    """

    def __init__(self) -> None:
        self._scene_cache = SceneCache()
        self._lights: list[Light] = []
        self._histories = Histories()
        self._views: dict[str, View] = {}
        self._pace = Pace()
        self._views_begun = 0
        self._backends = Backends()

    def load_asset(self, path: str | os.PathLike[str]) -> str:
        """Map the asset file at `path`; return its key. See `SceneCache.load_asset`."""
        return self._scene_cache.load_asset(path)

    def asset(self, key: str) -> Asset:
        """The loaded asset of `key`."""
        return self._scene_cache.asset(key)

    def render(self, frame: Frame, progress: OnProgress | None = None, cancelled: IsCancelled | None = None) -> Passes:
        """Render one frame.

        Parameters
        ----------
        frame : Frame
        progress : callable, optional
            Called with (phase, part of the picture done in [0, 1]).
        cancelled : callable, optional
            Asked between steps; True raises `Cancelled`.

        Raises
        ------
        AssetError
            An object's asset is not loaded, or its mesh does not fit; names the object.
        UsageError
            A setting cannot be used.
        Cancelled

        Examples
        --------
        A square of one metre, seen from two metres above it through a lens that shows two metres:

        >>> import numpy as np
        >>> from drgs_blender.core.asset.container import write_asset
        >>> from drgs_blender.core.asset.model import Asset, Mesh
        >>> from drgs_blender.core.frame import Camera, ObjectState, RenderSettings
        >>> from drgs_blender.deform.attach import attach
        >>> corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        >>> mesh = Mesh(corners, [[0, 1, 2], [0, 2, 3]], albedo=[[0.5] * 3] * 4, roughness=[1] * 4, metallic=[0] * 4)
        >>> surfels, binding, report = attach(mesh)
        >>> write_asset("square.drgs", Asset(surfels, mesh, binding))
        >>> session = Session()
        >>> matrix = np.eye(4)
        >>> matrix[:3, 3] = 0.5, 0.5, 2
        >>> camera = Camera(matrix, width=8, height=8, fx=8, fy=8, cx=4, cy=4)
        >>> square = ObjectState("Square", asset=session.load_asset("square.drgs"))
        >>> settings = RenderSettings(samples=4, camera_sees="mesh", film_transparent=True)
        >>> passes = session.render(Frame(1, camera, [square], settings=settings, passes=("Combined", "Depth")))
        >>> passes["Combined"].shape, passes["Depth"].shape
        ((8, 8, 4), (8, 8, 1))
        >>> passes["Combined"][:, 4, 3]
        array([0., 0., 1., 1., 1., 1., 0., 0.], dtype=float32)
        >>> passes["Depth"][4, 4].round(3)
        array([2.], dtype=float32)
        """
        self._compile(frame, (), progress, cancelled)
        timer, backend = _StageTimer(cancelled), self._backends.select(frame.settings.device)
        prepared = self._prepare(frame, timer, progress, backend)
        report = None if progress is None else lambda part, phase: progress(phase, part)
        passes = self._draw(frame, prepared, report, cancelled, backend)
        timer("render")
        x0, y0, x1, y1 = frame.camera.window
        passes.statistics |= self._statistics(frame, prepared, timer)
        passes.statistics["samples"] = float((x1 - x0) * (y1 - y0) * frame.settings.sample_count)
        passes.warnings = self._warnings(frame) + _ignored_settings(frame.settings)
        return passes

    def prepare(self, frame: Frame, progress: OnProgress | None = None) -> tuple[PreparedScene, list[PosedObject]]:
        """Scene, light and objects of a frame whose objects are seen as surfels, without its picture.

        Raises
        ------
        AssetError, UsageError
            As `render`.
        """
        self._compile(frame, (), progress, None)
        prepared = self._prepare(frame, _StageTimer(None), progress)
        posed = [
            PosedObject(
                item.state,
                item.loaded.asset,
                item.traced,
                item.posed,
                item.channels,
                surfel_emission(item.state, item.loaded.asset, item.loaded.driven),
            )
            for item in self._scene_cache.objects
            if item.posed is not None
        ]
        return prepared, posed

    def view(
        self,
        name: str,
        frame: Frame,
        progress: OnProgress | None = None,
        cancelled: IsCancelled | None = None,
        most: int = MOST_SURFELS,
    ) -> Passes:
        """Begin the picture of a viewport: a first one at once, of coarse pixels where that is quicker.

        ``statistics["view.fraction"]`` is the part of the samples in it; below 1, `refine` gives the next picture.
        ``passes`` may have fewer pixels than the camera's window, which they then cover evenly. Until it has samples,
        it shows no more surfels than these pixels can and at most `most`, enlarged to cover as much, or meshes that are
        as detailed; 0 has it show all surfels from the first. ``statistics["view.surfels"]`` of ``["view.all"]`` are
        shown.

        Raises
        ------
        AssetError, UsageError, Cancelled
            As `render`.
        """
        self._views.pop(name, None)
        self._compile(frame, ("viewport",), progress, cancelled)
        timer, backend = _StageTimer(cancelled), self._backends.select(frame.settings.device)
        rough = self._rough(frame, most)
        seen, budget = rough.seen(frame, rough.pixel), rough.budget(frame, rough.pixel)
        prepared = self._prepare(seen, timer, progress, backend, budget)
        view = View(self._scene_cache.snapshot(frame), self._pace, self._views_begun, rough, backend)
        self._views_begun += 1
        passes = self._next_picture(view, prepared, timer, cancelled)
        self._views[name] = view
        while len(self._views) > _VIEWS:
            del self._views[next(iter(self._views))]
        return passes

    def refine(
        self, name: str, progress: OnProgress | None = None, cancelled: IsCancelled | None = None
    ) -> Passes | None:
        """The next picture of a view, with more samples; None where the session does not know the view.

        Raises
        ------
        AssetError, UsageError, Cancelled
            As `render`; after `Cancelled` the view is as it was.
        """
        view = self._views.get(name)
        if view is None:
            return None
        timer, rough = _StageTimer(cancelled), view.rough
        seen, budget = rough.seen(view.frame, view.coming), rough.budget(view.frame, view.coming)
        prepared = self._prepare(seen, timer, progress, view.backend, budget)  # other views may have changed the scene
        return self._next_picture(view, prepared, timer, cancelled)

    def _rough(self, frame: Frame, most: int) -> Rough:
        """How the view of a frame begins."""
        check_most(most)
        x0, y0, x1, y1 = frame.camera.window
        pixels = (x1 - x0) * (y1 - y0)
        if most == 0:
            return Rough(self._pace.size(pixels))
        given = self._scene_cache.known(frame)
        return Rough(self._pace.size(pixels), is_detailed(frame, given), most, too_many(frame, given, most))

    def _next_picture(
        self, view: View, prepared: PreparedScene, timer: _StageTimer, cancelled: IsCancelled | None
    ) -> Passes:
        def draw(frame: Frame, prepared: PreparedScene, report: Progress) -> Passes:
            return self._draw(frame, prepared, report, cancelled, view.backend)

        passes = view.advance(self._scene_cache.as_seen(view.frame), prepared, draw, cancelled)
        timer("render")
        passes.statistics |= self._statistics(view.frame, prepared, timer)
        passes.statistics |= {"view.fraction": view.fraction, "view.pixel": float(view.pixel)}
        seen = [i for i in self._scene_cache.objects if i.state.visibility.camera and not i.seen_by_mesh]
        whole = sum(len(i.loaded.asset.surfels) for i in seen) if view.frame.settings.camera_sees == "surfels" else 0
        passes.statistics |= {"view.surfels": passes.statistics["surfels"], "view.all": float(whole)}
        passes.warnings = self._warnings(view.frame)
        return passes

    def _draw(
        self,
        frame: Frame,
        prepared: PreparedScene,
        report: Progress | None,
        cancelled: IsCancelled | None,
        backend: RenderBackend,
    ) -> Passes:
        """The frame's picture as a whole, part of a sequence where it names one."""
        frame = self._scene_cache.as_seen(frame)
        sequence, statistics = None, {}
        if frame.history and frame.settings.denoise == "svgf":
            self._lights = reuse_equal(frame.lights, self._lights)
            static_state = *self._scene_cache.static_state, self._lights
            sequence = self._histories.continued(frame, prepared, static_state)
            statistics["history"] = float(sequence.pictures)
        state_at = self._scene_cache.scene_state
        prepared = replace(prepared, previous=state_at(frame, frame.previous), following=state_at(frame, frame.next))
        history = None if sequence is None else sequence.history
        pictures = render(prepared, frame, report, cancelled, history=history, backend=backend)
        if sequence is not None:
            self._histories.store(frame, sequence, prepared)
        return Passes(pictures, [], statistics)

    def _compile(
        self, frame: Frame, jobs: tuple[str, ...], progress: OnProgress | None, cancelled: IsCancelled | None
    ) -> None:
        """Have the kernels compiled that a frame and some jobs besides need."""
        prepare_kernels((*jobs_of(frame), *self._scene_cache.jobs_of(frame), *jobs), progress, cancelled)

    def _prepare(
        self,
        frame: Frame,
        timer: _StageTimer,
        progress: OnProgress | None,
        backend: RenderBackend = CPU,
        budget: Budget | None = None,
    ) -> PreparedScene:
        """Bring scene and light up to date with the frame, with no more surfels than a budget allows."""
        _check(frame)
        use_threads(frame.settings.threads)
        if progress is not None:
            progress("Deforming", 0.0)
        posed = self._scene_cache.pose(frame, backend, budget, timer.check)
        timer("deform")
        environment, lights = self._scene_cache.environment_of(frame.world), self._scene_cache.lights_of(frame)
        background = self._scene_cache.background_of(frame.background)
        timer("light")
        cache = self._scene_cache
        seen, captured = cache.seen_tree, cache.captured
        return PreparedScene(
            cache.scene, environment, posed, lights, cache.tree, seen, captured=captured, background=background,
            emission=cache.emission, unmeshed=cache.unmeshed,
        )  # fmt: skip

    def _warnings(self, frame: Frame) -> list[str]:
        settings, trouble = frame.settings, cache_folder().trouble
        lights = self._scene_cache.lights
        linked = lights.linked is not None or lights.grouped is not None
        device = self._backends.warnings(settings, linked, needs_paths(self._scene_cache.scene, settings))
        found = scene_warnings(self._scene_cache, frame.passes) + device
        return found + _ignored_lobes(settings, self._scene_cache.meshes) + ([trouble] if trouble else [])

    def _statistics(self, frame: Frame, prepared: PreparedScene, timer: _StageTimer) -> dict[str, float]:
        return timer.seconds | {
            "seconds.total": sum(timer.seconds.values()),
            "objects": float(len(frame.objects)),
            "triangles": float(len(self._scene_cache.scene.faces)),
            "surfels": float(len(prepared.surfels) + sum(len(item.rest) for item in prepared.captured)),
        }


def _ignored_lobes(settings: RenderSettings, meshes: list[MeshState]) -> list[str]:
    """Materials of which the shading model shows only a part."""
    if settings.shading_model != "paper":
        return []
    more = dict.fromkeys(m.name for mesh in meshes for m in mesh.materials if m.has_more_lobes)
    if not more:
        return []
    names = ", ".join(list(more)[:5]) + (", ..." if len(more) > 5 else "")
    return [
        f"the shading model Cook-Torrance shows a diffuse and a glossy lobe alone: coats, glass, sheen and what else "
        f"the materials {names} have is left out. Choose Principled"
    ]


def _ignored_settings(settings: RenderSettings) -> list[str]:
    """Settings that cannot be followed together with the others."""
    if settings.noise_threshold > 0.0 and part_count(settings) == 1:
        return [
            f"noise threshold: {settings.strategy_samples or settings.samples} samples cannot be drawn in parts, so "
            "all are traced; use more samples, or samples per strategy with a common power of two"
        ]
    return []


def _check(frame: Frame) -> None:
    """Refuse what no stage would notice by itself."""
    turns = [world.rotation for world in (frame.world, frame.background) if world is not None]
    for name, rows in (
        *(("environment rotation", turn) for turn in turns),
        ("camera matrix", frame.camera.matrix_world),
    ):
        if not np.isfinite(rows).all():
            raise UsageError(name, "is not finite", "Check the transform and its drivers")
    for rotation in turns:
        if rotation.shape != (3, 3):
            raise UsageError("environment rotation", f"has shape {rotation.shape}", "Give a 3 x 3 matrix")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise UsageError("environment rotation", "scales or shears", "Give a matrix that only turns")
