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
from ..meshing.crops import cropped_views
from .gaussians import Gaussians

log = logging.getLogger(__name__)

#: Degrees from which on the normals of surfels and mesh count as different.
MIN_ANGLE = 40.0
#: Fraction of pixels with different normals from which on an object is thin: a fern has 0.17, a helmet with straps and
#: rivets 0.02, round objects less.
THIN_FRACTION = 0.06
#: Views sampled, at most.
SAMPLED_VIEWS = 15


def normals_of(gaussians: Gaussians) -> Normals:
    """Function that renders the normals of surfels in a view."""

    def shown(view: View) -> Array:
        with torch.no_grad():
            return gaussians.render(view.camera, torch.zeros(3), 0, reflections=False).normal.numpy(force=True)

    return shown


def is_thin(gaussians: Gaussians, mesh: Mesh, views: list[View]) -> bool:
    """Whether normals of the mesh and of the surfels that it was made from have little to do with each other."""
    tree = TriangleBVH(mesh.vertices, mesh.faces)
    smooth = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    cosines, shown = [], normals_of(gaussians)
    sampled = cropped_views(views[:: math.ceil(len(views) / SAMPLED_VIEWS)], mesh.vertices)
    for index, view in enumerate(sampled):
        pixels = pixels_of(index, view, mesh, tree)
        own = unit(shown(view).reshape(-1, 3)[pixels.place], (0, 0, 0))
        by_mesh = unit(pixels.blended(smooth))
        known = (own != 0).any(axis=1)
        cosines.append(np.einsum("nc,nc->n", own, by_mesh)[known])
    different = float((np.concatenate([*cosines, [1.0]]) < math.cos(math.radians(MIN_ANGLE))).mean())
    thin = different > THIN_FRACTION
    log.info("normals of surfels and mesh differ in %.1f %% of pixels%s", 100 * different, ": thin" if thin else "")
    return thin
