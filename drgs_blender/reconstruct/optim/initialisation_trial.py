"""Trial of two initialisations: both are trained for a while; the one that predicts held-out views better goes on."""

from __future__ import annotations

import logging
import math

import numpy as np

from ...core.arrays import Array
from ..model.gaussians import Gaussians

log = logging.getLogger(__name__)

#: Part of the schedule for which both starts of `initialisation` are tried.
TRIAL = 0.2
#: Every n-th view is held out of a trial, to compare the starts by.
HOLDOUT_EVERY = 8
#: Least gain in PSNR in these views, in decibels, for which surfels inside the hull are taken.
MIN_GAIN_DB = 0.75
#: Fewest training views with which there is a trial.
MIN_VIEWS = 16
#: Key of the first start's error among the arrays of checkpoints.
_ERROR = "aside"


def is_held_out(view: int) -> bool:
    """Whether a trial does not train on the view of this number, but compares the starts by it."""
    return view % HOLDOUT_EVERY == HOLDOUT_EVERY // 2


class Trial:
    """State of the trial of two starts.

    Parameters
    ----------
    rival : Gaussians, optional
        The second start; None for no trial.

    Attributes
    ----------
    rival : Gaussians or None
        None at the end.
    first : dict or None
        State of the first start at the end of its turn, with its error in the held-out views; before that None.
    """

    def __init__(self, rival: Gaussians | None) -> None:
        self.rival = rival
        self.first: dict[str, Array] | None = None

    @property
    def goes_on(self) -> bool:
        """Whether two starts are being tried."""
        return self.rival is not None

    def is_due(self, part: float, iteration: int) -> bool:
        """Whether the turn of the present start is over, at this part of the schedule and after `iteration` steps."""
        # As many steps as the first start had, at most: the first one's time contains the compilation of kernels.
        even = self.first is not None and iteration >= self.first["counts"][0]
        return self.goes_on and (part >= TRIAL or bool(even))

    def store_first(self, state: dict[str, Array], error: float) -> Gaussians:
        """Keep the state of the first start and its mean squared error; returns the other one."""
        assert self.rival is not None
        self.first = state | {_ERROR: np.array([error])}
        return self.rival

    def decide(self, error: float) -> dict[str, Array] | None:
        """End the trial by the second start's mean squared error: the state of the first one where that is better."""
        first = self.first
        assert first is not None
        gain = 10 * math.log10(max(float(first[_ERROR][0]), 1e-10) / max(error, 1e-10))
        log.info("surfels inside the hull: %+.2f dB in held-out views", gain)
        self.end()
        return None if gain >= MIN_GAIN_DB else first  # nor what is no number

    def end(self) -> None:
        """Go on with the present start alone."""
        self.rival = self.first = None

    def arrays(self) -> dict[str, Array]:
        """The arrays that `restore` needs; none where no trial goes on."""
        if not self.goes_on:
            return {}
        return {"trying": np.ones(1, np.int64)} | {f"before.{k}": v for k, v in (self.first or {}).items()}

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from what `arrays` returned, among other arrays."""
        if "trying" not in state:
            self.end()
        first = {k.removeprefix("before."): v for k, v in state.items() if k.startswith("before.")}
        self.first = first if self.goes_on and first else None
