"""One frame after the other: composes the stages and keeps what did not change. The only state of the engine.

Usable without the process: ``Session().render(frame)`` gives the same bits as a client's ``render``.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..asset.container import read_asset
from ..asset.model import Asset, PosedSurfels, Surfels
from ..deform.mesh_driven import MeshDriven
from ..errors import AssetError, Cancelled, UsageError
from ..frame import Frame, Image, Light, MeshState, Moment, ObjectState, RenderSettings, World
from ..jit import use_threads
from ..render.camera import camera_parameters
from ..render.lights.emitters import Emitters
from ..render.lights.lamps import Lamps
from ..render.lights.light import EnvironmentLight
from ..render.picture.motion import Instant
from ..render.pipeline import Progress, render
from ..render.shade.adaptive import part_count
from ..render.surfels.surfel_bvh import SurfelBVH
from ..render.trace.masks import group_mask
from ..render.trace.scene import TraceObject, TraceScene
from .histories import Histories
from .objects import join, material_faults, moved_vertices, posed_surfels, traced_object
from .protocol import Passes
from .snapshots import renewed
from .view import Pace, Ready, View

logger = logging.getLogger(__name__)

Array = np.ndarray
OnProgress = Callable[[str, float], None]
IsCancelled = Callable[[], bool]

#: Views whose samples are kept.
_VIEWS = 4
#: Surfels a vertex up to which a mesh is taken for as detailed as a coarse picture.
_SURFELS_A_VERTEX = 16


@dataclass(slots=True)
class _Loaded:
    """An asset, the state of the file it is mapped from, and its deformation once it was needed."""

    asset: Asset
    stamp: tuple[int, int, int]
    driven: MeshDriven | None = None

    def surfels_of(self, state: ObjectState) -> MeshDriven | Surfels:
        """The deformation of the asset's surfels, made when an object first needs it; the surfels without a mesh."""
        if not len(self.asset.mesh.faces):
            return self.asset.surfels
        if self.driven is None:
            asset = self.asset
            if asset.binding is None:
                problem = f"the surfels of {state.asset} are not bound to its mesh"
                raise AssetError(f"object {state.name}", problem, "Bind them, or choose the mesh as primary surface")
            self.driven = MeshDriven(asset.mesh, asset.surfels, asset.binding)
        return self.driven


@dataclass(slots=True)
class _Object:
    """An object as it was in the last frame, and what was made of it."""

    state: ObjectState
    loaded: _Loaded
    traced: TraceObject
    posed: PosedSurfels | None = None
    lost: int = 0
    faults: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Placed:
    """An object of a frame as it stands in the world.

    Attributes
    ----------
    state : what the frame says of it
    mesh : as rays see it, with the frame's materials
    surfels : posed; of `asset`, one each
    """

    state: ObjectState
    asset: Asset
    mesh: TraceObject
    surfels: PosedSurfels


class _Laps:
    """Seconds a stage; between two stages a cancel is seen."""

    def __init__(self, cancelled: IsCancelled | None) -> None:
        self.seconds: dict[str, float] = {}
        self._cancelled, self._clock = cancelled, time.perf_counter()

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[f"seconds.{stage}"], self._clock = now - self._clock, now
        if self._cancelled is not None and self._cancelled():
            raise Cancelled


class Session:
    """Renders frames; keeps loaded assets, the trace scene, posed surfels and the light between them.

    A frame's picture does not depend on what was rendered before, unless it names a ``history`` to continue.
    """

    def __init__(self) -> None:
        self._assets: dict[str, _Loaded] = {}
        self._objects: list[_Object] = []
        self._meshes: list[MeshState] = []
        self._images: list[Image] = []
        self._scene = TraceScene()
        self._tree: SurfelBVH | None = None
        self._in_tree: list[_Object] = []
        self._current = True
        self._world: World | None = None
        self._light: EnvironmentLight | None = None
        self._lamps = Lamps([])
        self._lights: list[Light] = []
        self._emitters = Emitters()
        self._histories = Histories()
        self._views: dict[str, View] = {}
        self._pace = Pace()
        self._views_begun = 0

    def load_asset(self, path: str | os.PathLike[str]) -> str:
        """Map the asset file at `path` unless it is mapped and unchanged; return its key.

        The key is the resolved path: a file that was written again keeps its key and is used from the next call on.

        Raises
        ------
        AssetError, VersionError
            Naming the file.
        """
        key = os.path.realpath(path)
        try:
            status = os.stat(key)
        except OSError as error:
            reason = error.strerror or str(error)
            raise AssetError(key, f"cannot be opened ({reason})", "Check that the file is where it was") from error
        stamp = status.st_ino, status.st_mtime_ns, status.st_size
        known = self._assets.get(key)
        if known is None or known.stamp != stamp:
            self._assets[key] = _Loaded(read_asset(key), stamp)
        return key

    def asset(self, key: str) -> Asset:
        """The loaded asset of `key`."""
        return self._assets[key].asset

    def render(self, frame: Frame, progress: OnProgress | None = None, cancelled: IsCancelled | None = None) -> Passes:
        """Render one frame.

        Parameters
        ----------
        progress : called with (phase, part of the picture done in [0, 1])
        cancelled : asked between steps; True raises `Cancelled`

        Raises
        ------
        AssetError
            An object's asset is not loaded, or its mesh does not fit; names the object.
        UsageError
            A setting cannot be used.
        Cancelled
        """
        lap = _Laps(cancelled)
        ready = self._prepare(frame, lap, progress)
        tell = None if progress is None else lambda part, phase: progress(phase, part)
        passes = self._draw(frame, ready, tell, cancelled)
        lap("render")
        x0, y0, x1, y1 = frame.camera.window
        passes.statistics |= self._statistics(frame, ready[2], lap)
        passes.statistics["samples"] = float((x1 - x0) * (y1 - y0) * frame.settings.rays)
        passes.warnings = self._warnings() + _unheeded(frame.settings)
        return passes

    def place(self, frame: Frame, progress: OnProgress | None = None) -> tuple[Ready, list[Placed]]:
        """Scene, light and objects of a frame whose objects are seen as surfels, without its picture.

        Raises
        ------
        AssetError, UsageError
            As `render`.
        """
        ready = self._prepare(frame, _Laps(None), progress)
        placed = [
            Placed(item.state, item.loaded.asset, item.traced, item.posed)
            for item in self._objects
            if item.posed is not None
        ]
        return ready, placed

    def view(
        self, name: str, frame: Frame, progress: OnProgress | None = None, cancelled: IsCancelled | None = None
    ) -> Passes:
        """Begin the picture of a viewport: a first one at once, of coarse pixels where that is quicker.

        ``statistics["view.fraction"]`` is the part of the samples in it; below 1, `refine` gives the next picture.
        ``passes`` may have fewer pixels than the camera's window, which they then cover evenly.

        Raises
        ------
        AssetError, UsageError, Cancelled
            As `render`.
        """
        self._views.pop(name, None)
        lap = _Laps(cancelled)
        by_mesh = self._detailed(frame)
        rough = replace(frame, settings=replace(frame.settings, primary="mesh")) if by_mesh else frame
        ready = self._prepare(rough, lap, progress)
        view = View(self._keep(frame), self._pace, self._views_begun, by_mesh)
        self._views_begun += 1
        passes = view.begin(ready, lambda frame, ready, tell: self._draw(frame, ready, tell, cancelled))
        lap("render")
        self._views[name] = view
        while len(self._views) > _VIEWS:
            del self._views[next(iter(self._views))]
        return self._seen(view, passes, ready, lap)

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
        lap = _Laps(cancelled)
        ready = self._prepare(view.frame, lap, progress)  # other views may have changed the scene
        passes = view.advance(ready, lambda frame, ready, tell: self._draw(frame, ready, tell, cancelled), cancelled)
        lap("render")
        return self._seen(view, passes, ready, lap)

    def _seen(self, view: View, passes: Passes, ready: Ready, lap: _Laps) -> Passes:
        passes.statistics |= self._statistics(view.frame, ready[2], lap)
        passes.statistics |= {"view.fraction": view.fraction, "view.pixel": float(view.pixel)}
        passes.warnings = self._warnings()
        return passes

    def _draw(self, frame: Frame, ready: Ready, tell: Progress | None, cancelled: IsCancelled | None) -> Passes:
        """The frame's picture as a whole, part of a sequence where it names one."""
        scene, light, posed, lamps, tree = ready
        sequence, statistics = None, {}
        if frame.history and frame.settings.denoise == "svgf":
            self._lights = renewed(frame.lights, self._lights)
            scenery = *(o.state for o in self._objects), self._meshes, self._images, self._world, self._lights
            sequence = self._histories.continued(frame, scene, scenery)
            statistics["history"] = float(sequence.pictures)
        pictures = render(
            scene,
            light,
            posed,
            frame,
            tell,
            cancelled,
            lamps,
            tree,
            self._instant(frame, frame.previous),
            self._instant(frame, frame.next),
            None if sequence is None else sequence.history,
        )
        if sequence is not None:
            self._histories.keep(frame, sequence, scene)
        return Passes(pictures, [], statistics)

    def _prepare(self, frame: Frame, lap: _Laps, progress: OnProgress | None) -> Ready:
        """Bring scene and light up to date with the frame."""
        _check(frame)
        use_threads(frame.settings.threads)
        if progress is not None:
            progress("Deforming", 0.0)
        posed = self._pose(frame)
        lap("deform")
        light, lamps = self._light_of(frame.world), self._lamps_of(frame.lights)
        lap("light")
        return self._scene, light, posed, lamps, self._tree

    def _detailed(self, frame: Frame) -> bool:
        """Whether the meshes of all objects are detailed enough to stand for their surfels in coarse pictures."""
        if frame.settings.tracer != "mesh":
            return False
        assets = [self._assets[state.asset].asset for state in frame.objects if state.asset in self._assets]
        return all(len(a.surfels) <= _SURFELS_A_VERTEX * len(a.mesh.vertices) for a in assets)

    def _keep(self, frame: Frame) -> Frame:
        """The frame as it is now, whatever becomes of its arrays; those of the scene are kept already."""
        states = [item.state for item in self._objects]
        world = frame.world if self._world is None else self._world
        return renewed(replace(frame, objects=states, meshes=self._meshes, images=self._images, world=world), None)

    def _statistics(self, frame: Frame, posed: PosedSurfels, lap: _Laps) -> dict[str, float]:
        return lap.seconds | {
            "seconds.total": sum(lap.seconds.values()),
            "objects": float(len(frame.objects)),
            "triangles": float(len(self._scene.faces)),
            "surfels": float(len(posed)),
        }

    # --- objects ---------------------------------------------------------------------------------------------------

    def _pose(self, frame: Frame) -> PosedSurfels:
        """Bring the trace scene up to date; return the surfels of all objects."""
        seen, met = frame.settings.primary == "surfels", frame.settings.tracer == "surfels"
        objects = []
        for index, state in enumerate(frame.objects):
            loaded = self._assets.get(state.asset)
            if loaded is None:
                raise AssetError(
                    f"object {state.name}",
                    f"its asset {state.asset} is not loaded",
                    "Link the object to its file again",
                )
            _check_surface(state, loaded.asset, frame.settings)
            known = self._objects[index] if index < len(self._objects) else None
            kept = renewed(state, None if known is None else known.state)
            if known is not None and known.loaded is loaded and known.state is kept and known.traced.seen_only == met:
                item = known
            else:
                item = _Object(kept, loaded, traced_object(kept, loaded.asset, met), faults=material_faults(kept))
            if (seen or met) and item.posed is None:
                item.posed, item.lost = posed_surfels(item.state, index, loaded.surfels_of(item.state), item.traced)
            objects.append(item)
        meshes, images = renewed(frame.meshes, self._meshes), renewed(frame.images, self._images)
        same = len(objects) == len(self._objects) and all(a is b for a, b in zip(objects, self._objects))
        if not (self._current and same and meshes is self._meshes and images is self._images):
            self._current = False  # an update that fails half way leaves nothing to be taken for current
            self._scene.update([item.traced for item in objects], meshes, images)
            self._current = True
        self._objects, self._meshes, self._images = objects, meshes, images
        used = {state.asset for state in frame.objects}
        for key, loaded in self._assets.items():
            if key not in used:
                loaded.driven = None
        self._plant(objects if met else None)
        shown = [item for item in objects if item.state.visibility.camera] if seen else []
        return join([item.posed for item in shown if item.posed is not None])

    def _plant(self, objects: list[_Object] | None) -> None:
        """Bring the tree of surfels up to date; None when light does not meet surfels."""
        if objects is None:
            self._tree, self._in_tree = None, []
            return
        same = len(objects) == len(self._in_tree) and all(a is b for a, b in zip(objects, self._in_tree))
        if self._tree is not None and same:
            return
        self._tree, tree = None, self._tree or SurfelBVH()  # as above
        masks = [group_mask(item.state.visibility, True) for item in objects]
        tree.update(join([item.posed for item in objects if item.posed is not None]), np.array(masks, np.int32))
        self._tree, self._in_tree = tree, objects

    def _instant(self, frame: Frame, moment: Moment | None) -> Instant | None:
        """The scene at another time; None when no pass asks for it."""
        if moment is None or not {"Vector", "Previous Position"}.intersection(frame.passes):
            return None
        for what, poses, shapes in (
            ("objects", moment.objects, frame.objects),
            ("meshes", moment.meshes, frame.meshes),
        ):
            if len(poses) != len(shapes):
                raise UsageError(
                    f"motion of {what}", f"is of {len(poses)}, the frame has {len(shapes)}", "Give one each"
                )
        moved = [
            None if pose is None else moved_vertices(item.state, item.loaded.asset, pose)
            for pose, item in zip(moment.objects, self._objects)
        ]
        vertices, places = self._scene.at(moved, moment.meshes)
        return Instant(vertices, places, camera_parameters(moment.camera, frame.settings, frame.number))

    def _warnings(self) -> list[str]:
        """What the user should know about the meshes of the last frame."""
        found = []
        if not self._objects and not self._meshes:
            found.append("the frame has no DR-GS object; the picture shows the world alone")
        lost = [item.lost for item in self._objects] + [0] * len(self._meshes)
        for hidden, fault in zip(lost, self._scene.faults, strict=True):
            if fault.bad_vertices:
                surfels = f" and {hidden} surfels" if hidden else ""
                found.append(
                    f"{fault.name}: {fault.bad_vertices} vertices are not finite or too far away; "
                    f"{fault.bad_faces} faces{surfels} are left out"
                )
            if fault.empty_faces:
                found.append(f"{fault.name}: {fault.empty_faces} faces have no area; light passes through them")
            if fault.bad_places:
                found.append(
                    f"{fault.name}: {fault.bad_places} instances are flat, not finite or too far away; left out"
                )
        for item in self._objects:
            found += item.faults
        found += self._scene.materials.warnings
        found += self._lamps.warnings
        if self._light is not None and self._light.bad_texels:
            found.append(f"world: {self._light.bad_texels} texels are not finite or negative; they are black")
        return found

    # --- light -----------------------------------------------------------------------------------------------------

    def _light_of(self, world: World) -> EnvironmentLight:
        """The light of `world`, made again only when something about it changed; a rotation costs nothing."""
        known, kept = self._world, renewed(world, self._world)
        if self._light is None or known is None:
            self._light = EnvironmentLight(kept)
        elif kept is not known:
            if all(getattr(kept, name) is getattr(known, name) for name in ("environment", "colour", "strength")):
                self._light.rotation = np.ascontiguousarray(kept.rotation, np.float32)
            else:
                self._light = EnvironmentLight(kept)
        self._world = kept
        return self._light

    def _lamps_of(self, lights: list[Light]) -> Lamps:
        """Blender's lights and surfaces that emit, and what they send to the middle of the scene."""
        self._emitters = Emitters(self._scene, self._emitters)
        boxes = [self._scene.bvh.bounds()] if len(self._scene.faces) or self._tree is None else []
        boxes += [self._tree.bounds()] if self._tree is not None else []
        low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
        self._lamps = Lamps(lights, 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)), self._emitters)
        return self._lamps


def _unheeded(settings: RenderSettings) -> list[str]:
    """Settings that cannot be followed together with the others."""
    if settings.noise_threshold > 0.0 and part_count(settings) == 1:
        return [
            f"noise threshold: {settings.cosine} + {settings.ggx} + {settings.environment} rays cannot be drawn in "
            "parts, so all are traced; use more rays, or counts with a common power of two"
        ]
    return []


def _check_surface(state: ObjectState, asset: Asset, settings: RenderSettings) -> None:
    """Refuse an asset of which nothing would be seen, or that light would not meet."""
    subject, bare = f"object {state.name}", settings.primary == "mesh" or settings.tracer == "mesh"
    if bare and not len(asset.mesh.faces):
        remedy = "Choose surfels as primary surface and as tracer, or import a file whose mesh has faces"
        raise AssetError(subject, f"the mesh of {state.asset} has no faces", remedy)
    if "surfels" in (settings.primary, settings.tracer) and not len(asset.surfels):
        raise AssetError(subject, f"{state.asset} has no surfels", "Choose the mesh as primary surface and as tracer")


def _check(frame: Frame) -> None:
    """Refuse what no stage would notice by itself."""
    for name, rows in (("environment rotation", frame.world.rotation), ("camera matrix", frame.camera.matrix_world)):
        if not np.isfinite(rows).all():
            raise UsageError(name, "is not finite", "Check the transform and its drivers")
    rotation = frame.world.rotation
    if rotation.shape != (3, 3):
        raise UsageError("environment rotation", f"has shape {rotation.shape}", "Give a 3 x 3 matrix")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise UsageError("environment rotation", "scales or shears", "Give a matrix that only turns")
