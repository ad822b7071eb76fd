"""Texture lookup: materials and their images at a point of a surface, read at the addresses of a `MaterialTable`.

Lookups are those of Cycles' Image Texture node, measured in Blender 5.0 (tests/unit/test_textures_cycles.py):

- the four texels around a point are blended **as they are stored**; sRGB bytes are decoded after that;
- "clip" is transparent black beyond the image, and blends into it over half a texel at the border;
- a point whose coordinates are not finite is transparent black.

A place on a surface is (s, t, face, u, v): texture coordinates by the mesh's own UVs, v upwards; the face, numbered
without those of DR-GS objects; the barycentric coordinates of its second and third corner.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import inlined, njit
from ..memory import load_float, load_int32, load_int64, load_uint8, load_uint32
from ..sampling import HALF, ONE, TWO, ZERO, F, luminance

#: What the lowest two bits of an image's kind say; those above say how many channels fewer than four it has.
BYTE, BYTE_SRGB, FLOAT = range(3)
CODE, FEWER = 3, 2
CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3, "luminance": 4, "rgb": 5}
_A, _LUMINANCE, _RGB = 3, 4, 5
INTERPOLATIONS = {"closest": 0, "linear": 1}
EXTENSIONS = {"repeat": 0, "extend": 1, "mirror": 2, "clip": 3}
_REPEAT, _, MIRROR, _CLIP = range(4)
#: Base colours above this are cut: the light of many bounces must stay a float32. So are factors of textures.
WHITEST = F(1e3)
#: Radiance above this is cut: its square is still a float32.
BRIGHTEST = F(1e15)
INFINITE = F(np.inf)
BYTE_SCALE = F(1.0 / 255.0)


@njit
def texel(address, kind, index, weight, red, green, blue, alpha):  # type: ignore[no-untyped-def]
    """Add `weight` times a texel, as stored.

    Parameters
    ----------
    address, kind, index : int64
        Of the image's first texel; its kind; which texel.
    weight : float32
    red, green, blue, alpha : float32

    Returns
    -------
    red, green, blue, alpha : float32
    """
    if kind == FLOAT:
        index *= 4
        return (
            red + weight * load_float(address, index),
            green + weight * load_float(address, index + 1),
            blue + weight * load_float(address, index + 2),
            alpha + weight * load_float(address, index + 3),
        )
    fewer = kind >> FEWER
    if fewer > 0:
        index *= 4 - fewer
        second = index + 1 if fewer == 1 else index
        third = index + 2 if fewer == 1 else index
        return (
            red + weight * F(load_uint8(address, index)),
            green + weight * F(load_uint8(address, second)),
            blue + weight * F(load_uint8(address, third)),
            alpha + weight * F(255.0),
        )
    word = np.int64(load_uint32(address, index))
    return (
        red + weight * F(word & 255),
        green + weight * F((word >> 8) & 255),
        blue + weight * F((word >> 16) & 255),
        alpha + weight * F(word >> 24),
    )


@njit
def axis(u, n, interpolation, extension):  # type: ignore[no-untyped-def]
    """The two texels next to a coordinate along an axis, and their weights.

    Parameters
    ----------
    u : float32
    n : int64
        Texels.
    interpolation, extension : int32
        Of `INTERPOLATIONS` and `EXTENSIONS`.

    Returns
    -------
    i, j : int64
    a, b : float32
    """
    if extension == _REPEAT:
        u -= np.floor(u)
    elif extension == MIRROR:
        u -= TWO * np.floor(u * HALF)
        u = min(u, TWO - u)
    else:
        # Far enough outside to be clipped, near enough to count in integers.
        u = min(max(u, -ONE), TWO)
    x = u * F(n)
    if interpolation == 1:
        x -= HALF
    low = np.floor(x)
    i = np.int64(low)
    j, b = i, ZERO
    if interpolation == 1:
        j, b = i + 1, x - low
    a = ONE - b
    if extension == _REPEAT:
        i = i + n if i < 0 else (i - n if i >= n else i)
        j = j - n if j >= n else j
        return i, j, a, b
    if extension == _CLIP:
        a = a if 0 <= i < n else ZERO
        b = b if 0 <= j < n else ZERO
    return min(max(i, 0), n - 1), min(max(j, 0), n - 1), a, b


@njit
def _decoded(x, decode):  # type: ignore[no-untyped-def]
    """Linear value of an sRGB value in [0, 255], to 6e-6."""
    i = min(np.int64(x), 254)
    below = load_float(decode, i)
    return below + (x - F(i)) * (load_float(decode, i + 1) - below)


@inlined
def blend(rows, i, j, k, w, u, v):  # type: ignore[no-untyped-def]
    """A float32 column blended over a face.

    Parameters
    ----------
    rows : int64
        Address of the column.
    i, j, k : int64
        Places of the corners' values.
    w, u, v : float32
        Barycentric coordinates.

    Returns
    -------
    float32
    """
    return w * load_float(rows, i) + u * load_float(rows, j) + v * load_float(rows, k)


@njit
def layer_at(layer, place, layers):  # type: ignore[no-untyped-def]
    """Values of a mesh's layer at a place; those that the layer does not have are 0.

    Parameters
    ----------
    layer : int64
        Row of `layers`.
    place : tuple
        See this module's head.
    layers : int64
        Address of the table, see `mesh_layers.MeshLayers`.

    Returns
    -------
    x, y, z, a : float32
    """
    _, _, face, u, v = place
    rows, width = load_int64(layers, 2 * layer), load_int64(layers, 2 * layer + 1)
    i, w = 3 * width * np.int64(face), ONE - u - v
    x = blend(rows, i, i + width, i + 2 * width, w, u, v)
    y = blend(rows, i + 1, i + 1 + width, i + 1 + 2 * width, w, u, v)
    if width < 4:
        return x, y, ZERO, ZERO
    z = blend(rows, i + 2, i + 2 + width, i + 2 + 2 * width, w, u, v)
    return x, y, z, blend(rows, i + 3, i + 3 + width, i + 3 + 2 * width, w, u, v)


@njit
def _lookup(row, place, addresses):  # type: ignore[no-untyped-def]
    """Red, green, blue, alpha of a texture."""
    _, _, textures, transforms, images, decode, layers = addresses
    u, v = place[0], place[1]
    i = 5 * row
    layer = np.int64(load_int32(textures, i + 4))
    if layer >= 0:
        red, green, blue, alpha = layer_at(layer, place, layers)
        if load_int32(textures, i) < 0:
            return red, green, blue, alpha
        u, v = red, green
    interpolation, extension = load_int32(textures, i + 2), load_int32(textures, i + 3)
    k = 6 * row
    s = load_float(transforms, k) * u + load_float(transforms, k + 1) * v + load_float(transforms, k + 2)
    t = load_float(transforms, k + 3) * u + load_float(transforms, k + 4) * v + load_float(transforms, k + 5)
    if not (abs(s) < INFINITE and abs(t) < INFINITE):
        return ZERO, ZERO, ZERO, ZERO
    i = 4 * np.int64(load_int32(textures, i))
    address, width, height, kind = (
        load_int64(images, i),
        load_int64(images, i + 1),
        load_int64(images, i + 2),
        load_int64(images, i + 3),
    )
    left, right, a, b = axis(s, width, interpolation, extension)
    low, high, c, d = axis(t, height, interpolation, extension)
    # Row 0 is at the top, v = 0 at the bottom.
    low, high = (height - 1 - low) * width, (height - 1 - high) * width
    red, green, blue, alpha = texel(address, kind, low + left, a * c, ZERO, ZERO, ZERO, ZERO)
    if interpolation == 1:
        red, green, blue, alpha = texel(address, kind, low + right, b * c, red, green, blue, alpha)
        red, green, blue, alpha = texel(address, kind, high + left, a * d, red, green, blue, alpha)
        red, green, blue, alpha = texel(address, kind, high + right, b * d, red, green, blue, alpha)
    if kind & CODE == BYTE_SRGB:
        return _decoded(red, decode), _decoded(green, decode), _decoded(blue, decode), alpha * BYTE_SCALE
    if kind & CODE == BYTE:
        return red * BYTE_SCALE, green * BYTE_SCALE, blue * BYTE_SCALE, alpha * BYTE_SCALE
    return red, green, blue, alpha


@inlined
def one_channel(channel, red, green, blue, alpha):  # type: ignore[no-untyped-def]
    """One number of a colour: a channel, or its luminance, as where Blender plugs a colour into a number.

    Parameters
    ----------
    channel : int32
        Of `CHANNELS`.
    red, green, blue, alpha : float32

    Returns
    -------
    float32
    """
    if channel >= _LUMINANCE:
        return luminance(red, green, blue)
    if channel == _A:
        return alpha
    return red if channel == 0 else (green if channel == 1 else blue)


@njit
def number_at(row, place, addresses):  # type: ignore[no-untyped-def]
    """One number of a texture, see `one_channel`.

    Parameters
    ----------
    row : int64
        Texture.
    place : tuple
        See this module's head.
    addresses : tuple of int
        ``MaterialTable.addresses``.

    Returns
    -------
    float32
    """
    red, green, blue, alpha = _lookup(row, place, addresses)
    return one_channel(load_int32(addresses[2], 5 * row + 1), red, green, blue, alpha)


@njit
def colour_at(row, place, addresses):  # type: ignore[no-untyped-def]
    """Colour of a texture; of one channel a grey.

    Parameters
    ----------
    row, place, addresses : int64 or tuple
        As of `number_at`.

    Returns
    -------
    red, green, blue : float32
    """
    if load_int32(addresses[2], 5 * row + 1) == _RGB:
        red, green, blue, _ = _lookup(row, place, addresses)
        return red, green, blue
    grey = number_at(row, place, addresses)
    return grey, grey, grey


@njit
def _within(x, highest):  # type: ignore[no-untyped-def]
    """`x` in [0, highest]; NaN is 0."""
    return min(x, highest) if x > ZERO else ZERO


@njit
def material_at(material, place, addresses):  # type: ignore[no-untyped-def]
    """Values of a material at a place.

    Parameters
    ----------
    material : int
        Index into the materials of the table; not checked.
    place : tuple
        See this module's head.
    addresses : tuple of int
        ``MaterialTable.addresses``.

    Returns
    -------
    r, g, b, roughness, metallic, er, eg, eb : float
        Base colour, linear Rec.709, above 1 where it was given so; roughness and metallic in [0, 1]; emitted radiance,
        linear Rec.709, finite, >= 0.
    """
    constants, slots = addresses[0], addresses[1]
    i = 8 * np.int64(material)
    r, g, b = load_float(constants, i), load_float(constants, i + 1), load_float(constants, i + 2)
    roughness, metallic = load_float(constants, i + 3), load_float(constants, i + 4)
    er, eg, eb = load_float(constants, i + 5), load_float(constants, i + 6), load_float(constants, i + 7)
    first, second = np.int64(load_int32(slots, i)), np.int64(load_int32(slots, i + 1))
    third, last = np.int64(load_int32(slots, i + 2)), np.int64(load_int32(slots, i + 3))
    # Only if all are -1 are all bits set.
    if (first & second & third & last) == -1:
        return r, g, b, roughness, metallic, er, eg, eb
    if first >= 0:
        x, y, z = colour_at(first, place, addresses)
        r, g, b = _within(r * x, WHITEST), _within(g * y, WHITEST), _within(b * z, WHITEST)
    if second >= 0:
        roughness = _within(roughness * number_at(second, place, addresses), ONE)
    if third >= 0:
        metallic = _within(metallic * number_at(third, place, addresses), ONE)
    er, eg, eb = _emission(last, er, eg, eb, place, addresses)
    return r, g, b, roughness, metallic, er, eg, eb


@njit
def _emission(row, er, eg, eb, place, addresses):  # type: ignore[no-untyped-def]
    """Radiance times a texture, if there is one."""
    if row < 0:
        return er, eg, eb
    x, y, z = colour_at(row, place, addresses)
    return _within(er * x, BRIGHTEST), _within(eg * y, BRIGHTEST), _within(eb * z, BRIGHTEST)


@njit
def emits(material, addresses):  # type: ignore[no-untyped-def]
    """Whether a material emits light, its texture apart.

    Parameters
    ----------
    material : int32
        Row of the table.
    addresses : tuple of int
        ``MaterialTable.addresses``.

    Returns
    -------
    bool
    """
    i = 8 * np.int64(material)
    return (
        max(load_float(addresses[0], i + 5), max(load_float(addresses[0], i + 6), load_float(addresses[0], i + 7))) > 0
    )


@njit
def emission_at(material, place, addresses):  # type: ignore[no-untyped-def]
    """Emitted radiance of a material at a place, as `material_at` has it.

    Parameters
    ----------
    material : int32
        Row of the table.
    place : tuple
        See this module's head.
    addresses : tuple of int
        ``MaterialTable.addresses``.

    Returns
    -------
    er, eg, eb : float32
        Linear Rec.709.
    """
    i = 8 * np.int64(material)
    row = np.int64(load_int32(addresses[1], i + 3))
    er, eg, eb = load_float(addresses[0], i + 5), load_float(addresses[0], i + 6), load_float(addresses[0], i + 7)
    return _emission(row, er, eg, eb, place, addresses)
