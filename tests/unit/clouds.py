"""Clouds of surfels, and what rays meet of them by the definition."""

from __future__ import annotations

import math

import numpy as np

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.render.surfels.surfel_tracer import SurfelHits

Array = np.ndarray


def cloud(n: int, seed: int = 0, size: float = 0.3, opacity: tuple[float, float] = (0.0, 1.0)) -> PosedSurfels:
    """Surfels anywhere in a unit box, of any direction, skewed and mirrored too, of three objects."""
    rng = np.random.default_rng(seed)
    tangents = rng.normal(size=(2, n, 3)) * size * rng.uniform(0.1, 1.0, (2, n, 1))
    normal = np.cross(*tangents)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) + 0.2 * rng.normal(size=(n, 3))
    normal *= rng.choice([-1, 1], (n, 1)) / np.linalg.norm(normal, axis=1, keepdims=True)
    arrays = (
        rng.uniform(-1, 1, (n, 3)), *tangents, normal, rng.uniform(*opacity, n), rng.uniform(size=(n, 3)),
        rng.uniform(size=n), rng.uniform(size=n),
    )  # fmt: skip
    objects = rng.integers(0, 3, n, dtype=np.int32)
    return PosedSurfels(*(np.ascontiguousarray(a, np.float32) for a in arrays), objects)


def select(posed: PosedSurfels, rows: Array) -> PosedSurfels:
    return PosedSurfels(*(np.ascontiguousarray(getattr(posed, name)[rows]) for name in PosedSurfels.__slots__))


def join(*parts: PosedSurfels) -> PosedSurfels:
    """Everything together, each part an object of its own."""
    arrays = [np.concatenate([getattr(p, name) for p in parts]) for name in list(PosedSurfels.__slots__)[:-1]]
    return PosedSurfels(*arrays, np.repeat(np.arange(len(parts), dtype=np.int32), [len(p) for p in parts]))


def rays(n: int, seed: int = 0, spread: float = 1.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (rng.normal(size=(n, 3)) * spread).astype(np.float32), direction.astype(np.float32)


def blend_all(
    posed: PosedSurfels, origins: Array, directions: Array, tnear: float = 0.0, tfar: float = math.inf,
    gap: float = math.inf,
) -> SurfelHits:  # fmt: skip
    """Every ray against every surfel in float64, sorted by (float32 depth, index); nothing ends early."""
    c, a, b = (getattr(posed, k).astype(float) for k in ("centre", "tangent_u", "tangent_v"))
    flat = np.cross(a, b)
    square = (flat * flat).sum(-1)
    size = np.sqrt(np.maximum((a * a).sum(-1), (b * b).sum(-1)))
    n = len(origins)
    out = SurfelHits(*(np.zeros((n, *s)) for s in ((), (), (3,), (3,), (3,), (), (), ())), np.full(n, -1))
    for r in range(n):
        o, d = origins[r].astype(float), directions[r].astype(float)
        with np.errstate(all="ignore"):
            t = ((c - o) * flat).sum(-1) / (flat @ d)
            q = o + t[:, None] * d - c
            u = (np.cross(q, b) * flat).sum(-1) / square
            v = (np.cross(a, q) * flat).sum(-1) / square
            alpha = posed.opacity * np.exp(-(u * u + v * v) / 2)
            near = t.astype(np.float32)
            met = np.flatnonzero((alpha > 1 / 255) & (near > tnear) & (near <= tfar))
        alpha = np.minimum(alpha, 0.99)
        met = met[np.lexsort((met, near[met]))]
        through = np.cumprod(np.concatenate([[1.0], 1 - alpha[met]]))
        out.through[r] = through[-1]
        if not len(met):
            continue
        weight = through[:-1] * alpha[met]
        jump = np.diff(t[met]) > gap * 0.5 * (size[met][1:] + size[met][:-1])
        surface = np.concatenate([[0], np.cumsum(jump)])
        keep = surface == np.bincount(surface, weight).argmax()
        met, weight = met[keep], weight[keep]
        side = np.where(flat[met] @ d > 0, -1.0, 1.0)
        g = flat[met] / np.sqrt(square[met, None]) * side[:, None]
        m = posed.normal[met] * np.where((posed.normal[met] * g).sum(-1) < 0, -1.0, 1.0)[:, None]
        total = weight.sum()
        for name, values in (
            ("depth", t[met]), ("albedo", posed.albedo[met]), ("roughness", posed.roughness[met]),
            ("metallic", posed.metallic[met]), ("size", size[met]),
        ):  # fmt: skip
            getattr(out, name)[r] = weight @ values / total
        for name, values in (("normal", m), ("geometric_normal", g)):
            mean = weight @ values
            getattr(out, name)[r] = mean / np.linalg.norm(mean)
        out.object_index[r] = posed.object_index[met[weight.argmax()]]
    return out
