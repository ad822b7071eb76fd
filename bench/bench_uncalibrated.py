"""Photographs without cameras and masks against the same with true ones, judged under a light that was not there.

python bench/bench_uncalibrated.py --scene NAME --world SKY.hdr --relit OTHER.hdr [--object MESH.glb] [--pictures 36]
    [--size 560] [--samples 64]

Cycles photographs an object among others on a table (`capture_scene.py --clutter`), and the object alone under the
other sky. The photographs become an asset twice: with the true cameras and masks, and as `drgs capture --masks auto`
finds them. Rows are kept, so that scenes may be measured one by one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_capture import overlap, true_cameras
from PIL import Image
from report import OUT, ROOT, processor_seconds, store_row, table, write_section

from drgs_blender.capture.world_alignment import similarity
from drgs_blender.cli.evaluate import compared_passes, writer
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.core.frame import ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.flip import find_flip
from drgs_blender.evaluate.metrics import on_white, relight_scores, ssim, straight
from drgs_blender.evaluate.truth import read_relit

FOLDER = OUT / "uncalibrated"
COLUMNS = (
    "Scene", "Cameras and masks", "Pictures", "Masks: IoU", "Relit, foreground: raw / scaled", "Relit: SSIM / FLIP",
    "Processor s", "s",
)  # fmt: skip
Array = np.ndarray


@dataclass
class Made:
    """An asset, where its object stands in the world of the truth, and what it cost."""

    asset: Path
    placed: Array
    pictures: str
    masks: str
    spent: float
    wall: float


def run(*words: str | Path) -> tuple[float, float]:
    """Run a command of `drgs`; processor seconds and seconds that it took."""
    before, begun = processor_seconds(children=True), time.perf_counter()
    subprocess.run([sys.executable, "-m", "drgs_blender.cli.main", *map(str, words)], check=True, cwd=ROOT)
    return processor_seconds(children=True) - before, time.perf_counter() - begun


def photographed(folder: Path, options: argparse.Namespace) -> None:
    """Photographs, truth and pictures under the other sky; what is there already stays."""
    words = [folder, "--object", options.object, "--world", options.world, "--relit", options.relit, "--clutter",
             "--pictures", options.pictures, "--size", options.size, "--samples", options.spp, "--denoise"]  # fmt: skip
    command = find_blender().command(ROOT / "bench" / "capture_scene.py")
    subprocess.run([*command, *map(str, words)], check=True, cwd=ROOT)


def with_truth(folder: Path) -> Made:
    """From photographs whose true cameras and masks are known."""
    capture = folder / "true"
    capture.mkdir(exist_ok=True)
    truth = json.loads((folder / "truth.json").read_text())
    frames = []
    for name, matrix in truth["frames"].items():
        true_mask = folder / "truth" / f"{Path(name).stem}.png"
        with Image.open(folder / "images" / name) as picture, Image.open(true_mask) as mask:
            width, height = picture.size
            picture.putalpha(mask.getchannel("A"))
            picture.save(capture / f"{Path(name).stem}.png")
        frames.append({"file_path": f"{Path(name).stem}.png", "transform_matrix": matrix})
    lens = {"fl_x": truth["focal"], "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    data = lens | {"applied_transform": np.eye(4)[:3].tolist(), "frames": frames}
    (capture / "transforms.json").write_text(json.dumps(data))
    asset = folder / "true.drgs"
    spent, wall = run("reconstruct", capture, "--out", asset, "--up", "z")  # the world as it is
    return Made(asset, np.eye(4), f"{len(frames)} of {len(frames)}", "true", spent, wall)


def without(folder: Path) -> Made:
    """From the photographs alone."""
    capture, asset = folder / "made", folder / "made.drgs"
    first = run("capture", folder / "images", "--out", capture, "--masks", "auto")
    second = run("reconstruct", capture, "--out", asset)
    report, truth = json.loads((capture / "capture.json").read_text()), true_cameras(folder / "truth.json")
    found = {Path(camera["file"]).stem: np.array(camera["matrix"]) for camera in report["cameras"]}
    ours, theirs = (np.stack([one[name][:3, 3] for name in sorted(found)]) for one in (found, truth))
    scale, rotation, shift = similarity(ours, theirs)
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = scale * rotation, shift
    masks = [overlap(path, folder / "truth" / path.name) for path in sorted((capture / "masks").glob("*.png"))]
    known = f"{np.mean(masks):.3f}" if masks else "none"
    spent, wall = (a + b for a, b in zip(first, second, strict=True))
    return Made(asset, placed, f"{len(found)} of {len(truth)}", known, spent, wall)


def relit(made: Made, folder: Path, sky: Path, samples: int) -> list[str]:
    """Cells of an asset under the other sky: PSNR of the foreground in dB, SSIM and FLIP of the scaled pictures."""
    truth = read_relit(folder / "relit", sky, up="z")
    session = Session()
    key = session.load_asset(made.asset)
    state, settings = ObjectState(made.asset.stem, key, made.placed), RenderSettings(samples, bounces=3)
    pictures = [compared_passes(session, state, view.camera, World(truth.radiance), settings) for view in truth.views]
    linear, alpha = (np.stack(parts) for parts in zip(*map(straight, pictures)))
    masks = [view.mask for view in truth.views]
    assert all(mask is not None for mask in masks)
    mask = np.stack(masks)  # type: ignore[arg-type]
    true = np.stack([view.colour + 1 - a[..., None] for view, a in zip(truth.views, mask)]).clip(0, 1)
    scores = relight_scores(linear, alpha, true, mask)
    ours, flip = on_white(linear * np.array(scores["scale"]), alpha), find_flip()
    show = writer(folder)
    for k, (a, b) in enumerate(zip(ours, true)):
        show(f"relit-{made.asset.stem}", k, a, b)
    alike = np.mean([ssim(a, b) for a, b in zip(ours, true)])
    apart = "-" if flip is None else f"{np.mean([flip(a, b) for a, b in zip(ours, true)]):.4f}"
    raw, scaled = (scores[kind]["foreground"] for kind in ("raw", "scaled"))  # type: ignore[index]
    return [f"{raw:.2f} / {scaled:.2f}", f"{alike:.4f} / {apart}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True, help="name of the row")
    parser.add_argument("--world", type=Path, required=True)
    parser.add_argument("--relit", type=Path, required=True)
    parser.add_argument("--object", type=Path, default=ROOT / "examples" / "cat" / "egyptian_cat.glb")
    parser.add_argument("--pictures", type=int, default=36)
    parser.add_argument("--size", type=int, default=560)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args()
    folder = FOLDER / options.scene.replace(" ", "-")
    folder.mkdir(parents=True, exist_ok=True)
    photographed(folder, options)
    for label, make in (("true", with_truth), ("from the photographs alone", without)):
        made = make(folder)
        cells = [made.pictures, made.masks, *relit(made, folder, options.relit, options.samples)]
        rows = store_row(
            FOLDER / "rows.json", f"{options.scene}|{label}", [*cells, *(f"{x:.0f}" for x in (made.spent, made.wall))]
        )
        print(options.scene, label, *cells, flush=True)
    body = (
        "An object among boxes on a table of noise, photographed by Cycles under one sky, and relit under another, "
        f"where Cycles' pictures of it alone judge; {options.size} pixels across. Default settings of `drgs capture "
        "--masks auto` and `drgs reconstruct`. PSNR of the foreground in dB, scaled by one factor a channel; SSIM and "
        "FLIP of the scaled frames on white.\n\n"
    )
    write_section(
        "uncalibrated", "Without cameras and masks, relit",
        body + table(COLUMNS, [(*key.split("|"), *cells) for key, cells in rows.items()]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
