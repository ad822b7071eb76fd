"""The scene cache: assets, posed objects and light of the last frame, kept as far as they did not change."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..compute.threads import interruptible
from ..compute.warp.posed_surfels import DevicePosedSurfels, joined
from ..core.asset.container import read_asset
from ..core.asset.model import Asset, PosedSurfels
from ..core.errors import AssetError, UsageError
from ..core.frame import Frame, MeshState, MotionStep, ObjectState, World
from ..core.materials import Image
from ..core.memory import give_back
from ..deform.gpu.mesh_driven import Deformer
from ..deform.mesh_driven import MeshDriven
from ..ipc.change_detection import reuse_equal
from ..render.backend import CPU, RenderBackend
from ..render.camera import camera_parameters
from ..render.film.motion_vectors import SceneState
from ..render.film.surfel_motion import SurfelState
from ..render.lights.environment import EnvironmentLight
from ..render.lights.light_groups import group, groups_of
from ..render.lights.light_links import link
from ..render.lights.light_sampler import Lights
from ..render.lights.mesh_lights import Emitters
from ..render.scene.trace_scene import TraceScene
from ..render.surfels.captured import CapturedObject
from ..render.surfels.surfel_bvh import SurfelBVH
from .broken_matter import BrokenMatter
from .cached_objects import CachedObject, begun, emission_of, same_matter, vertices_at
from .captured_objects import captured_faults, captured_object, shows_captured
from .carrier_cache import CarrierCache
from .level_of_detail import Budget, counts, grown, reduced
from .loaded_assets import LoadedAsset
from .optional_channels import channel_faults, may_need, surfel_emission
from .part_cache import PartCache
from .particle_surfaces import ParticleSurfaces
from .proxy_meshes import ProxyMeshes
from .repainted_assets import RepaintedAssets
from .scene_objects import check_surface, in_asset_order, join, posed_surfels
from .surfel_sheets import meets_sheets, sheet_mesh
from .surfel_states import state_at, state_now
from .surfel_trees import SurfelTree

Array = np.ndarray


class SceneCache:
    """Brings scene and light up to date with a frame.

    Attributes
    ----------
    objects : list of CachedObject
        Of the last frame.
    meshes : list of MeshState
        Of the last frame.
    images : list of Image
        Of the last frame.
    scene : TraceScene
        Scene that rays are traced in.
    tree : SurfelBVH or None
        Surfels that rays meet; None when they meet the mesh.
    seen_tree : SurfelBVH or None
        The same tree, where a panoramic camera sees the surfels by it.
    world : World, optional
        Of the last frame.
    environment : EnvironmentLight, optional
        Of the last frame.
    background : EnvironmentLight, optional
        Of the last frame, where the camera sees another world than the one that lights.
    lights : Lights
        Of the last frame.
    captured : tuple of CapturedObject
        Objects of the last frame that the camera sees in captured colours.
    emission : (n, 3) float32 array, optional
        Radiance of the surfels that the camera sees; see ``PreparedScene.emission``.
    unmeshed : SurfelState, optional
        Surfels of the last frame's objects without a mesh, as they are drawn.
    captured_faults : list of str
        What objects of the last frame lack to be shown as they should, in words for the user.
    """

    def __init__(self) -> None:
        self._assets: dict[str, LoadedAsset] = {}
        self._parts, self._repainted = PartCache(), RepaintedAssets()
        self._carriers, self._proxies, self._broken = CarrierCache(), ProxyMeshes(), BrokenMatter()
        self._skins = ParticleSurfaces()
        self.objects: list[CachedObject] = []
        self.meshes: list[MeshState] = []
        self.images: list[Image] = []
        self.scene = TraceScene()
        self.tree: SurfelBVH | None = None
        self.seen_tree: SurfelBVH | None = None
        self._trees = SurfelTree(), SurfelTree()  # of all surfels, and of fewer
        self._current = True
        self.world: World | None = None
        self.environment: EnvironmentLight | None = None
        self.background: EnvironmentLight | None = None
        self._background: World | None = None
        self.lights = Lights([])
        self.captured: tuple[CapturedObject, ...] = ()
        self.emission: Array | None = None
        self.captured_faults: list[str] = []
        self._emitters = Emitters()
        self._deformer: Deformer | None = None
        self._shown: list[CachedObject] = []  # those of the last frame, of which a budget leaves fewer surfels
        self.unmeshed: SurfelState | None = None

    @property
    def static_state(self) -> tuple[object, ...]:
        """All but the lights that a picture of the last frame depends on."""
        return *(item.state for item in self.objects), self.meshes, self.images, self.world, self._background

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
            faults: list[str] = []
            self._assets[key] = LoadedAsset(read_asset(key, faults=faults), stamp, faults=faults)
        return key

    def asset(self, key: str) -> Asset:
        """The loaded asset of `key`."""
        return self._assets[key].asset

    def known(self, frame: Frame) -> list[tuple[ObjectState, Asset]]:
        """Objects of a frame whose assets are loaded."""
        return [(state, self._assets[state.asset].asset) for state in frame.objects if state.asset in self._assets]

    def jobs_of(self, frame: Frame) -> tuple[str, ...]:
        """Jobs of `compute.manifest` that a frame needs for what its assets are."""
        given = [asset for _, asset in self.known(frame)]
        return ("lights", "mesh") if len(given) == len(frame.objects) and may_need(frame, given) else ()

    def snapshot(self, frame: Frame) -> Frame:
        """Copy of a frame that is safe from later changes of its arrays; those of the scene are copies already."""
        states = [item.state for item in self.objects]
        world = frame.world if self.world is None else self.world
        background = frame.background if self._background is None else self._background
        known = replace(frame, objects=states, meshes=self.meshes, images=self.images, world=world)
        return reuse_equal(replace(known, background=background), None)

    def pose(
        self,
        frame: Frame,
        backend: RenderBackend = CPU,
        budget: Budget | None = None,
        check: Callable[[], None] = lambda: None,
    ) -> PosedSurfels:
        """Bring the trace scene up to date; return the surfels of all objects, posed where they will be needed.

        With a `budget` these are no more than a picture can show, enlarged. What `check` raises ends it half way.
        """
        seen, met = frame.settings.camera_sees == "surfels", frame.settings.rays_see == "surfels"
        objects: list[CachedObject] = []
        faults: list[str] = []
        self._parts.begin()
        self._repainted.begin()
        states = self._proxies.carried(frame.objects, self._assets)
        self._carriers.begin(states)
        self._broken.begin(states)
        self._skins.begin(states)
        for index, state in enumerate(states):
            loaded = self._assets.get(state.asset)
            if loaded is None:
                raise AssetError(
                    f"object {state.name}",
                    f"its asset {state.asset} is not loaded",
                    "Link the object to its file again",
                )
            loaded = self._parts.loaded(loaded, state)
            loaded, state = self._repainted.loaded(loaded, state)
            skinned = state.particles is not None and state.particles.skin
            shown = not skinned and shows_captured(state, loaded.asset, frame)
            check_surface(state, loaded.asset, frame.settings, shown)
            state = in_asset_order(state, loaded.asset)
            known = self.objects[index] if index < len(self.objects) else None
            kept = reuse_equal(state, None if known is None else known.state)
            textured = loaded.asset.mesh.textures is not None and not shown and not (seen and met)
            mode = met, shown, textured, not (shown or skinned) and meets_sheets(state, loaded.asset, frame)
            if known is not None and known.loaded is loaded and known.state is kept and known.mode == mode:
                item = known
            else:
                alike = known is not None and known.loaded is loaded and same_matter(known.state, kept)
                past = known if alike else None
                with interruptible(check):
                    closed = self._broken.closed(loaded, kept) if past is None else past.closed
                    skin = self._skins.skin(loaded, kept) if past is None else past.skin
                item = begun(kept, loaded, mode, index, closed, skin)
                if known is not None and known.loaded is loaded and known.state is kept and known.mode[:2] == mode[:2]:
                    # Only how the camera sees it is another: its surfels stand where they stood.
                    item.posed, item.hidden_count, item.lost = known.posed, known.hidden_count, known.lost
                    item.emission = known.emission
            if item.sheeted:
                with interruptible(check):
                    self._place_surfels(item, index, frame, backend)
            if item.sheeted and item.sheet is None and item.posed is not None:
                item.sheet = sheet_mesh(item.state, item.posed)
            objects.append(item)
            faults += captured_faults(kept, loaded.asset, frame)
            if not shown:
                faults += channel_faults(kept, loaded.asset, item.shown, frame.settings)
        meshes, images = reuse_equal(frame.meshes, self.meshes), reuse_equal(frame.images, self.images)
        same = len(objects) == len(self.objects) and all(a is b for a, b in zip(objects, self.objects))
        if not (self._current and same and meshes is self.meshes and images is self.images):
            self._current = False  # an update that fails half way leaves nothing to be taken for current
            glowing = [item for item in objects if item.glowing is not None]
            glows = {item.state.asset: item.loaded.glow_of(item.state.asset).image for item in glowing}
            others = [*meshes, *(item.glowing for item in glowing if item.glowing is not None)]
            others += [item.sheet for item in objects if item.sheet is not None]
            others += [item.mesh for item in objects if item.mesh is not None]
            others += [part for item in objects for part in item.cracks]
            textures = {image.name: image for item in objects for image in item.images}
            layout = self.scene.layout
            self.scene.update([item.met for item in objects], others, [*images, *glows.values(), *textures.values()])
            if self.scene.layout is not layout:
                give_back()
            self._current = True
        self.objects, self.meshes, self.images, self.captured_faults = objects, meshes, images, faults
        used = {state.asset for state in frame.objects}
        for key, loaded in self._assets.items():
            if key not in used:
                loaded.forget()
        along_rays = seen and bool(frame.camera.panorama)
        self.tree = self.seen_tree = tree = None  # an update that fails half way leaves nothing to be taken for current
        if not (met or along_rays):
            self._trees = SurfelTree(), SurfelTree()
        with interruptible(check):
            objects = objects if budget is None else list(map(reduced, objects, counts(objects, budget)))
            for index, item in enumerate(objects):
                self._place_surfels(item, index, frame, backend)
            if met or along_rays:
                tree = self._trees[budget is not None].of(objects)
        self.tree, self.seen_tree = tree if met else None, tree if along_rays else None
        self._shown, self.unmeshed = objects, state_now(objects)
        visible = [item for item in objects if item.state.visibility.camera] if seen else []
        self.captured = tuple(item.captured for item in visible if item.captured is not None)
        visible = [item for item in visible if item.captured is None and not item.seen_by_mesh]
        self.emission = emission_of(objects if along_rays else visible)
        lit = [item.posed for item in visible if item.posed is not None]
        return self._joined(lit, backend)

    def as_seen(self, frame: Frame) -> Frame:
        """The frame that was posed last, as it is drawn: as of meshes where the camera sees nothing else."""
        if any(item.state.visibility.camera and not item.seen_by_mesh for item in self.objects):
            return frame
        return replace(frame, settings=replace(frame.settings, camera_sees="mesh"))

    def _place_surfels(self, item: CachedObject, index: int, frame: Frame, backend: RenderBackend) -> None:
        """Pose the surfels of an object, where they are needed, and find what they emit."""
        seen, met, loaded = frame.settings.camera_sees == "surfels", item.mode[0], item.loaded
        if not (seen or met):
            return
        driven = loaded.surfels_of(item.state)
        if item.posed is None:
            carrier = self._carriers.carrier(loaded, item.state)
            way = self._poser(backend) if item.closed is None else MeshDriven.pose
            given = item.state, index, driven, item.traced, way, carrier
            posed, item.hidden_count = posed_surfels(*given)
            item.lost = 0 if carrier is None else carrier.hidden_count
            if item.closed is not None and isinstance(driven, MeshDriven):
                self._broken.carry(loaded, item.state, driven, item.closed, posed)
            item.posed = posed if item.detail is None else grown(posed, item.detail)
        if item.mode[1]:
            item.captured = item.captured or captured_object(item.state, loaded.asset, item.posed)
        elif seen and item.emission is None and not item.seen_by_mesh:
            bound = driven if isinstance(driven, MeshDriven) else None
            item.emission = surfel_emission(item.state, loaded.asset, bound)

    def _poser(self, backend: RenderBackend) -> Callable[..., PosedSurfels]:
        """Who poses surfels: `MeshDriven.pose`, or a device as long as it can."""
        launcher = backend.launcher
        if launcher is None:
            return MeshDriven.pose
        if self._deformer is None or self._deformer.launcher is not launcher:
            self._deformer = Deformer(launcher)
        on_device = self._deformer.pose

        def pose(*given: Any, **options: Any) -> PosedSurfels:
            return backend.with_fallback(
                lambda: on_device(*given, **options), lambda: MeshDriven.pose(*given, **options)
            )

        return pose

    def _joined(self, parts: list[PosedSurfels], backend: RenderBackend) -> PosedSurfels:
        """The surfels of all objects as one, on a device if it has posed any."""
        on_cpu, launcher = functools.partial(join, parts), backend.launcher
        if launcher is None or len(parts) < 2 or not any(isinstance(part, DevicePosedSurfels) for part in parts):
            return on_cpu()
        return backend.with_fallback(lambda: joined(launcher, parts, on_cpu), on_cpu)

    def scene_state(self, frame: Frame, step: MotionStep | None) -> SceneState | None:
        """The scene at another time; None when no pass asks for it."""
        if step is None or not {"Vector", "Previous Position"}.intersection(frame.passes):
            return None
        for what, poses, shapes in (
            ("objects", step.objects, frame.objects),
            ("meshes", step.meshes, frame.meshes),
        ):
            if len(poses) != len(shapes):
                raise UsageError(
                    f"motion of {what}", f"is of {len(poses)}, the frame has {len(shapes)}", "Give one each"
                )
        moved = [None if pose is None else vertices_at(item, pose) for pose, item in zip(step.objects, self.objects)]
        others = [part for item in self.objects for part in item.meshes if part is not None]
        vertices, instances = self.scene.at(moved, [*step.meshes, *[None] * len(others)])
        parameters = camera_parameters(step.camera, frame.settings, frame.noise_index)
        surfels = state_at(self._shown, step.objects, self._assets, self._proxies, self._carriers)
        return SceneState(vertices, instances, parameters, surfels)

    def environment_of(self, world: World) -> EnvironmentLight:
        """The light of `world`, made again only when something about it changed; a rotation costs nothing."""
        kept = reuse_equal(world, self.world)
        self.environment = _light_of(kept, self.world, self.environment)
        self.world = kept
        return self.environment

    def background_of(self, world: World | None) -> EnvironmentLight | None:
        """What the camera sees of the world, as `environment_of`; None where that is what lights."""
        kept = None if world is None else reuse_equal(world, self._background)
        self.background = None if kept is None else _light_of(kept, self._background, self.background)
        self._background = kept
        return self.background

    def lights_of(self, frame: Frame) -> Lights:
        """Blender's lights and surfaces that emit, and what they send to the middle of the scene."""
        lights = frame.lights
        self._emitters = Emitters(self.scene, self._emitters)
        boxes = [self.scene.bvh.bounds()] if len(self.scene.faces) or self.tree is None else []
        boxes += [self.tree.bounds()] if self.tree is not None else []
        low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
        sphere = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        self.lights = Lights(lights, *sphere, self._emitters)
        shapes: list[ObjectState | MeshState] = [*(item.state for item in self.objects), *self.meshes]
        shapes += [item.glowing for item in self.objects if item.glowing is not None]
        shapes += [item.sheet for item in self.objects if item.sheet is not None]
        link(self.lights, lights, shapes, self.scene, sphere)
        group(self.lights, lights, shapes, frame.world.light_group, groups_of(frame.passes))
        return self.lights


def _light_of(world: World, known: World | None, light: EnvironmentLight | None) -> EnvironmentLight:
    """The light of `world`: `light`, that of `known`, where only the rotation changed."""
    if light is None or known is None:
        return EnvironmentLight(world)
    if any(getattr(world, name) is not getattr(known, name) for name in ("environment", "colour", "strength")):
        return EnvironmentLight(world)
    if world is not known:
        light.rotation = np.ascontiguousarray(world.rotation, np.float32)
    return light
