"""Photographs to an asset: surfels, mesh, surfels on the mesh or bound to it, materials and light."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..build.transfer import surfels_to_vertices
from ..compute.prepare import PHASE, prepare_kernels
from ..core.arrays import Array
from ..core.asset.model import BASE_CHANNELS, Asset, Binding, Environment, Mesh, Surfels
from ..core.errors import Cancelled, WriteError, first_of
from ..core.frame import Camera
from ..deform.binding import bind
from ..deform.mesh_driven import MeshDriven
from . import checkpoint
from .backend import CPU
from .capture.capture import Capture
from .gpu.select_backend import select_backend
from .held_out import held_out_metrics, preview
from .inverse_rendering.decoupled import Decoupled
from .inverse_rendering.decoupled import Progress as MaterialProgress
from .inverse_rendering.joint import LearnedSurfels, decouple_jointly
from .inverse_rendering.run import decouple
from .inverse_rendering.surfel_tomography import blended_as, bounded
from .jit_warmup import warm_up
from .meshing.depth_fusion import MOST, fuse, grid, voxels_that_fit
from .meshing.normal_integration import blended, follow_normals, shaded_by, shaded_by_own
from .meshing.silhouette_fit import fill_silhouettes
from .meshing.surfel_normals import with_surfel_normals
from .meshing.visual_hull import Region, find_region, have_silhouettes, silhouettes
from .model.attached import attach_learned, bound
from .model.gaussians import Gaussians
from .model.thin_structures import is_thin, normals_of
from .optim.train import Training
from .settings import Settings
from .settings_table import as_tables

log = logging.getLogger(__name__)

#: Seconds between two checkpoints, and two previews.
SAVE_EVERY, SHOW_EVERY = 20.0, 5.0
#: Steps on the mesh, as a part of those before.
ON_MESH = 0.4
#: Parts of the time budget for the surfels, and for their second round on the mesh.
SURFEL_TIME_FRACTION, MESH_SURFEL_TIME_FRACTION = 0.45, 0.15
#: Part of the time budget for materials and light.
MATERIAL_TIME_FRACTION = 0.35
#: Part of the time budget in which surfels take what blends to the mesh.
BLEND_TIME_FRACTION = 0.05
#: Voxels where none are asked for and each face gets a surfel, or time decides.
FEW_VOXELS = 256
#: Fewer views than this leave the shape open between them.
FEW_VIEWS = 5
#: Fewer steps of materials than this separate them poorly from the light.
FEW_STEPS = 300
#: Fewer steps of surfels than this leave their shape rough.
FEW_SURFEL_STEPS = 400
#: Phase -> the settings that decide its result.
CHECKPOINT_SETTINGS = {
    "surfels": ("schedule", "minutes"),
    "surfels on the mesh": ("schedule", "minutes", "mesh_resolution", "fixed"),
}
#: Part of a run's progress in which materials are learned; what is left goes by as surfels take what blends to them.
_LEARNING = 0.27
#: Fainter surfels do not come into the asset.
UNSEEN = 0.05


@dataclass(slots=True)
class Progress:
    """Progress of a reconstruction.

    Attributes
    ----------
    phase : str
        "Preparing the engine (first time only)", "surfels", "mesh", "surfels on the mesh", "materials".
    part : float
        Fraction that is done, 0..1.
    surfels : int
        How many there are.
    psnr : float, optional
        Of the latest training views, decibels; None: not known.
    picture : (h, w, 3) float32 array, optional
        sRGB: a view as it looks now, beside its photograph; None: not drawn this time.
    """

    phase: str
    part: float
    surfels: int = 0
    psnr: float | None = None
    picture: Array | None = None


def reconstruct(
    capture: Capture,
    settings: Settings | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    folder: Path | None = None,
) -> Asset:
    """Make an asset from photographs.

    Parameters
    ----------
    capture : Capture
    settings : Settings, optional
    on_progress : callable, optional
        Called about every second, with a picture every few seconds.
    cancelled : callable, optional
        Asked between steps; a checkpoint is left and Cancelled raised.
    folder : Path, optional
        Of checkpoints; a run that was stopped goes on from there, bit for bit unless `minutes` are given.

    Returns
    -------
    Asset
        In the capture's world space. ``provenance["report"]`` holds counts, "psnr" and "ssim" of the views left out,
        "steps" (of each phase those done, and those of its schedule, fewer where ``minutes`` end it);
        ``provenance["learned_from"]`` the names of the others, ``provenance["settings"]`` all settings.

    Raises
    ------
    UsageError
        Settings out of range.
    UsageError, AssetError: what cannot be reconstructed, see `visual_hull.find_region`, `training_views.targets` and
        `depth_fusion.fuse`.
    """
    settings = settings or Settings()
    settings.check()
    if idle := settings.without_effect():
        log.warning("%s: no effect with the other settings", first_of(idle))
    region = find_region(capture)
    if (count := len(capture.training)) < FEW_VIEWS:
        log.warning("%s: only %d views, too few for shape, materials and light. Take 30", capture.source, count)
    voxels = _voxels(settings, [view.camera for view in capture.training], region)
    settings = replace(settings, mesh_resolution=voxels)  # for the asset, and a run that goes on with other memory
    work = _Work(capture, settings, on_progress or (lambda _: None), cancelled or (lambda: False), folder)
    prepare_kernels(("reconstruct",), lambda phase, part: work.on_progress(Progress(phase, part)), work.cancelled)
    if settings.minutes is not None:
        work.on_progress(Progress(PHASE, 0.0))
        warm_up(settings, have_silhouettes(capture), work.backend, work.cancelled)
    training = Training(
        capture, region, settings.schedule, seconds=work.seconds(SURFEL_TIME_FRACTION), backend=work.backend
    )
    free = work.learn("surfels", training, 0.0, 0.5)
    del training  # and the photographs that it keeps in memory
    work.on_progress(Progress("mesh", 0.5, len(free)))
    report: dict[str, Any] = {"views": len(capture.training), "left_out": len(capture.testing), "steps": work.steps}
    report["turned"] = capture.turned
    mesh, report["mesh"] = mesh_of(free, capture, region, voxels)
    final: Gaussians = free
    binding: Binding | None = None
    if settings.variant == "m":
        final, binding = _on_mesh(work, mesh, free, region, report)
    found, own = None, None
    if settings.materials:
        # Surfels on the mesh have its normals.
        report["thin"] = settings.variant == "p" and is_thin(final, mesh, capture.training)
        fused = functools.partial(mesh_of, capture=capture, region=region, resolution=voxels)
        found = _decoupled(work, mesh, LearnedSurfels(final, settings.schedule, region.radius, fused), report)
        if (own := found.surfels) is not None and own.mesh is not None:
            mesh, final, report["mesh"] = own.mesh, own.gaussians, own.fusion
    report |= held_out_metrics(final, capture)
    visible = final.opacities().detach().numpy() >= UNSEEN
    surfels = _visible_surfels(final, visible)
    if found is not None:
        mesh = replace(mesh, albedo=found.albedo, roughness=found.roughness, metallic=found.metallic)
        if settings.decoupling.normals and found.normals is not None:
            mesh.vertices = follow_normals(mesh, found.normals)
    if binding is None:
        binding, report["binding"] = bind(mesh, surfels)
    else:
        binding = _rows(binding, visible)
        surfels.centre = MeshDriven(mesh, surfels, binding).pose(mesh.vertices).centre
    environment, origin = None, "photographed colour, light included"
    if found is None:
        report["vertices_without_surfels"] = surfels_to_vertices(mesh, surfels, binding)
    else:
        if own is None:
            normals = found.normals if settings.decoupling.normals else None
            binding = _show_the_mesh(work, final, visible, surfels, mesh, binding, normals)
        else:
            binding = shaded_by_own(binding, mesh, own.normals[visible])
            surfels = replace(surfels, **{name: getattr(own, name)[visible] for name in BASE_CHANNELS})
        environment, origin = Environment(found.environment), "separated from the lighting"
        done, of = report["steps"]["materials"]
        if done < FEW_STEPS:
            origin = f"hardly separated from the lighting, in {done} of {of} steps: unreliable"
        work.on_progress(Progress("materials", 1.0, len(surfels)))
    learned = [view.name for view in capture.training]
    provenance: dict[str, Any] = {"capture": capture.name, "learned_from": learned, "variant": settings.variant}
    provenance |= {"materials": origin, "settings": as_tables(settings), "report": report}
    return Asset(surfels, mesh, binding, environment, provenance)


def mesh_of(gaussians: Gaussians, capture: Capture, region: Region, resolution: int = MOST) -> tuple[Mesh, dict]:
    """Mesh of surfels as the training views see them (`depth_fusion.fuse`), with the outlines of exact masks."""
    cameras = [view.camera for view in capture.training]
    mesh, report = fuse(gaussians, cameras, region, resolution)
    exact = not any(view.mask_band for view in capture.training)
    if exact and (masks := silhouettes(capture)) is not None:
        mesh.vertices = fill_silhouettes(mesh, cameras, masks)
    return mesh, report


def _voxels(settings: Settings, cameras: list[Camera], region: Region) -> int:
    """Voxels along the mesh's longest side, known before minutes of learning; errors as of `depth_fusion.grid`."""
    resolution = settings.mesh_resolution
    if resolution is None:
        few = settings.variant == "m" or settings.minutes is not None
        resolution = voxels_that_fit(cameras, region, FEW_VOXELS if few else MOST)
    grid(cameras, region, resolution)
    return resolution


class _Work:
    """What all phases of a run share."""

    def __init__(
        self,
        capture: Capture,
        settings: Settings,
        on_progress: Callable[[Progress], None],
        cancelled: Callable[[], bool],
        folder: Path | None,
    ) -> None:
        self.capture, self.settings, self.folder = capture, settings, folder
        self.on_progress, self.cancelled = on_progress, cancelled
        #: Phase -> steps done, and those of its schedule.
        self.steps: dict[str, list[int]] = {}
        self.backend = select_backend(settings.device)
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                problem = f"cannot be a folder for what goes on after a stop ({error.strerror or error})"
                raise WriteError(
                    str(folder), problem, "Move what is there, or choose another name for the asset"
                ) from error

    def seconds(self, share: float) -> float | None:
        """Time budget of a phase, seconds."""
        return None if self.settings.minutes is None else 60 * share * self.settings.minutes

    def file(self, phase: str) -> Path | None:
        """Checkpoint of a phase."""
        return None if self.folder is None else self.folder / f"{phase.replace(' ', '-')}.state"

    def key(self, phase: str) -> str:
        """Key of a checkpoint of a phase: digest of the photographs, and of the settings that decide its result."""
        settings = asdict(self.settings)
        return checkpoint.fingerprint(self.capture, **{name: settings[name] for name in CHECKPOINT_SETTINGS[phase]})

    def learn(self, phase: str, training: Training, begin: float, end: float) -> Gaussians:
        """Run a training to its end, from its checkpoint if there is one.

        That of a run with other settings of later phases serves as well.
        """
        file = self.file(phase)
        kept = checkpoint.Checkpoint(file, "" if file is None else self.key(phase), SAVE_EVERY)
        if (state := kept.load()) is not None:
            known = state
            training.attempt(lambda: training.restore(known), interruptible=False)
            log.info("%s: going on at step %d", phase, training.iteration)
        shown = reported = time.monotonic()
        reached = 0.0
        while not training.finished:
            training.step()
            now = time.monotonic()
            stop = self.cancelled()
            if kept.is_due(stop or training.finished):
                kept.save(training.arrays())
            if stop:
                raise Cancelled
            if now - reported > 1 or training.finished:
                draw = now - shown > SHOW_EVERY or training.finished
                picture = training.attempt(lambda: preview(training.gaussians, self.capture)) if draw else None
                reached = max(reached, training.part)  # the second start of a trial starts over
                self.on_progress(
                    Progress(phase, begin + (end - begin) * reached, len(training.gaussians), training.psnr, picture)
                )
                reported, shown = now, now if draw else shown
        done, of = self.steps[phase] = [training.iteration, training.schedule.iterations]
        if done < min(FEW_SURFEL_STEPS, of):
            log.warning(
                "%s got %d of %d steps in their part of %g minutes, too few for their shape: it is rough. Give more "
                "minutes, --time-budget M, or a lower --resolution", phase, done, of, self.settings.minutes or 0.0,
            )  # fmt: skip
        return training.attempt(lambda: training.gaussians.on(CPU))


def _on_mesh(
    work: _Work, mesh: Mesh, free: Gaussians, region: Region, report: dict[str, Any]
) -> tuple[Gaussians, Binding]:
    """Surfels put on the mesh (DR-GS, algorithm 1), and a second round of learning there."""
    settings = work.settings
    attached, binding, report["attach"] = attach_learned(mesh, free, settings.fixed)
    training = Training(
        work.capture,
        region,
        settings.schedule.on_mesh(ON_MESH),
        attached,
        work.seconds(MESH_SURFEL_TIME_FRACTION),
        work.backend,
    )
    final = work.learn("surfels on the mesh", training, 0.55, 0.7)
    return final, bound(binding, final)  # type: ignore[arg-type]


def _decoupled(work: _Work, mesh: Mesh, surfels: LearnedSurfels, report: dict[str, Any]) -> Decoupled:
    """Materials, normals and light, of thin things on the surfels; the shape, too, where it is learned with them."""
    settings, free, start = work.settings.decoupling, work.settings.variant == "p", None
    on_surfels = free and (settings.domain == "surfels" or (settings.domain == "auto" and report["thin"]))
    if settings.normals and free and not on_surfels:
        start = with_surfel_normals(mesh, work.capture.training, normals_of(surfels.gaussians))
    if (seconds := work.seconds(MATERIAL_TIME_FRACTION)) is not None:
        settings = replace(settings, seconds=seconds)
    count = len(surfels.gaussians)

    def tell(at: MaterialProgress) -> None:
        work.on_progress(Progress("materials", 0.7 + _LEARNING * at.part, count, at.psnr))

    rest = tell, work.cancelled, work.file("materials")
    if settings.joint and free:
        if work.backend is not CPU:
            log.warning("decoupling.joint: surfels, materials and light are learned on the CPU, not on the card")
        found = decouple_jointly(work.capture, mesh, surfels, settings, *rest, on_surfels, start)
    else:
        own = surfels.gaussians if on_surfels else None
        found = decouple(work.capture, mesh, settings, *rest, work.backend, start, own)
    done, of = work.steps["materials"] = [found.report["iterations"], work.settings.decoupling.iterations]
    if _are_few(done, of):
        minutes = work.settings.minutes
        limit, option = f"{settings.seconds:g} seconds", "a larger --set decoupling.seconds=S"
        if minutes is not None:
            limit, option = f"part of {minutes:g} minutes", "more minutes, --time-budget M"
        log.warning(
            "materials got %d of %d steps in their %s, too few to separate them from the light: they are unreliable. "
            "Give %s, or a lower --resolution", done, of, limit, option,
        )  # fmt: skip
    # Without the clock: the same run gives the same bytes.
    report["decoupling"] = {key: value for key, value in found.report.items() if key != "seconds"}
    return found


def _are_few(done: int, of: int) -> bool:
    """Whether so few steps of materials, of those of the schedule, separate them poorly from the light."""
    return done < min(FEW_STEPS, of)


def _show_the_mesh(
    work: _Work,
    gaussians: Gaussians,
    visible: Array,
    surfels: Surfels,
    mesh: Mesh,
    binding: Binding,
    normals: Array | None,
) -> Binding:
    """Give surfels, in place, materials whose blend shows those of the mesh; the binding with such shading normals.

    `normals` (v, 3) are the mesh's; None: the binding keeps its own. Roughness and metallic are smooth anyway, and
    errors of the mesh's would only become larger.
    """

    def tell(part: float) -> None:
        if work.cancelled():
            raise Cancelled
        work.on_progress(Progress("materials", 0.7 + _LEARNING + (0.3 - _LEARNING) * part, len(surfels)))

    for name in ("roughness", "metallic"):
        setattr(surfels, name, np.clip(blended(binding, mesh, getattr(mesh, name)), 0, 1).astype(np.float32))
    values = mesh.albedo if normals is None else np.hstack([mesh.albedo, normals])
    start = np.zeros((len(visible), values.shape[1]), np.float32)
    start[visible] = blended(binding, mesh, values)
    views, seconds = work.capture.training, work.seconds(BLEND_TIME_FRACTION)
    found = blended_as(gaussians, visible, start, mesh, values, views, tell, seconds)[visible]
    surfels.albedo = found[:, :3].clip(0, 1)
    if normals is None:
        return binding
    return shaded_by(binding, mesh, bounded(found[:, 3:], start[visible][:, 3:]))


def _visible_surfels(gaussians: Gaussians, visible: Array) -> Surfels:
    """Surfels that can be seen."""
    surfels = gaussians.surfels()
    names = [name for name in Surfels.__dataclass_fields__ if name != "extras" and getattr(surfels, name) is not None]
    return Surfels(**{name: getattr(surfels, name)[visible] for name in names})


def _rows(binding: Binding, keep: Array) -> Binding:
    return Binding(*(getattr(binding, name)[keep] for name in Binding.__dataclass_fields__))
