"""Bake the light on the objects of a frame that Blender exported: to their vertices, or to images by their UV map.

A .npy file gets the linear Rec.709 colour of every vertex, (n, 3) float32; an .exr file is an image. What is baked is
the light that leaves the surface along its normal.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.asset.archive import replace_file
from ..core.errors import UsageError
from ..core.frame_sequences import frame_path
from .frame_range import check_template, parse_frames
from .output import check_suffix, check_writable
from .placed_frame import surface_frame
from .progress import FractionBar
from .sampling import int_range

if TYPE_CHECKING:
    from ..engine.session import PosedObject, Session

Array = np.ndarray
#: Name of an object, where its light goes, its UV map if that is an image.
Target = tuple[str, Path, Path | None]

EXAMPLES = """examples:
  drgs bake shot.drgsframe --object Robot robot.npy
  drgs bake shot.drgsframe --object Robot robot.exr robot_uvs.npy --size 2048 --light diffuse
  drgs bake 'shot_####.drgsframe' --frames 1-24 --object Robot 'robot_####.npy' --samples 512
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs bake``."""
    parser.add_argument("input", type=Path, metavar="FRAME", help="a frame that Blender exported")
    parser.add_argument(
        "--object", nargs="+", action="append", required=True, metavar="VALUE",
        help="NAME OUT.npy, or NAME OUT.exr UVS.npy: an object, the file to write, and for an image its UV map, "
        "(m, 3, 2), one a face corner; may be given several times",
    )  # fmt: skip
    parser.add_argument("--frames", help="frames: #### in FRAME and OUT becomes the number; 1-24")
    parser.add_argument("--size", type=int_range(16, 16384), default=1024, metavar="N", help="image side; default 1024")
    parser.add_argument(
        "--light", choices=("all", "diffuse"), default="all",
        help="all light with highlights as seen along the normal, or the view-independent part; default all",
    )  # fmt: skip
    parser.add_argument(
        "--samples", type=int_range(3, 65536), default=256, metavar="N", help="samples a point; default 256"
    )


def run(args: argparse.Namespace) -> int:
    """Bake one frame, or all of a sequence."""
    from ..engine.session import Session

    targets = [_target(values) for values in args.object]
    steps = [(args.input, targets)]
    if args.frames is not None:
        numbers = parse_frames(args.frames)
        for _, out, _ in targets:
            check_template(str(out), numbers)
        steps = [
            (frame_path(str(args.input), n), [(name, frame_path(str(out), n), uvs) for name, out, uvs in targets])
            for n in numbers
        ]
    session = Session()
    with FractionBar(args, "baking") as progress:
        for i, (path, named) in enumerate(steps):
            _bake(args, session, path, named, partial(_report_progress, progress, i, len(steps)))
    return 0


def _report_progress(progress: Callable[[str, float], None], done: int, count: int, part: float) -> None:
    progress("", (done + part) / count)


def _target(values: list[str]) -> Target:
    """What one ``--object`` asks for."""
    if not 2 <= len(values) <= 3:
        raise UsageError("--object", f"has {len(values)} values", "Give NAME OUT.npy, or NAME OUT.exr UVS.npy")
    check_suffix(Path(values[1]), (".npy",) if len(values) == 2 else (".exr",))
    return values[0], Path(values[1]), Path(values[2]) if len(values) == 3 else None


def _bake(
    args: argparse.Namespace, session: Session, path: Path, targets: list[Target], report: Callable[[float], None]
) -> None:
    """Bake the objects of one frame."""
    from ..build.bake import picture, texel_points, vertex_points
    from ..build.relit import light_components, own_surfels
    from ..formats.exr import write_exr_picture

    frame = surface_frame(path, args.samples, session)
    prepared, posed = session.prepare(frame)
    tree = prepared.surfel_bvh
    index = {item.state.name: i for i, item in enumerate(posed)}
    for k, (name, out, uvs) in enumerate(targets):
        if name not in index:
            known = ", ".join(index) or "none"
            raise UsageError(f"--object {name}", f"is not in {path}, which has {known}", "Choose one of them")
        check_writable(out, (path, uvs))
        item = posed[index[name]]
        if not len(item.mesh.faces):
            raise UsageError(f"object {name}", "has no mesh that light could be baked to", "Import it with a mesh")
        texel = None
        if uvs is None:
            points = vertex_points(item.mesh)
        else:
            points, texel = texel_points(item.mesh, _uvs_of(uvs, item), args.size)
        if tree is not None:
            points = own_surfels(points, index[name], float(tree.sizes(len(posed))[index[name]]))
        components = light_components(
            prepared.scene, prepared.environment, points, frame.settings, prepared.lights, tree
        )
        report((k + 1) / len(targets))
        colours = components[:, : 4 if args.light == "all" else 2].sum(axis=1)
        if texel is None:
            _write_npy(out, colours)
        else:
            write_exr_picture(out, picture(colours, texel, args.size))
        print(f"{out}: {len(colours)} {'vertices' if texel is None else 'texels'} of {name}")


def _uvs_of(path: Path, item: PosedObject) -> Array:
    """The UV map in the order of the corners of the object's traced faces, which a mirrored object turns round."""
    try:
        uvs = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UsageError(str(path), f"cannot be read ({error})", "Save the UV map with numpy.save") from error
    faces = len(item.mesh.faces)
    if uvs.shape != (faces, 3, 2):
        raise UsageError(str(path), f"has shape {uvs.shape}, expected ({faces}, 3, 2)", "Use the object's own UV map")
    return uvs[:, [0, 2, 1]] if np.linalg.det(item.state.matrix_world[:3, :3]) < 0 else uvs


def _write_npy(path: Path, values: Array) -> None:
    """Write one array in one step. Raises WriteError."""
    data = io.BytesIO()
    np.save(data, values.astype(np.float32), allow_pickle=False)
    replace_file(path, [data.getbuffer()])
