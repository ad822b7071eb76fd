"""Layers of each sub-pixel sample: surfels, an ordinary mesh, a hole or background.

Surfels are blended on their own; the nearest ordinary mesh on the camera's ray then hides them, or fills what they
leave free behind them. A holdout hides what lies behind it and is not seen itself; a shadow catcher is a surface that
hides nothing by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ..scene.ray_masks import CATCHER, HOLDOUT, ORDINARY
from ..scene.trace_scene import TraceScene
from ..surfels.raster import SurfelSamples
from .camera_hits import trace_camera
from .mesh_hits import MeshHits

Array = np.ndarray

#: Surfels that leave less of a mesh behind them free than this (a contribution they would skip themselves) hide it.
_LEAST = np.float32(1.0 / 255.0)


@dataclass(slots=True)
class Layers:
    """Weights of the two points of each sub-pixel sample, all (rows, width, subpixels) float32.

    Attributes
    ----------
    first : array
        Surfels.
    second : array or None
        Ordinary meshes, or None when there are none.
    opaque : array
        Share that hides the background, holdouts included.
    hits : MeshHits or None
        Of ordinary meshes, or None when there are none.
    """

    first: Array
    second: Array | None
    opaque: Array
    hits: MeshHits | None


def combine(
    samples: SurfelSamples,
    scene: TraceScene,
    parameters: Array,
    x0: int,
    y0: int,
    trace: Callable[..., MeshHits] = trace_camera,
) -> Layers:
    """Combine blended surfels with the ordinary meshes that the camera sees.

    Parameters
    ----------
    samples : SurfelSamples
    scene : TraceScene
    parameters : array
        `camera.camera_parameters`.
    x0, y0 : int
        Full-picture pixel of the first sample.
    trace : callable
        Function that casts the camera's rays.
    """
    special = bool((scene.object_flags & (HOLDOUT | CATCHER)).any())
    if not scene.any_ordinary and not special:
        return Layers(samples.alpha, None, samples.alpha, None)
    hits = trace(scene, parameters, x0, y0, samples.alpha.shape, ORDINARY if scene.any_ordinary else 0)
    first, second, opaque = (np.empty_like(samples.alpha) for _ in range(3))
    seen = samples.alpha, samples.depth, samples.object_index
    met, out = (hits.depth, hits.owner), (first, second, opaque)
    over_range(_combine, len(first), seen, met, scene.object_flags, out, fewest=ROWS)
    return Layers(first, second, opaque, hits)


def lone(hits: MeshHits, scene: TraceScene) -> Layers:
    """Layers of meshes alone."""
    nothing = np.zeros(hits.depth.shape, np.float32)
    first, second, opaque = (np.empty_like(nothing) for _ in range(3))
    none = np.zeros(hits.depth.shape, np.int32)
    met, out = (hits.depth, hits.owner), (first, second, opaque)
    over_range(_combine, len(first), (nothing, nothing, none), met, scene.object_flags, out, fewest=ROWS)
    return Layers(second, None, opaque, hits)


@njit
def _combine(y0, y1, seen, met, object_flags, out):  # type: ignore[no-untyped-def]
    """Fill `out`, the three arrays of `Layers`, from alpha, depth and owner of surfels, and depth and owner of hits."""
    alpha, depth, owner = seen
    mesh_depth, mesh_owner = met
    first, second, opaque = out
    zero, one = np.float32(0.0), np.float32(1.0)
    _, columns, subpixels = alpha.shape
    for y in range(y0, y1):
        for x in range(columns):
            for k in range(subpixels):
                a = alpha[y, x, k]
                m = mesh_owner[y, x, k]
                if a > zero and m >= 0:
                    if mesh_depth[y, x, k] < depth[y, x, k]:
                        a = zero
                    elif one - a < _LEAST:
                        a, m = one, -1
                b = one - a if m >= 0 else zero
                hidden = a + b
                if a > zero:
                    flags = object_flags[owner[y, x, k]]
                    if flags & HOLDOUT:
                        a = zero
                    elif flags & CATCHER:
                        hidden -= a
                if b > zero:
                    flags = object_flags[m]
                    if flags & HOLDOUT:
                        b = zero
                    elif flags & CATCHER:
                        hidden -= b
                first[y, x, k], second[y, x, k], opaque[y, x, k] = a, b, hidden
