"""What the denoisers make of more and more samples, on every case. Part of bench_light.py."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator

import numpy as np
from judge import psnr
from light_cases import REFERENCE_AA, Case, Reference
from light_variance import chosen
from report import table

from drgs_blender.engine.session import Session
from drgs_blender.render.denoise import svgf_spatial
from drgs_blender.render.denoise.oidn import available

Array = np.ndarray

#: Denoiser -> what the table calls it.
WAYS = {
    "none": "noisy",
    "alone": "SVGF's filter alone",
    "svgf": "SVGF",
    "oidn": "OIDN",
    "oidn-balanced": "OIDN, balanced",
}
#: Rays of either half of the converged picture.
CONVERGED = 4096


def converged(session: Session, case: Case, key: str, size: int) -> Reference:
    """Our converged picture; its seeds are none that are measured."""
    frames = (case.frame(key, size, CONVERGED, 1000 + i, subpixel_samples=REFERENCE_AA) for i in range(2))
    return Reference.of(np.mean([session.render(frame)["Combined"] for frame in frames], axis=0))


@contextlib.contextmanager
def unmixed() -> Iterator[None]:
    """SVGF gives nothing back of what its filter takes."""
    restore, svgf_spatial.restore = svgf_spatial.restore, lambda smoothed, noisy: smoothed
    try:
        yield
    finally:
        svgf_spatial.restore = restore


def measured(case: Case, options: argparse.Namespace) -> list[tuple[str, ...]]:
    """Rows of a case: PSNR of each denoiser at each number of samples, and the part of the light that SVGF keeps."""
    session = Session()
    key = session.load_asset(case.files[0])
    size, counts = options.size, options.cases_samples
    reference = converged(session, case, key, size)
    light = reference.picture[reference.mask][:, :3].mean()
    rows = []
    for name in WAYS:
        if name.startswith("oidn") and not available():
            continue
        decibels, kept = [], []
        for count in counts:
            denoise = "svgf" if name == "alone" else name
            frames = (case.frame(key, size, count, seed, denoise=denoise) for seed in range(options.seeds))
            with unmixed() if name == "alone" else contextlib.nullcontext():
                pictures = [session.render(frame)["Combined"] for frame in frames]
            decibels.append(np.mean([psnr(picture, reference.picture, reference.mask) for picture in pictures]))
            kept.append(np.mean([picture[reference.mask][:, :3].mean() for picture in pictures]) / light)
        cells = *(f"{value:.1f}" for value in decibels), *(f"{value:.3f}" for value in kept)
        rows.append((case.name, WAYS[name], *cells))
    return rows


def denoisers(options: argparse.Namespace) -> str:
    """Part ``denoisers``."""
    rows = [row for case in chosen(options) for row in measured(case, options)]
    counts = [str(count) for count in options.cases_samples]
    return (
        f"{options.size}x{options.size}, PSNR in sRGB over wholly covered pixels against {2 * CONVERGED} rays, and "
        f"mean light relative to theirs; means of {options.seeds} seeds, by samples. The cases are those of *Light: "
        "noise of single cases*. *Filter alone*: without `svgf_residual`.\n\n"
        + table(("Case", "Denoiser", *(f"{n}, dB" for n in counts), *(f"{n}, light" for n in counts)), rows)
    )
