"""Environment variables that switch something on or off."""

from __future__ import annotations

import pytest

from drgs_blender.core.switches import is_on


@pytest.mark.parametrize("default", [False, True])
def test_words_switch_on_and_off_and_others_are_warned_of_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, default: bool
) -> None:
    name = f"DRGS_TEST_{default}"
    monkeypatch.delenv(name, raising=False)
    assert is_on(name, default) is default
    wants = {"": default, "0": False, " Off": False, "no": False, "FALSE": False, "1": True, "yes": True}
    for text, wanted in wants.items():
        monkeypatch.setenv(name, text)
        assert is_on(name, default) is wanted
    assert not caplog.messages
    monkeypatch.setenv(name, "maybe")
    assert is_on(name, default) and is_on(name, default)
    assert caplog.messages == [f"{name} is maybe, which counts as 1: set it to 0 or 1"]
