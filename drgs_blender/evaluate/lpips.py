"""LPIPS with the user's own weights: features of AlexNet or VGG-16, compared with learned weights (Zhang et al. 2018).

No weights come with this program: torchvision's ``alexnet`` or ``vgg16`` state and LPIPS's linear heads of the same
network (``lpips/weights/v0.1/alex.pth``, ``vgg.pth``) are files that the user names. They are loaded as tensors only;
nothing in them is run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError, DeviceError

Array = np.ndarray


@dataclass(frozen=True, slots=True)
class _Network:
    """A network whose features are compared.

    Attributes
    ----------
    name : str
    first : int
        Pixels of a side of its first filters, by which its weights are recognised.
    layers : tuple of (int, int, int, int, bool)
        Number of a layer in torchvision's order, stride, padding, side of the maximum before it (0: none), and whether
        its features are compared.
    least : int
        Pixels of a side below which nothing is left for the last layers.
    """

    name: str
    first: int
    layers: tuple[tuple[int, int, int, int, bool], ...]
    least: int


_NETWORKS = (
    _Network("AlexNet", 11, ((0, 4, 2, 0, True), (3, 1, 2, 3, True), (6, 1, 1, 3, True), (8, 1, 1, 0, True),
                             (10, 1, 1, 0, True)), 31),
    _Network("VGG", 3, ((0, 1, 1, 0, False), (2, 1, 1, 0, True), (5, 1, 1, 2, False), (7, 1, 1, 0, True),
                        (10, 1, 1, 2, False), (12, 1, 1, 0, False), (14, 1, 1, 0, True), (17, 1, 1, 2, False),
                        (19, 1, 1, 0, False), (21, 1, 1, 0, True), (24, 1, 1, 2, False), (26, 1, 1, 0, False),
                        (28, 1, 1, 0, True)), 16),
)  # fmt: skip
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Lpips:
    """Perceptual distance; larger is more different.

    Parameters
    ----------
    backbone : Path
        State of torchvision's AlexNet or VGG-16.
    heads : Path
        State of LPIPS's linear layers for it.

    Attributes
    ----------
    network : str
        "AlexNet" or "VGG".

    Raises
    ------
    AssetError
        A file is damaged or holds something else.
    DeviceError
        torch is not installed.
    """

    def __init__(self, backbone: Path, heads: Path) -> None:
        features, linear = _tensors(backbone), _tensors(heads)
        first = features.get("features.0.weight")
        side = 0 if first is None or len(first.shape) != 4 else first.shape[-1]
        self._network = next((network for network in _NETWORKS if network.first == side), _NETWORKS[0])
        self.network = self._network.name
        compared = sum(layer[-1] for layer in self._network.layers)
        try:
            self._weights = [
                (features[f"features.{k}.weight"], features[f"features.{k}.bias"]) for k, *_ in self._network.layers
            ]
            self._heads = [linear[f"lin{k}.model.1.weight"] for k in range(compared)]
        except KeyError as error:
            problem = f"have no {error}"
            raise AssetError(
                f"{backbone}, {heads}", problem, "Give torchvision's AlexNet or VGG-16, then LPIPS's heads of it"
            ) from error
        channels = [weight.shape[0] for (weight, _), layer in zip(self._weights, self._network.layers) if layer[-1]]
        if channels != [head.shape[1] for head in self._heads]:
            problem = f"has the heads of another network than {self.network}"
            raise AssetError(str(heads), problem, f"Give those of {self.network} beside {backbone.name}")

    def __call__(self, picture: Array, reference: Array) -> float:
        """Distance of two (h, w, 3) sRGB-encoded pictures in [0, 1]; NaN where a side has too few pixels."""
        import torch

        if min(picture.shape[:2]) < self._network.least:
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
        for (weight, bias), (_, stride, padding, pooled, compared) in zip(self._weights, self._network.layers):
            if pooled:
                x = F.max_pool2d(x, pooled, 2)
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            if compared:
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
