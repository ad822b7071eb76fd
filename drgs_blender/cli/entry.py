"""The entry point of the program `drgs`: Ctrl+C has its exit code even while Python imports the rest."""

from __future__ import annotations

import sys


def main() -> int:
    """Run `drgs`; returns its exit code."""
    try:
        from .main import main as run

        return run()
    except KeyboardInterrupt:
        from ..core.errors import EXIT_INTERRUPTED
        from .frame_lines import emit, emit_exit_class

        emit("drgs: interrupted\n", sys.stderr)
        emit_exit_class(sys.argv[1:], EXIT_INTERRUPTED)
        return EXIT_INTERRUPTED
