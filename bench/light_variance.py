"""Variance of single cases: error and gain by the number of rays, from pairs of seeds. Part of bench_light.py."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from judge import decibels, run_cycles, to_srgb
from light_cases import FOLDER, Case, Reference
from light_scenes import EVERY, Scene
from noise import EPSILON
from report import table

from drgs_blender.engine.session import Session

Array = np.ndarray

#: Rays at which relative errors are compared, those of as many samples of Cycles, which are two rays at a surface each
#: (one to the light, one by the BRDF), and part of the pixels that the trimmed error leaves out.
EQUAL, AS_MANY_RAYS, TRIM = 32, 64, 0.001


@dataclass
class Noise:
    """What pictures of one number of samples are worth: dB, relative errors, and processor seconds (median)."""

    decibels: float
    untrimmed: float
    trimmed: float
    seconds: float

    @classmethod
    def of(cls, pictures: list[Array], seconds: list[float], reference: Reference) -> Noise:
        """By what the pictures differ from each other; the reference says where, and relative to what."""
        x = np.stack([picture[reference.mask][:, :3] for picture in pictures]).astype(np.float64)
        r = reference.picture[reference.mask][:, :3]
        relative = np.sort((x.var(axis=0, ddof=1) / (r**2 + EPSILON)).mean(axis=1))
        kept = len(relative) - int(np.floor(TRIM * len(relative)))
        shown = float(to_srgb(x).var(axis=0, ddof=1).mean())
        return cls(decibels(shown), float(relative.mean()), float(relative[:kept].mean()), float(np.median(seconds)))


@dataclass
class Series:
    """All that was measured of one renderer on one case."""

    counts: tuple[int, ...]
    noise: list[Noise]

    def at(self, count: int) -> Noise:
        return self.noise[self.counts.index(count)]

    @property
    def gain(self) -> float:
        """dB by four times the samples, over the whole series."""
        return float(np.polyfit(np.log(self.counts) / np.log(4), [n.decibels for n in self.noise], 1)[0])

    @property
    def second_per_sample(self) -> float:
        """Processor seconds of one sample more of all pixels, between the largest count and about a quarter of it."""
        k = max((k for k, count in enumerate(self.counts) if 4 * count <= self.counts[-1]), default=-2)
        return (self.noise[-1].seconds - self.noise[k].seconds) / (self.counts[-1] - self.counts[k])

    def time_to(self, error: float) -> float:
        """Processor seconds of sampling alone until the untrimmed relative error is `error`: log over log, linear."""
        e = [n.untrimmed for n in self.noise]
        slope, start = np.polyfit(np.log(e), np.log(self.counts), 1)
        return float(np.exp(start + slope * np.log(error))) * self.second_per_sample


def chosen(options: argparse.Namespace) -> list[Case]:
    return [c for c in EVERY if c.name in options.cases and not (isinstance(c, Scene) and c.missing)]


def ours(case: Case, size: int, seeds: int, counts: tuple[int, ...]) -> tuple[Series, Reference]:
    session = Session()
    key = session.load_asset(case.files[0])
    session.render(case.frame(key, size, 8, 0))  # kernels and tables
    found = {}
    for count in counts:
        pictures, seconds = [], []
        for seed in range(seeds):
            begin = time.process_time()
            pictures.append(session.render(case.frame(key, size, count, seed))["Combined"])
            seconds.append(time.process_time() - begin)
        found[count] = pictures, seconds
    reference = Reference.of(np.mean(found[counts[-1]][0], axis=0))
    return Series(counts, [Noise.of(*found[count], reference) for count in counts]), reference


def cycles(cases: list[Case], size: int, seeds: int, counts: tuple[int, ...]) -> list[Series]:
    def out(case: Case, n: int, seed: int) -> Path:
        return FOLDER / f"cases-{case.name}-{n}-{seed}.npy"

    jobs = [c.job(size, n, seed, out(c, n, seed)) for c in cases for n in counts for seed in range(seeds)]
    took = {result["out"]: result["processor_seconds"] for result in run_cycles(jobs, "light-cases")}
    series = []
    for case in cases:
        pictures = {n: [np.load(out(case, n, seed)) for seed in range(seeds)] for n in counts}
        reference = Reference.of(np.mean(pictures[counts[-1]], axis=0))
        noise = [
            Noise.of(pictures[n], [took[str(out(case, n, seed))] for seed in range(seeds)], reference) for n in counts
        ]
        series.append(Series(counts, noise))
    return series


def variance(options: argparse.Namespace) -> str:
    """The part's text."""
    cases, size, seeds = chosen(options), options.cases_size, options.cases_seeds
    counts, spp = tuple(options.cases_samples), tuple(options.cases_spp)
    own = [ours(case, size, seeds, counts)[0] for case in cases]
    theirs = cycles(cases, size, seeds, spp) if spp else [None] * len(cases)
    rows, ratios, below = [], [], 0
    for case, a, b in zip(cases, own, theirs, strict=True):
        at = a.at(EQUAL)
        row = [
            case.name, f"{at.untrimmed:.4f} / {at.trimmed:.4f}", " / ".join(f"{n.decibels:.1f}" for n in a.noise),
            f"{a.gain:.1f}", f"{a.second_per_sample / size**2 * 1e6:.2f}",
        ]  # fmt: skip
        if AS_MANY_RAYS in counts:
            doubled = a.at(AS_MANY_RAYS).untrimmed
            row.insert(2, f"{doubled:.4f}")
            below += b is not None and doubled <= b.at(EQUAL).untrimmed
        if b is not None:
            equal = b.at(EQUAL)
            ratios.append(b.time_to(at.untrimmed) / a.time_to(at.untrimmed))
            row += [f"{equal.untrimmed:.4f} / {equal.trimmed:.4f}", f"{b.gain:.1f}", f"{ratios[-1]:.1f}"]
        rows.append(row)
    columns = ["Case", "relMSE / trimmed", "dB", "dB by 4 x", "us a ray"]
    if AS_MANY_RAYS in counts:
        columns.insert(2, f"relMSE at {AS_MANY_RAYS}")
    if spp:
        columns += ["Cycles: relMSE / trimmed", "dB by 4 x", "time Cycles / ours"]
    verdict = f" Median {np.median(ratios):.1f}, worst {min(ratios):.1f}." if ratios else ""
    if AS_MANY_RAYS in counts and spp:
        verdict += (
            f" With as many rays at the visible surface, {AS_MANY_RAYS} of ours against {EQUAL} spp, the relative "
            f"error is no larger than Cycles' in {below} of {len(cases)}."
        )
    about = [f"{c.name}: {c.materials}, {c.environment.name}, {getattr(c, 'bounces', 1)} bounces" for c in cases]
    return (
        f"{size}x{size}, {seeds} seeds, {', '.join(map(str, counts))} samples, noise by pairs of seeds; relative "
        f"errors at {EQUAL} samples (trimmed: without the {TRIM:.1%} of the pixels that are worst); processor seconds "
        f"of sampling alone, to the relative error of ours at {EQUAL}.{verdict}\n\n{table(columns, rows)}\n\n"
        + "\n".join(f"- {text}" for text in about)
    )
