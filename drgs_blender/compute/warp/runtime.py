"""Warp: the devices that it finds, arrays on them, and modules of translated source.

Warp is imported when it is first needed, for most machines have no use for it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ...core.asset.archive import replace_file
from ...core.errors import DeviceError, WriteError
from ..folders import cache_folder
from .types import Array as ArrayType
from .types import Known, Record, Struct, Type, is_struct, like, type_of

Array = np.ndarray

#: Devices that a user may ask for, and what each stands for.
DEVICES = {"cpu": "the CPU", "cuda": "the first NVIDIA card"}

#: Called with 1 when kernels begin to be made ready, which nothing interrupts, and with -1 when they are.
watchers: list[Callable[[int], None]] = []
#: Versions that the translation is made for; `pyproject.toml` has the same.
VERSION = "1.19."  # also for what its ``and``, ``or`` and ``if`` leave out: they read no more than Python's do
_INSTALL = "Install it: pip install 'warp-lang>=1.19,<1.20', or Set Up Engine with Graphics Card"


def _folder() -> Path:
    """Warp's part of the folder of compiled kernels."""
    folder = cache_folder()
    if folder.path is None:
        raise DeviceError("device cuda", folder.trouble, "Set DRGS_CACHE_DIR to a folder that can be written")
    return folder.path / "warp"


@functools.cache
def warp() -> Any:
    """The module ``warp``, initialised.

    Raises
    ------
    DeviceError
        When it is not installed, of another version, or cannot start.
    """
    try:
        import warp as wp
    except Exception as error:
        raise DeviceError("device cuda", f"the package warp-lang cannot be imported ({error})", _INSTALL) from None
    version = str(getattr(wp, "__version__", "unknown"))
    if not version.startswith(VERSION):
        raise DeviceError("device cuda", f"warp-lang has version {version}, not {VERSION}x", _INSTALL)
    folder = _folder()
    wp.config.log_level = wp.LOG_WARNING  # else it greets on stdout, which is read by programs
    # Not the folder itself: Warp would take the sources there for what an older Warp has left, and warn.
    kernels = folder / "kernels"
    if kernels not in Path(wp.config.kernel_cache_dir or "").parents:  # else it has started, and added its version
        wp.config.kernel_cache_dir = str(kernels)
    try:
        wp.init()
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)  # it is in use, see `compute.folders`
    except Exception as error:
        raise DeviceError("device cuda", f"Warp does not start ({error})", "Use the CPU") from error
    return wp


@contextlib.contextmanager
def preparing() -> Iterator[None]:
    """While kernels are made ready: calls the `watchers`."""
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


def name_of(device: str) -> str:
    """Warp's name of one of the `DEVICES` but the first.

    Raises
    ------
    DeviceError
        Where there is none.
    """
    if device not in DEVICES:
        raise DeviceError(f"device {device!r}", "is unknown", f"Choose from {', '.join(DEVICES)}")
    warp()
    found = cuda_devices()
    if not found:
        raise DeviceError(
            "device cuda", "no NVIDIA card with a driver was found", "Install or update its driver, or use the CPU"
        )
    return found[0]


def is_there(value: Any) -> bool:
    """Whether it is an array of a device."""
    return hasattr(value, "ptr") and hasattr(value, "dtype")


def type_for(value: Any) -> Type:
    """Type of an argument as a kernel takes it: numbers, arrays here or there, tuples and named tuples of all these.

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
        if _is_whole(value):
            return Struct(type(value))
        return like(Record(type(value), ()) if hasattr(value, "_fields") else (), map(type_for, value))
    if isinstance(value, bool):
        return Known(value)
    kind = type_of(value)
    if kind is None:
        raise TypeError(f"{type(value).__name__} is no argument of a kernel")
    return kind


def _is_whole(value: tuple[Any, ...]) -> bool:
    """Whether it is a named tuple that a kernel takes as one argument."""
    return hasattr(value, "_fields") and is_struct(type(value))


def parts_of(value: Any) -> Iterable[Any]:
    """Kernel arguments of nested tuples, in order: structs whole, no truth values, for these are known."""
    if isinstance(value, tuple) and not _is_whole(value):
        for part in value:
            yield from parts_of(part)
    elif not isinstance(value, bool):
        yield value


def load_module(source: str) -> ModuleType:
    """Import the source of a Warp module; it is kept, so that errors show its lines."""
    name = f"drgs_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        warp()
        path = _folder() / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            replace_file(path, [source.encode()])  # at once: other processes may be reading it
        except WriteError:
            if not path.is_file():  # on Windows while it is read, which is the same text
                raise
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
