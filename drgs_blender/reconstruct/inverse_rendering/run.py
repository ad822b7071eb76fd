"""Decoupling: pixels of all photographs, a step at a time, until materials and light explain them."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import Mesh
from ...core.color import linear_to_srgb
from ...core.errors import AssetError, Cancelled, UsageError
from ...geometry.normals import VertexNormals
from ...render.gbuffer.surfels import ALIKE
from ...render.reference.brdf import MIN_ALPHA, dot, normalise
from ...render.scene.triangle_bvh import TriangleBVH
from .. import checkpoint as states
from ..backend import HERE, Processor
from ..capture.capture import Capture
from ..optim.adam import Adam
from .blend import blend
from .environment import LearnedLight, colour_cast
from .estimator import Points
from .losses import blotches, dullness, log_loss, unbiased_loss
from .materials import Materials
from .pixels import Normals, Pixels, foreground_pixels
from .radiance_cache import edges_of, filled, radiance_cache
from .settings import Settings

Array = np.ndarray
log = logging.getLogger(__name__)

DEFAULT = Settings()
#: Steps between two tables of light sampling, between two reports, and seconds between two checkpoints.
_AIM, _REPORT, _SAVE = 25, 25, 20.0
#: Where the environment grows and normals begin to turn (light comes first); the last step size in parts of the first.
_GROWS, _NORMALS, _LAST_RATE = (0.2, 0.45), 0.4, 0.05
#: Where weights by what is shown begin: before, they let light that is much too bright stay so.
_BY_SHOWN = 0.3
#: From here on metals are told from paint well enough to say how bright and how plain they are.
_METALS = 0.2
#: How much smoother than albedo roughness and metallic are (of diffuse and specular colour: diffuse, roughness, rest).
_SMOOTH = (1.0, 1.0, 1.0, 2.0, 10.0, 10.0, 10.0)
#: Edges that are smoothed a step; how much photographed chroma may differ along one that is.
_EDGES, _CHROMA = 8192, 0.08


@dataclass(slots=True)
class Decoupled:
    """Materials and light of a captured object.

    Attributes
    ----------
    albedo, roughness, metallic : (v, 3), (v,), (v,) float32 in [0, 1], of the mesh's vertices; linear Rec.709
    environment : (h, 2 h, 3) float32 radiance in the mapping of `asset.Environment`, Z up. What cannot be seen apart
        is its scale against that of the albedo
    normals : (v, 3) float32 unit: smooth vertex normals, with what was learned on top
    report : JSON-able: "views", "pixels", "iterations", "seconds", "psnr" (of the pixels of the last steps, dB in
        sRGB), "loss", "unseen_vertices", "exposures" (factors of the views, when learned)
    """

    albedo: Array
    roughness: Array
    metallic: Array
    environment: Array
    normals: Array
    report: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class Progress:
    """How far a run is: `part` of it is done, 0..1; `result` makes what it has so far."""

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
    by: Processor = HERE,
    normals: Normals | None = None,
) -> Decoupled:
    """Learn materials and light of an object from photographs and its geometry.

    The same inputs and settings give the same result, also across an interruption (unless ``seconds`` ends it).

    Parameters
    ----------
    mesh : world space, faces counter-clockwise seen from outside; its materials are not used
    on_progress : called every few steps
    cancelled : asked every step; then a checkpoint is left behind and Cancelled raised
    checkpoint : file to go on from when it lies there and fits, written every few seconds, removed at the end
    by : who follows rays; the rest is done here
    normals : what else than the mesh tells the normals behind pixels. They count where they are within 60 degrees of
        the face, as for surfels that are rendered; what is learned of normals is added to them

    Raises
    ------
    UsageError
        Settings out of range; no training view; none sees the mesh; a picture and its camera of different sizes.
    AssetError
        The mesh has no faces.
    Cancelled
    """
    settings.check()
    if not len(mesh.faces):
        raise AssetError("mesh", "has no faces", "Decoupling needs the surface")
    if not capture.training:
        raise UsageError(str(capture.source), "has no training view", "Leave fewer views out for the test")
    if len(capture.training) < 4:
        log.warning("only %d views: light and materials can hardly be told apart", len(capture.training))
    job = _Job(capture, mesh, settings, checkpoint, by, normals)
    while job.going():
        if cancelled is not None and cancelled():
            job.save()
            raise Cancelled()
        job.step()
        if on_progress is not None and (job.iteration % _REPORT == 0 or not job.going()):
            on_progress(Progress(job.iteration, min(job.part, 1.0), job.loss, job.psnr, job.result))
    result = job.result()
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return result


class _Job:
    """A run: what is learned, and everything a step needs."""

    def __init__(
        self, capture: Capture, mesh: Mesh, settings: Settings, checkpoint: Path | None, by: Processor,
        normals: Normals | None,
    ) -> None:  # fmt: skip
        self._mesh, self._settings, self._checkpoint = mesh, settings, checkpoint
        tree = TriangleBVH()
        tree.build(mesh.vertices, mesh.faces)
        self._pixels = foreground_pixels(capture.training, mesh, tree, settings.most_pixels, settings.seed, normals)
        self._told = normals is not None
        cache, self._weight = radiance_cache(self._pixels, mesh)
        counts = (settings.cosine, settings.ggx, settings.light)
        if not settings.shadows:
            tree = TriangleBVH()
            tree.build(mesh.vertices, mesh.faces[:0])
        self._gatherer = by.gatherer(mesh, tree, cache if settings.indirect else None, counts, settings.normals)
        self._normals = torch.from_numpy(VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices))
        self._faces = torch.from_numpy(mesh.faces.astype(np.int64))

        # Grey light that shows a surface of albedo .4 as bright as the photographs, which has their hue. Colours begin
        # without any detail: light is to explain shading before albedo can.
        mean = self._pixels.colour.mean(axis=0)
        level = 2.5 * float(mean.mean())
        self.light = LearnedLight(settings.environment // (4 if settings.coarse_to_fine else 1), level)
        self.materials = Materials(mesh, settings.parametrisation, settings.coarse, mean)
        seen = np.maximum(cache[:, 0] * 0.28209479, 0)
        self._edges = edges_of(mesh.faces)
        self._likeness = _likeness(self._edges, seen)
        self._parameters = dict(self.materials.parameters)
        if settings.normals:
            self._parameters["normals"] = torch.zeros(len(mesh.vertices), 3)
        if settings.exposure:
            self._parameters["exposure"] = torch.zeros(len(capture.training))
        self._adam = Adam(self._learned())
        self._views = len(capture.training)
        self.iteration, self.loss, self._error = 0, float("nan"), float("nan")
        self._aimed = np.ones((2, 4, 3), np.float32)
        self._spent, self._began, self._saved = 0.0, time.monotonic(), time.monotonic()
        shape = _digest(mesh.vertices, mesh.faces, self._pixels.shown)
        self._key = states.fingerprint(capture, mesh=shape, **asdict(settings))
        if checkpoint is not None and (state := states.load(checkpoint, self._key)) is not None:
            self._restore(state)

    @property
    def _elapsed(self) -> float:
        return self._spent + time.monotonic() - self._began

    @property
    def part(self) -> float:
        """Part of the schedule that is done."""
        done = self.iteration / self._settings.iterations
        return max(done, self._elapsed / self._settings.seconds) if self._settings.seconds > 0 else done

    @property
    def psnr(self) -> float:
        """Of the pixels of the last steps, dB in sRGB; NaN before the first."""
        return float(-10 * np.log10(np.maximum(self._error, 1e-12)))

    def going(self) -> bool:
        """Whether there are steps left; the first one is taken however short the time, or nothing would be known."""
        return self.iteration == 0 or self.part < 1

    def step(self) -> None:
        """One step of the optimiser."""
        s, fraction = self._settings, self.part
        # Doublings of the environment that still lie ahead on the schedule.
        ahead = sum(fraction < at for at in _GROWS) if s.coarse_to_fine else 0
        stale = self.iteration % _AIM == 0
        while s.environment // len(self.light.log) > 1 << ahead:
            self.light.grow()
            for moments in (self._adam.first, self._adam.second):
                moments["light"] = torch.zeros_like(self.light.log)
            stale = True
        if stale:
            self._aim(self.light.radiance().numpy())
        generator = np.random.default_rng([s.seed, self.iteration])
        row = generator.integers(0, len(self._pixels), s.pixels)
        edge = generator.integers(0, max(len(self._edges), 1), min(_EDGES, len(self._edges)))
        key = generator.integers(0, 2**32, s.pixels, dtype=np.uint32)

        learned = self._learned()
        for tensor in learned.values():
            tensor.requires_grad_(True)
        self._loss(self._pixels.select(row), key, edge).backward()
        for tensor in learned.values():
            tensor.requires_grad_(False)
            if tensor.grad is not None:
                tensor.grad.nan_to_num_(0.0, 0.0, 0.0)
        rate = _LAST_RATE**fraction
        turning = 0.4 if fraction > _NORMALS else 0.0
        rates = {"light": s.light_rate, "normals": turning * s.rate, "exposure": 0.1 * s.rate}
        self._adam.step(learned, {name: rate * rates.get(name, s.rate) for name in learned})
        self.iteration += 1
        if self._checkpoint is not None and time.monotonic() - self._saved > _SAVE:
            self.save()

    def _loss(self, pixels: Pixels, key: Array, edge: Array) -> Tensor:
        s = self._settings
        corner = self._faces[torch.from_numpy(pixels.face)]
        ends = torch.from_numpy(self._edges[edge])
        used, place = torch.unique(torch.cat([corner.flatten(), ends.flatten()]), return_inverse=True)
        corner_place, end_place = place[: corner.numel()].view(-1, 3), place[corner.numel() :].view(-1, 2)
        shares = torch.from_numpy(pixels.corners)

        columns = self.materials.at(used)
        here = blend(columns, corner_place, shares)
        smooth = self._normals[used]
        offsets = self._parameters["normals"].index_select(0, used) if s.normals else None
        if offsets is not None:
            smooth = smooth + offsets
        normal = normalise(blend(smooth, corner_place, shares))
        if self._told:
            normal = self._as_shown(pixels, normal, None if offsets is None else blend(offsets, corner_place, shares))
        roughness = self.materials.roughness(here)
        alpha2 = (roughness**2).clamp(min=MIN_ALPHA) ** 2
        radiance = self.light.radiance()
        sums = self._gatherer(Points(pixels.origin, pixels.flat, pixels.towards, key), normal, alpha2, radiance)
        nv = dot(normal, torch.from_numpy(pixels.towards)).clamp(1e-3, 1)
        shown = self.materials.reflect(here, sums, nv, s.shading_model)
        if s.exposure:
            exposure = self._parameters["exposure"]
            shown = shown * torch.exp(exposure - exposure.mean())[torch.from_numpy(pixels.view).long()][:, None, None]
        photographed = torch.from_numpy(pixels.colour)
        by_shown = s.by_shown and self.part >= _BY_SHOWN
        if s.unbiased:
            beside = torch.from_numpy(pixels.beside_clipped)
            counts = torch.where(beside, s.beside_clipped, 1.0) if by_shown else None
            loss = unbiased_loss(shown, photographed, by_shown, counts)
        else:
            loss = log_loss(shown.mean(1), photographed)
        self._note(float(loss.detach()), shown.detach().mean(1), photographed)

        pair = columns.index_select(0, end_place.flatten()).view(len(edge), 2, -1)
        differences = (pair[:, 0] - pair[:, 1]).abs()
        likeness = torch.from_numpy(self._likeness[edge])[:, None]
        weights = torch.tensor(_SMOOTH[: columns.shape[1]])
        loss = loss + s.smoothness * ((likeness * differences).mean(0) * weights).sum()
        told = self.materials.metallic and self.part >= _METALS
        if s.plain_metals > 0 and told:
            loss = loss + s.plain_metals * s.smoothness * blotches(differences[:, :3], pair[:, :, 4], likeness)
        if s.bimodal > 0 and self.materials.metallic:
            loss = loss + s.bimodal * (here[:, 4] * (1 - here[:, 4])).mean()
        if s.polish > 0 and told:
            loss = loss + s.polish * dullness(here[:, :3], here[:, 4])
        if s.white > 0:
            loss = loss + s.white * colour_cast(radiance)
        if s.light_smoothness > 0:
            loss = loss + s.light_smoothness * self.light.roughness()
        if offsets is not None:
            turned = offsets.index_select(0, end_place.flatten()).view(len(edge), 2, 3)
            loss = loss + s.normal_smoothness * (((turned[:, 0] - turned[:, 1]) ** 2).sum(1).mean())
            loss = loss + 0.02 * s.normal_smoothness * (offsets**2).sum(1).mean()
        return loss

    @staticmethod
    def _as_shown(pixels: Pixels, normal: Tensor, offsets: Tensor | None) -> Tensor:
        """Normals (n, 3) told by others than the mesh, with what is learned; its `normal` where they are far off."""
        shown, flat = torch.from_numpy(pixels.shown), torch.from_numpy(pixels.flat)
        believed = dot(shown, flat)[:, None] >= ALIKE
        # The face's where they are not: nothing has no direction, and its derivative would spoil that of its vertices.
        own = torch.where(believed, shown, flat)
        return torch.where(believed, own if offsets is None else normalise(own + offsets), normal)

    def _note(self, loss: float, shown: Tensor, photographed: Tensor) -> None:
        """Running means of the loss and of the squared error in sRGB."""
        a, b = (linear_to_srgb(x.clamp(0, 1).numpy()) for x in (shown, photographed))
        error = float(((a - b) ** 2).mean())
        first = not self._error >= 0
        self.loss = loss if first else 0.95 * self.loss + 0.05 * loss
        self._error = error if first else 0.95 * self._error + 0.05 * error

    def result(self) -> Decoupled:
        """What has been learned so far."""
        known = self._weight > 1e-3
        values = np.column_stack(self.materials.values())
        values = np.clip(filled(values, known, self._mesh), 0, 1)
        normals = self._normals
        report: dict[str, Any] = {
            "views": self._views,
            "pixels": len(self._pixels),
            "iterations": self.iteration,
            "seconds": round(self._elapsed, 1),
            "loss": self.loss,
            "psnr": self.psnr,
            "unseen_vertices": int((~known).sum()),
        }
        if "normals" in self._parameters:
            normals = normalise(normals + self._parameters["normals"])
        if "exposure" in self._parameters:
            exposure = self._parameters["exposure"]
            report["exposures"] = torch.exp(exposure - exposure.mean()).tolist()
        environment = self.light.radiance().numpy().copy()
        return Decoupled(
            values[:, :3], values[:, 3], values[:, 4], environment, normals.numpy().astype(np.float32), report
        )

    def _aim(self, radiance: Array) -> None:
        self._aimed = radiance
        self._gatherer.aim(radiance)

    def _learned(self) -> dict[str, Tensor]:
        return self._parameters | {"light": self.light.log}

    def save(self) -> None:
        """Leave a checkpoint behind, if one is wanted."""
        if self._checkpoint is None:
            return
        state = {f"value/{name}": tensor.numpy() for name, tensor in self._learned().items()}
        for order, moments in (("first", self._adam.first), ("second", self._adam.second)):
            state |= {f"{order}/{name}": value.numpy() for name, value in moments.items()}
        state["aimed"] = self._aimed
        state["numbers"] = np.array([self.iteration, self._elapsed, self.loss, self._error])
        states.save(self._checkpoint, state, self._key)
        self._saved = time.monotonic()

    def _restore(self, state: dict[str, Array]) -> None:
        for name, tensor in self._parameters.items():
            tensor.copy_(torch.from_numpy(state[f"value/{name}"].copy()))
        self.light.log = torch.from_numpy(state["value/light"].copy())
        for order, moments in (("first", self._adam.first), ("second", self._adam.second)):
            for name in moments:
                moments[name] = torch.from_numpy(state[f"{order}/{name}"].copy())
        self._aim(state["aimed"])
        iteration, self._spent, self.loss, self._error = (float(x) for x in state["numbers"])
        self.iteration = self._adam.steps = int(iteration)
        log.info("materials: going on at step %d", self.iteration)


def _digest(*arrays: Array) -> str:
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def _likeness(edges: Array, colours: Array) -> Array:
    """How alike the ends of edges (e, 2) are in the photographs (e,): 1 the same chroma, 0 another."""
    chroma = colours / np.maximum(colours.sum(axis=1, keepdims=True), 1e-4)
    difference = np.linalg.norm(chroma[edges[:, 0]] - chroma[edges[:, 1]], axis=1)
    return np.exp(-((difference / _CHROMA) ** 2)).astype(np.float32)
