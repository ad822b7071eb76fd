"""What light costs: time to equal quality against Cycles and Mitsuba, what makes the time, and what it buys.

python bench/bench_light.py [--part equal-psnr mitsuba denoised relmse cost memory efficiency cases frames
    denoisers filter-glossy ablation] ...

Each part writes its own section. Everything runs on two processors, as far as the system allows that to be set.
"""

from __future__ import annotations

import argparse
import os

import light_ablation
import light_cost
import light_denoisers
import light_efficiency
import light_filter
import light_frames
import light_renderers
import light_variance
from light_cases import FOLDER
from light_scenes import EVERY
from report import add_publish, write_section

PARTS = {
    "equal-psnr": ("Light: time to equal PSNR, Cycles", light_renderers.equal_psnr),
    "mitsuba": ("Light: time to equal PSNR, Mitsuba", light_renderers.against_mitsuba),
    "denoised": ("Light: time to equal PSNR, denoised", light_renderers.denoised),
    "relmse": ("Light: relative error at 32 samples", light_renderers.relative_error),
    "cost": ("Light: what makes the time", light_cost.cost),
    "memory": ("Light: memory of a large frame", light_cost.memory),
    "efficiency": ("Light: what denoiser, MIS and mesh bring", light_efficiency.efficiency),
    "cases": ("Light: noise of single cases", light_variance.variance),
    "frames": ("Light: whole frames of all cases", light_frames.frames),
    "denoisers": ("Light: denoisers by samples", light_denoisers.denoisers),
    "filter-glossy": ("Light: Filter Glossy", light_filter.filter_glossy),
    "ablation": ("Light: inter-reflection, shadows and reflections", light_ablation.ablation),
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--cases", nargs="+", choices=[c.name for c in EVERY], default=[c.name for c in EVERY])
    parser.add_argument("--size", type=int, default=200, help="of the pictures that are compared")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--subpixel-samples", type=int, default=0, help="sub-pixel positions of ours, 0 as the settings choose"
    )
    parser.add_argument("--samples", type=int, nargs="+", default=(8, 32, 128, 256), help="of ours")
    parser.add_argument("--spp", type=int, nargs="+", default=(2, 8, 32, 128), help="of Cycles and Mitsuba")
    parser.add_argument("--denoised-spp", type=int, nargs="+", default=(1, 4, 16), help="of Cycles with OIDN")
    parser.add_argument("--reference-rays", type=int, default=2048)
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--levels", type=float, nargs="+", default=(28, 30, 32, 34, 36, 38), help="dB")
    parser.add_argument("--denoised-levels", type=float, nargs="+", default=(30, 32, 34, 36, 38, 40), help="dB")
    parser.add_argument("--cost-size", type=int, default=800, help="of the pictures of part cost")
    parser.add_argument("--memory-size", type=int, nargs=2, default=(1920, 1080))
    parser.add_argument("--million", type=int, default=1_000_000, help="triangles and surfels of the memory test")
    parser.add_argument("--efficiency-rays", type=int, nargs="+", default=(4, 8, 16, 32, 64, 128, 256, 512))
    parser.add_argument("--cases-size", type=int, default=128, help="of the pictures of part cases")
    parser.add_argument("--cases-seeds", type=int, default=4)
    parser.add_argument("--cases-samples", type=int, nargs="+", default=(8, 32, 128, 512), help="of ours")
    parser.add_argument("--cases-spp", type=int, nargs="*", default=(8, 32, 128), help="of Cycles; none: without it")
    parser.add_argument("--frames-size", type=int, nargs="+", default=(256, 512), help="of the pictures of part frames")
    parser.add_argument("--frames-samples", type=int, nargs="+", default=(8, 32, 128), help="of ours")
    parser.add_argument("--frames-spp", type=int, nargs="+", default=(8, 32, 128), help="of Cycles")
    parser.add_argument("--ablation-size", type=int, default=400, help="of the pictures of part ablation")
    parser.add_argument("--ablation-rays", type=int, default=512)
    add_publish(parser)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # inherited by every process that is started from here
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    FOLDER.mkdir(parents=True, exist_ok=True)
    for part in options.part:
        title, run = PARTS[part]
        write_section(f"light-{part}", title, run(options))


if __name__ == "__main__":
    main()
