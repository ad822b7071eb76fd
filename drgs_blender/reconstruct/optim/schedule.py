"""The training schedule of surfels: steps, weights of the losses, learning rates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array

#: Learning rates at the start, and what is left of them at the end; of centres a part of the object's radius.
RATES = {"centre": (1.5e-3, 0.01), "scale": (8e-3, 0.2), "rotation": (4e-3, 0.2), "opacity": (4e-2, 0.3)}
RATES |= {"tint": (6e-2, 0.2), "blur": (6e-2, 0.2)}
LIGHT_RATE = (4e-2, 0.1)
COLOUR_RATE, HIGHER_BANDS = (2e-2, 0.1), 0.1


@dataclass(frozen=True, slots=True)
class Schedule:
    """Settings of the training of surfels.

    Attributes
    ----------
    iterations : int
        Steps, one view each.
    surfels : int
        How many there are at the end of densification, at most: see `initialisation.surfel_limit`.
    coarse : float
        Part of the steps that is done at half size.
    densify : tuple of float
        Parts of the steps between which surfels are cut; `rounds` times.
    shape : float
        Part of the steps after which distortion and normals count.
    mask, distortion, consistency : float
        Weights of the losses.
    median : float
        Part of the median in the depth whose normals surfels are to have (`consistency`); the rest is the mean.
    patches : float
        Weight of the consistency of patches between a view and a neighbour of it (`losses.patches`), 0 for none.
    patches_from : float
        Part of the steps after which it counts.
    patches_spread : float
        Difference of a patch's grey between both views at which it counts 1 / e: what mirrors counts less; 0: no less.
    reflections : float
        Part of the steps after which reflections are learned; 1 never.
    bands : int
        Highest band of the colour's harmonics.
    """

    iterations: int = 3000
    surfels: int = 16000
    coarse: float = 0.3
    densify: tuple[float, float] = (0.08, 0.6)
    rounds: int = 16
    shape: float = 0.15
    mask: float = 0.1
    distortion: float = 1.0
    consistency: float = 0.25
    median: float = 0.0
    patches: float = 0.0
    patches_from: float = 0.3
    patches_spread: float = 0.1
    reflections: float = 0.1
    bands: int = 2
    seed: int = 0

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
    rates["offset"] = RATES["centre"][0] * RATES["centre"][1] ** part * 30
    colour = COLOUR_RATE[0] * COLOUR_RATE[1] ** part
    rates["sh"] = np.repeat(np.where(np.arange(harmonics) == 0, colour, HIGHER_BANDS * colour), 3)
    return rates
