"""Cameras that `drgs capture` found against true ones, after a similarity.

    .venv/bin/python bench/bench_capture.py CAPTURE TRUTH

CAPTURE is a folder of `drgs capture`; TRUTH the `truth.json` of `capture_scene.py`, or a transforms.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from drgs_blender.capture.world_alignment import similarity


def true_cameras(path: Path) -> dict[str, np.ndarray]:
    """Stem of the picture -> camera to world, Blender's axes."""
    data = json.loads(path.read_text())
    frames = data["frames"]
    rows = frames.items() if isinstance(frames, dict) else ((f["file_path"], f["transform_matrix"]) for f in frames)
    return {Path(name).stem: np.array(matrix) for name, matrix in rows}


def main() -> None:
    capture, truth = Path(sys.argv[1]), true_cameras(Path(sys.argv[2]))
    report = json.loads((capture / "capture.json").read_text())
    found = {Path(camera["file"]).stem: np.array(camera["matrix"]) for camera in report["cameras"]}
    names = sorted(found.keys() & truth.keys())
    ours, theirs = (np.stack([one[name] for name in names]) for one in (found, truth))
    scale, rotation, shift = similarity(ours[:, :3, 3], theirs[:, :3, 3])
    off = np.linalg.norm(scale * ours[:, :3, 3] @ rotation.T + shift - theirs[:, :3, 3], axis=1)
    size = np.linalg.norm(theirs[:, :3, 3] - theirs[:, :3, 3].mean(axis=0), axis=1).mean()
    cosine = (np.trace(np.swapaxes(rotation @ ours[:, :3, :3], 1, 2) @ theirs[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    tilt = np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1)))
    print(f"{len(found)} of {len(truth)} pictures, {report['method']}, reprojection error {report['error']:.2f} px")
    print(f"place: median {np.median(off) / size:.2%}, largest {off.max() / size:.2%} of the cameras' distance")
    print(f"direction: median {np.median(angle):.3f}, largest {angle.max():.3f} degrees")
    print(f"scale {scale:.4f} ({report['scale']}), ground {shift[2]:.4f} m off")
    print(f"up {tilt:.2f} degrees off ({report['up']})")
    true_focal = json.loads(Path(sys.argv[2]).read_text()).get("focal", "not known")
    print(f"focal length {report['cameras'][0]['focal']:.1f} px, true {true_focal}")


if __name__ == "__main__":
    main()
