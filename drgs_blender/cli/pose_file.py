"""Poses in files: the vertices of a mesh, in the order of an asset or of the mesh that it was made from.

One pose is a NumPy array (.npy), the poses of many frames are a point cache (.pc2, .mdd).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from ..core.asset.model import Mesh
from ..core.errors import AssetError, UsageError

if TYPE_CHECKING:
    from ..formats.point_cache import PointCache


def add_vertex_order(parser: argparse.ArgumentParser) -> None:
    """Add the option of how a pose's vertices are ordered."""
    parser.add_argument(
        "--vertex-order", choices=("asset", "source"),
        help="whether --vertices are in the order of the asset or of the mesh that it was made from; default: as their "
        "number says",
    )  # fmt: skip


def check_vertex_order(args: argparse.Namespace) -> None:
    """Raise UsageError where an order is given and no pose."""
    if args.vertex_order and not args.vertices:
        raise UsageError("--vertex-order", "is that of --vertices, and there are none", "Leave it out")


def in_asset_order(args: argparse.Namespace, mesh: Mesh, vertices: np.ndarray) -> np.ndarray:
    """A pose, (n, 3), in the order of an asset's mesh.

    Raises
    ------
    AssetError
        The number of vertices fits neither the asset nor its source; names the file.
    UsageError
        It fits both, and the order is not said.
    """
    subject, order = f"--vertices {args.vertices}", args.vertex_order
    own, source, fitting = len(mesh.vertices), mesh.source, mesh.orders_of(len(vertices))
    if not fitting or (order and source is not None and order not in fitting):
        there = f"the asset has {own}, the mesh it was made from {mesh.source_count}"
        raise AssetError(subject, f"has {len(vertices)} vertices; {there}", "Pose this asset, or that mesh")
    if source is None:
        return vertices
    if len(fitting) > 1 and order is None:
        differing = "whose axes or units differ" if source.in_order else "whose orders differ"
        problem = f"has {own} vertices, as the asset and the mesh it was made from, {differing}"
        raise UsageError(subject, problem, "Say which with --vertex-order asset or --vertex-order source")
    return source.to_asset(vertices) if (order or fitting[0]) == "source" else vertices


#: Number of a frame, and what reads its pose.
Poses = Sequence[tuple[int, Callable[[], np.ndarray]]]


def is_point_cache(path: Path | None) -> bool:
    """Whether a file of poses has those of many frames."""
    from ..formats.point_cache import SUFFIXES

    return path is not None and path.suffix.lower() in SUFFIXES


def open_cache(path: Path) -> PointCache:
    """A point cache that is given with --vertices.

    Raises
    ------
    AssetError, UsageError
        The file is damaged, or not there.
    """
    from ..formats.point_cache import read_point_cache

    if not path.is_file():
        problem = "is not a regular file" if path.exists() else "does not exist"
        raise UsageError(f"--vertices {path}", problem, "Check the path")
    return read_point_cache(path)


def read_poses(path: Path, frames: Sequence[int] | None = None, cache: PointCache | None = None) -> Poses:
    """Poses of a point cache; by default of all its frames.

    Parameters
    ----------
    path : Path
    frames : sequence of int, optional
    cache : PointCache, optional
        What `open_cache` has read of it.

    Raises
    ------
    AssetError, UsageError
        The file is damaged, not there, or lacks one of the frames.
    """
    cache = open_cache(path) if cache is None else cache
    there = range(cache.first, cache.first + len(cache.frames))
    frames = there if frames is None else frames
    if missing := [frame for frame in frames if frame not in there]:
        raise UsageError("--frames", f"wants frame {missing[0]}; {path} has {there[0]} to {there[-1]}", "Choose others")

    def pose(frame: int) -> Callable[[], np.ndarray]:
        return lambda: np.ascontiguousarray(cache.frames[frame - cache.first], np.float32)

    return [(frame, pose(frame)) for frame in frames]


def read_vertices(path: Path, frame: int | None = None) -> np.ndarray:
    """Read a pose; only its form is checked here, its length by `in_asset_order`.

    Parameters
    ----------
    path : Path
    frame : int, optional
        Of a point cache; None: its only one.
    """
    if is_point_cache(path):
        poses = read_poses(path, None if frame is None else [frame])
        if len(poses) > 1:
            problem = f"has the frames {poses[0][0]} to {poses[-1][0]}"
            raise UsageError(f"--vertices {path}", problem, f"Say which: --frames {poses[0][0]}, or write #### in OUT")
        return poses[0][1]()
    subject = f"--vertices {path}"
    remedy = "Save it with numpy.save(path, vertices), an (n, 3) array of numbers"
    try:
        if path.exists() and not path.is_file():
            raise UsageError(subject, "is not a regular file", remedy)
        with open(path, "rb") as file:
            shape, dtype = _npy_header(file)
            available = path.stat().st_size - file.tell()
            if dtype.kind not in "fiu":
                raise UsageError(subject, f"holds values of type {dtype.name}, not real numbers", remedy)
            if len(shape) != 2 or shape[1] != 3:
                raise UsageError(subject, f"has shape {shape}, expected (n, 3) numbers", remedy)
            needed = math.prod(shape) * dtype.itemsize
            if needed > available:
                problem = f"is truncated: {shape} {dtype.name} are {needed} bytes, {available} are there"
                raise UsageError(subject, problem, remedy)
            file.seek(0)
            array = np.load(file, allow_pickle=False)
    except OSError as error:
        raise UsageError(subject, f"cannot be read ({error.strerror or error})", "Check the path") from error
    except (ValueError, EOFError, SyntaxError, RecursionError, MemoryError) as error:
        raise UsageError(subject, "is not a .npy file of one array of numbers", remedy) from error
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, dtype=np.float32)


def _npy_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """(shape, dtype) that a .npy file declares; ValueError where it is none."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"unknown version {version}")
    shape, _, dtype = read(file)
    return shape, dtype
