"""Modules stay short enough to be read; longer ones say here why."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LONGEST = 400
#: Modules above it, and why they are one.
REASONS = {
    "drgs_blender/core/frame.py": "the contract between Blender and the engine: all that a frame holds, on one page",
    "drgs_blender/render/lights/light_sampler.py": "the table of lights, and how it is sampled, met and weighed",
    "drgs_blender/render/surfels/raster.py": "one rasteriser: its tiles, their lists, and the kernel that blends them",
    "tools/dev.py": "one command per function; it runs before there is any environment",
    "drgs_blender/ipc/client.py": "one class: the life of a request, which its lock, its child and its errors share",
}


def lengths() -> dict[str, int]:
    folders = ("drgs_blender", "addon", "operators", "tools")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return {p.relative_to(ROOT).as_posix(): len(p.read_text(encoding="utf-8").splitlines()) for p in paths}


@pytest.mark.parametrize("kind", ["long without a reason", "named and short"])
def test_long_modules_have_a_reason(kind):
    found = {name for name, lines in lengths().items() if lines > LONGEST}
    wrong = found - REASONS.keys() if kind == "long without a reason" else REASONS.keys() - found
    assert not wrong, f"{kind}: {sorted(wrong)}"
