"""One frame after the other: composes the stages and keeps what did not change. The only state of the engine.

Usable without the process: ``Session().render(frame)`` gives the same bits as a client's ``render``.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..asset.container import read_asset
from ..asset.model import Asset, PosedSurfels
from ..deform.mesh_driven import MeshDriven
from ..errors import AssetError, Cancelled, UsageError
from ..frame import Frame, Image, Light, MeshState, ObjectState, RenderSettings, World
from ..jit import use_threads
from ..render.lights.lamps import Lamps
from ..render.lights.light import EnvironmentLight
from ..render.pipeline import render
from ..render.shade.adaptive import part_count
from ..render.trace.scene import TraceObject, TraceScene
from .objects import join, posed_surfels, traced_object
from .protocol import Passes
from .snapshots import renewed

logger = logging.getLogger(__name__)

Array = np.ndarray
OnProgress = Callable[[str, float], None]
IsCancelled = Callable[[], bool]


@dataclass(slots=True)
class _Loaded:
    """An asset, the state of the file it is mapped from, and its deformation once it was needed."""

    asset: Asset
    stamp: tuple[int, int, int]
    driven: MeshDriven | None = None

    def surfels_of(self, state: ObjectState) -> MeshDriven:
        """The deformation of the asset's surfels, made when an object first needs it."""
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


class Session:
    """Renders frames; keeps loaded assets, the trace scene, posed surfels and the light between them."""

    def __init__(self) -> None:
        self._assets: dict[str, _Loaded] = {}
        self._objects: list[_Object] = []
        self._meshes: list[MeshState] = []
        self._images: list[Image] = []
        self._scene = TraceScene()
        self._current = True
        self._world: World | None = None
        self._light: EnvironmentLight | None = None
        self._lamps = Lamps([])

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
        statistics: dict[str, float] = {}
        clock = time.perf_counter()

        def lap(stage: str) -> None:
            nonlocal clock
            now = time.perf_counter()
            statistics[f"seconds.{stage}"], clock = now - clock, now
            if cancelled is not None and cancelled():
                raise Cancelled

        _check(frame)
        use_threads(frame.settings.threads)
        if progress is not None:
            progress("Deforming", 0.0)
        posed = self._pose(frame)
        lap("deform")
        light = self._light_of(frame.world)
        lap("light")
        tell = None if progress is None else lambda part, phase: progress(phase, part)
        pictures = render(self._scene, light, posed, frame, tell, cancelled, self._lamps_of(frame.lights))
        lap("render")
        x0, y0, x1, y1 = frame.camera.window
        statistics |= {
            "seconds.total": sum(statistics.values()),
            "objects": float(len(frame.objects)),
            "triangles": float(len(self._scene.faces)),
            "surfels": float(len(posed)),
            "samples": float((x1 - x0) * (y1 - y0) * frame.settings.rays),
        }
        return Passes(pictures, self._warnings() + _unheeded(frame.settings), statistics)

    # --- objects ---------------------------------------------------------------------------------------------------

    def _pose(self, frame: Frame) -> PosedSurfels:
        """Bring the trace scene up to date; return the surfels of all objects."""
        with_surfels = frame.settings.primary == "surfels"
        objects = []
        for index, state in enumerate(frame.objects):
            loaded = self._assets.get(state.asset)
            if loaded is None:
                raise AssetError(
                    f"object {state.name}",
                    f"its asset {state.asset} is not loaded",
                    "Link the object to its file again",
                )
            _check_surface(state, loaded.asset, with_surfels)
            known = self._objects[index] if index < len(self._objects) else None
            kept = renewed(state, None if known is None else known.state)
            if known is not None and known.loaded is loaded and known.state is kept:
                item = known
            else:
                item = _Object(kept, loaded, traced_object(kept, loaded.asset))
            if with_surfels and item.posed is None:
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
        seen = [item for item in objects if item.state.visibility.camera] if with_surfels else []
        return join([item.posed for item in seen if item.posed is not None])

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
        """Blender's lights, and what they send to the middle of the scene."""
        self._lamps = Lamps([])
        if lights:
            low, high = self._scene.bvh.bounds()
            self._lamps = Lamps(lights, 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)))
        return self._lamps


def _unheeded(settings: RenderSettings) -> list[str]:
    """Settings that cannot be followed together with the others."""
    if settings.noise_threshold > 0.0 and part_count(settings) == 1:
        return [
            f"noise threshold: {settings.cosine} + {settings.ggx} + {settings.environment} rays cannot be drawn "
            f"in parts by its {settings.aa} sub-samples, so all are traced; use a multiple of 128"
        ]
    return []


def _check_surface(state: ObjectState, asset: Asset, with_surfels: bool) -> None:
    """Refuse an asset of which nothing would be seen."""
    subject = f"object {state.name}"
    if not len(asset.mesh.faces):
        raise AssetError(subject, f"the mesh of {state.asset} has no faces", "Import a file whose mesh has faces")
    if with_surfels and not len(asset.surfels):
        raise AssetError(subject, f"{state.asset} has no surfels", "Choose the mesh as primary surface")


def _check(frame: Frame) -> None:
    """Refuse what no stage would notice by itself."""
    for name, rows in (("environment rotation", frame.world.rotation), ("camera matrix", frame.camera.matrix_world)):
        if not np.isfinite(rows).all():
            raise UsageError(name, "is not finite", "Check the transform and its drivers")
    if frame.world.rotation.shape != (3, 3):
        raise UsageError("environment rotation", f"has shape {frame.world.rotation.shape}", "Give a 3 x 3 matrix")
