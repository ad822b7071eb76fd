"""Learned parameters of surfels to what the rasteriser blends, forwards and backwards, in one pass over the surfels.

Quaternions give frames, logarithms sizes, logits what lies in 0..1, harmonics the colour seen from the view; plain
tensor operations would cost as much as blending the pixels. The tests hold this against such.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import njit
from ...compute.threads import ELEMENTS, over_range
from ...core.arrays import Array
from ...formats.harmonics import basis

#: Columns of a surfel's features: colour, normal that faces the viewer; then, with reflections, tint and blur.
COLOUR, NORMAL, TINT, BLUR = 0, 3, 6, 9
#: Bands of harmonics -> coefficients.
COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}


class Learned(NamedTuple):
    """Learned parameters of surfels, or their gradients; names are those of `gaussians.Gaussians`.

    Attributes
    ----------
    scale : (n, 2) float32 array
        Logarithms of the standard deviations, metres.
    rotation : (n, 4) float32 array
        Quaternions wxyz, of any length.
    opacity : (n,) float32 array
        Logits.
    sh : (n, k, 3) float32 array
        Coefficients of the harmonics.
    tint : (n, 3) float32 array
        Logits.
    blur : (n,) float32 array
        Logits.
    """

    scale: Array
    rotation: Array
    opacity: Array
    sh: Array
    tint: Array
    blur: Array


class Attributes(NamedTuple):
    """Attributes of surfels for the rasteriser, or their gradients.

    Attributes
    ----------
    tangent_u, tangent_v : (n, 3) float32 array
        Metres, world, scaled by the standard deviations.
    opacity : (n,) float32 array
    features : (n, 6 or 10) float32 array
        See the columns above.
    """

    tangent_u: Array
    tangent_v: Array
    opacity: Array
    features: Array


def attributes(
    parameters: dict[str, Tensor], centre: Tensor, eye: Array, bands: int, reflections: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Attributes that a view from `eye` (3,) blends; differentiable in the parameters of `gaussians.Gaussians`.

    The dependence of direction and facing on the centre is not differentiated.

    Parameters
    ----------
    parameters : dict of str to tensor
    centre : (n, 3) tensor
        World.
    eye : array
    bands : int
        Of harmonics; those beyond are left out.
    reflections : bool
        Tint and blur are features.

    Returns
    -------
    tangent_u, tangent_v : (n, 3) float32 tensor
        Scaled by the standard deviations.
    opacity : (n,) float32 tensor
    features : (n, 6 or 10) float32 tensor
    """
    return _Attributes.apply(
        centre.detach().numpy(), eye, bands, reflections, *(parameters[name] for name in Learned._fields)
    )


def frames(scale: Array, rotation: Array) -> tuple[Array, Array, Array]:
    """Tangents of `rotation` (n, 4) wxyz scaled by exp of `scale` (n, 2), and the normal; any length; (n, 3) each."""
    u, v, normal = (np.empty((len(scale), 3), np.float32) for _ in range(3))
    over_range(write_frames, len(scale), scale, rotation, u, v, normal, fewest=ELEMENTS)
    return u, v, normal


class _Attributes(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, centre: Array, eye: Array, bands: int, reflections: bool, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        raw = Learned(*(np.ascontiguousarray(p.detach().numpy(), np.float32) for p in parameters))
        n = len(centre)
        away = centre - np.asarray(eye, np.float32)
        away /= np.maximum(np.sqrt(np.einsum("nk,nk->n", away, away)), 1e-12)[:, None]
        degree = min(bands, int(raw.sh.shape[1] ** 0.5) - 1)
        values = basis(away, degree).astype(np.float32)
        u, v, normal = frames(raw.scale, raw.rotation)
        found = Attributes(u, v, np.empty(n, np.float32), np.empty((n, BLUR + 1 if reflections else TINT), np.float32))
        over_range(write_colours, n, raw, normal, away, values, found, fewest=ELEMENTS)
        ctx.save = (raw, values, normal, found)
        return tuple(map(torch.from_numpy, found))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        raw, values, normal, found = ctx.save
        incoming = Attributes(*(
            np.zeros_like(a) if g is None else np.ascontiguousarray(g.numpy(), np.float32)
            for g, a in zip(gradients, found, strict=True)
        ))  # fmt: skip
        to = Learned(*map(np.zeros_like, raw))
        given = raw.rotation, values, normal, found, incoming
        over_range(write_gradients, len(normal), *given, to, fewest=ELEMENTS)
        return None, None, None, None, *map(torch.from_numpy, to)


@njit
def _logistic(x):  # type: ignore[no-untyped-def]
    return np.float32(1.0) / (np.float32(1.0) + np.exp(-x))


@njit
def write_frames(first: int, last: int, scale: Array, rotation: Array, u: Array, v: Array, normal: Array) -> None:
    """`frames` of a range of surfels."""
    one, two = np.float32(1.0), np.float32(2.0)
    for i in range(first, last):
        w, x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3]
        r = one / max(np.sqrt(w * w + x * x + y * y + z * z), np.float32(1e-12))
        w, x, y, z = w * r, x * r, y * r, z * r
        a, b = np.exp(scale[i, 0]), np.exp(scale[i, 1])
        u[i, 0], u[i, 1], u[i, 2] = (
            a * (one - two * (y * y + z * z)),
            a * two * (x * y + w * z),
            a * two * (x * z - w * y),
        )
        v[i, 0], v[i, 1], v[i, 2] = (
            b * two * (x * y - w * z),
            b * (one - two * (x * x + z * z)),
            b * two * (y * z + w * x),
        )
        normal[i, 0], normal[i, 1] = two * (x * z + w * y), two * (y * z - w * x)
        normal[i, 2] = one - two * (x * x + y * y)


@njit
def write_colours(
    first: int, last: int, raw: Learned, normal: Array, away: Array, values: Array, out: Attributes
) -> None:
    """Opacity and features, written; `away` (n, 3) from the eye, `values` (n, k) of the harmonics in that direction."""
    opacity, sh, tint, blur = raw.opacity, raw.sh, raw.tint, raw.blur
    alpha, features = out.opacity, out.features
    for i in range(first, last):
        alpha[i] = _logistic(opacity[i])
        facing = np.float32(0.0)
        for c in range(3):
            facing += away[i, c] * normal[i, c]
        for c in range(3):
            colour = np.float32(0.5)
            for k in range(values.shape[1]):
                colour += values[i, k] * sh[i, k, c]
            features[i, COLOUR + c] = max(colour, np.float32(0.0))
            features[i, NORMAL + c] = -normal[i, c] if facing > 0 else normal[i, c]
        if features.shape[1] > TINT:
            for c in range(3):
                features[i, TINT + c] = _logistic(tint[i, c])
            features[i, BLUR] = _logistic(blur[i])


@njit
def write_gradients(first, last, rotation, values, normal, found, incoming, out):  # type: ignore[no-untyped-def]
    """Gradients of the raw parameters of a range of surfels.

    Parameters
    ----------
    first, last : int
    rotation : (n, 4) float32 array
    values : (n, k) float32 array
        As of `write_colours`.
    normal : (n, 3) float32 array
        As of `frames`.
    found, incoming : Attributes or tuple of array
        What the parameters gave, and its gradients.
    out : Learned or tuple of array
        Of zeros; written.
    """
    u, v, alpha, features = found
    g_u, g_v, g_alpha, g_features = incoming
    to_scale, to_rotation, to_opacity, to_sh, to_tint, to_blur = out
    one, two = np.float32(1.0), np.float32(2.0)
    for i in range(first, last):
        to_opacity[i] = g_alpha[i] * alpha[i] * (one - alpha[i])
        for c in range(3):
            if features[i, COLOUR + c] > 0:
                for k in range(values.shape[1]):
                    to_sh[i, k, c] = values[i, k] * g_features[i, COLOUR + c]
        if features.shape[1] > TINT:
            for c in range(3):
                f = features[i, TINT + c]
                to_tint[i, c] = g_features[i, TINT + c] * f * (one - f)
            f = features[i, BLUR]
            to_blur[i] = g_features[i, BLUR] * f * (one - f)
        a0, a1, a2 = g_u[i, 0], g_u[i, 1], g_u[i, 2]
        b0, b1, b2 = g_v[i, 0], g_v[i, 1], g_v[i, 2]
        to_scale[i, 0] = a0 * u[i, 0] + a1 * u[i, 1] + a2 * u[i, 2]
        to_scale[i, 1] = b0 * v[i, 0] + b1 * v[i, 1] + b2 * v[i, 2]
        # By the unscaled tangents, whose lengths are the deviations, and by the normal as it is without the view.
        a = np.sqrt(u[i, 0] * u[i, 0] + u[i, 1] * u[i, 1] + u[i, 2] * u[i, 2])
        b = np.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
        side = np.float32(0.0)
        for c in range(3):
            side += features[i, NORMAL + c] * normal[i, c]
        a0, a1, a2, b0, b1, b2 = a * a0, a * a1, a * a2, b * b0, b * b1, b * b2
        n0, n1, n2 = side * g_features[i, NORMAL], side * g_features[i, NORMAL + 1], side * g_features[i, NORMAL + 2]
        w, x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3]
        r = one / max(np.sqrt(w * w + x * x + y * y + z * z), np.float32(1e-12))
        w, x, y, z = w * r, x * r, y * r, z * r
        dw = two * (a1 * z - a2 * y - b0 * z + b2 * x + n0 * y - n1 * x)
        dx = two * (a1 * y + a2 * z + b0 * y - two * b1 * x + b2 * w + n0 * z - n1 * w - two * n2 * x)
        dy = two * (a1 * x - two * a0 * y - a2 * w + b0 * x + b2 * z + n0 * w + n1 * z - two * n2 * y)
        dz = two * (a1 * w - two * a0 * z + a2 * x - b0 * w - two * b1 * z + b2 * y + n0 * x + n1 * y)
        along = dw * w + dx * x + dy * y + dz * z
        to_rotation[i, 0], to_rotation[i, 1] = r * (dw - along * w), r * (dx - along * x)
        to_rotation[i, 2], to_rotation[i, 3] = r * (dy - along * y), r * (dz - along * z)
