"""Settings of a reconstruction: every one has a name, limits and a description, in files, options and assets."""

from __future__ import annotations

import dataclasses
import json
import sys
import tomllib
from pathlib import Path

import pytest

pytest.importorskip("torch")

from capture_cases import balls, write
from published_sets import light, object_asset

from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import inspect_asset, read_asset
from drgs_blender.core.errors import UsageError
from drgs_blender.core.file_types import CAMERAS
from drgs_blender.formats.axes import UP_AXES
from drgs_blender.reconstruct.inverse_rendering.settings import Settings as Decoupling
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.settings import Reading, Settings
from drgs_blender.reconstruct.settings_file import as_toml, flat
from drgs_blender.reconstruct.settings_table import as_tables, table, with_values

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))

import settings_page  # noqa: E402


def printed(capsys, *words: str) -> dict:
    """Settings by name, as `drgs reconstruct --print-settings` prints them."""
    assert main(["reconstruct", "--print-settings", *words]) == 0
    return flat(tomllib.loads(capsys.readouterr().out))


def refused(capsys, *words: str) -> str:
    """What is said of settings that cannot be used."""
    assert main(["reconstruct", "--print-settings", *words]) == 64
    return capsys.readouterr().err


def another(row) -> object:
    """A value of a row that is not its default."""
    rule = row.allowed
    if rule.items is not None:
        return [0.2, 0.5] if rule.type is float else [rule.choices[0]]
    if rule.choices:
        return next(choice for choice in rule.choices if choice != row.default)
    if rule.type is bool:
        return not row.default
    if rule.type is str:
        return "a text"
    low, high = rule.range.low, min(rule.range.high, 1e6)
    values = [low, high, low + 2, 32]
    return next(v for v in (rule.type(value) for value in values) if v in rule.range and v != row.default)


def test_every_field_has_a_row_with_a_description_and_limits_that_hold_its_default():
    expected = {f.name for f in dataclasses.fields(Settings)} - {"schedule", "decoupling"}
    for stage, part in {"capture": Reading, "schedule": Schedule, "decoupling": Decoupling}.items():
        expected |= {f"{stage}.{field.name}" for field in dataclasses.fields(part)}
    assert set(table()) == expected
    for row in table().values():
        assert row.about and not row.allowed.problem(row.default), row.name
    assert table()["capture.axes"].allowed.choices == tuple(CAMERAS)
    assert table()["capture.up"].allowed.choices == tuple(UP_AXES)
    Settings().check()


def test_each_setting_goes_through_toml_to_its_field_and_no_other():
    for row in table().values():
        changed = with_values(Settings(), Reading(), {row.name: another(row)})
        text = as_toml(*changed)
        assert with_values(Settings(), Reading(), flat(tomllib.loads(text))) == changed
        before, after = (flat(as_tables(*both)) for both in ((Settings(), Reading()), changed))
        assert {name for name in before if before[name] != after[name]} == {row.name}, row.name


def test_what_is_printed_can_be_given_again(tmp_path, capsys):
    words = ["--variant", "m", "--time-budget", "3", "--set", "schedule.densify=[0.1, 0.4]", "--set", "device=cuda"]
    first = printed(capsys, *words, "--resolution", "200", "--no-materials")
    changed = {"variant": "m", "minutes": 3.0, "materials": False, "device": "cuda", "capture.resolution": 200}
    changed["schedule.densify"] = [0.1, 0.4]
    assert first == printed(capsys) | changed
    assert main(["reconstruct", "--print-settings", *words, "--resolution", "200", "--no-materials"]) == 0
    file = tmp_path / "all.toml"
    file.write_bytes(b"\xef\xbb\xbf" + capsys.readouterr().out.replace("\n", "\r\n").encode())  # as Notepad saves it
    assert printed(capsys, "--config", str(file)) == first
    # Options and --set come before the file.
    assert printed(capsys, "--config", str(file), "--variant", "p", "--set", "minutes=none") == first | {
        "variant": "p",
        "minutes": "none",
    }


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("schedule.iteration=5", "the nearest is schedule.iterations"),
        ("iterations=5", "the nearest is schedule.iterations or decoupling.iterations"),
        ("metal_albedo_prio=0", "the nearest is decoupling.metal_albedo_prior"),
        ("zebra=1", "zebra: is no setting of a reconstruction. `drgs"),
        ("schedule.iterations=0", "is 0, not a whole number from 1 to 10000000"),
        ("schedule.iterations=1.5", "is 1.5, not a whole number from"),
        ("schedule.iterations=true", "is True, not a whole number"),
        ("schedule.surfels=many", "is 'many', not a whole number"),
        ("decoupling.environment=48", "is 48, not a whole number from 8 to 1024, a power of two"),
        ("decoupling.cosine=3", "from 0 to 4096, even"),
        ("decoupling.rate=nan", "is nan, not a number of at least 0"),
        ("decoupling.rate=-1", "is -1, not a number of at least 0"),
        ("decoupling.normals=1", "is 1, not true or false"),
        ("variant=x", """is 'x', not "p" or "m\""""),
        ("capture.up=w", '"-y" or "none"'),
        ("schedule.densify=[0.5]", "not a list of 2, each a number from 0 to 1"),
        ("schedule.densify=[0.5, 2]", "is 2, not a number from 0 to 1"),
        ("schedule.densify=[0.5, 0.5]", "ends at 0.5 of the steps and begins at 0.5"),
        ('fixed=["tint"]', '''is 'tint', not "offset" or "opacity"'''),
        ("schedule=5", "schedule: is no setting"),
        ("variant", "is not NAME=VALUE"),
        (f"decoupling.rate=1{400 * '0'}", "not a number of at least 0"),
        (f"schedule.iterations=0x{4000 * 'f'}", "is too long to be shown, not a whole number from 1"),
        (f"schedule.densify=[0.5, 1{400 * '0'}]", "not a number from 0 to 1"),
        (f"schedule.densify={3000 * '['}0{3000 * ']'}", "..., not a list of 2"),
    ],
)
def test_what_cannot_be_used_is_refused_with_what_may_be(capsys, given, said):
    assert said in refused(capsys, "--set", given)


def test_contradictions_are_refused(capsys):
    assert "also by --iterations" in refused(capsys, "--iterations", "5", "--set", "schedule.iterations=6")
    assert "also by --set" in refused(capsys, "--set", "variant=m", "--set", "variant=p")
    assert "minutes" in refused(capsys, "--set", "decoupling.seconds=5", "--time-budget", "1")
    none = [part for name in ("cosine", "ggx", "light") for part in ("--set", f"decoupling.{name}=0")]
    assert "no direction would be drawn" in refused(capsys, *none)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"variant = ", "is not TOML"),
        (b"[schedule]\niterations = 5\n[schedule]\n", "is not TOML"),
        (b"\xff\xfev\0", "is not UTF-8 text"),
        (b"[schedul]\niterations = 5", "the nearest is schedule.iterations"),
        (b"[schedule.iterations]\nx = 5", "schedule.iterations.x: is no setting"),
        (b"[schedule]\niterations = 2024-01-01", "not a whole number"),
        (b"schedule.iterations = 1" + 400 * b"0", "not a whole number from 1"),
        (b"fixed = " + 3000 * b"[" + 3000 * b"]", "is not TOML"),
        (3000 * b"a." + b"b = 1", "is not TOML"),
        (b"#" * ((1 << 20) + 1), "more than"),
    ],
)
def test_files_that_are_no_settings_are_named(tmp_path, capsys, content, said):
    file = tmp_path / "a.toml"
    file.write_bytes(content)
    text = refused(capsys, "--config", str(file))
    assert said in text and str(file) in text


def test_files_that_are_not_there(tmp_path, capsys):
    assert "is not there" in refused(capsys, "--config", str(tmp_path / "none.toml"))
    assert "is a folder" in refused(capsys, "--config", str(tmp_path))
    assert main(["reconstruct", "--config", str(tmp_path / "none.drgs"), "--print-settings"]) == 65
    assert main(["reconstruct", "--out", str(tmp_path / "a.drgs")]) == 64
    assert "needs CAPTURE and --out" in capsys.readouterr().err


def test_the_asset_keeps_its_settings_and_a_run_can_be_repeated_from_it(tmp_path, capsys):
    photographs = tmp_path / "balls"
    photographs.mkdir()
    write(balls(8, 32), photographs)
    first, second = tmp_path / "first.drgs", tmp_path / "second.drgs"
    words = ["--voxels", "16", "--resolution", "30", "--test-every", "4", "--no-materials"]
    words += ["--set", "schedule.iterations=4", "--set", "schedule.surfels=300", "--set", "fixed=['offset']"]
    assert main(["reconstruct", str(photographs), "--out", str(first), *words]) == 0
    assert "fixed: no effect with the other settings" in capsys.readouterr().err
    kept = inspect_asset(first)["provenance"]["settings"]
    assert kept["schedule"]["iterations"] == 4 and kept["capture"]["resolution"] == 30 and kept["fixed"] == ["offset"]
    assert printed(capsys, "--config", str(first)) == printed(capsys, *words)
    assert main(["inspect", "--all", str(first)]) == 0
    assert "mesh_resolution: 16" in capsys.readouterr().out
    assert main(["reconstruct", str(photographs), "--out", str(second), "--config", str(first)]) == 0
    assert first.read_bytes() == second.read_bytes()
    asset = read_asset(first)
    del asset.provenance["settings"]
    from drgs_blender.core.asset.container import write_asset

    write_asset(second, asset)
    assert "holds no settings" in refused(capsys, "--config", str(second))


def test_masks_are_a_setting_that_the_asset_keeps(tmp_path, capsys, monkeypatch):
    photographs, modes = tmp_path / "balls", []
    photographs.mkdir()
    write(balls(8, 32), photographs)
    asset = object_asset(light(1))
    asset.provenance |= {"report": {"steps": {}}, "settings": {}}
    monkeypatch.setattr("drgs_blender.reconstruct.pipeline.reconstruct", lambda *_: asset)
    monkeypatch.setattr("drgs_blender.capture.masks.of_capture.mask_capture", lambda _, mode, *__: modes.append(mode))
    words = ["reconstruct", str(photographs), "--out", str(tmp_path / "a.drgs")]
    assert main([*words, "--masks", "none"]) == 0
    again = ["reconstruct", str(photographs), "--out", str(tmp_path / "b.drgs"), "--config", str(tmp_path / "a.drgs")]
    assert main(again) == 0 and main([*again, "--masks", "auto"]) == 0 and main(words) == 0
    assert modes == ["none", "none", "auto", "given"]
    # Of photographs without cameras, too.
    for file in photographs.glob("*.json"):
        file.unlink()

    def capture(_, __, settings, *rest):
        modes.append(settings.masks)
        raise UsageError("capture", "is not made")

    monkeypatch.setattr("drgs_blender.capture.pipeline.make_capture", capture)
    monkeypatch.setattr("drgs_blender.capture.pictures.has_pictures", lambda _: True)
    assert main([*words, "--set", "capture.masks=auto"]) == 64 and modes[4:] == ["auto"]
    # With views left out they are made later, of the others.
    assert main([*words, "--masks", "auto", "--test-every", "4"]) == 64 and modes[5:] == ["given"]


def test_repeated_photographs_with_cameras_are_told_before_the_long_work(tmp_path, capsys, monkeypatch):
    photographs = tmp_path / "balls"
    photographs.mkdir()
    write(balls(8, 32), photographs)
    (photographs / "005.png").write_bytes((photographs / "003.png").read_bytes())

    def reconstruct(capture, *_):
        assert len(capture.views) == 8 and "show the same as another one" in (said := capsys.readouterr().err)
        assert "005 (003)" in said
        raise UsageError("reconstruct", "is not tried")

    monkeypatch.setattr("drgs_blender.reconstruct.pipeline.reconstruct", reconstruct)
    assert main(["reconstruct", str(photographs), "--out", str(tmp_path / "a.drgs")]) == 64
    assert "is not tried" in capsys.readouterr().err


def test_settings_of_python_are_checked_too():
    with pytest.raises(UsageError, match=r"schedule\.surfels: is 5, not a whole number from 10"):
        Settings(schedule=Schedule(surfels=5)).check()
    changed = Settings(materials=False, decoupling=Decoupling(normals=True, exposure=True))
    assert changed.without_effect() == ["decoupling.exposure"] and not Settings().without_effect()


@pytest.mark.parametrize(
    ("more", "idle"),
    [
        ({"unbiased": False, "weight_by_prediction": False}, ["weight_by_prediction"]),
        ({"weight_by_prediction": False, "clipped_neighbour_weight": 1.0}, ["clipped_neighbour_weight"]),
        ({"parametrisation": "dielectric", "metal_smoothness": 1.0}, ["metal_smoothness"]),
        ({"normals": False, "normal_smoothness": 1.0}, ["normal_smoothness"]),
        ({"shadows": False, "indirect": False}, ["indirect"]),
    ],
)
def test_settings_that_another_one_makes_idle_are_named(more, idle):
    run = Settings(decoupling=Decoupling(**{"normals": True} | more))
    assert run.without_effect() == [f"decoupling.{name}" for name in idle]
    for name in idle:  # alone it has one
        alone = Decoupling(**{"normals": True, name: more[name]})
        assert not Settings(decoupling=alone).without_effect()
    assert Settings(schedule=Schedule(median=0.5, consistency=0.0)).without_effect() == ["schedule.median"]


def test_the_page_lists_every_setting():
    page = settings_page.PAGE.read_text(encoding="utf-8")
    assert page == settings_page.page(), "run tools/settings_page.py"
    assert all(f"| `{name}` | `{json.dumps('none' if row.default is None else row.default)}`" in page
               for name, row in table().items())  # fmt: skip
