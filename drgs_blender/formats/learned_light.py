"""Lights that IRGS and Ref-Gaussian learn, out of torch files, as lat-long radiance.

Torch is imported only here, and files are loaded with ``weights_only=True``: nothing in them is executed.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Environment
from ..core.color import srgb_to_linear
from ..core.errors import AssetError, DeviceError
from .files import EnvironmentFile
from .latlong import directions, nvdiffrec_cube, sample_cube

Array = np.ndarray

#: How torch files begin: a zip, or the magic number of the old format.
ZIP, LEGACY = b"PK\x03\x04", b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."


def read_learned_light(path: Path) -> EnvironmentFile:
    """Read ``point_cloud1.map`` and the like.

    IRGS keeps the logarithm of a lat-long image that, with the rotation IRGS applies to Blender-made data, is exactly
    in Blender's mapping. Ref-Gaussian keeps logits of a cube map, display-referred, looked up with directions in the
    axes of the surfels (OpenGL face order).

    Raises
    ------
    AssetError
        The file holds anything but tensors, or no light.
    DeviceError
        Torch is not installed.
    """
    base = np.asarray(_base(_load(path), str(path)), np.float64)
    if not np.isfinite(base).all():
        raise AssetError(str(path), "holds a light with NaN or infinite values", "Train it again")
    if base.ndim == 3 and base.shape[2] == 3:
        radiance = np.exp(np.clip(base, -30.0, 30.0))
        note = "IRGS light: taken to be trained with IRGS's rotation for Blender-made data; rotate the world if not"
        return EnvironmentFile(Environment(radiance), "IRGS light", [note])
    if base.ndim == 4 and base.shape[0] == 6 and base.shape[1] == base.shape[2] and base.shape[3] == 3:
        size = base.shape[1]
        logits = sample_cube(base, directions(2 * size), nvdiffrec_cube(size))
        radiance = srgb_to_linear(0.5 * (1.0 + np.tanh(0.5 * logits)))
        note = "Ref-Gaussian light: display-referred, so never brighter than 1; decoded from sRGB"
        return EnvironmentFile(Environment(radiance), "Ref-Gaussian light", [note])
    raise AssetError(str(path), f"holds a light of shape {base.shape}, which is not known", "Export it as .exr")


def _load(path: Path) -> Any:
    _refuse_bomb(path)
    try:
        import torch
    except ImportError as error:
        raise DeviceError(str(path), "needs torch to be read", "Install it: pip install torch") from error
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch's unpickler raises whatever a damaged file leads it to
        reason = str(error).strip().partition("\n")[0][:120] or type(error).__name__
        raise AssetError(str(path), f"cannot be loaded safely ({reason})", "Export the light as .exr") from error


def _refuse_bomb(path: Path) -> None:
    """Torch does not compress: a zip whose members are larger than it is was not written by it."""
    if not zipfile.is_zipfile(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise AssetError(str(path), f"is a damaged zip ({error})", "Restore it from a copy") from error
    if size > path.stat().st_size:
        raise AssetError(str(path), f"would unpack to {size} bytes", "Save the light with torch again")


def _base(content: Any, subject: str) -> Any:
    """The tensor called ``base``, wherever the writer put it."""
    for _ in range(3):
        if isinstance(content, dict):
            if "base" in content and hasattr(content["base"], "detach"):
                return content["base"].detach().float().numpy()
            content = content.get("state_dict")
    raise AssetError(subject, "holds no light (no tensor 'base')", "Choose the .map file beside the point cloud")
