"""Wavefront OBJ with MTL: polygons, texture coordinates, normals, materials (also the PBR ones of MTL)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from ..core.color import srgb_to_linear
from ..core.errors import AssetError
from .files import Image, MaterialFile, MeshFile
from .images import decode_image

Array = np.ndarray

_DAMAGED = "Export the file again, or restore it from a copy"


@dataclass(slots=True)
class _Reading:
    """What has been read so far."""

    vertices: list[list[float]] = field(default_factory=list)
    colours: list[list[float]] = field(default_factory=list)
    uvs: list[list[float]] = field(default_factory=list)
    normals: list[list[float]] = field(default_factory=list)
    corners: list[tuple[int, int, int]] = field(default_factory=list)  # vertex, uv, normal; three a triangle
    face_material: list[int] = field(default_factory=list)
    materials: list[str] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    parts: list[tuple[str, int]] = field(default_factory=list)  # name, first face


def read_obj(path: Path) -> MeshFile:
    """Read the OBJ file at `path` and the MTL files and images it names. Polygons become triangle fans.

    OBJ states no up axis: positions are as in the file. Vertex colours (an extension) are taken as sRGB, as Blender
    does.

    Raises
    ------
    AssetError
        A line cannot be understood or refers to what is not there.
    """
    reading = _Reading()
    current = -1
    # latin-1 decodes anything; names in UTF-8 survive the round trip in `_text`
    lines = path.read_text(encoding="latin-1").replace("\\\r\n", " ").replace("\\\n", " ").split("\n")
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        keyword, rest = words[0], line.strip()[len(words[0]) :].strip()
        try:
            if keyword == "v":
                _vertex(reading, [float(w) for w in words[1:]])
            elif keyword == "vt":
                reading.uvs.append([float(words[1]), float(words[2]) if len(words) > 2 else 0.0])
            elif keyword == "vn":
                reading.normals.append([float(w) for w in words[1:4]])
            elif keyword == "f":
                _face(reading, words[1:], current)
            elif keyword == "usemtl":
                name = _text(rest)
                if name not in reading.materials:
                    reading.materials.append(name)
                current = reading.materials.index(name)
            elif keyword == "mtllib":
                reading.libraries.append(_text(rest))
            elif keyword in ("o", "g"):
                reading.parts.append((_text(rest), len(reading.face_material)))
        except (ValueError, IndexError) as error:
            raise AssetError(
                f"{path}, line {number}", f"cannot be understood ({line.strip()[:60]!r})", _DAMAGED
            ) from error
    return _finish(reading, path)


def _vertex(reading: _Reading, numbers: list[float]) -> None:
    if len(numbers) < 3:
        raise ValueError("too few coordinates")
    reading.vertices.append(numbers[:3])
    if len(numbers) >= 6:
        reading.colours.append(numbers[3:6])


def _face(reading: _Reading, words: list[str], material: int) -> None:
    """Add a polygon as a fan; missing texture coordinates and normals are -1."""
    sizes = len(reading.vertices), len(reading.uvs), len(reading.normals)
    corners = []
    for word in words:
        entry = [-1, -1, -1]
        for k, text in enumerate(word.split("/")[:3]):
            if text:
                index = int(text)
                entry[k] = index - 1 if index > 0 else sizes[k] + index
                if index == 0 or not 0 <= entry[k] < sizes[k]:
                    raise IndexError(f"refers to number {index} of {sizes[k]}")
        if entry[0] < 0:
            raise ValueError("a corner without a vertex")
        corners.append((entry[0], entry[1], entry[2]))
    for k in range(1, len(corners) - 1):
        reading.corners += [corners[0], corners[k], corners[k + 1]]
        reading.face_material.append(material)


def _finish(reading: _Reading, path: Path) -> MeshFile:
    notes: list[str] = []
    corners = np.array(reading.corners, np.int64).reshape(-1, 3, 3)
    known = _libraries(reading.libraries, path, notes)
    for name in reading.materials:
        if name not in known:
            notes.append(f"material {name} is not described")
    ends = [first for _, first in reading.parts[1:]] + [len(corners)]
    with np.errstate(over="ignore"):
        mesh = MeshFile(
            np.array(reading.vertices).reshape(-1, 3),
            corners[:, :, 0],
            face_material=np.array(reading.face_material, np.int32),
            materials=[known.get(name, MaterialFile(name)) for name in reading.materials],
            parts=[(n, first, end) for (n, first), end in zip(reading.parts, ends, strict=False) if end > first],
            notes=notes,
        )
        mesh.corner_uvs = _per_corner(reading.uvs, corners[:, :, 1])
        normals = _per_corner(reading.normals, corners[:, :, 2])
    if normals is not None and (corners[:, :, 2] >= 0).all():
        length = np.linalg.norm(normals, axis=2, keepdims=True)
        if np.isfinite(length).all() and (length > 0).all():
            mesh.corner_normals = normals / length
    if len(reading.colours) == len(reading.vertices) > 0:
        mesh.vertex_colours = srgb_to_linear(np.clip(np.nan_to_num(np.array(reading.colours)), 0.0, 1.0))
        notes.append("vertex colours decoded from sRGB")
    return mesh


def _per_corner(values: list[list[float]], which: Array) -> Array | None:
    """Values at the corners as float32, zeros where a corner has none; None where no corner has any."""
    if not values or not (which >= 0).any():
        return None
    table = np.array(values, np.float64).reshape(len(values), -1).astype(np.float32)
    return np.where(which[..., None] >= 0, table[which], np.float32(0))


def _libraries(names: list[str], path: Path, notes: list[str]) -> dict[str, MaterialFile]:
    materials: dict[str, MaterialFile] = {}
    for name in dict.fromkeys(names):
        file = beside(path, name)
        if file is None or not file.is_file():
            notes.append(f"material file {name} not found")
        else:
            materials |= _read_mtl(file, notes)
    return materials


def _read_mtl(path: Path, notes: list[str]) -> dict[str, MaterialFile]:
    """Materials of an MTL file by name."""
    materials: dict[str, MaterialFile] = {}
    current = MaterialFile("")
    for line in path.read_text(encoding="latin-1").split("\n"):
        words = line.split()
        if not words:
            continue
        keyword = words[0].lower()
        try:
            if keyword == "newmtl":
                name = _text(line.strip()[6:].strip())
                current = materials[name] = MaterialFile(name)
            elif keyword == "kd":
                r, g, b = (_finite(w) for w in words[1:4])
                current.base_colour = r, g, b
            elif keyword == "ns":  # Blender's own mapping between shininess and roughness
                current.roughness = float(np.clip(1.0 - np.sqrt(max(_finite(words[1]), 0.0) / 1000.0), 0.0, 1.0))
            elif keyword == "pr":
                current.roughness = _finite(words[1])
            elif keyword == "pm":
                current.metallic = _finite(words[1])
            elif keyword == "map_kd":
                current.base_colour_image = _image(current, line, path, notes)
                if current.base_colour_image is not None:
                    current.base_colour = (1.0, 1.0, 1.0)
            elif keyword in ("d", "tr"):
                hides = _finite(words[-1])
                current.alpha = float(np.clip(hides if keyword == "d" else 1 - hides, 0, 1))
            elif keyword == "map_d":
                picture = _image(current, line, path, notes)
                if picture is not None:
                    current.alpha_image = picture.alpha or replace(picture, srgb=False)
            elif keyword == "ke":
                r, g, b = (_finite(w) for w in words[1:4])
                if min(r, g, b) < 0:
                    raise ValueError
                current.emission = r, g, b
            elif keyword == "map_ke":
                current.emission_image = _image(current, line, path, notes)
                if current.emission_image is not None:
                    current.emission = (1.0, 1.0, 1.0)
            elif keyword == "pc":
                current.coat = float(np.clip(_finite(words[1]), 0, 1))
            elif keyword in ("norm", "map_bump", "bump"):
                _read_normal_map(current, line, path, notes)
            elif keyword in ("map_pr", "map_pm", "map_ns"):
                notes.append(f"{current.name}: {keyword} ignored")
        except (ValueError, IndexError):
            notes.append(f"{path.name}: line {line.strip()[:60]!r} not understood")
    return materials


def _finite(word: str) -> float:
    """A number as 32 bits hold it. Raises ValueError where it is none."""
    number = float(word)
    if not abs(number) <= np.finfo(np.float32).max:
        raise ValueError
    return number


def _read_normal_map(material: MaterialFile, line: str, path: Path, notes: list[str]) -> None:
    """A normal map, as Blender reads these statements; heights, which are grey, are left out with a note."""
    image = _image(material, line, path, notes, "-bm")
    if image is None:
        return
    if image.pixels.ndim == 2 or image.pixels.shape[2] < 3 or np.ptp(image.pixels[..., :3], axis=2).max() == 0:
        notes.append(f"{material.name}: heights of {line.split()[0]} ignored: only normal maps are read")
        return
    (strength,) = _map_options(line)[0].get("-bm", _NUMBERS["-bm"])
    material.normal_image, material.normal_strength = replace(image, srgb=False), strength


#: Options of map statements: the numbers that follow them, with which they change nothing, or the word.
_NUMBERS = {
    "-s": (1.0, 1.0, 1.0), "-o": (0.0, 0.0, 0.0), "-t": (0.0, 0.0, 0.0), "-mm": (0.0, 1.0), "-bm": (1.0,),
    "-boost": (0.0,), "-texres": (0.0,),
}  # fmt: skip
_WORDS = {"-blendu": "on", "-blendv": "on", "-clamp": "off", "-cc": "off", "-imfchan": "", "-type": ""}


def _map_options(line: str) -> tuple[dict[str, tuple[float, ...]], list[str], str]:
    """Of a map statement: its numbers by option, which of its words change something, and the rest, a file's name.

    Numbers that are left out at the end of an option are those that change nothing.

    Raises
    ------
    ValueError
        It names no file, or an option is not followed by what belongs to it.
    """
    numbers: dict[str, tuple[float, ...]] = {}
    words: list[str] = []
    _, rest = _split(line)
    while (option := _split(rest)[0]) in _NUMBERS or option in _WORDS:
        _, rest = _split(rest)
        if option in _WORDS:
            word, rest = _split(rest)
            words += [option] if word != _WORDS[option] else []
            continue
        given: list[float] = []
        while len(given) < len(_NUMBERS[option]) and (number := _number(_split(rest)[0])) is not None:
            given.append(number)
            _, rest = _split(rest)
        if not given or not np.isfinite(given).all():
            raise ValueError
        numbers[option] = (*given, *_NUMBERS[option][len(given) :])
    if not rest:
        raise ValueError
    return numbers, words, rest


def _split(text: str) -> tuple[str, str]:
    """The first word, and what follows it."""
    first, *rest = text.split(None, 1) or ("",)
    return first, rest[0].strip() if rest else ""


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _image(material: MaterialFile, line: str, path: Path, notes: list[str], *used: str) -> Image | None:
    """The image that a map statement names; ValueError where it names none.

    `-s` and `-o` scale and move it, as in Blender; other options, but those `used`, are named.
    """
    numbers, words, rest = _map_options(line)
    file = beside(path, name := _text(rest))
    if file is None or not file.is_file():
        file = beside(path, name := _text(rest.split()[-1]))  # after options that are in no standard
    image = load_texture(file, name, notes)
    if image is None:
        return None
    ignored = [o for o, given in numbers.items() if o not in ("-s", "-o", *used) and given != _NUMBERS[o]] + words
    if ignored:
        notes.append(f"{material.name}: {', '.join(ignored)} of {line.split()[0]} ignored")
    (su, sv, _), (ou, ov, _) = (numbers.get(option, _NUMBERS[option]) for option in ("-s", "-o"))
    return replace(image, uv_transform=np.array([[su, 0.0, ou], [0.0, sv, ov]]))


def load_texture(file: Path | None, name: str, notes: list[str]) -> Image | None:
    """The sRGB texture in `file`; None, and a note that says why of the texture `name`, where there is none."""
    if file is None or not file.is_file():
        notes.append(f"texture {name} not found")
        return None
    try:
        data = file.read_bytes()
        return Image(decode_image(data, str(file)), srgb=True, file=data)
    except OSError as error:
        notes.append(f"texture left out: {file} cannot be read ({error.strerror or error})")
        return None
    except AssetError as error:
        notes.append(f"texture left out: {error}")
        return None


def beside(path: Path, name: str) -> Path | None:
    """The file `name` relative to `path`; of an absolute name only the last part is tried."""
    pure = PurePosixPath(name.replace("\\", "/"))
    if not pure.name or "\0" in name:
        return None
    return path.parent / (pure.name if pure.is_absolute() or ":" in name else pure)


def _text(raw: str) -> str:
    """A name as UTF-8 where it is that."""
    try:
        return raw.encode("latin-1").decode()
    except UnicodeDecodeError:
        return raw
