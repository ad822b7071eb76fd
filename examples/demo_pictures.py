"""How the demos show linear pictures: highlights roll off, as on film."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from drgs_blender.core.color import linear_to_srgb
from drgs_blender.render.film.frame_files import read_frame

#: Linear value from which on the curve bends; it ends at 1, which is reached by none.
SHOULDER = 0.5
#: Behind objects that stand alone, sRGB.
GROUND = (43, 45, 48)


def displayed(linear: np.ndarray) -> np.ndarray:
    """Linear Rec.709 as sRGB from 0 to 1: a straight line up to `SHOULDER`, then ever flatter; any shape."""
    above = np.maximum(linear - SHOULDER, 0) / (1 - SHOULDER)
    return linear_to_srgb(np.clip(np.minimum(linear, SHOULDER) + (1 - SHOULDER) * (1 - np.exp(-above)), 0, 1))


def with_alpha(linear: np.ndarray, curve=displayed) -> np.ndarray:
    """Premultiplied linear (h, w, 4) as sRGB by `curve`, with straight alpha."""
    alpha = np.clip(linear[..., 3:], 0, 1)
    return np.concatenate([curve(linear[..., :3] / np.maximum(alpha, 1e-6)), alpha], axis=-1)


def covered(values: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """(h, w, 4) of a pass, (h, w, 3) or (h, w, 1), with its coverage (h, w, 1) as straight alpha."""
    return np.concatenate([np.broadcast_to(values, (*cover.shape[:2], 3)), np.clip(cover, 0, 1)], axis=-1)


def over(picture: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a picture with straight alpha over a ground."""
    return picture[..., 3:] * picture[..., :3] + (1 - picture[..., 3:]) * ground


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """Values from 0 to 1 as 8-bit numbers."""
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


def combined(path: Path) -> np.ndarray:
    """(h, w, 4) linear picture of a rendered frame."""
    return read_frame(path)[0]["Combined"]


def save_animation(path: Path, pictures: Sequence[Image.Image], fps: int, quality: int) -> None:
    """An animated WebP of whole frames: what is kept of the last one would show as blocks in a sky."""
    first, *others = pictures
    how = {"duration": round(1000 / fps), "loop": 0, "quality": quality, "method": 4, "kmax": 1}
    first.save(path, save_all=True, append_images=others, **how)
