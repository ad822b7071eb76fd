"""Joint learning, the paper's inverse rendering: surfels, materials of their own and light are learned together.

After a first part on the mesh, or on the surfels as they are (`run.Job`), each step renders one photograph's view. The
surfels' radiance is held to the photograph as in stage (i), with its losses of shape; of some pixels the blended
normals and materials of the surfels are lit as before, and that loss moves surfels, materials and light. Rays meet the
mesh of stage (i), of thin things the sheets of its surfels; a last mesh is fused from the surfels at the end.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...core.asset.model import Mesh
from ...core.color import srgb_to_linear
from ...core.errors import UsageError
from ...deform.binding import bind, clamp_weights
from ...formats.harmonics import SH_C0
from ...render.gbuffer.surfels import ALIKE
from ...render.reference.brdf import dot, normalise
from ..backend import CPU
from ..capture.capture import Capture
from ..capture.training_views import background_of, full_targets
from ..meshing.crops import corner_of
from ..meshing.surfel_normals import with_surfel_normals
from ..model.gaussians import Gaussians, RenderedView
from ..model.thin_structures import normals_of
from ..optim.adam import Adam
from ..optim.learner import Learner
from ..optim.schedule import Schedule as SurfelSchedule
from .blend import blend
from .decoupled import Decoupled, DecoupledSurfels, Progress
from .domain import Domain
from .likeness import LikePoints
from .materials import Materials, levels
from .pixels import Pixels
from .regularisers import Regularisers, fineness
from .run import Job, domain_of, learned
from .schedule import Schedule
from .settings import Settings
from .surface import Pairs, SurfaceSamples
from .surfel_domain import carried, neighbours

Array = np.ndarray
log = logging.getLogger(__name__)

#: What is learned on the mesh and with surfels alike.
_SHARED = ("exposure", "light")
#: Part of the schedule of stage (i) at which surfels go on: its step sizes at the end.
_LATE = 0.9
#: Pixels covered less show no surfel's normal, and coverage counts as so much at the least.
_COVERED, _LEAST = 0.5, 0.05


@dataclass(frozen=True, slots=True)
class LearnedSurfels:
    """Surfels of stage (i), and what learning them further needs.

    Attributes
    ----------
    gaussians : Gaussians
        On the CPU; changed in place.
    schedule : Schedule
        Of stage (i): weights of its losses.
    radius : float
        Of the object, metres.
    fused : callable
        Makes a mesh from the surfels, and a report of it.
    """

    gaussians: Gaussians
    schedule: SurfelSchedule
    radius: float
    fused: Callable[[Gaussians], tuple[Mesh, dict[str, Any]]]


def decouple_jointly(
    capture: Capture,
    mesh: Mesh,
    surfels: LearnedSurfels,
    settings: Settings,
    on_progress: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    checkpoint: Path | None = None,
    on_surfels: bool = False,
    start: Array | None = None,
    now: Callable[[], float] = time.monotonic,
) -> Decoupled:
    """`run.decouple` on the CPU, in whose last part (`Settings.joint`) the surfels are learned, too.

    Parameters
    ----------
    capture : Capture
    mesh : Mesh
    surfels : LearnedSurfels
    settings : Settings
    on_progress : callable, optional
    cancelled : callable, optional
    checkpoint : Path, optional
    on_surfels : bool
        The first part is on the surfels as they are.
    start : (v, 3) float32 array, optional
    now : callable

    Returns
    -------
    Decoupled
        With `Decoupled.surfels`, its mesh among them.
    """
    schedule = Schedule(settings, now)
    domain = domain_of(capture, mesh, settings, start, surfels.gaussians if on_surfels else None)
    job = JointJob(capture, domain, mesh, surfels, settings, checkpoint, schedule)
    return learned(job, on_progress, cancelled)


class JointJob(Job):
    """A run whose last steps move surfels; see `decouple_jointly` for the parameters.

    Attributes
    ----------
    learner : Learner
        Of the surfels.
    """

    def __init__(
        self, capture: Capture, domain: Domain, mesh: Mesh, surfels: LearnedSurfels, settings: Settings,
        checkpoint: Path | None, schedule: Schedule,
    ) -> None:  # fmt: skip
        #: Materials of the surfels, once they are learned.
        self._own: Materials | None = None
        self._surfels = surfels
        super().__init__(capture, domain, mesh, settings, checkpoint, CPU, schedule)
        self._fused = surfels.fused
        background = torch.tensor(background_of(capture), dtype=torch.float32)
        self.learner = Learner(surfels.gaussians, surfels.schedule, surfels.radius, background, CPU)

    def _shape(self) -> list[Array]:
        schedule = np.frombuffer(repr(self._surfels.schedule).encode(), np.uint8)
        return [*super()._shape(), schedule, *self._surfels.gaussians.arrays().values()]

    def step(self) -> None:
        """One step of the optimiser."""
        if self._own is None and self.schedule.part >= 1 - self._settings.joint:
            self._begin()
        super().step()

    def _begin(self) -> None:
        """Learn materials of the surfels from now on, beginning with those of the first part."""
        gaussians, settings = self.learner.gaussians, self._settings
        surfels = gaussians.surfels()
        assert surfels.sh is not None
        edges = neighbours(surfels.centre, gaussians.frames()[2])
        finer = fineness(surfels.centre, edges)
        own = Materials(surfels.centre, settings.parametrisation, levels(settings.coarse, finer))
        with torch.no_grad():
            known = self.surface.materials.at(torch.arange(len(self._domain.points)))
            if self._domain.surfels is not None:
                own.begin(known)
            else:
                binding, _ = bind(self._mesh, surfels)
                corners = torch.from_numpy(self._mesh.faces[binding.face].astype(np.int64))
                shares = torch.from_numpy(clamp_weights(binding.barycentric).astype(np.float32))
                own.begin(blend(known, corners, shares))
                if self._shown is not None:
                    shown = blend(torch.from_numpy(self._shown), corners, shares).numpy()
                    self._like = LikePoints(shown, surfels.centre, settings.seed)
        colours = srgb_to_linear(np.clip(0.5 + SH_C0 * surfels.sh[:, 0], 0, 1))
        self._regularisers = Regularisers(edges, colours, settings, finer)
        # Light and exposures go on; moments that begin at 0 need a count of steps that does, too.
        self._own, self._adam_of_own = own, Adam(own.parameters)
        for moments in (self._adam.first, self._adam.second):
            for name in self.surface.parameters:
                del moments[name]
        self._keep_views()

    def _keep_views(self) -> None:
        """Photographs as stage (i) cuts them, and the pixels within."""
        views, self._targets = self._capture.training, full_targets(self._capture)
        y, x = self._places(self._pixels)
        sizes = np.array([(target.camera.width, target.camera.height) for target in self._targets])
        width, height = sizes[self._pixels.view].T
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if not inside.any():
            problem = "has no pixel of the surface where its masks show the object"
            raise UsageError(str(self._capture.source), problem, "Check the masks, or set decoupling.joint to 0")
        if not inside.all():
            log.info("joint learning: %d of %d pixels are beside the cut photographs", (~inside).sum(), len(inside))
            self._pixels = self._pixels.select(np.flatnonzero(inside))
        #: Where the pixels of each view begin, and the views that have any.
        self._first = np.searchsorted(self._pixels.view, np.arange(len(views) + 1))
        self._views = np.flatnonzero(np.diff(self._first))

    def _places(self, pixels: Pixels) -> tuple[Array, Array]:
        """Rows and columns (m,) of pixels in the photographs as they are cut."""
        cameras = [view.camera for view in self._capture.training]
        cut = [target.camera for target in self._targets]
        left, top = np.array([corner_of(a, b) for a, b in zip(cut, cameras, strict=True)]).T
        y, x = np.divmod(pixels.place.astype(np.int64), np.array([camera.width for camera in cameras])[pixels.view])
        return y - top[pixels.view], x - left[pixels.view]

    def _descend(self, learned: dict[str, Tensor], rates: dict[str, float | Array]) -> None:
        if self._own is None:
            return super()._descend(learned, rates)
        own = self._own.parameters
        self._adam_of_own.step(own, rates)
        self._adam.step({name: value for name, value in learned.items() if name not in own}, rates)

    def _optimisers(self) -> list[Adam]:
        return super()._optimisers() + ([] if self._own is None else [self._adam_of_own])

    def _learned(self) -> dict[str, Tensor]:
        known = super()._learned()
        if self._own is None:
            return known
        return self._own.parameters | {name: known[name] for name in _SHARED if name in known}

    def _view(self) -> int:
        """Number of the view of a step: all in turn, in an order drawn again each time."""
        turn, place = divmod(self.schedule.iteration, len(self._views))
        return int(np.random.default_rng([self._settings.seed, turn]).permutation(self._views)[place])

    def _range(self) -> tuple[int, int]:
        if self._own is None:
            return super()._range()
        k = self._view()
        return int(self._first[k]), int(self._first[k + 1])

    def _backward(self, pixels: Pixels, key: Array, edge: Array, pairs: Pairs | None) -> None:
        if self._own is None:
            return super()._backward(pixels, key, edge, pairs)
        k = self._view()
        columns, ends = self._columns(), torch.from_numpy(self._regularisers.edges(edge))

        def lit(rendered: RenderedView) -> Tensor:
            materials, normal = self._seen(rendered, pixels)
            return self._loss(SurfaceSamples(materials, normal, columns, None, ends, pairs), pixels, key, edge)

        part = _LATE + (1 - _LATE) * min(self.schedule.part, 1.0)
        self.learner.step(self._targets[k], part, materials=columns, loss_of=lit)

    def _columns(self) -> Tensor:
        """Columns (n, c) of all surfels, with derivatives."""
        assert self._own is not None
        return self._own.at(torch.arange(len(self.learner.gaussians)))

    def _seen(self, rendered: RenderedView, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Blended materials (m, c) and unit normals (m, 3) of pixels of the view that is rendered."""
        y, x = (torch.from_numpy(at) for at in self._places(pixels))
        assert rendered.materials is not None
        alpha, normal = rendered.maps.alpha[y, x][:, None], rendered.normal[y, x]
        materials = (rendered.materials[y, x] / alpha.clamp(min=_LEAST)).clamp(0, 1)
        flat = torch.from_numpy(pixels.flat)
        # As surfels are shaded when they are rendered.
        unit = normalise(normal)
        believed = (alpha > _COVERED) & (normal.norm(dim=1, keepdim=True) > _LEAST)
        return materials, torch.where(believed & (dot(unit, flat)[:, None] >= ALIKE), unit, flat)

    def result(self) -> Decoupled:
        """What is learned so far; with surfels the mesh is fused anew."""
        if self._own is None:
            return super().result()
        gaussians, views = self.learner.gaussians, self._capture.training
        mesh, fusion = self._fused(gaussians)
        with torch.no_grad():
            columns, known = carried(self._columns().numpy(), mesh, gaussians, views)
            values = np.column_stack(self._own.described(torch.from_numpy(columns)))
        found = self._found(values, known, with_surfel_normals(mesh, views, normals_of(gaussians)))
        normals = gaussians.frames()[2].astype(np.float32)
        found.surfels = DecoupledSurfels(gaussians, *self._own.values(), normals, mesh, fusion)
        return found

    def _state(self) -> dict[str, Array]:
        state = super()._state()
        if self._own is None:
            return state
        learner = self.learner
        state |= {f"surfels/{name}": values for name, values in learner.arrays().items()}
        return state | {"surfels.numbers": np.array([learner.iteration, learner.error])}

    def _restore(self, state: dict[str, Array]) -> None:
        if "surfels.numbers" in state:
            prefix = "surfels/"
            self._begin()
            self.learner.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
            iteration, self.learner.error = (float(x) for x in state["surfels.numbers"])
            # Both were made for the first of these steps.
            self.learner.iteration = self._adam_of_own.steps = int(iteration)
        super()._restore(state)
