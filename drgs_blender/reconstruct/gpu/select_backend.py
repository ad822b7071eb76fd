"""Selects the backend of learning: the one that is asked for, or the CPU with a warning and its reason."""

from __future__ import annotations

import logging

import torch

from ...compute.warp.runtime import name_of
from ...core.errors import DeviceError
from ..backend import CPU, LearningBackend
from .warp_backend import WarpLearningBackend

log = logging.getLogger(__name__)


def select_backend(device: str) -> LearningBackend:
    """The backend for a setting, "cpu" or "cuda"; the CPU, with a warning, where there is no such device."""
    if device == "cpu":
        return CPU
    try:
        name = name_of(device)
        if name.startswith("cuda") and not torch.cuda.is_available():
            raise DeviceError(
                "device cuda", f"PyTorch {torch.__version__} does not find the card", "Install a build of it for CUDA"
            )
        return WarpLearningBackend(name)
    except (DeviceError, RuntimeError) as error:
        log.warning("%s Learned on the CPU", error)
        return CPU
