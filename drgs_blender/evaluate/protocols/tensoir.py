"""TensoIR-Synthetic: views left out, albedo, normals, and pictures relit with the albedo scaled.

    SET/OBJECT/{train,test}_000/{metadata.json, rgba_LIGHT.png, albedo.png, normal.png}
    SET/env/high_res_envmaps_2k/LIGHT.hdr (also Environment_Maps, high_res_envmaps_1k)

Source: `relight_importance.py`, `renderer.py` and `tensoIR_relighting_test.py` of TensoIR (Jin et al. 2023). Everything
is over the whole frame: pictures and albedo on white, normals on +Z, which brings the mean of their errors down by the
part of the frame that is background; the foreground's is given beside it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.color import to_unit
from ...core.errors import AssetError
from ...formats.images import load_image
from ...reconstruct.capture.capture import Capture, View
from ...reconstruct.readers import read_capture, tensoir
from ...reconstruct.readers.layout import complain_of_missing
from ...reconstruct.readers.photograph_loading import shrink
from ..metrics import decibels
from .bench import Array, Bench, existing, find_light, mean_of, read_light, shown_on_white, split_counts

OBJECTS = ("armadillo", "ficus", "hotdog", "lego")
LIGHTS = ("bridge", "city", "fireplace", "forest", "night")
#: Views whose albedo gives the factors.
ALBEDO_VIEWS = 20
#: The light of the pictures to learn from; with rotated lights, that which is not rotated.
OWN = ("sunset", "sunset_000")
#: Views of the published set.
COUNTS = {"training views": 100, "views left out": 200}
_PLACES = ("env", "Environment_Maps", "environment_maps", ".")
_SIZES = ("high_res_envmaps_2k", "high_res_envmaps_1k", ".")


def folder(root: Path, name: str) -> Path:
    """The photographs of an object; the set may be in a folder of its name."""
    inner = root / "TensoIR_Synthetic" / name
    return inner if inner.is_dir() else root / name


def read(root: Path, name: str, resolution: int | None) -> Capture:
    """The capture to learn from: the training views under the training light."""
    return read_capture(folder(root, name), resolution, light=_own(folder(root, name)))


def check(root: Path, name: str, lights: Path | None) -> dict[str, Path]:
    """File of each light. Raises AssetError where one, or a file of a view, is not there."""
    source = existing(folder(root, name), f"photographs of {name}")
    views = sorted(path.name for path in source.glob("test_*") if path.is_dir())
    if not views:
        raise AssetError(str(source), "has no test_000, test_001, ...", "Unpack the set again")
    own = ("metadata.json", f"rgba_{_own(source)}.png")
    names = (*own, "albedo.png", "normal.png", *(f"rgba_{light}.png" for light in LIGHTS))
    files = [f"{view}/{file}" for view in views for file in names]
    files += [f"{path.name}/{file}" for path in sorted(source.glob("train_*")) if path.is_dir() for file in own]
    complain_of_missing(str(source), [file for file in files if not (source / file).is_file()], len(files))
    places = [lights] if lights else [root / place / size for place in _PLACES for size in _SIZES]
    return {light: find_light(places, light) for light in LIGHTS}


def _own(source: Path) -> str:
    """The one of `OWN` that the views have."""
    return next((light for light in OWN if any(source.glob(f"*/rgba_{light}.png"))), OWN[0])


def counts(root: Path, name: str) -> dict[str, int]:
    """How many views there are."""
    source = folder(root, name)
    return split_counts(tensoir.read(source, _own(source)))


def measure(bench: Bench, root: Path, name: str, lights: Path | None) -> dict[str, Any]:
    """Figures of an object."""
    files, source = check(root, name, lights), folder(root, name)
    layout = tensoir.read(source, _own(source))
    testing = [photograph for photograph in layout.photographs if photograph.test]
    bench.warn_of_known([photograph.name for photograph in testing], name)
    rows, angles, albedos, pixels = [], [], [], 0
    for number, view in bench.views("views", layout, testing):
        passes = bench.render(view.camera, bench.own_light(), (1.0, 1.0, 1.0))
        ours = shown_on_white(passes)
        bench.show("views", number, ours, view.colour)
        rows.append(bench.scores(ours, view.colour))
        albedo, normals, alpha = _maps(source / view.name, view)
        angles.append(_normal_errors(passes, normals, alpha))
        coverage, inside = np.clip(passes["Coverage"], 0, 1), alpha > 0
        albedos.append(((np.nan_to_num(passes["Albedo"]) * coverage + 1 - coverage)[inside], albedo[inside]))
        pixels += alpha.size
    factors = albedo_factors(albedos)
    report: dict[str, Any] = {"views": mean_of(rows), "shape": mean_of(angles), "lights": {}}
    report["materials"] = {"albedo_psnr": _albedo_psnr(albedos, factors, pixels), "albedo_factors": list(factors)}
    for light, file in files.items():
        report["lights"][light] = _relit(bench, source, light, read_light(file), factors)
    return report | {"relit": mean_of(list(report["lights"].values()))}


def albedo_factors(albedos: list[tuple[Array, Array]]) -> tuple[float, float, float]:
    """Median over pixels of the ratio of true and found albedo, per channel, of `ALBEDO_VIEWS` evenly chosen views.

    Parameters
    ----------
    albedos : list of tuple of (n, 3) array
        Found and true, of the pixels of each view that the true object covers.
    """
    step = max(1, len(albedos) // ALBEDO_VIEWS)
    chosen = [albedos[k] for k in range(0, min(len(albedos), step * ALBEDO_VIEWS), step)]
    ratios = np.concatenate([true / np.maximum(found, 1e-6) for found, true in chosen])
    red, green, blue = np.median(ratios, axis=0) if len(ratios) else np.ones(3)
    return float(red), float(green), float(blue)


def _albedo_psnr(albedos: list[tuple[Array, Array]], factors: tuple[float, float, float], pixels: int) -> float:
    """PSNR of the mean squared error over all views, gamma 2.2; outside of the object all is white."""
    total = 0.0
    for found, true in albedos:
        aligned = np.clip(found * np.asarray(factors), 0, 1)
        total += float(np.sum((aligned ** (1 / 2.2) - np.clip(true, 0, 1) ** (1 / 2.2)) ** 2, dtype=np.float64))
    return decibels(total / (3 * pixels))


def _maps(source: Path, view: View) -> tuple[Array, Array, Array]:
    """((h, w, 3) linear albedo on white, (h, w, 3) world normals on +Z, (h, w) alpha) of a view."""
    maps = []
    for name in ("albedo.png", "normal.png"):
        image = to_unit(load_image(source / name))
        if image.shape[2] != 4:
            raise AssetError(str(source / name), "has no alpha", "Use the set's own files")
        maps.append(image)
    albedo, normal = maps
    albedo = albedo[..., :3] * albedo[..., 3:] + 1 - albedo[..., 3:]
    normal = (2 * normal[..., :3] - 1) * normal[..., 3:] + np.array([0, 0, 1.0]) * (1 - normal[..., 3:])
    width, height = view.camera.width, view.camera.height
    small = [shrink(np.ascontiguousarray(image, np.float32), width, height) for image in (albedo, normal)]
    return small[0], _unit(small[1]), np.ones((height, width)) if view.mask is None else view.mask


def _normal_errors(passes: dict[str, Array], normals: Array, inside: Array) -> dict[str, float | None]:
    """Mean angle in degrees over the frame, and over the foreground."""
    coverage = np.clip(passes["Coverage"], 0, 1)
    ours = _unit(np.nan_to_num(passes["Normal"]) * coverage + np.array([0, 0, 1.0]) * (1 - coverage))
    angles = np.degrees(np.arccos(np.clip((ours * normals).sum(axis=-1), -1, 1)))
    foreground = inside > 0.5
    return {
        "normal_degrees": float(angles.mean()),
        "normal_degrees_foreground": float(angles[foreground].mean()) if foreground.any() else None,
    }


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-8)


def _relit(
    bench: Bench, source: Path, light: str, radiance: Array, factors: tuple[float, float, float]
) -> dict[str, float | None]:
    layout = tensoir.read(source, light)
    testing = [photograph for photograph in layout.photographs if photograph.test]
    rows = []
    for number, view in bench.views(light, layout, testing):
        ours = shown_on_white(bench.render(view.camera, radiance, factors))
        bench.show(light, number, ours, view.colour)
        rows.append(bench.scores(ours, view.colour))
    return mean_of(rows)
