"""Texture lookups against Cycles: shining squares, seen from above, each pixel at its very centre."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.formats.exr import read_exr
from drgs_blender.render.scene.textures import MaterialTable

ROOT = Path(__file__).resolve().parents[2]
BINARY = "Scripts/python.exe" if sys.platform == "win32" else "bin/python"
BLENDER_PYTHON = ROOT / ".venv-blender" / BINARY

COLUMNS, SIZE = 8, 32
U, V = (-1.37, 2.41), (-1.21, 2.33)
#: Of the largest value, 3: rounding of coordinates in float32, and the table of the sRGB curve.
TOLERANCE = 5e-5

RNG = np.random.default_rng(0)
ALPHA = RNG.integers(0, 256, (5, 7, 4), dtype=np.uint8)
ALPHA[1, 2, 3], ALPHA[3, :, 3], ALPHA[0, 0] = 0, RNG.integers(0, 20, 7), (255, 255, 255, 0)
OPAQUE = np.concatenate([ALPHA[..., :3], np.full((5, 7, 1), 255, np.uint8)], axis=2)
FLOATS = np.concatenate([3 * RNG.random((3, 6, 3)), np.ones((3, 6, 1))], axis=2).astype(np.float32)
MAPPING = {"location": [0.3, -0.2, 0.0], "rotation": [0.0, 0.0, 0.7], "scale": [1.7, -0.6, 1.0]}


def associated(pixels: np.ndarray) -> np.ndarray:
    """Encoded colours times alpha, rounded down to bytes, as Cycles makes them when it loads a picture."""
    colours = pixels[..., :3].astype(np.uint16) * pixels[..., 3:] // 255
    return np.concatenate([colours.astype(np.uint8), pixels[..., 3:]], axis=2)


def transform(mapping: dict) -> np.ndarray:
    """What a Mapping node of type Point does to (u, v, 1): scale, rotate, move."""
    c, s = math.cos(mapping["rotation"][2]), math.sin(mapping["rotation"][2])
    turned = np.array([[c, -s], [s, c]]) * mapping["scale"][:2]
    return np.column_stack([turned, mapping["location"][:2]])


def tiles() -> list[tuple[dict, Image, Texture]]:
    """What Cycles is asked for, and the same in our words."""
    found = []

    def add(name: str, space: str, pixels: np.ndarray, extension="repeat", interpolation="linear", **more) -> None:
        asked = {"image": name, "colour_space": space, "extension": extension.upper()}
        asked |= {"interpolation": interpolation.capitalize()} | more.get("mapping", {})
        asked |= {key: more[key] for key in ("output", "alpha_mode") if key in more}
        image = Image(f"{len(found)}", pixels, "srgb" if space == "sRGB" and pixels.dtype == np.uint8 else "linear")
        matrix = transform(more["mapping"]) if "mapping" in more else np.eye(2, 3)
        found.append((asked, image, Texture(image.name, more.get("output", "rgb"), matrix, interpolation, extension)))

    kinds = (("opaque", "sRGB", OPAQUE), ("opaque", "Non-Color", OPAQUE), ("floats", "Linear Rec.709", FLOATS))
    for extension, interpolation, kind in itertools.product(
        ("repeat", "extend", "clip", "mirror"), ("linear", "closest"), kinds
    ):
        add(*kind, extension, interpolation)
        if interpolation == "linear":
            add(*kind, extension, interpolation, mapping=MAPPING)
    # Alpha: what is done when the image is loaded depends on its settings; the lookup is always the same.
    for mode, output in itertools.product(("STRAIGHT", "NONE", "CHANNEL_PACKED"), ("rgb", "r", "luminance")):
        pixels = associated(ALPHA) if mode == "STRAIGHT" else ALPHA
        add("alpha", "sRGB", pixels, alpha_mode=mode, output=output)
    add("alpha", "sRGB", ALPHA, output="a")
    for output in ("rgb", "g", "a"):
        add("alpha", "Non-Color", ALPHA, "clip", output=output)
    add("1x1", "sRGB", OPAQUE[:1, :1], "clip")
    add("gone", "sRGB", OPAQUE)
    return found


@pytest.fixture(scope="module")
def picture(tmp_path_factory) -> np.ndarray:
    """Cycles' picture of all tiles."""
    if not BLENDER_PYTHON.exists():
        pytest.skip("Blender's Python is not installed in .venv-blender")
    folder = tmp_path_factory.mktemp("cycles")
    for name, pixels in (("opaque", OPAQUE), ("alpha", ALPHA), ("1x1", OPAQUE[:1, :1])):
        Picture.fromarray(pixels).save(folder / f"{name}.png")
    np.save(folder / "floats.npy", FLOATS)
    job = {"tiles": [asked for asked, *_ in tiles()], "columns": COLUMNS, "size": SIZE, "u": U, "v": V}
    (folder / "job.json").write_text(json.dumps(job))
    command = [str(BLENDER_PYTHON), "-P", str(Path(__file__).with_name("cycles_textures.py")), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return read_exr(folder / "picture.exr")[0]


def test_lookups_agree_with_cycles(picture):
    centre = (np.arange(SIZE) + 0.5) / SIZE
    u, v = np.meshgrid(U[0] + centre * (U[1] - U[0]), V[1] - centre * (V[1] - V[0]))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    wrong = []
    for k, (asked, image, texture) in enumerate(tiles()):
        images = [] if asked["image"] == "gone" else [image]
        table = MaterialTable([Material("m", emission=(1, 1, 1), emission_texture=texture)], images)
        found = table.lookup(np.zeros(len(uv), int), uv)[:, 5:].reshape(SIZE, SIZE, 3)
        row, column = k // COLUMNS * SIZE, k % COLUMNS * SIZE
        expected = picture[row : row + SIZE, column : column + SIZE]
        assert np.ptp(expected) > 0.1
        error = float(np.abs(found - expected).max())
        if not error <= TOLERANCE:
            wrong.append((error, asked))
    assert not wrong
