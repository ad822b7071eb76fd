"""The order of training views: one for each step, in turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ..backend import LearningBackend
from ..capture.training_views import Target, half_target
from .initialisation_trial import is_held_out

#: Pixels of all views up to which these stay on a device, 16 bytes each.
KEPT_ON_DEVICE = 100_000_000


class Views:
    """The training views, in the memory of a backend.

    Parameters
    ----------
    targets : list of Target
        Training views in full size; those in half size are made when they are asked for, and kept.
    background : tuple of float
        sRGB colour of `training_views.background_of`.
    backend : LearningBackend
    seed : int
        Of the order of the views.

    Attributes
    ----------
    full : list of Target
    background : (3,) float32 tensor
    """

    def __init__(
        self, targets: list[Target], background: tuple[float, float, float], backend: LearningBackend, seed: int
    ) -> None:
        self._backend, self._seed = backend, seed
        self.background = torch.tensor(background, dtype=torch.float32, device=backend.device)
        pixels = 1.25 * sum(view.camera.width * view.camera.height for view in targets)
        self._few, self._targets = pixels <= KEPT_ON_DEVICE, targets
        self.full = [backend.bring(view) for view in targets] if self._few else targets
        self._halves: dict[int, Target] = {}

    def of_step(self, iteration: int, half: bool, without_held_out: bool) -> Target:
        """The view of a step: all in turn, in an order drawn again each time.

        Parameters
        ----------
        iteration : int
        half : bool
            In half size.
        without_held_out : bool
            Without the views that a trial holds out.
        """
        return self._backend.bring(self._view(self._number(iteration, without_held_out), half))

    def beside(self, iteration: int, half: bool, without_held_out: bool, near: list[list[int]]) -> Target | None:
        """One of the views `near` (`capture.neighbours`) that of a step, drawn anew each time; None: it has none."""
        numbers = near[self._number(iteration, without_held_out)]
        numbers = [k for k in numbers if not (without_held_out and is_held_out(k))]
        if not numbers:
            return None
        return self._backend.bring(self._view(np.random.default_rng([self._seed, iteration, 1]).choice(numbers), half))

    def _view(self, number: int, half: bool) -> Target:
        """A view, on the device where all are kept there."""
        if not half:
            return self.full[number]
        if number not in self._halves:
            made = half_target(self._targets[number])
            self._halves[number] = self._backend.bring(made) if self._few else made
        return self._halves[number]

    def _number(self, iteration: int, without_held_out: bool) -> int:
        """Number of the view of a step."""
        numbers = [k for k in range(len(self.full)) if not (without_held_out and is_held_out(k))]
        turn, place = divmod(iteration, len(numbers))
        return numbers[np.random.default_rng([self._seed, turn]).permutation(len(numbers))[place]]

    def held_out(self) -> Iterator[Target]:
        """The views that a trial holds out, in half size."""
        return (self._backend.bring(self._view(k, half=True)) for k in range(len(self.full)) if is_held_out(k))
