"""An object that moved once, on ground that stood still: registered by the ground, it is there twice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array

#: Pixels up to which points are where a motion puts them; times that, their least displacement.
_FITS, _FAR = 4.0, 4.0
#: Points that must move alike; part of their views that must be on their side of the moment.
_LEAST, _APART = 30, 0.95
#: Cosine of the angle up to which two pictures see a point alike, and part of such pictures that may see it where it
#: should not be any more, or not be yet.
_ALIKE, _SEEN = np.cos(np.radians(15)), 0.1
_TRIALS = 2000


def find_move(
    rows: Sequence[Array], matches: Sequence[tuple[int, int, Array]], points: Array, centres: Array, inside: Array,
    pixel: float,
) -> int | None:  # fmt: skip
    """The first picture after a part of the scene moved as a rigid body; None where nothing says so.

    Matches then link points that only earlier pictures see with others that only later ones see, all by one motion.
    Things that look alike are linked by one, too; but pictures from the same side see both of them.

    Parameters
    ----------
    rows : sequence of (n,) int arrays
        Of each picture, in their order, the point that each feature shows, -1 where none.
    matches : sequence of (int, int, (n, 2) int array)
        Two pictures, the earlier one first, and their features that look alike, whatever cameras say of them.
    points : (m, 3) float64 array
    centres : (k, 3) float64 array
        Of the cameras.
    inside : (k, m) bool array
        Whether a point is in the frame of a picture.
    pixel : float
        Size of a pixel where the points are.
    """
    keys = [np.zeros(0, int)]
    for a, b, pair in matches:
        one, other = rows[a][pair[:, 0]], rows[b][pair[:, 1]]
        keys.append((one * len(points) + other)[(one >= 0) & (other >= 0) & (one != other)])
    links, times = np.unique(np.concatenate(keys), return_counts=True)
    linked = np.stack(np.divmod(links[times > 1], max(len(points), 1)), axis=1)  # wrong matches are not made again
    here, there = points[linked[:, 0]], points[linked[:, 1]]
    apart = np.linalg.norm(here - there, axis=1) > _FITS * _FAR * pixel
    linked, here, there = linked[apart], here[apart], there[apart]
    if len(linked) < _LEAST:
        return None
    fit = _one_motion(here, there, _FITS * pixel)
    before, after = np.unique(linked[fit, 0]), np.unique(linked[fit, 1])
    if min(len(before), len(after)) < _LEAST:
        return None
    seen = np.array([np.isin(before, row) for row in rows]), np.array([np.isin(after, row) for row in rows])
    ours, theirs = (one.sum(axis=1) for one in seen)
    # Views on the right side of each moment: of the points before it, and of those after it.
    right = np.cumsum([0, *ours])[:-1] + theirs.sum() - np.cumsum([0, *theirs])[:-1]
    moment = int(right.argmax())
    if right[moment] < _APART * (ours.sum() + theirs.sum()):
        return None
    early = np.arange(len(rows)) < moment
    absent = _is_absent(points[before], ~early, centres, seen[0], inside[:, before])
    return moment if absent and _is_absent(points[after], early, centres, seen[1], inside[:, after]) else None


def _one_motion(here: Array, there: Array, tolerance: float) -> Array:
    """(n,) bool: the most pairs of points that one rigid motion takes to each other, by RANSAC (Kabsch 1976)."""
    random = np.random.default_rng(0)
    chosen = random.integers(0, len(here), (_TRIALS, 3))
    a, b = here[chosen], there[chosen]
    middle_a, middle_b = a.mean(axis=1), b.mean(axis=1)
    u, _, v = np.linalg.svd(np.swapaxes(a - middle_a[:, None], 1, 2) @ (b - middle_b[:, None]))
    u[..., 2] *= np.sign(np.linalg.det(u @ v))[:, None]
    turns = u @ v  # rows are turned
    best = np.zeros(len(here), bool)
    for turn, start, end in zip(turns, middle_a, middle_b, strict=True):
        fit = np.square((here - start) @ turn + end - there).sum(axis=1) < tolerance**2
        if fit.sum() > best.sum():
            best = fit
    return best


def _is_absent(points: Array, others: Array, centres: Array, seen: Array, inside: Array) -> bool:
    """Whether the pictures `others` do not see points that they would, as some of the rest do from the same side."""
    should = found = 0
    for point, seeing, framing in zip(points, seen.T, inside.T, strict=True):
        towards = centres - point
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        near = (towards[others] @ towards[~others & seeing].T > _ALIKE).any(axis=1) & framing[others]
        should += int(near.sum())
        found += int(seeing[others][near].sum())
    return should >= _LEAST and found <= _SEEN * should


def moved_at(colmap: Any, model: Any, database: Path, files: Sequence[str]) -> str | None:
    """The first of `files` in whose picture a part of the scene stands elsewhere than before; None where none does.

    Parameters
    ----------
    colmap : module
    model : pycolmap.Reconstruction
    database : Path
        COLMAP's, with the matches of each pair.
    files : sequence of str
        In the order in which they were taken.
    """
    images = {model.image(number).name: model.image(number) for number in model.reg_image_ids()}
    files = [file for file in files if file in images]
    row = {point: k for k, point in enumerate(model.points3D)}
    points = np.array([point.xyz for point in model.points3D.values()], np.float64).reshape(-1, 3)
    rows, centres, inside, pixels = [], [], [], []
    for file in files:
        image = images[file]
        camera, pose = model.camera(image.camera_id), np.asarray(image.cam_from_world().matrix())
        rows.append(np.array([row[p.point3D_id] if p.has_point3D() else -1 for p in image.points2D], int))
        centres.append(-pose[:, :3].T @ pose[:, 3])
        local = points @ pose[:, :3].T + pose[:, 3]
        depth = np.maximum(local[:, 2], 1e-9)
        x, y = (local[:, :2] / depth[:, None] * camera.mean_focal_length()).T
        inside.append((local[:, 2] > 0) & (np.abs(x) < 0.45 * camera.width) & (np.abs(y) < 0.45 * camera.height))
        pixels.append(np.median(depth[rows[-1][rows[-1] >= 0]]) / camera.mean_focal_length())
    order = {images[file].image_id: k for k, file in enumerate(files)}
    with colmap.Database.open(str(database)) as data:
        pairs, found = data.read_all_matches()
    matches = []
    for pair, features in zip(pairs, found):
        a, b = (order.get(number, -1) for number in colmap.pair_id_to_image_pair(pair))
        if min(a, b) >= 0 and len(features):
            alike = np.asarray(features, int)
            matches.append((a, b, alike) if a < b else (b, a, alike[:, ::-1]))
    moment = find_move(rows, matches, points, np.array(centres), np.array(inside), float(np.median(pixels)))
    return None if moment is None else files[moment]
