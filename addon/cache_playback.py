"""Playback of a particle cache: a PC2 file that grows with it, played by a Mesh Cache modifier.

Blender itself plays it, by its own frame number: the same in viewports, F12, `blender -b` and on farms that lack the
extension, in any order of frames, between them (motion vectors), after undo and after loading, and nothing is called at
a frame change. What is in the file is in the cache as well; it can be thrown away at any time.

Layout as of `point_caches`. The header's count of frames is changed
after the frames are written, so a reader never sees a part of one.
"""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..drgs_blender.core.asset.archive import replace_file
from ..drgs_blender.core.errors import AssetError, DrgsError, UsageError, WriteError
from ..drgs_blender.core.frame import Inside
from ..drgs_blender.core.particle_cache import HEADER, Header, ParticleCache
from . import point_caches
from .point_caches import MAGIC, PC2

Array = np.ndarray
log = logging.getLogger(__name__)

MODIFIER = "DR-GS Physics"
FILE = "mesh.pc2"
_COUNT = struct.Struct("<i")
_COUNT_AT = PC2.size - _COUNT.size


class Playback:
    """Keeps the PC2 file of a cache up to date.

    Parameters
    ----------
    folder : of the cache
    matrices : (k, 4, 4) object to world in every frame, where it moves by itself: the cache is in the object space of
        the first
    """

    def __init__(self, folder: Path, matrices: Array | None = None) -> None:
        self.path = folder / FILE
        self.count = 0
        self._cache, self._matrices = ParticleCache(folder), matrices
        self._checked: tuple[str, list[str]] | None = None

    def follow(self, seconds: float = float("inf")) -> int:
        """Append frames that the cache has and the file lacks, for about `seconds`.

        Returns
        -------
        int
            Frames in the file, from the first on.

        Raises
        ------
        AssetError
            A frame of the cache is damaged.
        WriteError
            The file cannot be written.
        """
        header = self._cache.header()
        if header is None:
            return 0
        until = time.monotonic() + seconds
        there = set(self._cache.frames())
        try:
            if self._checked != (header.digest, header.moves):
                self.count = self._count_of(header, there)
                self._checked = header.digest, header.moves
            while header.first + self.count in there:
                self._append(header)
                if time.monotonic() > until:
                    break
        except UsageError:  # another bake began and removed the frame just now
            log.debug("%s: the cache starts over", self.path)
        except OSError as error:
            raise WriteError(
                str(self.path),
                f"cannot be written ({error.strerror or error})",
                "Free some space or choose another folder, and bake again: it goes on",
            ) from error
        return self.count

    def _append(self, header: Header) -> None:
        frame = self._vertices(header, self.count)
        if self.count == 0:
            head = PC2.pack(MAGIC, 1, len(frame), float(header.first), 1.0, 1)
            replace_file(self.path, [head, frame.tobytes()])
        else:
            with open(self.path, "r+b") as file:
                file.seek(PC2.size + self.count * frame.nbytes)
                file.write(frame.tobytes())
                file.flush()
                file.seek(_COUNT_AT)
                file.write(_COUNT.pack(self.count + 1))
        self.count += 1

    def _vertices(self, header: Header, index: int) -> Array:
        """(n, 3) <f4 vertices of a frame in the object space of that frame."""
        vertices = self._cache.read(header.first + index).vertices
        if self._matrices is not None:
            now = self._matrices[min(index, len(self._matrices) - 1)]
            turn = np.linalg.inv(now) @ self._matrices[0]
            vertices = vertices @ turn[:3, :3].T + turn[:3, 3]
        return np.ascontiguousarray(vertices, "<f4")

    def _count_of(self, header: Header, there: set[int]) -> int:
        """Frames in the file that are those of the cache; 0 where its first or last is not, to start over."""
        if self._matrices is not None:
            return 0  # the cache does not record whether these have changed
        try:
            played = Played(self.path, header)
            if played.last < header.first or played.last not in there:
                return 0
            ends = {frame: played.vertices(frame) for frame in (header.first, played.last)}
        except (FileNotFoundError, AssetError):
            return 0
        kept = all(
            vertices.tobytes() == self._vertices(header, frame - header.first).tobytes()
            for frame, vertices in ends.items()
        )
        return played.last - header.first + 1 if kept else 0


class Played:
    """What a Mesh Cache modifier plays of a cache.

    Parameters
    ----------
    path : the PC2 file
    header : of the cache

    Attributes
    ----------
    last : the last frame that is in the file

    Raises
    ------
    AssetError
        The file is damaged, or of another cache.
    OSError
        It cannot be read.
    """

    def __init__(self, path: Path, header: Header) -> None:
        self.path, self._header = path, header
        with open(path, "rb") as file:
            head = file.read(PC2.size)
        if len(head) < PC2.size or not head.startswith(MAGIC) or PC2.unpack(head)[2] != header.vertices:
            raise AssetError(str(path), "is not what its cache is played by", "Bake again")
        self.last = header.first + PC2.unpack(head)[5] - 1

    def vertices(self, frame: int) -> Array:
        """(n, 3) float32 vertices as they are played in a frame, object space."""
        count = self._header.vertices
        at = PC2.size + (frame - self._header.first) * count * 12
        found = np.fromfile(self.path, "<f4", 3 * count, offset=at)
        if len(found) < 3 * count:
            raise AssetError(str(self.path), f"ends before frame {frame}", "Bake again")
        return found.reshape(count, 3)


def modifier_of(obj: bpy.types.Object) -> bpy.types.Modifier | None:
    """The modifier that plays the cache of an object."""
    return point_caches.find(obj, MODIFIER)


def check(obj: bpy.types.Object, warn: Callable[[str], None], *, final: bool) -> None:
    """See that what an object plays came along to this machine.

    Raises
    ------
    AssetError
        It did not: Blender would show the object as if it had never been simulated.
    """
    modifier = modifier_of(obj)
    if modifier is None or not (modifier.show_render if final else modifier.show_viewport):
        return
    path = path_of(obj, modifier)
    if not path.exists():
        raise AssetError(
            f'Object "{obj.name}"',
            f"its simulated frames are not there: {path} does not exist",
            "Bring the folder along with the .blend, bake again, or use Delete Bake",
        )
    physics = obj.drgs.physics
    # While a bake starts over there is none for a moment; then nobody waits for a final picture.
    if final and (physics.tear or physics.grain) and not (path.parent / HEADER).exists():
        warn(f'"{obj.name}": {path.parent / HEADER} does not exist; its tears and grains are not shown. Bake again')


def path_of(obj: bpy.types.Object, modifier: bpy.types.Modifier) -> Path:
    """The file that a modifier plays."""
    return Path(bpy.path.abspath(modifier.filepath, library=obj.library))


def fracture_state(obj: bpy.types.Object) -> dict[str, Any]:
    """`tear`, `grain` and `inside` of the played mesh, see `frame.ObjectState`; empty where nothing is played."""
    modifier, physics = modifier_of(obj), obj.drgs.physics
    if modifier is None:
        return {}
    with suppress(DrgsError):  # a damaged cache plays all the same; the next bake says it
        header = ParticleCache(path_of(obj, modifier).parent).header()
        if header is not None:
            given = {"tear": header.tear * physics.tear, "grain": header.grain * physics.grain}
            return given | {"inside": _inside(physics)}
    return {}


def _inside(physics: bpy.types.PropertyGroup) -> Inside | None:
    """The material inside; None where nothing is to be closed."""
    if not physics.tear or physics.inside == "open":
        return None
    if physics.inside == "automatic":
        return Inside()
    red, green, blue = physics.inside_colour
    return Inside((red, green, blue), physics.inside_roughness, physics.inside_metallic)


def attach(obj: bpy.types.Object, path: Path, first: int) -> None:
    """Let the object play the file; a new modifier is the last of all, and stays where it is moved."""
    modifier = modifier_of(obj) or obj.modifiers.new(MODIFIER, "MESH_CACHE")
    point_caches.play(modifier, path, first)


def detach(obj: bpy.types.Object) -> None:
    """The object is itself again."""
    modifier = modifier_of(obj)
    if modifier is not None:
        obj.modifiers.remove(modifier)


@contextmanager
def hidden(obj: bpy.types.Object) -> Iterator[None]:
    """The object as it is before the modifier; what comes after that acts on the result and is off as well."""
    own = modifier_of(obj)
    stack = list(obj.modifiers)
    later = stack[stack.index(own) :] if own is not None else []
    shown = [(m.name, m.show_viewport) for m in later]
    try:
        for modifier in later:
            modifier.show_viewport = False
        yield
    finally:
        with suppress(ReferenceError):  # the object was removed meanwhile
            for name, value in shown:
                if name in obj.modifiers:
                    obj.modifiers[name].show_viewport = value
