"""What further terms of the materials' stage bring: the same surfels and mesh, one change a row.

python bench/bench_material_terms.py --capture scenes/cat [--size 256] [--steps 1000] [--rows NAME ...]

Scenes are those of `drgs evaluate --make-scenes scenes`. Surfels are those of bench_normals.py, learned once and kept;
rows are kept, too, so that captures and terms may be measured one by one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_evaluate import score
from bench_normals import FIGURES, FOLDER, figures, learned, same_surfels
from report import processor_seconds, store_row, table, write_section

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import BASE_CHANNELS, Mesh
from drgs_blender.evaluate.truth import Truth, read_truth
from drgs_blender.reconstruct import pipeline
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.inverse_rendering.radiance_cache import edges_of
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.settings import Settings

#: The light of relit pictures.
LIGHT = "city"
#: The row that others are held against.
PLAIN = "none of them"
#: Row -> settings of decoupling that differ.
ROWS: dict[str, dict[str, Any]] = {
    PLAIN: {"same_material": 0.0},
    "like vertices held alike, .003": {"same_material": 0.003},
    "like vertices held alike, .01": {"same_material": 0.01},
}
#: The row with four times the faces, about four vertices a pixel.
CUT = "faces cut in four"


def cut_in_four(mesh: Mesh) -> Mesh:
    """The same surface with the faces cut at the middles of their edges."""
    edges, faces = edges_of(mesh.faces), mesh.faces.astype(np.int64)
    codes = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), axis=-1)
    middle = len(mesh.vertices) + np.searchsorted(codes, pairs[..., 0] * len(mesh.vertices) + pairs[..., 1])
    corner = [np.stack([faces[:, k], middle[:, k], middle[:, k - 1]], -1) for k in range(3)]

    def with_middles(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[edges].mean(axis=1).astype(values.dtype)])

    channels = {name: with_middles(getattr(mesh, name)) for name in ("vertices", *BASE_CHANNELS)}
    return replace(mesh, faces=np.concatenate([*corner, middle]).astype(mesh.faces.dtype), **channels)


def measured(capture: Capture, folder: Path, truth: Truth, settings: Settings, key: str) -> list[str]:
    """Figures of the finished asset, without those of normals."""
    begun = processor_seconds()
    asset = pipeline.reconstruct(capture, settings)
    spent = processor_seconds() - begun
    path = FOLDER / f"terms-{key}.drgs"
    write_asset(path, asset)
    return figures(score(path, folder, "surfels", 32, truth), spent)[1:]


@contextmanager
def meshes_cut_in_four() -> Iterator[None]:
    """Let `pipeline.reconstruct` cut each face of its meshes in four."""
    known = pipeline.mesh_of

    def cut(*given: Any, **named: Any) -> Any:
        mesh, report = known(*given, **named)
        return cut_in_four(mesh), report

    pipeline.mesh_of = cut
    try:
        yield
    finally:
        pipeline.mesh_of = known


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1000, help="of materials and light")
    parser.add_argument("--rows", nargs="+", choices=[*ROWS, CUT], default=[*ROWS, CUT])
    options = parser.parse_args()
    torch.set_num_threads(1)
    capture, key = read_capture(options.capture, options.size), f"{options.capture.name}-{options.size}"
    truth = read_truth(options.capture)
    assert truth is not None
    known = (LIGHT, truth.training_light)
    truth = replace(truth, sets=[item for item in truth.sets if not item.posed and item.light in known])
    base = Settings()
    base = replace(base, decoupling=replace(base.decoupling, iterations=options.steps))
    rows: dict[str, Any] = {}
    gaussians = learned(capture, f"{options.capture.name}-256")
    for label in options.rows:
        settings = replace(base, decoupling=replace(base.decoupling, joint=0.0, **ROWS.get(label, ROWS[PLAIN])))
        with same_surfels(gaussians), meshes_cut_in_four() if label == CUT else nullcontext():
            cells = measured(capture, options.capture, truth, settings, key)
        print(key, label, *cells, flush=True)
        rows = store_row(FOLDER / "terms.json", f"{key}|{label}", cells)
    body = (
        f"The same surfels, of photographs of 256 pixels, {options.steps} steps of materials and light, one change a "
        "row; camera sees surfels. PSNR of the "
        f"foreground in dB, relit under {LIGHT!r} scaled by one factor a channel.\n\n"
    )
    lines = [(*name.split("|"), *cells) for name, cells in sorted(rows.items())]
    write_section(
        "material-terms",
        "Further terms of the materials' stage",
        body + table(("Object-pixels", "", *FIGURES[1:]), lines),
    )


if __name__ == "__main__":
    main()
