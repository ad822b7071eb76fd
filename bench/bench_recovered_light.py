"""The light that reconstructions recover beside the true one: a picture, and errors at three sharpnesses.

python bench/bench_recovered_light.py --scenes scenes [--assets out/bench/assets] [--objects spot cat]

Scenes are those of `drgs evaluate --make-scenes scenes`, assets those that `bench_asset.py` keeps. Photographs tell
light up to a factor that albedo takes up: one a channel is fitted before the comparison.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from bench_asset import FOLDER
from judge import to_srgb
from PIL import Image
from report import OUT, add_publish, picture_path, store_row, table, write_section

from drgs_blender.core.asset.container import read_asset
from drgs_blender.evaluate.truth import read_truth

FIGURE = "recovered-light.png"
#: Rows of the maps that are compared.
ROWS = 32
#: Exponents of the cosine lobes through which light is compared, by their names: what reflects it, and the angle at
#: which a lobe has half of its height.
LOBES = {"diffuse": 1, "half at 17 deg": 16, "half at 6 deg": 128}
COLUMNS = ("Object", *(f"Light, {name}" for name in LOBES), "Brightest direction, deg")
Array = np.ndarray


def directions(rows: int) -> tuple[Array, Array]:
    """(2 rows^2, 3) directions of the pixels of a lat-long map, and (2 rows^2,) solid angles."""
    latitude = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)
    longitude = np.pi * (1 - (np.arange(2 * rows) + 0.5) / rows)
    la, lo = (a.ravel() for a in np.meshgrid(latitude, longitude, indexing="ij"))
    found = np.stack([np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)], -1)
    return found, np.cos(la) * (np.pi / rows) ** 2


def reduced(radiance: Array, rows: int = ROWS) -> Array:
    """(rows, 2 rows, 3) means of a lat-long map, by boxes; its rows must be a multiple of them, or divide them."""
    times = -(-rows // len(radiance))
    grown = radiance.repeat(times, 0).repeat(times, 1)
    if len(grown) % rows or grown.shape[1] != 2 * len(grown):
        raise SystemExit(f"a map of {radiance.shape[:2]} pixels cannot be reduced to {rows} rows: choose another light")
    side = len(grown) // rows
    return grown.reshape(rows, side, 2 * rows, side, 3).mean((1, 3))


def scaled(found: Array, true: Array, weight: Array) -> Array:
    """`found` with one factor a channel, of least squares by solid angle."""
    return found * ((weight * found * true).sum(0) / np.maximum((weight * found * found).sum(0), 1e-12))


def errors(found: Array, true: Array) -> list[str]:
    """Cells: relative errors (root mean square by solid angle, of the true mean) of the light through each lobe."""
    toward, angle = directions(ROWS)
    weight = angle[:, None]
    cosine = np.clip(toward @ toward.T, 0, None)
    a, b = reduced(found).reshape(-1, 3), reduced(true).reshape(-1, 3)
    cells = []
    for exponent in LOBES.values():
        lobe = cosine**exponent * angle
        lobe /= lobe.sum(1, keepdims=True)
        seen, truth = lobe @ a, lobe @ b
        off = scaled(seen, truth, weight) - truth
        cells.append(
            f"{np.sqrt((weight * off**2).sum() / (3 * angle.sum())) / np.average(truth.mean(1), weights=angle):.1%}"
        )
    peaks = [toward[np.argmax((lobe @ light).mean(1))] for light in (a, b)]
    return [*cells, f"{np.degrees(np.arccos(np.clip(peaks[0] @ peaks[1], -1, 1))):.0f}"]


def strip(found: Array, true: Array) -> Array:
    """(h, w, 3) uint8: the true map, the recovered one scaled to it, side by side, in one exposure."""
    _, angle = directions(128)
    a, b = (reduced(light, 128).reshape(-1, 3) for light in (found, true))
    maps = [b, scaled(a, b, angle[:, None])]
    white = 2.5 * np.average(b.mean(1), weights=angle)
    shown = [to_srgb(np.clip(light / white, 0, 1)).reshape(128, 256, 3) for light in maps]
    return (np.pad(np.concatenate(shown, 1), ((0, 4), (0, 0), (0, 0)), constant_values=1) * 255 + 0.5).astype(np.uint8)


def main() -> None:
    """Measure, draw, write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--assets", type=Path, default=FOLDER)
    parser.add_argument("--objects", nargs="+", default=["cat", "fern", "helmet", "robot", "spot"])
    add_publish(parser)
    options = parser.parse_args()
    rows: dict[str, list[str]] = {}
    strips = []
    for name in options.objects:
        truth, asset = read_truth(options.scenes / name), read_asset(options.assets / f"{name}.drgs")
        if truth is None or asset.environment is None:
            raise SystemExit(f"{name}: has no {'truth' if truth is None else 'light'}")
        true = next(item.radiance for item in truth.sets if item.light == truth.training_light)
        found = asset.environment.radiance
        strips.append(strip(found, true))
        rows = store_row(OUT / "recovered-light.json", name, errors(found, true))
        print(name, *rows[name], flush=True)
    Image.fromarray(np.concatenate(strips)).save(picture_path(FIGURE, options))
    write_section("recovered_light", "The light that is recovered", report(rows, options.objects))


def report(rows: dict[str, list[str]], shown: list[str]) -> str:
    """The text of the section."""
    exponents = ", ".join(map(str, LOBES.values()))
    body = (
        "Environment of each reconstruction against the true one of its photographs, after one factor a channel: root "
        "mean square over all directions, in parts of the true mean, of the light that reaches a surface through "
        f"cosine lobes of exponents {exponents}; angle between the brightest directions of the last."
    )
    picture = f"![True and recovered light of {', '.join(shown)}](images/{FIGURE})"
    return f"{body}\n\n{picture}\n\n" + table(COLUMNS, [[name, *cells] for name, cells in sorted(rows.items())])


if __name__ == "__main__":
    main()
