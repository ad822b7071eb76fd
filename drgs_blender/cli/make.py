"""Make an asset from a textured mesh: surfels grown on its faces, materials from its textures.

Reads every mesh that `drgs inspect` knows. The mesh is divided where its textures need more vertices.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.errors import UsageError
from ..formats.axes import UP_AXES
from .output import check_suffix, check_writable, write_and_report
from .progress import clock
from .relight import positive
from .sampling import int_range

EXAMPLES = """examples:
  drgs make helmet.gltf --out helmet.drgs
  drgs make statue.obj --up y --env studio.hdr --out statue.drgs
  drgs make scan.ply --max-triangles 400000 --density 200 --out scan.drgs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs make``."""
    parser.add_argument(
        "mesh",
        type=Path,
        metavar="MESH",
        help="mesh with materials (glTF, GLB, OBJ, PLY, DAE), or without (STL, OFF, 3MF)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="A.drgs", help="asset to write")
    parser.add_argument("--up", choices=tuple(UP_AXES), help="up axis of the file; default: what its format says")
    parser.add_argument(
        "--pose",
        choices=("rest", "default"),
        default="rest",
        help="of a skinned glTF: as Blender's importer rests it, for Transfer Rig (default), or as viewers show it",
    )
    parser.add_argument("--scale", type=positive, default=1.0, metavar="S", help="factor on all lengths")
    parser.add_argument("--env", type=Path, help="environment kept in the asset")
    parser.add_argument(
        "--max-triangles",
        type=int_range(1, 10**8),
        metavar="N",
        help="most triangles when the mesh is divided where its textures need more vertices; default 150000. As many "
        "as the file has keep its mesh",
    )
    parser.add_argument(
        "--max-surfels",
        type=int_range(1, 10**7),
        metavar="N",
        help="most surfels when faces get smaller ones for textures and normal maps; default 400000. As many as "
        "--density needs are made in any case",
    )
    parser.add_argument(
        "--textures",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="keep the file's texture coordinates, images and normals for the mesh; default: yes",
    )
    parser.add_argument(
        "--max-texture",
        type=int_range(1, 16384),
        metavar="N",
        help="largest side in pixels of the images kept, larger ones are reduced; default 4096",
    )
    parser.add_argument(
        "--density",
        type=int_range(1, 100_000),
        metavar="D",
        help="surfels along the mesh's diagonal, at least; default 140",
    )


def run(args: argparse.Namespace) -> int:
    """Make and write one asset."""
    check_suffix(args.out, (".drgs",))
    check_writable(args.out, (args.mesh, args.env))

    from ..build.make import make_asset

    if not args.textures and args.max_texture:
        raise UsageError("--max-texture", "is given, but no textures are to be kept", "Leave it or --no-textures out")
    budgets = ("max_triangles", "max_surfels", "density", "max_texture")
    given = {name: value for name in budgets if (value := getattr(args, name)) is not None}
    given |= {} if args.textures else {"max_texture": 0}
    with clock(args, "making the asset"):
        asset = make_asset(args.mesh, up=args.up, environment=args.env, pose=args.pose, scale=args.scale, **given)
    write_and_report(args.out, asset)
    return 0
