"""Metrics of pictures, materials and shapes: PSNR, SSIM, errors. Each says of which pixels and in which encoding.

A picture's PSNR is that of its mean squared error over all pixels and channels, and that of several pictures is the
mean of theirs. (Averaging over channels, as some published code does, raises it.) Published relighting figures fit a
scale and measure on white, which the white background dominates: `relight_scores` gives every variant side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..core.color import linear_to_srgb

Array = np.ndarray

#: PSNR of equal pictures, so that a mean over pictures stays a number.
MOST_PSNR = 100.0
#: Scales of light that are tried: from one over this to this.
_MOST_SCALE = 64.0


def psnr(picture: Array, reference: Array, mask: Array | None = None) -> float:
    """Peak signal-to-noise ratio in dB of values in [0, 1].

    Parameters
    ----------
    picture, reference : (h, w, c) or (n, h, w, c) array
        In any one encoding; several are one set of pixels.
    mask : (h, w) or (n, h, w) bool array, optional
        Pixels that count.

    Returns
    -------
    float
        At most `MOST_PSNR`; NaN where no pixel counts, or one is NaN.

    Examples
    --------
    An error of a tenth everywhere is 20 dB; a picture compared with itself has the most there is:

    >>> picture, reference = np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.6)
    >>> round(psnr(picture, reference), 3), psnr(picture, picture) == MOST_PSNR
    (20.0, True)
    """
    squared = (np.asarray(picture, np.float64) - reference) ** 2
    if mask is not None:
        squared = squared[mask]
    return decibels(float(squared.mean()) if squared.size else float("nan"))


def decibels(error: float) -> float:
    """PSNR in dB of a mean squared error of values in [0, 1], at most `MOST_PSNR`; of NaN, NaN."""
    return float(np.minimum(MOST_PSNR, -10 * np.log10(np.maximum(error, 1e-30))))  # unlike Python's, these keep NaN


def ssim(picture: Array, reference: Array, border: bool = False) -> float:
    """Structural similarity of (h, w, 3) pictures in [0, 1]: Wang et al. 2004, Gaussian of 1.5, mean of channels.

    Pixels whose window the picture does not hold whole are left out, unless `border`: then all count, as for methods
    that follow 3DGS. Those pad with zeros; here the picture is reflected.
    """
    from skimage.metrics import structural_similarity

    if min(picture.shape[:2]) < 11:
        return float("nan")
    mean, whole = structural_similarity(
        np.asarray(picture, np.float64),
        np.asarray(reference, np.float64),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return float(whole.mean() if border else mean)


def fit_scale(values: Array, reference: Array) -> Array:
    """(c,) factors on (n, c) `values` that bring each channel closest to `reference` (least squares).

    Examples
    --------
    >>> values = np.array([[0.2, 0.1], [0.4, 0.3]])
    >>> fit_scale(values, values * [2, 0.5])
    array([2. , 0.5])
    """
    values, reference = np.asarray(values, np.float64), np.asarray(reference, np.float64)
    return (values * reference).sum(axis=0) / np.maximum((values**2).sum(axis=0), 1e-12)


def normal_error(normals: Array, reference: Array, mask: Array) -> float:
    """Mean angle in degrees between (h, w, 3) normals, of pixels in `mask` where both have one.

    Examples
    --------
    The second pixel has no normal and does not count:

    >>> normals, reference = np.array([[[0, 0, 1.0], [0, 0, 0]]]), np.array([[[0, 1.0, 0], [0, 0, 1]]])
    >>> round(normal_error(normals, reference, np.full((1, 2), True)))
    90
    """
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(reference, axis=-1)
    counted = mask & (lengths > 1e-6)
    if not counted.any():
        return float("nan")
    cosine = (normals[counted] * reference[counted]).sum(axis=-1) / lengths[counted]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def depth_error(depth: Array, reference: Array, mask: Array, empty: float = 1e9) -> tuple[float, float]:
    """(mean, median) absolute difference of (h, w) depths in metres, of pixels in `mask` where neither is empty."""
    counted = mask & (depth < empty) & (reference < empty)
    if not counted.any():
        return float("nan"), float("nan")
    difference = np.abs(depth[counted] - reference[counted])
    return float(difference.mean()), float(np.median(difference))


def material_scores(found: dict[str, Array], true: dict[str, Array], mask: Array) -> dict[str, object]:
    """Errors of materials over the pixels of all views at once.

    Parameters
    ----------
    found, true : dict of str to array
        "albedo" (n, h, w, 3), and "roughness", "metallic" (n, h, w) where `true` has them; albedo is linear.
    mask : (n, h, w) bool array

    Returns
    -------
    dict
        Albedo PSNR of linear values, raw and with one factor a channel for all views (also given); RMSE of the others;
        NaN where the mask is empty.
    """
    a, b = found["albedo"][mask], true["albedo"][mask]
    scale = fit_scale(a, b)

    def rmse(name: str) -> float:
        squared = (found[name][mask].astype(np.float64) - true[name][mask]) ** 2
        return float(np.sqrt(squared.mean())) if squared.size else float("nan")

    return {
        "albedo_psnr": psnr(a, b),
        "albedo_psnr_scaled": psnr(np.clip(a * scale, 0, 1), b),
        "albedo_scale": scale.tolist(),
        **{f"{name}_rmse": rmse(name) for name in ("roughness", "metallic") if name in true},
    }


def relight_scores(linear: Array, alpha: Array, reference: Array, mask: Array) -> dict[str, object]:
    """PSNR of pictures of one light, every way it is published.

    Parameters
    ----------
    linear : (n, h, w, 3) array
        Our pictures, linear, not premultiplied.
    alpha : (n, h, w) array
        Their coverage.
    reference : (n, h, w, 3) array
        sRGB-encoded on white.
    mask : (n, h, w) float array
        Coverage of the reference; the foreground is where it is above 0.5.

    Returns
    -------
    dict
        ``raw`` and ``scaled``, each of all pixels on white (``full``) and of the foreground (``foreground``);
        ``published``: one scale an image and channel, fitted to encoded values over all pixels, of all pixels;
        ``scale``: one factor a channel for all views on linear values, with which the foreground's encoded values come
        closest (what is clipped stays clipped);
        ``coverage``: part of the pixels that are foreground. Decibels, means over the views.
    """
    inside = mask > 0.5
    scale = np.array([_exposure(linear[inside][:, c], alpha[inside], reference[inside][:, c]) for c in range(3)])
    raw, scaled = on_white(linear, alpha), on_white(linear * scale, alpha)
    published = [_published(picture, wanted) for picture, wanted in zip(raw, reference)]
    return {
        "raw": _both(raw, reference, inside),
        "scaled": _both(scaled, reference, inside),
        "published": float(np.mean(published)),
        "scale": scale.tolist(),
        "coverage": float(inside.mean()),
    }


def _exposure(linear: Array, alpha: Array, reference: Array) -> float:
    """The factor on linear values (n,) with which their encoded values on white come closest to `reference`."""
    from scipy.optimize import minimize_scalar

    def error(stops: float) -> float:
        encoded = np.clip(linear_to_srgb(np.clip(linear * 2.0**stops, 0, 1)), 0, 1) * alpha + (1 - alpha)
        return float(np.mean((encoded.astype(np.float64) - reference) ** 2)) if len(encoded) else 0.0

    most = np.log2(_MOST_SCALE)
    coarse = np.linspace(-most, most, 25)
    around = coarse[int(np.argmin([error(stops) for stops in coarse]))]
    found = minimize_scalar(error, bounds=(around - 0.5, around + 0.5), method="bounded", options={"xatol": 1e-5})
    return float(2.0 ** (found.x if found.fun < error(0.0) else 0.0))


def on_white(linear: Array, alpha: Array) -> Array:
    """(..., 3) encoded pictures laid on white, as the published sets are: mixed in encoded values."""
    encoded = np.clip(linear_to_srgb(np.clip(linear, 0, 1)), 0, 1)
    return encoded * alpha[..., None] + (1 - alpha[..., None])


def straight(passes: Mapping[str, Array]) -> tuple[Array, Array]:
    """((h, w, 3) linear, not premultiplied; (h, w) alpha) of the pass Combined."""
    combined = np.nan_to_num(passes["Combined"])
    alpha = np.clip(combined[..., 3], 0, 1)
    return combined[..., :3] / np.maximum(alpha, 1e-6)[..., None] * (alpha > 0)[..., None], alpha


def mean_psnr(
    pictures: Sequence[Array] | Array,
    references: Sequence[Array] | Array,
    masks: Sequence[Array] | Array | None = None,
) -> float:
    """Mean of the PSNR of each picture; with masks, of those where one has pixels, NaN where none has."""
    if masks is None:
        return float(np.mean([psnr(a, b) for a, b in zip(pictures, references)]))
    found = [psnr(a, b, m) for a, b, m in zip(pictures, references, masks) if m.any()]
    return float(np.mean(found)) if found else float("nan")


def _both(pictures: Array, references: Array, inside: Array) -> dict[str, float]:
    return {"full": mean_psnr(pictures, references), "foreground": mean_psnr(pictures, references, inside)}


def _published(picture: Array, reference: Array) -> float:
    """As GS-ROR2 and others measure: 8-bit values, a factor a channel fitted over the white background as well."""
    values, wanted = np.round(picture * 255) / 255, np.round(reference * 255) / 255
    scale = fit_scale(values.reshape(-1, 3), wanted.reshape(-1, 3))
    return psnr(np.clip(values * scale, 0, 1), wanted)
