"""The `drgs` command: one table of commands, shared options, exit codes.

Exit codes are those of `drgs_blender.core.errors` (0 done, 64 usage, 65 bad asset, 69 something missing, 70 internal,
73 cannot write, 75 may work when repeated, 78 version mismatch), 130 and 143 when interrupted or terminated.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import io
import logging
import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from ..core import errors
from ..core.version import __version__
from .frame_lines import emit, emit_exit_class, is_for_farms
from .output import file_name

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Command:
    """One command: its name, the module of this package that implements it, one line of help.

    The module has ``EXAMPLES`` (text under --help), ``add_arguments(parser)`` and ``run(args) -> int``, and imports
    what computes only inside ``run``.
    """

    name: str
    module: str
    about: str


COMMANDS: tuple[Command, ...] = (
    Command("make", "make", "make an asset from a textured mesh"),
    Command("import", "import_surfels", "make an asset from captured surfels or splats"),
    Command("reconstruct", "reconstruct", "make an asset from photographs"),
    Command("capture", "capture", "find the cameras of photographs or of a video"),
    Command("markers", "markers", "print a sheet of markers to photograph objects on"),
    Command("clean", "clean", "remove floaters and what lies outside a box from an asset"),
    Command("reshape", "reshape", "give an asset the shape of an edited mesh"),
    Command("convert", "convert", "write an asset, splats, a mesh or a light in a format of other programs"),
    Command("bake", "bake", "bake the light on the objects of a frame to their vertices or to images"),
    Command(
        "inspect",
        "inspect_file",
        "say what a file holds: asset, mesh, surfels, environment, rendered or exported frame",
    ),
    Command("relight", "relight", "render an asset under an environment, without Blender"),
    Command("render", "render", "render frames of a .blend file through Blender"),
    Command("simulate", "simulate", "simulate the matter that fills an asset, without Blender"),
    Command("evaluate", "evaluate", "score an asset against its capture, or render scenes with known truth"),
    Command("denoise", "denoise", "denoise rendered frames with the help of their neighbours"),
    Command("submit", "submit", "write a job for OpenJD, Slurm or Flamenco"),
    Command("session", "session", "keep Blender and an engine from one chunk of frames to the next"),
    Command("doctor", "doctor", "check what DR-GS needs and say what is missing"),
)

#: Options whose values may begin with a dash.
_SIGNED = ("--up", "--from-up", "--frames", "--sequence", "--gravity", "--velocity", "--floor", "--box")


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors end with exit code 64, as farms expect, and not 2; no option is abbreviated.

    Options of type Path take no empty names.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
        self.register("type", Path, file_name)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is an error here, where the command is known, whose usage is shown."""
        known, rest = super().parse_known_args(args, namespace)
        if rest:
            options = list(self._option_string_actions)
            close = difflib.get_close_matches(rest[0].partition("=")[0], options, n=1, cutoff=0.8)
            hint = f"; did you mean {close[0]}?" if close else ""
            self.error(f"unrecognized arguments: {' '.join(rest)}{hint}")
        return known, rest

    def error(self, message: str) -> NoReturn:
        """Print usage and the problem, and leave."""
        message = re.sub(r"invalid \w+ value: (.*)", r"\1 cannot be read", message)  # names of Python's types
        self.print_usage(sys.stderr)
        self.exit(errors.EXIT_USAGE, f"{self.prog}: {message}\n")


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line, from the table."""
    shared = Parser(add_help=False)
    group = shared.add_argument_group("messages")
    group.add_argument("-v", "--verbose", action="count", default=argparse.SUPPRESS, help="more messages; -vv for all")
    group.add_argument("-q", "--quiet", action="store_true", default=argparse.SUPPRESS, help="errors only")
    group.add_argument(
        "--progress",
        action=argparse.BooleanOptionalAction,
        default=argparse.SUPPRESS,
        help="progress bars on stderr; default: only on a terminal",
    )
    parser = Parser(
        prog="drgs",
        description="Captured objects as 2D Gaussian surfels, deformed and relit.",
        epilog="`drgs COMMAND --help` shows the options of a command, with examples.",
        parents=[shared],
    )
    parser.add_argument("--version", action="version", version=f"drgs {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for command in COMMANDS:
        module = importlib.import_module(f".{command.module}", __package__)
        sub = commands.add_parser(
            command.name,
            help=command.about,
            description=module.__doc__,
            epilog=module.EXAMPLES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            parents=[shared],
        )
        module.add_arguments(sub)
        sub.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files can have what the terminal has not
    code = run_command(arguments)
    if code == errors.EXIT_OK and not is_for_farms(arguments) and (trouble := stdout_trouble()):
        code = report_stdout(trouble)
    with contextlib.suppress(BrokenPipeError):
        emit_exit_class(arguments, code)
    for name in ("stdout", "stderr"):
        try:
            getattr(sys, name).flush()
        except (OSError, AttributeError):
            setattr(sys, name, None)  # Python would end with a code of its own for what cannot be written
    return code


def run_command(arguments: Sequence[str], run: Callable[[argparse.Namespace], int] | None = None) -> int:
    """Parse and run; every way to end becomes an exit code here. `run` does it instead of the command's own module."""
    verbose = 0
    try:
        parser = build_parser()
        args = parser.parse_args(join_values(arguments))
        if args.command is None:
            parser.print_help(sys.stderr)
            parser.exit(errors.EXIT_USAGE, "\ndrgs: a COMMAND is missing; those above are known\n")
        verbose = getattr(args, "verbose", 0)
        args.verbose, args.quiet = verbose, getattr(args, "quiet", False)
        args.progress = getattr(args, "progress", None)
        args.words = list(arguments)
        set_up_logging(verbose, args.quiet)
        previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(errors.EXIT_TERMINATED))
        try:
            return (run or args.run)(args)
        finally:
            signal.signal(signal.SIGTERM, previous)
    except errors.DrgsError as error:
        emit(f"drgs: {error}\n", sys.stderr)
        return error.exit_code
    except (KeyboardInterrupt, errors.Cancelled):
        emit("drgs: interrupted\n", sys.stderr)
        return errors.EXIT_INTERRUPTED
    except BrokenPipeError:
        sys.stdout = None  # the reader left; nothing may be flushed at exit
        return 141
    except SystemExit as ending:
        return ending.code if isinstance(ending.code, int) else errors.EXIT_OK
    except MemoryError as error:
        logger.info("out of memory", exc_info=True)
        reason = f" ({error})" if str(error) else ""
        emit(f"drgs: the memory is not enough for this{reason}. Use a smaller picture or file.\n", sys.stderr)
        return errors.EXIT_RETRY
    except Exception as error:
        if isinstance(error, OSError) and (trouble := stdout_trouble("\n")):
            return report_stdout(trouble)
        # The one place where any exception ends: a user gets a sentence, -v a traceback, a farm its exit code.
        logger.info("internal error", exc_info=True)
        hint = "" if verbose else " Run again with -v for details and report it."
        emit(f"drgs: internal: {type(error).__name__}: {error}.{hint}\n", sys.stderr)
        return errors.EXIT_INTERNAL


def stdout_trouble(text: str = "") -> OSError | None:
    """Why what was printed cannot be written, as on a full disk; None where it can, or the reader has left.

    Where writing has failed already, nothing may be left to flush: `text` tries once more.
    """
    try:
        if sys.stdout is not None:
            sys.stdout.write(text)
            sys.stdout.flush()
    except BrokenPipeError:
        return None
    except OSError as error:
        return error
    return None


def report_stdout(trouble: OSError) -> int:
    """Say why stdout cannot be written, and give it up; the exit code."""
    sys.stdout = None
    emit(f"drgs: standard output cannot be written: {trouble.strerror or trouble}\n", sys.stderr)
    return errors.EXIT_CANNOT_WRITE


def join_values(arguments: Sequence[str]) -> list[str]:
    """``--up -y`` and ``--frames -5--1`` as ``--up=-y`` and ``--frames=-5--1``: argparse takes a dash for an option."""
    joined: list[str] = []
    for word in arguments:
        if joined and joined[-1] in _SIGNED and re.match(r"-[yz.\d]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


class _Printable(logging.Formatter):
    """Messages on one line, without control characters, which names of files can have."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The message in its format."""
        record.message = errors.printable(record.message)
        return super().formatMessage(record)


def set_up_logging(verbose: int, quiet: bool) -> None:
    """Messages go to stderr: warnings by default, errors with -q, information with -v, all with -vv."""
    level = logging.ERROR if quiet else [logging.WARNING, logging.INFO, logging.DEBUG][min(verbose, 2)]
    logging.basicConfig(level=level, stream=sys.stderr, force=True)
    warnings.filterwarnings("ignore", category=UserWarning, module="PIL")  # of damaged metadata: they name no file
    for handler in logging.getLogger().handlers:
        handler.setFormatter(_Printable("drgs: %(message)s"))
    for noisy in ("numba", "PIL", "trimesh"):
        logging.getLogger(noisy).setLevel(max(level, logging.WARNING))


if __name__ == "__main__":
    sys.exit(main())
