"""Say what a file holds: a .drgs asset, a mesh, surfels or splats, an environment, a rendered EXR frame, a capture.

The kind is found from the content, not from the name.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError
from ..core.file_integrity import EXR
from ..core.file_types import CAMERAS
from ..formats.axes import UP_AXES

EXAMPLES = """examples:
  drgs inspect helmet.drgs
  drgs inspect capture.ply --json
  drgs inspect frames/0001.exr
  drgs inspect statue --json > cameras.json
"""

_ZIP = b"PK\x03\x04"
#: Items of a list that a person is shown, and values within values, without --all.
_FEW, _FEW_WITHIN = 16, 2
#: Lines that a person is shown without --all, lines of a part that is put into running text, and its letters in a line.
_MOST_LINES, _FEW_LINES, _WIDTH = 30, 3, 120


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs inspect``."""
    parser.add_argument("file", type=Path, metavar="FILE", help="any file (or folder) that DR-GS reads or writes")
    parser.add_argument("--json", action="store_true", help="print JSON, of all that is known")
    parser.add_argument("--all", action="store_true", dest="whole", help="print all: settings, tensors, cameras")
    parser.add_argument("--axes", choices=tuple(CAMERAS), default="opengl", help="of a capture, as drgs reconstruct")
    parser.add_argument("--up", choices=tuple(UP_AXES), help="of a capture, as drgs reconstruct")


def run(args: argparse.Namespace) -> int:
    """Print the description."""
    report = {"file": str(args.file), **inspect_file(args.file, args.axes, args.up)}
    if args.json:
        print(json.dumps(report, indent=2, allow_nan=False))
    else:
        print("\n".join(as_lines(report) if args.whole else short_lines(report)))
    return 0


def inspect_file(path: Path, axes: str = "opengl", up: str | None = None) -> dict[str, Any]:
    """Describe a file with JSON-able values; ``kind`` says what it is. Of captures, `axes` and `up` as they are read.

    Raises
    ------
    AssetError
        The file cannot be read or is of no known kind.
    """
    magic = b""
    try:
        if path.is_file():
            with path.open("rb") as stream:
                magic = stream.read(4)
    except OSError as error:
        raise AssetError(str(path), f"cannot be read ({error.strerror})", "Check the path") from error
    if magic == _ZIP and path.suffix.lower() == ".drgs":
        from ..core.asset.container import inspect_asset

        return {"kind": "asset", **inspect_asset(path)}
    if magic == EXR and (frame := inspect_frame(path) or inspect_layers(path)):
        return frame
    from ..ipc.frame_file import SUFFIX

    if path.suffix.lower() == SUFFIX:
        return inspect_exported_frame(path)
    from ..formats.registry import find_format, read

    try:
        kind = find_format(path)
    except AssetError:
        if path.is_dir() or path.suffix.lower() == ".json":
            return inspect_capture(path, axes, up)
        raise
    return {"kind": kind.kind, "format": kind.name, **describe(read(path))}


def inspect_capture(path: Path, axes: str = "opengl", up: str | None = None) -> dict[str, Any]:
    """Describe a capture and the camera of each photograph: Blender's axes, Z up, metres, pixels."""
    from ..reconstruct.readers import find_layout, read_layout
    from ..reconstruct.readers.layout import picture_size

    layout, _ = read_layout(path, axes, up)
    lenses = [one.lens.scaled(*picture_size(one.image)) for one in layout.photographs]
    cameras = [
        {
            "name": one.name,
            "image": str(one.image.absolute()),
            "mask": None if one.mask is None else str(one.mask.absolute()),
            "test": one.test,
            "matrix_world": one.matrix.tolist(),
            **{name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "model")},
            "distorts": lens.distorts,
            "coefficients": list(lens.coefficients),
        }
        for one, lens in zip(layout.photographs, lenses, strict=True)
    ]
    return {
        "kind": "capture",
        "format": find_layout(path).name,
        "photographs": len(cameras),
        "test_views": sum(one["test"] for one in cameras),
        "masks": sum(one["mask"] is not None or _has_alpha(Path(one["image"])) for one in cameras),
        "points": 0 if layout.points is None else len(layout.points),
        "guessed": layout.guessed,
        "cameras": describe(cameras),
    }


def _has_alpha(path: Path) -> bool:
    """Whether a picture has alpha, which is its mask, by its head alone."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return "A" in picture.getbands() or "transparency" in picture.info
    except (OSError, ValueError, SyntaxError):  # a format that Pillow does not know, damaged, or not there
        return False


def inspect_exported_frame(path: Path) -> dict[str, Any]:
    """Describe a frame that Blender exported, for `drgs convert` and `drgs bake`."""
    from ..ipc.frame_file import read_frame_file, read_frame_version

    frame = read_frame_file(path)
    objects = {state.name: state.asset for state in frame.objects}
    size = {"width": frame.camera.width, "height": frame.camera.height}
    about = {"version": read_frame_version(path), **size, "passes": list(frame.passes), "objects": objects}
    return {"kind": "exported frame", **about, "settings": describe(frame.settings)}


def inspect_frame(path: Path) -> dict[str, Any] | None:
    """Describe a frame written by DR-GS; None when the EXR was written by another program."""
    from ..render.film.frame_files import read_frame

    try:
        pictures, metadata = read_frame(path)
    except AssetError:
        return None
    if "Combined" not in pictures:
        return None
    height, width = pictures["Combined"].shape[:2]
    passes = {name: summary(picture) for name, picture in pictures.items()}
    return {"kind": "frame", "width": width, "height": height, "passes": passes, "metadata": dict(metadata)}


def inspect_layers(path: Path) -> dict[str, Any] | None:
    """Describe a multi-layer EXR of another program, such as Blender writes at F12; None of those of one layer."""
    import OpenEXR

    from ..render.film.frame_files import PREFIX

    channels: dict[str, np.ndarray] = {}
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if any(str(key).startswith(PREFIX) for part in file.parts for key in part.header):
                return None  # a frame of DR-GS that is damaged
            for part in file.parts:
                channels |= {name: channel.pixels for name, channel in part.channels.items()}
    except (OSError, RuntimeError, ValueError, TypeError):  # damaged: who reads it as an environment says how
        return None
    layers: dict[str, list[np.ndarray]] = {}
    for name, pixels in channels.items():
        layers.setdefault(name.rpartition(".")[0], []).append(pixels)
    if len(layers) < 2:
        return None
    height, width = next(iter(channels.values())).shape[:2]
    passes = {name or "Combined": summary(np.stack(planes, axis=-1)) for name, planes in layers.items()}
    return {"kind": "frame", "width": width, "height": height, "passes": passes}


def summary(array: np.ndarray) -> dict[str, Any]:
    """Shape, type and range of an array; ``not_finite`` counts NaN and infinities where there are any."""
    result: dict[str, Any] = {"shape": list(array.shape), "dtype": array.dtype.name}
    if array.size and array.dtype.kind in "fiu":
        finite = np.isfinite(array)
        bad = int(array.size - np.count_nonzero(finite))
        if bad:
            result["not_finite"] = bad
        if bad < array.size:
            values = array if not bad else array[finite]
            result["range"] = [float(values.min()), float(values.max())]
    return result


def describe(value: Any) -> Any:
    """JSON-able description of what a reader returned: dataclasses by field, arrays by `summary`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: describe(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return summary(value)
    if isinstance(value, dict):
        return {str(key): describe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [describe(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def as_lines(value: Any, depth: int = 0, whole: bool = True) -> Iterator[str]:
    """Indented lines for a person; short lists and array summaries stay on one line.

    Unless it is to be `whole`, what lies deeper and is long is counted only.
    """
    pad = "  " * depth
    named = isinstance(value, dict)
    for key, item in value.items() if named else enumerate(value):
        if isinstance(item, dict) and "shape" in item and "dtype" in item:
            low_high = " from {:.4g} to {:.4g}".format(*item["range"]) if item.get("range") else ""
            bad = f", {item['not_finite']} not finite" if item.get("not_finite") else ""
            yield f"{pad}{key}: {' x '.join(map(str, item['shape']))} {item['dtype']}{low_high}{bad}"
        elif isinstance(item, dict | list) and item and not is_short(item):
            nested = isinstance(item, list) and any(isinstance(part, dict) for part in item)
            if not whole and (depth or nested) and count_values(item) > _FEW_WITHIN:
                count = f"{len(item)}, " if nested else f"{count_values(item)} values, "
                yield f"{pad}{key}: {count}see --all"
                continue
            yield f"{pad}{key}:"
            yield from as_lines(item, depth + 1, whole)
        elif isinstance(item, list):
            more = f", ... ({len(item)} in all)" if len(item) > _FEW else ""
            yield f"{pad}{key}: {', '.join(format_value(part) for part in item[:_FEW]) or 'none'}{more}"
        else:
            yield f"{pad}{key}: {format_value(item)}" if named else f"{pad}- {format_value(item)}"


def short_lines(report: dict[str, Any]) -> list[str]:
    """At most `_MOST_LINES` lines of a description: where it has more, the longest parts are shortened."""
    blocks = {key: list(as_lines({key: item}, whole=False)) for key, item in report.items()}
    for key in sorted(blocks, key=lambda name: -len(blocks[name])):
        if sum(map(len, blocks.values())) > _MOST_LINES and len(blocks[key]) > 1:
            blocks[key] = _condensed(key, report[key], blocks[key])
    lines = [line for block in blocks.values() for line in block]
    if len(lines) <= _MOST_LINES:
        return lines
    return [*lines[: _MOST_LINES - 1], f"... {len(lines) - _MOST_LINES + 1} more lines, see --all"]


def _condensed(key: str, item: Any, block: list[str]) -> list[str]:
    """The lines of one part as running text; one line that counts it where that is long, too."""
    running = "; ".join(re.sub(r"^\s*(- |\d+: )?", "", line) for line in block[1:]).replace(":; ", ": ")
    lines = textwrap.wrap(f"{key}: {running}", _WIDTH, subsequent_indent="  ", break_on_hyphens=False)
    if len(lines) <= _FEW_LINES and len(lines) < len(block):
        return lines
    names = f" ({', '.join(map(str, item))})" if isinstance(item, dict) else ""
    return [textwrap.shorten(f"{key}: {len(item)}{names}", _WIDTH, placeholder=" ...)") + ", see --all"]


def count_values(value: Any) -> int:
    """How many lines of values `as_lines` makes of a value."""
    if isinstance(value, dict) and not ("shape" in value and "dtype" in value):
        return sum(map(count_values, value.values()))
    return sum(map(count_values, value)) if isinstance(value, list) and value and not is_short(value) else 1


def is_short(value: Any) -> bool:
    """Whether the first items of a list fit a line: none is nested or a sentence."""
    return isinstance(value, list) and not any(isinstance(item, dict | list) or len(str(item)) > 30 for item in value)


def format_value(value: Any) -> str:
    """A value as a person writes it."""
    if value is None or value == {}:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
