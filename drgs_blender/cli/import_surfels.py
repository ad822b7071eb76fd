"""Make an asset from captured surfels or splats, with the mesh they were reconstructed with where there is one."""

from __future__ import annotations

import argparse
from pathlib import Path

from .output import check_suffix, check_writable

EXAMPLES = """examples:
  drgs import point_cloud.ply --mesh fuse_post.ply --out capture.drgs
  drgs import point_cloud.ply --mesh fuse_post.ply --env room.exr --up y --out capture.drgs
  drgs import splats.spz --out splats.drgs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs import``."""
    parser.add_argument("surfels", type=Path, metavar="SURFELS", help="surfels or splats, for example a PLY file")
    parser.add_argument("--mesh", type=Path, help="their mesh; default: one is made from the surfels")
    parser.add_argument("--env", type=Path, help="environment of the capture, kept in the asset")
    parser.add_argument("--up", choices=("y", "z"), help="up axis of the files; default: what their format says")
    parser.add_argument("--out", type=Path, required=True, metavar="A.drgs", help="asset to write")


def run(args: argparse.Namespace) -> int:
    """Import and write one asset."""
    check_suffix(args.out, (".drgs",))
    check_writable(args.out)

    from ..asset.container import write_asset
    from ..build.importer import import_asset

    asset = import_asset(args.surfels, mesh=args.mesh, environment=args.env, up=args.up)
    write_asset(args.out, asset)
    print(f"{args.out}: {len(asset.surfels)} surfels on {len(asset.mesh.faces)} triangles")
    return 0
