"""Normals of a fused mesh from the surfels': both are estimates of the same, with errors of their own.

The mesh has the slopes of depth maps, which many views even out; surfels have normals that photographs taught them,
flat on facets and sharp at edges. The mean of both is nearer to the truth than either.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...geometry.normals import VertexNormals, unit
from ..capture.capture import View
from ..inverse_rendering.pixels import Normals, onto_vertices

#: Least cosine between both; a surfel's normal that is farther off is of something else.
ALIKE = 0.5


def with_surfel_normals(mesh: Mesh, views: list[View], normals: Normals) -> Array:
    """Mean of the smooth vertex normals of `mesh` and of the `normals` that `views` show there.

    Parameters
    ----------
    mesh : Mesh
    views : list of View
    normals : callable
        Gives those of a view's pixels.

    Returns
    -------
    (v, 3) float32 array
        Unit; those of the mesh where no view shows a vertex, or something else.
    """
    own = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    shown = unit(onto_vertices(mesh, views, lambda view: unit(normals(view), (0, 0, 0))), (0, 0, 0))
    alike = (shown * own).sum(axis=1, keepdims=True) > ALIKE
    return unit(own + np.where(alike, shown, 0)).astype(np.float32)
