"""What has broken of a body until each of its frames: judged where these have its particles, and never undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.errors import AssetError
from ..core.particle_cache import VERSION, Header, ParticleCache, ParticleFrame
from ..deform.bonds import Bonds, Broken


class Cracks:
    """What has broken of a body until the last of its frames that is known.

    It is a function of the frames as they are written, so it is the same however often a bake was interrupted.

    Parameters
    ----------
    header : Header
        Of its cache.
    rest : ParticleFrame
        The body at rest.
    """

    def __init__(self, header: Header, rest: ParticleFrame) -> None:
        self._bonds = Bonds(np.asarray(rest.points, np.float32), np.array(header.cells))
        self._gap = header.tear * abs(float(np.linalg.det(self._bonds.to_cells[:3, :3]))) ** (1 / 3)
        self._broken = self._bonds.none()

    def go_on(self, frame: ParticleFrame) -> None:
        """What has broken until `frame` is known from it."""
        assert frame.broken is not None
        self._broken = self._bonds.unpacked(frame.broken)

    def add(self, frame: ParticleFrame) -> ParticleFrame:
        """The next frame, with what has broken until then."""
        now = self._bonds.broken(self._bonds.placed(np.asarray(frame.points, np.float32)), self._gap)
        self._broken = Broken(*(before | after for before, after in zip(self._broken, now)))
        return replace(frame, broken=self._bonds.packed(self._broken))


def cracks_of(header: Header, rest: ParticleFrame) -> Cracks | None:
    """Of a body at rest; None where its matter cannot break."""
    return Cracks(header, rest) if header.breaks else None


def cracks_until(cache: ParticleCache, frame: int) -> Cracks | None:
    """Of a body that is baked until `frame`."""
    header = cache.header()
    cracks = None if header is None else cracks_of(header, cache.rest())
    if cracks is not None:
        cracks.go_on(cache.read(frame))
    return cracks


def renewed(cache: ParticleCache, found: Header, header: Header) -> Header | None:
    """The header of a cache, brought up to this version with its frames; None where one of these is damaged.

    Nothing is simulated, and it may be interrupted at any time.

    Parameters
    ----------
    cache : ParticleCache
    found, header : Header
        Its own, and that of the simulation to which it belongs.
    """
    if (found.version, found.cells) == (VERSION, header.cells):
        return found
    found = replace(found, cells=header.cells)
    if found.breaks:
        try:
            rest = _loaded(cache.rest())
            cracks = Cracks(found, rest)
            cache.write_rest(cracks.add(rest))
            for frame in cache.frames():
                cache.write(frame, cracks.add(_loaded(cache.read(frame))))
        except AssetError:
            return None
    found = replace(found, version=VERSION)
    cache.describe(found)
    return found


def _loaded(frame: ParticleFrame) -> ParticleFrame:
    """A frame that is not mapped from its file, which then can be replaced on any system."""
    return ParticleFrame(*(np.array(array) for array in (frame.points, frame.gradients, frame.vertices)))
