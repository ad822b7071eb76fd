"""The training schedule of surfels: steps, weights of the losses, learning rates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ...core.arrays import Array
from ...core.errors import UsageError
from ..ranges import Part, Range, Weight, check

#: Learning rates at the start, and what is left of them at the end; of centres a part of the object's radius.
RATES = {"centre": (3e-3, 0.01), "scale": (8e-3, 0.2), "rotation": (8e-3, 0.2), "opacity": (4e-2, 0.3)}
RATES |= {"tint": (6e-2, 0.2), "blur": (6e-2, 0.2)}
LIGHT_RATE = (4e-2, 0.1)
#: Of the offsets of surfels on faces, edges of the face.
OFFSET_RATE = (4.5e-2, 0.01)
COLOUR_RATE, HIGHER_BANDS = (2e-2, 0.1), 0.1


@dataclass(frozen=True, slots=True)
class Schedule:
    """Settings of the training of surfels.

    Attributes
    ----------
    iterations : int
        Steps, one view each.
    surfels : int, optional
        At most so many at the end of densification; for small pictures fewer. None: as many as the photographs show,
        see `initialisation.surfel_limit`.
    coarse : float
        Part of the steps that is done at half size: they take a quarter of the time, and cost detail.
    densify : tuple of float
        Parts of the steps between which surfels are cut, `rounds` times.
    rounds : int
        How often surfels are cut.
    shape : float
        Part of the steps after which distortion and normals count.
    mask : float
        Weight of the mask's loss.
    distortion : float
        Weight of the depth distortion, which gathers the surfels of a ray at one depth.
    consistency : float
        Weight of the consistency of normals with those of the depth map.
    median : float
        Part of the median in the depth whose normals surfels are to have (`consistency`); the rest is the mean.
    patches : float
        Weight of the consistency of patches between a view and a neighbour of it (`losses.patches`), 0 for none.
    patches_from : float
        Part of the steps after which it counts.
    patches_spread : float
        Difference of a patch's grey between both views at which it counts 1 / e: what mirrors counts less; 0: no less.
    normal_prior : float
        Weight of normals that a model gives (`capture.normals`) at the start, from where it falls to 0.
    normal_prior_until : float
        Part of the steps after which they count no more: what the photographs show of shape is finer.
    reflections : float
        Part of the steps after which reflections are learned; 1 never.
    bands : int
        Highest band of the colour's harmonics.
    seed : int
        Of all random numbers.
    """

    iterations: Annotated[int, Range(1, 10_000_000)] = 3000
    surfels: Annotated[int | None, Range(10, 5_000_000)] = None
    coarse: Part = 0.0
    densify: tuple[Part, Part] = (0.08, 0.6)
    rounds: Annotated[int, Range(0, 1000)] = 16
    shape: Part = 0.15
    mask: Weight = 0.5
    distortion: Weight = 1.0
    consistency: Weight = 0.25
    median: Part = 0.0
    patches: Weight = 0.0
    patches_from: Part = 0.3
    patches_spread: Weight = 0.1
    normal_prior: Weight = 0.3
    normal_prior_until: Part = 0.7
    reflections: Part = 0.1
    bands: Annotated[int, Range(0, 3)] = 2
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0

    def check(self, prefix: str = "schedule.") -> None:
        """Raise UsageError on what cannot be used; `prefix` is put before names."""
        check(self, prefix)
        begin, end = self.densify
        if begin >= end:
            problem = f"ends at {end:g} of the steps and begins at {begin:g}"
            raise UsageError(f"{prefix}densify", problem, "Give the smaller part first")

    def on_mesh(self, part: float) -> Schedule:
        """For surfels that have their place: `part` of the steps, in full size, and no more surfels."""
        return replace(
            self, iterations=max(int(part * self.iterations), 1), coarse=0.0, rounds=0, shape=0.0, reflections=0.0
        )


def learning_rates(part: float, radius: float, harmonics: int) -> dict[str, float | Array]:
    """Rates of the parameters of surfels.

    Parameters
    ----------
    part : float
        Fraction of the schedule that is done, 0..1.
    radius : float
        Of the object, metres.
    harmonics : int
        How many a surfel's colour has.

    Returns
    -------
    dict
        Rate by name, of "sh" one per column.
    """
    rates: dict[str, float | Array] = {k: first * rest**part for k, (first, rest) in RATES.items()}
    rates["centre"] = float(rates["centre"]) * radius
    rates["offset"] = OFFSET_RATE[0] * OFFSET_RATE[1] ** part
    colour = COLOUR_RATE[0] * COLOUR_RATE[1] ** part
    rates["sh"] = np.repeat(np.where(np.arange(harmonics) == 0, colour, HIGHER_BANDS * colour), 3)
    return rates
