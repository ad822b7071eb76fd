"""Cameras and masks that `drgs capture` made against true ones.

    .venv/bin/python bench/bench_capture.py CAPTURE TRUTH.json [--masks FOLDER] [--turned] [--scene NAME]

CAPTURE is a folder of `drgs capture`; TRUTH.json the `truth.json` of `capture_scene.py`, or a transforms.json, whose
cameras are compared after a similarity. FOLDER has the true masks, named as the pictures, `.png`. With a NAME the
figures become a row of docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image
from report import OUT, store_row, table, write_section

from drgs_blender.capture.world_alignment import similarity

COLUMNS = [
    "Scene", "Pictures", "Place, median / largest", "Direction, median / largest", "Up", "Masks", "IoU, mean",
    "IoU, lowest",
]  # fmt: skip


def true_cameras(path: Path) -> dict[str, np.ndarray]:
    """Stem of the picture -> camera to world, Blender's axes."""
    data = json.loads(path.read_text())
    frames = data["frames"]
    rows = frames.items() if isinstance(frames, dict) else ((f["file_path"], f["transform_matrix"]) for f in frames)
    return {Path(name).stem: np.array(matrix) for name, matrix in rows}


def camera_figures(report: dict, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Errors of cameras: places in parts of the cameras' distance, angles in degrees, the ground in metres."""
    found = {Path(camera["file"]).stem: np.array(camera["matrix"]) for camera in report["cameras"]}
    names = sorted(found.keys() & truth.keys())
    ours, theirs = (np.stack([one[name] for name in names]) for one in (found, truth))
    scale, rotation, shift = similarity(ours[:, :3, 3], theirs[:, :3, 3])
    off = np.linalg.norm(scale * ours[:, :3, 3] @ rotation.T + shift - theirs[:, :3, 3], axis=1)
    size = np.linalg.norm(theirs[:, :3, 3] - theirs[:, :3, 3].mean(axis=0), axis=1).mean()
    cosine = (np.trace(np.swapaxes(rotation @ ours[:, :3, :3], 1, 2) @ theirs[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return {
        "place": float(np.median(off) / size),
        "largest place": float(off.max() / size),
        "direction": float(np.median(angle)),
        "largest direction": float(angle.max()),
        "scale": scale,
        "ground": float(shift[2]),
        "up": float(np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1)))),
    }


def overlap(made: Path, true: Path) -> float:
    """Intersection over union of two masks; of a true one with alpha, this is the mask."""
    with Image.open(made) as image:
        ours = np.asarray(image.convert("L")) > 127
    with Image.open(true) as image:
        coverage = image.getchannel("A") if "A" in image.getbands() else image.convert("L")
        theirs = np.asarray(coverage.resize(ours.shape[::-1], Image.Resampling.BOX)) > 127
    return float((ours & theirs).sum() / max((ours | theirs).sum(), 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--masks", type=Path, help="folder of true masks")
    parser.add_argument("--turned", action="store_true", help="up is not Z in the truth's world")
    parser.add_argument("--scene", help="name of the row in docs/benchmarks.md")
    args = parser.parse_args()
    report, truth = json.loads((args.capture / "capture.json").read_text()), true_cameras(args.truth)
    row = camera_figures(report, truth)
    count, of = len(report["cameras"]), len(report["cameras"]) + len(report["left_out"])
    print(f"{count} of {of} pictures, {report['method']}, reprojection error {report['error']:.2f} px")
    print(f"place: median {row['place']:.2%}, largest {row['largest place']:.2%} of the cameras' distance")
    print(f"direction: median {row['direction']:.3f}, largest {row['largest direction']:.3f} degrees")
    print(f"scale {row['scale']:.4f} ({report['scale']}), ground {row['ground']:.4f} m off")
    print(f"up {row['up']:.2f} degrees off ({report['up']})")
    true_focal = json.loads(args.truth.read_text()).get("focal", "not known")
    print(f"focal length {report['cameras'][0]['focal']:.1f} px, true {true_focal}")
    made = {path.stem: path for path in sorted((args.capture / "masks").glob("*.png"))}
    figures = ["given" if "masks" in report else "none", "", ""]
    if args.masks:
        scores = {stem: overlap(path, args.masks / f"{stem}.png") for stem, path in made.items()}
        if scores:
            lowest = min(scores, key=lambda stem: scores[stem])
            mean = float(np.mean(list(scores.values())))
            print(f"masks: IoU mean {mean:.3f}, lowest {scores[lowest]:.3f} ({lowest}), of {len(scores)}")
            figures = [str(len(scores)), f"{mean:.3f}", f"{scores[lowest]:.3f}"]
        else:
            print("masks: none")
    if args.scene:
        cells = [
            f"{count} of {of}", f"{row['place']:.2%} / {row['largest place']:.2%}",
            f"{row['direction']:.3f}° / {row['largest direction']:.2f}°",
            "guessed" if "up" in report["guessed"] else "not known" if args.turned else f"{row['up']:.2f}°", *figures,
        ]  # fmt: skip
        rows = store_row(OUT / "capture.json", args.scene, cells)
        write_section(
            "capture", "Photographs without cameras",
            "Scenes on tables of noise are those of `bench/capture_scene.py`, rendered by Cycles; on a turntable the "
            "object turns before one camera, table and sky stand still, and nothing is given. Cameras after a "
            "similarity, places in parts of their distance from their centre. A number of masks: made of the "
            "photographs alone (`--masks auto`); IoU is the intersection over union with the object's true coverage. "
            "The true cameras of the real head are COLMAP's as its photographers published them.\n\n"
            + table(COLUMNS, [[name, *cells] for name, cells in rows.items()]),
        )  # fmt: skip


if __name__ == "__main__":
    main()
