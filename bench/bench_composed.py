"""Whole scenes against Cycles: .blend files with DR-GS objects, meshes, instances and lights, rendered by both engines.

python bench/bench_composed.py [--size 192] [--seeds 3] [--spp 1024] [--samples 2048] [--scenes NAME ...]

Both pictures come out of Blender, ours through the extension, from one file (`composed_job.py`).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import OpenEXR
from judge import blender_python, environments, psnr, systematic_error, to_srgb, without_noise
from PIL import Image
from report import OUT, ROOT, table, write_section
from scipy.ndimage import binary_erosion
from subjects import spread_asset

BOUNCES = 3
SCENES = {
    "outdoors": "textured floor, sun of 4 degrees, HDRI",
    "studio": "two objects, one mirrored; metal ball, cube; soft point, spot, area light, a light in the picture",
    "scattered": "a mesh in 20 places, disk light with spread, panel that glows",
    "visibility": "object unseen by the camera, one without shadow, holdout",
    "catcher": "the same, floor a shadow catcher",
}
_PROGRAM = Path(__file__).with_name("composed_job.py")
#: (scene, ours, theirs) -> its line of the table.
Row = Callable[[str, np.ndarray, np.ndarray], tuple[str, ...]]


def render(
    name: str, options: argparse.Namespace, folder: Path, module: str = "composed_job", passes: Sequence[str] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """(ours, theirs): (k, h, w, 4) pictures of k seeds; of `passes`, those side by side.

    Those of Cycles are kept for as long as the job is the same; ours, too, where an interrupted run is resumed.
    """
    drgs, npz = spread_asset("spot")
    wanted = []
    for engine, samples in (("CYCLES", options.spp), ("DRGS", options.samples)):
        for seed in range(options.seeds):
            out = OUT / f"{module}-{name}-{engine.lower()}-{seed}.npy"
            note = out.with_suffix(".job.json")
            programs = b"".join(path.read_bytes() for path in sorted(_PROGRAM.parent.glob("*_scenes.py")))
            sources = hashlib.sha256(_PROGRAM.read_bytes() + programs + npz.read_bytes()).hexdigest()
            text = json.dumps([sources, name, samples, seed, options.size, BOUNCES, passes])
            known = out.exists() and note.exists() and note.read_text() == text
            known &= engine == "CYCLES" or options.resume
            wanted.append(({"engine": engine, "seed": seed, "samples": samples, "out": str(out)}, note, text, known))
    job = {
        "zip": str(folder / "extension.zip"), "asset": str(drgs), "module": module, "scene": name,
        "hdris": str(environments()), "blend": str(OUT / f"{module}-{name}.blend"), "size": options.size,
        "bounces": BOUNCES, "passes": passes,
        "pictures": [picture for picture, _, _, known in wanted if not known],
    }  # fmt: skip
    path = OUT / f"{module}-{name}.json"
    path.write_text(json.dumps(job))
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(folder / name), "DRGS_ENGINE": sys.executable}
    command = [str(blender_python()), "-P", str(_PROGRAM), str(path)]
    if job["pictures"]:
        subprocess.run(command, check=True, timeout=3000, env=environment)
    for picture, note, text, known in wanted:
        if passes and not known:
            np.save(picture["out"], side_by_side(Path(picture["out"]).with_suffix(".exr"), passes))
        note.write_text(text)
    pictures = [np.load(picture["out"]) for picture, _, _, _ in wanted]
    return np.stack(pictures[options.seeds :]), np.stack(pictures[: options.seeds])


def side_by_side(path: Path, passes: Sequence[str]) -> np.ndarray:
    """(h, n w, 4): passes of a multilayer EXR file, with the alpha of its picture; the file goes."""
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    layers = {name.split(".", 1)[1]: channel.pixels for part in parts for name, channel in part.channels.items()}
    alpha = layers["Combined.A"]
    tiles = [np.stack([*(layers[f"{name}.{c}"] for c in "RGB"), alpha], -1) for name in passes]
    path.unlink()
    return np.concatenate(tiles, axis=1).astype(np.float32)


def show(ours: np.ndarray, theirs: np.ndarray, path: Path) -> None:
    """Both pictures, and eight times their difference on grey, side by side."""
    a, b = to_srgb(ours[..., :3]), to_srgb(theirs[..., :3])
    sheet = np.concatenate([a, b, np.clip(0.5 + 8 * (a - b), 0, 1)], axis=1)
    Image.fromarray((sheet * 255 + 0.5).astype(np.uint8)).save(path)


def options_of(text: str, scenes: Collection[str], seeds: int, spp: int, samples: int) -> argparse.Namespace:
    """Options of the command line of a program that compares `scenes`; the numbers are defaults."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--seeds", type=int, default=seeds, help="independent pictures of either program, at least 2")
    parser.add_argument("--spp", type=int, default=spp, help="of Cycles, per pixel and picture")
    parser.add_argument("--samples", type=int, default=samples, help="of ours, per pixel and picture")
    parser.add_argument("--scenes", nargs="+", default=list(scenes), choices=list(scenes))
    parser.add_argument("--resume", action="store_true", help="keep what an interrupted run of this code rendered")
    options = parser.parse_args()
    if options.seeds < 2:
        parser.error("--seeds: noise can be separated from the rest with two pictures or more")
    return options


def compare(
    options: argparse.Namespace,
    row: Row,
    name: str,
    module: str = "composed_job",
    passes: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> list[tuple[str, ...]]:
    """Lines of the table of all scenes that the options ask for; a picture of each is kept as ``name-SCENE.png``.

    Of the scenes in `passes` these are compared instead of the picture.
    """
    OUT.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        command = [sys.executable, str(ROOT / "tools" / "extension.py"), "--out", str(folder / "extension.zip")]
        subprocess.run(command, check=True)
        for scene in options.scenes:
            ours, theirs = render(scene, options, folder, module, passes.get(scene, ()))
            rows.append(row(scene, ours, theirs))
            show(ours.mean(0), theirs.mean(0), OUT / f"{name}-{scene}.png")
            print(*rows[-1], flush=True)
    return rows


def main() -> None:
    options = options_of(__doc__ or "", SCENES, seeds=3, spp=1024, samples=2048)
    rows = compare(options, row, "composed")
    if options.scenes == list(SCENES):
        write_section("composed", "Whole scenes against Cycles", report(options, rows))


def row(name: str, ours: np.ndarray, theirs: np.ndarray) -> tuple[str, ...]:
    """A scene's line of the table."""
    mask = binary_erosion((theirs[..., 3].min(0) > 0.999) & (ours[..., 3].min(0) > 0.999), iterations=2)
    error, deviation = systematic_error(ours, theirs, mask)
    a, b = ours.mean(0), theirs.mean(0)
    alpha = a[..., 3] - b[..., 3]
    light = a[mask][:, :3].mean() / b[mask][:, :3].mean() - 1
    return (
        name, SCENES[name], f"{psnr(a, b, mask):.2f}", without_noise(error, deviation), f"{light:+.2%}",
        f"{np.abs(alpha).mean():.4f} ({alpha.mean():+.4f})", f"{psnr(theirs[0], theirs[1], mask):.1f}",
    )  # fmt: skip


def report(options: argparse.Namespace, rows: list[tuple[str, ...]]) -> str:
    """The text of the section."""
    columns = (
        "Scene",
        "",
        "PSNR dB",
        "No noise, dB",
        "Mean light",
        "Alpha: mean absolute difference (mean)",
        "Cycles itself",
    )
    return (
        f"Foreground PSNR in sRGB (mask eroded by 2 px), {options.size}x{options.size}, of .blend files rendered by "
        f"Cycles of bpy 5.0.1 (Principled, GGX) and through the extension, primary mesh, 16 sub-pixel samples, "
        f"{BOUNCES} bounces in "
        f"both. Each picture is the mean of {options.seeds} with independent random numbers, of {options.spp} spp "
        f"and {options.samples} samples. Cycles' shadow terminator offsets and clamps are off. *No noise* and *Cycles "
        "itself* as in the section on parity.\n\n" + table(columns, rows) + "\n\n"
        "In the last two scenes sky and lights stand next to objects that only some rays meet, where a picture depends "
        "on how strategies are weighed (docs/rendering.md)."
    )


if __name__ == "__main__":
    main()
