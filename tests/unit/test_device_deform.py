"""Surfels that follow their mesh on a device, on Warp's device "cpu": as the processor poses them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, assert_same, host
from test_deform_mesh_driven import blob, matrix, shell_surfels

from drgs_blender.compute.warp.kernels import Launcher
from drgs_blender.compute.warp.posed_surfels import FIELDS, DevicePosedSurfels, arrays_of, joined, with_fields
from drgs_blender.compute.warp.runtime import is_there
from drgs_blender.core.asset.model import Mesh
from drgs_blender.core.errors import DeviceError
from drgs_blender.deform.binding import bind
from drgs_blender.deform.gpu.mesh_driven import Deformer
from drgs_blender.deform.mesh_driven import MeshDriven

MIRRORED = matrix(np.diag([-1.5, 0.5, 1.0]) @ [[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]], (3.0, -2.0, 1.0))


def driven(collapsed: bool = False) -> MeshDriven:
    mesh = blob()
    if collapsed:  # some faces have no area at rest
        mesh.vertices[mesh.faces[:40, 1]] = mesh.vertices[mesh.faces[:40, 0]]
    surfels = shell_surfels(mesh)
    surfels.scale[::2] *= 8  # larger than their faces
    return MeshDriven(mesh, surfels, bind(mesh, surfels)[0])


def bent(mesh: Mesh) -> np.ndarray:
    x, y, z = mesh.vertices.T
    moved = np.stack([x + 0.3 * np.sin(2 * z), 1.4 * y, z + 0.2 * x * y], -1).astype(np.float32)
    moved[mesh.faces[7]] = moved[mesh.faces[7, 0]]  # a face that has collapsed
    return moved


def corner_normals(mesh: Mesh) -> np.ndarray:
    normals = np.random.default_rng(1).normal(size=(len(mesh.faces), 3, 3))
    return (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)


POSES: dict[str, Callable[[Mesh], dict[str, Any]]] = {
    "bent": lambda mesh: {},
    "mirrored": lambda mesh: {"matrix_world": MIRRORED, "object_index": 2},
    "corners": lambda mesh: {"corner_normals_world": corner_normals(mesh), "matrix_world": MIRRORED},
    "torn": lambda mesh: {"torn": np.arange(len(mesh.faces)) % 5 == 0},
    "painted": lambda mesh: {"materials": {"roughness": np.full(len(mesh.vertices), 0.3, np.float32)}},
}


@pytest.fixture(scope="module")
def deformer() -> Deformer:
    return Deformer(Launcher(DEVICE))


@pytest.mark.slow
@pytest.mark.parametrize("collapsed", [False, True])
@pytest.mark.parametrize("name", POSES)
def test_a_device_poses_surfels_as_the_processor_does(deformer: Deformer, name: str, collapsed: bool) -> None:
    asset = driven(collapsed)
    assert (asset.degenerate_faces > 0) == collapsed
    vertices, options = bent(asset.mesh), POSES[name](asset.mesh)
    here, there = asset.pose(vertices, **options), deformer.pose(asset, vertices, **options)
    assert isinstance(there, DevicePosedSurfels) and len(there) == len(here)
    found = arrays_of(there, deformer.launcher)
    for field in FIELDS:
        expected = getattr(here, field)
        assert is_there(found[field]) and host(found[field]).dtype == expected.dtype
        np.testing.assert_allclose(host(found[field]), expected, 1e-5, 1e-6, err_msg=field)
        assert_same(getattr(there, field), expected, 1e-6, field)  # made here when it is asked for


def test_what_does_not_change_is_copied_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a second frame, only vertices and matrix go to the card, and nothing comes back from it before it is read."""
    asset, launcher, copied = driven(), Launcher(DEVICE), []
    launcher.apart, copy = True, launcher.array
    monkeypatch.setattr(launcher, "array", lambda array, *more: copied.append(array.nbytes) or copy(array, *more))
    deformer, vertices = Deformer(launcher), bent(asset.mesh)
    deformer.pose(asset, asset.mesh.vertices)
    for array in (*asset.rest, asset.normals.place, asset.normals.start):
        array.setflags(write=True)
        array.view(np.uint8)[...] = 0  # a card cannot read this memory
    copied.clear()
    there = deformer.pose(asset, vertices)
    arrays_of(there, launcher)
    assert sum(copied) == vertices.nbytes + 72
    np.testing.assert_allclose(host(there._there["centre"]), driven().pose(vertices).centre, 1e-5, 1e-6)


def test_surfels_on_vertices_that_are_not_finite_are_counted(deformer: Deformer) -> None:
    asset = driven()
    vertices = bent(asset.mesh)
    vertices[3] = np.inf
    here, there = asset.pose(vertices), deformer.pose(asset, vertices)
    assert asset.hidden_count > 0 and (there.opacity == 0).sum() == (here.opacity == 0).sum() >= asset.hidden_count
    deformer.pose(asset, bent(asset.mesh))
    assert asset.hidden_count == 0


def test_surfels_of_several_objects_lie_on_the_device_as_one(deformer: Deformer) -> None:
    """One that hangs on a mesh, one whose materials are others, one that this processor has made, and nothing."""
    asset = driven()
    first = deformer.pose(asset, bent(asset.mesh), object_index=0)
    shades = {"roughness": np.linspace(0, 1, len(first), dtype=np.float32)}
    second = with_fields(deformer.pose(asset, asset.mesh.vertices, object_index=1), shades)
    third = asset.pose(asset.mesh.vertices, object_index=2)
    nothing = type(third)(*(getattr(third, field)[:0] for field in FIELDS))
    parts = first, second, nothing, third

    def never() -> DevicePosedSurfels:
        raise AssertionError

    whole = joined(deformer.launcher, parts, never)
    assert len(whole) == 3 * len(first)
    for field in FIELDS:
        expected = np.concatenate([getattr(part, field) for part in parts])
        np.testing.assert_allclose(host(whole.on(deformer.launcher)[field]), expected, 1e-5, 1e-6, err_msg=field)
    np.testing.assert_array_equal(second.roughness, shades["roughness"])


def test_no_memory_to_join_surfels_in_is_the_devices_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which the processor's work then follows."""
    launcher, driver = Launcher(DEVICE), driven()
    parts = [driver.pose(driver.mesh.vertices) for _ in range(2)]

    def full(*_: Any, **__: Any) -> None:
        raise RuntimeError("Failed to allocate 1000000 bytes")

    monkeypatch.setattr(launcher, "array", full)
    with pytest.raises(DeviceError, match=r"joining surfels .*Failed to allocate"):
        joined(launcher, parts, lambda: parts[0])
