"""Inverse rendering (decoupling): steps over the pixels of all photographs, until materials and light explain them."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import Mesh
from ...core.errors import Cancelled
from ...formats.harmonics import SH_C0
from ...render.reference.brdf import MIN_GGX_ALPHA, dot
from ...render.scene.triangle_bvh import TriangleBVH
from .. import checkpoint as states
from ..backend import CPU, LearningBackend
from ..capture.capture import Capture
from ..model.gaussians import Gaussians
from ..optim.adam import Adam
from ..torch_threads import one_thread
from .decoupled import Decoupled, DecoupledSurfels, Progress
from .domain import Domain, mesh_domain
from .lighting import Lighting
from .likeness import LikePoints, features
from .losses import log_loss, unbiased_loss
from .materials import levels
from .pixels import Pixels
from .radiance_cache import filled, radiance_cache
from .regularisers import Regularisers, fineness
from .schedule import Schedule
from .score import Score
from .settings import Settings
from .surface import Pairs, Surface, SurfaceSamples
from .surfel_domain import carried, surfel_domain

Array = np.ndarray
log = logging.getLogger(__name__)

DEFAULT = Settings()
#: Steps between two tables of light sampling, between two reports, and seconds between two checkpoints.
_AIM, _REPORT, _SAVE = 25, 25, 20.0
#: How much more surfels that photographs show alike are held so than vertices.
_ALIKE = 3.0
#: Photographs in display values were exposed for white, unless their mean is less than so much of `brightness`.
_DARKEST = 0.2


def decouple(
    capture: Capture,
    mesh: Mesh,
    settings: Settings = DEFAULT,
    on_progress: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    checkpoint: Path | None = None,
    backend: LearningBackend = CPU,
    start: Array | None = None,
    surfels: Gaussians | None = None,
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
    start : (v, 3) float32 array, optional
        Unit normals of the vertices to begin with, in place of the mesh's smooth ones.
    surfels : Gaussians, optional
        On the CPU. Materials and normals are learned of them, as they are, in place of the mesh, which takes what views
        show; rays meet their sheets. For things thinner than the mesh can be.
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
    schedule = Schedule(settings, now)
    domain = domain_of(capture, mesh, settings, start, surfels)
    return learned(Job(capture, domain, mesh, settings, checkpoint, backend, schedule), on_progress, cancelled)


def domain_of(
    capture: Capture, mesh: Mesh, settings: Settings, start: Array | None, surfels: Gaussians | None
) -> Domain:
    """The vertices of the mesh, or surfels; see `decouple`."""
    return mesh_domain(capture, mesh, settings, start) if surfels is None else surfel_domain(capture, surfels, settings)


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
        with one_thread():
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
        self,
        capture: Capture,
        domain: Domain,
        mesh: Mesh,
        settings: Settings,
        checkpoint: Path | None,
        backend: LearningBackend,
        schedule: Schedule,
    ) -> None:
        if domain.surfels is not None:
            settings = replace(settings, same_material=_ALIKE * settings.same_material)
        self._domain, self._mesh, self._settings, self._capture = domain, mesh, settings, capture
        self.schedule, self.score = schedule, Score()
        points, edges = domain.points, domain.edges
        self._gain = _gain(capture, float(domain.pixels.colour.mean()), settings.brightness)
        self._pixels = replace(domain.pixels, colour=domain.pixels.colour * np.float32(self._gain))
        cache, self._weight = radiance_cache(self._pixels, len(points), edges)
        counts = (settings.cosine, settings.ggx, settings.light)
        sent = cache[domain.owner] if settings.indirect else None
        tree = domain.tree if settings.shadows else TriangleBVH()  # an empty one: nothing is in the way
        gatherer = backend.gatherer(domain.occluder, tree, sent, counts, settings.normals)

        # Grey light that shows a surface of albedo .4 as bright as the photographs, which has their hue. Colours begin
        # without any detail: light is to explain shading before albedo can.
        mean = self._pixels.colour.mean(axis=0)
        turns = [view.turn for view in capture.training if view.turn is not None]
        self.lighting = Lighting(gatherer, settings, 2.5 * float(mean.mean()), turns)
        finer = fineness(points, edges)
        grids = replace(settings, coarse=levels(settings.coarse, finer))
        self.surface = Surface(points, domain.normals, grids, mean, domain.surfels is not None)
        #: What photographs show of the vertices, where it is wanted.
        self._shown: Array | None = None
        self._like: LikePoints | None = None
        if settings.same_material > 0:
            self._shown = features(self._pixels, len(points), edges)
            self._like = LikePoints(self._shown, points, settings.seed)
        colours = np.maximum(cache[:, 0] * SH_C0, 0)
        self._regularisers = Regularisers(edges, colours, settings, finer)
        #: Logarithm of the brightness of the photographs, one each.
        self._exposure = torch.zeros(len(capture.training)) if settings.exposure else None
        self._adam = Adam(self._learned())
        key = states.fingerprint(capture, shape=_digest(*self._shape()), **asdict(settings))
        self.checkpoint = states.Checkpoint(checkpoint, key, _SAVE, schedule.now)

    def _shape(self) -> list[Array]:
        """What its states belong to, beside photographs and settings."""
        return [self._domain.occluder.vertices, self._domain.occluder.faces, self._domain.normals]

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
        values = np.clip(filled(values, known, self._domain.edges), 0, 1)
        if (surfels := self._domain.surfels) is None:
            return self._found(values, known, self.surface.normals())
        found = self._found(*carried(values, self._mesh, surfels, self._capture.training))
        found.surfels = DecoupledSurfels(surfels, values[:, :3], values[:, 3], values[:, 4], self.surface.normals())
        return found

    def _found(self, values: Array, known: Array, normals: Array | None = None) -> Decoupled:
        """The result: materials (v, 5) of vertices, which of them (v,) photographs show, and their normals."""
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
