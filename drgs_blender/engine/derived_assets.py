"""What is made of loaded assets for objects of the last frame, made once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from ..ipc.change_detection import reuse_equal
from .loaded_assets import LoadedAsset

T = TypeVar("T")


class _Known(NamedTuple):
    """What is loaded of an asset, what an object says of it, and what that makes of it."""

    whole: LoadedAsset
    given: object
    made: LoadedAsset


class DerivedAssets(Generic[T]):
    """Assets as objects want them by a value of type `T`; kept from one frame to the next, shared by instances."""

    def __init__(self) -> None:
        self._last: list[_Known] = []
        self._used: list[_Known] = []

    def begin(self) -> None:
        """A frame begins: what the last one did not use is forgotten."""
        self._last, self._used = self._used, []

    def of(self, whole: LoadedAsset, given: T, make: Callable[[], LoadedAsset]) -> LoadedAsset:
        """What `make` makes of an asset for a value that an object gives, or has made for one equal to it."""
        known = (*self._used, *self._last)
        found = next((e for e in known if e.whole is whole and reuse_equal(given, e.given) is e.given), None)
        found = found or _Known(whole, reuse_equal(given, None), make())
        if all(found is not used for used in self._used):
            self._used.append(found)
        return found.made
