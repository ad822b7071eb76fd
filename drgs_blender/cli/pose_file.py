"""Poses in files: the vertices of a mesh, in the order of an asset or of the mesh that it was made from."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..core.asset.model import Mesh
from ..core.errors import AssetError, UsageError


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
    own, source, made_from = len(mesh.vertices), mesh.source, mesh.source_count
    fitting = [name for name, count in (("asset", own), ("source", made_from)) if len(vertices) == count]
    if not fitting or (order and order not in fitting):
        there = f"the asset has {own}, the mesh it was made from {made_from}"
        raise AssetError(subject, f"has {len(vertices)} vertices; {there}", "Pose this asset, or that mesh")
    if source is None:
        return vertices
    if len(fitting) > 1 and order is None:
        problem = f"has {own} vertices, as the asset and the mesh it was made from, whose orders differ"
        raise UsageError(subject, problem, "Say which with --vertex-order asset or --vertex-order source")
    return source.to_asset(vertices) if (order or fitting[0]) == "source" else vertices


def read_vertices(path: Path) -> np.ndarray:
    """Read a pose; only its form is checked here, its length by `in_asset_order`."""
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
