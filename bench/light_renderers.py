"""Time to equal quality: ours against Cycles and Mitsuba, plain and denoised. Parts of bench_light.py."""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from judge import cycles_pictures, psnr, run_cycles
from light_cases import BOUNCES, FOLDER, REFERENCE_AA, TINY, Case, Plan, Reference, chosen, our_reference
from noise import EPSILON, relative_mse, time_ratios
from report import ROOT, table

from drgs_blender.render.denoise.oidn import QUALITIES as OIDN
from drgs_blender.render.denoise.oidn import available as oidn_available

#: Part of the pixels left out of the trimmed relative error.
TRIM = 0.001
#: Samples of the relative errors.
EQUAL = 32
#: Part of the setup that sampling must take for the difference to be believed.
LEAST = 0.05
MITSUBA = ["mitsuba==3.9.*", "numpy"]
#: Renders one list of jobs, see cycles_job.py; each result has `seconds`.
Runner = Callable[[list[dict[str, Any]], str], list[dict[str, Any]]]


class Unavailable(Exception):
    """A renderer that cannot be had here; the message says why."""


@dataclass
class Sample:
    """What a renderer reached with a number of samples: dB, errors (means over the seeds) and seconds (median)."""

    count: int
    decibels: float
    trimmed: float
    untrimmed: float
    seconds: float


@dataclass
class Measured:
    """All that was measured of one renderer on one case."""

    samples: list[Sample]
    setup: float  # seconds of a picture of hardly any pixels: what does not grow with samples

    @property
    def decibels(self) -> list[float]:
        return [s.decibels for s in self.samples]

    @property
    def seconds(self) -> list[float]:
        return [s.seconds for s in self.samples]

    @property
    def sampling(self) -> list[float]:
        """Seconds without the setup; NaN where the setup is so much that nothing reliable is left."""
        rest = [s.seconds - self.setup for s in self.samples]
        return [t if t > LEAST * self.setup else math.nan for t in rest]

    def at(self, count: int) -> Sample:
        return next(s for s in self.samples if s.count == count)


def judged(count: int, pictures: Sequence[tuple[np.ndarray, float]], reference: Reference) -> Sample:
    """Judge `pictures`, which differ by their seed, with their seconds."""
    scores = [
        (
            psnr(picture, reference.picture, reference.mask),
            relative_mse(picture, reference.picture, reference.mask, TRIM),
            relative_mse(picture, reference.picture, reference.mask),
        )
        for picture, _ in pictures
    ]
    decibels, trimmed, untrimmed = map(float, np.mean(scores, axis=0))
    return Sample(count, decibels, trimmed, untrimmed, float(np.median([seconds for _, seconds in pictures])))


@cache
def ours(case: Case, plan: Plan, counts: tuple[int, ...], denoise: str = "none") -> Measured:
    """Our pictures at every number of rays."""
    settings: dict[str, Any] = {"denoise": denoise, "subpixel_samples": plan.subpixel_samples}
    case.picture(plan.size, 8, **settings)  # kernels and pages of files
    reference = our_reference(case, plan)
    setup = [case.picture(TINY, 4)[1] for _ in range(plan.seeds)]
    samples = [
        judged(n, [case.picture(plan.size, n, seed, **settings) for seed in range(plan.seeds)], reference)
        for n in counts
    ]
    return Measured(samples, float(np.median(setup)))


def theirs(
    case: Case, plan: Plan, counts: tuple[int, ...], reference: Reference, run: Runner, name: str, **more: Any
) -> tuple[Measured, dict[str, Any]]:
    """Another renderer's pictures at every number of samples, and what it says of itself."""
    k = plan.seeds

    def out(text: str) -> Path:
        return FOLDER / f"{name}-{case.name}-{text}.npy"

    # One tiny picture more than counts: the first render of a process also loads the program.
    jobs = [case.job(TINY, 1, i, out(f"tiny-{i}")) for i in range(k + 1)]
    jobs += [case.job(plan.size, n, seed, out(f"{n}-{seed}"), **more) for n in counts for seed in range(k)]
    results = run(jobs, f"light-{name}")
    setup = float(np.median([result["seconds"] for result in results[1 : k + 1]]))
    pictures = [(np.load(job["out"]), result["seconds"]) for job, result in zip(jobs, results)][k + 1 :]
    samples = [judged(n, pictures[i * k : (i + 1) * k], reference) for i, n in enumerate(counts)]
    return Measured(samples, setup), results[0]


@cache
def cycles(case: Case, plan: Plan, counts: tuple[int, ...], denoise: bool = False) -> Measured:
    """Cycles on the processor, against its own converged picture, which is kept until its job changes."""
    job = case.job(plan.size, plan.reference_spp, 1000, FOLDER / f"cycles-{case.name}-{plan.size}-reference.npy")
    cycles_pictures([job], "light-reference")
    reference = Reference.of(np.load(job["out"]))
    name = "cycles-denoised" if denoise else "cycles"
    return theirs(case, plan, counts, reference, run_cycles, name, denoise=denoise)[0]


def mitsuba(case: Case, plan: Plan, counts: tuple[int, ...]) -> tuple[Measured, dict[str, Any]]:
    """Mitsuba, against its own converged picture."""
    job = case.job(plan.size, plan.reference_spp, 1000, FOLDER / f"mitsuba-{case.name}-reference.npy", untimed=True)
    run_mitsuba([job], "light-mitsuba-reference")
    return theirs(case, plan, counts, Reference.of(np.load(job["out"])), run_mitsuba, "mitsuba")


def mitsuba_python() -> Path:
    """Interpreter of an environment with Mitsuba below build/, made when it is not there."""
    sys.path.insert(0, str(ROOT / "tools"))
    from dev import Failure, ensure

    (ROOT / "build").mkdir(exist_ok=True)
    try:
        return ensure(ROOT / "build" / "mitsuba", {"packages": MITSUBA}, [MITSUBA], "import mitsuba, numpy")
    except Failure as failure:
        raise Unavailable(f"Mitsuba cannot be installed ({failure})") from failure


def run_mitsuba(jobs: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """As `judge.run_cycles`, in Mitsuba.

    Its LLVM variant needs libLLVM 17 or later: the system's, one below build/llvm, or DRJIT_LIBLLVM_PATH.
    """
    python = mitsuba_python()
    path = FOLDER / f"{name}.json"
    path.write_text(json.dumps(jobs))
    program = Path(__file__).with_name("mitsuba_job.py")
    found = sorted((ROOT / "build" / "llvm").rglob("libLLVM.so*"))
    environment = ({"DRJIT_LIBLLVM_PATH": str(found[-1])} if found else {}) | os.environ
    done = subprocess.run(
        [str(python), str(program), str(path)], capture_output=True, text=True, timeout=1800, env=environment
    )
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise Unavailable(f"Mitsuba failed: {last[-1] if last else 'without a word'}")
    return json.loads(path.with_suffix(".result.json").read_text())


def comparison(rows: list[tuple[Case, Measured, Measured]], levels: Sequence[float], name: str) -> str:
    """Tables of ratios at equal dB and of what was measured. A row is (case, ours, theirs)."""
    lines, verdicts = [], []
    for what, seconds in ((", sampling alone", "sampling"), (", whole", "seconds")):
        ratios = [
            time_ratios((getattr(a, seconds), a.decibels), (getattr(b, seconds), b.decibels), levels)
            for _, a, b in rows
        ]
        lines += [
            (f"{case.name}{what}", *(f"{found[level]:.1f}" if level in found else "-" for level in levels))
            for (case, _, _), found in zip(rows, ratios)
        ]
        every = [ratio for found in ratios for ratio in found.values()]
        if every:
            verdicts.append(f"**{np.median(every):.1f}{what}** ({min(every):.1f} to {max(every):.1f})")
    verdict = (
        f"Time of {name} over ours at equal PSNR, median over subjects and levels: {'; '.join(verdicts)}."
        if verdicts
        else "No level was reached by both programs."
    )
    measured = [(case.name, *_figures(a), *_figures(b)) for case, a, b in rows]
    columns = [f"{who} {what}" for who in ("ours", name) for what in ("dB", "s", "setup s")]
    return (
        f"{verdict}\n\n{table(('Subject', *(f'{level:g} dB' for level in levels)), lines)}\n\nMeasured:\n\n"
        f"{table(('Subject', *columns), measured)}"
    )


def _figures(found: Measured) -> tuple[str, str, str]:
    """dB and seconds at each number of samples, and the setup."""
    return (
        " / ".join(f"{x:.1f}" for x in found.decibels),
        " / ".join(f"{x:.2f}" for x in found.seconds),
        f"{found.setup:.2f}",
    )


def _list(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def subjects_text(options: argparse.Namespace) -> str:
    """What all of these parts have in common."""
    cases = "; ".join(f"{c.name}: {c.mesh}, {c.materials}, {c.light}" for c in chosen(options))
    return (
        f"{options.size}x{options.size}, {BOUNCES} indirect bounce, 2 threads, {options.seeds} seeds. Subjects: "
        f"{cases}. Ours: mesh as primary surface, sub-pixel samples {options.subpixel_samples or 'as settings choose'}"
        f", {_list(options.samples)} samples. "
        f"Each program against its own converged picture (ours {options.reference_rays} rays, {REFERENCE_AA} "
        f"sub-pixel samples; "
        f"theirs {options.reference_spp} spp), PSNR in sRGB over the subject (mask eroded by 2 px). Seconds from "
        "arrays in memory to pixels: scene, environment map and acceleration structure are made again each time, "
        "program and kernels were loaded before. *Sampling alone*: less the setup, the time of a picture of "
        f"{TINY}x{TINY} pixels, which decides in pictures as small as these and counts little in large ones. "
        "log(time) is linear over dB."
    )


def equal_psnr(options: argparse.Namespace) -> str:
    """Plain pictures against Cycles."""
    plan, samples, spp = Plan.of(options), tuple(options.samples), tuple(options.spp)
    rows = [(case, ours(case, plan, samples), cycles(case, plan, spp)) for case in chosen(options)]
    about = f"{subjects_text(options)} Cycles of bpy 5.0.1 on the processor, {_list(spp)} spp, no denoiser."
    return f"{about}\n\n{comparison(rows, options.levels, 'Cycles')}"


def against_mitsuba(options: argparse.Namespace) -> str:
    """Plain pictures against Mitsuba."""
    plan, samples, spp = Plan.of(options), tuple(options.samples), tuple(options.spp)
    rows, about = [], {}
    try:
        for case in chosen(options):
            found, about = mitsuba(case, plan, spp)
            rows.append((case, ours(case, plan, samples), found))
    except Unavailable as reason:
        return f"Not measured: {reason}."
    return (
        f"{subjects_text(options)} Mitsuba {about['version']}, variant {about['variant']}, `principled` with the same "
        f"materials at vertices (a related, not the same, model), `path` of depth {BOUNCES + 2}, independent sampler, "
        f"{_list(spp)} spp.\n\n{comparison(rows, options.levels, 'Mitsuba')}"
    )


def denoised(options: argparse.Namespace) -> str:
    """Ours with SVGF and OIDN against Cycles with OIDN."""
    plan, samples, spp = Plan.of(options), tuple(options.samples), tuple(options.denoised_spp)
    filters = ["svgf", *(OIDN if oidn_available() else [])]
    about = f"{subjects_text(options)} Cycles + OIDN (albedo and normals, accurate prefilter), {_list(spp)} spp."
    if len(filters) == 1:
        about += " Ours + OIDN: not measured, pyoidn is not installed."
    parts = [about]
    for name in filters:
        rows = [(case, ours(case, plan, samples, name), cycles(case, plan, spp, True)) for case in chosen(options)]
        title = name.upper().replace("-BALANCED", ", balanced")
        parts.append(f"### Ours + {title}\n\n{comparison(rows, options.denoised_levels, 'Cycles + OIDN')}")
    return "\n\n".join(parts)


def relative_error(options: argparse.Namespace) -> str:
    """Errors at as many rays as Cycles has samples."""
    plan, rows = Plan.of(options), []
    # The whole series where it has the number: part equal-psnr measured it.
    samples, spp = (tuple(s) if EQUAL in s else (EQUAL,) for s in (options.samples, options.spp))
    for case in chosen(options):
        a, b = ours(case, plan, samples).at(EQUAL), cycles(case, plan, spp).at(EQUAL)
        rows.append((
            case.name, *(f"{x:.4f}" for x in (a.untrimmed, b.untrimmed, a.trimmed, b.trimmed)),
            f"{a.decibels:.1f}", f"{b.decibels:.1f}", f"{a.seconds:.2f}", f"{b.seconds:.2f}",
        ))  # fmt: skip
    columns = (
        "Subject", "ours", "Cycles", "ours, trimmed", "Cycles, trimmed", "ours dB", "Cycles dB", "ours s", "Cycles s",
    )  # fmt: skip
    return (
        f"Mean of (x - r)^2 / (r^2 + {EPSILON}), linear, nothing clamped; trimmed: without the {TRIM:.1%} of the "
        f"pixels that are worst. {EQUAL} rays against {EQUAL} spp, without denoiser; otherwise as in the part on equal "
        f"PSNR: {options.size}x{options.size}, {options.seeds} seeds.\n\n{table(columns, rows)}"
    )
