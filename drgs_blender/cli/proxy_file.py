"""Proxy meshes in files: what carries the surfels of an asset without a mesh."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ..core.asset import Asset
from ..core.asset.model import Mesh
from ..core.errors import AssetError, UsageError

HELP = "mesh at rest that carries the surfels of an asset without one, in its space, metres"


def add_proxy(parser: argparse._ActionsContainer, more: str) -> None:
    """Declare the option; `more` says what the command does with it."""
    parser.add_argument("--proxy", type=Path, metavar="MESH", help=f"{HELP}: {more}")


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
    centre = asset.surfels.centre
    low, high = centre.min(axis=0), centre.max(axis=0)
    if (vertices.max(axis=0) < low).any() or (vertices.min(axis=0) > high).any():
        remedy = "Save it in the space of the surfels, Z up"
        raise AssetError(f"--proxy {path}", f"is not where the surfels of {subject} are", remedy)
    grey = np.full((len(vertices), 3), 0.5, np.float32)
    return Mesh(vertices, faces, grey, np.ones(len(vertices), np.float32), np.zeros(len(vertices), np.float32))
