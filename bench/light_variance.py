"""Variance of single cases: error and gain by the number of rays, by what seeds differ. Part of bench_light.py."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from judge import decibels, run_cycles, to_srgb
from light_cases import FOLDER, TINY, Case, Reference, converged
from light_scenes import EVERY, SHARED, Scene
from noise import EPSILON, Noise, Series
from report import table

from drgs_blender.core.frame import Frame
from drgs_blender.engine.session import Session

Array = np.ndarray

#: Rays at which relative errors are compared, those of as many samples of Cycles, which are two rays at a surface each
#: (one to the light, one by the BRDF), and part of the pixels that the trimmed error leaves out.
EQUAL, AS_MANY_RAYS, TRIM = 32, 64, 0.001


def noise_of(pictures: list[Array], seconds: list[float], reference: Reference) -> Noise:
    """By what the pictures differ from each other; the reference says where, and relative to what."""
    x = np.stack([picture[reference.mask][:, :3] for picture in pictures]).astype(np.float64)
    r = reference.picture[reference.mask][:, :3]
    relative = np.sort((x.var(axis=0, ddof=1) / (r**2 + EPSILON)).mean(axis=1))
    kept = len(relative) - int(np.floor(TRIM * len(relative)))
    shown = float(to_srgb(x).var(axis=0, ddof=1).mean())
    return Noise(decibels(shown), float(relative.mean()), float(relative[:kept].mean()), float(np.median(seconds)))


def chosen(options: argparse.Namespace) -> list[Case]:
    """The cases that the command line names; SystemExit where what they are made of is not there."""
    cases = [c for c in EVERY if c.name in options.cases]
    if missing := [c.name for c in cases if isinstance(c, Scene) and c.missing]:
        there = [c.name for c in cases if c.name not in missing]
        raise SystemExit(
            f"{', '.join(missing)}: {SHARED} lacks their files. Set DRGS_SHARED to the development data, or measure "
            f"--cases {' '.join(there)}; the section of docs/benchmarks.md stays as it is"
        )
    return cases


def series(tiny: list[float], found: dict[int, list[tuple[Array, float]]], reference: Reference) -> Series:
    """Of the seconds of tiny pictures, and by number of samples the pictures that differ by their seed with theirs.

    The reference is none of them: their bright dots would lower their own weight.
    """
    noise = [noise_of(*map(list, zip(*pictures, strict=True)), reference) for pictures in found.values()]  # type: ignore[arg-type]
    return Series(tuple(found), noise, float(np.median(tiny)))


def ours(case: Case, size: int, seeds: int, counts: tuple[int, ...], reference: Reference) -> Series:
    """In processor seconds."""
    session = Session()
    key = session.load_asset(case.files[0])
    session.render(case.frame(key, size, 8, 0))  # kernels and tables
    tiny = [timed(session, case.frame(key, TINY, 1, seed))[1] for seed in range(seeds)]
    found = {n: [timed(session, case.frame(key, size, n, seed)) for seed in range(seeds)] for n in counts}
    return series(tiny, found, reference)


def timed(session: Session, frame: Frame) -> tuple[Array, float]:
    """A picture and the processor seconds that it took."""
    begin = time.process_time()
    picture = session.render(frame)["Combined"]
    return picture, time.process_time() - begin


def cycles(
    cases: list[Case],
    size: int,
    seeds: int,
    counts: tuple[int, ...],
    references: list[Reference],
    clock: str = "processor_seconds",
) -> list[Series]:
    """In the seconds that cycles_job.py calls `clock`."""

    def out(case: Case, n: int, seed: int) -> Path:
        return FOLDER / f"cases-{case.name}-{n}-{seed}.npy"

    jobs = [c.job(size, n, seed, out(c, n, seed)) for c in cases for n in counts for seed in range(seeds)]
    # The first render of a process also loads the program: it does not count.
    tiny = [c.job(TINY, 1, seed, out(c, 0, seed)) for c in cases for seed in range(seeds)]
    jobs = [cases[0].job(TINY, 1, 0, FOLDER / "cases-first.npy"), *tiny, *jobs]
    took = {result["out"]: result[clock] for result in run_cycles(jobs, "light-cases")}

    def found(case: Case, n: int) -> list[tuple[Array, float]]:
        return [(np.load(path), took[str(path)]) for path in (out(case, n, seed) for seed in range(seeds))]

    return [
        series([s for _, s in found(case, 0)], {n: found(case, n) for n in counts}, reference)
        for case, reference in zip(cases, references, strict=True)
    ]


def variance(options: argparse.Namespace) -> str:
    """The part's text."""
    cases, size, seeds = chosen(options), options.cases_size, options.cases_seeds
    counts, spp = tuple(options.cases_samples), tuple(options.cases_spp)
    references = [converged(case, size, options.reference_rays) for case in cases]
    own = [ours(case, size, seeds, counts, reference) for case, reference in zip(cases, references, strict=True)]
    theirs = cycles(cases, size, seeds, spp, references) if spp else [None] * len(cases)
    rows, ratios, below = [], [], 0
    for case, a, b in zip(cases, own, theirs, strict=True):
        at = a.at(EQUAL)
        row = [
            case.name, f"{at.untrimmed:.4f} / {at.trimmed:.4f}", " / ".join(f"{n.decibels:.1f}" for n in a.noise),
            f"{a.gain:.1f}", f"{a.seconds(EQUAL) / EQUAL / size**2 * 1e6:.2f}",
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
    columns = ["Case", "Relative variance / trimmed", "dB", "dB by 4 x", "us a ray"]
    if AS_MANY_RAYS in counts:
        columns.insert(2, f"at {AS_MANY_RAYS}")
    if spp:
        columns += ["Cycles: relative variance / trimmed", "dB by 4 x", "time Cycles / ours"]
    verdict = f" Median {np.median(ratios):.1f}, worst {min(ratios):.1f}." if ratios else ""
    if AS_MANY_RAYS in counts and spp:
        verdict += (
            f" With as many rays at the visible surface, {AS_MANY_RAYS} of ours against {EQUAL} spp, the relative "
            f"variance is no larger than Cycles' in {below} of {len(cases)}."
        )
    about = [f"{c.name}: {c.materials}, {c.environment.name}, {getattr(c, 'bounces', 1)} bounces" for c in cases]
    return (
        f"{size}x{size}, {seeds} seeds, {', '.join(map(str, counts))} samples, noise by what "
        f"seeds differ, relative to {options.reference_rays} samples of ours with another seed; at {EQUAL} samples "
        f"(trimmed: without the {TRIM:.1%} of the pixels that are worst); processor seconds without the setup, that of "
        f"a picture of {TINY}x{TINY} pixels, to the relative variance of ours at {EQUAL}; us a ray: of all that "
        f"{EQUAL} samples take, camera rays among it.{verdict}\n\n"
        f"{table(columns, rows)}\n\n" + "\n".join(f"- {text}" for text in about)
    )
