"""The pictures that the demos make of what is rendered: the strip, the film, and how both show light."""

from __future__ import annotations

import importlib
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.engine.session import Session

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture(scope="module")
def demos():
    """The scripts, as modules."""
    before = list(sys.path)
    sys.path.insert(0, str(EXAMPLES))
    names = ("strip", "film", "shots", "pictures")
    yield SimpleNamespace(**{name: importlib.import_module(f"demo_{name}") for name in names})
    sys.path[:] = before


def test_highlights_roll_off_without_a_kink(demos):
    linear = np.linspace(0, 40, 400_001)
    shown = srgb_to_linear(demos.pictures.displayed(linear))
    below = linear <= demos.pictures.SHOULDER
    np.testing.assert_allclose(shown[below], linear[below], atol=1e-6, err_msg="as it is, below the shoulder")
    slope = np.diff(shown.astype(float)) / np.diff(linear)
    assert (slope > -1e-2).all() and slope[:9000].max() < 1.01, "never steeper, never back"
    assert shown.max() <= 1 and np.ptp(slope[4000:6000]) < 0.25


def test_what_is_bent_stands_where_it_stood_and_keeps_its_middle_as_long(demos):
    strip = demos.strip
    camera = strip.camera_of("robot")
    column = np.array([(0.0, 0.0, z) for z in np.linspace(-1, 2, 400)])
    moved = strip.bent(column, camera).astype(float)
    np.testing.assert_allclose(moved[0], column[0], atol=1e-6)
    length = np.linalg.norm(np.diff(moved, axis=0), axis=1).sum()
    assert length == pytest.approx(3.0, rel=1e-3)
    top = moved[-1] - moved[-2]
    lean = np.degrees(np.arccos(top[2] / np.linalg.norm(top)))
    assert lean == pytest.approx(strip.BEND, abs=0.5)
    assert moved[-1] @ camera.matrix_world[:3, 0] > 0.5, "to the right of the picture"
    np.testing.assert_allclose(strip.bent(column, camera, 1e-4), column, atol=1e-4)


@pytest.mark.parametrize("name", ["robot", "spot"])
def test_columns_show_one_view_and_passes_as_the_engine_has_them(demos, name):
    """The photograph's outline is that of the object in its camera."""
    strip = demos.strip
    settings = strip.SETTINGS
    strip.SETTINGS = type(settings)(samples=4, subpixel_samples=4, film_transparent=True)
    try:
        found = strip.views(name, Session())
    finally:
        strip.SETTINGS = settings
    columns = strip.columns(name, found)
    assert len(columns) == len(strip.COLUMNS)
    photograph, *rest, bent = columns
    inside = photograph[..., 3] > 0.5
    for column, label in zip(rest, strip.COLUMNS[1:]):
        seen = column[..., 3] > 0.5
        assert (seen & inside).sum() > 0.96 * (seen | inside).sum(), label
    seen = bent[..., 3] > 0.5
    assert (seen & inside).sum() < 0.9 * (seen | inside).sum(), "it is bent"
    albedo = columns[strip.COLUMNS.index("albedo")]
    np.testing.assert_allclose(srgb_to_linear(albedo[..., :3]), np.clip(found.relit["Albedo"], 0, 1), atol=1e-5)
    roughness = columns[strip.COLUMNS.index("roughness")]
    np.testing.assert_array_equal(roughness[..., 0], found.relit["Roughness"][..., 0])
    whole = photograph[..., 3] > 0.99
    likeness = [np.abs(photograph[..., :3] - np.clip(c[..., :3], 0, 1))[whole].mean() for c in (columns[1], columns[5])]
    assert likeness[0] < 0.7 * likeness[1], "in the learned light it is more like the photograph than in another"


def test_rows_of_the_strip_are_cut_alike(demos):
    """All pictures of a row lose the same margins, so that they stay one view."""
    strip = demos.strip
    row = []
    for i in range(len(strip.COLUMNS)):
        picture = np.zeros((90, 90, 4), np.float32)
        picture[20 : 40 + 5 * i, 30:60] = (1, 0, 0, 1)
        row.append(picture)
    sheet = np.asarray(strip.strip([row]))
    red = (sheet == (255, 0, 0)).all(-1)
    width = sheet.shape[1] // len(row)
    tops, lefts = set(), set()
    for i in range(len(row)):
        ys, xs = np.nonzero(red[:, i * width : (i + 1) * width])
        assert len(ys) == (20 + 5 * i) * 30
        tops.add(ys.min())
        lefts.add(xs.min())
    assert len(tops) == len(lefts) == 1


def test_the_film_has_words_and_frames_for_every_part_and_begins_at_its_photograph(demos):
    film, shots = demos.film, demos.shots
    spans = list(shots.SHOTS.values())
    assert all(a[1] < b[0] for a, b in pairwise([(0, 0), *spans])) and all(a < b for a, b in spans)
    assert set(shots.SHOTS) < set(film.WORDS)
    named = [Path(part) for step in film.steps(Path("out")) for part in step.command]
    scripts = [path for path in named if path.suffix == ".py" and path.is_absolute()]
    assert scripts and all(path.is_file() for path in scripts)
    *_, last = film.photographs()
    chosen = Image.open(EXAMPLES / "captured" / "robot.png").convert("RGBA").resize((360, 360))
    inside = np.asarray(chosen)[..., 3] > 250
    shown = last[:, 140:500][inside]
    assert np.abs(shown - np.asarray(chosen)[..., :3][inside] / 255).mean() < 0.02
    sheet = np.asarray(Image.open(film.PICTURES / "photographs.webp").convert("RGB"), float) / 255
    side = sheet.shape[1] // 8
    rows, columns = np.divmod(np.arange(40), 8)
    cells = [sheet[y * side : (y + 1) * side, x * side : (x + 1) * side] for y, x in zip(rows, columns)]
    alone = film.over(np.asarray(chosen.resize((side, side)), float) / 255, np.asarray(film.GROUND) / 255)
    assert np.argmin([np.abs(cell - alone).mean() for cell in cells]) == film.CHOSEN


def test_frames_that_a_film_misses_are_told(demos, tmp_path, capsys):
    arguments = ["--cut", "--out", str(tmp_path), "--publish", str(tmp_path / "film")]
    first, last = list(demos.shots.SHOTS.values())[-1]
    for path in demos.film.missing(tmp_path)[: -(last - first)]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert demos.film.main(arguments) == 1
    told = capsys.readouterr().err
    assert f"{last - first} frames are missing" in told and f"{first + 1:04d}.exr" in told
    assert not list((tmp_path / "film").iterdir())


def test_passes_in_the_film_are_those_of_the_strip(demos):
    cover = np.ones((360, 640, 1), np.float32)
    albedo = np.random.default_rng(1).uniform(size=(360, 640, 3)).astype(np.float32)
    shown = demos.film.shown({"Albedo": albedo, "Coverage": cover}, "Albedo")
    np.testing.assert_allclose(shown, linear_to_srgb(albedo), atol=1e-6)


def test_the_film_that_is_shown_is_the_one_that_is_cut_now(demos):
    folder = EXAMPLES.parent / "docs" / "film"
    film, shots = demos.film, demos.shots
    cut = sum(1 for _ in film.photographs()) + shots.TURN + film._END
    cut += sum(last - first + 1 for first, last in shots.SHOTS.values())
    assert 20 <= cut / film.FPS <= 30
    seconds = 0.0
    with Image.open(folder / "film.webp") as shown:
        for i in range(shown.n_frames):
            shown.seek(i)
            shown.load()
            seconds += shown.info["duration"] / 1000
    assert seconds == pytest.approx(cut / film.FPS, rel=0.01)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 4 << 20
