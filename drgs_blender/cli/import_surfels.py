"""Make an asset from captured surfels or splats, with the mesh they were reconstructed with where there is one.

Without a mesh a closed one is built around the surfels, so that they can be rigged and cast shadows.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from ..core.errors import UsageError
from ..core.file_types import Kind
from ..core.frame_sequences import frame_path
from ..formats.axes import UP_AXES
from .frame_range import check_template, requested_frames
from .output import check_suffix, check_writable, write_and_report
from .progress import FractionBar, clock, prepare_engine
from .relight import positive
from .sampling import int_range

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs import point_cloud.ply --mesh fuse_post.ply --out capture.drgs
  drgs import point_cloud.ply --mesh fuse_post.ply --env room.exr --up y --out capture.drgs
  drgs import fern.ply --no-mesh --out fern.drgs
  drgs import splats.compressed.ply --up=-y --resolution 256 --out splats.drgs
  drgs import 'dance/####.spz' --no-mesh --frames 1-24 --out 'dance/####.drgs'
  drgs import statue.ply --env garden.hdr --remove-light --out statue.drgs
  drgs import statue.ply --remove-light --out statue.drgs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs import``."""
    parser.add_argument("surfels", type=Path, metavar="SURFELS", help="surfels or splats")
    parser.add_argument("--out", type=Path, required=True, metavar="A.drgs", help="asset to write")
    mesh = parser.add_mutually_exclusive_group()
    mesh.add_argument("--mesh", type=Path, help="their mesh; default: one is built around them")
    mesh.add_argument(
        "--no-mesh", action="store_true", help="surfels alone, for --rays-see surfels: foliage, hair, anything thin"
    )
    parser.add_argument("--scale", type=positive, default=1.0, metavar="S", help="factor on all lengths")
    parser.add_argument("--env", type=Path, help="environment of the capture, kept in the asset")
    parser.add_argument(
        "--frames", nargs="?", const="",
        help="frames, one asset each: #### in the names becomes the number; 1-24, or nothing for those of SURFELS",
    )  # fmt: skip
    light = parser.add_argument_group("light in the colours of surfels without materials")
    light.add_argument(
        "--remove-light", action="store_true",
        help="estimate the albedo: the captured colour over the light of --env; without it that is estimated, too, but "
        "for its brightness and mean colour",
    )  # fmt: skip
    light.add_argument(
        "--exposure", type=positive, metavar="E",
        help="linear captured colour that radiance 1 of the environment gives, without --env that of white in the mean "
        "light; default: what makes the albedo of the brightest tenth 0.8, without --env 0.5",
    )  # fmt: skip
    parser.add_argument(
        "--up",
        choices=tuple(UP_AXES),
        help="up axis of surfels and mesh, --up=-y for most photogrammetry; default: what the formats say",
    )
    parser.add_argument(
        "--resolution", type=int_range(8, 1024), metavar="N", help="voxels along the longest side of a built mesh"
    )
    parser.add_argument(
        "--max-triangles",
        type=int_range(1, 10**8),
        metavar="N",
        help="most triangles when a mesh is divided where its textures need more vertices; default 300000",
    )


def run(args: argparse.Namespace) -> int:
    """Import and write one asset, or those of all frames."""
    frames = requested_frames(args.frames, args.surfels)
    check_template(str(args.out), frames or [])
    if frames is None:
        return _import(args)
    if args.remove_light and args.env is None and len(frames) > 1:
        remedy = "write that of the first by `drgs convert FIRST.drgs light.exr` and give it with --env light.exr"
        logger.warning("--remove-light: estimates a light for each frame, so that colours may flicker; %s", remedy)
    for frame in frames:
        paths = {name: path for name in ("surfels", "mesh", "env", "out") if (path := getattr(args, name)) is not None}
        of_frame = {name: frame_path(str(path), frame) for name, path in paths.items()}
        _import(argparse.Namespace(**(vars(args) | of_frame)))
    return 0


def _import(args: argparse.Namespace) -> int:
    check_suffix(args.out, (".drgs",))
    check_writable(args.out, (args.surfels, args.mesh, args.env))
    if args.exposure is not None and not args.remove_light:
        raise UsageError("--exposure", "belongs to --remove-light", "Give both")

    from ..build.importer import import_asset
    from ..formats.registry import find_format

    kinds: dict[Kind, Path | None] = {"surfels": args.surfels, "mesh": args.mesh, "environment": args.env}
    for kind, path in kinds.items():
        if path is not None:
            find_format(path, kind)  # before minutes of compiling
    prepare_engine(args, "import")
    given = {name: value for name in ("resolution", "max_triangles") if (value := getattr(args, name)) is not None}
    with clock(args, "importing"):
        asset = import_asset(
            args.surfels, args.mesh, args.env, args.up, meshless=args.no_mesh, scale=args.scale, **given
        )
    if args.remove_light:
        from ..build.delight import remove_light

        with FractionBar(args, "removing light") as progress:
            remove_light(asset, args.exposure, progress=progress)
    write_and_report(args.out, asset)
    return 0
