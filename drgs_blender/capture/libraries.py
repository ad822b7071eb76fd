"""Optional libraries of the front end: structure from motion, markers, masks, video, camera raw."""

from __future__ import annotations

import importlib
import importlib.util
import signal
import threading
from collections.abc import Iterable
from typing import Any, NamedTuple

# Before pycolmap, because it loads the system's zlib: if pycolmap is the first to do so, that zlib calls functions of
# the other zlib that pycolmap exports, and whoever compresses by it, as Pillow does, crashes or hangs.
import PIL.Image  # noqa: F401

from ..core.errors import DeviceError
from ..core.own_python import install_remedy


class Library(NamedTuple):
    """A library: its module, its package with the versions that are known to work, its purpose."""

    module: str
    package: str
    purpose: str


#: The table; versions as in the extra "capture" of pyproject.toml.
LIBRARIES = {
    "pycolmap": Library("pycolmap", "pycolmap>=4.2,<4.3", "structure from motion"),
    "opencv": Library("cv2", "opencv-python-headless>=4.10", "marker sheets and masks"),
    "av": Library("av", "av>=14", "video"),
    "torch": Library("torch", "torch>=2.5", "masks"),
    "onnxruntime": Library("onnxruntime", "onnxruntime>=1.20", "masks and normals by a model"),
    "rawpy": Library("rawpy", "rawpy>=0.24", "camera raw files"),
}


def load(name: str) -> Any:
    """The module of a row of `LIBRARIES`.

    Raises
    ------
    DeviceError
        It is not installed; the message has the command that installs it.
    """
    library = LIBRARIES[name]
    terminated = signal.getsignal(signal.SIGTERM)
    try:
        module = importlib.import_module(library.module)
    except ImportError as error:
        raise DeviceError(
            library.purpose,
            f"needs {name}, which cannot be loaded ({error})",
            f"Install all that is absent: {install_command(absent(name))}",
        ) from error
    if name == "pycolmap":
        if threading.current_thread() is threading.main_thread() and terminated is not None:
            signal.signal(signal.SIGTERM, terminated)  # its log library takes it for a crash
        module.logging.minloglevel = module.logging.Level.FATAL.value  # its errors arrive as exceptions
    return module


def absent(*needed: str) -> list[str]:
    """Rows of `LIBRARIES` that are not installed, those `needed` among them; torch, which is large, if it is needed."""
    return [
        name
        for name, library in LIBRARIES.items()
        if name in needed or (name != "torch" and importlib.util.find_spec(library.module) is None)
    ]


def install_command(names: Iterable[str]) -> str:
    """What installs rows of `LIBRARIES` into this Python's environment, however DR-GS came there."""
    packages = " ".join(f'"{LIBRARIES[name].package}"' for name in names)
    return install_remedy(packages, "Photographs without Cameras")


def is_there(name: str) -> bool:
    """Whether a row of `LIBRARIES` can be loaded."""
    try:
        load(name)
    except Exception:  # also where a library of its own does not load
        return False
    return True
