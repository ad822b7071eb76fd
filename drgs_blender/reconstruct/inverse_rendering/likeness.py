"""Which vertices are of one material, as far as photographs show it without knowing the light.

Features of a vertex, from its pixels in all views: chromaticity and brightness of its darkest quarter, where highlights
are not, and by how much its brightness changes from view to view, a score of how much it reflects.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from ...core.arrays import Array
from .pixels import Pixels
from .radiance_cache import filled
from .surface import Pairs

#: Quantiles of brightness: the one taken for a vertex's own, those whose ratio is its score, and how wide each is.
_DARK, _LOW, _HIGH, _WIDE = 0.25, 0.2, 0.8, 0.1
#: Differences that count as much: of chromaticity, log brightness and score, and of place in parts of the extent.
_CHROMA, _BRIGHTNESS, _SCORE, _PLACE = 0.03, 0.5, 0.4, 0.25
#: Brightness below which its logarithm flattens out.
_KNEE = 0.02
#: Vertices among which others look for their like, how many each finds, and pairs of a step.
_ANCHORS, _NEAREST, _PAIRS = 4096, 12, 4096


def features(pixels: Pixels, count: int, edges: Array) -> Array:
    """Features of `count` points in units of differences that count.

    Returns
    -------
    (v, 4) float32 array
        Chromaticity (two), log brightness, score; points that no photograph shows take the mean of their
        neighbours along `edges` (e, 2), in turn.
    """
    pixel, column = np.nonzero(pixels.share > 0)
    corner, share = pixels.index[pixel, column], pixels.share[pixel, column]
    log = np.log(pixels.colour.mean(axis=1) + _KNEE)[pixel]
    order = np.lexsort((log, corner))
    corner, share, log = corner[order], share[order].clip(1e-6), log[order, None]
    colour = pixels.colour[pixel[order]]
    total = np.bincount(corner, share, count)
    before = np.cumsum(share, dtype=np.float64) - 0.5 * share - (np.cumsum(total) - total)[corner]
    place = before / total[corner]

    def at(part: float, values: Array) -> Array:
        """Mean of `values` near a quantile of each vertex."""
        near = share * np.exp(-(((place - part) / _WIDE) ** 2)) + 1e-9
        whole = np.maximum(np.bincount(corner, near, count), 1e-12)
        return np.stack([np.bincount(corner, near * column, count) for column in values.T], 1) / whole[:, None]

    dark = at(_DARK, colour)
    chroma = dark / np.maximum(dark.sum(axis=1, keepdims=True), 1e-4)
    score = at(_HIGH, log) - at(_LOW, log)
    found = np.column_stack([chroma[:, :2] / _CHROMA, at(_DARK, log) / _BRIGHTNESS, score / _SCORE])
    return filled(found, total > 1e-3, edges)


class LikePoints:
    """Pairs of near vertices, or surfels, that photographs show alike, as a joint bilateral filter weighs them.

    Parameters
    ----------
    features : (v, 4) float32 array
    places : (v, 3) float32 array
    seed : int
    """

    def __init__(self, features: Array, places: Array, seed: int) -> None:
        extent = max(float(np.ptp(places, axis=0).max()), 1e-12)
        points = np.column_stack([features, places / (_PLACE * extent)])
        most = min(_ANCHORS, len(points))
        anchors = np.sort(np.random.default_rng(seed).choice(len(points), most, replace=False))
        far, near = (x.reshape(len(points), -1) for x in cKDTree(points[anchors]).query(points, min(_NEAREST, most)))
        self._like, self._weight = anchors[near], np.exp(-0.5 * far**2).astype(np.float32)

    def draw(self, generator: np.random.Generator) -> Pairs:
        """The pairs of a step."""
        one = generator.integers(0, len(self._like), _PAIRS)
        each = generator.integers(0, self._like.shape[1], _PAIRS)
        both = np.stack([one, self._like[one, each]], -1)
        return Pairs(torch.from_numpy(both), torch.from_numpy(self._weight[one, each]))
