"""What learned surfels show of the photographs: pictures beside them, and figures of the views left out."""

from __future__ import annotations

import numpy as np
import torch

from .capture.capture import Capture, View
from .capture.training_views import background_of, composed
from .losses.photometric import Photograph, structural_similarity
from .model.gaussians import Gaussians

Array = np.ndarray


def drawn(gaussians: Gaussians, view: View, capture: Capture) -> Array:
    """The surfels' own colours in a view, (h, w, 3) sRGB in 0..1, over `background_of` the capture."""
    with torch.no_grad():
        background = torch.tensor(background_of(capture), dtype=torch.float32, device=gaussians.backend.device)
        rendered = gaussians.render(view.camera, background, turn=view.turn)
    return np.clip(rendered.colour.numpy(force=True), 0, 1)


def preview(gaussians: Gaussians, capture: Capture) -> Array:
    """A view, left out if there is one, beside its photograph: (h, 2 w, 3) sRGB."""
    view = (capture.testing or capture.training)[0]
    return np.concatenate([drawn(gaussians, view, capture), composed(view, capture)], axis=1)


def held_out_metrics(gaussians: Gaussians, capture: Capture) -> dict[str, float]:
    """Figures of the views left out, whole pictures.

    "psnr" is the mean of that of each, as in published tables and in `drgs evaluate`; "psnr_pooled" that of the mean
    squared error over all; "ssim".
    """
    if not capture.testing:
        return {}
    errors, similar = [], []
    for view in capture.testing:
        shown, truth = drawn(gaussians, view, capture), composed(view, capture)
        errors.append(max(float(np.square(shown - truth).mean()), 1e-10))
        similar.append(structural_similarity(shown, Photograph.of(truth)))
    return {
        "psnr": float(np.mean(-10 * np.log10(errors))),
        "psnr_pooled": -10 * float(np.log10(np.mean(errors))),
        "ssim": float(np.mean(similar)),
    }
