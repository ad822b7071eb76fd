"""Kernels of Warp on torch's tensors, in place."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.runtime import warp


class TensorLauncher(Launcher):
    """A `Launcher` that takes tensors, which it shares with Warp: nothing is copied.

    Parameters
    ----------
    device : str
        Warp's name of it: "cuda:0", "cpu".

    Attributes
    ----------
    place : torch.device
        Where torch has it.
    """

    def __init__(self, device: str) -> None:
        super().__init__(device)
        self.place = torch.device(str(warp().device_to_torch(self.device)))

    def launch(self, kernel: WarpKernel, pieces: int, arguments: Sequence[Any], out: Sequence[Any]) -> None:
        """`Launcher.launch`, among torch's own work on the device; nothing where there are no pieces.

        Raises
        ------
        ValueError
            For a tensor of another device.
        """
        if not pieces:
            return
        with self._in_order():
            super().launch(kernel, pieces, self._shared(tuple(arguments)), self._shared(tuple(out)))

    def _shared(self, value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            if value.device != self.place:  # its address would be read on the other, which ends all work there
                raise ValueError(f"a tensor on {value.device} for a kernel on {self.place}")
            return warp().from_torch(value.detach())
        plain = isinstance(value, tuple) and not hasattr(value, "_fields")
        return tuple(map(self._shared, value)) if plain else value

    @contextlib.contextmanager
    def _in_order(self) -> Iterator[None]:
        """Warp's work in the queue of torch's: each finds what the other has written."""
        if not self.device.is_cuda:
            yield
            return
        wp = warp()
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.place))):
            yield
