"""Intel's Open Image Denoise as an alternative to `svgf_spatial`, where the wheel `pyoidn` is installed.

A trained network: smoother than SVGF on single pictures, but slower; it knows nothing of neighbouring frames, and is no
part of this package.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

import numpy as np

from ...core.errors import DeviceError
from ..film.guides import Guides

Array = np.ndarray

#: Denoisers of `RenderSettings` that are OIDN, with the name of its constant: how large a network it runs.
QUALITIES = {"oidn": "OIDN_QUALITY_HIGH", "oidn-balanced": "OIDN_QUALITY_BALANCED"}
#: Pixels of its own mirror image beyond a border of the picture that cuts off what is covered. The network takes what
#: lies beyond a picture for black: an even grey came out with 0.93 to 1.16 of its light along the borders, and with 0.4
#: in a single pixel.
MARGIN = 16
#: Empty pixels of the picture around what is covered. Those further off are black, as the network takes them to be.
EMPTY_MARGIN = 8


def available() -> bool:
    """Whether `denoise_oidn` can work here."""
    try:
        require()
    except DeviceError:
        return False
    return True


def require() -> ModuleType:
    """The wheel's module; DeviceError, with what to do, where it is not installed or its libraries do not load."""
    try:
        with _without_torch():
            import pyoidn
        works = pyoidn.Device.is_cpu_available()  # loads the libraries
    except (ImportError, OSError) as error:
        raise _unavailable(str(error)) from error
    if not works:
        raise _unavailable("it does not know this processor")
    return pyoidn


def denoise_oidn(
    components: Array,
    guides: Guides,
    split: bool = True,
    check: Callable[[], None] = lambda: None,
    denoiser: str = "oidn",
    threads: int = 0,
) -> Array:
    """Filter the light of a picture on the CPU.

    Only the rectangle around what is covered is filtered; device, network and their memory are gone afterwards.

    Parameters
    ----------
    components : (h, w, 4, 3) float32 array
        Premultiplied light, see `shading_points.Radiance`; non-finite values count as black.
    guides : Guides
        Its coverage, albedo and normals; taken as free of noise.
    split : bool
        Filter each of the four components; else their sum alone, returned as the first (four times as fast).
    check : callable
        Called between runs; may raise to stop.
    denoiser : str
        A key of `QUALITIES`.
    threads : int
        0 is all cores; the result is the same.

    Returns
    -------
    (h, w, 4, 3) float32 array
        0 where nothing is covered.

    Raises
    ------
    DeviceError: the wheel is not installed, or it cannot work on this machine.
    """
    pyoidn = require()
    out = np.zeros_like(components)
    rows, row_margins = _covered(np.any(guides.coverage, axis=1))
    columns, column_margins = _covered(np.any(guides.coverage, axis=0))
    if rows.start == rows.stop:
        return out
    cover = guides.coverage[rows, columns, None]
    light = np.nan_to_num(components[rows, columns], nan=0.0, posinf=0.0, neginf=0.0)

    def widened(picture: Array) -> Array:
        """(h, w, 3) of the rectangle with its margins, contiguous."""
        wide = np.pad(picture, (row_margins, column_margins, (0, 0)), mode="symmetric")
        return np.ascontiguousarray(wide, np.float32)

    images = {"albedo": widened(guides.albedo[rows, columns] * cover)}
    images["normal"] = widened(guides.normal[rows, columns] * cover)
    images["color"], images["output"] = (np.empty_like(images["albedo"]) for _ in range(2))
    inside = tuple(
        slice(before, before + size)
        for (before, _), size in zip((row_margins, column_margins), cover.shape, strict=False)
    )
    with ExitStack() as held:  # pyoidn's own `with` of a filter swallows exceptions
        device = pyoidn.Device()
        held.callback(device.release)
        device.set_int("numThreads", threads)
        device.commit()
        _raise_errors(device)
        network = pyoidn.Filter(device)
        held.callback(network.release)
        for name, image in images.items():
            network.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
        network.set_bool("hdr", True)
        network.set_bool("cleanAux", True)
        network.set_quality(getattr(pyoidn, QUALITIES[denoiser]))
        network.commit()
        for k in range(4 if split else 1):
            check()
            images["color"][:] = widened(
                light[:, :, k] if split else light[:, :, 0] + light[:, :, 1] + light[:, :, 2] + light[:, :, 3]
            )
            network.execute()
            _raise_errors(device)
            out[rows, columns, k] = np.where(cover > 0, images["output"][inside], 0)
    return out


def _covered(lines: Array) -> tuple[slice, tuple[int, int]]:
    """The lines to filter, of those of which some are covered, and how many mirrored ones to put before and after.

    A side on which the picture goes on gets `EMPTY_MARGIN` lines of it instead of mirrored ones.
    """
    found = np.flatnonzero(lines)
    if not len(found):
        return slice(0, 0), (0, 0)
    first, last = int(found[0]), int(found[-1])
    end = len(lines)
    margins = MARGIN if first == 0 else 0, MARGIN if last == end - 1 else 0
    return slice(max(first - EMPTY_MARGIN, 0), min(last + 1 + EMPTY_MARGIN, end)), margins


class _NoTorch:
    """A finder of modules that hides torch from the thread that made it."""

    def __init__(self) -> None:
        self._thread = threading.get_ident()

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name == "torch" and threading.get_ident() == self._thread:
            raise ModuleNotFoundError("torch is hidden from pyoidn", name=name)


@contextmanager
def _without_torch() -> Iterator[None]:
    """Imports in this thread find no torch: pyoidn would load it, for tensors, in a second and 180 MB.

    Other threads find it all the while, as does this one afterwards. The list of finders is replaced, not changed,
    since other threads may be going through it.
    """
    finder = _NoTorch()
    sys.meta_path = [finder, *sys.meta_path]
    try:
        yield
    finally:
        sys.meta_path = [other for other in sys.meta_path if other is not finder]


def _raise_errors(device: Any) -> None:
    message = device.get_error()
    if message is not None:
        raise DeviceError("denoiser OIDN", f"failed ({message})", "Choose SVGF")


def _unavailable(reason: str) -> DeviceError:
    return DeviceError(
        "denoiser OIDN",
        f"cannot be loaded in the engine's Python ({reason})",
        "Install it there with `pip install pyoidn`, or choose SVGF",
    )
