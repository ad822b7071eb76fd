"""Print a sheet of markers to stand an object on: cameras and scale of photographs, also of a turntable's.

The PDF has its true size. Print it at 100 %, measure the line, keep the sheet flat, and move it only together with the
object while photographs are taken; `drgs capture` finds it by itself.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from .output import check_suffix, check_writable

EXAMPLES = """examples:
  drgs markers sheet.pdf
  drgs markers sheet.pdf --paper letter
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs markers``."""
    parser.add_argument("out", type=Path, metavar="SHEET.pdf", help="PDF to write")
    parser.add_argument("--paper", choices=("a4", "letter", "a3"), default="a4", help="its size; default a4")


def run(args: argparse.Namespace) -> int:
    """Write one sheet."""
    check_suffix(args.out, (".pdf",))
    check_writable(args.out)

    from ..capture.marker_sheet import PAPERS, write_pdf

    write_pdf(args.out, args.paper)
    if not args.quiet:
        paper = PAPERS[args.paper]
        print(f"{args.out}: {paper.width:g} x {paper.height:g} mm; markers of {paper.marker:g} mm. Print at 100 %")
    return 0
