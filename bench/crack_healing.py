"""What of broken matter heals from frame to frame, where each is judged alone and where caches keep what has broken."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from drgs_blender.core.asset import Mesh
from drgs_blender.core.particle_cache import ParticleCache, ParticleFrame
from drgs_blender.deform.closed_matter import Breakable
from drgs_blender.simulation.cracks import Cracks
from drgs_blender.simulation.job import Job

Array = np.ndarray

#: Frames whose computation is timed.
_TIMED = 4


class Healed(NamedTuple):
    """Sums over the frames of a motion of what was broken in the frame before, and is not any more.

    Attributes
    ----------
    bonds, faces : int
        Bonds of particles; faces of the mesh that are cut.
    walls : float
        Area of faces inside at rest, in parts of the most that are there at once.
    at : int
        Frame in which most bonds heal.
    places : (k, 3) float32 array
        Particles then of those bonds.
    """

    bonds: int
    faces: int
    walls: float
    at: int
    places: Array


def healed(mesh: Mesh, cache: ParticleCache, kept: bool) -> Healed:
    """What heals of a mesh: as caches keep it, or each frame judged alone."""
    header, rest = cache.header(), cache.rest()
    assert header is not None
    matter = Breakable(mesh.vertices, mesh.faces, rest.points, np.array(header.cells))
    bonds, before = matter.bonds, None
    gap = header.tear * abs(float(np.linalg.det(bonds.to_cells[:3, :3]))) ** (1 / 3)
    count, faces, walls, most, by_frame = 0, 0, 0, 1, {}
    for frame in cache.frames():
        particles, vertices = cache.driving(frame, rest)
        bits = particles.broken
        if not kept or bits is None:
            bits = bonds.packed(bonds.broken(bonds.placed(particles.points), gap))
        broken = bonds.unpacked(bits)
        zone = bonds.zone(broken)
        opened = (3 * zone.keys[:, None] + np.arange(3))[zone.open]
        closed = matter.closed(vertices, particles.points, particles.gradients, header.tear, bits=bits)
        cut = np.zeros(len(mesh.faces), bool) if closed is None else closed.cut
        if before is not None:
            lost = before[0] & ~broken.up
            by_frame[frame] = int(lost.sum()), particles.points[lost.any(axis=1)]
            count, faces = count + by_frame[frame][0], faces + int((before[1] & ~cut).sum())
            walls += len(np.setdiff1d(before[2], opened))
        before, most = (broken.up, cut, opened), max(most, len(opened))
    at = max(by_frame, key=lambda frame: by_frame[frame][0])
    return Healed(count, faces, walls / most, at, by_frame[at][1])


def cost(job: Job, cache: ParticleCache) -> tuple[float, float]:
    """What keeping it costs: share of a frame's bytes, and of the time in which a frame is computed."""
    header, frame = cache.header(), cache.read(cache.frames()[-1])
    assert header is not None and frame.broken is not None
    arrays = frame.points, frame.gradients, frame.vertices, frame.broken
    cracks = Cracks(header, cache.rest())
    seconds = np.zeros(2)
    for _ in range(_TIMED):
        started = time.perf_counter()
        job.solver.advance(1 / header.fps, job.pin_targets(job.solver.frame + 1))
        now: ParticleFrame = job.now()
        middle = time.perf_counter()
        cracks.add(now)
        seconds += middle - started, time.perf_counter() - middle
    return len(frame.broken) / sum(array.nbytes for array in arrays), float(seconds[1] / seconds.sum())


def and_back(motion: Array) -> Array:
    """A motion in half the frames, then backwards."""
    there = motion[::2]
    return np.concatenate([there, there[::-1]])[: len(motion)]
