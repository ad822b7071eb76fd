"""Streamed SOG: the finest level of its chunks, by the published layout; damaged ones are refused by name."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from splat_files import damaged, random_splats
from test_formats_others import needs, splat_transform

from drgs_blender.cli.main import main
from drgs_blender.core.errors import AssetError
from drgs_blender.formats.registry import find_format, read_surfels
from drgs_blender.formats.sog_writer import write_sog
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import Splats


def cloud(n: int, x: float, coefficients: int = 4) -> Splats:
    """Splats around a place on the X axis."""
    splats = random_splats(n, coefficients, seed=n)
    splats.centre[:, 0] = x + splats.centre[:, 0] / 100
    return splats


def write_chunk(folder: Path, splats: Splats) -> None:
    """A SOG that is not bundled."""
    folder.mkdir(parents=True)
    write_sog(folder / "bundle.sog", splats)
    with zipfile.ZipFile(folder / "bundle.sog") as archive:
        archive.extractall(folder)
    (folder / "bundle.sog").unlink()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Two leaves; the finest level has 30 splats at 0 and 40 at 10, in files of 50 and 20, the coarser one 5 and 6."""
    write_chunk(tmp_path / "0_0", cloud(50, 0))
    write_chunk(tmp_path / "0_1", cloud(20, 10, 1))
    write_chunk(tmp_path / "1_0", cloud(11, 20))
    write_chunk(tmp_path / "env", cloud(7, 100))
    bound = {"min": [-1, -1, -1], "max": [1, 1, 1]}

    def leaf(*rows: tuple[str, int, int, int]) -> dict:
        return {"bound": bound, "lods": {k: {"file": f, "offset": o, "count": c} for k, f, o, c in rows}}

    first = leaf(("0", 0, 0, 30), ("1", 2, 0, 5))
    second = {"bound": bound, "children": [leaf(("0", 0, 30, 20), ("1", 2, 5, 6)), leaf(("0", 1, 0, 20))]}
    meta = {
        "version": 1, "asset": {"generator": "a test"}, "count": 81, "counts": [70, 11], "lodLevels": 2,
        "environment": "env/meta.json", "filenames": ["0_0/meta.json", "0_1/meta.json", "1_0/meta.json"],
        "tree": {"bound": bound, "children": [first, second]},
    }  # fmt: skip
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    return tmp_path / "lod-meta.json"


def change(path: Path, edit: Callable[[dict], Any]) -> None:
    meta = json.loads(path.read_text())
    edit(meta)
    path.write_text(json.dumps(meta))


def test_the_finest_level_is_read(scene: Path) -> None:
    assert find_format(scene).name == "streamed SOG"
    file = read_surfels(scene)
    assert file.layout == "streamed SOG" and len(file.surfels) == 70
    for rows, folder in ((slice(0, 50), "0_0"), (slice(50, 70), "0_1")):
        chunk = read_surfels(scene.parent / folder / "meta.json").surfels
        np.testing.assert_allclose(file.surfels.centre[rows], chunk.centre, atol=1e-6)
        np.testing.assert_allclose(file.surfels.scale[rows], chunk.scale, rtol=1e-5)
        np.testing.assert_array_equal(file.surfels.sh[rows, : chunk.sh.shape[1]], chunk.sh)
    assert not file.surfels.sh[50:, 1:].any()  # one of the files has no harmonics
    assert any("level of detail 0 of 2" in note and "2 files" in note for note in file.notes)
    assert any("env/meta.json can be imported by itself" in note for note in file.notes)


def test_only_the_rows_that_leaves_name_are_read(scene: Path) -> None:
    def edit(meta: dict) -> None:
        meta["tree"]["children"] = [
            {"lods": {"0": {"file": 0, "offset": 40, "count": 5}}},
            {"lods": {"0": {"file": 0, "offset": 3, "count": 4}}},
        ]
        meta["counts"] = [9, 0]

    change(scene, edit)
    whole = read_surfels(scene.parent / "0_0" / "meta.json").surfels
    found = read_surfels(scene).surfels
    np.testing.assert_allclose(found.centre, whole.centre[[3, 4, 5, 6, 40, 41, 42, 43, 44]], atol=1e-6)


def test_older_ones_and_those_without_a_finest_level_are_read(scene: Path) -> None:
    def edit(meta: dict) -> None:
        for name in ("version", "count", "counts", "environment"):
            del meta[name]

    change(scene, edit)
    assert len(read_surfels(scene).surfels) == 70
    change(scene, lambda meta: meta.update(tree={"lods": {"1": {"file": 2, "offset": 0, "count": 11}}}))
    file = read_surfels(scene)
    assert len(file.surfels) == 11 and any("level of detail 1 of 2" in note for note in file.notes)
    other = scene.with_name("index.json")
    other.write_bytes(scene.read_bytes())
    assert find_format(other).name == "streamed SOG"


def leaf_of(meta: dict) -> dict:
    return meta["tree"]["children"][0]["lods"]["0"]


DAMAGE: dict[str, tuple[Callable[[dict], Any], str]] = {
    "another version": (lambda m: m.update(version=2), "of version 2; 1 is read"),
    "no levels": (lambda m: m.update(lodLevels=0), "has 0 levels"),
    "levels in words": (lambda m: m.update(lodLevels="many"), "has many levels"),
    "no files": (lambda m: m.update(filenames=None), "no list of filenames"),
    "files that are none": (lambda m: m.update(filenames=[1, 2, 3]), "no list of filenames"),
    "no tree": (lambda m: m.pop("tree"), "damaged tree"),
    "a child that is none": (lambda m: m["tree"].update(children=[None]), "damaged tree"),
    "children that are none": (lambda m: m["tree"].update(children=3), "damaged tree"),
    "leaves that are none": (lambda m: m["tree"].update(lods=[1]), "damaged tree"),
    "an empty tree": (lambda m: m.update(tree={}), "names no splats"),
    "a file beyond": (lambda m: leaf_of(m).update(file=3), "level '0' names no rows"),
    "a negative offset": (lambda m: leaf_of(m).update(offset=-1), "level '0' names no rows"),
    "a count of halves": (lambda m: leaf_of(m).update(count=1.5), "level '0' names no rows"),
    "no count": (lambda m: leaf_of(m).pop("count"), "level '0' names no rows"),
    "a level beyond": (lambda m: m["tree"].update(lods={"9": leaf_of(m)}), "level '9' names no rows"),
    "a level in words": (lambda m: m["tree"].update(lods={"x": leaf_of(m)}), "level 'x' names no rows"),
    "rows beyond": (lambda m: (leaf_of(m).update(offset=10**18), m.pop("counts")), "that its 50 splats do not have"),
    "rows twice": (lambda m: (leaf_of(m).update(count=31), m.pop("counts")), "overlap"),
    "another count": (lambda m: m.update(counts=[71, 11]), "70 splats of level 0, other than it says"),
    "a file elsewhere": (lambda m: m["filenames"].__setitem__(0, "../0_0/meta.json"), "no file below it"),
    "an absolute name": (lambda m: m["filenames"].__setitem__(0, "/etc/passwd"), "no file below it"),
    "no such file": (lambda m: m["filenames"].__setitem__(0, "9_9/meta.json"), "9_9/meta.json: cannot be read"),
    "a folder": (lambda m: m["filenames"].__setitem__(0, "0_0"), "0_0: is not a regular file"),
    "a name without end": (lambda m: m["filenames"].__setitem__(0, "x" * 5000), "cannot be read"),
    "no name": (lambda m: m["filenames"].__setitem__(0, "a\0b"), "no file below it"),
    "one file by two names": (
        lambda m: (m["filenames"].__setitem__(1, "./0_1/../0_0/meta.json"), m.pop("counts")),
        "overlap",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_what_does_not_fit_is_refused_by_name(scene: Path, damage: str) -> None:
    edit, reason = DAMAGE[damage]
    change(scene, edit)
    with pytest.raises(AssetError, match=reason) as caught:
        read_surfels(scene)
    assert str(scene) in str(caught.value)


def test_a_deep_tree_is_no_matter_and_a_damaged_chunk_is_named(scene: Path) -> None:
    text = scene.read_text()
    meta = json.loads(text)
    tree = json.dumps(meta["tree"])
    deep = '{"children": [' * 300 + tree + "]}" * 300
    scene.write_text(text.replace(tree, deep))
    assert len(read_surfels(scene).surfels) == 70
    scene.write_text(text.replace(tree, '{"children": [' * 100_000 + tree + "]}" * 100_000))
    with pytest.raises(AssetError, match=r"lod-meta\.json: is a damaged index"):
        read_surfels(scene)
    scene.write_text(text)
    (scene.parent / "0_1" / "quats.webp").write_bytes(b"RIFF")
    with pytest.raises(AssetError, match=r"lod-meta\.json, 0_1/meta\.json"):
        read_surfels(scene)
    (scene.parent / "0_1" / "quats.webp").unlink()
    with pytest.raises(AssetError, match=r"lod-meta\.json, 0_1/meta\.json: needs quats\.webp"):
        read_surfels(scene)


def test_damaged_indices_are_refused_or_read_sensibly(scene: Path) -> None:
    data, rng, refused = scene.read_bytes(), np.random.default_rng(6), 0
    for _ in range(150):
        scene.write_bytes(damaged(data, rng))
        try:
            surfels = read_surfels(scene).surfels
        except AssetError as error:
            assert str(scene) in str(error)
            refused += 1
        else:
            assert np.isfinite(surfels.centre).all()
    assert refused > 50


def test_convert_reads_it(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(scene), str(tmp_path / "a.ply")]) == 0
    assert "70 splats" in capsys.readouterr().out
    assert len(read_surfels(tmp_path / "a.ply").surfels) == 70


@pytest.mark.slow
@needs("@playcanvas/splat-transform")
def test_we_read_what_splat_transform_writes(tmp_path: Path) -> None:
    """Two levels and an environment: all splats of the first, near where they were."""
    splats = random_splats(600)
    levels: list[Path | str] = []
    for level, content in (("0", splats), ("1", random_splats(50, seed=5)), ("-1", random_splats(9, seed=6))):
        write_splat_ply(tmp_path / f"{level}.ply", content)
        levels += [tmp_path / f"{level}.ply", "-l", level]
    (tmp_path / "scene").mkdir()
    splat_transform(*levels, tmp_path / "scene" / "lod-meta.json")
    file = read_surfels(tmp_path / "scene" / "lod-meta.json")
    assert file.layout == "streamed SOG" and len(file.surfels) == 600
    assert any("level of detail 0 of 2" in note for note in file.notes)
    assert any("environment is left out" in note for note in file.notes)
    apart, order = cKDTree(file.surfels.centre).query(splats.centre)
    assert len(np.unique(order)) == 600 and apart.max() < 0.01
    np.testing.assert_allclose(file.surfels.opacity[order], splats.opacity, atol=0.005)
