"""Surfels and a mesh carried along by sources: simulated particles, or any mesh or cloud that deforms."""

from __future__ import annotations

import numpy as np

from ..compute.jit import njit
from ..compute.threads import ELEMENTS, over_range
from ..core.asset.model import Asset, PosedSurfels
from ..core.errors import AssetError
from ..geometry.occupancy import Volume
from .gmls import bind_points, carry
from .mesh_driven import MeshDriven

Array = np.ndarray


class SourceDriven:
    """Poses an asset from the positions and deformation gradients of sources around it.

    Parameters
    ----------
    asset : Asset
        Bound surfels and mesh at rest, object space.
    sources : (s, 3) array
        At rest, in the space of the asset.
    space : Volume, optional
        As of `gmls.bind_points`.
    parts : array, optional
        As of `gmls.bind_points`.

    Attributes
    ----------
    turned : int
        Surfels and vertices of the last pose at which the blend would have been inside out.
    """

    def __init__(
        self, asset: Asset, sources: Array, *, space: Volume | None = None, parts: Array | None = None
    ) -> None:
        if asset.binding is None:
            raise AssetError("asset", "has surfels that are not bound", "Import it again")
        # As the renderer shows it at rest; its shading normals are the smooth ones.
        self._rest = MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(asset.mesh.vertices)
        self._surfels = bind_points(self._rest.centre, sources, space=space, parts=parts)
        self._vertices = bind_points(asset.mesh.vertices, sources, space=space, parts=parts)
        self.turned = 0

    @property
    def separated(self) -> int:
        """Surfels and vertices that had sources across a gap, which do not carry them."""
        return self._surfels.separated + self._vertices.separated

    def vertices(self, x: Array, gradients: Array) -> Array:
        """(n, 3) float32 vertices of the mesh, in the space of `x`."""
        points, _, self.turned = carry(self._vertices, x, gradients)
        return points.astype(np.float32)

    def pose(self, x: Array, gradients: Array, *, object_index: int = 0) -> PosedSurfels:
        """Surfels of one frame.

        Parameters
        ----------
        x : (s, 3) array
            The sources now.
        gradients : (s, 3, 3) array
            Their deformation gradients.
        object_index : int
            Index into Frame.objects, copied to every surfel.

        Returns
        -------
        PosedSurfels
            In the space of `x`. Tangents are F T and normals cof(F) n, exactly.
        """
        centre, at, self.turned = carry(self._surfels, x, gradients)
        rest = self._rest
        u, v, normal = (np.empty((len(centre), 3), np.float32) for _ in range(3))
        frames = rest.tangent_u, rest.tangent_v, rest.normal
        over_range(_update, len(at), at.reshape(-1, 9), *frames, u, v, normal, fewest=ELEMENTS)
        return PosedSurfels(
            centre.astype(np.float32), u, v, normal, rest.opacity, rest.albedo, rest.roughness, rest.metallic,
            np.full(len(centre), object_index, np.int32),
        )  # fmt: skip


@njit
def _update(first, last, gradients, tangent_u, tangent_v, normal, out_u, out_v, out_normal):  # type: ignore[no-untyped-def]
    """F T and normalised cof(F) n; the rest normal where F collapses space onto a line."""
    for i in range(first, last):
        f = gradients[i]
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        a = (f[4] * f[8] - f[5] * f[7]) * x + (f[5] * f[6] - f[3] * f[8]) * y + (f[3] * f[7] - f[4] * f[6]) * z
        b = (f[2] * f[7] - f[1] * f[8]) * x + (f[0] * f[8] - f[2] * f[6]) * y + (f[1] * f[6] - f[0] * f[7]) * z
        c = (f[1] * f[5] - f[2] * f[4]) * x + (f[2] * f[3] - f[0] * f[5]) * y + (f[0] * f[4] - f[1] * f[3]) * z
        length = np.sqrt(a * a + b * b + c * c)
        if length > np.float32(1e-20):
            x, y, z = a / length, b / length, c / length
        out_normal[i, 0], out_normal[i, 1], out_normal[i, 2] = x, y, z
        for r in range(3):
            out_u[i, r] = f[3 * r] * tangent_u[i, 0] + f[3 * r + 1] * tangent_u[i, 1] + f[3 * r + 2] * tangent_u[i, 2]
            out_v[i, r] = f[3 * r] * tangent_v[i, 0] + f[3 * r + 1] * tangent_v[i, 1] + f[3 * r + 2] * tangent_v[i, 2]
