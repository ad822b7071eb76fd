"""What Blender's side of a frame costs: reading an evaluated object and handing it to the engine.

    python bench/bench_export.py [--side 1000] [--repeats 12]

An object of side^2 vertices, bent again in every frame by a shape key, with three painted attributes that all differ
from the asset's. Only Blender's evaluation and the engine's own work are left out of the figures.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from judge import blender_python
from report import ROOT, table, write_section

from drgs_blender.core.asset import Asset, Binding, Mesh, Surfels
from drgs_blender.core.asset.container import write_asset

SURFELS = 1000


def sheet(side: int) -> Asset:
    """A square of side x side vertices in the plane, with few surfels: they stay in the engine."""
    y, x = np.mgrid[0:side, 0:side]
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32) / (side - 1) - (0.5, 0.5, 0)
    low = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([low[:, None] + (0, 1, side + 1), low[:, None] + (0, side + 1, side)]).astype(np.int32)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
    face = np.linspace(0, len(faces) - 1, SURFELS).astype(np.int64)
    centres = vertices[faces[face]].mean(axis=1)
    turn = np.tile((1.0, 0.0, 0.0, 0.0), (SURFELS, 1))
    surfels = Surfels(
        centres, np.full((SURFELS, 2), 0.01), turn, np.full(SURFELS, 0.9), np.full((SURFELS, 3), 0.5),
        np.full(SURFELS, 0.5), np.zeros(SURFELS),
    )  # fmt: skip
    binding = Binding(face, np.full((SURFELS, 3), 1 / 3), np.zeros(SURFELS), np.tile((0, 0, 1), (SURFELS, 1)))
    return Asset(surfels, mesh, binding)


def measure(side: int, repeats: int) -> dict:
    """Run `export_job.py` in Blender's Python."""
    with tempfile.TemporaryDirectory(prefix="drgs-export-") as folder:
        extensions = Path(folder, "extensions", "user_default")
        extensions.mkdir(parents=True)
        (extensions / "drgs").symlink_to(ROOT, target_is_directory=True)
        asset = Path(folder, "sheet.drgs")
        write_asset(asset, sheet(side))
        job = Path(folder, "job.json")
        job.write_text(json.dumps({"asset": str(asset), "repeats": repeats}))
        environment = os.environ | {"BLENDER_USER_RESOURCES": folder}
        environment.setdefault("DRGS_ENGINE", sys.executable)
        command = [str(blender_python()), "-P", str(Path(__file__).with_name("export_job.py")), str(job)]
        subprocess.run(command, check=True, timeout=900, env=environment)
        return json.loads(job.with_suffix(".result").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=1000, help="vertices along an edge of the object")
    parser.add_argument("--repeats", type=int, default=12, help="frames of each kind")
    parser.add_argument("--dry", action="store_true", help="print, and leave docs/benchmarks.md as it is")
    args = parser.parse_args()
    found = measure(args.side, args.repeats)
    names = {
        "export": "reading the evaluated object",
        "transfer": "comparing, sending, the answer's way back",
        "both": "**both: beyond Blender's evaluation and the engine's work**",
        "evaluation": "(Blender's evaluation of the frame)",
    }
    rows = []
    for key, text in names.items():
        final, seen = (1000 * np.array(found[kind][key]) for kind in ("final", "viewport"))
        rows.append([text, *(float(v) for v in (np.median(final), final.max(), np.median(seen), seen.max()))])
    body = (
        f"Blender {found['blender']}, an object of {args.side**2:,} vertices and {2 * (args.side - 1) ** 2:,} "
        "triangles, bent again in every frame, with albedo, roughness and metallic painted. A final frame reads "
        f"everything again; a viewport remembers what did not change. {args.repeats} frames each.\n\n"
        + table(["milliseconds", "final frame, median", "worst", "viewport, median", "worst"], rows)
    )
    if args.dry:
        print(body)
    else:
        write_section("export", "From Blender to the engine", body)


if __name__ == "__main__":
    main()
