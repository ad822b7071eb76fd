"""Render an asset under an environment, without Blender: a picture, or those of a simulation, from a camera in a file.

Without a camera file the picture frames the asset from the front, or from all around. The file holds matrix_world (4
rows of 4 numbers, camera to world, metres: the world is Z up; the camera looks along its own -Z, its own Y is up),
width, height, and fov_x in degrees or fx, fy, cx, cy in pixels; optionally orthographic, clip_start, clip_end.
docs/command-line.md has a script that writes it in Blender.
"""

from __future__ import annotations

import argparse
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..core import cryptomatte
from ..core.asset import Asset
from ..core.asset.model import Mesh
from ..core.errors import UsageError, without_numbers
from ..core.frame import Camera, Frame, Inside, ObjectState, Particles, ProxyMesh, RenderSettings, World
from ..core.frame_sequences import frame_path
from ..core.loading import many_imports
from ..core.particle_cache import ParticleCache, ParticleFrame
from . import sampling
from .camera_file import LARGEST_SIDE, read_camera
from .frame_range import check_template, parse_frames
from .framing import SIZE, framing_camera, sees_any
from .interrupt import interruptible
from .output import check_suffix, check_writable, write_preview
from .pose_file import add_vertex_order, check_vertex_order, in_asset_order, is_point_cache, read_poses, read_vertices
from .progress import FractionBar
from .proxy_file import add_proxy, read_proxy

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs relight helmet.drgs --env studio.hdr --out helmet.png
  drgs relight helmet.drgs --env studio.hdr --orbit 24 --out 'around/####.png'
  drgs relight helmet.drgs --env studio.hdr --camera front.json --out helmet.exr
  drgs relight helmet.drgs --env city.exr --env-rotation 90 --camera front.json --samples 128 --denoise svgf \\
      --passes all --transparent --out helmet.exr
  drgs relight robot.drgs --env city.exr --camera front.json --vertices pose.npy --out pose.png
  drgs relight robot.drgs --env city.exr --camera front.json --vertices walk.pc2 --frames 1-24 --out 'walk/####.exr'
  drgs relight fern.drgs --env city.exr --proxy hull.ply --vertices wind.pc2 --out 'fern/####.exr'
  drgs relight cat.drgs --env city.exr --camera front.json --cache bake --frames 1-48 --out 'cat/####.exr'
  drgs relight room.drgs --captured --camera front.json --out room.png
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs relight``."""
    parser.add_argument("asset", type=Path, metavar="ASSET", help=".drgs file")
    parser.add_argument(
        "--camera", type=Path, metavar="CAMERA.json", help="camera; default: one in front (-Y) that frames the asset"
    )
    parser.add_argument(
        "--orbit", type=sampling.int_range(2, 100_000), metavar="N", help="N pictures from all around, numbered"
    )
    parser.add_argument(
        "--size", type=sampling.int_range(1, LARGEST_SIDE), metavar="N",
        help=f"pixels of a side where no camera is given; default {SIZE}",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE",
        help="EXR frame (linear), or PNG to look at (sRGB, without Blender's view transform AgX)",
    )  # fmt: skip
    light = parser.add_argument_group("light")
    light.add_argument("--env", type=Path, help="lat-long environment (EXR, HDR); default: the asset's own")
    light.add_argument(
        "--env-rotation", type=finite, default=0.0, metavar="DEG", help="Rotation Z of a World Mapping node, degrees"
    )
    light.add_argument("--env-strength", type=finite, default=1.0, metavar="S", help="strength of the environment")
    light.add_argument(
        "--captured", action="store_true",
        help="show the surfels unlit, in the view-dependent colours of their capture; needs no environment (that "
        "of the asset is behind them: --transparent leaves it out)",
    )  # fmt: skip
    pose = parser.add_argument_group("pose").add_mutually_exclusive_group()
    pose.add_argument("--cache", type=Path, metavar="CACHE", help="folder that `drgs simulate` wrote")
    pose.add_argument(
        "--vertices",
        type=Path,
        metavar="V",
        help="pose: the mesh's vertices in object space, metres: (n, 3) array (.npy), or of many frames (.pc2, .mdd)",
    )
    add_proxy(parser, "--vertices are its own, moved")
    add_vertex_order(parser)
    parser.add_argument(
        "--driven-by", choices=("automatic", "surface", "particles"), default="automatic",
        help="what carries the surfels of CACHE: the mesh's faces; the particles; or these only what does not lie on "
        "the mesh (default)",
    )  # fmt: skip
    parser.add_argument(
        "--inside", type=_inside, default=Inside(), metavar="R,G,B[,ROUGHNESS[,METALLIC]]",
        help="material inside of what CACHE has torn apart, linear colour; open: pieces are hollow; default: the means "
        "of the asset",
    )  # fmt: skip
    parser.add_argument(
        "--surface", choices=("automatic", "mesh", "particles"), default="automatic",
        help="what is shown of CACHE: the asset's mesh and surfels, or a surface around the particles; automatic: that "
        "of fluids (default)",
    )  # fmt: skip
    parser.add_argument(
        "--frames", metavar="RANGE", help="of CACHE or V: 12, 1-24, 1-24x2; default: all that are there"
    )
    sampling.add_arguments(parser, defaults=True)


def finite(text: str) -> float:
    """Parser of a finite number."""
    value = sampling.number(text)
    if not abs(value) <= sampling.LARGEST:
        raise argparse.ArgumentTypeError(f"{text} is not a finite number, or too large")
    return value


def positive(text: str) -> float:
    """Parser of a finite number above 0."""
    value = finite(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def _inside(text: str) -> Inside | None:
    """Parser of a material: colour, roughness, metallic."""
    if text == "open":
        return None
    values = [sampling.number(word) for word in text.split(",")]
    if len(values) not in (3, 4, 5) or not all(0 <= value <= 1 for value in values):
        raise argparse.ArgumentTypeError(f"{text} is not open, nor R,G,B[,ROUGHNESS[,METALLIC]] from 0 to 1")
    return Inside((values[0], values[1], values[2]), *values[3:])


def run(args: argparse.Namespace) -> int:
    """Render."""
    check_suffix(args.out, (".exr", ".png"))
    if args.out.suffix.lower() == ".png" and set(args.passes) != {"Combined"}:
        raise UsageError("--passes", "are not in a PNG file, which has Combined alone", "Write EXR, or leave them out")
    given = _given_camera(args)
    settings = sampling.override(RenderSettings(), args)
    sampling.check_size(given or framing_camera(np.zeros((1, 3)), size=args.size or SIZE), args.passes)
    check_vertex_order(args)
    poses, (tear, grain) = _poses(args)
    for number, _ in poses:
        check_writable(frame_path(args.out, number), (args.asset, args.camera, args.env, args.vertices))

    with many_imports():
        from ..engine.session import Session

        session = Session()
    key = session.load_asset(args.asset)
    asset = session.asset(key)
    if args.captured and args.env is None and asset.environment is None:
        world = World(strength=0.0)
    else:
        world = World(read_environment(args, asset), rotation_z(args.env_rotation), strength=args.env_strength)
    state = ObjectState(
        args.asset.stem, key, tear=tear, grain=grain, captured_colours=args.captured, inside=args.inside
    )
    carrier = _carrier(args, asset)
    warned, told = False, set[str]()
    for number, give_pose in poses:
        vertices, particles = give_pose()
        if vertices is not None and args.vertices and carrier is None:
            vertices = in_asset_order(args, asset.mesh, vertices)
        shape = asset.mesh.vertices if vertices is None else vertices
        shape = shape if len(shape) else asset.surfels.centre
        camera = given or framing_camera(shape, 360.0 * (number - 1) / (args.orbit or 1), args.size or SIZE)
        if not warned and not camera.panorama and not sees_any(camera, shape):
            logger.warning("%s is not in the picture: it lies %s. Point the camera there (its clip range too), or "
                           "leave --camera out", args.asset.stem, place_of(shape))  # fmt: skip
            warned = True
        if not warned and not args.captured and (size := size_around(camera.matrix_world[:3, 3], shape)) is not None:
            logger.warning("the camera is inside %s (a box of %s m): move it back", args.asset.stem, size)
            warned = True
        frame = Frame(
            noise_index=number,
            camera=camera,
            objects=[_posed(args, state, asset, carrier, vertices, particles)],
            world=world,
            settings=settings,
            passes=args.passes,
        )
        started = time.perf_counter()
        with FractionBar(args, "rendering") as progress, interruptible() as stopped:
            picture = session.render(frame, progress, stopped)
        for warning in picture.warnings:
            if without_numbers(warning) not in told:
                logger.warning("%s", warning)
        told.update(map(without_numbers, picture.warnings))
        logger.info("frame %d rendered in %.2f s", number, time.perf_counter() - started)
        path = frame_path(args.out, number)
        if path.suffix.lower() == ".png":
            write_preview(path, picture["Combined"])
        else:
            from ..core.asset.container import digest_asset
            from ..render.film.frame_files import write_frame

            about = {"asset": digest_asset(key), "seed": str(settings.seed)}
            write_frame(path, picture, about | cryptomatte.metadata(frame))
        height, width = picture["Combined"].shape[:2]
        print(f"{path}: {width} x {height}, {settings.sample_count} samples")
    return 0


def _carrier(args: argparse.Namespace, asset: Asset) -> Mesh | None:
    """The proxy of an asset without a mesh; UsageError where something moves that carries nothing."""
    subject = str(args.asset)
    if args.proxy is not None:
        if args.vertices is None:
            remedy = "Give its moved --vertices" if args.cache is None else "Leave it out: the particles of CACHE carry"
            raise UsageError(f"--proxy {args.proxy}", "carries nothing at rest", remedy)
        if args.vertex_order:
            raise UsageError("--vertex-order", "is that of an asset's mesh, not of a proxy", "Leave it out")
        return read_proxy(args.proxy, asset, subject)
    if not len(asset.mesh.faces):
        if args.vertices is not None:
            problem = f"are of no mesh: {subject} has surfels alone"
            raise UsageError(f"--vertices {args.vertices}", problem, "Give the mesh they move at rest, with --proxy")
        if args.cache is not None and args.driven_by == "surface":
            raise UsageError("--driven-by surface", f"wants a mesh: {subject} has surfels alone", "Leave it out")
    return None


def _posed(
    args: argparse.Namespace,
    state: ObjectState,
    asset: Asset,
    carrier: Mesh | None,
    vertices: np.ndarray | None,
    particles: Particles | None,
) -> ObjectState:
    """The object as its mesh, its proxy or particles have it; where it has no mesh, these carry all."""
    if carrier is not None and vertices is not None:
        if vertices.shape != carrier.vertices.shape:
            problem = f"has {len(vertices)} vertices, --proxy {args.proxy} has {len(carrier.vertices)}"
            raise UsageError(f"--vertices {args.vertices}", problem, "Pose this proxy")
        return replace(state, proxy=ProxyMesh(carrier.vertices, vertices, carrier.faces))
    if len(asset.mesh.faces) or vertices is None:
        return replace(state, vertices=vertices, particles=particles)
    if particles is None or not particles.surfels:
        problem = "has no mesh that could follow matter that flows"
        raise UsageError(str(args.asset), problem, "Simulate a material that keeps its shape")
    return replace(state, particles=replace(particles, all=True))


def place_of(vertices: np.ndarray) -> str:
    """Where (n, 3) world vertices are, such as "between (-1, -1, 0) and (1, 1, 2) m"."""
    low, high = (", ".join(f"{x:.3g}" for x in corner) for corner in (vertices.min(axis=0), vertices.max(axis=0)))
    return f"between ({low}) and ({high}) m"


def _given_camera(args: argparse.Namespace) -> Camera | None:
    """The camera of the file; None where the asset is to be framed. UsageError where both are wanted."""
    if args.camera is None:
        return None
    for name in ("orbit", "size"):
        if getattr(args, name) is not None:
            raise UsageError(f"--{name}", "is of pictures without --camera", "Leave one of them out")
    return read_camera(args.camera)


def size_around(position: np.ndarray, vertices: np.ndarray) -> str | None:
    """Size of the bounding box of `vertices` where `position` lies in it, such as "0.4 x 0.4 x 0.7"; otherwise None.

    Parameters
    ----------
    position : (3,) float array
        World space, metres.
    vertices : (n, 3) float array
        The same.
    """
    if not len(vertices):
        return None
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    inside = bool(((low < position) & (position < high)).all())
    return " x ".join(f"{side:.2g}" for side in high - low) if inside else None


#: Vertices of the mesh and what carries its surfels; None: they are at rest, or follow the mesh.
_Pose = tuple[np.ndarray | None, Particles | None]


def _poses(args: argparse.Namespace) -> tuple[Sequence[tuple[int, Callable[[], _Pose]]], tuple[float, float]]:
    """Number of each picture with what gives its pose, and `tear` and `grain` of the object."""
    if args.cache is None:
        if args.driven_by == "particles":
            raise UsageError("--driven-by particles", "needs the particles of a simulation", "Give them with --cache")
        for option, given in (("--inside", args.inside != Inside()), ("--surface", args.surface != "automatic")):
            if given:
                raise UsageError(option, "is of the matter of a simulation", "Give one with --cache, or leave it out")
    if is_point_cache(args.vertices) and args.orbit is None:
        poses = read_poses(args.vertices, parse_frames(args.frames) if args.frames else None)
        check_template(str(args.out), [frame for frame, _ in poses])
        return [(frame, partial(_by_mesh, read)) for frame, read in poses], (0.0, 0.0)
    if args.orbit is not None:
        if args.cache is not None or args.vertices is not None or args.frames:
            raise UsageError("--orbit", "is of an asset at rest", "Leave --cache, --vertices and --frames out")
        check_template(str(args.out), list(range(1, args.orbit + 1)))
        return [(number, lambda: (None, None)) for number in range(1, args.orbit + 1)], (0.0, 0.0)
    if args.cache is None:
        if args.frames:
            problem = "are those of a cache"
            raise UsageError("--frames", problem, "Give one with --cache, or a .pc2 or .mdd with --vertices")
        vertices = read_vertices(args.vertices) if args.vertices else None
        return [(1, lambda: (vertices, None))], (0.0, 0.0)
    cache = ParticleCache(args.cache)
    header = cache.header()
    if header is None:
        raise UsageError(f"--cache {args.cache}", "is not the cache of a simulation", "Make one with `drgs simulate`")
    if args.driven_by == "particles" and not header.keeps_shape:
        problem = f"does not work with {args.cache}: its matter flows, so no particle knows how it deforms"
        raise UsageError("--driven-by particles", problem, "Leave it out: surfels follow the mesh")
    frames = parse_frames(args.frames) if args.frames else cache.frames()
    if missing := sorted(set(frames) - set(cache.frames())):
        cache.read(missing[0])  # says which are there
    check_template(str(args.out), frames)
    skin = header.has_skin(args.surface, args.captured)
    driven = args.driven_by if header.keeps_shape else "surface"
    if skin and header.cells is None:
        problem = "was baked before particles had a surface"
        if args.surface == "particles":
            raise UsageError(f"--cache {args.cache}", problem, "Bake again")
        logger.warning("%s %s: the mesh is shown, stretched. Bake again", args.cache, problem)
        skin = False
    closes = header.keeps_shape and header.tear > 0 and not skin
    if closes and args.inside is not None and header.cells is None:
        logger.warning("%s was baked before pieces were closed: what is torn is hollow. Bake again", args.cache)
    if driven == "surface" and not skin and (not closes or header.cells is None):
        give = [(frame, partial(_by_mesh, partial(_vertices, cache, frame))) for frame in frames]
    else:
        rest = cache.rest()
        if closes and header.cells is not None and rest.broken is None:
            problem = "was baked before frames knew what had broken until then: cracks may close again. Bake again"
            logger.warning("%s %s", args.cache, problem)
        rest = replace(rest, points=np.array(rest.points))
        cells = None if header.cells is None else np.array(header.cells, np.float64)
        own = rest.points, rest.points, rest.gradients
        shown = Particles(*own, driven == "particles", cells, driven != "surface", skin)
        give = [(frame, partial(_simulated, cache, frame, rest, shown)) for frame in frames]
    return give, (header.tear, header.grain)


def _by_mesh(read: Callable[[], np.ndarray]) -> _Pose:
    return read(), None


def _vertices(cache: ParticleCache, frame: int) -> np.ndarray:
    return cache.read(frame).vertices


def _simulated(cache: ParticleCache, frame: int, rest: ParticleFrame, shown: Particles) -> _Pose:
    particles, vertices = cache.driving(frame, rest)
    now = {name: getattr(particles, name) for name in ("points", "gradients", "broken")}
    return vertices, replace(shown, **now)


def read_environment(args: argparse.Namespace, asset: Asset) -> np.ndarray:
    """Radiance of the light, (h, w, 3): from a file, or what the asset brought along."""
    if args.env:
        from ..formats.registry import read_environment_file

        file = read_environment_file(args.env)
        for note in file.notes:
            logger.warning("%s: %s", args.env, note)
        return file.environment.radiance
    if asset.environment is None:
        raise UsageError(str(args.asset), "has no captured light", "Give an environment with --env")
    return asset.environment.radiance


def rotation_z(degrees: float) -> np.ndarray:
    """(3, 3) rotation of directions by Rotation Z of a Mapping node."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
