"""The strip: what a photograph became, and what can be done with it, from the photograph's own camera.

    .venv/bin/python examples/demo_strip.py [--out out/demo/strip.png]

For each object a photograph of those that it was learned from, the object in the light that was learned with it, its
passes albedo, roughness and normals, and the object under another light, at rest and bent. `examples/captured` has the
photograph and its camera, as `drgs relight --camera` takes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from demo_pictures import GROUND, covered, over, to_bytes, with_alpha

from drgs_blender.cli.camera_file import read_camera
from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.formats.latlong import directions
from drgs_blender.ipc.protocol import Passes

CAPTURED = Path(__file__).resolve().parent / "captured"
OBJECTS = ("robot", "spot")
COLUMNS = ("photograph", "as captured", "albedo", "roughness", "normals", "relit", "bent")
#: Of the words, sRGB.
INK = (225, 225, 222)
SETTINGS = RenderSettings(samples=64, subpixel_samples=8, denoise="svgf", film_transparent=True)
PASSES = ("Combined", "Albedo", "Roughness", "Normal", "Coverage")
#: By how much the top of an object leans when bent, degrees.
BEND = 55.0
_MARGIN, _LINE = 8, 26


class Views(NamedTuple):
    """What one camera sees of an object: in its learned light, under the other one, and there bent."""

    captured: Passes
    relit: Passes
    bent: Passes


def camera_of(name: str) -> Camera:
    """The camera of the photograph."""
    return read_camera(CAPTURED / f"{name}.json")


def bent(vertices: np.ndarray, camera: Camera, degrees: float = BEND) -> np.ndarray:
    """(n, 3) vertices bent along an arc, to the right of the camera, feet as they were."""
    side = np.array([*camera.matrix_world[:2, 0], 0.0])
    side /= np.linalg.norm(side)
    low, height = vertices[:, 2].min(), np.ptp(vertices[:, 2])
    radius = height / np.radians(degrees)
    angle = (vertices[:, 2] - low) / radius
    across = vertices @ side
    from_centre = radius - across
    moved = vertices + ((radius - from_centre * np.cos(angle)) - across)[:, None] * side
    moved[:, 2] = low + from_centre * np.sin(angle)
    return moved.astype(np.float32)


def light(camera: Camera) -> np.ndarray:
    """(h, w, 3) radiance of the other light: warm from the left of the camera, blue from behind at the right."""
    right, up, back = camera.matrix_world[:3, :3].T
    towards = directions(64)

    def window(direction: np.ndarray, size: float) -> np.ndarray:
        return np.exp((towards @ (direction / np.linalg.norm(direction)) - 1) / size)[..., None]

    room = 0.07 + 0.03 * (towards @ up)[..., None]
    warm = window(0.5 * up - 0.9 * right + 0.7 * back, 0.05) * np.array([10.0, 6.0, 2.8])
    blue = window(0.4 * up + right - 0.6 * back, 0.04) * np.array([2.2, 4.5, 9.0])
    return (room + warm + blue).astype(np.float32)


def views(name: str, session: Session) -> Views:
    """Render a captured object from the camera of its photograph."""
    key = session.load_asset(CAPTURED / f"{name}.drgs")
    asset = session.asset(key)
    assert asset.environment is not None
    camera, state = camera_of(name), ObjectState(name, key)

    def seen(state: ObjectState, radiance: np.ndarray) -> Passes:
        return session.render(Frame(0, camera, [state], World(radiance), SETTINGS, PASSES))

    other = light(camera)
    posed = replace(state, vertices=bent(asset.mesh.vertices, camera))
    return Views(seen(state, asset.environment.radiance), seen(state, other), seen(posed, other))


def columns(name: str, found: Views) -> list[np.ndarray]:
    """(h, w, 4) sRGB pictures with alpha, of the columns in their order, all from one camera."""
    photograph = np.asarray(Image.open(CAPTURED / f"{name}.png").convert("RGBA"), np.float32) / 255
    relit = found.relit

    def picture(colour: np.ndarray) -> np.ndarray:
        return covered(np.clip(colour, 0, 1), relit["Coverage"])

    return [
        photograph,
        with_alpha(found.captured["Combined"], linear_to_srgb),  # as the photograph
        picture(linear_to_srgb(relit["Albedo"])),
        picture(relit["Roughness"]),
        picture(0.5 + 0.5 * relit["Normal"]),
        with_alpha(relit["Combined"]),
        with_alpha(found.bent["Combined"]),
    ]


def strip(rows: Sequence[Sequence[np.ndarray]]) -> Image.Image:
    """Rows of pictures above the names of their columns; of each row what all of its pictures leave empty is cut."""
    cut = [[_on_ground(picture[_box(row)]) for picture in row] for row in rows]
    width = max(picture.width for row in cut for picture in row) + 2 * _MARGIN
    heights = [row[0].height + 2 * _MARGIN for row in cut]
    sheet = Image.new("RGB", (width * len(COLUMNS), sum(heights) + _LINE), GROUND)
    for i, row in enumerate(cut):
        for j, picture in enumerate(row):
            at = j * width + (width - picture.width) // 2, sum(heights[:i]) + _MARGIN
            sheet.paste(picture, at)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(17)
    for j, word in enumerate(COLUMNS):
        draw.text(((j + 0.5) * width, sum(heights) + _LINE / 2 - 4), word, INK, font, anchor="mm")
    return sheet


def _box(row: Sequence[np.ndarray]) -> tuple[slice, slice]:
    seen = np.any([picture[..., 3] > 0.02 for picture in row], axis=0)
    return tuple(slice(found.min(), found.max() + 1) for found in map(np.flatnonzero, (seen.any(1), seen.any(0))))


def _on_ground(picture: np.ndarray) -> Image.Image:
    return Image.fromarray(to_bytes(over(picture, np.asarray(GROUND) / 255)))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=CAPTURED.parents[1] / "out" / "demo" / "strip.png")
    options = parser.parse_args(arguments)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    session = Session()
    strip([columns(name, views(name, session)) for name in OBJECTS]).save(options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
