"""Edited materials: the paper's picture of them, made by the extension's own buttons, and what each edit changed.

python bench/bench_editing.py [--size 256] [--samples 512]

Blender edits and renders (`editing_job.py`); the passes of the materials are compared here.
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
from judge import blender_python, environments, to_srgb
from report import OUT, ROOT, add_publish, picture_path, table, write_section
from scipy.spatial import cKDTree
from subjects import asset_path, textured_spot

from drgs_blender.evaluate.scenes import read_layers

Array = np.ndarray
Layers = dict[str, Array]

FIGURE = "editing.png"
LIGHTS = ("forest", "sunset")
CHANNELS = ("Albedo", "Roughness", "Metallic")
#: Subject -> the part that each edit is masked by, as in editing_job.py.
PARTS = {
    "helmet": {"gilded": "MetalPartsMat", "painted": "LeatherPartsMat", "tinted": "RubberWoodMat"},
    "spot": {"gilded": "Head", "painted": "Legs", "tinted": "Body"},
}
#: Picture -> its title; two rows a subject.
TITLES = {
    "captured": "as captured",
    "gold": "Set Material: gold",
    "mirror": "Adjustments: rough to mirror",
    "gilded": "gold, masked: {gilded}",
    "painted": "painted: {painted}",
    "tinted": "tint, masked: {tinted}",
    "posed-all": "the last three, posed, second light",
    "posed-captured": "Show as Captured",
}
#: Edit -> what was pressed.
EDITED_BY = {
    "gold": "Set Material, Gold",
    "mirror": "Adjustments: roughness x 0.1, metallic + 1, value x 3",
    "gilded": "Set Material, Gold, Mask",
    "painted": "Paint albedo, Paint roughness, Set Vertex Colors",
    "tinted": "Adjustments: tint 0.25 0.5 1, Mask",
}
#: Pictures that must be the first one again.
SAME = {"shown": "Show as Captured over all edits", "restored": "Restore Captured Material, pose and light taken back"}
#: Points on a subject, and how many nearest ones must agree on whether a pixel shows a part.
POINTS, NEAR = 1_000_000, 8


def render(options: argparse.Namespace, folder: Path) -> None:
    """Have Blender write all pictures to `folder`."""
    archive = folder / "extension.zip"
    subprocess.run([sys.executable, str(ROOT / "tools" / "extension.py"), "--out", str(archive)], check=True)
    job = {
        "zip": str(archive), "out": str(folder), "size": options.size, "samples": options.samples,
        "assets": {"helmet": str(asset_path("helmet", textures=True)), "spot": str(textured_spot())},
        "lights": [str(environments() / f"{name}.exr") for name in LIGHTS],
    }  # fmt: skip
    path = folder / "job.json"
    path.write_text(json.dumps(job))
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(folder / "blender"), "DRGS_ENGINE": sys.executable}
    command = [str(blender_python()), "-P", str(Path(__file__).with_name("editing_job.py")), str(path)]
    subprocess.run(command, check=True, timeout=3000, env=environment)


def load(folder: Path, name: str, camera_sees: str) -> dict[str, Layers]:
    """Step -> layers of a subject's pictures of one primary surface."""
    end = f"-{camera_sees}"
    files = folder.glob(f"{name}-*{end}.exr")
    return {f.stem.removeprefix(f"{name}-").removesuffix(end): read_layers(f) for f in files}


class PixelFaces:
    """Which faces the pixels of a picture show, found by the pass Position alone."""

    def __init__(self, layers: Layers, vertices: Array, faces: Array) -> None:
        rng = np.random.default_rng(0)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        face = rng.choice(len(faces), POINTS, p=area / area.sum())
        u, v = np.sqrt(rng.random((POINTS, 1))), rng.random((POINTS, 1))
        points = (1 - u) * a[face] + u * (1 - v) * b[face] + u * v * c[face]
        self.covered = layers["Coverage"][..., 0] > 0
        _, near = cKDTree(points).query(layers["Position"][self.covered], NEAR)
        #: (k, NEAR, 3) vertices of the faces that lie nearest to what each covered pixel shows.
        self.corners = faces[face[near]]

    def of(self, mask: Array) -> tuple[Array, Array]:
        """(inside, outside): (h, w) bool, pixels that show nothing but the masked part, nothing but the rest."""
        weights = mask[self.corners]
        found = np.zeros((2, *self.covered.shape), bool)
        found[0, self.covered] = (weights == 1).all(axis=(1, 2))
        found[1, self.covered] = (weights == 0).all(axis=(1, 2))
        return found[0], found[1]


def changed(a: Layers, b: Layers, pixels: Array) -> int:
    """How many of `pixels` have another bit in a pass of the materials."""
    return int(np.any([(a[name] != b[name]).any(axis=-1) for name in CHANNELS], axis=0)[pixels].sum())


def means(before: Layers, after: Layers, pixels: Array) -> list[str]:
    """Each channel's mean over `pixels`, before and after."""

    def text(layers: Layers, name: str) -> str:
        return " ".join(f"{value:.2f}" for value in layers[name][pixels].reshape(pixels.sum(), -1).mean(axis=0))

    return [f"{text(before, name)} → {text(after, name)}" for name in CHANNELS]


def rows_of(name: str, pictures: dict[str, Layers], arrays: dict[str, Array]) -> list[list[object]]:
    """A subject's lines of the table."""
    before = pictures["captured"]
    pixel_faces = PixelFaces(before, arrays["rest"], arrays["faces"])
    rows: list[list[object]] = []
    for edit, made_by in EDITED_BY.items():
        part = PARTS[name].get(edit)
        mask = np.ones(len(arrays["rest"])) if part is None else arrays[part]
        inside, outside = pixel_faces.of(mask)
        kept = "-" if part is None else f"{changed(before, pictures[edit], outside)} of {outside.sum()}"
        rows.append([name, made_by, part or "all", *means(before, pictures[edit], inside), kept])
    posed, edited = pictures["posed-captured"], pictures["posed-all"]
    pixel_faces = PixelFaces(posed, arrays["posed"], arrays["faces"])
    _, outside = pixel_faces.of(np.max([arrays[part] for part in PARTS[name].values()], axis=0))
    for part in PARTS[name].values():
        inside, _ = pixel_faces.of(arrays[part])
        kept = f"{changed(posed, edited, outside)} of {outside.sum()}" if outside.any() else "-"
        rows.append([name, "the last three, posed", part, *means(posed, edited, inside), kept])
    return rows


def differing(a: Layers, b: Layers) -> int:
    """How many values of any pass differ by a bit."""
    return sum(int((a[name] != b[name]).sum()) for name in a)


def draw(pictures: dict[str, dict[str, Layers]], options: argparse.Namespace) -> None:
    """Two rows a subject, over white."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = 4
    rows = len(pictures) * len(TITLES) // columns
    figure, axes = pyplot.subplots(rows, columns, figsize=(2.2 * columns, 2.4 * rows), constrained_layout=True)
    flat = iter(axes.flat)
    for name, found in pictures.items():
        for step, title in TITLES.items():
            panel, combined = next(flat), found[step]["Combined"]
            over_white = to_srgb(combined[..., :3] + 1 - combined[..., 3:])
            panel.imshow((over_white * 255 + 0.5).astype(np.uint8))
            panel.set_title(title.format(**PARTS[name]), fontsize=8)
            panel.axis("off")
    figure.savefig(picture_path(FIGURE, options), dpi=90)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=512)
    add_publish(parser)
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, dict[str, Layers]] = {}
    rows, same = [], []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        render(options, folder)
        for name in PARTS:
            pictures[name], exact = load(folder, name, "surfels"), load(folder, name, "mesh")
            with np.load(folder / f"{name}.npz") as data:
                rows += rows_of(name, exact, dict(data))
            first = pictures[name]["captured"]
            for step, about in SAME.items():
                count = sum(values.size for values in first.values())
                same.append([name, about, f"{differing(first, pictures[name][step])} of {count}"])
    draw(pictures, options)
    write_section("editing", "Edited materials", report(options, rows, same))


def report(options: argparse.Namespace, rows: list[list[object]], same: list[list[object]]) -> str:
    """The text of the section."""
    columns = ("Subject", "Made by", "Part", *CHANNELS, "Rest: pixels that changed")
    return (
        f"{options.size}x{options.size}, {options.samples} samples, surfels as primary surface, 16 sub-pixel "
        f"samples, 2 "
        f"bounces, under "
        f"{LIGHTS[0]}.exr, posed under {LIGHTS[1]}.exr. Every edit was made in Blender by the operators and settings "
        "of the sidebar (`bench/editing_job.py`), after *Restore Captured Material*. The helmet's parts are attributes "
        "that `drgs make` keeps of its source, spot's are vertex groups.\n\n"
        f"![Materials edited, posed and shown as captured](images/{FIGURE})\n\n"
        "Means of the passes Albedo, Roughness and Metallic over the pixels that show the part and nothing else, as "
        "captured → edited, and how many of the pixels that show nothing of it have another bit in one of these "
        "passes. Here a pixel is one point of the mesh; surfels let through a little of what lies behind them.\n\n"
        + table(columns, rows)
        + "\n\nThe way back, against the first picture, all passes and the picture itself:\n\n"
        + table(("Subject", "", "Values that differ by a bit"), same)
    )


if __name__ == "__main__":
    main()
