"""NeRO's GlossySynthetic: views left out of the published split, and relit pictures as GS-ROR measures them.

    SET/GlossySynthetic/OBJECT/{k.png, k-camera.pkl, k-depth.png}
    SET/glossy_relight/relight_gt/OBJECT_LIGHT/{k.png with alpha, k-camera.pkl}
    SET/glossy_relight/hdr2k/LIGHT.exr

Sources: `get_database_split` and `blender_utils.py` of NeRO (Liu et al. 2023); `metrics_relit_glossy.py` of GS-ROR (Zhu
et al. 2024). Cameras are Y up; lights are Blender's mapping in the Z up world.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import AssetError
from ...reconstruct.capture.capture import WHITE, Capture
from ...reconstruct.readers import nero, read_capture
from ..metrics import fit_scale
from .bench import Bench, Distance, eight_bits, existing, find_light, mean_of, read_light, shown_on_white, split_counts

OBJECTS = ("angel", "bell", "cat", "horse", "luyu", "potion", "tbell", "teapot")
LIGHTS = ("corridor", "golf", "neon")
#: Relit views that count, the first ones.
RELIT_VIEWS = 16
#: Views of the published set.
COUNTS = {"training views": 96, "views left out": 32, **{f"views in {light}": RELIT_VIEWS for light in LIGHTS}}


def folder(root: Path, name: str) -> Path:
    """The photographs of an object; the set's folder may be that of the objects itself."""
    inner = root / "GlossySynthetic" / name
    return inner if inner.is_dir() or not (root / name).is_dir() else root / name


def read(root: Path, name: str, resolution: int | None) -> Capture:
    """The capture to learn from: 96 of 128 views."""
    return read_capture(folder(root, name), resolution)


def check(root: Path, name: str, lights: Path | None) -> dict[str, Path]:
    """File of each light. Raises AssetError where one, or a photograph or relit picture, is not there."""
    nero.read(existing(folder(root, name), f"photographs of {name}"))
    base = _base(root)
    for light in LIGHTS:
        source = existing(_relit_folder(root, name, light), f"{name} relit by {light}")
        if not nero.sniff(source):
            raise AssetError(str(source), "holds no k-camera.pkl beside k.png", "Unpack glossy_relight again")
        nero.read(source)
    places = [lights] if lights else [base / inner for inner in ("hdr2k", "hdr", "hdr4k", ".")]
    return {light: find_light(places, light) for light in LIGHTS}


def _base(root: Path) -> Path:
    """The folder of the relit pictures, in the set's or beside it."""
    return (root if (root / "glossy_relight").is_dir() else root.parent) / "glossy_relight"


def _relit_folder(root: Path, name: str, light: str) -> Path:
    return _base(root) / "relight_gt" / f"{name}_{light}"


def counts(root: Path, name: str) -> dict[str, int]:
    """How many views there are."""
    relit = {light: len(nero.read(_relit_folder(root, name, light)).photographs) for light in LIGHTS}
    shown = {f"views in {light}": min(count, RELIT_VIEWS) for light, count in relit.items()}
    return split_counts(nero.read(folder(root, name))) | shown


def measure(bench: Bench, root: Path, name: str, lights: Path | None) -> dict[str, Any]:
    """Figures of views left out and of relit pictures."""
    files = check(root, name, lights)
    bench = replace(bench, lpips=_unshifted(bench.lpips))
    layout = nero.read(folder(root, name))
    testing = [photograph for photograph in layout.photographs if photograph.test]
    bench.warn_of_known([photograph.name for photograph in testing], name)
    rows = []
    for number, view in bench.views("views", layout, testing):
        ours = shown_on_white(bench.render(view.camera, bench.own_light(), (1.0, 1.0, 1.0)))
        true = view.laid_on(WHITE, None)
        bench.show("views", number, ours, true)
        rows.append(bench.scores(eight_bits(ours), eight_bits(true), border=True))
    report: dict[str, Any] = {"views": mean_of(rows), "lights": {}}
    for light, file in files.items():
        source = _relit_folder(root, name, light)
        report["lights"][light] = _relit(bench, source, light, read_light(file))
    return report | {"relit": mean_of(list(report["lights"].values()))}


def _unshifted(lpips: Distance | None) -> Distance | None:
    """LPIPS of encoded pictures in [0, 1] as if they were in [-1, 1].

    GS-ROR's tables are made so: its `lpipsPyTorch` leaves the shift to the caller, who gives pictures in [0, 1].
    """
    return None if lpips is None else lambda ours, true: lpips((ours + 1) / 2, (true + 1) / 2)


def _relit(bench: Bench, source: Path, light: str, radiance: np.ndarray) -> dict[str, float | None]:
    layout = nero.read(source)
    # Their alpha is the mask, not the depth.
    first = [replace(photograph, mask=None) for photograph in layout.photographs[:RELIT_VIEWS]]
    rows = []
    for number, view in bench.views(light, layout, first):
        if view.mask is None:
            raise AssetError(str(source / f"{int(view.name)}.png"), "has no alpha", "Use the set's own relit pictures")
        ours = eight_bits(shown_on_white(bench.render(view.camera, radiance, (1.0, 1.0, 1.0))))
        scaled = ours * fit_scale(ours.reshape(-1, 3), view.colour.reshape(-1, 3))
        bench.show(light, number, scaled, view.colour)
        raw = bench.scores(ours, view.colour, border=True)
        rows.append(bench.scores(scaled, view.colour, border=True) | {"raw_psnr": raw["psnr"]})
    return mean_of(rows)
