"""Slopes of textures: how a height grows along a face, for bump maps."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..memory import load_float, load_int32, load_int64
from ..sampling import HALF, ONE, TWO, ZERO, F
from .texture_lookup import BYTE, BYTE_SCALE, BYTE_SRGB, CODE, INFINITE, MIRROR, axis, layer_at, one_channel, texel


@njit
def slopes_at(row, place, addresses, uvs):  # type: ignore[no-untyped-def]
    """How a texture's number grows along the two edges of a face that leave its first corner; see `one_channel`.

    The derivatives of the blend of the four texels around the place, as they are decoded; between the closest texels
    there are none.

    Parameters
    ----------
    row, place, addresses : int64 or tuple
        As of `number_at`.
    uvs : int64
        ``Geometry.uvs``.

    Returns
    -------
    first, second : float32
        By the barycentric coordinates of the second and of the third corner.
    """
    _, _, textures, transforms, images, decode, layers = addresses
    s0, t0, face, _, _ = place
    i = 5 * row
    image, channel = np.int64(load_int32(textures, i)), load_int32(textures, i + 1)
    interpolation, extension = load_int32(textures, i + 2), load_int32(textures, i + 3)
    layer = np.int64(load_int32(textures, i + 4))
    corners = uvs
    c, width = 6 * np.int64(face), np.int64(2)
    if layer >= 0:
        corners, width = load_int64(layers, 2 * layer), load_int64(layers, 2 * layer + 1)
        c = 3 * width * np.int64(face)
        s0, t0, _, _ = layer_at(layer, place, layers)
    if image < 0 and layer >= 0 and width == 4:
        start = one_channel(
            channel, load_float(corners, c), load_float(corners, c + 1), load_float(corners, c + 2),
            load_float(corners, c + 3),
        )  # fmt: skip
        first = one_channel(
            channel, load_float(corners, c + 4), load_float(corners, c + 5), load_float(corners, c + 6),
            load_float(corners, c + 7),
        )  # fmt: skip
        second = one_channel(
            channel, load_float(corners, c + 8), load_float(corners, c + 9), load_float(corners, c + 10),
            load_float(corners, c + 11),
        )  # fmt: skip
        return first - start, second - start
    if image < 0 or corners == 0 or interpolation == 0:
        return ZERO, ZERO
    k = 6 * row
    a, b = load_float(transforms, k), load_float(transforms, k + 1)
    d, e = load_float(transforms, k + 3), load_float(transforms, k + 4)
    s, t = a * s0 + b * t0 + load_float(transforms, k + 2), d * s0 + e * t0 + load_float(transforms, k + 5)
    if not (abs(s) < INFINITE and abs(t) < INFINITE):
        return ZERO, ZERO
    along_s, along_t = _gradient(s, t, channel, extension, 4 * image, images, decode)
    # Coordinates along the edges, then in the image.
    u1 = load_float(corners, c + width) - load_float(corners, c)
    v1 = load_float(corners, c + width + 1) - load_float(corners, c + 1)
    u2 = load_float(corners, c + 2 * width) - load_float(corners, c)
    v2 = load_float(corners, c + 2 * width + 1) - load_float(corners, c + 1)
    first = along_s * (a * u1 + b * v1) + along_t * (d * u1 + e * v1)
    second = along_s * (a * u2 + b * v2) + along_t * (d * u2 + e * v2)
    return first, second


@njit
def _gradient(s, t, channel, extension, i, images, decode):  # type: ignore[no-untyped-def]
    """Derivatives of an image's number by its own coordinates, blended linearly."""
    address, width, height, kind = (
        load_int64(images, i),
        load_int64(images, i + 1),
        load_int64(images, i + 2),
        load_int64(images, i + 3),
    )
    left, right, a, b = axis(s, width, 1, extension)
    low, high, c, d = axis(t, height, 1, extension)
    low, high = (height - 1 - low) * width, (height - 1 - high) * width
    none = (ZERO, ZERO, ZERO, ZERO)
    p0, p1, p2, p3 = texel(address, kind, low + left, ONE, *none)
    q0, q1, q2, q3 = texel(address, kind, low + right, ONE, *none)
    x0, x1, x2, x3 = texel(address, kind, high + left, ONE, *none)
    y0, y1, y2, y3 = texel(address, kind, high + right, ONE, *none)
    m0 = m1 = m2 = m3 = ONE
    if kind & CODE == BYTE_SRGB:
        m0 = _decoded_slope(c * (a * p0 + b * q0) + d * (a * x0 + b * y0), decode)
        m1 = _decoded_slope(c * (a * p1 + b * q1) + d * (a * x1 + b * y1), decode)
        m2 = _decoded_slope(c * (a * p2 + b * q2) + d * (a * x2 + b * y2), decode)
        m3 = BYTE_SCALE
    elif kind & CODE == BYTE:
        m0 = m1 = m2 = m3 = BYTE_SCALE
    along_s = one_channel(
        channel, m0 * (c * (q0 - p0) + d * (y0 - x0)), m1 * (c * (q1 - p1) + d * (y1 - x1)),
        m2 * (c * (q2 - p2) + d * (y2 - x2)), m3 * (c * (q3 - p3) + d * (y3 - x3)),
    )  # fmt: skip
    along_t = one_channel(
        channel, m0 * (a * (x0 - p0) + b * (y0 - q0)), m1 * (a * (x1 - p1) + b * (y1 - q1)),
        m2 * (a * (x2 - p2) + b * (y2 - q2)), m3 * (a * (x3 - p3) + b * (y3 - q3)),
    )  # fmt: skip
    mirrored_s = extension == MIRROR and s - TWO * np.floor(s * HALF) > ONE
    mirrored_t = extension == MIRROR and t - TWO * np.floor(t * HALF) > ONE
    along_s = -along_s if mirrored_s else along_s
    along_t = -along_t if mirrored_t else along_t
    return along_s * F(width), along_t * F(height)


@njit
def _decoded_slope(x, decode):  # type: ignore[no-untyped-def]
    """Derivative of `_decoded`."""
    i = min(np.int64(x), 254)
    return load_float(decode, i + 1) - load_float(decode, i)
