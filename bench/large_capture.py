"""Captures as large as one wishes: each surfel of a real one as many that share its place, for benchmarks of size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from report import ROOT
from subjects import asset_path

from drgs_blender.build.importer import import_asset
from drgs_blender.core.asset import Asset, Binding
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.part import taken
from drgs_blender.geometry.normals import rotation_matrices

CAPTURE = ROOT / "examples" / "playbot" / "playbot.ply"


def enlarged(asset: Asset, count: int, seed: int = 0) -> Asset:
    """An asset of `count` surfels: those of `asset` in turn, smaller by as many as there are, moved within their discs.

    Materials vary a little, as those of a capture do.
    """
    assert asset.binding is not None
    rng = np.random.default_rng(seed)
    n = len(asset.surfels)
    rows = np.sort(np.arange(count) % n)
    surfels = taken(asset.surfels, rows)
    smaller = np.float32(np.sqrt(n / count))
    moved = rng.standard_normal((count, 2), np.float32) * np.sqrt(1 - smaller**2)
    frames = rotation_matrices(surfels.rotation)
    shift = np.einsum("nik,nk->ni", frames[..., :2], surfels.scale * moved, dtype=np.float32)
    surfels.centre += shift
    surfels.scale *= smaller
    surfels.albedo = np.clip(surfels.albedo + rng.normal(0, 0.03, (count, 3)).astype(np.float32), 0, 1)
    own = asset.binding
    corners = asset.mesh.vertices[asset.mesh.faces[own.face]].astype(np.float64)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    inverse = np.linalg.pinv(np.stack([e1, e2], axis=-1))[rows]
    along = np.einsum("nij,nj->ni", inverse, shift.astype(np.float64))
    weights = own.barycentric[rows] + np.column_stack([-along.sum(axis=1), along]).astype(np.float32)
    surfels.extras = {}
    return replace(asset, surfels=surfels, binding=Binding(own.face[rows], weights, own.offset[rows], own.normal[rows]))


def large_asset(count: int) -> Path:
    """`.drgs` of the capture in examples/ with `count` surfels, made once for these sources."""
    folder = asset_path("spot").parent
    whole, path = folder / "capture.drgs", folder / f"capture-{count}.drgs"
    if not whole.exists():
        write_asset(whole, import_asset(CAPTURE))
    if not path.exists():
        write_asset(path, enlarged(read_asset(whole), count))
    return path
