"""Floaters: precision and recall on captures with planted ones; and how long the edits of large captures take.

python bench/bench_clean.py CAPTURE.ply [CAPTURE.spz ...] [--surfels 1000000]

Planted are surfels of the capture itself, elsewhere: alone in the space around it, in small clumps, and wide faint
ones as haze; at least six medians of the larger deviation from the nearest surfel of the capture. What is found in the
capture as it is counts as wrong, though some of it may be in the air.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from judge import blender_python
from report import ROOT, table, write_section
from scipy.spatial import cKDTree

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Surfels
from drgs_blender.core.asset.part import part_of, part_of_faces, taken
from drgs_blender.core.floaters import find_floaters
from drgs_blender.deform.attach import attach
from drgs_blender.formats.registry import read_surfels

Array = np.ndarray
#: Medians of the larger deviation between what is planted and the capture.
APART = 6.0
CLUMPS = 12


def planted(own: Surfels, seed: int) -> tuple[Surfels, Array]:
    """The capture with floaters, and which they are."""
    random, n = np.random.default_rng(seed), len(own)
    low, high = np.quantile(own.centre, [0.01, 0.99], axis=0)
    size, middle, count = float((high - low).max()), (low + high) / 2, max(200, n // 50)
    typical = float(np.median(own.scale.max(axis=1)))
    alone = middle + (random.random((count, 3)) - 0.5) * 1.6 * size
    seeds = middle + (random.random((CLUMPS, 3)) - 0.5) * 1.6 * size
    clumps = seeds[random.integers(0, CLUMPS, count)] + random.normal(0, 3 * typical, (count, 3))
    haze = middle + (random.random((count // 4, 3)) - 0.5) * 1.2 * size
    places = np.concatenate([alone, clumps, haze])
    wide = np.concatenate([np.ones(2 * count), np.full(count // 4, 10.0)])
    opacity = np.concatenate([random.uniform(0.1, 0.95, 2 * count), random.uniform(0.02, 0.15, count // 4)])
    kept = cKDTree(own.centre).query(places)[0] > APART * typical
    rows = random.integers(0, n, len(places))[kept]
    made = taken(own, np.concatenate([np.arange(n), rows]))
    made.centre[n:], made.opacity[n:] = places[kept], opacity[kept]
    made.scale[n:] *= wide[kept, None]
    return made, np.arange(len(made)) >= n


def accuracy(path: Path) -> tuple[object, ...]:
    """A row: capture, surfels, planted, precision, recall, found in the capture as it is, seconds."""
    own = replace(read_surfels(path).surfels, sh=None, extras={})
    found, true = [], []
    before = int(find_floaters(own).sum())
    for seed in (1, 2, 3):
        surfels, litter = planted(own, seed)
        begun = time.perf_counter()
        found.append(find_floaters(surfels))
        spent = time.perf_counter() - begun
        true.append(litter)
    hit, said = np.concatenate(found) & np.concatenate(true), np.concatenate(found)
    planted_count = int(np.concatenate(true).sum()) // 3
    precision, recall = hit.sum() / max(said.sum(), 1), hit.sum() / np.concatenate(true).sum()
    return path.name, f"{len(own):,}", f"{planted_count:,}", f"{precision:.3f}", f"{recall:.3f}", before, float(spent)


def large(count: int, folder: Path) -> Path:
    """A ball of about `count` surfels on 320,000 triangles."""
    import trimesh

    from drgs_blender.core.asset.model import Mesh

    ball = trimesh.creation.icosphere(7)
    n = len(ball.vertices)
    mesh = Mesh(ball.vertices, ball.faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
    surfels, binding, _ = attach(mesh, density=100.0)
    times = -(-count // len(surfels))
    rows = np.repeat(np.arange(len(surfels)), times)[:count]
    surfels = taken(surfels, rows)
    names = ("face", "barycentric", "offset", "normal")
    binding = replace(binding, **{name: getattr(binding, name)[rows] for name in names})
    write_asset(path := folder / "ball.drgs", Asset(surfels, mesh, binding))
    begun = time.perf_counter()
    part_of(Asset(surfels, mesh, binding), part_of_faces(mesh, mesh.vertices[mesh.faces][..., 2].min(axis=1) > 0))
    print(f"engine cuts half of it in {time.perf_counter() - begun:.2f} s")
    return path


def timed(count: int) -> dict[str, float]:
    """Seconds of edits in Blender, without a window."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        job = {"asset": str(large(count, folder)), "out": str(folder / "times.json"), "checkout": str(ROOT)}
        (folder / "job.json").write_text(json.dumps(job))
        words = [str(blender_python()), str(ROOT / "bench" / "clean_job.py"), str(folder / "job.json")]
        subprocess.run(
            words, check=True, env=os.environ | {"BLENDER_USER_RESOURCES": str(folder / "user")}, timeout=900
        )
        return json.loads((folder / "times.json").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--surfels", type=int, default=1_000_000)
    options = parser.parse_args()
    rows = [accuracy(path) for path in options.captures]
    columns = ("Capture", "Surfels", "Planted", "Precision", "Recall", "Found in the capture as it is", "s")
    times = timed(options.surfels)
    body = (
        "Floaters planted in captures, three times each: alone, in clumps and as wide faint haze, six medians of their "
        "size or more from the nearest surfel; strength 1, without a mesh. What is found in the capture as it is "
        "counts as wrong.\n\n"
        + table(columns, rows)
        + f"\n\nEdits of {options.surfels:,} surfels on 327,680 triangles in Blender, without a window: seconds.\n\n"
        + table(("Edit", "s"), list(times.items()))
    )
    write_section("clean", "Cleaning captures", body)


if __name__ == "__main__":
    main()
