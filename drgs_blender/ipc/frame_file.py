"""A frame on disk, for programs that do not talk to Blender; numpy and the standard library only.

A safetensors file: the arrays by slot, and the rest of the frame as JSON. Large arrays lie beside it, named by what
they hold, so that the frames of a sequence share what does not change.
"""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.archive import replace_file
from ..core.asset.tensors import decode, encode, parse_json
from ..core.errors import AssetError, VersionError
from ..core.frame import Frame
from ..core.version import __version__
from .codec import CodecError, completed, decode_frame, encode_frame

Array = np.ndarray

#: Ending of such files.
SUFFIX = ".drgsframe"
#: Of the description; counts up when its fields change. `_UPGRADES` reads the formats before.
FORMAT = 12
_DESCRIPTION = "description"
#: Arrays of as many bytes have a file of their own.
_LARGE = 1 << 16
_REMEDY = "Export the frame again"


def write_frame_file(path: Path, frame: Frame) -> None:
    """Write `frame`, whose objects name the files of their assets. Raises WriteError."""
    data, arrays = encode_frame(frame)
    beside = {slot: _write_beside(path.parent, array) for slot, array in arrays.items() if array.nbytes >= _LARGE}
    text = json.dumps({"format": FORMAT, "version": __version__, "frame": data, "apart": beside}, allow_nan=False)
    inside = {slot: array for slot, array in arrays.items() if slot not in beside}
    replace_file(path, encode({_DESCRIPTION: np.frombuffer(text.encode(), np.uint8)} | inside))


def read_frame_file(path: Path) -> Frame:
    """The frame that `write_frame_file` wrote.

    Raises
    ------
    AssetError
        The file cannot be read, or is damaged.
    VersionError
        A later version of the program wrote it.
    """
    return _read(path)[0]


def read_frame_version(path: Path) -> str:
    """Version of the program that wrote a frame; raises what `read_frame_file` raises."""
    return _read(path)[1]


def _read(path: Path) -> tuple[Frame, str]:
    """The frame, and the version of the program that wrote it."""
    subject = str(path)
    try:
        if path.exists() and not path.is_file():
            raise AssetError(subject, "is not a regular file", _REMEDY)
        arrays = decode(np.fromfile(path, np.uint8), subject)
    except OSError as error:
        raise AssetError(subject, f"cannot be read ({error.strerror or error})", "Check the path") from error
    text = arrays.pop(_DESCRIPTION, None)
    if text is None:
        raise AssetError(subject, "is no frame", _REMEDY)
    content = parse_json(text.tobytes(), subject)
    kind = content.get("format", 1)
    if kind not in range(1, FORMAT + 1):
        problem = f"has format {str(kind)[:20]} (of DR-GS {str(content.get('version'))[:20]}); this is {__version__}"
        raise VersionError(subject, problem, "Use a later DR-GS, or export the frame again with this one")
    arrays |= _read_beside(path, content.get("apart"))
    frame: Any = content.get("frame")
    try:
        for upgrade in _UPGRADES[kind - 1 :]:
            frame = upgrade(frame)
    except (TypeError, KeyError, AttributeError, CodecError) as error:
        raise AssetError(subject, f"is no frame ({type(error).__name__}: {error})", _REMEDY) from error
    try:
        return decode_frame(frame, arrays), str(content.get("version"))
    except CodecError as error:
        raise AssetError(subject, f"is no frame ({error})", _REMEDY) from error


def _named_samples(frame: dict[str, Any]) -> dict[str, Any]:
    """Format 1 to 2: samples are one number, and settings have the names that artists see."""
    frame = dict(frame)
    frame["noise_index"] = frame.pop("number")
    settings = frame["settings"] = dict(frame["settings"])
    counts = [settings.pop(name) for name in ("cosine", "ggx", "environment")]
    settings["strategy_samples"] = counts if settings.pop("split") == "counts" else None
    settings["samples"] = sum(counts)
    names = {"aa": "subpixel_samples", "primary": "camera_sees", "tracer": "rays_see", "look": "shading_model"}
    for old, new in names.items():
        settings[new] = settings.pop(old)
    return frame


def _with_new_fields(frame: dict[str, Any]) -> dict[str, Any]:
    """Formats 2 to 12: fields that came later have their defaults."""
    found: dict[str, Any] = completed(Frame, frame)
    return found


#: From each format to the next, the oldest first.
_UPGRADES = (_named_samples, *(_with_new_fields,) * 10)


def _write_beside(folder: Path, array: Array) -> str:
    """Write an array to a file that its content names, unless that is there; return the name."""
    data = io.BytesIO()
    np.save(data, array, allow_pickle=False)
    name = f"{hashlib.blake2b(data.getbuffer(), digest_size=16).hexdigest()}.npy"
    if not (folder / name).exists():
        replace_file(folder / name, [data.getbuffer()])
    return name


def _read_beside(path: Path, names: Any) -> dict[str, Array]:
    """The arrays that lie beside a frame file, by slot."""
    subject = str(path)
    if not isinstance(names, dict):
        raise AssetError(subject, "is no frame", _REMEDY)
    arrays = {}
    for slot, name in names.items():
        beside = path.parent / str(name)
        if Path(str(name)).name != name or not beside.is_file():
            raise AssetError(subject, f"needs {str(name)[:60]!r}, which does not lie beside it", _REMEDY)
        try:
            arrays[slot] = np.load(beside, allow_pickle=False)
        except (OSError, ValueError, EOFError, SyntaxError, MemoryError) as error:
            raise AssetError(str(beside), f"cannot be read ({error})", _REMEDY) from error
    return arrays
