"""The domain of materials while they are learned: the vertices of a mesh, or surfels (`surfel_domain`).

Either way a pixel shows a few points, each with its share, and rays from it meet an opaque surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...core.errors import AssetError
from ...geometry.normals import VertexNormals
from ...render.scene.triangle_bvh import TriangleBVH
from ..capture.capture import Capture
from ..model.gaussians import Gaussians
from .pixels import Pixels, of_training_views, pixels_of
from .radiance_cache import edges_of
from .settings import Settings


@dataclass(frozen=True, slots=True)
class Domain:
    """Points that have materials, and how photographs and rays meet them.

    Attributes
    ----------
    points : (v, 3) float32 array
        World space.
    normals : (v, 3) float32 array
        Their unit normals to begin with.
    edges : (e, 2) int64 array
        Pairs of points that lie side by side, each once.
    pixels : Pixels
        Of the training views.
    occluder : Mesh
        What rays meet.
    tree : TriangleBVH
        Of its triangles.
    owner : (w,) int64 array
        Point of each vertex of the occluder.
    surfels : Gaussians, optional
        Where the points are surfels: seen from either side, and normals of neighbours may be on different ones.
    """

    points: Array
    normals: Array
    edges: Array
    pixels: Pixels
    occluder: Mesh
    tree: TriangleBVH
    owner: Array
    surfels: Gaussians | None = None


def mesh_domain(capture: Capture, mesh: Mesh, settings: Settings, normals: Array | None = None) -> Domain:
    """The vertices of a mesh; parameters and errors are those of `run.decouple`, `normals` its `start`."""
    if not len(mesh.faces):
        raise AssetError("mesh", "has no faces", "Decoupling needs the surface")
    tree = TriangleBVH(mesh.vertices, mesh.faces)
    pixels = of_training_views(capture, settings, lambda k, view: pixels_of(k, view, mesh, tree))
    if normals is None:
        normals = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    return Domain(mesh.vertices, normals, edges_of(mesh.faces), pixels, mesh, tree, np.arange(len(mesh.vertices)))
