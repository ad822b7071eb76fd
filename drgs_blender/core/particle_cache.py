"""The particle cache: simulated frames on disk, a file each, whole or absent, that can be read while it grows.

    CACHE/cache.json            what was simulated: settings, their digest, counts, frames a second
    CACHE/rest.drgp             points and vertices at rest
    CACHE/frame_000012.drgp     points (float32), their deformation gradients (float16), vertices (float32), and of
                                matter that can break which bonds have broken until then (bits)
    CACHE/state.drgp            all that the next frame depends on, to go on after an interruption

Positions are in the space of the object. The files are stored zips (asset.archive); numpy alone reads them.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .asset.archive import read_archive, replace_file, write_archive
from .errors import AssetError, UsageError, WriteError
from .frame import Particles
from .sim_materials import LOOSE

Array = np.ndarray

#: 3: frames know what has broken until then.
VERSION = 3
HEADER, _REST, _STATE = "cache.json", "rest.drgp", "state.drgp"
_NAME = re.compile(r"frame_(-?\d+)\.drgp")
_AGAIN = "Bake again"
#: Of the bits of a half, the same number in single precision: a third of the time that a conversion takes.
with np.errstate(invalid="ignore"):  # of NaNs, on Arm
    _SINGLE = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a particle cache.

    Attributes
    ----------
    digest : str
        Of the settings and the mesh; another one means other frames.
    moves : list of str
        Of what moves in each frame, see `simulate.digest`.
    points, vertices : int
        Counts.
    first : int
        Frame at which all is at rest.
    fps : float
        Frames per second.
    settings : dict
        JSON-able, as they were given.
    tear, grain : float
        See `frame.ObjectState`.
    cells : list of list of float, optional
        See `frame.Particles`; caches of version 1 have none.
    """

    digest: str
    points: int
    vertices: int
    first: int
    fps: float
    settings: dict[str, Any] = field(default_factory=dict)
    version: int = VERSION
    tear: float = 0.0
    grain: float = 0.0
    moves: list[str] = field(default_factory=list)
    cells: list[list[float]] | None = None

    @property
    def is_fluid(self) -> bool:
        """Whether all of the matter is fluid."""
        return all(isinstance(row, dict) and row.get("model") == "fluid" for row in self._materials)

    @property
    def keeps_shape(self) -> bool:
        """Whether none of the matter flows: only then do its particles know how space around them deforms."""
        return all(isinstance(row, dict) and row.get("model") not in LOOSE for row in self._materials)

    @property
    def breaks(self) -> bool:
        """Whether its matter can break, so that frames keep what has broken."""
        rigid = isinstance(self.settings, dict) and self.settings.get("solver") == "rigid"
        return self.keeps_shape and not rigid and self.tear > 0 and self.cells is not None

    def has_skin(self, surface: str, captured: bool) -> bool:
        """Whether an object is shown by a surface of its particles.

        Parameters
        ----------
        surface : str
            "particles", "mesh", or "automatic": of fluids, but where `captured` colours are shown, which it has not.
        captured : bool
        """
        return surface == "particles" or (surface == "automatic" and self.is_fluid and not captured)

    @property
    def _materials(self) -> list[Any]:
        """That of the body and those of its regions, as far as they are known."""
        settings = self.settings if isinstance(self.settings, dict) else {}
        rows = settings.get("regions") or ()
        kept = [row[-1] if isinstance(row, list | tuple) and row else None for row in rows]
        return [settings.get("material"), *kept]


@dataclass(slots=True)
class ParticleFrame:
    """Particles in one frame, object space.

    Attributes
    ----------
    points : (n, 3) float32 array
        Metres.
    gradients : (n, 3, 3) float16 array
        Deformation gradient of each since rest.
    vertices : (k, 3) float32 array
        Metres: the mesh.
    broken : (bytes,) uint8 array, optional
        What has broken until then, see `frame.Particles`; not of matter that cannot break, nor of caches of before.
    """

    points: Array
    gradients: Array
    vertices: Array
    broken: Array | None = None


class ParticleCache:
    """A folder of frames.

    Parameters
    ----------
    folder : str or path-like
        Need not exist before `create`.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def path(self, frame: int) -> Path:
        """File of a frame."""
        return self.folder / f"frame_{frame:06d}.drgp"

    def create(self, header: Header, rest: ParticleFrame) -> None:
        """Begin a cache: remove frames of other settings, write the header last.

        Raises
        ------
        WriteError
            Naming the file and the system's reason.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WriteError(
                str(self.folder), f"cannot be made ({error.strerror or error})", "Choose another folder"
            ) from error
        self.clear()
        self.write_rest(rest)
        self.describe(header)

    def write_rest(self, rest: ParticleFrame) -> None:
        """Write particles and mesh at rest."""
        _write(self.folder / _REST, _members_of(rest))

    def extend(self, header: Header, last: int) -> None:
        """Go on under another header: frames after `last` are removed."""
        self._remove([self.path(frame) for frame in self.frames() if frame > last])
        self.describe(header)

    def describe(self, header: Header) -> None:
        """Write the header alone."""
        replace_file(self.folder / HEADER, [json.dumps(asdict(header), indent=1).encode()])

    def files(self) -> list[Path]:
        """All that it may have, the header last: without it there is no cache."""
        return [*map(self.path, self.frames()), *(self.folder / name for name in (_REST, _STATE, HEADER))]

    def clear(self) -> None:
        """Remove all files of a cache, the header first: what is left then is no cache."""
        self._remove(reversed(self.files()))
        with suppress(OSError, WriteError):
            self._remove(self.folder.glob(".*.drgp.*.tmp"))

    @staticmethod
    def _remove(paths: Iterable[Path]) -> None:
        for path in paths:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise WriteError(
                    str(path), f"cannot be removed ({error.strerror or error})", "Check permissions"
                ) from error

    def header(self) -> Header | None:
        """The header of the cache in the folder; None where it is no cache.

        Raises
        ------
        AssetError
            The header is damaged, or of a later version of DR-GS.
        """
        path = self.folder / HEADER
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            raise AssetError(str(path), f"cannot be read ({error})", _AGAIN) from error
        try:
            header = Header(**json.loads(text))
        except (ValueError, TypeError) as error:
            raise AssetError(
                str(path), "is not the header of a particle cache", "Remove this file, and bake again"
            ) from error
        if header.version not in range(1, VERSION + 1):
            raise AssetError(str(path), f"is of version {header.version}, not {VERSION}", "Use the DR-GS that baked it")
        return header

    def frames(self) -> list[int]:
        """Frames that are there, ascending; may grow at any time."""
        if not self.folder.is_dir():
            return []
        names = (_NAME.fullmatch(name) for name in os.listdir(self.folder))
        return sorted(int(match[1]) for match in names if match)

    def lacking(self, first: int, last: int) -> int | None:
        """The first of some frames that is missing or cut off, or None: all have as many bytes; the last is read."""
        sizes = []
        for frame in range(first, last + 1):
            try:
                sizes.append(self.path(frame).stat().st_size)
            except OSError:
                return frame
        whole = max(sizes, default=0)
        if (gone := next((first + i for i, size in enumerate(sizes) if size != whole), None)) is not None:
            return gone
        try:
            self.read(last)
        except (AssetError, UsageError):
            return last
        return None

    def rest(self) -> ParticleFrame:
        """Particles and mesh at rest."""
        return _frame(self.folder / _REST)

    def read(self, frame: int) -> ParticleFrame:
        """One frame; before the first it is at rest.

        Raises
        ------
        UsageError
            It is not baked (yet), saying which frames are.
        AssetError
            Its file is damaged.
        """
        path = self.path(frame)
        try:
            return _frame(path)
        except AssetError:
            if path.exists():  # afterwards: another bake may start over, and remove it at any moment
                raise
        there = self.frames()
        held = f"There are frames {there[0]} to {there[-1]}" if there else "Bake first: the cache has no frame"
        raise UsageError(f"{self.folder}, frame {frame}", "is not baked", held)

    def driving(
        self,
        frame: float,
        rest: ParticleFrame | None = None,
        *,
        last: int | None = None,
        place: Callable[[int, ParticleFrame], ParticleFrame] | None = None,
    ) -> tuple[Particles, Array]:
        """What carries an object's surfels at a time; nothing of it is mapped from a file.

        Parameters
        ----------
        frame : float
            Between two frames all moves straight from one to the next, and what has broken in the next is broken;
            beyond those that are there nothing moves.
        rest : ParticleFrame, optional
            All at rest, where it has been read before.
        last : int, optional
            Frames after it count as not there.
        place : callable, optional
            Brings frames, by their number, to where they are shown before they are blended; their gradients are
            float32.

        Returns
        -------
        particles : Particles
        vertices : (k, 3) float32 array
            The mesh then, object space.

        Raises
        ------
        AssetError, UsageError
            A file is damaged, or there is no frame.
        """
        there = [known for known in self.frames() if last is None or known <= last]
        at = min(max(frame, there[0]), there[-1]) if there else frame
        first = int(np.floor(at))
        shown = [_single(self.read(first + k)) for k in range(2 if at > first else 1)]
        rest = self.rest() if rest is None else rest
        for number, read in enumerate(shown, first):
            for what, found, wanted in (
                ("particles", len(read.points), len(rest.points)),
                ("bytes of what has broken", *(0 if of.broken is None else len(of.broken) for of in (read, rest))),
            ):
                if found != wanted:
                    raise AssetError(str(self.path(number)), f"has {found} {what}, {wanted} at rest", _AGAIN)
        broken = None if shown[-1].broken is None else np.array(shown[-1].broken)
        shown = shown if place is None else [place(number, read) for number, read in enumerate(shown, first)]
        points, gradients, vertices = (np.array(a) for a in (shown[0].points, shown[0].gradients, shown[0].vertices))
        if len(shown) > 1:
            part, then = np.float32(at - first), shown[1]
            for now, later in ((points, then.points), (gradients, then.gradients), (vertices, then.vertices)):
                now += part * (later - now)
        began = np.array(rest.points) if rest.points.base is not None else rest.points
        for array in (began, points, gradients, vertices, *([] if broken is None else [broken])):
            array.flags.writeable = False  # so that the engine's client need not copy it
        return Particles(began, points, gradients, broken=broken), vertices

    def write(self, frame: int, particles: ParticleFrame) -> None:
        """Write a frame in one step: a reader sees all of it or nothing."""
        _write(self.path(frame), _members_of(particles))

    def write_state(self, frame: int, arrays: dict[str, Array]) -> None:
        """Keep what the frame after `frame` depends on."""
        _write(self.folder / _STATE, {"frame": np.array([frame], np.int64)} | arrays)

    def read_state(self) -> tuple[int, dict[str, Array]] | None:
        """The last frame kept by `write_state` and its arrays; None where there is none that can be read."""
        try:
            arrays = _read(self.folder / _STATE)
            return int(arrays.pop("frame")[0]), arrays
        except (AssetError, KeyError):
            return None


def _single(frame: ParticleFrame) -> ParticleFrame:
    """A frame with gradients in single precision."""
    gradients = _SINGLE[np.ascontiguousarray(frame.gradients, np.float16).view(np.uint16)]
    return replace(frame, gradients=gradients)


def _members_of(particles: ParticleFrame) -> dict[str, Array]:
    top = float(np.finfo(np.float16).max)
    members = {
        "points": np.ascontiguousarray(particles.points, np.float32),
        "gradients": np.clip(particles.gradients, -top, top).astype(np.float16),
        "vertices": np.ascontiguousarray(particles.vertices, np.float32),
    }
    return members if particles.broken is None else members | {"broken": particles.broken}


def _frame(path: Path) -> ParticleFrame:
    arrays = _read(path)
    try:
        points, gradients, vertices = arrays["points"], arrays["gradients"], arrays["vertices"]
    except KeyError as error:
        raise AssetError(str(path), f"lacks {error.args[0]}", _AGAIN) from error
    if points.ndim != 2 or points.shape[1:] != (3,) or gradients.shape != (len(points), 3, 3):
        raise AssetError(str(path), "holds arrays that do not fit each other", _AGAIN)
    broken = arrays.get("broken")
    if broken is not None and (broken.dtype != np.uint8 or broken.ndim != 1 or 8 * len(broken) < 3 * len(points)):
        raise AssetError(str(path), f"does not say of {len(points)} particles what has broken", _AGAIN)
    return ParticleFrame(points, gradients, vertices, broken)


def _write(path: Path, arrays: dict[str, Array]) -> None:
    """Arrays and, as the first member, their shapes and types."""
    kept = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    index = {name: [array.dtype.str, list(array.shape)] for name, array in kept.items()}
    members = [("index.json", [memoryview(json.dumps(index, separators=(",", ":")).encode())])]
    members += [(name, [array.reshape(-1).view(np.uint8).data]) for name, array in kept.items()]
    write_archive(path, members)


def _read(path: Path) -> dict[str, Array]:
    """Arrays of a file, each checked against its CRC."""
    try:
        names = read_archive(path)
        views = read_archive(path, check=tuple(names))
        index = json.loads(views["index.json"].tobytes())
        return {name: views[name].view(np.dtype(kind)).reshape(shape) for name, (kind, shape) in index.items()}
    except AssetError as error:
        raise AssetError(error.subject, error.problem, _AGAIN) from error
    except (KeyError, ValueError, TypeError) as error:
        raise AssetError(str(path), "is not a file of a particle cache", _AGAIN) from error
