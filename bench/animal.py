"""A body for benchmarks of simulated matter."""

from __future__ import annotations

import numpy as np
import trimesh


def body() -> trimesh.Trimesh:
    """Something like an animal: a trunk, a neck and four legs, one metre long."""

    def limb(length: float, radius: float, tilt: float, middle: tuple[float, float, float]) -> trimesh.Trimesh:
        part = trimesh.creation.capsule(length, radius, count=[24, 24])
        part.apply_transform(trimesh.transformations.rotation_matrix(tilt, (0, 1, 0)))
        part.apply_translation(np.subtract(middle, part.bounds.mean(axis=0)))
        return part

    parts = [limb(0.5, 0.16, np.pi / 2, (0, 0, 0.55)), limb(0.35, 0.09, 0.7, (0.31, 0, 0.73))]
    parts += [limb(0.45, 0.055, 0, (x, y, 0.28)) for x in (-0.28, 0.26) for y in (-0.09, 0.09)]
    return trimesh.util.concatenate(parts)
