"""One frame of ``drgs render``: as Blender evaluated it, with the options of the command, and the mean of its blur."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import Cancelled, EngineError
from ..core.frame import Frame, RenderSettings
from ..core.phases import is_preparing
from ..ipc import blur
from ..ipc.protocol import Passes
from . import frame_store
from .blender_process import Evaluated

if TYPE_CHECKING:
    from ..ipc.client import EngineClient, OnProgress


class Picture:
    """One picture to render of an evaluated frame.

    Parameters
    ----------
    shot : Evaluated
    override : callable
        Gives the settings of the command for those of the scene.

    Attributes
    ----------
    frame : Frame
        Its description, without blur.
    """

    def __init__(self, shot: Evaluated, override: Callable[[RenderSettings], RenderSettings]) -> None:
        self._shot, self._override = shot, override
        self.frame = self._overridden(shot.frame)

    def _overridden(self, frame: Frame) -> Frame:
        return replace(frame, settings=self._override(frame.settings))

    def _parts(self) -> Iterator[Frame]:
        """What the engine renders for it: the frame, or the one that stays sharp and those that are averaged."""
        if not self._shot.count:
            yield self.frame
            return
        if (sharp := blur.sharp_frame(self.frame)) is not None:
            yield sharp
        for i, frame in enumerate(self._shot.pictures()):
            yield blur.sample_frame(self._overridden(frame), self._shot.count, i)

    def settings_hash(self, assets: Mapping[str, Path]) -> str:
        """`frame_store.settings_hash` of all that is rendered for it."""
        return _joined([frame_store.settings_hash(part, assets) for part in self._parts()])

    def render(
        self, engine: EngineClient, assets: Mapping[str, Path], on_progress: OnProgress, timeout: float
    ) -> tuple[Passes, str]:
        """The passes and their `settings_hash`; EngineError when that takes longer than `timeout` seconds.

        The time in which kernels are compiled, once on a machine, does not count.
        """
        reported, prepared = time.monotonic(), False
        latest, count = reported + timeout, max(self._shot.count, 1)
        hashes: list[str] = []

        def report(phase: str, fraction: float) -> None:
            nonlocal reported, prepared, latest
            now = time.monotonic()
            if is_preparing(phase):
                latest += now - reported if prepared else 0.0
                on_progress(phase, fraction)
            else:
                done = min(len(hashes) - 1, count - 1)
                on_progress(f"blur {done}/{count}: {phase}" if count > 1 else phase, (done + fraction) / count)
            reported, prepared = now, is_preparing(phase)

        def rendered() -> Iterator[Passes]:
            for part in self._parts():
                hashes.append(frame_store.settings_hash(part, assets))
                yield engine.render(part, report, lambda: time.monotonic() > latest)

        try:
            passes = blur.averaged(rendered(), self.frame.passes) if self._shot.count else next(rendered())
        except Cancelled as end:
            problem, remedy = f"took longer than {timeout:g} s", "Raise --timeout, or use fewer samples"
            raise EngineError(f"frame {self._shot.number}", problem, remedy) from end
        return passes, _joined(hashes)


def _joined(hashes: list[str]) -> str:
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
