"""Loss of a picture against a photograph, against scikit-image and autograd."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.reconstruct.losses.photometric import Photograph, difference, structural_similarity  # noqa: E402
from drgs_blender.reconstruct.optim.adam import Adam  # noqa: E402


def window() -> torch.Tensor:
    taps = torch.exp(-0.5 * (torch.arange(-5, 6, dtype=torch.float64) / 1.5) ** 2)
    taps = taps / taps.sum()
    return torch.outer(taps, taps)


def reference_loss(picture: torch.Tensor, photograph: torch.Tensor) -> torch.Tensor:
    """0.8 L1 + 0.2 (1 - SSIM) by convolution, float64."""
    blur = lambda x: torch.nn.functional.conv2d(x.permute(2, 0, 1)[:, None], window()[None, None], padding=5)  # noqa: E731
    mx, my = blur(picture), blur(photograph)
    xx, yy, xy = blur(picture**2) - mx**2, blur(photograph**2) - my**2, blur(picture * photograph) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (xx + yy + 9e-4))
    return 0.8 * (picture - photograph).abs().mean() + 0.2 * (1 - ssim.mean())


def test_loss_and_gradient_are_those_of_a_convolution():
    rng = np.random.default_rng(0)
    photograph = rng.uniform(0, 0.9, (40, 53, 3)).astype(np.float32)  # nowhere saturated
    picture = np.clip(photograph + 0.1 * rng.normal(size=photograph.shape), 0, 1).astype(np.float32)
    mine = torch.tensor(picture, requires_grad=True)
    loss = difference(mine, Photograph.of(photograph))
    loss.backward()
    his = torch.tensor(picture, dtype=torch.float64, requires_grad=True)
    truth = reference_loss(his, torch.tensor(photograph, dtype=torch.float64))
    truth.backward()
    assert loss.item() == pytest.approx(truth.item(), rel=1e-5)
    assert (mine.grad.double() - his.grad).norm() < 1e-4 * his.grad.norm()


def test_similarity_agrees_with_scikit_image_inside():
    from skimage.metrics import structural_similarity as skimage_ssim

    rng = np.random.default_rng(1)
    a = rng.uniform(0, 1, (48, 40, 3)).astype(np.float32)
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1).astype(np.float32)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, his = skimage_ssim(a, b, channel_axis=-1, full=True, **options)
    # Pad so that our black border lies outside of what is compared.
    mine = structural_similarity(a, Photograph.of(b))
    assert mine == pytest.approx(his.mean(), abs=0.02)
    assert structural_similarity(a, Photograph.of(a)) == pytest.approx(1, abs=1e-5)


def test_adam_takes_the_steps_of_torch():
    rng = np.random.default_rng(2)
    start, pull = rng.normal(size=(1000, 3)).astype(np.float32), rng.normal(size=(1000, 3)).astype(np.float32)
    mine, his = torch.tensor(start, requires_grad=True), torch.tensor(start, requires_grad=True)
    optimiser, other = Adam({"x": mine}), torch.optim.Adam([his], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    for _ in range(20):
        for value in (mine, his):
            value.grad = None
            ((value - torch.from_numpy(pull)) ** 2).sum().backward()
        optimiser.step({"x": mine}, {"x": 0.01})
        other.step()
    assert float((mine - his).detach().abs().max()) < 1e-5


def test_adam_passes_over_gradients_that_are_not_finite():
    value = torch.ones(3, requires_grad=True)
    value.grad = torch.tensor([float("nan"), float("inf"), 1.0])
    Adam({"x": value}).step({"x": value}, {"x": 0.1})
    assert value.detach().tolist() == pytest.approx([1, 1, 0.9])


def test_what_is_not_kept_of_a_photograph_is_computed_again():
    rng = np.random.default_rng(4)
    a, b = rng.uniform(0, 1, (2, 20, 24, 3)).astype(np.float32)
    assert structural_similarity(a, Photograph.of(b)) == structural_similarity(a, Photograph.of(b, keep=False))


def test_saturated_photographs_do_not_pull_bright_pictures_down():
    white = Photograph.of(np.ones((24, 24, 3), np.float32))
    picture = torch.full((24, 24, 3), 1.7, requires_grad=True)
    loss = difference(picture, white)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-6) and not picture.grad.any()


def test_adam_forgets_what_is_new_and_keeps_what_stays():
    value = torch.ones(4, 2, requires_grad=True)
    optimiser = Adam({"x": value})
    (value * torch.arange(8.0).reshape(4, 2)).sum().backward()
    optimiser.step({"x": value}, {"x": np.array([0.1, 0.0])})
    assert torch.equal(value.detach()[:, 1], torch.ones(4))  # a rate for each column
    before = optimiser.first["x"].clone()
    optimiser.reindex(np.array([3, -1, 0]))
    assert np.array_equal(optimiser.first["x"], np.stack([before[3], np.zeros(2), before[0]]))
