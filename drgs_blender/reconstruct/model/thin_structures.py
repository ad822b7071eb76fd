"""Thin structures, such as leaves: normals of what is thinner than the mesh can be are those of tubes around it.

Surfels have no thickness. Where much of what photographs show is so thin, their own normals are the better ones.
"""

from __future__ import annotations

import logging
import math

import numpy as np
import torch

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...geometry.normals import VertexNormals, unit
from ...render.scene.triangle_bvh import TriangleBVH
from ..capture.capture import View
from ..inverse_rendering.pixels import Normals, pixels_of
from .gaussians import Gaussians

log = logging.getLogger(__name__)

#: Degrees between two normals of different surfaces; part of the pixels where they do that makes a thing thin.
#: A fern has .17 of them, a helmet with straps and rivets .02, round things less.
APART, THIN = 40.0, 0.06
#: Views that are asked.
ASKED = 15


def normals_of(gaussians: Gaussians) -> Normals:
    """What surfels show of normals in a view."""

    def shown(view: View) -> Array:
        with torch.no_grad():
            return gaussians.look(view.camera, torch.zeros(3), 0, mirrors=False).normal.numpy(force=True)

    return shown


def is_thin(gaussians: Gaussians, mesh: Mesh, views: list[View]) -> bool:
    """Whether normals of the mesh and of the surfels that it was made from have little to do with each other."""
    tree = TriangleBVH()
    tree.build(mesh.vertices, mesh.faces)
    smooth = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    cosines = []
    for index, view in enumerate(views[:: math.ceil(len(views) / ASKED)]):
        pixels = pixels_of(index, view, mesh, tree, normals_of(gaussians))
        by_mesh = unit(np.einsum("nk,nkc->nc", pixels.corners, smooth[mesh.faces[pixels.face]]))
        known = (pixels.shown != 0).any(axis=1)
        cosines.append(np.einsum("nc,nc->n", pixels.shown, by_mesh)[known])
    apart = float((np.concatenate([*cosines, [1.0]]) < math.cos(math.radians(APART))).mean())
    thin = apart > THIN
    log.info("normals of surfels and mesh differ in %.1f %% of pixels%s", 100 * apart, ": thin" if thin else "")
    return thin
