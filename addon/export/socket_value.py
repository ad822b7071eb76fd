"""Value of a shader node's socket: a colour, or a colour times a texture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any

import bpy
import numpy as np

from .sockets import SocketRef

Warn = Callable[[str], None]
Array = np.ndarray

#: Nodes that may follow each other; Python's own limit is some six times that.
DEEPEST = 100


@dataclass(frozen=True, slots=True, eq=False)
class SocketValue:
    """A colour, times a texture where there is one.

    Attributes
    ----------
    texture : hashable: a texture, attribute or bake of `texture_refs`, `layers` or `surface_bake`, or None
    approximations : what of it is not exact, as messages
    """

    colour: Array
    texture: Any = None
    approximations: tuple[str, ...] = ()

    def times(self, factor: Array | float) -> SocketValue:
        """Scaled."""
        return replace(self, colour=self.colour * factor)

    def same(self, other: SocketValue) -> bool:
        """Whether both are the same everywhere."""
        return self.texture == other.texture and bool((self.colour == other.colour).all())

    @property
    def black(self) -> bool:
        return not self.colour.any()


def uniform(value: Array | float) -> SocketValue:
    """Value that is the same everywhere, without texture."""
    return SocketValue(np.broadcast_to(np.asarray(value, np.float64), (3,)).copy())


def constant(socket: bpy.types.NodeSocket) -> Array:
    """(3,) float64: a socket's own value."""
    value = socket.default_value
    return np.array(value[:3] if hasattr(value, "__len__") else (value,) * 3, np.float64)


def tracked(method: Callable[..., SocketValue]) -> Callable[..., SocketValue]:
    """Let a method of a `Walker` note on its value what was approximated for it."""

    @wraps(method)
    def followed(self: Any, *args: Any) -> SocketValue:
        before, self.approximated = self.approximated, ()
        value = method(self, *args)
        given = [text for arg in args if isinstance(arg, SocketValue) for text in arg.approximations]
        texts = tuple(dict.fromkeys((*self.approximated, *value.approximations, *given)))
        self.approximated = (*before, *texts)
        return replace(value, approximations=texts) if texts else value

    return followed


def once(fallback: Callable[[Any], Any]) -> Callable[..., Any]:
    """Let a method of a `Walker` work out what a place holds only once, however many nodes ask.

    Without that, nodes whose inputs share a source double the work each. Nodes before the `DEEPEST` are left out: then
    the method gives ``fallback(walker)``.
    """

    def decorate(method: Callable[[Any, SocketRef], Any]) -> Callable[[Any, SocketRef], Any]:
        @wraps(method)
        def remembered(self: Any, ref: SocketRef) -> Any:
            key = method.__name__, ref
            if key not in self.found:
                if self.depth >= DEEPEST and ref.socket.is_linked:
                    self.warn(ref.node, f"more than {DEEPEST} nodes follow; what comes before is left out")
                    return fallback(self)
                self.depth += 1
                try:
                    self.found[key] = method(self, ref)
                finally:
                    self.depth -= 1
            return self.found[key]

        return remembered

    return decorate
