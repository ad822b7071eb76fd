"""Warp: the devices that it finds, arrays on them, and modules of translated source.

Warp is imported when it is first needed, for most machines have no use for it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..errors import DeviceError
from ..jit import cache_folder
from .typed import Array as ArrayType
from .typed import Known, Struct, Type, type_of

Array = np.ndarray

#: Called with 1 when kernels begin to be made ready, which nothing interrupts, and with -1 when they are.
watchers: list[Callable[[int], None]] = []


@functools.cache
def warp() -> Any:
    """The module ``warp``, initialised.

    Raises
    ------
    DeviceError
        When it is not installed, or cannot start.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise DeviceError(
            "device cuda",
            f"the package warp-lang cannot be imported ({error})",
            "Install it: pip install 'warp-lang>=1.19,<1.20', or Set Up Engine with Graphics Card",
        ) from None
    wp.config.quiet = True
    wp.config.kernel_cache_dir = str(cache_folder() / "warp")
    try:
        wp.init()
    except Exception as error:
        raise DeviceError("device cuda", f"Warp does not start ({error})", "Use the CPU") from error
    return wp


@contextlib.contextmanager
def preparing() -> Iterator[None]:
    """While kernels are made ready: tells the `watchers`."""
    for watcher in watchers:
        watcher(1)
    try:
        yield
    finally:
        for watcher in watchers:
            watcher(-1)


def cuda_devices() -> list[str]:
    """Warp's names of the graphics cards that can be used ("cuda:0", ...); none without Warp."""
    try:
        return [device.alias for device in warp().get_cuda_devices()]
    except DeviceError:
        return []


def is_there(value: Any) -> bool:
    """Whether it is an array of a device."""
    return hasattr(value, "ptr") and hasattr(value, "dtype")


def type_for(value: Any) -> Type:
    """Type of an argument as a kernel takes it: numbers, arrays here or there, named tuples, tuples of all these.

    A kernel is made for the truth values that it is given.

    Raises
    ------
    TypeError
        For anything else.
    """
    if isinstance(value, np.ndarray):
        return ArrayType(value.dtype.name, value.ndim)
    if is_there(value):
        return ArrayType(value.dtype.__name__, value.ndim)
    if isinstance(value, tuple):
        return Struct(type(value)) if hasattr(value, "_fields") else tuple(type_for(part) for part in value)
    if isinstance(value, bool):
        return Known(value)
    kind = type_of(value)
    if kind is None:
        raise TypeError(f"{type(value).__name__} is no argument of a kernel")
    return kind


def parts_of(value: Any) -> Iterable[Any]:
    """What a kernel takes of nested tuples, in order: named tuples whole, no truth values, for these are known."""
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        for part in value:
            yield from parts_of(part)
    elif not isinstance(value, bool):
        yield value


def load_module(source: str) -> ModuleType:
    """Import the source of a Warp module; it is kept, so that errors show its lines."""
    name = f"drgs_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        warp()
        folder = cache_folder() / "warp"
        folder.mkdir(parents=True, exist_ok=True)
        path = Path(folder, f"{name}.py")
        path.write_text(source, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]
