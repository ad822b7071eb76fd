"""One optimiser step: a view is rendered, compared with its photograph, and all parameters are updated."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ..backend import LearningBackend
from ..capture.training_views import Target, pixel_rays
from ..losses.patches import REACH, Pair
from ..losses.photometric import Photograph
from ..model.attributes import TINT
from ..model.gaussians import Gaussians, RenderedView
from ..model.raster import GradientStatistics, Maps
from ..torch_threads import one_thread
from .adam import Adam
from .densification import densify
from .schedule import LIGHT_RATE, Schedule, learning_rates

log = logging.getLogger(__name__)

#: Part of the weight of `Schedule.consistency` that matte pixels have, and what the tint of mirrors adds to it.
MATTE, MIRRORED = 0.2, 5.0
#: Weights of sRGB-encoded red, green and blue in grey (ITU-R BT.601).
LUMA = (0.299, 0.587, 0.114)


class Learner:
    """Surfels and the state of their optimisation, on one backend.

    Parameters
    ----------
    gaussians : Gaussians
        To begin with.
    schedule : Schedule
    radius : float
        Of the object, metres.
    background : (3,) float32 tensor
        On the device of `backend`.
    backend : LearningBackend

    Attributes
    ----------
    gaussians : Gaussians
    optimiser, light : Adam
        Of the surfels' parameters; of the light that they mirror.
    statistics : GradientStatistics
        Gradient statistics for densification.
    iteration : int
        Steps that are done.
    error : float
        Running mean of the squared error of pictures.
    """

    def __init__(
        self, gaussians: Gaussians, schedule: Schedule, radius: float, background: Tensor, backend: LearningBackend
    ) -> None:
        self._schedule, self._radius, self._background, self._backend = schedule, radius, background, backend
        self.gaussians = gaussians.on(backend)
        self.optimiser = Adam(self.gaussians.parameters, backend.descend)
        light = self.gaussians.light
        self.light = Adam({} if light is None else {"light": light}, backend.descend)
        self.statistics = GradientStatistics.of(len(self.gaussians), backend.device)
        self.iteration, self.error = 0, 0.0

    def step(
        self,
        target: Target,
        part: float,
        beside: Target | None = None,
        materials: Tensor | None = None,
        loss_of: Callable[[RenderedView], Tensor] | None = None,
    ) -> None:
        """Learn from one view, and from what it has in common with another.

        Parameters
        ----------
        target : Target
            Where the CPU can read it.
        part : float
            Fraction of the schedule that is done, 0..1.
        beside : Target, optional
            A view of the same from another place, for the consistency of patches.
        materials : (n, c) tensor, optional
            To be blended beside the colours.
        loss_of : callable, optional
            A further loss, of the rendered view.
        """
        # Also when done again, after a device has left it half-done.
        self.optimiser.steps = self.light.steps = self.iteration
        with one_thread():
            rendered, rays = self._render(target, part, materials)
            loss = self._loss(rendered, target, rays, part)
            if beside is not None:
                loss = loss + self._schedule.patches * self._patch_loss(rendered, target, rays, beside)
            loss = target.share * loss
            if loss_of is not None:
                loss = loss + loss_of(rendered)
            loss.backward()
            self._optimise(part)
            squared = _squared_error(rendered, target)
        self.error = squared if not self.iteration else 0.98 * self.error + 0.02 * squared
        self.iteration += 1

    def _render(self, target: Target, part: float, materials: Tensor | None) -> tuple[RenderedView, Tensor]:
        """The surfels as the view sees them, and its rays."""
        schedule = self._schedule
        rays = pixel_rays(target.camera, self._backend.device)
        statistics = self.statistics if part < schedule.densify[1] else None
        reflections = part >= schedule.reflections < 1
        bands = min(schedule.bands, int(part * 8))
        behind = self._behind(target)
        seen = self.gaussians.render(
            target.camera, behind, bands, statistics, rays, reflections, materials, target.turn
        )
        return seen, rays

    def _behind(self, target: Target) -> Tensor:
        """What is behind the surfels: (3,), or (h, w, 3)."""
        return self._background if target.background is None else target.background

    def _optimise(self, part: float) -> None:
        parameters = self.gaussians.parameters
        self.optimiser.step(parameters, learning_rates(part, self._radius, parameters["sh"].shape[1]))
        if self.gaussians.light is not None:
            self.light.step({"light": self.gaussians.light}, {"light": LIGHT_RATE[0] * LIGHT_RATE[1] ** part})

    def _loss(self, rendered: RenderedView, target: Target, rays: Tensor, part: float) -> Tensor:
        schedule, maps = self._schedule, rendered.maps
        shaped = part >= schedule.shape
        weights = (
            schedule.mask,
            schedule.distortion / self._radius**2 if shaped else 0.0,
            schedule.consistency if shaped else 0.0,
        )
        photograph, mask = _taught(rendered, target)
        counts, depth = _importance(maps.features), maps.depth
        if schedule.median and shaped:
            depth = torch.lerp(depth, _weighted_median(maps), schedule.median)
        shape = self._backend.shape_loss(
            maps.alpha, depth, maps.distortion, rendered.normal, mask, rays, counts, weights
        )
        if target.normals is not None and part < schedule.normal_prior_until:
            weight = schedule.normal_prior * (1 - part / schedule.normal_prior_until)
            shape = shape + weight * _disagreement(rendered, target.normals)
        return self._backend.difference(rendered.colour, photograph) + shape

    def _patch_loss(self, rendered: RenderedView, target: Target, rays: Tensor, beside: Target) -> Tensor:
        """Consistency of patches with those of the view `beside`."""
        gaussians, backend = self.gaussians, self._backend
        with torch.no_grad():
            centre, eye = gaussians.centres(), np.asarray(beside.camera.matrix_world)[:3, 3]
            u, v, opacity, features = backend.attributes(gaussians.parameters, centre, eye, 0, False)
            behind = backend.rasterise(centre, u, v, opacity, features[:, :1], beside.camera).median
        median, greys = rendered.maps.median, (_grey(target), _grey(beside))
        pair, spread = Pair.of(target.camera, beside.camera), self._schedule.patches_spread
        counts = torch.ones_like(median)
        if target.unknown is not None:  # and patches that show it
            shown = torch.nn.functional.max_pool2d(target.unknown[None].float(), 2 * REACH + 1, 1, REACH)[0]
            counts = counts - shown
        return backend.patch_loss(median, rendered.normal, counts, rays, greys, behind, pair, spread)

    def densify(self, budget: int) -> None:
        """Cut surfels, until there are `budget` at most."""
        self.gaussians, report = densify(
            self.gaussians, self.optimiser, self.statistics, budget, 0.5 * self._radius, 1e-3 * self._radius
        )
        self.statistics = GradientStatistics.of(len(self.gaussians), self._backend.device)
        log.debug("step %d: %d surfels, %s", self.iteration, len(self.gaussians), report)

    def error_of(self, views: Iterable[Target]) -> float:
        """Mean squared error of views, of colours of 0..1."""
        errors = []
        for target in views:
            with torch.no_grad():
                seen = self.gaussians.render(target.camera, self._behind(target), turn=target.turn)
                errors.append(_squared_error(seen, target))
        return float(np.mean(errors))

    def arrays(self) -> dict[str, Array]:
        """Surfels, light, moments and statistics, by name: what `restore` needs beside the counts of steps."""
        tensors = {"gradient": self.statistics.gradient, "views": self.statistics.views}
        tensors |= {f"first.{k}": v for k, v in self.optimiser.first.items()}
        tensors |= {f"second.{k}": v for k, v in self.optimiser.second.items()}
        if self.gaussians.light is not None:
            tensors |= {"light": self.gaussians.light, "light.first": self.light.first["light"]}
            tensors["light.second"] = self.light.second["light"]
        state = {f"value.{k}": v for k, v in self.gaussians.arrays().items()}
        return state | {k: v.numpy(force=True) for k, v in tensors.items()}

    def restore(self, state: dict[str, Array]) -> None:
        """Take the surfels of another learner, also of another backend, from its `arrays`."""
        there = lambda name: torch.tensor(state[name], device=self._backend.device)  # noqa: E731
        part = lambda name: {k.removeprefix(name): there(k) for k in state if k.startswith(name)}  # noqa: E731
        if self.gaussians.light is not None:
            self.gaussians.light = there("light").requires_grad_(True)
            self.light.first, self.light.second = {"light": there("light.first")}, {"light": there("light.second")}
        self.gaussians = self.gaussians.like(part("value."))
        self.optimiser.first, self.optimiser.second = part("first."), part("second.")
        self.statistics = GradientStatistics(there("gradient"), there("views"))


def _weighted_median(maps: Maps) -> Tensor:
    """(h, w): median depth times alpha, by which `shape_loss` divides; where less than half is covered, the mean's."""
    return torch.where(maps.median > 0, maps.median * maps.alpha, maps.depth)


def _disagreement(rendered: RenderedView, normals: Tensor) -> Tensor:
    """Mean of 1 - cosine between the surfels' normals and those given (h, w, 3), as far as pixels are covered."""
    known = (normals != 0).any(-1)
    return torch.where(known, rendered.maps.alpha - (rendered.normal * normals).sum(-1), 0.0).mean()


def _taught(rendered: RenderedView, target: Target) -> tuple[Photograph | Tensor, Tensor | None]:
    """Photograph and mask that a rendered view is compared with: what it shows itself where the mask may be wrong."""
    if target.unknown is None or target.mask is None:
        return target.photograph, target.mask
    colour = torch.where(target.unknown[..., None], rendered.colour.detach(), target.colour)
    mask = torch.where(target.unknown, rendered.maps.alpha.detach(), target.mask)
    if isinstance(target.photograph, Photograph):
        return Photograph.of(colour.numpy(), keep=False), mask
    return colour, mask


def _grey(target: Target) -> Tensor:
    """(h, w) luma of the photograph."""
    return target.colour @ torch.tensor(LUMA, device=target.colour.device)


def _squared_error(rendered: RenderedView, target: Target) -> float:
    """Mean over the picture that the view is cut from."""
    squared = (rendered.colour.detach().clamp(0, 1) - target.colour).square()
    if target.unknown is not None:
        squared = squared.masked_fill(target.unknown[..., None], 0.0)
    return target.share * float(squared.mean())


def _importance(features: Tensor) -> Tensor:
    """(h, w) float32 in 0..1, what the agreement of normals counts: where a surface mirrors, they decide its colour.

    Where it does not, the agreement mostly rounds off edges: on the toy bulldozer of NeRF-synthetic it cost 0.7 dB.
    """
    # A sum: the mean of no channels is none.
    return (MATTE + MIRRORED / 3 * features.detach()[..., TINT : TINT + 3].sum(-1)).clamp(max=1)
