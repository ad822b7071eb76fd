"""The `.drgs` file: one asset, self-contained, memory-mapped, with a hash over everything (docs/asset-format.md).

``manifest.json`` describes the other members (size, SHA-256, dtype and shape of every tensor); the tensors are in
safetensors members, aligned so that they are mapped and never copied. Nothing is executed, nothing points outside.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arrays import outside
from ..errors import AssetError, VersionError
from ..version import __version__
from .archive import read_archive, write_archive
from .model import (
    BASE_CHANNELS,
    MATERIAL_CHANNELS,
    SURFEL_CHANNELS,
    Asset,
    Binding,
    Environment,
    Mesh,
    SourceVertices,
    Surfels,
)
from .schema import CONVENTIONS, OPTIONAL_TENSORS, SCHEMA, SINCE, TENSORS, TEXTURES, lowest_schema
from .tensors import decode, dtype_name, encode, parse_json
from .textures import check_textures, tensors_of, textures_of

Array = np.ndarray
PathLike = str | os.PathLike[str]

MANIFEST = "manifest.json"
#: Largest deviation from a limit (range [0, 1], unit length) that is taken for rounding.
TOLERANCE = 1e-3
_REQUIRED = ("surfels.safetensors", "mesh.safetensors")
_RESTORE = "Restore the file from a copy, or import the source files again"


def write_asset(path: PathLike, asset: Asset) -> None:
    """Write `asset` to `path` atomically: after a failure the old file, if any, is untouched.

    Raises
    ------
    AssetError
        The asset is one that `read_asset` would refuse (non-finite values, indices out of range, ...).
    WriteError
        The file cannot be written; names `path`.
    """
    subject = os.fspath(path)
    check_asset(asset, subject)
    members: dict[str, Any] = {}
    buffers: dict[str, list[memoryview]] = {}
    for member, tensors in _tensors_of(asset).items():
        tensors = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
        buffers[member] = encode(tensors)
        digest = hashlib.sha256()
        for buffer in buffers[member]:
            digest.update(buffer)
        members[member] = {
            "size": sum(len(b) for b in buffers[member]),
            "sha256": digest.hexdigest(),
            "tensors": {n: {"dtype": dtype_name(a), "shape": list(a.shape)} for n, a in tensors.items()},
        }
    manifest = {
        "format": "drgs",
        "schema": lowest_schema(members),
        "producer": f"drgs-blender {__version__}",
        **CONVENTIONS,
        "members": members,
        "provenance": asset.provenance,
    }
    try:
        text = json.dumps(manifest, ensure_ascii=False, allow_nan=False, indent=1).encode()
    except (TypeError, ValueError) as error:
        raise AssetError(f"{subject}, provenance", f"cannot be written as JSON ({error})") from error
    write_archive(path, [(MANIFEST, [memoryview(text)]), *buffers.items()])


def read_asset(path: PathLike, verify: bool = True, faults: list[str] | None = None) -> Asset:
    """Open the asset at `path`; its arrays are read-only views of the mapped file.

    Parameters
    ----------
    path : str or path-like
    verify : bool
        Also read everything once: SHA-256 of every member, finite values, ranges. Without it only structure, shapes and
        indices are checked, which is enough never to crash.
    faults : list of str, optional
        Where given, textures that are damaged are left out and named here; the rest of the asset is read.

    Raises
    ------
    AssetError
        Names file, member and tensor, and what is wrong.
    VersionError
        The file was written by a later version.

    Examples
    --------
    >>> from drgs_blender.core.asset.model import Asset, Mesh
    >>> from drgs_blender.deform.attach import attach
    >>> corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    >>> mesh = Mesh(corners, [[0, 1, 2], [0, 2, 3]], albedo=[[0.5] * 3] * 4, roughness=[1] * 4, metallic=[0] * 4)
    >>> surfels, binding, report = attach(mesh, density=1)
    >>> write_asset("square.drgs", Asset(surfels, mesh, binding, provenance={"by": "hand"}))
    >>> asset = read_asset("square.drgs")
    >>> asset.mesh.faces
    array([[0, 1, 2],
           [0, 2, 3]], dtype=int32)
    >>> asset.binding.face, asset.provenance
    (array([0, 0, 1, 1], dtype=int32), {'by': 'hand'})
    """
    subject = os.fspath(path)
    members = read_archive(path, check=(MANIFEST,))
    manifest = _manifest(members, subject)
    parts = [name for name in members if name not in (MANIFEST, TEXTURES)]
    tensors = {name: _tensors(name, members, manifest, subject, verify) for name in parts}
    try:
        asset = _asset(tensors, manifest["provenance"])
    except AssetError as error:
        raise AssetError(f"{subject}, {error.subject}", error.problem, error.remedy or _RESTORE) from error
    check_asset(asset, subject, values=verify)
    if TEXTURES in members:
        try:
            arrays = _tensors(TEXTURES, members, manifest, subject, verify)
            asset.mesh.textures = textures_of(arrays, len(asset.mesh.faces), f"{subject}, {TEXTURES}")
        except AssetError as error:
            if faults is None:
                raise
            faults.append(
                f"{str(error).rstrip('.')}; its textures are left out, the materials of its vertices are shown"
            )
    return asset


def inspect_asset(path: PathLike, verify: bool = True) -> dict[str, Any]:
    """Describe the asset at `path` with JSON-able values: counts, bounds (metres), ranges, members, provenance.

    Raises
    ------
    AssetError, VersionError
        As `read_asset`.
    """
    asset = read_asset(path, verify)
    members = read_archive(path, check=(MANIFEST,))
    manifest = _manifest(members, os.fspath(path))
    surfels, mesh = asset.surfels, asset.mesh
    counts = {
        "surfels": len(surfels),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "groups": len(mesh.groups),
        "source_vertices": mesh.source_count,
        "sh_coefficients": 0 if surfels.sh is None else surfels.sh.shape[1],
    }
    counts |= {} if mesh.textures is None else {"images": len(mesh.textures.images)}
    ranges = {
        f"{kind}.{name}": _range(getattr(part, name))
        for kind, part, names in (
            ("surfels", surfels, ("scale", "opacity", *BASE_CHANNELS, *SURFEL_CHANNELS)),
            ("mesh", mesh, MATERIAL_CHANNELS),
        )
        for name in names
        if getattr(part, name) is not None
    }
    if asset.environment is not None:
        ranges["environment.radiance"] = _range(asset.environment.radiance)
    return {
        **{key: value for key, value in manifest.items() if key not in ("members", "provenance")},
        "digest": hashlib.sha256(members[MANIFEST].data).hexdigest(),
        "verified": verify,
        "counts": counts,
        "bounds": {"surfels": _bounds(surfels.centre), "mesh": _bounds(mesh.vertices)},
        "ranges": ranges,
        "bound": asset.binding is not None,
        "environment": None if asset.environment is None else list(asset.environment.radiance.shape[:2]),
        "extras": sorted(surfels.extras),
        "members": manifest["members"],
        "provenance": manifest["provenance"],
    }


def digest_asset(path: PathLike) -> str:
    """SHA-256 of the manifest, which holds that of every other member: the identity of the asset's content."""
    members = read_archive(path, check=(MANIFEST,))
    _manifest(members, os.fspath(path))
    return hashlib.sha256(members[MANIFEST].data).hexdigest()


def check_asset(asset: Asset, subject: str, values: bool = True) -> None:
    """Raise AssetError where counts disagree or indices are out of range; with `values`, where numbers are not valid.

    Valid numbers are finite; materials and opacity are in [0, 1], scales, radiance and emission not negative,
    quaternions and binding normals of unit length, barycentric coordinates and source weights of sum 1, the latter not
    negative.
    """
    surfels, mesh, binding = asset.surfels, asset.mesh, asset.binding
    for name, extra in surfels.extras.items():
        if extra.ndim not in (1, 2) or len(extra) != len(surfels) or extra.dtype != np.float32:
            raise AssetError(f"{subject}, surfels extras/{name}", f"is {extra.dtype} {extra.shape}, not one per surfel")
    _check_indices(mesh.faces, len(mesh.vertices), f"{subject}, mesh faces", "vertices")
    for name, group in mesh.groups.items():
        if group.ndim != 1 or group.dtype != np.int32:
            raise AssetError(f"{subject}, mesh groups/{name}", "is not a list of vertex indices")
        _check_indices(group, len(mesh.vertices), f"{subject}, mesh groups/{name}", "vertices")
    if binding is not None:
        if binding.face.shape != (len(surfels),):
            raise AssetError(f"{subject}, binding", f"has face shape {binding.face.shape} for {len(surfels)} surfels")
        _check_indices(binding.face, len(mesh.faces), f"{subject}, binding face", "faces")
    if mesh.source is not None:
        where = f"{subject}, source index"
        if len(mesh.source.index) != len(mesh.vertices):
            raise AssetError(where, f"has {len(mesh.source.index)} rows for {len(mesh.vertices)} vertices", _RESTORE)
        _check_indices(mesh.source.index, mesh.source_count, where, "vertices of the source")
    if mesh.textures is not None:
        check_textures(mesh.textures, len(mesh.faces), f"{subject}, {TEXTURES}")
    if values:
        for member, tensors in _tensors_of(asset).items():
            for name, array in tensors.items():
                _check_values(array, name, f"{subject}, {member}, {name}")


def _manifest(members: Mapping[str, Array], subject: str) -> dict[str, Any]:
    """The checked manifest: known schema, our conventions, exactly the members that are there."""
    where = f"{subject}, {MANIFEST}"
    if next(iter(members), None) != MANIFEST:
        raise AssetError(where, "is missing or not the first member", _RESTORE)
    text = members[MANIFEST].tobytes()
    manifest = parse_json(text, where)
    if manifest.get("format") != "drgs":
        raise AssetError(where, "does not say that this is a .drgs file", _RESTORE)
    schema = manifest.get("schema")
    if isinstance(schema, int) and schema > SCHEMA:
        raise VersionError(
            subject,
            f"has schema {schema}, written by {manifest.get('producer')}; DR-GS {__version__} reads up to {SCHEMA}",
            "Update DR-GS",
        )
    if schema not in range(1, SCHEMA + 1) or isinstance(schema, bool):
        raise AssetError(where, f"has the unknown schema {schema!r}", _RESTORE)
    for key, value in CONVENTIONS.items():
        if manifest.get(key) != value:
            raise AssetError(where, f"states {key} {manifest.get(key)!r} where {value!r} is meant", _RESTORE)
    listed = manifest.get("members")
    if not isinstance(listed, dict) or not isinstance(manifest.get("provenance"), dict):
        raise AssetError(where, "lacks the list of members or the provenance", _RESTORE)
    for name in [*_REQUIRED, *listed]:
        if name not in members or name not in listed:
            raise AssetError(f"{subject}, {name}", "is missing", _RESTORE)
    for name in members:
        if name != MANIFEST and (name not in listed or name not in TENSORS):
            raise AssetError(f"{subject}, {name}", f"is not a member of schema {schema}", _RESTORE)
    return manifest


def _tensors(
    member: str, members: Mapping[str, Array], manifest: dict[str, Any], subject: str, verify: bool
) -> dict[str, Array]:
    """The arrays of `member`, as the manifest and the schema want them."""
    where = f"{subject}, {member}"
    entry, data = manifest["members"][member], members[member]
    if not isinstance(entry, dict) or entry.get("size") != len(data):
        raise AssetError(where, "does not have the size that the manifest states", _RESTORE)
    if verify and hashlib.sha256(data.data).hexdigest() != entry.get("sha256"):
        raise AssetError(where, "has been altered: its SHA-256 is not that of the manifest", _RESTORE)
    tensors = decode(data, where)
    if entry.get("tensors") != {n: {"dtype": dtype_name(a), "shape": list(a.shape)} for n, a in tensors.items()}:
        raise AssetError(where, "does not hold the tensors that the manifest lists", _RESTORE)
    known, schema = TENSORS[member], manifest["schema"]
    for name, array in tensors.items():
        family = name.split("/", 1)[0] + "/" if "/" in name else name
        if known.get(family) != dtype_name(array) or SINCE.get((member, name), 1) > schema:
            raise AssetError(f"{where}, {name}", f"with type {array.dtype} is not part of schema {schema}", _RESTORE)
    for name in known:
        if name not in tensors and not name.endswith("/") and (member, name) not in OPTIONAL_TENSORS:
            raise AssetError(f"{where}, {name}", "is missing", _RESTORE)
    return tensors


def _tensors_of(asset: Asset) -> dict[str, dict[str, Array]]:
    """member -> tensor -> array: the inverse of `_asset`."""
    parts = {
        "surfels.safetensors": _fields(asset.surfels, "extras"),
        "mesh.safetensors": _fields(asset.mesh, "groups"),
    }
    if asset.mesh.source is not None:
        parts["source.safetensors"] = _fields(asset.mesh.source)
    if asset.binding is not None:
        parts["binding.safetensors"] = _fields(asset.binding)
    if asset.environment is not None:
        parts["environment.safetensors"] = _fields(asset.environment)
    if asset.mesh.textures is not None:
        parts[TEXTURES] = tensors_of(asset.mesh.textures)
    return parts


def _asset(tensors: dict[str, dict[str, Array]], provenance: dict[str, Any]) -> Asset:
    def split(member: str, family: str = "") -> dict[str, Any]:
        fields: dict[str, Any] = {name: a for name, a in tensors[member].items() if "/" not in name}
        if family:
            prefix = family + "/"
            fields[family] = {n.removeprefix(prefix): a for n, a in tensors[member].items() if n.startswith(prefix)}
        return fields

    bound, lit = "binding.safetensors" in tensors, "environment.safetensors" in tensors
    source = SourceVertices(**split("source.safetensors")) if "source.safetensors" in tensors else None
    return Asset(
        surfels=Surfels(**split("surfels.safetensors", "extras")),
        mesh=Mesh(**split("mesh.safetensors", "groups"), source=source),
        binding=Binding(**split("binding.safetensors")) if bound else None,
        environment=Environment(**split("environment.safetensors")) if lit else None,
        provenance=provenance,
    )


def _fields(part: Surfels | Mesh | Binding | Environment | SourceVertices, family: str = "") -> dict[str, Array]:
    """Arrays of one part of an asset by name; those of the dictionary `family` as "family/name"."""
    fields: dict[str, Array] = {}
    for name in part.__slots__:
        value = getattr(part, name)
        if name == family:
            fields.update({f"{family}/{key}": array for key, array in value.items()})
        elif isinstance(value, np.ndarray):
            fields[name] = value
    return fields


def _check_indices(indices: Array, limit: int, where: str, what: str) -> None:
    if (wrong := outside(indices, limit)) is not None:
        raise AssetError(where, f"refers to number {wrong} of {limit} {what}", _RESTORE)


def _check_values(array: Array, name: str, where: str) -> None:
    """Raise AssetError where a number of the tensor `name` cannot be used."""
    if array.dtype.kind != "f" or not array.size:
        return
    low, high = float(array.min()), float(array.max())  # NaN and infinity both show in one of them
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise AssetError(where, f"has {bad} values that are NaN or infinite", "Import the source files again")
    wrong = ""
    channel = MATERIAL_CHANNELS.get(name)
    if channel is not None and channel.limit == 1 and (low < -TOLERANCE or high > 1 + TOLERANCE):
        wrong = f"reaches from {low:g} to {high:g}, outside [0, 1]"
    elif name in ("scale", "radiance", "emission") and low < 0:
        wrong = f"has the negative value {low:g}"
    elif name in ("rotation", "normal"):
        squared = np.einsum("ij,ij->i", array, array)
        if np.abs(squared - 1).max() > 2 * TOLERANCE:
            wrong = "has rows that are not of unit length"
    elif name in ("barycentric", "weights") and np.abs(array.sum(axis=1) - 1).max() > TOLERANCE:
        wrong = "has rows that do not sum to 1"
    elif name == "weights" and low < -TOLERANCE:
        wrong = f"has the negative value {low:g}"
    elif name == "transform" and np.linalg.matrix_rank(array / max(abs(low), abs(high), 1e-30)) < 3:
        wrong = "flattens the vertices"
    if wrong:
        raise AssetError(where, wrong, "Import the source files again")


def _bounds(points: Array) -> list[list[float]] | None:
    """[[min x, y, z], [max x, y, z]], or None without points."""
    return [points.min(axis=0).tolist(), points.max(axis=0).tolist()] if len(points) else None


def _range(values: Array) -> list[float] | None:
    return [float(values.min()), float(values.max())] if values.size else None
