"""The messages between extension and engine; `protocol` encodes and sends them.

Needs numpy and the standard library only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray


# --- messages: engine -> client -----------------------------------------------------------------------------------


@dataclass(slots=True)
class Hello:
    """First words of the engine, before anything slow is imported. Its fields never change."""

    protocol: int
    version: str
    pid: int


@dataclass(slots=True)
class Loaded:
    """An asset is ready under `key`."""

    id: int
    key: str
    vertices: int
    surfels: int


@dataclass(slots=True)
class Progress:
    """Progress of a request; ``fraction`` of the phase or picture in [0, 1]."""

    id: int
    phase: str
    fraction: float


@dataclass(slots=True)
class Result:
    """A finished picture; its passes are the message's arrays."""

    id: int
    warnings: list[str]
    statistics: dict[str, float]


@dataclass(slots=True)
class Need:
    """These slots are not held at the version named: send them again."""

    id: int
    slots: list[str]


@dataclass(slots=True)
class Stopped:
    """A request ended because it was cancelled."""

    id: int


@dataclass(slots=True)
class Failed:
    """A request ended in an error (`error` is a name of errors.ERROR_CLASSES). Request 0 is the link itself."""

    id: int
    error: str
    subject: str
    problem: str
    remedy: str


@dataclass(slots=True)
class Alive:
    """The engine is there. ``steps`` grows while its main thread advances, ``preparing`` while kernels compile."""

    steps: int
    preparing: bool


# --- messages: client -> engine -----------------------------------------------------------------------------------


@dataclass(slots=True)
class Welcome:
    """The client's answer to Hello: its version, and what the engine inherits: shared regions, a socket (-1: none)."""

    protocol: int
    version: str
    to_engine: int
    to_client: int
    files: int


@dataclass(slots=True)
class LoadAsset:
    """Map the asset at `path`."""

    id: int
    path: str


@dataclass(slots=True)
class Render:
    """Render one frame: its description, the version of every slot it uses, and (as arrays) what changed."""

    id: int
    frame: dict[str, Any]
    slots: dict[str, int]


@dataclass(slots=True)
class View:
    """Begin the picture of the viewport `view`: fields as of Render. The answer is its first, rough state.

    Until it has samples it shows `most` surfels at most; 0: all.
    """

    id: int
    view: str
    frame: dict[str, Any]
    slots: dict[str, int]
    most: int


@dataclass(slots=True)
class Refine:
    """The next state of the picture of `view`, with more samples; answered by Need where it is not known."""

    id: int
    view: str


@dataclass(slots=True)
class Cancel:
    """Stop the request."""

    id: int


@dataclass(slots=True)
class Shutdown:
    """End the engine."""


_FROM_ENGINE: tuple[type, ...] = (Hello, Loaded, Progress, Result, Need, Stopped, Failed, Alive)
_FROM_CLIENT: tuple[type, ...] = (Welcome, LoadAsset, Render, View, Refine, Cancel, Shutdown)
MESSAGES: dict[str, type] = {c.__name__: c for c in (*_FROM_ENGINE, *_FROM_CLIENT)}


class Passes(dict[str, Array]):
    """Passes of a finished picture, name -> (h, w, c) float32, with what the engine has to say about it.

    Attributes
    ----------
    warnings : list of str
        Each naming the object it is about.
    statistics : dict of str to float
        Seconds per stage (``seconds.deform`` ...), counts of triangles, surfels, rays.
    """

    def __init__(self, passes: dict[str, Array], warnings: list[str], statistics: dict[str, float]) -> None:
        super().__init__(passes)
        self.warnings = warnings
        self.statistics = statistics
