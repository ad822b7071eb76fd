"""Measures of likeness against independent values: scikit-image, formulas of the papers, torch.nn."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.errors import AssetError
from drgs_blender.evaluate import metrics
from drgs_blender.evaluate.flip import find_flip, flip
from drgs_blender.evaluate.lpips import Lpips


def test_psnr_is_of_all_channels_at_once():
    from skimage.metrics import peak_signal_noise_ratio

    rng = np.random.default_rng(0)
    a, b = rng.random((2, 20, 30, 3))
    b[..., 0] = a[..., 0] + 0.001  # one good channel: a mean of channels' PSNRs would be far higher
    assert metrics.psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1.0))
    mask = np.zeros((20, 30), bool)
    mask[:4] = True
    assert metrics.psnr(a, b, mask) == pytest.approx(peak_signal_noise_ratio(a[:4], b[:4], data_range=1.0))
    assert metrics.psnr(a, a) == metrics.MOST_PSNR
    assert metrics.mean_psnr([a, a], [b, a]) == pytest.approx((metrics.psnr(a, b) + metrics.MOST_PSNR) / 2)


def test_pictures_that_are_no_numbers_and_no_pixels_are_not_taken_for_equal():
    """As those of an object that is nowhere near the true one; the best figure of all was theirs."""
    a, none = np.ones((2, 4, 4, 3)), np.zeros((2, 4, 4), bool)
    assert math.isnan(metrics.psnr(a * np.nan, a)) and math.isnan(metrics.psnr(a, a, none))
    assert math.isnan(metrics.mean_psnr(a, a, none)) and math.isnan(metrics.mean_psnr([a[0] * np.nan, a[0]], a))
    materials = {"albedo": a, "roughness": a[..., 0]}
    scores = metrics.material_scores(materials, materials, none)
    assert all(math.isnan(scores[name]) for name in ("albedo_psnr", "albedo_psnr_scaled", "roughness_rmse"))
    scores = metrics.relight_scores(a, a[..., 0], a, 0 * a[..., 0])
    assert math.isnan(scores["raw"]["foreground"]) and scores["raw"]["full"] == metrics.MOST_PSNR


def test_ssim_is_that_of_the_paper():
    # A direct sum over the 11 x 11 Gaussian window of Wang et al., away from the border.
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 24, 24, 3))
    x = np.arange(-5, 6)
    window = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    found = []
    for c in range(3):
        for i in range(5, 19):
            for j in range(5, 19):
                p, q = a[i - 5 : i + 6, j - 5 : j + 6, c], b[i - 5 : i + 6, j - 5 : j + 6, c]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                found.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    assert metrics.ssim(a, b) == pytest.approx(np.mean(found), abs=1e-6)
    assert metrics.ssim(a, a) == pytest.approx(1)
    assert math.isnan(metrics.ssim(a[:8], b[:8]))


#: Mean by an implementation of the paper in numpy and scipy, whose maps differed from the package's by 2e-6 at most.
FLIP = {"noise": 0.8260648, "square": 0.1337522, "upside down": 0.8651912, "dark": 0.8402813}


@pytest.mark.parametrize("case", FLIP)
def test_flip_is_that_of_the_paper(case):
    y, x = np.mgrid[:24, :32]
    reference = np.stack([x / 31, y / 23, 0.5 + 0 * x], -1).astype(np.float32)
    square = reference.copy()
    square[8:16, 10:20] = (0.9, 0.1, 0.2)
    noise = np.random.default_rng(3).random((24, 32, 3)).astype(np.float32)
    picture = {"noise": noise, "square": square, "upside down": reference[::-1], "dark": reference * 0.5}[case]
    assert flip(picture, reference) == pytest.approx(FLIP[case], abs=2e-6)
    assert flip(reference, reference) == 0


def test_flip_takes_what_is_no_display_value_as_the_nearest_and_adds_up_in_double_precision():
    black, white = np.zeros((240, 320, 3)), np.ones((240, 320, 3))
    assert flip(black - 1, white + 1) == flip(black, white) == pytest.approx(0.967379762, abs=2e-5)


def test_without_its_package_flip_is_not_computed_and_a_warning_says_what_to_install(monkeypatch, caplog):
    assert find_flip() is flip
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert find_flip() is None
    assert "flip-evaluator cannot be imported" in caplog.text and "pip install flip-evaluator" in caplog.text


def scene(coverage: float = 0.25, views: int = 3):
    """(linear, alpha, encoded reference on white, mask) of textured pictures with a square foreground."""
    rng = np.random.default_rng(2)
    size = 32
    linear = rng.uniform(0.02, 0.5, (views, size, size, 3)).astype(np.float32)
    mask = np.zeros((views, size, size), np.float32)
    mask[:, :, : int(size * coverage)] = 1
    return linear, mask, metrics.on_white(linear, mask), mask


def test_a_wrong_exposure_is_what_the_scaled_figure_forgives_and_the_raw_one_does_not():
    linear, alpha, reference, mask = scene()
    exposure = np.array([0.5, 0.8, 1.25])
    scores = metrics.relight_scores(linear * exposure, alpha, reference, mask)
    np.testing.assert_allclose(scores["scale"], 1 / exposure, rtol=1e-4)
    assert scores["scaled"]["foreground"] > 60 and scores["raw"]["foreground"] < 25
    # White pins the published fit: it can hardly undo the exposure.
    assert scores["published"] < scores["scaled"]["full"] - 25
    assert abs(scores["published"] - scores["raw"]["full"]) < 3
    assert scores["coverage"] == pytest.approx(0.25)


def test_full_frame_figures_are_higher_by_the_coverage():
    linear, alpha, reference, mask = scene(coverage=0.25)
    raw = metrics.relight_scores(linear * 0.7, alpha, reference, mask)["raw"]
    # All errors are in a quarter of the pixels.
    assert raw["full"] - raw["foreground"] == pytest.approx(-10 * math.log10(0.25), abs=1e-3)


def test_one_scale_serves_all_views_of_a_light():
    linear, alpha, reference, mask = scene(views=2)
    wrong = linear * np.array([0.5, 2.0])[:, None, None, None]
    scores = metrics.relight_scores(np.clip(wrong, 0, 1), alpha, reference, mask)
    assert scores["scaled"]["foreground"] < 25  # a scale for each view would have made it perfect


def test_clipped_highlights_do_not_move_the_scale():
    linear, alpha, _, mask = scene()
    linear[:, :8, :, :] *= 8.0
    reference = metrics.on_white(linear, alpha)
    assert (reference[mask > 0.5] > 0.999).any()
    scores = metrics.relight_scores(linear * 0.5, alpha, reference, mask)
    np.testing.assert_allclose(scores["scale"], 2.0, rtol=1e-4)


def test_a_fitted_scale_is_never_worse_than_none():
    linear, alpha, reference, mask = scene(views=1)
    noisy = linear.copy()
    noisy[:, ::3, ::2] *= 20.0  # fireflies: a fit to linear values would darken everything for them
    row = metrics.relight_scores(noisy, alpha, reference, mask)
    assert row["scaled"]["foreground"] >= row["raw"]["foreground"]
    dark = metrics.relight_scores(0 * linear, alpha, reference, mask)
    np.testing.assert_array_equal(dark["scale"], 1)


def test_normals_and_depths():
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(8, 9, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    across = np.cross(normals, rng.normal(size=3))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.radians(7.0)
    turned = np.cos(angle) * normals + np.sin(angle) * across
    mask = np.ones((8, 9), bool)
    assert metrics.normal_error(2.5 * turned, normals, mask) == pytest.approx(7.0, abs=1e-6)
    turned[:4] = 0  # where nothing was found there is no angle
    assert metrics.normal_error(turned, normals, mask) == pytest.approx(7.0, abs=1e-6)
    assert math.isnan(metrics.normal_error(0 * normals, normals, mask))
    depth = np.full((8, 9), 3.0)
    other = depth + 0.01
    other[0] += 0.99
    other[1] = 1e10
    mean, median = metrics.depth_error(other, depth, mask)
    assert (mean, median) == (pytest.approx((1.0 + 6 * 0.01) / 7), pytest.approx(0.01))


def test_materials():
    rng = np.random.default_rng(5)
    true = {"albedo": rng.uniform(0.1, 0.5, (2, 8, 8, 3)), "roughness": rng.random((2, 8, 8))}
    true["metallic"] = (rng.random((2, 8, 8)) > 0.5).astype(float)
    found = {"albedo": true["albedo"] * [0.5, 1.0, 1.5], "roughness": true["roughness"] + 0.1}
    found["metallic"] = 1 - true["metallic"]
    mask = rng.random((2, 8, 8)) > 0.3
    scores = metrics.material_scores(found, true, mask)
    np.testing.assert_allclose(scores["albedo_scale"], [2, 1, 2 / 3], rtol=1e-6)
    assert scores["albedo_psnr_scaled"] > 90 > 25 > scores["albedo_psnr"]
    assert scores["roughness_rmse"] == pytest.approx(0.1) and scores["metallic_rmse"] == pytest.approx(1)
    linear = np.linspace(0, 1, 11)
    assert np.allclose(metrics.on_white(linear[:, None], np.ones(11)), linear_to_srgb(linear)[:, None])


def networks():
    """Name -> the layers of the paper by torch's own modules, and those that are compared."""
    from torch import nn

    alexnet = nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip
    layers, before = [], 3
    for block in ((4, 4), (6, 6), (8, 8, 8), (10, 10, 10), (10, 10, 10)):  # narrower than the real one
        layers += [] if before == 3 else [nn.MaxPool2d(2, 2)]
        for channels in block:
            layers += [nn.Conv2d(before, channels, 3, padding=1), nn.ReLU()]
            before = channels
    return {"AlexNet": (alexnet, (1, 4, 7, 9, 11)), "VGG": (nn.Sequential(*layers), (3, 8, 15, 22, 29))}


@pytest.mark.parametrize(("name", "least"), [("AlexNet", 31), ("VGG", 16)])
def test_lpips_with_given_weights(tmp_path, name, least):
    torch = pytest.importorskip("torch")
    from torch import nn

    torch.manual_seed(0)
    network, compared = networks()[name]
    channels = (64, 192, 384, 256, 256) if name == "AlexNet" else (4, 6, 8, 10, 10)
    heads = [torch.rand(1, c, 1, 1) for c in channels]
    torch.save({f"features.{k}": v for k, v in network.state_dict().items()}, tmp_path / "network.pth")
    torch.save({f"lin{k}.model.1.weight": h for k, h in enumerate(heads)}, tmp_path / "heads.pth")
    a, b = np.random.default_rng(6).random((2, 64, 64, 3)).astype(np.float32)
    wanted = 0.0
    with torch.no_grad():
        x, y = (
            (torch.tensor(p).permute(2, 0, 1)[None] * 2 - 1 - torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
            / torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
            for p in (a, b)
        )
        head = iter(heads)
        for k, layer in enumerate(network):
            x, y = layer(x), layer(y)
            if k in compared:
                assert isinstance(layer, nn.ReLU)
                difference = nn.functional.normalize(x, dim=1) - nn.functional.normalize(y, dim=1)
                wanted += float((difference**2 * next(head)).sum(dim=1).mean())
    lpips = Lpips(tmp_path / "network.pth", tmp_path / "heads.pth")
    assert lpips.network == name
    assert lpips(a, b) == pytest.approx(wanted, rel=1e-4) and wanted > 0.01
    assert lpips(a, a) == 0
    assert lpips(a[:least], b[:least]) > 0  # with fewer pixels nothing is left for the last layers
    assert np.isnan(lpips(a[:, : least - 1], b[:, : least - 1]))
    with pytest.raises(AssetError, match="AlexNet"):
        Lpips(tmp_path / "heads.pth", tmp_path / "network.pth")
    torch.save({f"lin{k}.model.1.weight": torch.rand(1, 7, 1, 1) for k in range(5)}, tmp_path / "others.pth")
    with pytest.raises(AssetError, match=rf"others\.pth: has the heads of another network than {name}"):
        Lpips(tmp_path / "network.pth", tmp_path / "others.pth")
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    with pytest.raises(AssetError, match=r"bad\.pth"):
        Lpips(tmp_path / "bad.pth", tmp_path / "heads.pth")
