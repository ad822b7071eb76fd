"""Kernels of Warp on torch's tensors, in place."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import torch

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.runtime import warp


class SharedTensor:
    """A tensor as an argument of a kernel: Warp's descriptor of it, which is made much faster than an array.

    Attributes
    ----------
    dtype : type
        Warp's.
    ndim : int
    ptr : int
        Address.
    descriptor : object
        What `warp.launch` takes.
    """

    __slots__ = ("descriptor", "dtype", "ndim", "ptr")

    def __init__(self, tensor: torch.Tensor) -> None:
        wp = warp()
        self.dtype, self.ndim, self.ptr = wp.dtype_from_torch(tensor.dtype), tensor.dim(), tensor.data_ptr()
        self.descriptor = wp.from_torch(tensor.detach(), return_ctype=True)


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
        self._stream: Any = None

    def launch(self, kernel: WarpKernel, pieces: int, arguments: Sequence[Any], out: Sequence[Any]) -> None:
        """`Launcher.launch`, among torch's own work on the device; nothing where there are no pieces.

        Raises
        ------
        ValueError
            For a tensor of another device.
        """
        if not pieces:
            return
        self._join()
        super().launch(kernel, pieces, self._shared(tuple(arguments)), self._shared(tuple(out)))

    def _shared(self, value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            if value.device != self.place:  # its address would be read on the other, which ends all work there
                raise ValueError(f"a tensor on {value.device} for a kernel on {self.place}")
            return SharedTensor(value)
        if isinstance(value, tuple):
            parts = map(self._shared, value)
            return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
        return value

    def _argument(self, module: ModuleType, value: Any) -> Any:
        return value.descriptor if isinstance(value, SharedTensor) else super()._argument(module, value)

    def _join(self) -> None:
        """Warp's work goes into the queue of torch's from now on: each finds what the other has written."""
        if not self.device.is_cuda:
            return
        stream = torch.cuda.current_stream(self.place)
        if self._stream != stream or self.device.stream.cuda_stream != stream.cuda_stream:
            warp().set_stream(warp().stream_from_torch(stream), self.device, sync=True)
            self._stream = stream
