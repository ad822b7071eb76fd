"""Proxy meshes in files: what carries the surfels of an asset without a mesh."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ..core.asset import Asset
from ..core.asset.model import Mesh
from ..core.errors import AssetError, UsageError

#: Times the surfels' size from which on a proxy is taken for one in another unit.
_LARGE = 20


def add_proxy(parser: argparse._ActionsContainer, more: str) -> None:
    """Declare the option; `more` says what the command does with it."""
    what = "mesh at rest that carries the surfels of an asset without one, in its space, metres"
    parser.add_argument("--proxy", type=Path, metavar="MESH", help=f"{what}: {more}")


def read_proxy(path: Path, asset: Asset, subject: str) -> Mesh:
    """The mesh at `path`, for an asset without one, which messages call `subject`.

    Raises
    ------
    AssetError
        The file is damaged, has no faces, is not finite, or is nowhere near the surfels.
    UsageError
        The asset has a mesh.
    """
    from ..formats.registry import read_mesh

    if len(asset.mesh.faces):
        raise UsageError(f"--proxy {path}", f"is not needed: {subject} has a mesh", "Leave it out")
    file = read_mesh(path)
    vertices, faces = np.ascontiguousarray(file.vertices, np.float32), np.ascontiguousarray(file.faces, np.int32)
    if not len(faces) or not np.isfinite(vertices).all():
        raise AssetError(f"--proxy {path}", "has no faces, or vertices that are not finite", "Clean the mesh up")
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    if not np.cross(b - a, c - a).any():
        raise AssetError(f"--proxy {path}", "has faces without area", "Choose a closed mesh around the surfels")
    centre, used = asset.surfels.centre, vertices[np.unique(faces)]
    low, high = centre.min(axis=0), centre.max(axis=0)
    size, own = float(np.ptp(used, axis=0).max()), float((high - low).max())
    if size > _LARGE * own:
        problem = f"is {size:.3g} m large, the surfels of {subject} {own:.3g} m"
        raise AssetError(f"--proxy {path}", problem, "Save it in metres")
    if (used.max(axis=0) < low).any() or (used.min(axis=0) > high).any():
        remedy = "Save it in the space of the surfels, Z up"
        raise AssetError(f"--proxy {path}", f"is not where the surfels of {subject} are", remedy)
    grey = np.full((len(vertices), 3), 0.5, np.float32)
    return Mesh(vertices, faces, grey, np.ones(len(vertices), np.float32), np.zeros(len(vertices), np.float32))
