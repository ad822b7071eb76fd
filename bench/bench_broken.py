"""Matter that breaks and flows: closed pieces, the backs of faces that rays see, surfaces of particles; and pictures.

python bench/bench_broken.py --asset out/bench/assets/spot.drgs [--size 300]

The capture is torn in two by its ends as jelly and as snow, of which one is pushed together again, and falls into a box
as water.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from bench_matter_pictures import picture
from bench_thin import save
from crack_healing import and_back, cost, healed
from judge import frame_camera
from ours import SESSION
from report import OUT, add_publish, picture_path, table, write_section

from drgs_blender.core.asset import Mesh
from drgs_blender.core.frame import Inside, ObjectState
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.closed_matter import Breakable, ClosedMatter
from drgs_blender.geometry.particle_surface import particle_surface
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.job import Job, prepare
from drgs_blender.simulation.settings import parse_settings

Array = np.ndarray

FIGURE, HEALING = "broken.png", "cracks.webp"
FOLDER = OUT / "broken"
LAST, AZIMUTH = 24, -40
#: Views from which rays are cast, and rays of each along a side of the picture.
VIEWS, RAYS = 12, 96
#: Frames that are shown around that in which most heals, and how much around that, in parts of the object's size.
BEFORE, AFTER, AROUND = 2, 4, 0.12
#: Particles of the pools whose surface is timed, along each side.
POOL = (50, 50, 40)


def baked(name: str, mesh: Mesh, settings: dict[str, Any]) -> ParticleCache:
    """Frames of a simulation; those that are there are kept."""
    cache = ParticleCache(FOLDER / name)
    bake(job_of(name, mesh, settings), cache)
    return cache


def job_of(name: str, mesh: Mesh, settings: dict[str, Any]) -> Job:
    return prepare(mesh, parse_settings({"last": LAST} | settings), name)


def pulled(name: str, mesh: Mesh, material: dict[str, Any], resolution: int, back: bool = False) -> dict[str, Any]:
    """Settings by which the longest side of a mesh is pulled apart by its ends, by half its length, and `back`."""
    low, high = mesh.vertices.min(axis=0).astype(float), mesh.vertices.max(axis=0).astype(float)
    size, axis = high - low, int(np.argmax(high - low))
    side = np.where(mesh.vertices[:, axis] > (low + high)[axis] / 2, 1.0, -1.0)
    motion = np.repeat(mesh.vertices[None].astype(np.float64), LAST, axis=0)
    for frame in range(LAST):
        motion[frame, :, axis] += side * 0.25 * frame / (LAST - 1) * size[axis]
        motion[frame, :, (axis + 1) % 3] += side * 0.0375 * frame / (LAST - 1) * size[axis]
    FOLDER.mkdir(parents=True, exist_ok=True)
    np.save(FOLDER / f"{name}.npy", and_back(motion) if back else motion)
    ends = [[(low - 0.01 * size).tolist(), (high + 0.01 * size).tolist()] for _ in range(2)]
    ends[0][1][axis], ends[1][0][axis] = (float(low[axis] + part * size[axis]) for part in (0.36, 0.64))
    pins = [{"box": box} for box in ends]
    given = {"material": material, "resolution": resolution, "pins": pins, "gravity": [0, 0, -4.0]}
    return given | {"motion": str(FOLDER / f"{name}.npy")}


def poured(name: str, mesh: Mesh) -> ParticleCache:
    """A mesh of water that falls into a box."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = float((high - low).max())
    walls = [(low - size * np.array([0.35, 0.35, 0.25])).tolist(), (high + size * np.array([0.35, 0.35, 2])).tolist()]
    return baked(name, mesh, {"material": {"name": "water"}, "resolution": 24, "domain": walls, "walls": "slip"})


def shown(state: ObjectState, cache: ParticleCache, frame: int, inside: Inside | None) -> ObjectState:
    """An object as a frame of a cache has it; what is fluid by the surface of its particles."""
    header = cache.header()
    assert header is not None
    particles, vertices = cache.driving(frame)
    particles = replace(particles, cells=np.array(header.cells), skin=header.is_fluid, surfels=header.keeps_shape)
    return replace(state, vertices=vertices, particles=particles, tear=header.tear, grain=header.grain, inside=inside)


def backs_seen() -> float:
    """Share of the rays that meet the last frame's object, from all around it, that meet the back of a face."""
    scene = SESSION._scene_cache.scene
    own = scene.face_object == 0
    shape = trimesh.Trimesh(scene.vertices, scene.faces[own], process=False)
    shape.update_faces(shape.area_faces > 0)
    middle, radius = shape.bounds.mean(axis=0), float(np.linalg.norm(np.ptp(shape.bounds, axis=0)))
    met = backs = 0
    for view in range(VIEWS):
        angle, height = 2 * np.pi * view / VIEWS, 0.5 * np.sin(2.4 * view)
        way = np.array([np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)])
        right = np.cross(way, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        u, v = np.meshgrid(*[np.linspace(-0.5, 0.5, RAYS)] * 2)
        starts = (
            middle + 2 * radius * way + radius * (u.reshape(-1, 1) * right + v.reshape(-1, 1) * np.cross(right, way))
        )
        first = shape.ray.intersects_first(starts, np.tile(-way, (len(starts), 1)))
        normals = shape.face_normals[first[first >= 0]]
        met += len(normals)
        backs += int((normals @ way < 0).sum())
    return backs / met


def volume(places: Array, faces: Array) -> float:
    a, b, c = places[faces].astype(np.float64).transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def closed_volume(mesh: Mesh, closed: ClosedMatter) -> float:
    """Volume of all pieces."""
    places, first = np.concatenate([closed.vertices, closed.points]), len(closed.vertices)
    return volume(places, np.concatenate([mesh.faces[~closed.cut], closed.rim + first, closed.walls + first]))


def rigidly(mesh: Mesh, cache: ParticleCache) -> tuple[float, float]:
    """Parted along a wave without being deformed: error of the volume, and seconds that closing takes."""
    header = cache.header()
    assert header is not None
    rest = cache.rest().points
    matter = Breakable(mesh.vertices, mesh.faces, rest, np.array(header.cells))
    size = np.ptp(mesh.vertices, axis=0).max()

    def moved(places: Array) -> Array:
        beyond = places[:, 1] + 0.3 * places[:, 2] + 0.05 * size * np.sin(9 * places[:, 0] / size) > 0
        return places + beyond[:, None] * np.array([0, 2 * size, 0])

    given = moved(mesh.vertices), moved(rest), np.tile(np.eye(3), (len(rest), 1, 1)), header.tear
    closed = matter.closed(*given)
    started = time.perf_counter()
    closed = matter.closed(*given)
    seconds = time.perf_counter() - started
    assert closed is not None
    return closed_volume(mesh, closed) / volume(mesh.vertices, mesh.faces) - 1, seconds


def pool() -> list[object]:
    """Of particles at rest in a box: error of the surface's volume, unevenness of its top, seconds for 100,000."""
    cells = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in POOL], indexing="ij"), -1).reshape(-1, 3)
    cells += np.random.default_rng(0).uniform(-0.3, 0.3, cells.shape)
    particle_surface(cells[:1000], 1.0)
    started = time.perf_counter()
    surface = particle_surface(cells, 1.0)
    seconds = time.perf_counter() - started
    places = surface.vertices
    top = places[(places[:, 2] > POOL[2] / 2) & (np.abs(places[:, :2] - np.array(POOL[:2]) / 2).max(axis=1) < 15), 2]
    off = top - POOL[2]
    return [
        f"{100 * (volume(places, surface.faces) / len(cells) - 1):+.2f} %", f"{off.mean() / 2:+.3f}",
        f"{np.abs(off - off.mean()).max() / 2:.3f}", 1e5 * seconds / len(cells),
    ]  # fmt: skip


def healing(state: ObjectState, mesh: Mesh, motions: dict[str, dict[str, Any]], args: argparse.Namespace) -> str:
    """A table of what heals in bakes by settings, and pictures of the first around where most does."""
    rows, pictures = [], []
    for title, given in motions.items():
        name = f"{state.name}-{title}"
        cache = baked(name, mesh, given)
        alone, kept = healed(mesh, cache, False), healed(mesh, cache, True)
        found = np.unpackbits(cache.read(LAST).broken).sum()
        share = cost(job_of(name, mesh, given), cache)
        told = [[of.bonds, of.faces, f"{100 * of.walls:.1f} %"] for of in (alone, kept)]
        rows.append([title, int(found), *told[0], ", ".join(map(str, told[1])), *(f"{100 * s:.2f} %" for s in share)])
        if pictures:
            continue
        frames = range(alone.at - BEFORE, min(alone.at + AFTER, LAST + 1))
        near = AROUND * np.ptp(mesh.vertices, axis=0).max()
        places = np.concatenate([alone.places - near, alone.places + near])
        camera = frame_camera(places, args.size, azimuth=AZIMUTH, fill=0.9)
        floor = min(float(cache.read(frame).vertices[:, 2].min()) for frame in cache.frames()) - 0.02
        for known in (False, True):
            row = []
            for frame in frames:
                now = shown(state, cache, frame, Inside())
                if not known and now.particles is not None:
                    now = replace(now, particles=replace(now.particles, broken=None))
                row.append(picture(now, floor, camera, args.samples))
            pictures.append(np.concatenate(row, axis=1))
    save(picture_path(HEALING, args), [np.concatenate(pictures, axis=0)])
    columns = [
        "matter", "bonds broken", "bonds heal", "cut faces heal", "walls heal", "these, kept", "of the bytes",
        "of the time",
    ]  # fmt: skip
    return table(columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--asset", type=Path, required=True)
    parser.add_argument("--size", type=int, default=300)
    parser.add_argument("--samples", type=int, default=64)
    add_publish(parser)
    args = parser.parse_args()
    key = SESSION.load_asset(args.asset)
    mesh = SESSION.asset(key).mesh
    state = ObjectState(args.asset.stem, key)
    pictures, rows = [], []
    motions: dict[str, dict[str, Any]] = {}
    frames = {"jelly": (18, {"name": "jelly"}, 36), "snow": (16, {"name": "snow"}, 20)}
    for name, (frame, material, resolution) in frames.items():
        motions[name] = pulled(f"{args.asset.stem}-{name}", mesh, material, resolution)
        cache = baked(f"{args.asset.stem}-{name}", mesh, motions[name])
        floor = float(cache.read(frame).vertices[:, 2].min()) - 0.02
        camera = frame_camera(cache.read(frame).vertices, args.size, azimuth=AZIMUTH, fill=0.82)
        seen = []
        for inside in (None, Inside()):
            made = picture(shown(state, cache, frame, inside), floor, camera, args.samples)
            seen.append(f"{100 * backs_seen():.3f} %")
            if name == "jelly" or inside is not None:
                pictures.append(made)
        error, seconds = rigidly(mesh, cache)
        count = len(cache.rest().points)
        rows.append([name, count, len(mesh.faces), *seen, f"{100 * error:+.4f} %", seconds])
    cache = poured(f"{args.asset.stem}-water", mesh)
    for frame in (11, LAST):
        low = cache.read(frame).vertices[:, 2].min()
        every = np.concatenate([cache.read(f).points for f in (1, LAST)])
        camera = frame_camera(every, args.size, azimuth=AZIMUTH, fill=0.82)
        pictures.append(picture(shown(state, cache, frame, None), float(low) - 0.02, camera, args.samples))
    save(picture_path(FIGURE, args), pictures)
    again = "snow, pushed together"
    motions[again] = pulled(f"{args.asset.stem}-{again}", mesh, frames["snow"][1], frames["snow"][2], back=True)
    mended = healing(state, mesh, motions, args)
    columns = [
        "matter",
        "particles",
        "faces",
        "backs seen, hollow",
        "backs seen, closed",
        "volume, parted",
        "s to close",
    ]
    body = (
        f"{args.asset.stem} is pulled apart by its ends. *Backs seen*: of the "
        "rays from all around that meet it, those that meet a face from behind. *Volume*: of all pieces against the "
        "whole mesh, where they are parted without being deformed. *Seconds* are of one frame.\n\n"
        f"{table(columns, rows)}\n\nThe surface of {int(np.prod(POOL)):,} particles that fill a box in disorder; cells "
        "are those of the simulation's grid.\n\n"
        + table(["volume", "top, cells too high", "unevenness, cells", "s for 100,000 particles"], [pool()])
        + "\n\n![Hollow and closed pieces, snow, and water](images/broken.png)\n\n"
        f"What heals from one frame to the next, summed over {LAST} frames, where each frame is judged by itself: "
        "bonds, faces of the mesh that were cut, and faces inside (of the most that there are at once). *These, kept*: "
        "the same by what caches keep, and what that costs: of a frame's bytes, and of the time that computes it. Cut "
        "faces are also others where a crack grows, whose line is smoothed."
        f"\n\n{mended}\n\n![Frames in a row, judged each by itself, and as they are kept](images/cracks.webp)"
    )
    write_section("broken", "Broken and flowing matter", body)


if __name__ == "__main__":
    main()
