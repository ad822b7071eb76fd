"""Posed surfels in a device's memory, copied to the CPU on demand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ...core.asset.model import PosedSurfels
from .kernels import Launcher
from .runtime import is_there, warp

Array = np.ndarray

FIELDS = tuple(field.name for field in dataclasses.fields(PosedSurfels))


class DevicePosedSurfels(PosedSurfels):
    """`PosedSurfels` that lie on a device.

    Parameters
    ----------
    there : dict
        Every field by its name, on the device or, where nobody has needed it there, here.
    here : callable
        Makes the same on the CPU; called when a field is first read that is not among the `known`.
    known : mapping of str to array, optional
        Fields that are on the CPU, too.
    """

    def __init__(
        self, there: dict[str, Any], here: Callable[[], PosedSurfels], known: Mapping[str, Array] | None = None
    ) -> None:
        self._there, self._here = there, here
        for name, array in (known or {}).items():
            setattr(self, name, array)

    def __getattr__(self, name: str) -> Array:
        if name not in FIELDS:
            raise AttributeError(name)
        posed = self._here()
        for field in FIELDS:
            setattr(self, field, getattr(posed, field))
        found: Array = getattr(posed, name)
        return found

    def __len__(self) -> int:
        return len(self._there["opacity"])

    def on(self, launcher: Launcher) -> dict[str, Any]:
        """All fields on the device, where they stay."""
        for name, array in self._there.items():
            if not is_there(array):
                self._there[name] = launcher.array(array)
        return self._there


def arrays_of(posed: PosedSurfels, launcher: Launcher) -> dict[str, Any]:
    """All fields of posed surfels on a device."""
    if isinstance(posed, DevicePosedSurfels):
        return posed.on(launcher)
    return {name: launcher.array(getattr(posed, name)) for name in FIELDS}


def with_fields(posed: PosedSurfels, fields: dict[str, Array]) -> PosedSurfels:
    """The surfels with other arrays (of the CPU) for some fields."""
    if not isinstance(posed, DevicePosedSurfels):
        return dataclasses.replace(posed, **fields)

    def here() -> PosedSurfels:
        return PosedSurfels(**{name: getattr(posed, name) for name in FIELDS} | fields)

    return DevicePosedSurfels(posed._there | fields, here, fields)


def joined(launcher: Launcher, parts: Sequence[PosedSurfels], here: Callable[[], PosedSurfels]) -> DevicePosedSurfels:
    """The surfels of some parts as one, on a device; `here` joins them on the CPU."""
    wp = warp()
    with launcher.failures("joining surfels"):
        there, found = {}, [arrays_of(part, launcher) for part in parts]
        for name in FIELDS:
            given = [arrays[name] for arrays in found]
            rows = sum(map(len, given))
            whole = there[name] = wp.empty((rows, *given[0].shape[1:]), dtype=given[0].dtype, device=launcher.device)
            first = 0
            for array in given:
                if len(array):
                    wp.copy(whole[first : first + len(array)], array)
                first += len(array)
    return DevicePosedSurfels(there, here)
