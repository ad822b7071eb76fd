"""Surfaces that light may pass: rays that stop at them by chance, and what they leave of light on its way.

An alpha is the share of a surface that is there. A ray that looks for a surface stops at it with that probability; one
random number serves for all surfaces on the way, so that numbers which are evenly spread over the samples of a pixel
stay so behind each. A shadow ray brings the product of what all surfaces let through.

Surfaces that lie in one another, to the last bits of float32, are one.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..memory import load_float, load_int32, load_int64
from ..sampling import ONE, ZERO, F
from . import ray_masks
from .detailed_normal import ALPHA, ALPHA_TABLE, SLOTS
from .interaction import nearest, place_of, tables_of
from .ray import Ray
from .texture_lookup import number_at

#: Surfaces on a ray beyond which it is blocked.
MOST = 256
#: Least light that is followed further.
_LEAST = F(1e-5)
_BEYOND, _BELOW_ONE = F(2.0**-22), F(1.0 - 2.0**-24)
_TINY = F(1e-30)


@njit
def opacity_at(face, u, v, geometry):  # type: ignore[no-untyped-def]
    """Alpha of a point of a face.

    Parameters
    ----------
    face : int32
        Of the scene.
    u, v : float32
        Barycentric coordinates of the second and third corner.
    geometry : Geometry

    Returns
    -------
    float32
        In [0, 1].
    """
    if face < geometry.vertex_faces:
        return ONE
    material = np.int64(load_int32(geometry.material, np.int64(face) - geometry.vertex_faces))
    alpha = load_float(load_int64(geometry.materials, ALPHA_TABLE), material)
    row = np.int64(load_int32(load_int64(geometry.materials, 1), SLOTS * material + ALPHA))
    if row >= 0:
        alpha = alpha * number_at(row, place_of(face, u, v, geometry), tables_of(geometry))
    return min(alpha, ONE) if alpha > ZERO else ZERO


@njit
def nearest_there(tracer, ray, geometry, number):  # type: ignore[no-untyped-def]
    """Closest hit at which a ray stops, see this module's head.

    Parameters
    ----------
    tracer : Tracer
        Or anything that has its fields.
    ray : Ray
        Of a mask for what is opaque.
    geometry : Geometry
    number : float32
        Random number in [0, 1).

    Returns
    -------
    t, face, instance, u, v, gx, gy, gz : float32 or int32
        As of `Hit`.
    count : int64
        Surfaces that were passed; `MOST`: it was blocked for having passed too many.
    """
    origin, direction, tnear, tfar, mask = ray
    mask = np.int32(mask | mask << ray_masks.CLEAR)
    t, face, instance, u, v, gx, gy, gz = nearest(tracer, Ray(origin, direction, tnear, tfar, mask))
    count, step = np.int64(0), _BEYOND
    while face >= 0 and count < MOST:
        alpha = opacity_at(face, u, v, geometry)
        if number < alpha:
            break
        number = min((number - alpha) / max(ONE - alpha, _TINY), _BELOW_ONE)
        count += 1
        before, place = face, instance
        # A face is met once: rounding may bring it again.
        while face == before and instance == place:
            tnear = t + max(step * abs(t), _TINY)
            t, face, instance, u, v, gx, gy, gz = nearest(tracer, Ray(origin, direction, tnear, tfar, mask))
            step = step * F(4.0)
        step = _BEYOND
    return t, face, instance, u, v, gx, gy, gz, count


@njit
def transmitted(tracer, ray, geometry):  # type: ignore[no-untyped-def]
    """Share of light that passes all surfaces on a shadow ray that light may pass.

    Parameters
    ----------
    tracer, ray, geometry : Tracer, Ray or Geometry
        As of `nearest_there`.

    Returns
    -------
    float32
    """
    origin, direction, tnear, tfar, mask = ray
    mask = np.int32(mask << ray_masks.CLEAR)
    share, count, step = ONE, np.int64(0), _BEYOND
    last, place = np.int32(-1), np.int32(-1)
    while share > _LEAST and count < MOST:
        t, face, instance, u, v, _, _, _ = nearest(tracer, Ray(origin, direction, tnear, tfar, mask))
        if face < 0:
            return share
        if face == last and instance == place:
            step = step * F(4.0)
        else:
            share = share * (ONE - opacity_at(face, u, v, geometry))
            count, step = count + 1, _BEYOND
        last, place = face, instance
        tnear = t + max(step * abs(t), _TINY)
    return ZERO
