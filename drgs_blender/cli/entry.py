"""Where the program `drgs` begins: Ctrl+C has its exit code even while Python imports the rest."""

from __future__ import annotations

import sys


def main() -> int:
    """Run `drgs`; returns its exit code."""
    try:
        from .main import main as run

        return run()
    except KeyboardInterrupt:
        sys.stderr.write("drgs: interrupted\n")
        return 130
