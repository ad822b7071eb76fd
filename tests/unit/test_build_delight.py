"""The estimate that removes the captured light, on a corner whose albedo, light and shadows are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.build.delight import LIMITS, remove_light
from drgs_blender.build.light_estimate import estimate_light
from drgs_blender.build.relit import captured_along, relit_colours
from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Environment, Mesh, Surfels
from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.core.frame import RenderSettings, World
from drgs_blender.deform.binding import bind
from drgs_blender.formats.exr import write_exr_environment
from drgs_blender.formats.gaussian_ply import SH_C0
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import splats_of

#: Floor (+Z) and wall (facing -X, at x = 1), n x n squares each.
N = 12
FORWARD = RenderSettings(samples=896, subpixel_samples=1, bounces=1, shading_model="principled", seed=99)
FEW = RenderSettings(samples=192, subpixel_samples=1, bounces=1, shading_model="principled")


def sky() -> np.ndarray:
    """A blue sky with a bright, warm patch, over dark ground."""
    picture = np.zeros((32, 64, 3), np.float32)
    picture[:16] = (0.3, 0.4, 0.7)
    picture[4:9, 36:44] = (14.0, 11.0, 7.0)
    picture[16:] = 0.05
    return picture


def corner() -> tuple[Asset, np.ndarray]:
    """An asset without captured colours, and the true albedo of its surfels: squares of two paints."""
    line = np.linspace(-1, 1, N + 1)
    a, b = (v.ravel() for v in np.meshgrid(line, line, indexing="ij"))
    floor = np.stack([a, b, 0 * a - 1], axis=1)
    wall = np.stack([0 * a + 1, a, b], axis=1)
    row = np.arange(N)[:, None] * (N + 1) + np.arange(N)
    quad = np.stack([row, row + N + 1, row + N + 2, row + 1], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    # The wall's normal along (0, 1, 0) x (0, 0, 1) is +X: turned over, it faces the floor.
    vertices = np.concatenate([floor, wall]).astype(np.float32)
    faces = np.concatenate([faces, faces[:, ::-1] + len(floor)]).astype(np.int32)
    corners = vertices[faces]
    centre = corners.mean(axis=1)
    n = len(centre)
    on_wall = np.arange(n) >= n // 2
    half = np.sqrt(0.5)
    rotation = np.where(on_wall[:, None], [half, 0, -half, 0], [1.0, 0, 0, 0])
    cells = np.floor(centre * 2).astype(int).sum(axis=1) % 2
    albedo = np.where(cells[:, None] == 1, [0.75, 0.5, 0.3], [0.15, 0.25, 0.5])
    k = len(vertices)
    mesh = Mesh(vertices, faces, np.full((k, 3), 0.4), np.full(k, 0.5), np.zeros(k))
    surfels = Surfels(centre, np.full((n, 2), 0.06), rotation, np.full(n, 0.95), albedo, np.full(n, 0.5), np.zeros(n))
    return Asset(surfels, mesh, bind(mesh, surfels)[0], Environment(sky())), albedo


def photographed(asset: Asset, exposure: float) -> None:
    """Give the surfels the colours that a camera of this exposure sees, and forget their materials."""
    from drgs_blender.build.transfer import surfels_to_vertices

    assert asset.binding is not None and asset.environment is not None
    surfels_to_vertices(asset.mesh, asset.surfels, asset.binding)
    world = World(asset.environment.radiance)
    seen = exposure * relit_colours(asset, asset.surfels, asset.mesh.vertices, world, FORWARD)
    shown = linear_to_srgb(np.clip(seen, 0, 1))
    asset.surfels.sh = ((shown - 0.5) / SH_C0).astype(np.float32)[:, None]
    asset.surfels.albedo = srgb_to_linear(shown)
    asset.mesh.albedo = np.full_like(asset.mesh.albedo, 0.4)


@pytest.fixture(scope="module")
def capture() -> tuple[Asset, np.ndarray, np.ndarray]:
    """(asset, its true albedo, the albedo that it was read with), taken at an exposure of 0.4."""
    asset, truth = corner()
    photographed(asset, 0.4)
    return asset, truth, asset.surfels.albedo.copy()


def copied(asset: Asset) -> Asset:
    s, m = asset.surfels, asset.mesh
    surfels = Surfels(
        s.centre, s.scale, s.rotation, s.opacity, s.albedo.copy(), s.roughness.copy(), s.metallic.copy(), s.sh
    )
    mesh = Mesh(m.vertices, m.faces, m.albedo.copy(), m.roughness.copy(), m.metallic.copy())
    return Asset(surfels, mesh, asset.binding, asset.environment, {})


def test_the_light_goes_and_the_paint_stays(capture: tuple[Asset, np.ndarray, np.ndarray]) -> None:
    asset, truth, read = capture
    asset = copied(asset)
    remove_light(asset, 0.4, FEW)
    error, before = np.abs(asset.surfels.albedo - truth), np.abs(read / 0.4 - truth)
    assert np.median(error) < 0.02 and np.quantile(error, 0.9) < 0.06
    assert np.median(before) > 5 * np.median(error)
    # The shadow of the wall, or the colour of the sky, is in neither paint.
    bright = truth[:, 0] > 0.5
    for paint in (bright, ~bright):
        assert asset.surfels.albedo[paint].std(axis=0).max() < 0.25 * (read[paint] / 0.4).std(axis=0).max()
    assert asset.provenance["materials"].startswith("estimated")
    assert asset.provenance["report"]["remove_light"]["notes"]


def test_an_unknown_exposure_changes_the_brightness_alone(capture: tuple[Asset, np.ndarray, np.ndarray]) -> None:
    asset, truth, _ = capture
    asset = copied(asset)
    remove_light(asset, None, FEW)
    luminance = asset.surfels.albedo @ [0.2126, 0.7152, 0.0722]
    assert np.quantile(luminance, 0.9) == pytest.approx(0.8, abs=0.05)
    bright = truth[:, 0] > 0.5
    ratio = np.median(asset.surfels.albedo[~bright], axis=0) / np.median(asset.surfels.albedo[bright], axis=0)
    # What is clipped at white is not counted: blue of the dark paint against that of the bright one.
    np.testing.assert_allclose(ratio[1:], np.array([0.25, 0.5])[:2] / [0.5, 0.3], rtol=0.35)


def test_dark_surfels_beside_their_faces_get_an_albedo_that_is_one(
    capture: tuple[Asset, np.ndarray, np.ndarray],
) -> None:
    """Captures have surfels over the edges of their mesh; those that are dark take its albedo, continued there."""
    asset = copied(capture[0])
    assert asset.binding is not None and asset.surfels.sh is not None
    n = len(asset.surfels)
    asset.binding = replace(asset.binding, barycentric=np.tile(np.float32([3.0, -1.0, -1.0]), (n, 1)))
    sun = np.zeros((32, 64, 3), np.float32)
    sun[8:10, 31:33] = 500.0  # behind the wall, whose shadow ends on the floor
    asset.environment = Environment(sun)
    remove_light(asset, 0.4, FEW)
    assert 0 < asset.provenance["report"]["remove_light"]["too_dark"] < n
    assert asset.surfels.albedo.min() >= 0 and asset.surfels.albedo.max() <= 1


@pytest.fixture(scope="module")
def unlit(capture: tuple[Asset, np.ndarray, np.ndarray]) -> Asset:
    """The capture without its light, by an estimate of that."""
    asset = copied(capture[0])
    asset.environment = None
    remove_light(asset, None, FEW)
    return asset


def aligned(albedo: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors after the one factor that nobody can know."""
    return np.abs(albedo * (albedo * truth).sum() / (albedo**2).sum() - truth)


def test_surfels_that_no_light_reaches_are_no_estimate(
    capture: tuple[Asset, np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A capture within a closed mesh; the error says what to do."""
    monkeypatch.setattr("drgs_blender.build.light_estimate._SETTINGS", replace(FEW, samples=4))
    asset = copied(capture[0])
    box = np.array([[x, y, z] for x in (-2, 2) for y in (-2, 2) for z in (-2, 2)], np.float32)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    m, n = asset.mesh, len(asset.mesh.vertices)
    faces = np.concatenate([m.faces, quads[:, [0, 1, 2]] + n, quads[:, [0, 2, 3]] + n])
    vertices, k = np.concatenate([m.vertices, box]), n + len(box)
    asset.mesh = Mesh(vertices, faces, np.full((k, 3), 0.4), np.full(k, 0.5), np.zeros(k))
    asset.environment = None
    with pytest.raises(AssetError, match=r"0 surfels that are .* reached by light from outside.*--env"):
        remove_light(asset)


def test_the_estimate_is_the_same_each_time(
    capture: tuple[Asset, np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drgs_blender.build.light_estimate._SETTINGS", replace(FEW, samples=4))
    monkeypatch.setattr("drgs_blender.build.light_estimate._ROUNDS", np.array([1.0]))
    one, two = (estimate_light(capture[0]).radiance for _ in range(2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.slow
def test_an_unknown_light_goes_too(capture: tuple[Asset, np.ndarray, np.ndarray], unlit: Asset) -> None:
    _, truth, read = capture
    error, before = aligned(unlit.surfels.albedo, truth), aligned(read, truth)
    assert error.mean() < 0.6 * before.mean()
    bright = truth[:, 0] > 0.5
    for paint in (bright, ~bright):  # the shadow of the wall is in neither paint
        spread, lit = (
            values[paint].std(axis=0) / values[paint].mean(axis=0) for values in (unlit.surfels.albedo, read)
        )
        assert spread.mean() < 0.6 * lit.mean()
    luminance = unlit.surfels.albedo @ [0.2126, 0.7152, 0.0722]
    assert np.quantile(luminance, 0.9) == pytest.approx(0.5, abs=0.05)
    notes = unlit.provenance["report"]["remove_light"]["notes"]
    assert set(LIMITS) < set(notes) and "an estimated environment" in notes[0]


@pytest.mark.slow
def test_the_estimate_is_brightest_where_the_light_was(unlit: Asset) -> None:
    assert unlit.environment is not None
    found = unlit.environment.radiance.sum(axis=2)
    true = sky().sum(axis=2)
    patch = true > 5
    assert found[patch].mean() > 3 * found[~patch].mean()
    warm = unlit.environment.radiance[patch].mean(axis=0)
    cold = unlit.environment.radiance[:16][~patch[:16]].mean(axis=0)
    assert warm[0] / warm[2] > cold[0] / cold[2]


@pytest.mark.slow
def test_the_estimate_gives_the_captured_colours_back(
    capture: tuple[Asset, np.ndarray, np.ndarray], unlit: Asset
) -> None:
    """Its light on its albedo, without an exposure."""
    assert unlit.environment is not None
    world = World(unlit.environment.radiance)
    again = relit_colours(unlit, unlit.surfels, unlit.mesh.vertices, world, FORWARD)
    seen = capture[2]
    assert np.median(np.abs(again - seen)) < 0.05 * np.median(seen)


def test_captured_colour_is_that_seen_from_the_direction() -> None:
    """Harmonics of 3DGS are evaluated along the ray from the camera: the first band of a splat seen from +Z."""
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 2] = 0.5
    surfels = Surfels(np.zeros((1, 3)), np.ones((1, 2)), [[1, 0, 0, 0]], [1], [[0, 0, 0]], [0.5], [0], sh)
    seen = captured_along(surfels, np.array([[0.0, 0, 1]]))
    np.testing.assert_allclose(seen, srgb_to_linear(np.full((1, 3), 0.5 - 0.5 * 0.4886025)), rtol=1e-5)


def test_what_is_lacking_is_said(capture: tuple[Asset, np.ndarray, np.ndarray]) -> None:
    asset = copied(capture[0])
    dark = Asset(asset.surfels, asset.mesh, asset.binding, Environment(np.zeros((4, 8, 3))), {})
    with pytest.raises(UsageError, match="does not reach"):
        remove_light(dark, 1.0, FEW)
    known = Asset(asset.surfels, asset.mesh, asset.binding, asset.environment, {"materials": "of the surfels"})
    with pytest.raises(UsageError, match="these are of the surfels"):
        remove_light(known)
    black = copied(asset)
    black.surfels.sh = np.full_like(asset.surfels.sh, -0.5 / SH_C0)
    black.environment = None
    black.provenance["surfels"] = "night.ply"
    with pytest.raises(AssetError, match=r"night\.ply.*0 surfels that are neither black nor clipped.*--env"):
        remove_light(black)
    with pytest.raises(UsageError, match="needs a mesh"):
        remove_light(Asset(asset.surfels, Mesh.empty()))


def test_the_command_removes_the_light(
    capture: tuple[Asset, np.ndarray, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asset, truth, _ = capture
    write_splat_ply(tmp_path / "s.ply", splats_of(asset.surfels))
    write_exr_environment(tmp_path / "sky.exr", Environment(sky()))
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in asset.mesh.vertices)
    obj += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in asset.mesh.faces)
    (tmp_path / "m.obj").write_text(obj)
    files = ["import", str(tmp_path / "s.ply"), "--mesh", str(tmp_path / "m.obj"), "--up", "z"]
    out = tmp_path / "a.drgs"
    assert main([*files, "--out", str(out), "--exposure", "1"]) == 64
    light = ["--env", str(tmp_path / "sky.exr"), "--remove-light", "--exposure", "0.4"]
    assert main([*files, *light, "--out", str(out)]) == 0
    found = read_asset(out)
    assert np.median(np.abs(found.surfels.albedo - truth)) < 0.03
    assert found.provenance["materials"].startswith("estimated")
    assert "--remove-light" not in capsys.readouterr().out  # it is done
    assert main([*files, "--out", str(out)]) == 0
    assert "albedo is the captured colour, with the light of the capture in it" in capsys.readouterr().out
