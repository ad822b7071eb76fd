"""Write what a file holds in another format: assets, splats, meshes and environments for other programs.

The format read is found from the content, the format written from the name of the output.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.errors import AssetError, UsageError
from ..core.file_integrity import EXR
from ..core.file_types import SPZ_VERSIONS, USD_KERNELS, Held
from ..core.frame_sequences import frame_path
from ..formats.axes import UP_AXES
from ..formats.point_cache import SUFFIXES as POINT_CACHES
from .convert_sequence import OPTIONS, check_one_file, convert_sequence, is_sequence, refuse_options
from .frame_range import check_template, parse_frames, requested_frames
from .output import check_writable, write_preview
from .pose_file import add_vertex_order, check_vertex_order, in_asset_order, is_point_cache, open_cache, read_poses
from .progress import clock
from .relight import finite, positive
from .sampling import int_range

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs convert capture.ply capture.spz
  drgs convert helmet.drgs helmet.glb
  drgs convert helmet.drgs helmet.ply --env studio.hdr --env-rotation 90
  drgs convert robot.drgs robot.spz --vertices pose.npy
  drgs convert robot.drgs 'splats/####.ply' --vertices 'poses/####.npy' --frames 1-24
  drgs convert robot.drgs robot.pc2 --vertices source.mdd
  drgs convert 'in/####.ply' 'out/####.spz' --frames
  drgs convert splats.spz splats.ply --up=-y
  drgs convert splats.ply splats.spz --spz-version 3
  drgs convert lego.drgs light.exr
  drgs convert 'frames/####.exr' 'look/####.png' --frames
  drgs convert helmet.drgs helmet.glb --as splats --materials
  drgs convert shot.blend walk.usdc --object Robot --frames 1-24 --surfels
  drgs convert robot.drgs walk.usdz --vertices walk.pc2 --frames
  drgs convert shot.blend walk.abc --frames 1-24
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs convert``."""
    parser.add_argument(
        "input", type=Path, metavar="IN",
        help="asset, splats, mesh, environment, a .blend with DR-GS objects, a frame that Blender exported, or a "
        "rendered one, to look at (.png)",
    )  # fmt: skip
    parser.add_argument("output", type=Path, metavar="OUT", help="file to write; its extension chooses the format")
    parser.add_argument(
        "--as", dest="kind", choices=("splats", "mesh", "environment", "sequence"),
        help="what to write of an asset; default: what OUT can hold, its mesh rather than its splats; sequence: all "
        "frames in one USD, as it is where OUT has no #",
    )  # fmt: skip
    parser.add_argument(
        "--up", choices=tuple(UP_AXES), help="up axis of the file written; default: what its format prescribes, else z"
    )
    parser.add_argument(
        "--from-up", choices=tuple(UP_AXES), help="up axis of the file read; default: what its format says, else z"
    )
    parser.add_argument("--scale", type=positive, default=1.0, metavar="S", help="factor on all lengths")
    parser.add_argument(
        "--vertices", type=Path, metavar="V",
        help="pose of an asset: the mesh's vertices, metres, an (n, 3) array (.npy), or those of frames (.pc2, .mdd)",
    )  # fmt: skip
    add_vertex_order(parser)
    parser.add_argument(
        "--frames", nargs="?", const="",
        help="frames, one file each: #### in IN, OUT and V becomes the number; 1-24, or nothing for those of IN or V; "
        "a USD without #### in its name has all of them",
    )  # fmt: skip
    blend = parser.add_argument_group("of Blender's files")
    blend.add_argument(
        "--object",
        action="append",
        metavar="NAME",
        help="an object of the scene; repeatable; default: all DR-GS objects",
    )
    blend.add_argument(
        "--blender", metavar="PATH", help="blender program, or a Python (or its environment) that has bpy"
    )
    blend.add_argument(
        "--enable-scripts", action="store_true", help="let the file run its own Python scripts and drivers"
    )
    formats = parser.add_argument_group("what single formats leave open")
    formats.add_argument(
        "--materials", action="store_true",
        help="of PLY, glTF and USD with splats: add albedo, roughness, metallic, normals (docs/relightable-splats.md)",
    )  # fmt: skip
    formats.add_argument(
        "--compress", action="store_true",
        help="of glTF with splats: pack them as SPZ (KHR_gaussian_splatting_compression_spz_2)",
    )  # fmt: skip
    formats.add_argument(
        "--spz-version", type=int, choices=SPZ_VERSIONS,
        help="of SPZ: older programs read 2 and 3, of which 2 has coarser rotations; default 4, in glTF 2",
    )  # fmt: skip
    formats.add_argument(
        "--kernel", choices=USD_KERNELS,
        help="of USD with splats: ellipsoid (default), which viewers show, or surflet, flat as surfels are",
    )  # fmt: skip
    formats.add_argument(
        "--surfels", action="store_true", help="of a sequence: the surfels, too, as splats; else the mesh alone"
    )
    formats.add_argument(
        "--fps", type=positive, metavar="N", help="of a sequence: frames per second; default: the scene's, else 24"
    )
    splats = parser.add_argument_group("colour of splats")
    splats.add_argument(
        "--colour", choices=("captured", "albedo", "relit"),
        help="the captured colour where there is one, else the albedo (default); the albedo; or that under the "
        "environment (default with --env)",
    )  # fmt: skip
    splats.add_argument("--env", type=Path, help="environment that lights an asset (EXR, HDR); default: its own")
    splats.add_argument("--env-rotation", type=finite, default=0.0, metavar="DEG", help="as in `drgs relight`")
    splats.add_argument("--env-strength", type=finite, default=1.0, metavar="S", help="strength of the environment")
    splats.add_argument(
        "--samples", type=int_range(1, 65536), default=256, metavar="N", help="samples a surfel; default 256"
    )


def run(args: argparse.Namespace) -> int:
    """Convert one file, or those of all frames."""
    check_vertex_order(args)
    args.frame = args.scene = args.scene_fps = None
    if args.input.suffix.lower() == ".blend":
        from .convert_blend import evaluated_frames

        with evaluated_frames(args) as described:
            return 0 if described is None else convert_all(described)
    return convert_all(args)


def convert_all(args: argparse.Namespace) -> int:
    """Convert what is not Blender's file itself."""
    from ..ipc.frame_file import SUFFIX

    for option in ("object", "blender", "enable_scripts"):
        if getattr(args, option) and args.input.suffix.lower() != SUFFIX:
            raise UsageError(f"--{option.replace('_', '-')}", "is of a .blend", "Leave it out")
    moving = is_point_cache(args.vertices)
    if args.output.suffix.lower() in POINT_CACHES:
        return convert_poses(args)
    frames: list[int] | None
    whole = args.frames is None and ("#" in args.output.name or is_sequence(args, None))
    if moving and (args.frames == "" or whole):
        frames = [frame for frame, _ in read_poses(args.vertices)]
    else:
        frames = requested_frames(args.frames, args.input)
    if is_sequence(args, frames):
        convert_sequence(args, frames)
        return 0
    if args.fps:
        raise UsageError("--fps", "is of a sequence", "Leave it out, or name OUT .usdc and give --frames")
    if frames is not None:
        check_template(str(args.output), frames)
    if frames is None:
        convert(args)
        return 0
    for frame in frames:
        paths = {name: path for name in ("input", "output", "vertices") if (path := getattr(args, name)) is not None}
        of_frame = {name: frame_path(str(path), frame) for name, path in paths.items()}
        convert(argparse.Namespace(**(vars(args) | of_frame | ({"frame": frame} if moving else {}))))
    return 0


def convert_poses(args: argparse.Namespace) -> int:
    """Write a point cache in the order, axes and unit of an asset; of the frames that are asked for, or of all."""
    from ..core.asset.container import read_asset
    from ..formats.point_cache import write_point_cache

    if not is_point_cache(args.vertices):
        problem = "is written of a point cache"
        raise UsageError(str(args.output), problem, "Give an asset as IN and a .pc2 or .mdd with --vertices")
    refuse_options(args, ("kind", "up", "from_up", "env", "colour"), "a point cache")
    check_one_file(args.output)
    check_writable(args.output, (args.input, args.vertices))
    with clock(args, "reading"):
        mesh = read_asset(args.input).mesh
        cache = open_cache(args.vertices)
        poses = read_poses(args.vertices, parse_frames(args.frames) if args.frames else None, cache)
    numbers = [frame for frame, _ in poses]
    if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        raise UsageError(f"--frames {args.frames}", "skips frames, which a point cache cannot", "Write it as 1-24")
    scale = np.float32(args.scale)
    faulty: list[int] = []

    def moved(number: int, vertices: np.ndarray) -> np.ndarray:
        vertices = in_asset_order(args, mesh, vertices)
        with np.errstate(over="ignore"):
            vertices = vertices * scale
        if not np.isfinite(vertices).all():
            faulty.append(number)
        return vertices

    moving = (moved(number, pose()) for number, pose in poses)
    write_point_cache(args.output, moving, len(poses), len(mesh.vertices), numbers[0], cache.fps)
    # An MDD has times from its first frame on, and no numbers.
    first = 1 if args.output.suffix.lower() == ".mdd" else numbers[0]
    print(f"{args.output}: {len(poses)} frames from {first} on, {len(mesh.vertices)} vertices each")
    if first != numbers[0]:
        logger.warning("%s: MDD keeps no frame numbers; frame %d of %s is 1", args.output, numbers[0], args.vertices)
    if faulty:
        problem = "frames, the first %d, have vertices that are NaN or infinite; export them again"
        logger.warning(f"%s: %d {problem}", args.vertices, len(faulty), faulty[0])
    return 0


def rendered_frame(path: Path) -> np.ndarray | None:
    """Combined, (h, w, 4) linear, of a frame that DR-GS rendered; None of other files."""
    from ..render.film.frame_files import read_checksum, read_frame

    if not path.is_file():  # opening a pipe may never end
        return None
    try:
        with path.open("rb") as file:
            if file.read(len(EXR)) != EXR:
                return None
        read_checksum(path)
    except (OSError, AssetError):  # the readers say what is wrong with it
        return None
    return read_frame(path)[0].get("Combined")


def convert_frame(args: argparse.Namespace, combined: np.ndarray) -> None:
    """Write a rendered frame as a picture to look at."""
    if args.output.suffix.lower() != ".png":
        problem = f"is a rendered frame, and cannot be written as {args.output.suffix or 'a file without an extension'}"
        raise UsageError(str(args.input), problem, "Name OUT .png, or .exr to use it as a light")
    refuse_options(args, ("kind", "up", "from_up", "vertices", "env", "colour"), "a rendered frame")
    check_writable(args.output, (args.input,))
    write_preview(args.output, combined)
    height, width = combined.shape[:2]
    print(f"{args.output}: {width} x {height} picture, sRGB, without Blender's view transform")


def convert(args: argparse.Namespace) -> None:
    """Read, convert, write, and say what was converted."""
    from ..formats.writers import WRITERS, either, find_writer, names_for
    from .convert_source import open_source

    suffix = args.output.suffix.lower()
    if suffix != ".exr" and (frame := rendered_frame(args.input)) is not None:  # else it is a light
        convert_frame(args, frame)
        return
    with clock(args, "reading"):
        source = open_source(args)
    wanted: list[Held] = [args.kind] if args.kind else list({w.kind: 0 for w in WRITERS if suffix in w.extensions})
    if wanted and not set(wanted) & set(source.kinds):
        words = {"environment": "captured light", "mesh": "mesh", "splats": "splats"}
        lacking = either([words[kind] for kind in wanted])
        held = " and ".join("a mesh" if kind == "mesh" else words[kind] for kind in source.kinds)
        problem = f"has no {lacking}, only {held}, and cannot be written as {suffix or args.kind}"
        remedy = f"Name OUT {names_for(source.kinds)}"
        if "environment" in wanted and args.input.suffix.lower() == ".drgs":
            remedy += ", or make the asset with the light of its capture: `drgs import ... --env`"
        raise UsageError(str(args.scene or args.input), problem, remedy)
    writer = find_writer(args.output, [args.kind] if args.kind else source.kinds)
    kind = writer.kind
    if writer.fixed and args.up not in (None, writer.up):
        raise UsageError("--up", f"is {args.up}, but {writer.name} is {writer.up} up", "Leave --up out")
    options = writer.chosen({name: getattr(args, name) for name in OPTIONS})
    check_writable(args.output, (args.input, args.vertices, args.env))
    up = args.up or writer.up
    if kind == "environment":
        environment = source.environment()
        writer.write(args.output, environment)
        height, width = environment.radiance.shape[:2]
        print(f"{args.output}: {width} x {height} environment, {writer.name}")
    elif kind == "mesh":
        from ..build.make import scale_mesh
        from ..formats.atlas import material_loss
        from ..formats.axes import mesh_from_z_up
        from ..formats.mesh_groups import kept

        mesh = replace(source.mesh())
        scale_mesh(mesh, args.scale, str(args.output))
        writer.write(args.output, mesh_from_z_up(mesh, up))
        print(f"{args.output}: {len(mesh.faces)} triangles, {writer.name}, {up} up")
        print(f"  {kept(mesh, str(args.output)) or material_loss(mesh)}")
        for name in writer.lost_channels:
            if getattr(mesh, name) is not None or (mesh.textures is not None and name in mesh.textures.optional):
                print(f"  {name} is lost: {writer.name} has no place for it")
    else:
        from ..formats.splats import scaled, splats_from_z_up

        splats, shown = source.splats()
        writer.write(args.output, splats_from_z_up(scaled(splats, args.scale), up), **options)
        extra = ", with materials" if args.materials else ""
        print(f"{args.output}: {len(splats)} splats, {writer.name}, {up} up, showing the {shown}{extra}")
    for note in source.notes:
        print(f"  {note}")
