"""Particles of the solver, one row each: what changes from step to step, and what does not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Particles(NamedTuple):
    """State of the particles, which changes from step to step.

    Attributes
    ----------
    x : (n, 3) float64 array
        Metres, world.
    v : (n, 3) float32 array
        m/s.
    affine : (n, 9) float32 array
        Velocity gradient of APIC, 1/s.
    elastic : (n, 9) float32 array
        Elastic deformation gradient less 1.
    total : (n, 9) float32 array
        Deformation gradient since the start less 1; no rows where no matter is plastic. Matter that does not keep its
        shape keeps the one it has.
    tau : (n, 6) float32 array
        Kirchhoff stress, Pa: xx, yy, zz, xy, xz, yz.
    memory : (n,) float32 array
        See `constitutive.respond`.
    """

    x: Array
    v: Array
    affine: Array
    elastic: Array
    total: Array
    tau: Array
    memory: Array


class Properties(NamedTuple):
    """Constant properties of the particles.

    Attributes
    ----------
    mass : (n,) float32 array
        kg; none: markers.
    volume : (n,) float32 array
        Cubic metres at rest.
    model : (n,) uint8 array
        See `core.sim_materials.ParticleMaterials`.
    parameters : (n, k) float32 array
        See `core.sim_materials.ParticleMaterials`.
    solid : (n,) bool array
        Matter that keeps its shape.
    """

    mass: Array
    volume: Array
    model: Array
    parameters: Array
    solid: Array
