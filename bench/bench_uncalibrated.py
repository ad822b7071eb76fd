"""Photographs without cameras and masks against the same with true ones, judged under a light that was not there.

python bench/bench_uncalibrated.py --scene NAME --world SKY.hdr --relit OTHER.hdr [--object MESH.glb] [--pictures 36]
    [--size 560] [--samples 64] [--steps 1000 800] [--only "true cameras, found masks"]

Cycles photographs an object among others on a table (`capture_scene.py --clutter`), and the object alone under the
other sky. The photographs become an asset with the true cameras and masks, with those that `drgs capture --masks auto`
finds, and with either of each. Rows are kept, so that scenes may be measured one by one.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench_capture import overlap, true_cameras
from bench_evaluate import similarity as ssim_and_flip
from PIL import Image
from report import OUT, ROOT, processor_seconds, store_row, table, write_section

from drgs_blender.capture.world_alignment import similarity
from drgs_blender.cli.evaluate import compared_passes, writer
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.core.frame import ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import score_relit
from drgs_blender.evaluate.flip import find_flip
from drgs_blender.evaluate.truth import read_relit

FOLDER = OUT / "uncalibrated"
#: Pixels across, of rows that name none.
SIZE = 560
COLUMNS = (
    "Scene", "Cameras and masks", "Pictures", "Masks: IoU", "Relit, foreground: raw / scaled", "Relit: SSIM / FLIP",
    "Processor s", "s",
)  # fmt: skip
#: How a row is made: its cameras and its masks.
WAYS = {
    "true": ("true", "true"),
    "true cameras, found masks": ("true", "found"),
    "found cameras, true masks": ("found", "true"),
    "from the photographs alone": ("found", "found"),
}
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


def cameras_of(folder: Path, which: str) -> tuple[dict, dict[str, dict]]:
    """What a transforms.json says of all, and of each picture, of "true" or "found" cameras."""
    if which == "found":
        data = json.loads((folder / "made" / "transforms.json").read_text())
        return data, {Path(frame["file_path"]).name: frame for frame in data.pop("frames")}
    truth = json.loads((folder / "truth.json").read_text())
    known = {"orientation_override": "none", "fl_x": truth["focal"]}  # the world as it is
    return known, {name: {"transform_matrix": matrix} for name, matrix in truth["frames"].items()}


def composed(folder: Path, cameras: str, masks: str) -> Path:
    """A capture of the photographs with cameras and masks that are "true", or "found" by `drgs capture`."""
    capture, made = folder / f"{cameras}-cameras-{masks}-masks", folder / "made"
    (capture / "masks").mkdir(parents=True, exist_ok=True)
    data, known = cameras_of(folder, cameras)
    data["frames"] = []
    bands = {}
    if masks == "found":
        frames = cameras_of(folder, "found")[1]
        bands = {Path(name).stem: frame.get("mask_band", 0) for name, frame in frames.items()}
    for name, camera in known.items():
        mask_file = (folder / "truth" if masks == "true" else made / "masks") / f"{Path(name).stem}.png"
        if mask_file.is_file():
            shutil.copy(folder / "images" / name, capture)
            with Image.open(capture / name) as picture, Image.open(mask_file) as mask:
                width, height = picture.size
                coverage = mask.getchannel("A") if "A" in mask.getbands() else mask
                coverage.save(capture / "masks" / mask_file.name)
            lens = {"w": width, "h": height, "cx": width / 2, "cy": height / 2}
            files = {"file_path": name, "mask_path": f"masks/{mask_file.name}"}
            data["frames"].append(lens | camera | files | {"mask_band": bands.get(Path(name).stem, 0)})
    if cameras == "found":
        shutil.copy(made / data["ply_file_path"], capture)
    (capture / "transforms.json").write_text(json.dumps(data))
    return capture


def asset_of(folder: Path, cameras: str, masks: str, steps: list[int] | None) -> Made:
    """From photographs with "true" cameras and masks, or "found" ones."""
    made = folder / "made"
    if "found" in (cameras, masks) and not (made / "cost.json").exists():
        cost = run("capture", folder / "images", "--out", made, "--masks", "auto")
        (made / "cost.json").write_text(json.dumps(cost))
    alone = cameras == masks == "found"
    capture = made if alone else composed(folder, cameras, masks)
    asset = folder / f"{capture.name}.drgs"
    names = ("schedule.iterations", "decoupling.iterations")
    bound = [word for name, count in zip(names, steps or ()) for word in ("--set", f"{name}={count}")]
    spent, wall = run("reconstruct", capture, "--out", asset, *bound)
    if alone:
        first = json.loads((made / "cost.json").read_text())
        spent, wall = spent + first[0], wall + first[1]
    placed, truth = np.eye(4), true_cameras(folder / "truth.json")
    if cameras == "found":
        found = {
            Path(name).stem: np.array(one["transform_matrix"]) for name, one in cameras_of(folder, "found")[1].items()
        }
        ours, theirs = (np.stack([one[name][:3, 3] for name in sorted(found)]) for one in (found, truth))
        scale, rotation, shift = similarity(ours, theirs)
        placed[:3, :3], placed[:3, 3] = scale * rotation, shift
    count = len(cameras_of(folder, cameras)[1])
    fit = "true"
    if masks == "found":
        scores = [overlap(path, folder / "truth" / path.name) for path in sorted((made / "masks").glob("*.png"))]
        fit = f"{np.mean(scores):.3f}" if scores else "none"
    return Made(asset, placed, f"{count} of {len(truth)}", fit, spent, wall)


def relit(made: Made, folder: Path, sky: Path, samples: int) -> list[str]:
    """Cells of an asset under the other sky: PSNR of the foreground in dB, SSIM and FLIP of the scaled pictures."""
    truth = read_relit(folder / "relit", sky, up="z")
    session = Session()
    key = session.load_asset(made.asset)
    state, settings = ObjectState(made.asset.stem, key, made.placed), RenderSettings(samples, bounces=3)
    pictures = [compared_passes(session, state, view.camera, World(truth.radiance), settings) for view in truth.views]
    named = replace(truth, name=f"relit-{made.asset.stem}")
    scores = score_relit(named, pictures, {"flip": find_flip()}, writer(folder))
    raw, scaled = (scores[kind]["foreground"] for kind in ("raw", "scaled"))
    return [f"{raw:.2f} / {scaled:.2f}", ssim_and_flip([scores])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True, help="name of the row")
    parser.add_argument("--world", type=Path, required=True)
    parser.add_argument("--relit", type=Path, required=True)
    parser.add_argument("--object", type=Path, default=ROOT / "examples" / "cat" / "egyptian_cat.glb")
    parser.add_argument("--pictures", type=int, default=36)
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--steps", type=int, nargs=2, help="of surfels, of materials and light; else the default ones")
    parser.add_argument("--only", choices=list(WAYS), nargs="+", default=list(WAYS))
    options = parser.parse_args()
    folder = FOLDER / f"{options.scene.replace(' ', '-')}-{options.size}"
    folder.mkdir(parents=True, exist_ok=True)
    photographed(folder, options)
    scene = options.scene + (f", {options.size} pixels" if options.size != SIZE else "")
    scene += ", {} and {} steps".format(*options.steps) if options.steps else ""
    for label in options.only:
        made = asset_of(folder, *WAYS[label], options.steps)
        cells = [made.pictures, made.masks, *relit(made, folder, options.relit, options.samples)]
        rows = store_row(
            FOLDER / "rows.json", f"{scene}|{label}", [*cells, *(f"{x:.0f}" for x in (made.spent, made.wall))]
        )
        print(scene, label, *cells, flush=True)
    body = (
        "An object among boxes on a table of noise, photographed by Cycles under one sky, and relit under another, "
        f"where Cycles' pictures of it alone judge; {SIZE} pixels across but for rows that say so. Default settings of "
        "`drgs capture --masks auto` and `drgs reconstruct`, but for steps that are named. PSNR of the "
        "foreground in dB, scaled by one factor a channel; SSIM and FLIP of the scaled frames on white. "
        "Seconds: of both commands where both cameras and masks are found, else of `drgs reconstruct`.\n\n"
    )
    write_section(
        "uncalibrated", "Without cameras and masks, relit",
        body + table(COLUMNS, [(*key.split("|"), *cells) for key, cells in rows.items()]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
