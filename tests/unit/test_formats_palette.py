"""Codebooks and palettes, and the SOG files that are made of them."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from splat_files import covariance, random_splats

from drgs_blender.core.errors import UsageError
from drgs_blender.formats.palette import codebook, palette
from drgs_blender.formats.registry import find_format, read_surfels
from drgs_blender.formats.sog_writer import write_sog
from drgs_blender.formats.splats import Splats


def test_a_codebook_is_nearly_the_best_and_its_indices_are_the_nearest() -> None:
    """Of a normal distribution the best 256 numbers leave sqrt(3) pi / 2 / 256^2 of its variance (Panter and Dite)."""
    values = np.random.default_rng(1).normal(size=(100_000, 3)).astype(np.float32)
    book, index = codebook(values)
    assert book.dtype == np.float32 and index.dtype == np.uint8 and (np.diff(book) >= 0).all()
    error = values - book[index]
    assert np.square(error).mean() < 1.1 * np.sqrt(3) * np.pi / 2 / 256**2
    nearest = np.abs(values[:500, :, None] - book).min(axis=2)
    np.testing.assert_allclose(np.abs(error[:500]), nearest, atol=2e-4)


@pytest.mark.parametrize("values", [np.zeros((0, 3)), np.full((5, 3), 7.5), np.array([[-1.0, 4.0]])])
def test_a_codebook_of_few_values_is_exact(values: np.ndarray) -> None:
    book, index = codebook(values.astype(np.float32))
    np.testing.assert_allclose(book[index], values, atol=1e-6)


def test_a_palette_finds_the_clusters() -> None:
    rng = np.random.default_rng(2)
    centres = rng.normal(size=(300, 9)).astype(np.float32)
    which = rng.integers(0, 300, 20_000)
    rows = centres[which] + rng.normal(scale=1e-3, size=(20_000, 9)).astype(np.float32)
    entries, index = palette(rows, 512)
    assert len(entries) == 512
    assert np.abs(rows - entries[index]).max() < 0.02
    whole, same = palette(rows[:40], 512)
    np.testing.assert_array_equal(whole[same], rows[:40])
    alone, _ = palette(np.ones((1000, 3), np.float32), 16)  # nothing can be cut
    np.testing.assert_array_equal(alone, np.ones((1, 3)))


def in_order(splats: Splats, centre: np.ndarray) -> np.ndarray:
    """For each splat, where it is in a file: SOG sorts them."""
    apart = np.abs(splats.centre[:, None] - centre[None]).max(axis=2)
    assert len(np.unique(apart.argmin(axis=1))) == len(splats)
    return apart.argmin(axis=1)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_sog_loses_what_the_documentation_says(tmp_path: Path, coefficients: int) -> None:
    splats = random_splats(coefficients=coefficients)
    write_sog(tmp_path / "a.sog", splats)
    assert find_format(tmp_path / "a.sog").name == "SOG"
    back = read_surfels(tmp_path / "a.sog").surfels
    order = in_order(splats, back.centre)
    assert back.sh is not None and back.sh.shape == splats.sh.shape
    step = 2 * np.log(4) / 65535  # log(1 + x) of -3 to 3
    assert (np.abs(back.centre[order] - splats.centre) <= 0.51 * step * (1 + np.abs(splats.centre))).all()
    assert np.abs(back.opacity[order] - splats.opacity).max() <= 1 / 510 * 1.001
    turn = 2 * np.arccos(np.minimum(np.abs((back.rotation[order] * splats.rotation).sum(axis=1)), 1))
    assert turn.max() < np.radians(1.1)
    # 256 numbers for values spread evenly over `width` leave width / 256 / sqrt(12).
    for found, wanted, width in (
        (np.log(back.scale[order]), np.log(splats.scale[:, :2]), 8.0),
        (back.sh[order, :1], splats.sh[:, :1], 1.8),
        (back.sh[order, 1:], splats.sh[:, 1:], 1.8),
    ):
        assert np.sqrt(np.square(found - wanted).mean() if wanted.size else 0) < 1.2 * width / 256 / np.sqrt(12)


def test_many_harmonics_become_those_of_a_palette(tmp_path: Path) -> None:
    """As harmonics of captures do, these vary along few directions."""
    rng = np.random.default_rng(3)
    splats = random_splats(70_000, 4)
    along = rng.normal(scale=0.2, size=(70_000, 3)).astype(np.float32)
    splats.sh[:, 1:] = (along @ rng.normal(size=(3, 9)).astype(np.float32)).reshape(-1, 3, 3)
    write_sog(tmp_path / "a.sog", splats)
    back = read_surfels(tmp_path / "a.sog").surfels
    # The order by place is that of the first coordinates' bits; the sums do not depend on it.
    key = lambda sh, centre: np.lexsort(np.round(centre, 3).T)  # noqa: E731
    ours, theirs = key(splats.sh, splats.centre), key(back.sh, back.centre)
    close = np.abs(back.centre[theirs] - splats.centre[ours]).max(axis=1) < 1e-3
    assert close.mean() > 0.5
    error = (back.sh[theirs, 1:] - splats.sh[ours, 1:])[close]
    assert np.sqrt(np.square(error).mean()) < 0.06 * splats.sh[:, 1:].std()
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
    assert meta["count"] == 70_000 and meta["shN"]["bands"] == 1 and 60_000 < meta["shN"]["count"] <= 65536


def test_sog_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot hold 0 splats"):
        write_sog(tmp_path / "a.sog", random_splats(0))
    write_sog(tmp_path / "b.sog", random_splats(1))
    back = read_surfels(tmp_path / "b.sog").surfels
    np.testing.assert_allclose(back.centre, random_splats(1).centre, rtol=1e-5)


def test_sog_keeps_the_thickness(tmp_path: Path) -> None:
    splats = random_splats(100)
    write_sog(tmp_path / "a.sog", splats)
    back = read_surfels(tmp_path / "a.sog").surfels
    order = in_order(splats, back.centre)
    np.testing.assert_allclose(back.extras["thickness"][order], splats.scale[:, 2], rtol=0.05)
    wanted = covariance(splats.rotation, splats.scale[:, :2])
    found = covariance(back.rotation, back.scale)[order]
    assert np.abs(found - wanted).max(axis=(1, 2)).max() <= 0.1 * np.abs(wanted).max()
