"""What Filter Glossy gains and takes, ours and that of Cycles. Part of bench_light.py; draws a figure."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from judge import psnr, run_cycles, to_srgb
from light_cases import FOLDER, Case, Reference
from light_variance import EQUAL, chosen, noise_of
from noise import Noise
from report import picture_grid, table

from drgs_blender.engine.session import Session

Array = np.ndarray

#: Densities below which surfaces are made rougher; 1 is Cycles' default.
FILTERS = (0.0, 1.0, 10.0)
#: Rays and samples of the pictures by which the light is compared.
CONVERGED, CONVERGED_SPP = 4096, 2048
FIGURE = "filter-glossy.png"
#: What the figure shows, at how many pixels and samples.
SHOWN, SHOWN_SIZE, SHOWN_SAMPLES = "facing", 300, 64


def ours(case: Case, size: int, seeds: int) -> tuple[Reference, list[tuple[Noise, Array]]]:
    """Where the subject is, and for each filter the noise of `EQUAL` rays and the converged picture."""
    session = Session()
    key = session.load_asset(case.files[0])
    found = []
    for strength in FILTERS:
        frames = [case.frame(key, size, EQUAL, seed, filter_glossy=strength) for seed in range(seeds)]
        pictures = [session.render(frame)["Combined"] for frame in frames]
        picture = session.render(case.frame(key, size, CONVERGED, 1000, filter_glossy=strength))["Combined"]
        found.append((pictures, picture))
    where = Reference.of(found[0][1])
    return where, [(noise_of(p, [0.0], Reference(picture, where.mask)), picture) for p, picture in found]


def draw(case: Case, options: argparse.Namespace) -> None:
    """A row as it is and one denoised, a column a filter."""
    session = Session()
    key = session.load_asset(case.files[0])

    def picture(strength: float, denoise: str) -> Array:
        frame = case.frame(key, SHOWN_SIZE, SHOWN_SAMPLES, filter_glossy=strength, denoise=denoise)
        return to_srgb(session.render(frame)["Combined"][..., :3])

    ways = ("", "none"), (", SVGF", "svgf")
    rows = [{f"{strength:g}{name}": picture(strength, denoise) for strength in FILTERS} for name, denoise in ways]
    picture_grid(FIGURE, rows, options)


def filter_glossy(options: argparse.Namespace) -> str:
    """The part's text."""
    cases, size = chosen(options), options.cases_size

    def out(case: Case, strength: float) -> Path:
        return FOLDER / f"filter-{case.name}-{strength:g}.npy"

    each = [(case, strength) for case in cases for strength in FILTERS]
    jobs = [case.job(size, CONVERGED_SPP, 0, out(case, g), filter_glossy=g) for case, g in each]
    run_cycles(jobs, "light-filter-glossy")
    rows = []
    for case in cases:
        where, found = ours(case, size, options.cases_seeds)
        light = lambda picture, mask=where.mask: picture[mask][:, :3].mean()  # noqa: E731
        free, theirs_free = found[0][1], np.load(out(case, 0.0))
        for strength, (noise, picture) in zip(FILTERS, found, strict=True):
            theirs = np.load(out(case, strength))
            rows.append(
                [
                    case.name, f"{strength:g}", f"{noise.untrimmed:.4f} / {noise.trimmed:.4f}",
                    f"{light(picture) / light(free):.3f}", f"{light(theirs) / light(theirs_free):.3f}",
                    f"{psnr(picture, theirs, where.mask):.1f}",
                    "-" if strength == 0.0 else f"{psnr(picture, free, where.mask):.1f}",
                ]
            )  # fmt: skip
    columns = ["Case", "Filter Glossy", f"noise at {EQUAL} / trimmed", "light", "Cycles' light"]
    columns += ["dB to Cycles", "dB to 0"]
    shown = next((case for case in cases if case.name == SHOWN), None)
    figure = ""
    if shown is not None:
        draw(shown, options)
        figure = f"![Filter Glossy 0, 1 and 10 at {SHOWN_SAMPLES} samples, as it is and denoised](images/{FIGURE})\n\n"
    return (
        f"{size}x{size}, {options.cases_seeds} seeds. Light: of {CONVERGED} rays, of Cycles {CONVERGED_SPP} spp with "
        "the same setting, relative to that without it; PSNR in sRGB over the subject, of these pictures. Cases are "
        "those of *Light: noise of single cases*.\n\n" + figure + table(columns, rows)
    )
