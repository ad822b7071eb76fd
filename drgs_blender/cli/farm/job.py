"""A render farm job, the same for every farm manager: command lines for chunks of frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..frame_range import cut_frames, write_frames

#: What a second step over finished frames needs of the first; options of the user come after and win.
FOR_DENOISING = ("--denoise", "none", "--passes", "temporal")


@dataclass(frozen=True, slots=True)
class Job:
    """Frames of a scene, and optionally a second step that denoises them over time.

    Attributes
    ----------
    name : str
        For people.
    scene : Path
        Absolute path of the .blend file.
    frames : list of int
        In the order in which they shall be made.
    out : str
        Absolute pattern with ``#``, of the rendered frames.
    clean : str or None
        The same of the denoised frames, if there are any.
    chunk : int
        Size of a chunk: most frames of one task.
    options : tuple of str
        Further options of ``drgs render``.
    program : tuple of str
        How a node starts ``drgs``: a program and perhaps its first arguments.
    """

    name: str
    scene: Path
    frames: list[int]
    out: str
    clean: str | None
    chunk: int
    options: tuple[str, ...]
    program: tuple[str, ...]

    @property
    def range(self) -> str:
        """All frames, in the notation of frame_range."""
        return write_frames(self.frames)

    @property
    def chunks(self) -> list[str]:
        """The frames of every task, in that notation."""
        return [write_frames(part) for part in cut_frames(self.frames, self.chunk)]

    @property
    def outputs(self) -> list[Path]:
        """Folders into which is written."""
        return [Path(pattern).parent for pattern in (self.out, self.clean) if pattern]

    def render(self, frames: str, scene: str | None = None, out: str | None = None) -> list[str]:
        """Command that renders `frames`; `scene` and `out` may be what a manager replaces on the node."""
        temporal = FOR_DENOISING if self.clean else ()
        where = [scene or str(self.scene), f"--frames={frames}", f"--out={out or self.out}"]
        return [*self.program, "render", *where, *temporal, *self.options]

    def denoise(
        self, frames: str, out: str | None = None, clean: str | None = None, every: str | None = None
    ) -> list[str]:
        """Command that denoises `frames` once all frames are rendered; `every` stands for the notation of them all."""
        where = [f"--frames={frames}", f"--sequence={every or self.range}", f"--out={clean or self.clean}"]
        return [*self.program, "denoise", out or self.out, *where]
