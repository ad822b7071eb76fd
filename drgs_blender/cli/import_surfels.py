"""Make an asset from captured surfels or splats, with the mesh they were reconstructed with where there is one.

Without a mesh a closed one is built around the surfels, so that they can be rigged and cast shadows.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..formats.axes import UP_AXES
from .output import check_suffix, check_writable, write_and_report
from .progress import clock
from .sampling import whole

EXAMPLES = """examples:
  drgs import point_cloud.ply --mesh fuse_post.ply --out capture.drgs
  drgs import point_cloud.ply --mesh fuse_post.ply --env room.exr --up y --out capture.drgs
  drgs import splats.compressed.ply --up=-y --resolution 256 --out splats.drgs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs import``."""
    parser.add_argument("surfels", type=Path, metavar="SURFELS", help="surfels or splats")
    parser.add_argument("--out", type=Path, required=True, metavar="A.drgs", help="asset to write")
    parser.add_argument("--mesh", type=Path, help="their mesh; default: one is built around them")
    parser.add_argument("--env", type=Path, help="environment of the capture, kept in the asset")
    parser.add_argument(
        "--up",
        choices=tuple(UP_AXES),
        help="up axis of surfels and mesh, --up=-y for most photogrammetry; default: what the formats say",
    )
    parser.add_argument(
        "--resolution", type=whole(8, 1024), metavar="N", help="voxels along the longest side of a built mesh"
    )
    parser.add_argument(
        "--max-triangles", type=whole(1, 10**8), metavar="N", help="budget for the texture detail of a mesh"
    )


def run(args: argparse.Namespace) -> int:
    """Import and write one asset."""
    check_suffix(args.out, (".drgs",))
    check_writable(args.out)

    from ..build.importer import import_asset

    given = {name: value for name in ("resolution", "max_triangles") if (value := getattr(args, name)) is not None}
    with clock(args, "importing"):
        asset = import_asset(args.surfels, args.mesh, args.env, args.up, **given)
    write_and_report(args.out, asset)
    return 0
