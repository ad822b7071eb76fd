"""Normals by a model that the user has: photographs that show their normals as colours, and a network that copies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from capture_cases import photographed, rays_of, write  # noqa: E402
from test_segmentation_model import write_model  # noqa: E402

from drgs_blender.capture.normal_model import NormalModel, give_normals  # noqa: E402
from drgs_blender.cli.main import main  # noqa: E402
from drgs_blender.core.errors import AssetError, Cancelled, UsageError  # noqa: E402
from drgs_blender.core.frame import Camera  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture  # noqa: E402
from drgs_blender.reconstruct.meshing.visual_hull import find_region  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.reconstruct.optim.learner import _disagreement  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.optim.train import Training  # noqa: E402

pytest.importorskip("onnxruntime")

RADIUS = 0.8
#: Whose x points left and whose z points away from the viewer.
SIGNS = np.array([-1.0, 1.0, -1.0])


def ball(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, which is the normal in the model's axes, coverage and normal (world) of a ball."""
    rays, _ = rays_of(camera, 1)
    eye = camera.matrix_world[:3, 3]
    along = -(rays @ eye)
    inside = RADIUS**2 - (eye @ eye - along**2)
    normal = (eye + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays) / RADIUS
    colour = (SIGNS * (normal @ camera.matrix_world[:3, :3]) + 1) / 2
    hit = inside > 0
    return np.where(hit[..., None], colour, 0).astype(np.float32), hit.astype(np.float32), normal


@pytest.fixture
def capture() -> Capture:
    return photographed(ball, 12, 64, 6)


@pytest.fixture
def copies(tmp_path: Path) -> Path:
    """A model that gives the picture that it gets."""
    return write_model(tmp_path / "omnidata-copy.onnx", side=64, outputs=3)


def silent(*_: object) -> None:
    pass


def no() -> bool:
    return False


@pytest.mark.parametrize("channels", [3, 4])
def test_normals_are_turned_to_the_world_whatever_the_axes_of_the_model(
    capture: Capture, tmp_path: Path, channels: int
) -> None:
    """A fourth channel is a confidence, as some have it."""
    copies = write_model(tmp_path / "omnidata.onnx", side=64, outputs=channels)
    give_normals(capture, str(copies), silent, no)
    for view in capture.training:
        _, alpha, true = ball(view.camera)
        assert view.normals is not None and not view.normals[alpha < 0.5].any()
        cosine = (view.normals * true).sum(-1)[alpha > 0.5]
        assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 2 and cosine.mean() > 0.98
    assert all(view.normals is None for view in capture.testing)


def test_what_are_no_normals_is_not_used(capture: Capture, copies: Path, caplog: pytest.LogCaptureFixture) -> None:
    noise = np.random.default_rng(0)
    for view in capture.views:
        view.colour = noise.random(view.colour.shape, np.float32)
    give_normals(capture, str(copies), silent, no)
    assert "no better than normals that all face" in caplog.text
    assert all(view.normals is None for view in capture.views)
    caplog.clear()
    for view in capture.views:  # the model's axes: away from the viewer
        view.colour = np.broadcast_to(np.float32([0.5, 0.5, 0.0]), view.colour.shape)
    give_normals(capture, str(copies), silent, no)
    assert "no better than normals that all face" in caplog.text and capture.training[0].normals is None


def test_without_masks_axes_are_not_guessed(capture: Capture, copies: Path, caplog: pytest.LogCaptureFixture) -> None:
    bare = replace(capture, views=[replace(view, mask=None) for view in capture.views], background=None)
    give_normals(bare, str(copies), silent, no)
    assert "has no masks" in caplog.text and bare.views[1].normals is None


def test_a_file_that_is_no_such_model_is_named(tmp_path: Path, capture: Capture) -> None:
    with pytest.raises(UsageError, match="no such file"):
        NormalModel(str(tmp_path / "gone.onnx"))
    one = write_model(tmp_path / "one.onnx", side=64)
    with pytest.raises(AssetError, match=r"one.onnx.*shape \(1, 1, 64, 64\)"):
        NormalModel(str(one))
    with pytest.raises(Cancelled):
        give_normals(capture, str(write_model(tmp_path / "omnidata.onnx", 64, outputs=3)), silent, lambda: True)


def test_the_command_line_says_it_before_anything_is_read(
    tmp_path: Path, capture: Capture, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "set").mkdir()
    write(capture, tmp_path / "set")
    words = ["reconstruct", str(tmp_path / "set"), "--out", str(tmp_path / "a.drgs"), "--normals", "gone.onnx"]
    assert main(words) == 64
    assert "normals: is 'gone.onnx': no such file" in capsys.readouterr().err


def test_a_surfel_turns_to_the_normals_given() -> None:
    """One disc before a camera that looks down, told that it faces 30 degrees away from it."""
    view = Camera(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]], float), 32, 32, 64, 64, 16, 16)
    disc = Gaussians.on_surface(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.full((1, 3), 0.5), 0.2)
    wanted = np.array([0.5, 0, 0.75**0.5])
    normals = torch.tensor(wanted, dtype=torch.float32).expand(32, 32, 3)
    rotation = disc.parameters["rotation"]
    for _ in range(60):
        loss = _disagreement(disc.render(view, torch.zeros(3), 0, reflections=False), normals)
        (gradient,) = torch.autograd.grad(loss, rotation)
        with torch.no_grad():
            rotation -= 0.02 * gradient / gradient.norm()
    assert disc.frames()[2][0] @ wanted > np.cos(np.radians(3))  # a step turns by 2


def learned(capture: Capture, **changes: float) -> np.ndarray:
    """Rotations of surfels after a few steps."""
    schedule = Schedule(iterations=40, surfels=600, coarse=0.5, shape=1.0, rounds=0, reflections=1.0, **changes)
    training = Training(capture, find_region(capture), schedule)
    while not training.finished:
        training.step()
    return training.gaussians.arrays()["rotation"]


def test_they_count_as_long_and_as_much_as_the_schedule_says(capture: Capture, copies: Path) -> None:
    give_normals(capture, str(copies), silent, no)
    without = learned(replace(capture, views=[replace(view, normals=None) for view in capture.views]))
    assert np.array_equal(learned(capture, normal_prior=0.0), without)
    assert np.array_equal(learned(capture, normal_prior_until=0.0), without)
    assert not np.array_equal(learned(capture), without)
