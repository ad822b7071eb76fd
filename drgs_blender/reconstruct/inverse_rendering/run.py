"""Inverse rendering (decoupling): steps over the pixels of all photographs, until materials and light explain them."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import Mesh
from ...core.errors import AssetError, Cancelled, UsageError
from ...render.reference.brdf import MIN_GGX_ALPHA, dot
from ...render.scene.triangle_bvh import TriangleBVH
from .. import checkpoint as states
from ..backend import CPU, LearningBackend
from ..capture.capture import Capture
from ..model.gaussians import Gaussians
from ..optim.adam import Adam
from .lighting import Lighting
from .likeness import LikePoints, features
from .losses import log_loss, unbiased_loss
from .materials import levels
from .pixels import Normals, Pixels, foreground_pixels
from .radiance_cache import edges_of, filled, radiance_cache
from .regularisers import Regularisers, fineness
from .schedule import Schedule
from .score import Score
from .settings import Settings
from .surface import Pairs, Surface, SurfaceSamples

Array = np.ndarray
log = logging.getLogger(__name__)

DEFAULT = Settings()
#: Steps between two tables of light sampling, between two reports, and seconds between two checkpoints.
_AIM, _REPORT, _SAVE = 25, 25, 20.0
#: Photographs in display values were exposed for white, unless their mean is less than so much of `brightness`.
_DARKEST = 0.2


@dataclass(slots=True)
class Decoupled:
    """Materials and light of a captured object.

    Attributes
    ----------
    albedo : (v, 3) float32 array
        In [0, 1], of the mesh's vertices; linear Rec.709.
    roughness, metallic : (v,) float32 array
        In [0, 1], of the mesh's vertices; linear Rec.709.
    environment : (h, 2 h, 3) float32 array
        Radiance in the mapping of `asset.Environment`, Z up, as it was around the first view where the object was
        turned (`View.turn`). What cannot be seen apart is its scale against that of the albedo.
    normals : (v, 3) float32 array
        Unit: smooth vertex normals, with what was learned on top.
    report : dict
        JSON-able: "views", "pixels", "iterations", "seconds", "psnr" (of the pixels of the last steps, dB in sRGB),
        "loss", "unseen_vertices", "exposures" (factors of the views, when learned).
    shape : Shape, optional
        Where the shape was learned, too; the arrays above are of its mesh then.
    """

    albedo: Array
    roughness: Array
    metallic: Array
    environment: Array
    normals: Array
    report: dict[str, Any] = field(default_factory=dict)
    shape: Shape | None = None


@dataclass(slots=True)
class Shape:
    """Surfels that were learned with materials and light.

    Attributes
    ----------
    mesh : Mesh
        Fused from them; its materials mean nothing.
    fusion : dict
        Report of that, see `depth_fusion.fuse`.
    gaussians : Gaussians
    albedo : (n, 3) float32 array
    roughness, metallic : (n,) float32 array
        The surfels' own, as of `Decoupled`.
    """

    mesh: Mesh
    fusion: dict[str, Any]
    gaussians: Gaussians
    albedo: Array
    roughness: Array
    metallic: Array


@dataclass(slots=True)
class Progress:
    """Progress of a run: `part` of it is done, 0..1; `result` makes the present result."""

    iteration: int
    part: float
    loss: float
    psnr: float
    result: Callable[[], Decoupled]


def decouple(
    capture: Capture,
    mesh: Mesh,
    settings: Settings = DEFAULT,
    on_progress: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    checkpoint: Path | None = None,
    backend: LearningBackend = CPU,
    normals: Normals | None = None,
    start: Array | None = None,
    now: Callable[[], float] = time.monotonic,
) -> Decoupled:
    """Learn materials and light of an object from photographs and its geometry.

    The same inputs and settings give the same result, also across an interruption (unless ``seconds`` ends it).

    Parameters
    ----------
    capture : Capture
    mesh : Mesh
        World space, faces counter-clockwise seen from outside; its materials are not used.
    settings : Settings
    on_progress : callable, optional
        Called every few steps.
    cancelled : callable, optional
        Asked every step; then a checkpoint is left behind and Cancelled raised.
    checkpoint : Path, optional
        File to go on from when it lies there and fits, written every few seconds and at the end.
    backend : LearningBackend
        Backend that traces rays; the rest runs on the CPU.
    normals : callable, optional
        Gives the normals behind pixels in place of the mesh. They count where they are within 60 degrees of the
        face, as for surfels that are rendered; what is learned of normals is added to them.
    start : (v, 3) float32 array, optional
        Unit normals of the vertices to begin with, in place of the mesh's smooth ones.
    now : callable
        Monotonic clock, seconds.

    Raises
    ------
    UsageError
        Settings out of range; no training view; none sees the mesh; a picture and its camera of different sizes.
    AssetError
        The mesh has no faces.
    Cancelled
    """
    job = Job(capture, mesh, settings, checkpoint, backend, normals, start, now)
    return learned(job, on_progress, cancelled)


def learned(
    job: Job, on_progress: Callable[[Progress], None] | None, cancelled: Callable[[], bool] | None
) -> Decoupled:
    """Run a job to its end, as `decouple` says."""
    job.go_on()
    schedule = job.schedule
    while schedule.going():
        if cancelled is not None and cancelled():
            job.save()
            raise Cancelled()
        job.step()
        if on_progress is not None and (schedule.iteration % _REPORT == 0 or not schedule.going()):
            score = job.score
            on_progress(Progress(schedule.iteration, min(schedule.part, 1.0), score.loss, score.psnr, job.result))
    job.save()  # what is made of it can be stopped, too
    return job.result()


class Job:
    """A run, a `step` at a time.

    Attributes
    ----------
    schedule : Schedule
    surface : Surface
        Materials and normals that are learned.
    lighting : Lighting
        The environment that is learned.
    score : Score
    checkpoint : Checkpoint
    """

    def __init__(
        self, capture: Capture, mesh: Mesh, settings: Settings, checkpoint: Path | None, backend: LearningBackend,
        normals: Normals | None, start: Array | None, now: Callable[[], float],
    ) -> None:  # fmt: skip
        settings.check()
        if not len(mesh.faces):
            raise AssetError("mesh", "has no faces", "Decoupling needs the surface")
        if not capture.training:
            raise UsageError(str(capture.source), "has no training view", "Leave fewer views out for the test")
        self._mesh, self._settings, self._capture = mesh, settings, capture
        self.schedule, self.score = Schedule(settings, now), Score()
        tree = TriangleBVH()
        tree.build(mesh.vertices, mesh.faces)
        self._pixels = foreground_pixels(capture.training, mesh, tree, settings.most_pixels, settings.seed, normals)
        self._gain = _gain(capture, float(self._pixels.colour.mean()), settings.brightness)
        self._pixels.colour *= np.float32(self._gain)
        cache, self._weight = radiance_cache(self._pixels, mesh)
        counts = (settings.cosine, settings.ggx, settings.light)
        if not settings.shadows:
            tree = TriangleBVH()
            tree.build(mesh.vertices, mesh.faces[:0])
        gatherer = backend.gatherer(mesh, tree, cache if settings.indirect else None, counts, settings.normals)

        # Grey light that shows a surface of albedo .4 as bright as the photographs, which has their hue. Colours begin
        # without any detail: light is to explain shading before albedo can.
        mean = self._pixels.colour.mean(axis=0)
        turns = [view.turn for view in capture.training if view.turn is not None]
        self.lighting = Lighting(gatherer, settings, 2.5 * float(mean.mean()), turns)
        finer = fineness(mesh.vertices, mesh.faces[:, :2])
        grids = replace(settings, coarse=levels(settings.coarse, finer))
        self.surface = Surface(mesh, grids, mean, normals is not None, start)
        #: What photographs show of the vertices, where it is wanted.
        self._shown: Array | None = None
        self._like: LikePoints | None = None
        if settings.same_material > 0:
            self._shown = features(self._pixels, mesh)
            self._like = LikePoints(self._shown, mesh.vertices, settings.seed)
        colours = np.maximum(cache[:, 0] * 0.28209479, 0)
        self._regularisers = Regularisers(edges_of(mesh.faces), colours, settings, finer)
        #: Logarithm of the brightness of the photographs, one each.
        self._exposure = torch.zeros(len(capture.training)) if settings.exposure else None
        self._adam = Adam(self._learned())
        shape = _digest(mesh.vertices, mesh.faces, self._pixels.detail_normal, self.surface.normals())
        key = states.fingerprint(capture, mesh=shape, **asdict(settings))
        self.checkpoint = states.Checkpoint(checkpoint, key, _SAVE, now)

    def go_on(self) -> None:
        """Go on from the checkpoint, if there is one."""
        if (state := self.checkpoint.load()) is not None:
            self._restore(state)

    def step(self) -> None:
        """One step of the optimiser."""
        s, part = self._settings, self.schedule.part
        self._prepare_light(part)
        generator = np.random.default_rng([s.seed, self.schedule.iteration])
        row = generator.integers(*self._range(), s.pixels)
        edge = self._regularisers.draw(generator)
        key = generator.integers(0, 2**32, s.pixels, dtype=np.uint32)
        pairs = self._like.draw(generator) if self._like is not None and self.schedule.knows_metals() else None

        learned = self._learned()
        for tensor in learned.values():
            tensor.requires_grad_(True)
        self._backward(self._pixels.select(row), key, edge, pairs)
        for tensor in learned.values():
            tensor.requires_grad_(False)
            if tensor.grad is not None:
                tensor.grad.nan_to_num_(0.0, 0.0, 0.0)
        self._descend(learned, self.schedule.rates(part, learned))
        self.schedule.iteration += 1
        if self.checkpoint.is_due():
            self.save()

    def _descend(self, learned: dict[str, Tensor], rates: dict[str, float | Array]) -> None:
        self._adam.step(learned, rates)

    def _optimisers(self) -> list[Adam]:
        """All that hold moments; no two of the same name."""
        return [self._adam]

    def _prepare_light(self, part: float) -> None:
        """Let the environment grow, and aim at what is bright in it, when it is time."""
        stale = self.schedule.iteration % _AIM == 0
        if self.lighting.grow(self.schedule.doublings_ahead(part)):
            for moments in (self._adam.first, self._adam.second):
                moments["light"] = torch.zeros_like(self.lighting.learned.log)
            stale = True
        if stale:
            self.lighting.aim(self.lighting.learned.radiance().numpy())

    def _range(self) -> tuple[int, int]:
        """First and last of the pixels that a step draws from, half-open."""
        return 0, len(self._pixels)

    def _backward(self, pixels: Pixels, key: Array, edge: Array, pairs: Pairs | None) -> None:
        """Gradients of all that is learned, from these pixels, edges and pairs."""
        self._loss(self.surface.at(pixels, self._regularisers.edges(edge), pairs), pixels, key, edge).backward()

    def _loss(self, samples: SurfaceSamples, pixels: Pixels, key: Array, edge: Array) -> Tensor:
        radiance = self.lighting.learned.radiance()
        loss = self._difference(pixels, key, samples, radiance)
        has_metallic, knows_metals = self.surface.materials.metallic, self.schedule.knows_metals()
        loss = loss + self._regularisers.of_materials(samples, edge, has_metallic, knows_metals)
        if samples.pairs is not None:
            loss = loss + self._regularisers.of_likeness(samples.columns, samples.pairs)
        loss = loss + self._regularisers.of_light(self.lighting.learned, radiance)
        return loss + self._regularisers.of_normals(samples)

    def _difference(self, pixels: Pixels, key: Array, samples: SurfaceSamples, radiance: Tensor) -> Tensor:
        """Loss between predicted and photographed colours."""
        s, materials = self._settings, self.surface.materials
        roughness = materials.roughness(samples.materials)
        alpha2 = (roughness**2).clamp(min=MIN_GGX_ALPHA) ** 2
        sums = self.lighting.gather(pixels, key, samples.normal, alpha2, radiance)
        nv = dot(samples.normal, torch.from_numpy(pixels.towards)).clamp(1e-3, 1)
        predicted = materials.reflect(samples.materials, sums, nv, s.shading_model)
        if self._exposure is not None:
            factor = torch.exp(self._exposure - self._exposure.mean())
            predicted = predicted * factor[torch.from_numpy(pixels.view).long()][:, None, None]
        photographed, clipped = torch.from_numpy(pixels.colour), torch.from_numpy(pixels.clipped)
        if s.unbiased:
            weight_by_prediction = self.schedule.weighs_by_prediction()
            beside = torch.from_numpy(pixels.next_to_clipped)
            counts = torch.where(beside, s.clipped_neighbour_weight, 1.0) if weight_by_prediction else None
            loss = unbiased_loss(predicted, photographed, clipped, weight_by_prediction, counts)
        else:
            loss = log_loss(predicted.mean(1), photographed, clipped)
        self.score.note(float(loss.detach()), predicted.detach().mean(1) / self._gain, photographed / self._gain)
        return loss

    def result(self) -> Decoupled:
        """Materials and light as learned so far."""
        known = self._weight > 1e-3
        values = np.column_stack(self.surface.materials.values())
        values = np.clip(filled(values, known, self._mesh), 0, 1)
        return self._found(values, self.surface.normals(), known)

    def _found(self, values: Array, normals: Array, known: Array) -> Decoupled:
        """The result: materials (v, 5) and normals of vertices, and which of them (v,) photographs show."""
        report: dict[str, Any] = {
            "views": len(self._capture.training),
            "pixels": len(self._pixels),
            "iterations": self.schedule.iteration,
            "seconds": round(self.schedule.elapsed, 1),
            "loss": self.score.loss,
            "psnr": self.score.psnr,
            "unseen_vertices": int((~known).sum()),
        }
        if self._exposure is not None:
            report["exposures"] = torch.exp(self._exposure - self._exposure.mean()).tolist()
        environment = self.lighting.learned.radiance().numpy() / np.float32(self._gain)
        return Decoupled(values[:, :3], values[:, 3], values[:, 4], environment, normals, report)

    def _learned(self) -> dict[str, Tensor]:
        exposure = {} if self._exposure is None else {"exposure": self._exposure}
        return self.surface.parameters | exposure | {"light": self.lighting.learned.log}

    def save(self) -> None:
        """Leave a checkpoint behind, if one is wanted."""
        self.checkpoint.save(self._state())

    def _state(self) -> dict[str, Array]:
        """All that `_restore` needs."""
        state = {f"value/{name}": tensor.numpy() for name, tensor in self._learned().items()}
        for adam in self._optimisers():
            for order, moments in (("first", adam.first), ("second", adam.second)):
                state |= {f"{order}/{name}": value.numpy() for name, value in moments.items()}
        state["aimed"] = self.lighting.aimed
        schedule, score = self.schedule, self.score
        state["numbers"] = np.array([schedule.iteration, schedule.elapsed, score.loss, score.error])
        return state

    def _restore(self, state: dict[str, Array]) -> None:
        self.lighting.learned.log = torch.from_numpy(state["value/light"].copy())
        for name, tensor in self._learned().items():
            tensor.copy_(torch.from_numpy(state[f"value/{name}"].copy()))
        for adam in self._optimisers():
            for order, moments in (("first", adam.first), ("second", adam.second)):
                for name in moments:
                    moments[name] = torch.from_numpy(state[f"{order}/{name}"].copy())
        self.lighting.aim(state["aimed"])
        iteration, spent, self.score.loss, self.score.error = (float(x) for x in state["numbers"])
        self._adam.steps = int(iteration)
        self.schedule.go_on(int(iteration), spent)
        log.info("materials: going on at step %d", self.schedule.iteration)


def _gain(capture: Capture, mean: float, brightness: float) -> float:
    """Factor of the photographs, by whose colours losses are weighed. `mean` is that of their linear colours.

    Dark objects have dark photographs, rightly: one brightness for all took 3.6 dB of albedo from a bright one.
    """
    if any(view.linear for view in capture.training):
        return brightness / max(mean, 1e-6)
    return max(1.0, _DARKEST * brightness / max(mean, 1e-6))


def _digest(*arrays: Array) -> str:
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
