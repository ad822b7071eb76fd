"""Kernels of translated functions: made when they are first needed, launched with arrays of this process or a device's.

What is launched is a function ``f(thread, stride, scratch, *arguments, out)``, a grid-stride loop: it does every
`stride`-th piece from the `thread`-th on, with scratch memory of its own, and writes to the arrays `out`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from ...core.errors import Cancelled, DeviceError
from .runtime import is_there, load_module, parts_of, preparing, type_for, warp
from .translate import Constants, Translation
from .types import Array as ArrayType
from .types import Record, Type, given, like, spelled

Array = np.ndarray

#: Threads of one launch at most.
MAX_THREADS = 1 << 17


class ScratchArray(NamedTuple):
    """An array of scratch memory for one thread: type of its elements, and its shape."""

    element: str
    shape: tuple[int, ...]


#: Scratch memory of a function: nested tuples and named tuples of `ScratchArray`.
ScratchTree = Any


class WarpKernel:
    """A function that can be launched.

    Parameters
    ----------
    function : callable
        See this module's head.
    scratch : ScratchArray or tuple
        Its scratch memory.
    natives : mapping
        See `Translation`.
    constants : callable
        See `Translation`.
    level : int, optional
        Of optimisation by NVIDIA's compiler, 1 to 3; None: Warp's own.
    exact : bool
        Products and sums round as on the CPU, also on a card: where the difference of equal products has to be zero.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        scratch: ScratchTree,
        natives: Mapping[Any, Any],
        constants: Constants = lambda module, name, value: value,
        level: int | None = None,
        exact: bool = False,
    ) -> None:
        self.function, self.scratch, self._level, self._exact = function, scratch, level, exact
        self._natives, self._constants = natives, constants

    def module(self, types: tuple[Type, ...], fused: bool) -> ModuleType:
        """Module whose ``run`` is the kernel for arguments of these types; `fused` for a card."""
        translation = Translation(self._natives, self._constants, fused and not self._exact)
        kinds = _types(self.scratch)
        made = translation.function(self.function, ["int64", "int64", kinds, *types])
        scratch = [f"r{i}" for i in range(len(given(kinds)))]
        names = [f"a{i}" for i in range(len(given(types)))]
        parameters = ["stride: wp.int64"]
        parameters += [f"{n}: {ArrayType(k.element, k.axes + 1)}" for n, k in zip(scratch, given(kinds))]
        parameters += [f"{n}: {spelled(k)}" for n, k in zip(names, given(types))]
        arguments = ["wp.int64(t)", "stride", *(f"{n}[t]" for n in scratch), *names]
        translation.add(
            f"@wp.kernel\ndef run({', '.join(parameters)}):\n    t = wp.tid()\n    {made.name}({', '.join(arguments)})"
        )
        module = load_module(translation.source)
        if fused and self._level is not None:
            warp().set_module_options({"optimization_level": self._level}, module)
        return module


class Launcher:
    """Launches kernels on one device.

    Parameters
    ----------
    device : str
        Warp's name of it: "cuda:0", "cpu".

    Attributes
    ----------
    apart : bool
        Whether it has memory of its own, as a card has.
    """

    def __init__(self, device: str) -> None:
        self.device = warp().get_device(device)
        self.apart = bool(self.device.is_cuda)
        self._scratch: dict[WarpKernel, list[Any]] = {}
        self._modules: dict[tuple[WarpKernel, tuple[Type, ...]], ModuleType] = {}

    def array(self, array: Array, copy: bool | None = None) -> Any:
        """A Warp array of an array's content; on the CPU it is the same memory unless a copy is asked for."""
        wp = warp()
        copy = self.apart if copy is None else copy
        array = np.ascontiguousarray(array)
        return wp.array(array, dtype=getattr(wp, array.dtype.name), device=self.device, copy=copy)

    def zeros(self, shape: tuple[int, ...], element: str = "float32") -> Any:
        """An array on the device."""
        return warp().zeros(shape, dtype=getattr(warp(), element), device=self.device)

    def launch(self, kernel: WarpKernel, pieces: int, arguments: Sequence[Any], out: Sequence[Any]) -> None:
        """Do `pieces` of a kernel's work.

        Parameters
        ----------
        kernel : WarpKernel
        pieces : int
        arguments : sequence
            Numbers, arrays here or on the device, tuples and named tuples of all these.
        out : sequence
            Arrays that are written to, or tuples of them: those of this process as a whole, those on the device where
            the kernel does.

        Raises
        ------
        DeviceError
            When the device fails, for one of the reasons that a device has.
        """
        with self.failures(kernel.function.__name__.replace("_", " ")):
            arrays = list(parts_of(tuple(out)))
            found = [a if is_there(a) else self.zeros(a.shape, a.dtype.name) for a in arrays]
            self._launch(kernel, pieces, arguments, tuple(out), found)
            for array, result in zip(arrays, found):
                if array is not result:
                    array[...] = result.numpy()

    def recorded(
        self, kernel: WarpKernel, pieces: int, arguments: Sequence[Any], out: Sequence[Any]
    ) -> Callable[[], None]:
        """A recorded launch, executed whenever it is called, at little cost; all its arrays are the device's.

        Raises
        ------
        DeviceError
            As `launch`; what it does later belongs into `failures`.
        """
        with self.failures(kernel.function.__name__.replace("_", " ")):
            made = self._launch(kernel, pieces, arguments, tuple(out), list(parts_of(tuple(out))), record_cmd=True)
            kept = arguments, out, self._scratch.get(kernel)

            def again(kept: Any = kept) -> None:
                made.launch()

            return again

    def _launch(
        self,
        kernel: WarpKernel,
        pieces: int,
        arguments: Sequence[Any],
        out: tuple[Any, ...],
        found: list[Any],
        **how: bool,
    ) -> Any:
        module = self._ready(kernel, tuple(type_for(a) for a in (*arguments, out)))
        stride = min(pieces, MAX_THREADS)
        inputs = [self._argument(module, part) for part in parts_of(tuple(arguments))]
        given = [stride, *self._scratch_for(kernel, stride), *inputs, *(self._argument(module, part) for part in found)]
        return warp().launch(module.run, stride, given, device=self.device, **how)

    def _ready(self, kernel: WarpKernel, types: tuple[Type, ...]) -> ModuleType:
        """The module for arguments of these types, compiled."""
        if (kernel, types) not in self._modules:
            with preparing():
                module = kernel.module(types, self.device.is_cuda)
                warp().load_module(module, self.device)
            self._modules[kernel, types] = module
        return self._modules[kernel, types]

    @contextlib.contextmanager
    def failures(self, work: str) -> Iterator[None]:
        """Name what the device could not do, whatever Warp raises for it: a compiler that fails is an Exception."""
        try:
            yield
        except (Cancelled, DeviceError):
            raise
        except Exception as error:
            said = (str(error).strip() or type(error).__name__).splitlines()[0]
            problem = f"{self.device.name} failed at {work} ({said})"
            raise DeviceError("device cuda", problem, "Use fewer objects or the CPU") from error

    def _argument(self, module: ModuleType, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return self.array(value)
        if isinstance(value, tuple):
            struct = getattr(module, type(value).__name__)()
            for name, part in zip(value._fields, value):  # type: ignore[attr-defined]
                setattr(struct, name, part)
            return struct
        return value.item() if isinstance(value, np.generic) else value

    def _scratch_for(self, kernel: WarpKernel, stride: int) -> list[Any]:
        """Scratch memory; neighbouring threads find theirs next to each other on a card."""
        known = self._scratch.get(kernel)
        if known and known[0].shape[0] >= stride:
            return known
        wp = warp()
        made = []
        for array in _flat(kernel.scratch):
            dtype, axes = getattr(wp, array.element), len(array.shape)
            if self.apart:
                turned = wp.zeros((*array.shape, stride), dtype=dtype, device=self.device)
                made.append(turned.transpose((axes, *range(axes))))
            else:
                made.append(wp.zeros((stride, *array.shape), dtype=dtype, device=self.device))
        self._scratch[kernel] = made
        return made


def _flat(scratch: ScratchTree) -> list[ScratchArray]:
    return [scratch] if isinstance(scratch, ScratchArray) else [array for inner in scratch for array in _flat(inner)]


def _types(scratch: ScratchTree) -> Type:
    if isinstance(scratch, ScratchArray):
        return ArrayType(scratch.element, len(scratch.shape))
    return like(Record(type(scratch), ()) if hasattr(scratch, "_fields") else (), map(_types, scratch))
