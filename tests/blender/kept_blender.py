"""The Blender that bakes, handed on from test to test: to start one takes longer than most bakes of tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from scenes import part


def keep_blender(monkeypatch: pytest.MonkeyPatch, kept: list[Any]) -> None:
    """Put a process that would be ended into `kept`, and take it from there instead of starting one.

    The extension ends it with each file that is loaded, as each test does. One that has a job under way, or has failed
    at one, is ended as ever, and a test with a program of its own gets that.
    """
    manager, process = part("addon.bakes.manager"), part("addon.bakes.blender_process")
    own, command = process.BlenderProcess, process.command
    do, close = own.do, own.close

    def start() -> Any:
        while kept and process.command is command:
            found = kept.pop()
            if found.alive:
                return found
            close(found)
        return own()

    def do_job(self: Any, job: dict[str, Any], cancelled: Callable[[], bool]) -> None:
        self.is_sound = False
        do(self, job, cancelled)
        self.is_sound = self.alive

    def hand_on(self: Any) -> None:
        if self.is_sound and self.alive:
            kept.append(self)
        else:
            close(self)

    monkeypatch.setattr(own, "is_sound", False, raising=False)
    monkeypatch.setattr(own, "do", do_job)
    monkeypatch.setattr(own, "close", hand_on)
    monkeypatch.setattr(manager, "BlenderProcess", start)
