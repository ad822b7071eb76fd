"""Kernels compiled for a card by NVIDIA's compiler, which Warp brings: it needs no card."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

import test_device_camera_hits
import test_device_deform
import test_device_gmls
import test_device_integrate
import test_device_mpm
import test_device_raster
import warp
from test_device_denoise import nothing, pictures

from drgs_blender.compute.warp.kernels import Launcher
from drgs_blender.deform.gpu import gmls
from drgs_blender.deform.gpu import mesh_driven as deformation
from drgs_blender.deform.gpu.mesh_driven import Deformer
from drgs_blender.render.gpu import attach, bvhs, camera_hits, integrate, raster, splats, svgf_kernels
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.simulation.gpu import cells, steps

#: A100 and later.
ARCHITECTURE = 80


def made(wanted: tuple[object, ...], launcher: Launcher, folder: Path) -> set[object]:
    """Compile what a device was asked for, of these kernels; those that were."""
    found = set()
    for kernel, types in launcher._modules:
        if kernel in wanted:
            module = kernel.module(types, True)
            (file,) = warp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=str(folder))
            assert Path(file).stat().st_size > 1000
            found.add(kernel)
    return found


@pytest.mark.slow
def test_pictures_kernels_compile_for_a_card(tmp_path: Path) -> None:
    device = WarpRenderBackend("cpu")
    asset = test_device_deform.driven()
    deformer = Deformer(device.launcher)
    deformer.pose(asset, asset.mesh.vertices)
    deformer.pose(asset, asset.mesh.vertices, test_device_deform.corner_normals(asset.mesh))
    test_device_raster.test_points_are_tied_to_the_mesh_as_the_processor_ties_them(device, 0.1, True)
    scene, view = test_device_camera_hits.unseen()[0], test_device_camera_hits.VIEWS["perspective"]
    test_device_camera_hits.seen(device, scene, view)
    history = None
    for picture in pictures(2):
        _, history = device.denoise_next(picture, history, True, False, nothing)
    wanted = raster.BLEND, attach.ATTACH, *svgf_kernels.KERNELS
    wanted += deformation.WEIGH, deformation.SUM, deformation.POSE
    wanted += bvhs.PLACE, camera_hits.TRACE, camera_hits.SHADE
    wanted += splats.PROJECT, splats.KEY, splats.FIND, splats.GATHER, splats.LIST
    assert made(wanted, device.launcher, tmp_path) == set(wanted)
    assert not device.failed


@pytest.mark.slow
def test_learnings_kernels_compile_for_a_card(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    import test_device_gather
    import test_device_learning
    import test_device_surfels

    from drgs_blender.reconstruct.gpu import appearance, gather, kernels, losses, warp_backend

    device = warp_backend.WarpLearningBackend("cpu")
    test_device_surfels.test_every_map_has_a_gradient_of_its_own(device.launcher)
    test_device_learning.test_difference_from_a_photograph(device)
    test_device_learning.test_attributes(device, 2, True)
    test_device_learning.test_what_is_mirrored(device)
    test_device_learning.test_losses_of_the_shape(device, (0.0, 0.0, 0.25))
    test_device_learning.test_a_step_down(device)
    test_device_gather.test_what_arrives_and_its_derivatives(device, {}, True)
    modules = appearance, kernels, losses, warp_backend, gather
    wanted = {
        kernel for module in modules for kernel in vars(module).values() if isinstance(kernel, kernels.WarpKernel)
    }
    assert made(tuple(wanted), device.launcher, tmp_path) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("case", ["all", "vortex"])
def test_particles_kernels_compile_for_a_card(tmp_path: Path, case: str) -> None:
    launcher = Launcher("cpu")
    test_device_mpm.test_a_step_is_the_processors_to_the_last_digits(launcher, case)
    test_device_gmls.test_a_device_carries_points_as_the_processor_does(launcher, "torn", 16, np.float64)
    wanted = (
        cells.NUMBER,
        cells.LIST,
        cells.INDEX,
        cells.FIND_HOMES,
        steps.PREPARE,
        steps.GATHER,
        steps.SOLVE,
        steps.MOVE,
        steps.END_STEP,
    )
    wanted += (gmls.CARRY,)
    assert made(wanted, launcher, tmp_path) == set(wanted)


@pytest.mark.skipif(os.environ.get("DRGS_FAULTS") != "whole", reason="takes minutes; DRGS_FAULTS=whole runs it")
def test_the_integrator_compiles_for_a_card(tmp_path: Path) -> None:
    device = WarpRenderBackend("cpu")
    for scene in (test_device_integrate.under_sky(), test_device_integrate.among_meshes()):
        test_device_integrate.both(device, scene, test_device_integrate.SETTINGS)
    assert made((integrate.SHADE,), device.launcher, tmp_path) == {integrate.SHADE}
