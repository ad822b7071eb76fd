"""Options of sampling and render, shared by ``relight`` and ``render``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args, get_type_hints

from ..core.errors import UsageError
from ..core.frame import Camera, RenderSettings
from ..core.passes import BY_NAME, PASSES, TEMPORAL, pass_of

#: The largest float32, which the renderer computes with.
LARGEST = 3.4028234663852886e38
#: Pixels times passes of one picture; 16k x 16k with one pass.
MOST_PIXEL_PASSES = 1 << 28


def add_arguments(
    parser: argparse.ArgumentParser, *, defaults: bool, output: bool = True, samples: int = RenderSettings().samples
) -> None:
    """Add the sampling options; without `defaults` an absent option stays None and the scene decides.

    `samples` is the default of that option. Without `output`, what is written is not the user's to choose: film and
    passes
    have no options.
    """
    settings, hints = RenderSettings(), get_type_hints(RenderSettings)
    group = parser.add_argument_group("sampling and render" + ("" if defaults else " (default: what the scene says)"))

    def add(flag: str, field: str, about: str, among: Any = group, **options: Any) -> None:
        default = samples if field == "samples" else getattr(settings, field)
        about += f"; default {default}" if defaults else ""
        among.add_argument(flag, dest=field, default=default if defaults else None, help=about, **options)

    def choices(field: str) -> tuple[str, ...]:
        return get_args(hints[field])

    either = group.add_mutually_exclusive_group()
    add(
        "--samples",
        "samples",
        "per pixel; shared among light, diffuse and glossy sampling by the material",
        among=either,
        type=int_range(1, 65536),
    )
    either.add_argument(
        "--strategy-samples",
        type=strategies,
        metavar="C,G,L",
        help="advanced: diffuse (cosine), glossy (GGX) and light samples, instead of --samples (the paper has 16,8,8)",
    )
    add("--bounces", "bounces", "indirect bounces", type=int_range(0, 64))
    add(
        "--noise-threshold",
        "noise_threshold",
        "stop sampling a pixel below this error, as Cycles defines it; 0 never stops, which is faster where few "
        "pixels would stop early",
        type=at_least_zero,
    )
    add(
        "--clamp-indirect",
        "clamp_indirect",
        "limit of one indirect sample: fewer fireflies, less light; 0 for no limit",
        type=at_least_zero,
    )
    add(
        "--filter-glossy",
        "filter_glossy",
        "make surfaces rougher behind rough reflections, as Cycles' setting (1 by default there): less noise of "
        "caustics, which are blurred and lose some light; 0 is off",
        type=at_least_zero,
    )
    add(
        "--subpixel-samples",
        "subpixel_samples",
        "anti-aliasing positions per pixel, which share its samples; 0: chosen by the number of samples, "
        "more where the camera sees meshes alone",
        type=int_range(0, 1024),
    )
    add(
        "--filter-width",
        "filter_width",
        "width of the pixel filter in pixels (Blackman-Harris, Cycles has 1.5); 0: a box of one pixel",
        type=at_least_zero,
    )
    add("--camera-sees", "camera_sees", "what the camera sees: surfels or the mesh", choices=choices("camera_sees"))
    add(
        "--rays-see",
        "rays_see",
        "representation of DR-GS objects for shadow and indirect rays: mesh or surfels",
        choices=choices("rays_see"),
    )
    add("--denoise", "denoise", "denoiser", choices=choices("denoise"))
    add("--shading-model", "shading_model", "reflection model", choices=choices("shading_model"))
    add("--seed", "seed", "noise seed", type=int_range(0, 2**31 - 1))
    add("--device", "device", "device of the renderer: cpu or cuda; falls back to cpu", choices=choices("device"))
    add("--threads", "threads", "threads, 0 for all cores", type=int_range(0, 1024))
    if not output:
        return
    group.add_argument(
        "--transparent",
        dest="film_transparent",
        action=argparse.BooleanOptionalAction,
        default=False if defaults else None,
        help="leave the background transparent",
    )
    group.add_argument(
        "--passes",
        type=passes,
        default=("Combined",) if defaults else None,
        metavar="NAMES",
        help="passes to write, separated by commas, `all`, or `temporal` for what `drgs denoise` needs: "
        f"{', '.join(p.name for p in PASSES)}",
    )


def int_range(low: int, high: int) -> Any:
    """Parser of a whole number from `low` to `high`."""

    def parse(text: str) -> int:
        value = whole_number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{value} is not from {low} to {high}")
        return value

    return parse


def above_zero(what: str) -> Any:
    """Parser of a finite number above 0; `what` is said of others: "not a time", "no length"."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            raise argparse.ArgumentTypeError(f"{text} is {what} above zero")
        return value

    return parse


def whole_number(text: str) -> int:
    """Parser of a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def number(text: str) -> float:
    """Parser of a number, also of an infinite one."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def strategies(text: str) -> tuple[int, int, int]:
    """``16,8,8`` -> counts of the three strategies."""
    try:
        counts = [int(word) for word in text.split(",")]
    except ValueError:
        counts = []
    if len(counts) != 3 or min(counts) < 0 or not 1 <= sum(counts) <= 65536:
        raise argparse.ArgumentTypeError(f"{text} is not three numbers of samples, such as 16,8,8")
    return counts[0], counts[1], counts[2]


def at_least_zero(text: str) -> float:
    """Parser of a number that is not negative, and finite as float32."""
    value = number(text)
    if not 0.0 <= value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text} is not a number from 0 to {LARGEST:.1e}")
    return value


def passes(text: str) -> tuple[str, ...]:
    """Names of the pass table, in its order, from ``Combined,Depth``, ``temporal`` or ``all``.

    ``temporal`` is what ``drgs denoise`` needs; Combined is always among them.
    """
    if text == "all":
        return tuple(BY_NAME)
    known = {name.lower(): name for name in BY_NAME}
    wanted = {"Combined"}
    for word in text.split(","):
        if word.strip().lower() == "temporal":
            wanted.update(TEMPORAL)
            continue
        if word.strip().lower() not in known:
            raise argparse.ArgumentTypeError(f"there is no pass {word.strip()!r}; there are {', '.join(BY_NAME)}")
        wanted.add(known[word.strip().lower()])
    return tuple(name for name in BY_NAME if name in wanted)


def check_size(camera: Camera, passes: Sequence[str]) -> None:
    """Refuse a picture that no memory holds, before anything is taken for it."""
    x0, y0, x1, y1 = camera.window
    pixels = (x1 - x0) * (y1 - y0)
    if pixels * len(passes) > MOST_PIXEL_PASSES:
        size = 4 * pixels * sum(len(kind.channels) for name in passes if (kind := pass_of(name))) / 2**30
        problem = f"of {x1 - x0} x {y1 - y0} pixels with {len(passes)} passes would need {size:.0f} GiB and more"
        raise UsageError("a picture", problem, "Render fewer pixels or fewer passes at a time")


def override(settings: RenderSettings, args: argparse.Namespace) -> RenderSettings:
    """`settings` with every option that was given.

    Sub-pixel samples that were not given are at most the samples of a pixel.
    """
    numbers = (
        "samples",
        "bounces",
        "noise_threshold",
        "clamp_indirect",
        "filter_glossy",
        "subpixel_samples",
        "filter_width",
        "seed",
        "threads",
    )
    names = (*numbers, "camera_sees", "rays_see", "denoise", "shading_model", "device", "film_transparent")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.strategy_samples or args.samples is not None:
        given["strategy_samples"] = args.strategy_samples
    result = replace(settings, **given)
    if result.subpixel_count > result.sample_count:
        if args.subpixel_samples is None:
            return replace(result, subpixel_samples=result.sample_count)
        problem = f"{result.subpixel_count} is more than the {result.sample_count} samples of a pixel"
        raise UsageError("--subpixel-samples", problem, "Use more samples, or fewer of these")
    return result
