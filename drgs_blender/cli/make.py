"""Make an asset from a textured mesh: surfels grown on it, materials from its textures.

Reads glTF, GLB, OBJ, PLY and what else the formats registry knows; textures may lie beside the mesh.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from .output import check_suffix, check_writable
from .progress import FractionBar

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs make helmet.gltf --out helmet.drgs
  drgs make statue.obj --up y --out statue.drgs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs make``."""
    parser.add_argument("mesh", type=Path, metavar="MESH", help="textured mesh")
    parser.add_argument("--out", type=Path, required=True, metavar="A.drgs", help="asset to write")
    parser.add_argument("--up", choices=("y", "z"), help="up axis of the file; default: what its format says")


def run(args: argparse.Namespace) -> int:
    """Make and write one asset."""
    check_suffix(args.out, (".drgs",))
    check_writable(args.out)

    from ..asset.container import write_asset
    from ..build.make import make_asset

    with FractionBar(args, "making"):
        asset = make_asset(args.mesh)
    write_asset(args.out, asset)
    print(f"{args.out}: {len(asset.surfels)} surfels on {len(asset.mesh.faces)} triangles")
    return 0
