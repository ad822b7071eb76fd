"""Which processor learns: the one asked for, or this one with a warning that says why."""

from __future__ import annotations

import logging

import torch

from ...compute.warp.runtime import name_of
from ...core.errors import DeviceError
from ..backend import HERE, Processor
from .on_device import OnDevice

log = logging.getLogger(__name__)


def learner(device: str) -> Processor:
    """The processor for a setting, "cpu" or "cuda"; this one, with a warning, where that has none."""
    if device == "cpu":
        return HERE
    try:
        name = name_of(device)
        if name.startswith("cuda") and not torch.cuda.is_available():
            raise DeviceError(
                "device cuda", f"PyTorch {torch.__version__} does not find the card", "Install a build of it for CUDA"
            )
        return OnDevice(name)
    except (DeviceError, RuntimeError) as error:
        log.warning("%s Learned on the CPU", error)
        return HERE
