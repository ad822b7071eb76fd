"""How the demos show linear pictures: highlights roll off, as on film."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drgs_blender.core.color import linear_to_srgb
from drgs_blender.render.film.frame_files import read_frame

#: Linear value from which on the curve bends; it ends at 1, which is reached by none.
SHOULDER = 0.5


def displayed(linear: np.ndarray) -> np.ndarray:
    """Linear Rec.709 as sRGB from 0 to 1: a straight line up to `SHOULDER`, then ever flatter; any shape."""
    above = np.maximum(linear - SHOULDER, 0) / (1 - SHOULDER)
    return linear_to_srgb(np.clip(np.minimum(linear, SHOULDER) + (1 - SHOULDER) * (1 - np.exp(-above)), 0, 1))


def with_alpha(linear: np.ndarray, curve=displayed) -> np.ndarray:
    """Premultiplied linear (h, w, 4) as sRGB by `curve`, with straight alpha."""
    alpha = np.clip(linear[..., 3:], 0, 1)
    return np.concatenate([curve(linear[..., :3] / np.maximum(alpha, 1e-6)), alpha], axis=-1)


def over(picture: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a picture with straight alpha over a ground."""
    return picture[..., 3:] * picture[..., :3] + (1 - picture[..., 3:]) * ground


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """Values from 0 to 1 as 8-bit numbers."""
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


def combined(path: Path) -> np.ndarray:
    """(h, w, 4) linear picture of a rendered frame."""
    return read_frame(path)[0]["Combined"]
