"""The sRGB transfer function and its inverse (IEC 61966-2-1) for tensors, with derivatives; see `core.color`."""

from __future__ import annotations

from torch import Tensor, where

#: Where the line ends and the power begins, of encoded and of linear values.
_ENCODED, _LINEAR = 0.04045, 0.0031308


def to_linear(encoded: Tensor) -> Tensor:
    """Decode sRGB values of any shape; those below 0 follow the line."""
    power = ((encoded.clamp(min=_ENCODED) + 0.055) / 1.055) ** 2.4
    return where(encoded <= _ENCODED, encoded / 12.92, power)


def to_display(linear: Tensor) -> Tensor:
    """Encode linear values of any shape as sRGB; those below 0 follow the line."""
    power = 1.055 * linear.clamp(min=_LINEAR) ** (1 / 2.4) - 0.055
    return where(linear <= _LINEAR, 12.92 * linear, power)
