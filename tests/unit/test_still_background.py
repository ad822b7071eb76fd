"""An object that turned before a camera that stood still: what is behind it, and where it may be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, gaussian_filter, shift

cv2 = pytest.importorskip("cv2", reason="needs OpenCV, the extra capture")

from drgs_blender.capture.masks.still_background import find_still_background  # noqa: E402
from drgs_blender.core.errors import Cancelled  # noqa: E402

HEIGHT, WIDTH, COUNT = 180, 240, 16


def texture(seed: int, shape=(HEIGHT, WIDTH), mean: float = 120.0) -> np.ndarray:
    """(h, w, 3): patches of colour, as of a room."""
    noise = np.random.default_rng(seed).normal(size=(*shape, 3))
    smooth = gaussian_filter(noise, (3, 3, 0))
    return (mean + 35 * smooth / smooth.std()).clip(0, 255)


def ellipse(angle: float, middle=(90, 120)) -> np.ndarray:
    """(h, w) bool: the silhouette of a body that is longer than wide, turned about the upright axis."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    width = 30 + 15 * np.cos(2 * angle)
    return ((rows - middle[0]) / 54) ** 2 + ((columns - middle[1] - 7 * np.sin(angle)) / width) ** 2 < 1


def photographs(turns: bool = True, shake: float = 0.0, exposures: bool = False):
    """Pictures by name, the room without the object as each shows it, and where the object is in each."""
    room, skin = texture(0), texture(1, (HEIGHT, 4 * WIDTH), 70.0)
    random = np.random.default_rng(2)
    pictures, rooms, masks = {}, {}, {}
    for k in range(COUNT):
        angle = 2 * np.pi * k / COUNT if turns else 0.0
        inside = ellipse(angle)
        turned = np.roll(skin, round(angle / (2 * np.pi) * 4 * WIDTH), axis=1)[:, :WIDTH]
        picture = np.where(inside[..., None], turned, room)
        moved = random.normal(size=2) * shake
        gain = 1 + 0.2 * np.sin(k) if exposures else 1.0

        def seen(values: np.ndarray, moved=moved, gain=gain) -> np.ndarray:
            return (gain * shift(values, (*moved, 0), order=1, mode="nearest")).clip(0, 255).round().astype(np.uint8)

        pictures[f"{k}.jpg"], rooms[f"{k}.jpg"] = seen(picture), seen(room)
        masks[f"{k}.jpg"] = shift(inside.astype(float), moved, order=1) > 0.5
    return pictures, rooms, masks


def found_in(pictures):
    return find_still_background(cv2, pictures, lambda *_: None, lambda: False)


@pytest.mark.parametrize("way", [{}, {"shake": 2.5}, {"exposures": True}])
def test_what_turned_is_inside_and_the_room_is_behind(way):
    pictures, rooms, masks = photographs(**way)
    found = found_in(pictures)
    assert set(found.behind) == set(found.turned) == set(pictures)
    for name, inside in masks.items():
        assert found.turned[name][inside].mean() > 0.97
        assert found.turned[name][~binary_dilation(inside, iterations=6)].mean() < 0.1
        # where the room is seen past the object in half of the pictures, it is known
        often = np.mean(list(masks.values()), axis=0) < 0.5
        off = np.abs(found.behind[name].astype(float) - rooms[name]).max(axis=-1)
        assert np.median(off[often]) < 6


def test_the_object_is_not_taken_for_what_is_behind_it():
    """Also in its middle, which no picture shows without it."""
    pictures, rooms, masks = photographs()
    found = found_in(pictures)
    always = np.all(list(masks.values()), axis=0)
    dark = np.mean([found.behind[name][always].mean() for name in pictures])
    room = np.mean([rooms[name][always].mean() for name in pictures])
    skin = np.mean([pictures[name][always].mean() for name in pictures])
    assert abs(dark - room) < abs(dark - skin)


def test_a_pattern_in_the_objects_moving_shadow_is_what_is_behind():
    """Its features would hold all pictures together as those of one that did not turn."""
    pictures, _, masks = photographs()
    pattern = np.random.default_rng(3).uniform(40, 220, (HEIGHT // 3, WIDTH // 3, 3)).repeat(3, 0).repeat(3, 1)
    anywhere = np.any(list(masks.values()), axis=0)
    floor, shadow = np.zeros((2, HEIGHT, WIDTH), bool)
    floor[105:160, 80:228], shadow[110:155, 90:220] = True, True
    for k, (name, inside) in enumerate(masks.items()):
        shade = np.where(shadow, 0.5 if k % 3 else 0.8, 1.0)[..., None]
        pictures[name] = np.where((floor & ~inside)[..., None], shade * pattern, pictures[name]).astype(np.uint8)
    found = found_in(pictures)
    beside = shadow & ~binary_dilation(anywhere, iterations=6)
    assert np.median([found.turned[name][beside].mean() for name in pictures]) < 0.2
    assert min(found.turned[name][inside].mean() for name, inside in masks.items()) > 0.95


def test_nothing_is_found_where_nothing_turned():
    assert found_in(photographs(turns=False)[0]) is None


def test_a_picture_of_something_else_is_left_out():
    pictures = photographs()[0] | {"other.jpg": texture(9, mean=200.0).astype(np.uint8)}
    found = found_in(pictures)
    assert "other.jpg" not in found.behind and len(found.behind) == COUNT


def test_it_can_be_cancelled():
    with pytest.raises(Cancelled):
        find_still_background(cv2, photographs()[0], lambda *_: None, lambda: True)
