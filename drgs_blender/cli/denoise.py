"""Denoise rendered frames with the help of their neighbours: the second step after `drgs render`.

Each frame is made from the noisy frames around it (two before and two after by default), read from disk, whatever is
denoised in the same run: however a sequence is divided among runs and machines, the frames have the same bits. Motion
is followed, cuts are found by the cameras that the frames name. The first and last frames have fewer neighbours: those
that are there, or that --sequence names.

The noisy frames come from `drgs render --denoise none --passes temporal`, or from `drgs render` of a scene in which
Store Denoising Data is on; files that Blender itself writes are not read. Frames that are already denoised, from the
same noisy ones, are skipped.

The last line is DRGS_EXIT class=ok, or the class of what went wrong.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.cryptomatte import METADATA
from ..core.errors import AssetError, EngineError, UsageError
from ..core.frame_sequences import frame_path
from ..core.passes import BY_NAME, COLOURS, without_colour
from ..core.version import __version__
from . import sampling, session_link
from .frame_lines import FrameLines
from .frame_range import check_template, parse_frames
from .output import check_not_input, check_suffix, check_writable, file_pattern
from .progress import bar

if TYPE_CHECKING:
    from ..render.denoise.noisy_frames import NoisyFrame

EXAMPLES = """examples:
  drgs denoise 'noisy/####.exr' --frames 1-24 --out 'clean/####.exr'
  drgs denoise 'noisy/####.exr' --frames 9-16 --sequence 1-24 --out 'clean/####.exr' --passes Combined,Depth
the frames for it:
  drgs render shot.blend --frames 1-24 --denoise none --passes temporal --out 'noisy/####.exr'
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs denoise``."""
    parser.add_argument(
        "noisy", type=file_pattern, metavar="PATTERN", help="noisy EXR files; #### is the frame's number"
    )
    parser.add_argument("--frames", required=True, help="frames to denoise: 1-24, 1-24x2,30")
    parser.add_argument("--out", type=file_pattern, required=True, metavar="PATTERN", help="EXR files to write")
    parser.add_argument("--window", type=odd, default=5, metavar="N", help="frames averaged into one, odd; default 5")
    parser.add_argument(
        "--sequence",
        metavar="FRAMES",
        help="all frames of the shot: one that is missing is an error. Default: the neighbours that are there",
    )
    parser.add_argument(
        "--passes", type=sampling.passes, metavar="NAMES", help="passes to write; default: what the noisy frames hold"
    )
    parser.add_argument(
        "--threads", type=sampling.int_range(0, 1024), default=0, help="threads, 0 for all cores; default 0"
    )
    parser.add_argument("--overwrite", action="store_true", help="denoise frames that are already there, too")
    session_link.add_arguments(parser)


def odd(text: str) -> int:
    """An odd whole number from 1 to 15."""
    value = sampling.int_range(1, 15)(text)
    if value % 2 == 0:
        raise argparse.ArgumentTypeError(f"{value} is not odd")
    return value


def run(args: argparse.Namespace) -> int:
    """Denoise every frame that is not there yet, here or in the session's process."""
    if args.session and (code := session_link.delegate(args.session, args.words)) is not None:
        return code
    return denoise(args)


def denoise(args: argparse.Namespace) -> int:
    """Denoise every frame that is not there yet."""
    frames = parse_frames(args.frames)
    sequence = None if args.sequence is None else set(parse_frames(args.sequence))
    for template in (args.noisy, args.out):
        check_template(template, frames)
        check_suffix(Path(template), (".exr",))
    if frame_path(args.noisy, frames[0]).resolve() == frame_path(args.out, frames[0]).resolve():
        raise UsageError(f"--out {args.out}", "is where the noisy frames are", "Choose another folder or name")
    if sequence is not None and not sequence.issuperset(frames):
        raise UsageError("--frames", "has frames that are not in --sequence", "Give all frames of the shot there")
    for number in frames:
        check_not_input(frame_path(args.out, number), (frame_path(args.noisy, number),))
    check_writable(frame_path(args.out, frames[0]))

    from ..compute.threads import use_threads
    from . import frame_store

    frame_store.remove_abandoned(args.out)
    use_threads(args.threads)
    source = _Source(args.noisy, sequence, args.window)
    same_noise = False
    with FrameLines(openjd=args.openjd and len(frames)) as lines, bar(args, "frames", len(frames)) as progress:
        for done, number in enumerate(frames, 1):
            lines.begin(number, phase="Denoising")
            path, settings = frame_path(args.out, number).absolute(), source.settings(number, args.passes)
            whole = None if args.overwrite else frame_store.read_complete(path)
            if whole is not None and whole[1].get(frame_store.SETTINGS) == settings:
                lines.skipped(path)
            else:
                middle, pictures, repeated = source.denoise(number, args.passes)
                if source.settings(number, args.passes) != settings:
                    raise EngineError(str(path), "its noisy frames were rewritten meanwhile", "Try again")
                if repeated and not same_noise:
                    lines.note("neighbours have the same noise, which stays; switch on Animated Seed")
                same_noise |= repeated
                if others := source.other_sizes(number):
                    lines.note(
                        f"{path.name} is of another size than its neighbours {others}: it is denoised without them"
                    )
                known = ("frame", "seed", "camera")
                kept = {k: v for k, v in middle.metadata.items() if k in known or k.startswith(METADATA)}
                extra = {frame_store.SETTINGS: settings, "denoise": f"svgf, window of {args.window}"}
                frame_store.write_frame(path, pictures, kept | extra)
                lines.saved(path)
            progress.update()
            lines.finished(done)
    return 0


def _held(noisy: NoisyFrame) -> tuple[str, ...]:
    """Passes of a noisy frame that a denoised one has as well: all that are not for this step alone."""
    from ..render.film.light_passes import COMPONENTS, LIGHT_PASSES

    light = COMPONENTS if noisy.transmitted is None else LIGHT_PASSES
    return tuple(name for name in BY_NAME if name in noisy.passes or name in light)


class _Source:
    """The noisy frames, of which a window is kept in memory."""

    def __init__(self, template: str, sequence: set[int] | None, window: int) -> None:
        self._template, self._sequence = template, sequence
        self._reach = window // 2
        self._held: dict[int, tuple[str, NoisyFrame]] = {}  # with the checksum of the file

    def _path(self, number: int) -> Path | None:
        """File of a frame; None where the sequence has none."""
        path = frame_path(self._template, number)
        if self._sequence is None:
            return path if path.is_file() else None
        return path if number in self._sequence else None

    def _window(self, number: int) -> list[int | None]:
        """The frames that decide on one, None where the sequence has ended."""
        if self._path(number) is None:
            path = frame_path(self._template, number)
            raise AssetError(str(path), "does not exist", "Render this frame first")
        around = [self._path(k) for k in range(number - self._reach, number + self._reach + 1)]
        if absent := [str(path) for path in around if path is not None and not path.is_file()]:
            problem = "does not exist, but --sequence names it" if len(absent) == 1 else "are named by --sequence alone"
            remedy = f"Render what frame {number} needs, or shorten --sequence"
            raise AssetError(", ".join(absent), problem, remedy)
        return [None if path is None else k for k, path in enumerate(around, number - self._reach)]

    def settings(self, number: int, passes: tuple[str, ...] | None) -> str:
        """SHA-256 over all that decides what the denoised frame is."""
        from ..render.film.frame_files import read_checksum

        sums = [None if k is None else read_checksum(frame_path(self._template, k)) for k in self._window(number)]
        return hashlib.sha256(json.dumps([__version__, passes, sums]).encode()).hexdigest()

    def frame(self, number: int) -> NoisyFrame:
        """A noisy frame, read when first needed, and when its file is another one."""
        from ..render.denoise.noisy_frames import read_noisy
        from ..render.film.frame_files import read_checksum

        path = frame_path(self._template, number)
        checksum = read_checksum(path)
        if number not in self._held or self._held[number][0] != checksum:
            noisy = read_noisy(path)
            if noisy.metadata.get("frame", str(number)) != str(number):
                raise AssetError(str(path), f"is frame {noisy.metadata['frame']}", "Give it the name of its number")
            self._held[number] = checksum, noisy
        return self._held[number][1]

    def other_sizes(self, number: int) -> str:
        """Names of the frames in the window of `denoise`'s last one that have another size, which cannot help."""
        sizes = {k: noisy.picture.variance.shape[:2] for k, (_, noisy) in sorted(self._held.items())}
        return ", ".join(frame_path(self._template, k).name for k in sizes if sizes[k] != sizes[number])

    def denoise(self, number: int, passes: tuple[str, ...] | None) -> tuple[NoisyFrame, dict[str, np.ndarray], bool]:
        """The noisy frame, its denoised passes, and whether a neighbour has the very same noise."""
        from ..render.denoise.svgf_temporal import NoisyPicture
        from ..render.denoise.svgf_window import window
        from ..render.film.light_passes import LIGHT_PASSES, light_parts

        around = self._window(number)
        for old in [k for k in self._held if k not in around]:
            del self._held[old]
        noisy = [None if k is None else self.frame(k) for k in around]
        middle = self.frame(number)
        pictures: list[NoisyPicture | None] = []
        for before, item in zip([None, *noisy], noisy):
            if item is None:
                pictures.append(None)
                continue
            picture = item.picture
            linked = before is not None and item.follows(before)
            pictures.append(replace(picture, motion=picture.motion if linked else None))
        wanted = passes or _held(middle)
        light = window(pictures, split=any(name in LIGHT_PASSES for name in wanted))
        colours = middle.passes
        parts = light_parts(light, middle.picture.components, middle.transmitted, colours)
        made = {
            name: without_colour(part, colours[COLOURS[name]])
            for name, part in zip(LIGHT_PASSES, parts)
            if COLOURS[name] in colours
        }
        made |= middle.passes | {"Combined": middle.beauty(light), "Noisy Image": middle.passes["Combined"]}
        absent = [name for name in wanted if name not in made]
        if absent:
            raise UsageError(
                f"pass {absent[0]!r}", "is not in the noisy frames", "Render it, or leave it out of --passes"
            )
        noises = [(n.metadata.get("seed"), n.metadata.get("noise")) for n in noisy if n is not None]
        return middle, {name: made[name] for name in wanted}, len(set(noises)) < len(noises)
