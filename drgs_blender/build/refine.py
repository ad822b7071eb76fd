"""A mesh divided until its vertices hold the detail of its textures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .texture import Materials
from .topology import Net, close_marks, edge_lengths, edges, subdivide, survivors

Array = np.ndarray

#: Triangles that subdivision for texture detail may reach.
MAX_TRIANGLES = 150_000
#: Largest error of the interpolated materials, of square-root albedo, roughness and metallic, before an edge is split.
TOLERANCE = 0.05
#: Edges are not split below this part of the mesh's diagonal.
FINEST = 1 / 1500
#: A vertex averages its texture over this part of its mean edge.
FOOTPRINT = 0.7
#: Texture compared with the interpolation is averaged over this part of an edge, so that finer detail is noticed.
EDGE_FOOTPRINT = 0.1
#: Rounds of subdivision at most.
ROUNDS = 16


def refine(net: Net, materials: Materials, tolerance: float, max_triangles: int) -> tuple[Net, Array, int, int]:
    """Divide edges until interpolated vertex materials follow the textures, or the budget is reached.

    Returns
    -------
    net : Net
        The divided mesh.
    values : (n, channels) float32 array
        Of its vertices: the mean over their corners of the textures around them.
    rounds : int
        Rounds done.
    unresolved : int
        Edges still above the tolerance.
    """
    finest = FINEST * float(np.linalg.norm(np.ptp(net.vertices, axis=0)))
    (edge, count), lengths = edges(net), edge_lengths(net)
    fit = _TextureFit(net, edge, lengths, materials)
    for done in range(ROUNDS + 1):
        error = np.zeros(count)
        np.maximum.at(error, edge.reshape(-1), fit.errors.reshape(-1))
        length = np.zeros(count)
        np.maximum.at(length, edge.reshape(-1), lengths.reshape(-1))
        wanted = (error > tolerance) & (length > 2 * finest)
        unresolved = int((error > tolerance).sum())
        if not wanted.any() or done == ROUNDS:
            break
        marked = _within_budget(edge, lengths, np.where(wanted, error * length, 0), max_triangles)
        if not marked.any():
            break
        kept = survivors(net, edge, marked)
        net = subdivide(net, edge, marked)
        (edge, count), lengths = edges(net), edge_lengths(net)
        fit = _TextureFit(net, edge, lengths, materials, fit, kept)
    return net, fit.values, done, unresolved


def _within_budget(edge: Array, lengths: Array, priority: Array, max_triangles: int) -> Array:
    """Closed marks of as many of the most urgent edges as the budget allows."""
    urgent = np.flatnonzero(priority > 0)
    order = urgent[np.argsort(-priority[urgent], kind="stable")]
    more = np.cumsum(np.bincount(edge.reshape(-1))[order])  # faces that the marks add before they are closed
    take = len(order)
    while take:
        if len(edge) + more[take - 1] <= max_triangles:
            marked = np.zeros(len(priority), bool)
            marked[order[:take]] = True
            marked = close_marks(edge, lengths, marked)
            if len(edge) + int(marked[edge].sum()) <= max_triangles:
                return marked
        take //= 2
    return np.zeros(len(priority), bool)


class _TextureFit:
    """Vertex values of a net and their errors along edges; what a division leaves as it was is not sampled again.

    Parameters
    ----------
    net : Net
    edge : array
        See `topology.edges`.
    lengths : array
        See `topology.edge_lengths`.
    materials : Materials
    before : _TextureFit, optional
        Of the net that was divided.
    kept : array, optional
        `survivors` of the division.

    Attributes
    ----------
    values : (n, channels) float32 array
        Of the vertices.
    errors : (m, 3) array
        Largest difference between textures and interpolated vertex values along each edge of each face. The middle of
        a face counts for its longest edge. Edges about as long as a texel have none.
    """

    def __init__(
        self,
        net: Net,
        edge: Array,
        lengths: Array,
        materials: Materials,
        before: _TextureFit | None = None,
        kept: Array | None = None,
    ) -> None:
        m = len(net.faces)
        if before is None or kept is None:
            new = np.ones(m, bool)
            self._corners = np.empty((materials.width, m, 3), np.float32)
            self._along, self._middle = np.zeros((m, 3)), np.zeros(m)
        else:
            new = kept < 0
            self._corners = before._corners.take(kept, axis=1)
            self._along, self._middle = before._along.take(kept, axis=0), before._middle.take(kept)
        self._corners[:, new] = _at_corners(net, materials, np.flatnonzero(new))
        self.values = _at_vertices(net, materials, self._corners)
        moved = np.zeros(len(net.vertices), bool)  # their values are others than before
        moved[net.faces[new]] = True
        moved = moved[net.faces]

        extent = np.abs(np.roll(net.uvs, -1, axis=1) - net.uvs)
        textured = materials.textured[net.tags[:, 0]]
        coarse = textured[:, None] & (extent.max(axis=-1) > 1.5 * materials.texel_size()[net.tags[:, 0]][:, None])
        compare = _Comparison(net, materials, self.values)
        self._along[new] = 0
        sides = np.flatnonzero(coarse & (moved | np.roll(moved, -1, axis=1)))
        self._along.reshape(-1)[sides] = compare.along(
            edge.reshape(-1)[sides], sides, EDGE_FOOTPRINT * extent.reshape(-1, 2)[sides]
        )
        self._middle[new] = 0
        rows = np.flatnonzero(coarse.any(axis=1) & moved.any(axis=1))
        self._middle[rows] = compare.middle(rows, EDGE_FOOTPRINT * extent[rows].mean(axis=1))
        self.errors = self._along.copy()
        row, longest = np.arange(m), lengths.argmax(axis=1)
        self.errors[row, longest] = np.maximum(self.errors[row, longest], self._middle)


def _at_corners(net: Net, materials: Materials, some: Array) -> Array:
    """Values (channels, s, 3) of the textures around the corners of the faces `some`."""
    uvs = net.uvs[some]
    size = _corner_size(uvs)
    material = np.repeat(net.tags[some, 0], 3)
    found = materials.sample(material, uvs.reshape(-1, 2), FOOTPRINT * size.reshape(-1, 2))
    return found.T.reshape(materials.width, len(some), 3)


def _at_vertices(net: Net, materials: Materials, corners: Array) -> Array:
    """Values (n, channels) float32 of the vertices: the mean over all their corners, channel by channel in memory."""
    flat, n = net.faces.reshape(-1), len(net.vertices)
    count = np.maximum(np.bincount(flat, minlength=n), 1)
    values = np.stack([np.bincount(flat, channel.reshape(-1), n) / count for channel in corners])
    values[:3] *= net.values[:, :3].T
    own = net.values[:, 3:].T
    np.copyto(values[3:], own, where=np.isfinite(own))
    return materials.clipped(values).astype(np.float32).T


def _corner_size(uvs: Array) -> Array:
    """Mean extent (m, 3, 2) in u and v of the two edges at each corner."""
    to_next = np.abs(np.roll(uvs, -1, axis=1) - uvs)
    return 0.5 * (to_next + np.roll(to_next, 1, axis=1))


class _Comparison:
    """Textures compared with what is interpolated between vertices.

    Parameters
    ----------
    net : Net
    materials : Materials
    values : (n, channels) float32 array
        Of the vertices.
    """

    def __init__(self, net: Net, materials: Materials, values: Array) -> None:
        self._net, self._materials = net, materials
        self._values = materials.perceived(values.T).astype(np.float64)
        colours = net.values[:, :3].T
        self._colours = None if (colours == 1).all() else np.where(np.isfinite(colours), colours, 1)
        self._given = np.isfinite(net.values.T)  # channels the file gives at its vertices have no textures
        self._given[:3] = False

    def along(self, edge: Array, sides: Array, scale: Array) -> Array:
        """Largest difference (s,) along sides of faces.

        Parameters
        ----------
        edge : (s,) array
            Their edges.
        sides : (s,) array
            3 x face + the corner at which the side begins.
        scale : (s, 2) array
            Width of the area of the textures that is averaged.
        """
        ends = sides, sides + np.where(sides % 3 == 2, -2, 1)
        vertices = [self._net.faces.reshape(-1)[end] for end in ends]
        uvs = [self._net.uvs.reshape(-1, 2)[end] for end in ends]
        # Two faces of an edge see the same from both sides, unless it is a seam.
        first = np.empty(edge.max(initial=-1) + 1, np.int64)
        first[edge[::-1]] = np.arange(len(edge))[::-1]
        other = first[edge]
        known = (vertices[0] == vertices[1][other]) & (vertices[1] == vertices[0][other])
        for end in (0, 1):
            known &= (uvs[end] == uvs[1 - end][other]).all(axis=1)
        new, known = np.flatnonzero(~known), np.flatnonzero(known)
        vertices, uvs = [v[new] for v in vertices], [uv[new] for uv in uvs]
        material = self._net.tags[sides[new] // 3, 0]
        result = np.zeros(len(sides))
        for t in (0.25, 0.5, 0.75):
            found = self._at((1 - t, t), vertices, uvs, material, scale[new])
            result[new] = np.maximum(result[new], found)
        result[known] = result[other[known]]
        return result

    def middle(self, faces: Array, scale: Array) -> Array:
        """Difference (s,) in the middle of `faces`, of textures averaged over areas of width `scale` (s, 2)."""
        vertices, uvs = self._net.faces[faces].T, self._net.uvs[faces].swapaxes(0, 1)
        return self._at((1 / 3, 1 / 3, 1 / 3), vertices, uvs, self._net.tags[faces, 0], scale)

    def _at(
        self, weights: Sequence[float], vertices: Sequence[Array], uvs: Sequence[Array], material: Array, scale: Array
    ) -> Array:
        """Largest difference of all channels at points with these weights of vertices."""
        texture = self._materials.sample(material, _mean(weights, uvs), scale).T
        if self._colours is not None:
            texture[:3] *= _mean(weights, [self._colours.take(vertex, axis=1) for vertex in vertices])
        values = _mean(weights, [self._values.take(vertex, axis=1) for vertex in vertices])
        difference = np.abs(self._materials.perceived(texture) - values)
        for channel, given in zip(difference, self._given):
            if given.any():
                channel[given[vertices[0]]] = 0
        return difference.max(axis=0)


def _mean(weights: Sequence[float], values: Sequence[Array]) -> Array:
    """Sum of the weighted values, in their order."""
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total += weight * value
    return total
