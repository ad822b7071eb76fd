"""Digests of all that frames depend on: a frame is the same where both of a simulation are.

One is of the settings and of all at rest. What moves has one for each frame, of its motion until then, so that a longer
bake goes on from a shorter one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ..core.asset.model import Mesh
from ..core.sim_materials import RENAMED
from ..core.version import __version__
from .colliders import Collider
from .settings import Settings

Array = np.ndarray
#: Raised where a solver computes other bits than before: caches that older versions began are not continued.
_ARITHMETIC = {"mpm": 2}
#: Name of a setting -> the former one, which digests hash: caches of before stay valid.
_FORMER = {new: old for old, new in RENAMED.items()}


def digest_of(mesh: Mesh, settings: Settings, colliders: Sequence[Collider], motion: Array | None) -> str:
    """Digest of the settings and of what they name, in the first frame.

    Parameters
    ----------
    mesh : Mesh
    settings : Settings
    colliders : sequence of Collider
        Colliders of the settings.
    motion : (k, n, 3) array or None
        Vertices of the mesh, that pins follow; None where they stay.
    """
    described = asdict(settings)
    for key in ("last", "colliders", "motion", "device"):
        del described[key]
    for field in described["fields"]:
        field["frames"] = field["frames"][:1]
    # What moves is computed otherwise than what stands, also while it stands still.
    described["contacts"] = [(c.contact, c.friction, c.thickness, len(c.vertices) > 1) for c in colliders]
    described["moved"] = motion is not None
    parts = [*settings.pins, *(region for region, _ in settings.regions)]
    groups = sorted({part.group for part in parts if part.group is not None})
    if settings.courant is None and settings.solver not in _ARITHMETIC:
        described["courant"] = 0.5  # as it was before it could be left out
    hashed = [__version__, _with_former_names(described), groups]
    if settings.solver in _ARITHMETIC:
        hashed.append(_ARITHMETIC[settings.solver])
    digest = hashlib.sha256(json.dumps(hashed, sort_keys=True).encode())
    arrays = [mesh.vertices, mesh.faces, *(mesh.groups[name] for name in groups)]
    arrays += [a for c in colliders for a in (c.vertices[0], c.faces)]
    arrays += [] if motion is None else [motion[0]]
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(_bytes(array).data)
    return digest.hexdigest()


def moves_of(settings: Settings, colliders: Sequence[Collider], motion: Array | None) -> list[str]:
    """For each frame, a digest of how all that moves has moved until then; it moves no more after the last one."""
    tracks = {f"collider {i}": c.vertices for i, c in enumerate(colliders)}
    tracks |= {f"field {i}": np.array(field.frames, np.float64) for i, field in enumerate(settings.fields)}
    tracks |= {} if motion is None else {"pins": motion}
    digest, found = hashlib.sha256(), []
    for frame in range(max(map(len, tracks.values()), default=0)):
        for name, rows in tracks.items():
            if 0 < frame < len(rows) and not np.array_equal(rows[frame], rows[frame - 1]):
                digest.update(f"{frame} {name}".encode())
                digest.update(_bytes(rows[frame]).data)
        found.append(digest.hexdigest()[:16])
    while len(found) > 1 and found[-1] == found[-2]:
        found.pop()
    return found


def same_until(frame: int, one: Sequence[str], other: Sequence[str]) -> bool:
    """Whether two `moves_of` are of the same motion until `frame`, counted from 0."""
    return one[: frame + 1][-1:] == other[: frame + 1][-1:]


def _with_former_names(described: Any) -> Any:
    """The same settings, JSON-able, with the former name of each key that was renamed."""
    if isinstance(described, dict):
        return {_FORMER.get(key, key): _with_former_names(value) for key, value in described.items()}
    if isinstance(described, list | tuple):
        return [_with_former_names(value) for value in described]
    return described


def _bytes(array: Array) -> Array:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)
