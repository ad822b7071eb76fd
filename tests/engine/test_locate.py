"""Where the engine is looked for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drgs_blender.core.errors import DeviceError
from drgs_blender.ipc import locate
from drgs_blender.ipc.locate import VARIABLE, locate_engine


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """A folder laid out like a virtual environment."""
    folder = tmp_path / "venv"
    (folder / "bin").mkdir(parents=True)
    for name in ("python3", "drgs"):
        (folder / "bin" / name).write_text("#!/bin/sh\n")
        (folder / "bin" / name).chmod(0o755)
    return folder


@pytest.fixture(autouse=True)
def outside_a_checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(locate, "__file__", str(tmp_path / "a" / "b" / "c.py"))


@pytest.mark.parametrize("part", ["", "bin/python3", "bin/drgs"])
@pytest.mark.parametrize("through", ["variable", "preference"])
def test_folder_interpreter_and_program_lead_to_the_interpreter(environment, monkeypatch, part, through):
    place = str(environment / part)
    if through == "variable":
        monkeypatch.setenv(VARIABLE, place)
    command = locate_engine(place if through == "preference" else None)
    assert command == [str(environment / "bin/python3"), "-I", "-Xutf8", "-m", "drgs_blender.engine"]


def test_a_checkout_has_its_environment_in_it(environment, tmp_path):
    environment.rename(tmp_path / ".venv")
    assert locate_engine(tmp_path)[0] == str(tmp_path / ".venv" / "bin" / "python3")


def test_link_to_the_program_is_followed(environment, tmp_path):
    link = tmp_path / "local" / "drgs"
    link.parent.mkdir()
    link.symlink_to(environment / "bin" / "drgs")
    assert locate_engine(link)[0] == str(environment / "bin" / "python3")


def test_variable_comes_before_preference(environment, monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, str(environment))
    assert locate_engine(tmp_path / "other")[0].startswith(str(environment))


def test_place_that_leads_nowhere_is_an_error_and_not_skipped(environment, monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "gone"))
    with pytest.raises(DeviceError, match="gone is absent") as caught:
        locate_engine(environment)
    assert VARIABLE in caught.value.subject
    assert caught.value.remedy


def test_checkout_offers_its_own_environment(monkeypatch, tmp_path):
    package = tmp_path / "drgs_blender" / "engine"
    package.mkdir(parents=True)
    monkeypatch.setattr(locate, "__file__", str(package / "locate.py"))
    (tmp_path / "pyproject.toml").touch()
    with pytest.raises(DeviceError, match=r"\.venv has no Python"):
        locate_engine()
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python3").touch()
    os.chmod(tmp_path / ".venv" / "bin" / "python3", 0o755)
    assert locate_engine()[0] == str(tmp_path / ".venv" / "bin" / "python3")


def test_nothing_found_names_what_was_looked_at():
    with pytest.raises(DeviceError) as caught:
        locate_engine()
    assert VARIABLE in str(caught.value)
    assert "preference" in str(caught.value)
