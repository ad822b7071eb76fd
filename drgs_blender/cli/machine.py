"""A Blender with a scene open and an engine: for one chunk of frames, or kept for the next ones."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import Any

from ..core.asset.container import digest_asset
from ..core.errors import AssetError, EngineError
from ..engine.memory_limit import OPTION
from ..ipc.client import EngineClient, engine_command
from .blender_process import BlenderProcess, Evaluated
from .find_blender import Blender

logger = logging.getLogger(__name__)

#: Engines that are started again for one frame before the job is given back to the farm.
RESTARTS = 2


class Machine:
    """Blender and the engine for rendering; a context manager that ends both.

    Parameters
    ----------
    keep_blender : bool
        Leave Blender, with its scene, for the next chunk.

    Attributes
    ----------
    assets : dict of str to Path
        Engine's key -> path of every asset of the open scene.
    """

    def __init__(self, keep_blender: bool = False) -> None:
        self._keep_blender = keep_blender
        self._engine: EngineClient | None = None
        self._blender: BlenderProcess | None = None
        self._opened: tuple[object, ...] = ()
        self.assets: dict[str, Path] = {}
        self._contents: dict[Path, str] = {}

    def __enter__(self) -> Machine:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._close_blender()
        if self._engine is not None:
            self._engine.close()

    def engine(self, memory_mb: int | None = None) -> EngineClient:
        """The engine, which may take `memory_mb`; the same one as before where that limit is the same."""
        command = engine_command() + ([OPTION, str(memory_mb)] if memory_mb else [])
        if self._engine is not None and self._engine.command != command:
            self._engine.close()
            self._engine = None
        if self._engine is None:
            self._engine = EngineClient(command, restarts=RESTARTS)
        return self._engine

    def frames(self, blender: Blender, job: dict[str, Any], timeout: float) -> Generator[Evaluated, None, None]:
        """Frames as Blender evaluates them, see `BlenderProcess`; close the generator when it is not used up."""
        frames = job["frames"]
        job = {key: value for key, value in job.items() if key != "frames"}
        opened = (blender, *job.values(), timeout, _stamp(Path(job["scene"])))
        warm = (
            self._blender is not None
            and self._blender.running
            and opened == self._opened
            and all(self._load(path) == key for key, path in list(self.assets.items()))
        )
        if not warm:
            self._close_blender()
            process = BlenderProcess(blender, job | {"frames": frames, "keep": self._keep_blender}, self._load, timeout)
            process.__enter__()
            self._blender, self._opened = process, opened
        assert self._blender is not None
        whole = False
        try:
            yield from self._blender.more(frames) if warm else self._blender.frames()
            whole = True
        except AssetError:
            self.check_assets()  # one that is just being rewritten is not a damaged one
            raise
        finally:
            if not (whole and self._keep_blender):
                self._close_blender()

    def _load(self, path: Path) -> str:
        self._contents[path] = digest_asset(path)
        key = self.engine_in_use.load_asset(str(path))
        self.assets[key] = path
        self._check(path)
        return key

    def check_assets(self) -> None:
        """Refuse a frame that was rendered while an asset was rewritten: it may show the old or the new content.

        Raises
        ------
        EngineError
        """
        for path in self.assets.values():
            self._check(path)

    def _check(self, path: Path) -> None:
        rewritten = EngineError(str(path), "was rewritten while frames were rendered", "Try again")
        try:
            digest = digest_asset(path)
        except AssetError as error:  # it was whole when it was loaded
            raise rewritten from error
        if digest != self._contents[path]:
            raise rewritten

    @property
    def engine_in_use(self) -> EngineClient:
        """The engine that `engine` gave last."""
        return self._engine if self._engine is not None else self.engine()

    def _close_blender(self) -> None:
        if self._blender is not None:
            self._blender.__exit__()
        self._blender = None
        self.assets.clear()


def _stamp(path: Path) -> tuple[int, int] | None:
    """What changes when a file is rewritten."""
    with contextlib.suppress(OSError):  # Blender says what is wrong with it
        about = path.stat()
        return about.st_mtime_ns, about.st_size
    return None
