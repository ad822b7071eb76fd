"""The learned light, and the light that pixels gather."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from .environment import LearnedLight
from .estimator import Points
from .gatherer import Gatherer
from .pixels import Pixels
from .settings import Settings

Array = np.ndarray


class Lighting:
    """An environment that grows, and the directions in which its light is looked for.

    Parameters
    ----------
    gatherer : Gatherer
    settings : Settings
    level : float
        Radiance to begin with.
    turns : list of array
        `View.turn` of the views; empty where the light stands still in the world.

    Attributes
    ----------
    learned : LearnedLight
    aimed : (h, 2 h, 3) float32 array
        The radiance by which directions are drawn.
    """

    def __init__(self, gatherer: Gatherer, settings: Settings, level: float, turns: list[Array]) -> None:
        self._gatherer, self._rows = gatherer, settings.environment
        self._turns = np.array(turns, np.float32).reshape(-1, 3, 3)
        self.learned = LearnedLight(settings.environment // (4 if settings.coarse_to_fine else 1), level)
        self.aimed: Array = np.ones((2, 4, 3), np.float32)

    def grow(self, ahead: int) -> bool:
        """Double the rows until `ahead` doublings are left; False where none was due."""
        grown = False
        while self._rows // len(self.learned.log) > 1 << ahead:
            self.learned.grow()
            grown = True
        return grown

    def aim(self, radiance: Array) -> None:
        """Draw directions by this radiance (h, 2 h, 3) from now on."""
        self.aimed = radiance
        self._gatherer.aim(radiance)

    def gather(self, pixels: Pixels, key: Array, normal: Tensor, alpha2: Tensor, radiance: Tensor) -> Tensor:
        """Sums of light at pixels: `Gatherer`."""
        turn = self._turns[pixels.view] if len(self._turns) else self._turns
        points = Points(pixels.origin, pixels.flat, pixels.towards, key, turn)
        return self._gatherer(points, normal, alpha2, radiance)
