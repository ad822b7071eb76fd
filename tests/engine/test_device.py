"""Frames whose light is traced on a device: as on the processor; without a card on the processor, with a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, IS_CARD

from drgs_blender.core.frame import Adjustment, ObjectState
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.engine import jit_events
from drgs_blender.engine.session import Session

#: dB between devices. On a card last bits decide which of the surfels of one flat face comes first, as these lie at one
#: depth; the coarse ball of these tests has few faces, each with many surfels of unlike materials.
LIKE = 35.0 if IS_CARD else 60.0


@pytest.fixture
def warp_session(monkeypatch, asset_path):
    """A session for which Warp's processor is the card: the same code, without the card."""
    monkeypatch.setattr("drgs_blender.render.gpu.select_backend.name_of", lambda device: DEVICE)
    session = Session()
    session.load_asset(asset_path)
    return session


def psnr(a, b):
    error = np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)).astype(np.float64) ** 2)
    return -10 * np.log10(max(error, 1e-20))


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"denoise": "svgf"}, {"camera_sees": "mesh", "noise_threshold": 0.05}])
def test_the_picture_is_the_processors(session, warp_session, make_frame, changes):
    passes = ("Combined", "DiffDir", "GlossInd")
    frames = [replace(make_frame(samples=4, bounces=2, device=d, **changes), passes=passes) for d in ("cpu", "cuda")]
    here, there = session.render(frames[0]), warp_session.render(frames[1])
    assert there.warnings == here.warnings
    for name in passes:
        assert here[name].any() and psnr(here[name], there[name]) > LIKE


@pytest.mark.slow
def test_surfels_stay_on_a_device_from_deformation_to_picture(session, warp_session, make_frame, monkeypatch):
    """Two objects that move, tear, are mirrored, tinted and grainy; this processor poses the grains alone."""
    poses, pose = [], MeshDriven.pose
    monkeypatch.setattr(MeshDriven, "pose", lambda *given, **options: poses.append(1) or pose(*given, **options))
    for case in ("bent", "two", "torn", "tinted", "grainy", "again"):
        pictures, counts = [], []
        for which, device in ((session, "cpu"), (warp_session, "cuda")):
            frame = make_frame(0.3, device=device, samples=1)
            (item,) = frame.objects
            if case != "bent":
                other = ObjectState("Second", item.asset, np.diag([-0.5, 0.5, 0.5, 1.0]))
                other.matrix_world[:3, 3] = 0.5, -1.0, 0.5
                frame.objects.append(other)
            if case == "torn":
                item.vertices[item.vertices[:, 2] > 0.1, 2] += 0.4
                item.tear = 0.3
            if case == "tinted":
                mask = (item.vertices[:, 2] > 0).astype(np.float32)
                item.adjustment = Adjustment(tint=(0.5, 1.0, 0.25), mask=mask)
            if case == "grainy":
                item.vertices *= np.float32(1.6)
                item.grain = 0.3
            poses.clear()
            pictures.append(which.render(frame)["Combined"])
            counts.append(len(poses))
        assert psnr(*pictures) > LIKE, case
        assert counts[0] > 0 and counts[1] == (case == "grainy")


@pytest.mark.slow
def test_viewports_grow_on_a_device(session, warp_session, make_frame):
    last = []
    for which, device in ((session, "cpu"), (warp_session, "cuda")):
        passes = which.view("v", make_frame(samples=4, device=device))
        while passes.statistics["view.fraction"] < 1.0:
            passes = which.refine("v")
        last.append(passes["Combined"])
    assert psnr(*last) > LIKE


def test_without_a_card_a_frame_is_rendered_here_with_a_warning(session, make_frame, monkeypatch):
    monkeypatch.setattr("drgs_blender.compute.warp.runtime.cuda_devices", list)
    expected = session.render(make_frame())
    found = session.render(make_frame(device="cuda"))
    assert any("no NVIDIA card" in warning and "CPU" in warning for warning in found.warnings)
    np.testing.assert_array_equal(found["Combined"], expected["Combined"])


@pytest.mark.slow
def test_whoever_waits_is_told_that_kernels_are_made(warp_session, make_frame):
    """They take a minute, and an engine that says nothing for so long is taken for dead."""
    changes = []
    jit_events.watch(changes.append)
    warp_session.render(make_frame(device="cuda"))
    assert changes.count(1) == changes.count(-1) > 1 and changes[0] == 1
    changes.clear()
    warp_session.render(make_frame(0.1, device="cuda"))
    assert not changes
