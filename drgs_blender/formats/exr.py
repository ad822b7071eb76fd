"""Radiance out of OpenEXR files, whichever part or layer holds R, G and B, or luminance alone; and into them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..compute.threads import get_num_threads
from ..core.asset import Environment
from ..core.asset.archive import replace_by
from ..core.errors import AssetError

Array = np.ndarray

#: Largest picture that is decoded, in pixels (16k x 8k).
PIXEL_LIMIT = 1 << 27
#: No compression of EXR packs better; more pixels than this for the size of the file are a damaged header.
RATIO_LIMIT = 4000
_DAMAGED = "Render or download the file again"
#: CIE xy of red, green, blue, white of Rec.709, what EXR means when it says nothing.
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def read_exr(path: Path, alpha: bool = False) -> tuple[Array, bool, list[str]]:
    """((h, w, 3) float32 linear Rec.709, whether it is a cube map, notes).

    The unnamed layer is preferred, then "Combined", then the first that has R, G and B.

    Parameters
    ----------
    path : Path
    alpha : bool
        (h, w, 4) where the layer has an A, by which the colours are multiplied (associated alpha).

    Raises
    ------
    AssetError
        The file is damaged, too large, or has no colour.
    """
    import OpenEXR

    subject = str(path)
    notes: list[str] = []
    OpenEXR.set_global_thread_count(get_num_threads())
    try:
        with OpenEXR.File(subject, header_only=True) as file:
            for part in file.parts:
                _check_size(part.header, path)
            declared = [len(part.header["channels"]) for part in file.parts]
        with OpenEXR.File(subject, separate_channels=True) as file:
            parts = [(dict(p.header), {name: c.pixels for name, c in p.channels.items()}) for p in file.parts]
            # The binding only prints a warning where pixels cannot be decoded, and leaves the channels out.
            whole = [len(part.channels) for part in file.parts] == declared
    except AssetError:
        raise
    except Exception as error:  # the binding raises whatever the C++ library threw, of no common type
        raise AssetError(subject, f"is damaged ({str(error).replace(subject, 'it')})", _DAMAGED) from error
    if not whole:
        raise AssetError(subject, "is damaged: its pixels cannot be decoded", _DAMAGED)
    header, pixels = _choose(parts, subject, alpha, notes)
    if not np.isfinite(pixels).any():
        raise AssetError(subject, "has only values that are NaN or infinite", _DAMAGED)
    if not np.isfinite(pixels).all():
        notes.append(f"{int(np.count_nonzero(~np.isfinite(pixels)))} values that are NaN or infinite set to 0")
        pixels = np.nan_to_num(pixels, nan=0.0, posinf=0.0, neginf=0.0)
    if matrix := _to_rec709(header):
        notes.append("converted from the chromaticities of the file to Rec.709")
        pixels[..., :3] = pixels[..., :3] @ np.array(matrix, np.float32).T
    cube = getattr(header.get("envmap"), "name", "") == "ENVMAP_CUBE" or pixels.shape[0] == 6 * pixels.shape[1]
    return np.ascontiguousarray(pixels), cube, notes


def exr_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header of an EXR file. Raises AssetError."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            header = dict(file.parts[0].header)
    except Exception as error:  # the binding raises whatever the C++ library threw, of no common type
        raise AssetError(str(path), f"is damaged ({str(error).replace(str(path), 'it')})", _DAMAGED) from error
    _check_size(header, path)
    (x0, y0), (x1, y1) = (corner.astype(int) for corner in header["dataWindow"])
    return int(x1 - x0 + 1), int(y1 - y0 + 1)


def _check_size(header: dict[str, Any], path: Path) -> None:
    (x0, y0), (x1, y1) = (corner.astype(np.int64) for corner in header["dataWindow"])
    pixels = int(x1 - x0 + 1) * int(y1 - y0 + 1)
    if x1 < x0 or y1 < y0 or pixels > PIXEL_LIMIT or pixels > RATIO_LIMIT * path.stat().st_size:
        raise AssetError(str(path), f"declares {x1 - x0 + 1} x {y1 - y0 + 1} pixels", _DAMAGED)


def _choose(
    parts: list[tuple[dict[str, Any], dict[str, Array]]], subject: str, alpha: bool, notes: list[str]
) -> tuple[dict[str, Any], Array]:
    """(header, (h, w, 3) float32) of the best layer; (h, w, 4) where it has an A for which `alpha` asks."""
    found: list[tuple[int, str, dict[str, Any], list[Array]]] = []
    for header, channels in parts:
        for name in channels:
            layer, dot, channel = name.rpartition(".")
            if channel in ("R", "Y"):
                prefix = layer + dot
                wanted = [channels.get(prefix + c) for c in ("RGB" if channel == "R" else "YYY")]
                planes = [w for w in wanted if w is not None]
                if len(planes) == 3:
                    rank = {"": 0, "Combined": 1}.get(layer.split(".")[-1], 2) + 10 * (channel == "Y")
                    if alpha and prefix + "A" in channels:
                        planes.append(channels[prefix + "A"])
                    found.append((rank, name, header, planes))
    if not found:
        raise AssetError(subject, "has neither R, G, B nor Y", "Choose an environment picture")
    _, name, header, planes = min(found, key=lambda f: f[0])
    if name.endswith("Y"):
        notes.append("luminance only: grey light")
    elif name != "R":
        notes.append(f"layer {name[:-2]} used")
    if len({p.shape for p in planes}) != 1 or planes[0].ndim != 2 or planes[0].dtype.kind != "f":
        raise AssetError(subject, "has channels that are subsampled or not numbers of light", "Save it as RGB")
    return header, np.stack(planes, axis=2).astype(np.float32)


def _to_rec709(header: dict[str, Any]) -> list[list[float]]:
    """Matrix from the file's primaries to Rec.709, empty when they are Rec.709."""
    given = header.get("chromaticities")
    if given is None:
        return []
    values = np.array(given, np.float64).ravel()
    if values.shape != (8,) or not np.isfinite(values).all() or np.allclose(values, REC709, atol=2e-3):
        return []
    if np.any(values[1::2] <= 0):
        return []
    source, target = _rgb_to_xyz(values), _rgb_to_xyz(np.array(REC709))
    white_from, white_to = source.sum(axis=1), target.sum(axis=1)
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    gain = (bradford @ white_to) / (bradford @ white_from)
    adapt = np.linalg.inv(bradford) @ np.diag(gain) @ bradford
    return (np.linalg.inv(target) @ adapt @ source).tolist()


def _rgb_to_xyz(chromaticities: Array) -> Array:
    """(3, 3) matrix of primaries and white given as CIE xy."""
    x, y = chromaticities[0::2], chromaticities[1::2]
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])


def write_exr_environment(path: Path, environment: Environment) -> None:
    """Write distant light as a lat-long picture in Blender's mapping: 32-bit R, G, B. Raises WriteError."""
    write_exr_picture(path, environment.radiance)


def write_exr_picture(path: Path, pixels: Array) -> None:
    """Write (h, w, 3 or 4) float32, linear Rec.709, row 0 at the top, as 32-bit R, G, B (, A). Raises WriteError."""
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    planes = {
        name: np.ascontiguousarray(pixels[..., i], np.float32) for i, name in enumerate("RGBA"[: pixels.shape[2]])
    }

    def save(temporary: Path) -> None:
        try:
            with OpenEXR.File(header, planes) as file:
                file.write(str(temporary))
        except ValueError as error:  # the library raises these, too
            raise RuntimeError(str(error)) from error

    replace_by(path, save)
