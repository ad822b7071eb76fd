"""FLIP: how different two pictures look when they are flipped back and forth, by NVIDIA's own package.

After Andersson et al., "FLIP: A Difference Evaluator for Alternating Images" (HPG 2020), for pictures of display range.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

Array = np.ndarray
logger = logging.getLogger(__name__)


def find_flip() -> Callable[[Array, Array], float] | None:
    """`flip`, or None where its package is not installed, which a warning says."""
    try:
        import flip_evaluator  # noqa: F401
    except ImportError as error:
        logger.warning(
            "FLIP is not computed: the package flip-evaluator cannot be imported (%s). Install it: "
            "pip install flip-evaluator",
            error,
        )
        return None
    return flip


def flip(picture: Array, reference: Array) -> float:
    """Mean difference in [0, 1] of two (h, w, 3) sRGB-encoded pictures, clipped to [0, 1].

    They are seen as the package's defaults say: on a screen 0.7 m wide with 3840 pixels, from 0.7 m.
    """
    from flip_evaluator import evaluate

    given = [np.ascontiguousarray(np.clip(image, 0, 1), np.float32) for image in (reference, picture)]
    differences = evaluate(*given, "LDR", applyMagma=False, computeMeanError=False)[0]
    # Its own mean adds up in single precision: off by 7e-4 for 320 x 240 pixels.
    return float(np.mean(differences, dtype=np.float64))
