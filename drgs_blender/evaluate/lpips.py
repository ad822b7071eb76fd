"""LPIPS with the user's own weights: AlexNet's features, compared with learned weights (Zhang et al. 2018).

No weights come with this program: torchvision's ``alexnet`` state and LPIPS's linear heads (``lpips/weights/v0.1/
alex.pth``) are files that the user names. They are loaded as tensors only; nothing in them is run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError, DeviceError

Array = np.ndarray

#: Layers of AlexNet in torchvision's numbering: (number, stride, padding, pooled before).
_LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))
#: Pixels of a side below which nothing is left for the last layers.
_LEAST = 31
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Lpips:
    """Perceptual distance; larger is more different.

    Parameters
    ----------
    backbone : Path
        State of torchvision's AlexNet.
    heads : Path
        State of LPIPS's linear layers for it.

    Raises
    ------
    AssetError
        A file is damaged or holds something else.
    DeviceError
        torch is not installed.
    """

    def __init__(self, backbone: Path, heads: Path) -> None:
        features, linear = _tensors(backbone), _tensors(heads)
        try:
            self._layers = [
                (features[f"features.{k}.weight"], features[f"features.{k}.bias"]) for k, _, _, _ in _LAYERS
            ]
            self._heads = [linear[f"lin{k}.model.1.weight"] for k in range(len(_LAYERS))]
        except KeyError as error:
            problem = f"have no {error}"
            raise AssetError(
                f"{backbone}, {heads}", problem, "Give torchvision's AlexNet, then LPIPS's heads"
            ) from error

    def __call__(self, picture: Array, reference: Array) -> float:
        """Distance of two (h, w, 3) sRGB-encoded pictures in [0, 1]; NaN where a side has fewer than 31 pixels."""
        import torch

        if min(picture.shape[:2]) < _LEAST:
            return float("nan")
        with torch.no_grad():
            a, b = self._features(picture), self._features(reference)
            total = 0.0
            for x, y, head in zip(a, b, self._heads):
                x, y = (f / (f.norm(dim=1, keepdim=True) + 1e-10) for f in (x, y))
                total += float(torch.nn.functional.conv2d((x - y) ** 2, head).mean())
        return total

    def _features(self, picture: Array) -> list[Any]:
        import torch
        import torch.nn.functional as F

        x = torch.as_tensor(np.asarray(picture, np.float32)).permute(2, 0, 1)[None] * 2 - 1
        x = (x - torch.tensor(_SHIFT).view(1, 3, 1, 1)) / torch.tensor(_SCALE).view(1, 3, 1, 1)
        found = []
        for (weight, bias), (_, stride, padding, pooled) in zip(self._layers, _LAYERS):
            if pooled:
                x = F.max_pool2d(x, 3, 2)
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            found.append(x)
        return found


def _tensors(path: Path) -> dict[str, Any]:
    """The state in a file, loaded as tensors only."""
    try:
        import torch
    except ImportError as error:
        raise DeviceError(
            "LPIPS", "needs torch, which is not installed", 'Install "drgs-blender[reconstruct]"'
        ) from error
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged archives raise almost anything
        # Not torch's own words: they advise to load what may run code.
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "torch cannot load it"
        raise AssetError(str(path), f"holds no weights ({reason})", "Give a state saved by torch") from error
    if not isinstance(state, dict):
        raise AssetError(str(path), "holds no named weights", "Give a state saved by torch")
    return state
