"""One frame, from posed surfels and a traced scene to passes.

The picture is made in strips of rows, the light of a strip in batches of points. Both sizes only bound memory and the
time until a cancel is seen: no sample depends on them, so the passes are the same to the last bit whatever they are.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ..compute.threads import interruptible, use_threads
from ..compute.warp.posed_surfels import with_fields
from ..core.cryptomatte import KINDS
from ..core.errors import Cancelled, UsageError
from ..core.frame import Camera, Frame
from ..core.memory import give_back
from ..core.passes import BY_NAME, pass_of
from .backend import CPU, RenderBackend
from .camera import camera_parameters
from .denoise.catchers import smooth_catchers
from .denoise.demodulation import PAD
from .denoise.kept_light import to_trace
from .denoise.oidn import QUALITIES, denoise_oidn, require
from .denoise.svgf_temporal import History, NoisyPicture
from .film.cryptomatte import CryptoFilm
from .film.film import Film
from .film.light_group_film import LightGroupFilm
from .film.light_passes import LIGHT_PASSES
from .film.lobe_colours import put_lobe_colours
from .film.motion_vectors import MotionFilm, SceneState, vector_pass
from .film.object_numbers import object_numbers
from .film.surface_film import SurfaceFilm
from .gbuffer.gbuffer import GBuffer
from .gbuffer.mesh import primary_mesh
from .gbuffer.surfel_rays import SurfelRays, blend_along_rays
from .gbuffer.surfels import Stages, primary_surfels, show_captured, show_emission, snap_windows
from .gbuffer.visible_lights import visible_lights
from .integrator.adaptive import part_count, sample_adaptively
from .integrator.variance import variances
from .prepared_scene import PreparedScene
from .scene.terminator import terminators
from .shading_points import RECEIVER, UNLIT, Radiance, ShadingPoints
from .surfel_columns import ALBEDO
from .surfels import captured
from .surfels.raster import SurfelSamples
from .surfels.splats import Splats
from .surfels.surfel_bvh import SurfelBVH

Array = np.ndarray
Progress = Callable[[float, str], None]
Check = Callable[[], None]

#: Passes that can be made of pixels without light of their own.
KEPT_PASSES = frozenset({"Combined", "Depth"})
#: Memory a strip may take, and what a sub-pixel sample takes of it at most (samples, points, light).
STRIP_BYTES, SAMPLE_BYTES = 64 << 20, 326
#: Seconds a batch of points should take, how many samples (points times theirs) the first has, fewest of any.
BATCH_SECONDS, FIRST_SAMPLES, FEWEST_POINTS = 0.03, 1 << 17, 16


def render(
    prepared: PreparedScene,
    frame: Frame,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    *,
    history: History | None = None,
    backend: RenderBackend = CPU,
) -> dict[str, Array]:
    """Render the passes of a frame.

    Parameters
    ----------
    prepared : PreparedScene
        The frame's shapes and lights.
    frame : Frame
        Camera, settings and passes.
    progress : callable, optional
        Called with the part done in [0, 1] and the name of the phase.
    cancelled : callable, optional
        Called several times per second; True ends the rendering.
    history : History, optional
        Temporal history of the denoiser SVGF; brought up to date when the frame is done.
    backend : RenderBackend
        Where the kernels run.

    Returns
    -------
    dict of str to (h, w, channels) float32 array
        The passes of ``frame.passes``, of the camera's window, row 0 at the top.

    Raises
    ------
    UsageError: a camera through which nothing can be seen, an unknown pass or setting.
    Cancelled: `cancelled` said so.
    """
    settings, camera = frame.settings, frame.camera
    check_frame(frame)
    use_threads(settings.threads)
    parameters = camera_parameters(camera, settings, frame.noise_index)

    def check() -> None:
        if cancelled is not None and cancelled():
            raise Cancelled

    def report(part: float, phase: str) -> None:
        check()
        if progress is not None:
            progress(part, phase)

    report(0.0, "Projecting")
    scene, lights = prepared.scene, prepared.lights
    film, numbers = Film(camera, settings, parameters), object_numbers(scene)
    mattes = [
        CryptoFilm(kind, scene, frame)
        for kind, name in KINDS.items()
        if any(wanted.startswith(name) for wanted in frame.passes)
    ]
    surfaces = SurfaceFilm(scene, frame, parameters, put_lobe_colours)
    groups = LightGroupFilm(scene, lights, frame, parameters)
    if settings.denoise != "svgf":
        history = None
    left, top, right, bottom = camera.window
    now = SceneState(scene.vertices, scene.instances, parameters, prepared.unmeshed)
    past = None if history is None else history.scene_state
    moving = [
        None if then is None else MotionFilm((bottom - top, right - left), (left, top), now, then)
        for then in (prepared.previous, prepared.following, past)
    ]
    end = 1.0 if settings.denoise == "none" else 0.9
    kept = None
    if history is not None and history.signal is not None and history.turned and keeps_light(frame, backend):
        kept = history.signal.to_cpu()
    ages = np.zeros((bottom - top, right - left), np.uint8)

    def needed(buffer: GBuffer) -> Array | None:
        """Which points to trace, None for all; the others keep the light of the picture before."""
        if kept is None or past is None or history is None:
            return None
        if kept.light.shape[::2] != (bottom - top, right - left + 2 * PAD):
            return None
        cameras, corner = (parameters, past.parameters), (left, top, camera.width)
        before = np.zeros_like(ages) if history.ages is None else history.ages
        return to_trace(buffer, numbers.name, kept, cameras, history.pictures, corner, (before, ages))

    def draw_strips() -> None:
        """Fill the films; what this takes, the splats above all, is given back before the light is denoised."""
        with interruptible(check):
            visible = VisibleSurfaces(prepared, frame, parameters, backend)
        batches = Batches(prepared, frame, check, backend)
        height = backend.strip_factor * strip_height(right - left, settings.subpixel_count)
        for y0 in range(top, bottom, height):
            report(end * (y0 - top) / (bottom - top), "Rendering")
            y1 = min(y0 + height, bottom)
            with interruptible(check):
                buffer = visible.rows(y0, y1)
            check()
            radiance = batches.light(buffer, needed(buffer))
            film.add(buffer, radiance, numbers, prepared.seen)
            for matte in mattes:
                matte.add(buffer)
            surfaces.add(buffer)
            groups.add(buffer, radiance)
            if lights is not None and lights.seen:
                film.pixels.emission[y0 - top : y1 - top] += visible_lights(lights.tables, parameters, left, buffer)
            for motion in moving:
                if motion is not None:
                    motion.add(buffer, scene)

    draw_strips()
    give_back()
    seen = film.pixels
    motions = [None if motion is None else motion.motion(seen.position, seen.coverage) for motion in moving]
    signal = None
    if settings.denoise != "none":
        report(end, "Denoising")
    if history is None:
        components = denoised(film, frame, check, backend)
    else:
        smooth_catchers(seen.catcher, film.catchers, check)
        picture = NoisyPicture(seen.components, seen.variance, film.guides(), motions[2], history.world_turn)
        components, signal = backend.denoise_next(
            picture, history.signal, split_light(frame), history.still, check, history.turned
        )
    report(1.0, "Done")
    if history is not None:
        history.signal, history.ages = signal, None if kept is None else ages
    before, after = motions[:2]
    made = {name: values for matte in mattes for name, values in matte.passes().items()}
    made |= surfaces.passes()
    made |= groups.passes(film.seen_environment())
    made |= film.passes(
        tuple(name for name in frame.passes if name not in made),
        made,
        components,
        vector_pass(before, after, seen.coverage.shape) if "Vector" in frame.passes else None,
        None if before is None else before.previous,
    )
    return {name: made[name] for name in frame.passes}


def denoised(film: Film, frame: Frame, check: Check, backend: RenderBackend = CPU) -> Array | None:
    """(h, w, 4, 3) light without noise, None without a denoiser; that of catchers is denoised in the film itself."""
    if frame.settings.denoise != "none":
        smooth_catchers(film.pixels.catcher, film.catchers, check)
    if frame.settings.denoise in QUALITIES:
        given = film.pixels.components, film.guides(), split_light(frame), check
        return denoise_oidn(*given, frame.settings.denoise, frame.settings.threads)
    if frame.settings.denoise == "svgf":
        return backend.denoise(film.pixels.components, film.pixels.variance, film.guides(), split_light(frame), check)
    return None


def split_light(frame: Frame) -> bool:
    """Whether direct and indirect light are wanted apart."""
    return any(name in frame.passes for name in LIGHT_PASSES)


def keeps_light(frame: Frame, backend: RenderBackend = CPU) -> bool:
    """Whether pixels may keep the light of the last picture, where that is all that is asked for."""
    settings = frame.settings
    alone = settings.subpixel_count == 1 and settings.noise_threshold == 0.0 and backend.launcher is None
    return alone and KEPT_PASSES.issuperset(frame.passes)


class VisibleSurfaces:
    """The G-buffer of a frame, strip by strip."""

    def __init__(self, prepared: PreparedScene, frame: Frame, parameters: Array, backend: RenderBackend = CPU) -> None:
        self._scene, self._camera, self._parameters = prepared.scene, frame.camera, parameters
        linked = None if prepared.lights is None else prepared.lights.linked
        self._receiver: Array | None = None if linked is None else linked.receiver
        self._tree, self._objects, self._backend = prepared.surfel_bvh, len(frame.objects), backend
        self._splats: Splats | SurfelRays | None = None
        self._captured: captured.CapturedSplats | None = None
        self._glowing: Splats | SurfelRays | None = None
        self._rasterise: Callable[..., SurfelSamples] = backend.rasterise
        prepared.scene.cut.clear()
        if frame.settings.camera_sees == "surfels":
            if frame.camera.panorama:
                assert prepared.seen_surfels is not None
                self._splats = SurfelRays.of(prepared.seen_surfels, frame.camera, parameters)
                self._rasterise = blend_along_rays
            else:
                self._splats = backend.prepare(prepared.surfels, frame.camera, parameters)
            self._windows = snap_windows(prepared.scene, len(frame.objects))
            if prepared.captured:
                self._captured = captured.project(prepared.captured, frame.camera, parameters)
            if prepared.emission is not None:
                self._glowing = self._with_radiance(prepared, frame.camera, prepared.emission)

    def _with_radiance(self, prepared: PreparedScene, camera: Camera, emission: Array) -> Splats | SurfelRays:
        """The surfels that the camera sees, with the radiance that they emit in place of their albedo."""
        if isinstance(self._splats, SurfelRays):
            surface = self._splats.bvh.surface.copy()
            surface[:, ALBEDO : ALBEDO + 3] = emission
            return self._splats._replace(surface=surface)
        return self._backend.prepare(with_fields(prepared.surfels, {"albedo": emission}), camera, self._parameters)

    def rows(self, y0: int, y1: int) -> GBuffer:
        """The samples of the rows ``y0 .. y1`` of the full picture."""
        buffer = self._rows(y0, y1)
        geometry, points = self._scene.geometry, buffer.points
        if geometry.terminators:
            tied = buffer.face, buffer.instance, buffer.barycentric, points.geometric_normal
            points.terminator = terminators(*tied, geometry)
        if self._glowing is not None:
            show_emission(buffer, self._rasterise(self._glowing, y0, y1), self._camera.window[0], self._camera.width)
        if self._receiver is not None:
            sets = self._receiver[self._scene.source[buffer.object_index]]
            buffer.points.flags |= (sets << RECEIVER).astype(np.uint8)
        return buffer

    def _rows(self, y0: int, y1: int) -> GBuffer:
        backend = self._backend
        if self._splats is None:
            buffer = primary_mesh(self._scene, self._camera, self._parameters, y0, y1, backend.trace, backend.shade)
            if self._tree is not None:
                _own_surfels(buffer, self._tree, self._objects)
            return buffer
        given = self._splats, self._scene, self._windows, self._camera, y0, y1, self._tree is None
        if self._captured is None or isinstance(self._splats, SurfelRays):
            return primary_surfels(*given, Stages(self._rasterise, backend.tie, backend.trace, backend.shade))
        blended = captured.blend(self._captured, self._splats, y0, y1, backend.rasterise)
        stages = Stages(lambda *_: blended.samples, backend.tie, backend.trace, backend.shade)
        buffer = primary_surfels(*given, stages)
        show_captured(buffer, blended, self._camera.window[0], self._camera.width)
        return buffer


def strip_height(width: int, subpixels: int) -> int:
    """Rows of a strip that fit in `STRIP_BYTES`."""
    return max(1, STRIP_BYTES // (SAMPLE_BYTES * width * subpixels))


def _own_surfels(buffer: GBuffer, tree: SurfelBVH, objects: int) -> None:
    """Set ``own`` and ``size`` of points on meshes of DR-GS objects: the object, and its surfels' mean size."""
    points, owner = buffer.points, buffer.object_index
    points.own = np.where(owner < objects, owner, -1).astype(np.int32)
    points.size = np.append(tree.sizes(objects), np.float32(0.0))[points.own]


def _spread(some: Radiance, rows: Array, points: ShadingPoints) -> Radiance:
    """Light of the `rows` of `points` as that of all; the others have none."""
    out = Radiance.dark(len(points))
    out.components[rows], out.moments[rows] = some.components, some.moments
    out.variance = variances(points.pixel, out.moments)
    if some.unshadowed is not None:
        out.unshadowed = np.zeros(len(points), np.float32)
        out.unshadowed[rows] = some.unshadowed
    if some.groups is not None:
        out.groups = np.zeros((len(points), *some.groups.shape[1:]), np.float32)
        out.groups[rows] = some.groups
    if some.transmitted is not None:
        out.transmitted = np.zeros((len(points), 2, 3), np.float32)
        out.transmitted[rows] = some.transmitted
    return out


class Batches:
    """Integrates points in batches as long as `BATCH_SECONDS`, learning how many points these are."""

    def __init__(self, prepared: PreparedScene, frame: Frame, check: Check, backend: RenderBackend = CPU) -> None:
        self._prepared, self._frame, self._check, self._backend = prepared, frame, check, backend
        self._parts = part_count(frame.settings)
        self._size = max(FEWEST_POINTS, FIRST_SAMPLES * self._parts // max(1, frame.settings.sample_count))

    def light(self, buffer: GBuffer, chosen: Array | None = None) -> Radiance:
        """Light of all points of `buffer`, or of those `chosen` (n,) of them; that of the others is NaN."""
        if chosen is not None:
            rows = np.flatnonzero(chosen)
            found = _spread(self.trace(buffer.points[rows], (0, 1)), rows, buffer.points)
            found.components[~chosen] = np.nan
            return found
        if self._parts == 1:
            return self.trace(buffer.points, (0, 1))
        threshold = self._frame.settings.noise_threshold
        return sample_adaptively(buffer.points, self._frame.settings.sample_count, self._parts, threshold, self.trace)

    def trace(self, points: ShadingPoints, part: tuple[int, int]) -> Radiance:
        """Light of `points`, ordered by pixel, from one part of their samples, see `integrate`."""
        if self._prepared.captured:
            lit = np.flatnonzero(points.flags & UNLIT == 0)
            if len(lit) < len(points):
                return _spread(self.trace(points[lit], part), lit, points)
        n = len(points)
        out, prepared = Radiance.dark(n), self._prepared
        first = 0
        while first < n:
            # A pixel's points stay together: their variance is estimated together.
            last = int(np.searchsorted(points.pixel, points.pixel[min(first + self._size, n) - 1], side="right"))
            began = time.perf_counter()
            found = self._backend.integrate(
                prepared.scene,
                prepared.environment,
                points[first:last],
                self._frame.settings,
                self._frame.noise_index,
                prepared.lights,
                part,
                surfels=prepared.surfel_bvh,
            )
            out.components[first:last], out.variance[first:last] = found.components, found.variance
            out.moments[first:last] = found.moments
            if found.groups is not None:
                out.groups = np.zeros((n, *found.groups.shape[1:]), np.float32) if out.groups is None else out.groups
                out.groups[first:last] = found.groups
            if found.transmitted is not None:
                out.transmitted = np.zeros((n, 2, 3), np.float32) if out.transmitted is None else out.transmitted
                out.transmitted[first:last] = found.transmitted
            if found.unshadowed is not None:
                out.unshadowed = np.zeros(n, np.float32) if out.unshadowed is None else out.unshadowed
                out.unshadowed[first:last] = found.unshadowed
            if last - first >= self._size:
                pace = BATCH_SECONDS / max(time.perf_counter() - began, 1e-6)
                self._size = int(min(max(self._size * min(max(pace, 0.25), 4.0), FEWEST_POINTS), 1 << 20))
            first = last
            self._check()
        return out


def check_frame(frame: Frame) -> None:
    """Raise UsageError on what the stages below would misunderstand."""
    settings = frame.settings
    for name in frame.passes:
        if pass_of(name) is None:
            raise UsageError(f"pass {name!r}", "does not exist", f"Choose from {', '.join(BY_NAME)}")
    if settings.camera_sees not in ("surfels", "mesh"):
        raise UsageError("Camera Sees", f"is {settings.camera_sees!r}", "Choose surfels or mesh")
    if settings.rays_see not in ("mesh", "surfels"):
        raise UsageError("Rays See", f"is {settings.rays_see!r}", "Choose mesh or surfels")
    if settings.denoise not in ("none", "svgf", *QUALITIES):
        raise UsageError("denoiser", f"is {settings.denoise!r}", "Choose none, svgf, oidn or oidn-balanced")
    if settings.denoise in QUALITIES:
        require()  # before the work, not after it
