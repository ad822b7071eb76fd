"""Whole frames of every case: time until they have the noise of Cycles' frames. Part of bench_light.py."""

from __future__ import annotations

import argparse

import numpy as np
from light_cases import TINY, Case, Reference, converged
from light_variance import chosen, cycles, series
from noise import Series
from report import table

#: Errors of `noise.Noise`, and what the table calls them.
MEASURES = {"untrimmed": "relative variance", "shown": "in sRGB"}


def ours(case: Case, size: int, seeds: int, counts: tuple[int, ...], reference: Reference) -> Series:
    """In seconds by the clock; everything is built anew for each picture."""
    case.picture(size, 8)  # kernels and pages of files
    tiny = [case.picture(TINY, 1, seed)[1] for seed in range(seeds)]
    return series(tiny, {n: [case.picture(size, n, seed) for seed in range(seeds)] for n in counts}, reference)


def ratios(a: Series, b: Series, of: str) -> list[float]:
    """Seconds of `b` over those of `a` until a whole frame has the noise of `b` at each of its numbers of samples."""
    levels = [getattr(noise, of) for noise in b.noise]
    return [(b.setup + b.time_to(level, of)) / (a.setup + a.time_to(level, of)) for level in levels]


def frames(options: argparse.Namespace) -> str:
    """The part's text."""
    cases, seeds = chosen(options), options.seeds
    counts, spp = tuple(options.frames_samples), tuple(options.frames_spp)
    rows, verdicts = [], []
    for size in options.frames_size:
        references = [converged(case, size, options.reference_rays) for case in cases]
        own = [ours(case, size, seeds, counts, reference) for case, reference in zip(cases, references, strict=True)]
        theirs = cycles(cases, size, seeds, spp, references, "seconds")
        found = {of: np.array([ratios(a, b, of) for a, b in zip(own, theirs, strict=True)]) for of in MEASURES}
        for i, (case, a, b) in enumerate(zip(cases, own, theirs, strict=True)):
            seconds = (" / ".join(f"{noise.seconds:.2f}" for noise in s.noise) for s in (a, b))
            cells = (" / ".join(f"{ratio:.1f}" for ratio in found[of][i]) for of in MEASURES)
            rows.append((f"{size}x{size}", case.name, *seconds, *cells))
        for of, name in MEASURES.items():
            middle, worst = np.median(found[of], axis=0), found[of].min(axis=0)
            text = ", ".join(f"{m:.1f} / {w:.1f} (that of {n} spp)" for m, w, n in zip(middle, worst, spp, strict=True))
            verdicts.append(f"- {size}x{size}, {name}: {text}")
    columns = [f"ours, s at {' / '.join(map(str, counts))}", f"Cycles, s at {' / '.join(map(str, spp))} spp"]
    columns += [f"time Cycles / ours, {name}" for name in MEASURES.values()]
    found_text = "\n".join(verdicts) + "\n\n" + table(("Size", "Case", *columns), rows)
    return (
        f"{seeds} seeds, noise by what they differ, materials and lights as in *Light: noise of single cases*. Seconds "
        "by the clock, median, to pixels in memory (ours, with the map's file read) or in a file (Cycles): scene, "
        "environment map and acceleration structure are made again for each picture, program and kernels were loaded "
        f"before. Time until a frame has the noise that Cycles has at {', '.join(map(str, spp))} spp: the setup, that "
        f"of a picture of {TINY}x{TINY} pixels, and sampling, log(samples) linear over log(noise). The variance is "
        f"relative to {options.reference_rays} samples of ours with another seed. Where few pixels make the noise "
        f"(statue, glossy, facing), few seeds say little. Median / worst of the cases:\n\n{found_text}"
    )
