"""The film of docs/film: photographs, what was learned from them, and what can be done with that.

    .venv/bin/python examples/demo_film.py [--out out/film] [--publish out/film]

Blender makes two scenes, `drgs render` and `drgs denoise` their frames, Pillow the titles, and PyAV film.webm, which
`make env` installs. Frames that are there already are not rendered again, so that a film that was interrupted is gone
on with.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "film"
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

import environments  # noqa: E402
from demo_pictures import (  # noqa: E402
    GROUND,
    combined,
    covered,
    displayed,
    over,
    save_animation,
    to_bytes,
    with_alpha,
)
from demo_run import DRGS, EXAMPLES, building, check_folder, exit_code, frames_saved, run_all  # noqa: E402
from demo_shots import CAPTURED, ROUND, SHOTS, TURN  # noqa: E402
from steps import Step, StepFailed  # noqa: E402

from drgs_blender.core.color import linear_to_srgb  # noqa: E402
from drgs_blender.render.film.frame_files import read_frame  # noqa: E402

FPS, SIZE = 12, (640, 360)
#: Pixels of the words and of the space between two (the font's own is filled by a j), and where they stand.
TEXT, SPACE, CAPTION = 20, 8, (25, SIZE[1] - 20)
#: Pixels of each of the forty photographs, five rows above the words.
SIDE = (SIZE[1] - 50) // 5
#: Said of the parts.
WORDS = {
    "photographs": "forty photographs of a robot",
    "captured": "surfels, materials and light, learned from them",
    "Albedo": "albedo",
    "Roughness": "roughness",
    "Normal": "normals",
    "relit": "another light",
    "jelly": "a cow of jelly",
    "bones": "a skeleton of Blender's",
    "gold": "stone becomes gold",
    "night": "noon, evening, a lamp",
    "end": "DR-GS for Blender",
}
#: Of the words, sRGB.
INK = (235, 235, 232)
#: The photograph from whose camera the turntable begins, among those of docs/film/photographs.webp, eight in a row.
CHOSEN = 18
_ALONG, _HOLD, _ZOOM, _DISSOLVE, _END = 20, 12, 14, 6, 36


def steps(out: Path) -> list[Step]:
    """What is rendered, one after another; seconds are those of two processors."""
    extension = out / "extension.zip"
    scene = [environments.blender(), "-P", EXAMPLES / "demo_film_scene.py", extension, out]
    scripts = ("demo_film_scene.py", "demo_shots.py", "demo_scene.py", "blender_scenes.py")
    of_scene = (EXAMPLES / "captured", *(EXAMPLES / name for name in scripts), extension)
    turntable = [
        *(*DRGS, "render", out / "turntable.blend", "--frames", f"1-{TURN}", "--out", out / "turntable" / "####.exr"),
        *("--denoise", "svgf", "--passes", "Combined,Albedo,Roughness,Normal,Coverage"),
    ]
    text = "Rendering the turntable"
    found = [
        building(extension),
        Step("scene", "Setting the scenes", scene, 40.0, ("extension",), out / "stage.blend", of_scene),
        Step("turntable", text, turntable, 60.0, ("scene",), count=frames_saved(text, TURN), measured=True),
    ]
    for name, (first, last) in SHOTS.items():
        span, noisy, clean = f"{first}-{last}", out / "noisy" / "####.exr", out / name / "####.exr"
        render = [*DRGS, "render", out / "stage.blend", "--frames", span, "--out", noisy]
        render += ["--denoise", "none", "--passes", "temporal"]
        denoise = [*DRGS, "denoise", noisy, "--frames", span, "--sequence", span, "--out", clean]
        denoise += ["--passes", "Combined"]
        count, text = last - first + 1, f"Rendering {name}"
        rendering = Step(name, text, render, 2.5 * count, (found[-1].name,), count=frames_saved(text, count))
        rendering.measured = True
        found += [rendering, Step(f"{name}, denoised", f"Denoising {name}", denoise, 1.0 * count, (name,))]
    return found


def missing(out: Path) -> list[Path]:
    """Frames of the film that are not there."""
    frames = [out / "turntable" / f"{number:04d}.exr" for number in range(1, TURN + 1)]
    for name, (first, last) in SHOTS.items():
        frames += [out / name / f"{number:04d}.exr" for number in range(first, last + 1)]
    return [path for path in frames if not path.is_file()]


def mix(a: np.ndarray, b: np.ndarray, part: float | np.ndarray) -> np.ndarray:
    """Between two pictures."""
    return a + (b - a) * part


def ease(part: float) -> float:
    """From 0 to 1, slow at both ends."""
    part = min(max(part, 0.0), 1.0)
    return part * part * (3 - 2 * part)


def ground() -> np.ndarray:
    """(h, w, 3) behind the robot: lighter in the middle."""
    x, y = (np.linspace(-1, 1, n) for n in SIZE)
    light = 1.25 - 0.45 * np.hypot(x[None] * 0.9, y[:, None] * 0.9)
    return np.asarray(GROUND) / 255 * light[..., None]


def titled(picture: np.ndarray, words: str, part: float) -> np.ndarray:
    """The picture with words at the lower left, as visible as `part` says."""
    font = ImageFont.load_default(TEXT)

    def drawn(ink: int, stroke: int) -> np.ndarray:
        sheet = Image.new("L", SIZE)
        draw, x = ImageDraw.Draw(sheet), float(CAPTION[0])
        for word in words.split():
            draw.text((x, CAPTION[1]), word, ink, font, anchor="ls", stroke_width=stroke)
            x += font.getlength(word) + SPACE
        return np.asarray(sheet, np.float32)[..., None] / 255 * part

    shaded = mix(picture, np.zeros(3), drawn(110, 3))  # a shadow, on light grounds
    return mix(shaded, np.asarray(INK) / 255, drawn(255, 0))


def photographs() -> Iterator[np.ndarray]:
    """One photograph after another, then the chosen one alone, as large as the turntable shows it."""
    sheet = Image.open(PICTURES / "photographs.webp").convert("RGB")
    cell, side = sheet.width // 8, SIDE
    chosen = Image.open(EXAMPLES / "captured" / "robot.png").convert("RGBA")
    left = (SIZE[0] - 8 * side) // 2
    behind = ground()
    for i in range(_ALONG + _HOLD + _ZOOM):
        count = min(40, 1 + round(40 * ease((i + 1) / _ALONG)))
        part = ease((i - _ALONG - _HOLD + 1) / _ZOOM)
        size = side + part * (SIZE[1] - side)
        at = np.array([left + CHOSEN % 8 * side, CHOSEN // 8 * side], float)
        at += part * (np.array([(SIZE[0] - SIZE[1]) / 2, 0.0]) - at)
        picture = Image.fromarray(to_bytes(behind))
        faint = Image.new("RGB", SIZE, GROUND)
        for k in range(count):
            x, y = at + (np.array([k % 8, k // 8]) - [CHOSEN % 8, CHOSEN // 8]) * size
            box = (k % 8 * cell, k // 8 * cell, (k % 8 + 1) * cell, (k // 8 + 1) * cell)
            if k != CHOSEN and -size < x < SIZE[0] and -size < y < SIZE[1]:
                whole = sheet.crop(box).resize((round(size),) * 2, Image.Resampling.BICUBIC)
                faint.paste(whole, (round(x), round(y)))
        picture = Image.blend(faint, picture, part)
        if count > CHOSEN:
            one = chosen.resize((round(size),) * 2, Image.Resampling.BICUBIC)
            picture.paste(one, (round(at[0]), round(at[1])), one)
        yield titled(np.asarray(picture, np.float32) / 255, WORDS["photographs"], ease((i + 1) / 6) * (1 - part))


def shown(passes: dict[str, np.ndarray], name: str) -> np.ndarray:
    """(h, w, 3) of one part of the turntable: light, or a pass."""
    if name in ("captured", "relit"):
        curve = linear_to_srgb if name == "captured" else displayed  # as the photograph, as the stage
        return over(np.clip(with_alpha(passes["Combined"], curve), 0, 1), ground())
    values = linear_to_srgb(passes[name]) if name == "Albedo" else passes[name]
    values = 0.5 + 0.5 * values if name == "Normal" else values
    return over(covered(values, passes["Coverage"]), ground())


def turntable(out: Path) -> Iterator[np.ndarray]:
    """The photograph becomes the robot; its materials are wiped over it; then the light turns."""
    parts = [("captured", 1), ("Albedo", CAPTURED + 1), ("Roughness", CAPTURED + 12), ("Normal", CAPTURED + 23)]
    parts.append(("relit", ROUND - 2))
    *_, photograph = photographs()
    x = np.linspace(0, 1, SIZE[0])[None, :, None]
    for number in range(1, TURN + 1):
        passes = read_frame(out / "turntable" / f"{number:04d}.exr")[0]
        index = max(i for i, (_, first) in enumerate(parts) if first <= number)
        name, first = parts[index]
        picture = shown(passes, name)
        since = number - first
        if index and since < 8:  # a soft edge runs from the left to the right
            edge = np.clip(((since + 1) / 8 * 0.6 + 0.2 - x) / 0.02 + 0.5, 0, 1)
            picture = mix(shown(passes, parts[index - 1][0]), picture, edge)
        if not index and since < _DISSOLVE:
            picture = mix(photograph, picture, ease((since + 1) / _DISSOLVE))
        last = parts[index + 1][1] if index + 1 < len(parts) else TURN + 1
        yield titled(picture, WORDS[name], min(ease((since + 1) / 4), ease((last - number) / 4)))


def stage(out: Path) -> Iterator[np.ndarray]:
    """The shots, cut."""
    for name, (first, last) in SHOTS.items():
        for number in range(first, last + 1):
            picture = displayed(combined(out / name / f"{number:04d}.exr")[..., :3])
            yield titled(picture, WORDS[name], min(ease((number - first + 1) / 4), ease((last + 1 - number) / 4)))


def end(last: np.ndarray) -> Iterator[np.ndarray]:
    """The name, over the last picture gone dark."""
    sheet = Image.new("L", SIZE)
    draw = ImageDraw.Draw(sheet)
    draw.text((SIZE[0] / 2, SIZE[1] / 2), WORDS["end"], 255, ImageFont.load_default(40), anchor="mm")
    words = np.asarray(sheet, np.float32)[..., None] / 255
    for i in range(_END):
        dark = last * (1 - ease(i / 10))
        yield mix(dark, np.asarray(INK) / 255, words * ease((i - 3) / 10) * ease((_END - i) / 6))


def film(out: Path) -> list[np.ndarray]:
    """All pictures of the film, (h, w, 3) 8-bit sRGB."""
    pictures = [*photographs(), *turntable(out), *stage(out)]
    return [to_bytes(picture) for picture in (*pictures, *end(pictures[-1]))]


def publish(pictures: Sequence[np.ndarray], folder: Path) -> None:
    """Write film.webm (VP9) and the smaller film.webp, which pages show."""
    import av

    with av.open(folder / "film.webm", "w") as file:
        stream = file.add_stream("libvpx-vp9", rate=FPS)
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "24", "b": "0", "row-mt": "1", "cpu-used": "2"}
        for picture in pictures:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode())
    small = [Image.fromarray(p).resize((480, 270), Image.Resampling.LANCZOS) for p in pictures]
    save_animation(folder / "film.webp", small, FPS, quality=72)


def run(out: Path, folder: Path, cut: bool) -> None:
    """Render what is missing unless this is the `cut` alone, and write the film to a folder.

    Raises
    ------
    StepFailed
    """
    if importlib.util.find_spec("av") is None:  # before half an hour of rendering
        raise StepFailed("the encoder of film.webm is missing, the package av; `make env` installs it")
    check_folder("--out", out)
    check_folder("--publish", folder)
    if not cut:
        run_all(steps(out), out)
    if absent := missing(out):
        first = absent[0].relative_to(out)
        raise StepFailed(
            f"{len(absent)} frames are missing in {out}, the first is {first}; without --cut they are rendered"
        )
    publish(film(out), folder)
    print(f"Look at film.webm and film.webp in {folder}")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "film", help="scenes and frames")
    parser.add_argument("--publish", type=Path, help="folder of the film; default that of --out")
    parser.add_argument("--cut", action="store_true", help="only the film, of the frames that are there")
    options = parser.parse_args(arguments)
    out = options.out.resolve()
    folder = (options.publish or out).resolve()
    return exit_code("film", "examples/demo_film.py", partial(run, out, folder, options.cut))


if __name__ == "__main__":
    sys.exit(main())
