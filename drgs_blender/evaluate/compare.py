"""Scores of an asset against ground truth: views left out, other lights, other poses, materials, shape."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core.asset import Asset
from ..core.errors import UsageError, first_of
from ..core.frame import Camera, Particles, World
from ..deform.gmls import bind_points, carry
from ..deform.sources import MeshSource
from ..reconstruct.capture.capture import RGB, WHITE, Capture, View
from .flip import find_flip
from .metrics import depth_error, material_scores, mean_psnr, normal_error, on_white, relight_scores, ssim, straight
from .truth import Truth, TruthSet

Array = np.ndarray
logger = logging.getLogger(__name__)


class Posed(NamedTuple):
    """An asset that moves with its true object.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        Of its mesh, object space.
    particles : Particles
        Points of the true surface around it.
    """

    vertices: Array
    particles: Particles


#: (camera, light, pose of the asset or None at rest) -> pass name -> (h, w, c): the passes `COMPARED_PASSES`, on a
#: transparent film.
Renderer = Callable[[Camera, World, Posed | None], dict[str, Array]]
COMPARED_PASSES = ("Combined", "Depth", "Normal", "Albedo", "Roughness", "Metallic", "Coverage")
#: A perceptual distance of two encoded pictures.
Distance = Callable[[Array, Array], float]
#: By name; None where it is not computed.
Distances = dict[str, Distance | None]
#: Spacing of the points of the true mesh that carry others, in parts of its extent, and their number at most.
_SPACING, _MOST_POINTS = 0.01, 300_000
#: Called with the part done and what is rendered.
Progress = Callable[[float, str], None]
#: Where files of pictures go: (name of the set, number of the view, ours and the true one, encoded).
Show = Callable[[str, int, Array, Array], None]


def compare(
    asset: Asset,
    capture: Capture,
    truth: Truth | None,
    renderer: Renderer,
    lpips: Distance | None = None,
    progress: Progress | None = None,
    show: Show | None = None,
) -> dict[str, Any]:
    """Score an asset.

    Parameters
    ----------
    asset : Asset
    capture : Capture
        Its views left out are rendered under the asset's own light, at the size they have there; where the object was
        turned (`View.turn`), the light is where it was then.
    truth : Truth or None
        Sets under known lights, at rest and posed, with maps.
    renderer : callable
    lpips : callable, optional
        None where it is not computed.
    progress, show : callable, optional

    Returns
    -------
    dict
        JSON-able: "novel" (views left out), "lights" (one entry a set of the truth), "materials", "geometry"; None for
        what cannot be measured. Decibels, degrees, metres.

    Raises
    ------
    UsageError
        There is nothing to compare with.
    """
    distances: Distances = {"flip": find_flip(), "lpips": lpips}
    novel, reason, remedy = capture.testing, "no views left out", "Leave views out with --test-every 8"
    if novel and asset.environment is None:
        novel, reason = [], "the asset has no light of its own"
        remedy = "Reconstruct it with materials, or name a known light with --relit"
    if not novel:
        if truth is None:
            raise UsageError(str(capture.source), f"has nothing to compare with: {reason}", remedy)
        logger.warning("views left out are not rendered: %s", reason)
    total = len(novel) + (sum(len(item.views) for item in truth.sets) if truth else 0)
    done = 0

    def render(view: View, radiance: Array, pose: Posed | None, name: str) -> dict[str, Array]:
        nonlocal done
        if progress is not None:
            progress(done / total, name)
        done += 1
        turn = np.eye(3) if view.turn is None else view.turn
        return renderer(view.camera, World(radiance, turn), pose)

    report: dict[str, Any] = {"novel": None, "lights": [], "materials": None, "geometry": None, "posed_geometry": None}
    if novel:
        assert asset.environment is not None
        _warn_of_known(asset, capture)
        radiance = asset.environment.radiance
        pictures = [render(view, radiance, None, "views left out") for view in novel]
        report["novel"] = _novel(novel, pictures, capture.background, distances, show)
    if truth is not None:
        moved = posed_as(asset, truth) if any(item.posed for item in truth.sets) else None
        for item in truth.sets:
            pose = moved if item.posed else None
            pictures = [render(view, item.radiance, pose, item.name) for view in item.views]
            entry = score_relit(item, pictures, distances, show)
            entry["training_light"] = item.light == truth.training_light
            report["lights"].append(entry)
            if item.maps:
                report["posed_geometry" if item.posed else "geometry"] = _geometry(item, pictures)
                if not item.posed:
                    report["materials"] = _materials(item, pictures)
    return without_nan(report)


def _warn_of_known(asset: Asset, capture: Capture) -> None:
    """Say which views left out the asset was learned from all the same, where it says what it was learned from."""
    learned = asset.provenance.get("learned_from")
    if not isinstance(learned, list):
        return
    made_of = str(asset.provenance.get("capture"))
    if made_of.split("/")[0] != capture.name.split("/")[0]:
        logger.warning(
            "%s: the asset was learned from %s: which views it knows does not show in their names",
            capture.source, made_of,
        )  # fmt: skip
        return
    novel = capture.testing
    if known := [view.name for view in novel if view.name in learned]:
        logger.warning(
            "%s: the asset was learned from %d of the %d views left out (%s): their figures are too good. Give the "
            "--test-every that it was reconstructed with, or reconstruct it with this one",
            capture.source, len(known), len(novel), first_of(known),
        )  # fmt: skip


def surface_points(vertices: Array, faces: Array, spacing: float) -> tuple[Array, Array]:
    """Points of a mesh: its corners, and on its faces one to each square of `spacing`, as many as `_MOST_POINTS`.

    Where faces are large, as on flat sides, corners alone say little of how the surface between them moves.

    Returns
    -------
    corners : (n, 3) int array
        Numbers of vertices.
    shares : (n, 3) float array
        Barycentric coordinates.

    Examples
    --------
    >>> corners, shares = surface_points(np.eye(3), np.array([[0, 1, 2]]), 0.5)
    >>> len(corners), bool(np.allclose(shares.sum(axis=1), 1))
    (7, True)
    """
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).astype(np.float64)
    end = np.cumsum(area)
    total = float(end[-1]) if len(end) else 0.0
    count = min(math.ceil(total / spacing**2), _MOST_POINTS)
    # As evenly over the faces as over each, by two additive sequences (Roberts 2018).
    number = np.arange(count)
    on = faces[np.searchsorted(end, (number + 0.5) * total / max(count, 1))]
    u, v = (0.5 + number * step for step in (0.7548776662466927, 0.5698402909980532))
    u, v = u % 1, v % 1
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    used = np.unique(faces)
    corners = np.concatenate([np.repeat(used[:, None], 3, axis=1), on])
    shares = np.concatenate([np.tile((1.0, 0.0, 0.0), (len(used), 1)), np.stack([1 - u - v, u, v], 1)])
    return corners, shares


def posed_as(asset: Asset, truth: Truth) -> Posed:
    """The asset carried along by the true mesh around it: its vertices, and what can carry its surfels."""
    assert truth.rest is not None and truth.posed is not None and truth.faces is not None
    source = MeshSource(truth.rest, truth.faces)
    corners, shares = surface_points(truth.rest, truth.faces, _SPACING * float(np.ptp(truth.rest, axis=0).max()))
    at = lambda values: np.einsum("nk,nk...->n...", shares, values[corners]).astype(np.float32)  # noqa: E731
    particles = Particles(at(truth.rest), at(truth.posed), at(source.gradients(truth.posed)))
    points, _, turned = carry(bind_points(asset.mesh.vertices, particles.rest), particles.points, particles.gradients)
    if turned:
        logger.info("%d vertices are carried by their nearest neighbour alone", turned)
    return Posed(points.astype(np.float32), particles)


def _white(view: View, background: RGB | None) -> tuple[Array, Array]:
    """((h, w, 3) encoded picture on white, (h, w) mask) of a photograph; real surroundings are cut out."""
    mask = np.ones(view.colour.shape[:2], np.float32) if view.mask is None else view.mask
    return view.laid_on(WHITE, background), mask


def _image_metrics(
    ours: Sequence[Array] | Array, true: Sequence[Array] | Array, distances: Distances
) -> dict[str, float | None]:
    """Means of the measures that look at whole pictures."""
    pairs = list(zip(ours, true))
    return {
        name: None if of is None else float(np.mean([of(a, b) for a, b in pairs]))
        for name, of in {"ssim": ssim, **distances}.items()
    }


def _novel(
    views: list[View], pictures: list[dict[str, Array]], background: RGB | None,
    distances: Distances, show: Show | None,
) -> dict[str, Any]:  # fmt: skip
    wanted = [_white(view, background) for view in views]
    ours = []
    for view, picture in zip(views, pictures):
        linear, alpha = straight(picture)
        # Surroundings that were photographed and not cut out are not ours to show.
        ours.append(on_white(linear, alpha if view.mask is not None else np.ones_like(alpha)))
    true = [picture for picture, _ in wanted]
    inside = [mask > 0.5 for _, mask in wanted]
    for k, (a, b) in enumerate(zip(ours, true)):
        if show is not None:
            show("novel", k, a, b)
    return {
        "views": len(views),
        "coverage": float(np.mean([m.mean() for m in inside])),
        "psnr": mean_psnr(ours, true),
        "psnr_foreground": mean_psnr(ours, true, inside),
        **_image_metrics(ours, true, distances),
    }


def score_relit(
    item: TruthSet, pictures: list[dict[str, Array]], distances: Distances, show: Show | None
) -> dict[str, Any]:
    """Score pictures of an asset under the light of a set.

    Parameters
    ----------
    item : TruthSet
    pictures : list of dict
        Passes of its views, in their order.
    distances : dict of str to callable or None
        Measures of two pictures on white, by name; None: not computed.
    show : callable, optional

    Returns
    -------
    dict
        One entry of "lights" of `compare`: `metrics.relight_scores`, and of scaled pictures "ssim" and the distances.
    """
    linear, alpha = (np.stack(parts) for parts in zip(*map(straight, pictures)))
    wanted = [_white(view, item.background) for view in item.views]
    true, mask = (np.stack(parts) for parts in zip(*wanted))
    scores = relight_scores(linear, alpha, true, mask)
    ours = on_white(linear * np.array(scores["scale"]), alpha)
    for k, (a, b) in enumerate(zip(ours, true)):
        if show is not None:
            show(item.name, k, a, b)
    about = {"name": item.name, "light": item.light, "posed": item.posed, "views": len(item.views)}
    return {**about, **scores, **_image_metrics(ours, true, distances)}


def _inside(item: TruthSet) -> Array:
    """(n, h, w) bool: pixels that the true object covers whole."""
    return np.stack([maps["Coverage"][..., 0] > 0.99 for maps in item.maps])


def _geometry(item: TruthSet, pictures: list[dict[str, Array]]) -> dict[str, float]:
    inside = _inside(item)
    rows = []
    for ours, true, mask in zip(pictures, item.maps, inside):
        unknown = (float("nan"), float("nan"))
        depths = depth_error(ours["Depth"][..., 0], true["Depth"][..., 0], mask) if "Depth" in true else unknown
        cover = ours["Coverage"][..., 0] > 0.5
        both = (cover & (true["Coverage"][..., 0] > 0.5)).sum() / max(
            (cover | (true["Coverage"][..., 0] > 0.5)).sum(), 1
        )
        rows.append((normal_error(ours["Normal"], true["Normal"], mask), *depths, both))
    normal, mean, median, overlap = (_mean_of_numbers(column) for column in np.array(rows).T)
    return {
        "normal_degrees": normal,
        "depth_mean": mean,
        "depth_median": median,
        "silhouette_iou": overlap,
    }


def _mean_of_numbers(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def _materials(item: TruthSet, pictures: list[dict[str, Array]]) -> dict[str, object]:
    def stack(source: list[dict[str, Array]]) -> dict[str, Array]:
        known = [name for name in ("Roughness", "Metallic") if name in item.maps[0]]
        planes = {name.lower(): np.stack([p[name][..., 0] for p in source]) for name in known}
        return {"albedo": np.stack([p["Albedo"] for p in source]), **planes}

    seen = np.stack([p["Coverage"][..., 0] > 0.5 for p in pictures])
    return material_scores(stack(pictures), stack(item.maps), _inside(item) & seen)


def without_nan(value: Any) -> Any:
    """None in place of what is not a number, so that the report is JSON."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def table(report: dict[str, Any]) -> list[str]:
    """The report as lines for a person."""
    lines = []
    novel = report["novel"]
    if novel:
        lines.append(
            f"views left out, in the light that was found ({novel['views']}, {novel['coverage']:.0%} foreground): "
            f"PSNR {_number(novel['psnr'], 2)} dB, foreground {_number(novel['psnr_foreground'], 2)} dB, "
            f"SSIM {_number(novel['ssim'])}, FLIP {_number(novel['flip'])}, LPIPS {_number(novel['lpips'])}"
        )
    if geometry := report["geometry"]:
        lines.append(_shape("shape", geometry))
    if geometry := report["posed_geometry"]:
        lines.append(_shape("shape, posed", geometry))
    if materials := report["materials"]:
        scale = ", ".join(f"{factor:.2f}" for factor in materials["albedo_scale"])
        lines.append(
            f"materials: albedo PSNR {_number(materials['albedo_psnr'], 2)} dB, "
            f"{_number(materials['albedo_psnr_scaled'], 2)} dB scaled (by {scale}); RMSE of roughness "
            f"{_number(materials.get('roughness_rmse'))}, of metallic {_number(materials.get('metallic_rmse'))}"
        )
    if report["lights"]:
        lines += ["", "PSNR in dB        |  foreground     |  all, on white         |"]
        lines += ["light             |  raw   scaled   |  raw   scaled  publ.  |  SSIM    FLIP    LPIPS"]
        for row in report["lights"]:
            raw, scaled = row["raw"], row["scaled"]
            name = row["light"] + (" posed" if row["posed"] else "") + ("*" if row["training_light"] else "")
            figures = [raw["foreground"], scaled["foreground"], raw["full"], scaled["full"], row["published"]]
            a, b, c, d, e = (f"{_number(figure, 2):>6}" for figure in figures)
            lines.append(
                f"{name:<18}| {a} {b}   | {c} {d} {e}  | {_number(row['ssim'])}  {_number(row['flip'])}  "
                f"{_number(row['lpips'])}"
            )
        lines.append("* the light of the training views. SSIM, FLIP and LPIPS are of the scaled pictures on white.")
    return lines


def _number(value: float | None, digits: int = 4) -> str:
    return "not computed" if value is None else f"{value:.{digits}f}"


def _shape(name: str, geometry: dict[str, float]) -> str:
    normal = _number(geometry["normal_degrees"], 1)
    median, mean, overlap = (_number(geometry[key]) for key in ("depth_median", "depth_mean", "silhouette_iou"))
    return (
        f"{name}: normals {normal} degrees off; depth {median} (median), {mean} (mean); silhouettes overlap {overlap}"
    )
