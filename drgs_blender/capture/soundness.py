"""Registered pictures that are not sound: matches contradict their cameras, or they hang on the others by few points.

The reprojection error of a camera does not tell: a picture of one side of an object that looks alike from behind, or a
group that a handful of points ties to the others, has as small an error in the wrong place as in the right one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.arrays import Array
from ..core.errors import AssetError
from .left_out import Cause, Reason

if TYPE_CHECKING:
    from .registration import Registration

#: Points, seen by two or more of the other pictures, without which a camera is none.
LEAST_POINTS = 12
#: Distance from the epipolar line, pixels, up to which a match agrees with two cameras: COLMAP's own of verified pairs.
_AGREES = 4.0
#: Part of a picture's verified matches that must agree with the cameras of the others.
_AGREEING = 0.5
#: Degrees that the directions of all cameras span, below which they show one side alone.
_SPAN = 12.0
#: Part of its points that a picture may share with those left out, which may have bent its camera.
_SHARED = 0.25


def read_matches(colmap: Any, database: Path) -> list[tuple[int, int, Array]]:
    """Matches of each pair of pictures that epipolar geometry verified: numbers of the pictures, (n, 2) features."""
    with colmap.Database.open(str(database)) as data:
        pairs, geometries = data.read_two_view_geometries()
    found = []
    for pair, geometry in zip(pairs, geometries):
        matches = np.asarray(geometry.inlier_matches)
        if len(matches):
            found.append((*colmap.pair_id_to_image_pair(pair), matches))
    return found


def leave_out_unsound(model: Any, matches: Sequence[tuple[int, int, Array]]) -> dict[str, Cause]:
    """Take the pictures out of a model that are not sound, and those that lean on them, which may be registered again.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Changed.
    matches : sequence of (int, int, (n, 2) array)
        Of `read_matches`.

    Returns
    -------
    dict of str to Cause
        File -> why it is out.
    """
    out: dict[int, Cause] = {}
    leaning: list[int] = []
    agreeing = _agreement(model, matches)
    while agreeing:
        number, part = worst(agreeing)
        if part >= _AGREEING:
            break
        out[number] = Cause(Reason.CONTRADICTED, f"{1 - part:.0%} of them")
        agreeing = {pair: counts for pair, counts in agreeing.items() if number not in pair}
    kept = set(model.reg_image_ids()) - out.keys()
    tracks = [{element.image_id for element in point.track.elements} & kept for point in model.points3D.values()]
    core = largest_core(tracks)
    for number in kept - core:
        out[number] = Cause(Reason.LOOSE, f"fewer than {LEAST_POINTS}")
    for number in core:
        points = [point.point3D_id for point in model.image(number).points2D if point.has_point3D()]
        shared = sum(any(one.image_id in out for one in model.point3D(k).track.elements) for k in points)
        if shared > _SHARED * len(points):
            leaning.append(number)
    out |= dict.fromkeys(leaning, Cause(Reason.LEANING))
    for number in out:
        model.deregister_frame(model.image(number).frame_id)
    return {model.image(number).name: why for number, why in out.items()}


def worst(agreeing: dict[tuple[int, int], tuple[int, int]]) -> tuple[int, float]:
    """The picture of whose matches the least part agrees, and that part.

    Parameters
    ----------
    agreeing : dict of (int, int) to (int, int)
        Pair of pictures -> its matches that agree with both cameras, and all of its matches.

    Examples
    --------
    >>> worst({(1, 2): (90, 100), (1, 3): (5, 50), (2, 3): (0, 40)})
    (3, 0.05555555555555555)
    """
    sums: dict[int, list[int]] = {}
    for pair, counts in agreeing.items():
        for number in pair:
            one = sums.setdefault(number, [0, 0])
            one[0] += counts[0]
            one[1] += counts[1]
    return min(((number, agree / of) for number, (agree, of) in sums.items()), key=lambda found: found[::-1])


def largest_core(tracks: Iterable[set[int]]) -> set[int]:
    """The most pictures that can be registered one after the other, each by points that two before it see.

    Parameters
    ----------
    tracks : iterable of set of int
        Of each point, the pictures that see it.

    Examples
    --------
    Two groups, and two points that join them:

    >>> groups = [{1, 2, 3, 4}] * 20 + [{5, 6, 7}] * 30 + [{4, 5}, {3, 4, 5}]
    >>> largest_core(groups)
    {1, 2, 3, 4}
    """
    shared = [track for track in tracks if len(track) > 1]
    together = Counter(pair for track in shared for pair in combinations(sorted(track), 2))
    seen: dict[int, list[int]] = {}
    for k, track in enumerate(shared):
        for number in track:
            seen.setdefault(number, []).append(k)
    left, best = set(seen), set[int]()
    while len(left) > len(best):
        pairs = [pair for pair in together if pair[0] in left and pair[1] in left]
        if not pairs:
            break
        core = _grow(max(pairs, key=together.__getitem__), shared, seen)
        left -= core
        best = max(best, core, key=len)
    return best


def _grow(start: tuple[int, int], tracks: Sequence[set[int]], seen: dict[int, list[int]]) -> set[int]:
    """`start` and what is registered after it."""
    core, count, support = set[int](), [0] * len(tracks), Counter[int]()
    following: list[int] = list(start)
    while following:
        number = following.pop()
        core.add(number)
        for k in seen[number]:
            count[k] += 1
            if count[k] == 2:
                support.update(tracks[k])
        if not following:
            more = [(points, other) for other, points in support.items() if other not in core]
            if more and max(more)[0] >= LEAST_POINTS:
                following = [max(more)[1]]
    return core


def _agreement(model: Any, matches: Sequence[tuple[int, int, Array]]) -> dict[tuple[int, int], tuple[int, int]]:
    """Pair of registered pictures -> matches that agree with its cameras, and all."""
    rays, poses, focals = {}, {}, {}
    for number in model.reg_image_ids():
        image = model.image(number)
        camera = model.camera(image.camera_id)
        pixels = np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)
        plane = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
        rays[number] = np.column_stack([plane, np.ones(len(plane))])
        poses[number], focals[number] = np.asarray(image.cam_from_world().matrix()), camera.mean_focal_length()
    found = {}
    for a, b, pair in matches:
        if a not in rays or b not in rays:
            continue
        turn = poses[b][:, :3] @ poses[a][:, :3].T
        x, y, z = poses[b][:, 3] - turn @ poses[a][:, 3]
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
        first, second = rays[a][pair[:, 0]], rays[b][pair[:, 1]]
        lines, others = first @ essential.T, second @ essential
        slope = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (others[:, :2] ** 2).sum(axis=1))
        focal = np.sqrt(focals[a] * focals[b])
        agree = np.abs((second * lines).sum(axis=1)) * focal < _AGREES * slope
        found[a, b] = int(agree.sum()), len(pair)
    return found


def check_directions(found: Registration, subject: str) -> None:
    """Raise AssetError where all cameras look the same way: of an object that was turned, or of one side of it."""
    facing = np.array([-matrix[:3, 2] for matrix in found.matrices.values()])
    span = float(np.degrees(np.arccos(np.clip((facing @ facing.T).min(), -1, 1))))
    if span < _SPAN:
        raise AssetError(
            subject, f"shows one side alone: its {len(facing)} cameras look the same way within {span:.0f} degrees",
            "Go around the object. If it was turned before a camera that stood still, draw masks, or let a marker "
            "sheet turn with it (drgs markers)",
        )  # fmt: skip
