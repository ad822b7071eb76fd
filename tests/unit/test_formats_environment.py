"""Environment pictures: exact decoding, and the sky above, whatever the file's own convention."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.formats.latlong import directions, nvdiffrec_cube, sample_cube
from drgs_blender.formats.registry import read, read_environment, read_materials


def rgbe_pixels(height: int = 4, width: int = 16, flat: bool = True) -> np.ndarray:
    rng = np.random.default_rng(1)
    rgbe = rng.integers(1, 256, (height, width, 4), dtype=np.uint8)
    rgbe[..., 3] = rng.integers(120, 140, (height, width))
    if flat:
        rgbe[:, 4:9] = rgbe[:, 4:5]  # something for the runs
    rgbe[0, 0] = 0
    return rgbe


def radiance(rgbe: np.ndarray) -> np.ndarray:
    scale = np.where(rgbe[..., 3:] > 0, 2.0 ** (rgbe[..., 3:].astype(float) - 136), 0)
    return (rgbe[..., :3] * scale).astype(np.float32)


def encode_hdr(rgbe: np.ndarray, runs: str, extra: str = "", size: str = "") -> bytes:
    """A Radiance file with new runs, old runs or none."""
    height, width = rgbe.shape[:2]
    size = size or f"-Y {height} +X {width}"
    data = f"#?RADIANCE\n{extra}FORMAT=32-bit_rle_rgbe\n\n{size}\n".encode()
    for row in rgbe:
        if runs == "none":
            data += row.tobytes()
        elif runs == "old":
            x = 0
            while x < width:
                count = 1
                while x + count < width and (row[x + count] == row[x]).all():
                    count += 1
                data += row[x].tobytes()
                if count > 1:
                    data += bytes([1, 1, 1, count - 1])
                x += count
        else:
            data += bytes([2, 2, width >> 8, width & 255])
            for channel in range(4):
                values = row[:, channel]
                data += bytes([4, *values[:4], 128 + 5, values[4], width - 9, *values[9:]])
    return data


@pytest.mark.parametrize("runs", ["new", "old", "none"])
def test_hdr_decodes_exactly(tmp_path: Path, runs: str) -> None:
    rgbe = rgbe_pixels()
    (tmp_path / "a.hdr").write_bytes(encode_hdr(rgbe, runs))
    np.testing.assert_array_equal(read_environment(tmp_path / "a.hdr").radiance, radiance(rgbe))


def test_hdr_exposure_and_flipped_pictures(tmp_path: Path) -> None:
    rgbe = rgbe_pixels()
    path = tmp_path / "a.hdr"
    path.write_bytes(encode_hdr(rgbe, "none", extra="EXPOSURE=4\n"))
    np.testing.assert_array_equal(read_environment(path).radiance, radiance(rgbe) / 4)
    path.write_bytes(encode_hdr(rgbe, "none", size="+Y 4 -X 16"))
    np.testing.assert_array_equal(read_environment(path).radiance, radiance(rgbe)[::-1, ::-1])


def test_damaged_hdr_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    for runs in ("new", "old", "none"):
        data = encode_hdr(rgbe_pixels(), runs)
        for length in range(3, len(data), 7):
            path.write_bytes(data[:length])
            with pytest.raises(AssetError):
                read(path)
    path.write_bytes(encode_hdr(rgbe_pixels(), "none", size="-Y 99999 +X 99999"))
    with pytest.raises(AssetError, match="not possible"):
        read(path)
    rng = np.random.default_rng(4)
    data = encode_hdr(rgbe_pixels(), "new")
    for _ in range(200):
        mutant = bytearray(data)
        mutant[rng.integers(2, len(data))] = rng.integers(256)
        path.write_bytes(mutant)
        try:
            assert np.isfinite(read_environment(path).radiance).all()
        except AssetError as error:
            assert "a.hdr" in str(error)


def test_a_real_sky_is_bright_above(shared_data: Path) -> None:
    image = read_environment(shared_data / "env/park.hdr").radiance
    assert image.shape == (512, 1024, 3)
    assert image[:256].mean() > image[256:].mean()


def write_exr(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    import OpenEXR

    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}, channels).write(
        str(path)
    )
    return path


def test_exr_layers_luminance_and_bad_values(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    rgb = rng.random((4, 8, 3), dtype=np.float32)
    r, g, b = (np.ascontiguousarray(rgb[..., k]) for k in range(3))
    path = tmp_path / "a.exr"
    np.testing.assert_array_equal(read_environment(write_exr(path, {"R": r, "G": g, "B": b})).radiance, rgb)
    layered = {"key.R": g, "key.G": g, "key.B": g, "Combined.R": r, "Combined.G": g, "Combined.B": b}
    np.testing.assert_array_equal(read_environment(write_exr(path, layered)).radiance, rgb)
    grey = read(write_exr(path, {"Y": r}))
    np.testing.assert_array_equal(grey.environment.radiance, np.repeat(r[..., None], 3, axis=2))
    assert "luminance only: grey light" in grey.notes
    half = {"RGB": rgb.astype(np.float16)}
    np.testing.assert_array_equal(read_environment(write_exr(path, half)).radiance, rgb.astype(np.float16))
    r[0, 0], g[1, 1] = np.inf, -1.0
    bad = read(write_exr(path, {"R": r, "G": g, "B": b}))
    assert bad.environment.radiance.min() == 0 and np.isfinite(bad.environment.radiance).all()
    assert any("1 values that are NaN" in n for n in bad.notes) and any("1 negative" in n for n in bad.notes)
    with pytest.raises(AssetError, match="neither"):
        read(write_exr(path, {"Z": b}))


@pytest.mark.parametrize("lowest, told", [(-1e-4, False), (-1e-2, True)])
def test_negative_values_below_rounding_are_not_told(tmp_path: Path, lowest: float, told: bool) -> None:
    """Blender's own environments have some, -7e-7 in studio.exr."""
    pixels = np.full((4, 8, 3), 0.5, np.float32)
    pixels[1, 2, 0] = lowest
    file = read(write_exr(tmp_path / "a.exr", {"RGB": pixels}))
    assert file.environment.radiance[1, 2, 0] == 0
    assert any("1 negative values set to 0" in note for note in file.notes) == told


def test_exr_primaries_are_converted(tmp_path: Path) -> None:
    """ACEScg white stays white; its red is outside Rec.709."""
    acescg = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
    pixels = np.zeros((2, 4, 3), np.float32)
    pixels[0], pixels[1] = 1.0, [0, 0.5, 0]
    file = read(write_exr(tmp_path / "a.exr", {"RGB": pixels}, chromaticities=acescg))
    np.testing.assert_allclose(file.environment.radiance[0], 1.0, atol=1e-4)
    # published ACEScg -> Rec.709 matrix, second column
    np.testing.assert_allclose(file.environment.radiance[1, 0, 1], 0.5 * 1.1408, atol=2e-3)
    assert any("chromaticities" in n for n in file.notes)


def test_cube_and_lat_long_of_the_same_scene_agree(shared_data: Path) -> None:
    """The labelled pair of the OpenEXR project: right way up, not mirrored, not turned."""
    flat = read_environment(shared_data / "env/OrientationLatLong.exr").radiance
    file = read(shared_data / "env/OrientationCube.exr")
    assert file.notes == ["cube map resampled to lat-long"]
    cube = file.environment.radiance.reshape(512, 2, 1024, 2, 3).mean(axis=(1, 3))
    error = np.abs(cube - flat).mean()
    assert error < 0.02
    for wrong in (cube[:, ::-1], cube[::-1], *(np.roll(cube, k * 256, axis=1) for k in (1, 2, 3))):
        assert np.abs(wrong - flat).mean() > 3 * error


def test_pictures_are_decoded_from_srgb(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (4, 8, 3), dtype=np.uint8)
    Pillow.fromarray(pixels).save(tmp_path / "a.png")
    file = read(tmp_path / "a.png")
    np.testing.assert_allclose(linear_to_srgb(file.environment.radiance) * 255, pixels, atol=1e-3)
    assert "display-referred" in file.notes[0]


def test_directions_are_blenders() -> None:
    d = directions(64)
    u, v = np.meshgrid((np.arange(128) + 0.5) / 128, (np.arange(64) + 0.5) / 64)
    np.testing.assert_allclose(0.5 - np.arctan2(d[..., 1], d[..., 0]) / (2 * math.pi), u, atol=1e-12)
    np.testing.assert_allclose(np.arccos(d[..., 2]) / math.pi, v, atol=1e-12)


def test_cube_faces_of_the_nvdiffrec_family() -> None:
    """A cube painted with its own directions, by the published formula of each face, is the identity."""
    n = 64
    y, x = np.meshgrid(*(2 * ((np.arange(n) + 0.5) / n) - 1,) * 2, indexing="ij")
    one = np.ones_like(x)
    formulas = [(one, -y, -x), (-one, -y, x), (x, one, y), (x, -one, -y), (x, -y, one), (-x, -y, -one)]
    faces = np.stack([np.stack(f, axis=-1) / np.sqrt(1 + x**2 + y**2)[..., None] for f in formulas])
    look = directions(32)
    np.testing.assert_allclose(sample_cube(faces, look, nvdiffrec_cube(n)), look, atol=0.02)


def test_learned_lights(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    base = torch.randn(8, 16, 3)
    torch.save({"state_dict": {"base": base}, "activation": "exp"}, tmp_path / "a.map")
    file = read(tmp_path / "a.map")
    assert file.layout == "IRGS light"
    np.testing.assert_allclose(file.environment.radiance, np.exp(base.numpy()), rtol=1e-5)
    logits = torch.zeros(6, 16, 16, 3)
    logits[4] = 3.0  # +Z
    torch.save({"state_dict": {"base": logits}}, tmp_path / "a.map")
    file = read(tmp_path / "a.map")
    light = file.environment.radiance
    assert file.layout == "Ref-Gaussian light" and light.shape == (32, 64, 3)
    top = srgb_to_linear(np.array(1 / (1 + np.exp(-3.0))))
    np.testing.assert_allclose(light[0], top, rtol=1e-5)
    np.testing.assert_allclose(light[-1], srgb_to_linear(np.array(0.5)), rtol=1e-5)


class Evil:
    """An object whose unpickling would write a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_code_in_torch_files_is_never_run(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    torch.save({"state_dict": Evil(tmp_path / "owned")}, tmp_path / "a.map")
    with pytest.raises(AssetError, match="cannot be loaded safely"):
        read(tmp_path / "a.map")
    assert not (tmp_path / "owned").exists()
    torch.save([1, 2], tmp_path / "a.map")
    with pytest.raises(AssetError, match="no light"):
        read(tmp_path / "a.map")


def test_nero_materials_are_decoded(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {"albedo": rng.random((9, 3)), "metallic": rng.random((9, 1)), "roughness": rng.random((9, 1))}
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array.astype(np.float32))
    for source in (tmp_path, tmp_path / "albedo.npy"):
        file = read_materials(source)
        np.testing.assert_allclose(file.albedo, srgb_to_linear(arrays["albedo"]), atol=1e-6)
        np.testing.assert_allclose(file.roughness, srgb_to_linear(arrays["roughness"])[:, 0], atol=1e-6)
        np.testing.assert_allclose(file.metallic, srgb_to_linear(arrays["metallic"])[:, 0], atol=1e-6)
    np.save(tmp_path / "metallic.npy", np.zeros((8, 1), np.float32))
    with pytest.raises(AssetError, match="8 of metallic"):
        read_materials(tmp_path)
    np.save(tmp_path / "metallic.npy", np.array([Evil(tmp_path / "owned")], object), allow_pickle=True)
    with pytest.raises(AssetError, match="cannot be read"):
        read_materials(tmp_path)
    assert not (tmp_path / "owned").exists()
