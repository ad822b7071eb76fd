"""Gaussian splats of every trainer: the right layout, the right activation, the right axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.asset import Surfels
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.formats.axes import UP_AXES, surfels_to_z_up
from drgs_blender.formats.gaussian_ply import SH_C0
from drgs_blender.formats.gltf_nodes import rotation_matrix
from drgs_blender.formats.registry import find_format, read_surfels

XYZ = ["x", "y", "z"]
NORMAL = ["nx", "ny", "nz"]
DC = [f"f_dc_{i}" for i in range(3)]
REST = [f"f_rest_{i}" for i in range(45)]
ROT = [f"rot_{i}" for i in range(4)]
BASE = [f"base_color_{i}" for i in range(3)]


def scales(n: int) -> list[str]:
    return [f"scale_{i}" for i in range(n)]


LAYOUTS: dict[str, list[str]] = {
    "3DGS": [*XYZ, *NORMAL, *DC, *REST, "opacity", *scales(3), *ROT],
    "2DGS": [*XYZ, *NORMAL, *DC, *REST, "opacity", *scales(2), *ROT],
    "Ref-Gaussian": [
        *XYZ, *NORMAL, "nx2", "ny2", "nz2", *DC, *REST, "ind_dc_0", "ind_dc_1", "ind_dc_2",
        *(f"ind_asg_{i}" for i in range(160)), "opacity", "refl_strength", "metalness", "roughness",
        *(f"ori_color_{i}" for i in range(3)), *(f"diffuse_color_{i}" for i in range(3)), *scales(2), *ROT,
    ],
    "Ref-Gaussian in IRGS": [
        *XYZ, *DC, *REST, "ind_dc_0", "ind_dc_1", "ind_dc_2", "opacity", "metallic", "roughness", *BASE, *scales(2),
        *ROT,
    ],
    "IRGS": [*XYZ, *DC, *REST, "opacity", "metallic", "roughness", *BASE, *scales(2), *ROT],
    "Relightable 3D Gaussian": [
        *XYZ, *NORMAL, *DC, *REST, "opacity", *scales(3), *ROT, *BASE, "roughness", "incidents_dc_0", "visibility_dc_0"
    ],
    "GS-ROR2": [
        *XYZ, *NORMAL, "nx2", *DC, *REST, "opacity", *scales(3), *ROT, "roughness",
        *(f"{n}{i}" for n in ("specular", "albedo", "diffuse") for i in range(3)), "metallic",
    ],
    "GaussianMesh": [
        *XYZ, *NORMAL, "ca", "cb", "cc", *(f"v{k}{a}" for k in (1, 2, 3) for a in "xyz"), "dis",
        "v_index1", "v_index2", "v_index3", "radius", "face_id", *DC, *REST, "opacity", *scales(3), *ROT,
    ],
}  # fmt: skip


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """A binary PLY file of float columns."""
    names = list(columns)
    table = np.stack([np.asarray(columns[n], "<f4") for n in names], axis=1)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [*(f"property float {n}" for n in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.tobytes())
    return path


def random_columns(layout: str, n: int = 50) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {name: rng.normal(size=n).astype(np.float32) for name in LAYOUTS[layout]}


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.asarray(x, np.float64)))


def frames(surfels: Surfels) -> np.ndarray:
    return np.stack([rotation_matrix(*q) for q in surfels.rotation.astype(np.float64)])


def columns_of(columns: dict[str, np.ndarray], names: list[str]) -> np.ndarray:
    return np.stack([columns[n] for n in names], axis=1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_is_recognised_and_valid(tmp_path: Path, layout: str) -> None:
    file = read_surfels(write(tmp_path / "a.ply", random_columns(layout)))
    s = file.surfels
    assert file.layout == layout and file.unknown == [] and len(s) == 50
    for values in (s.opacity, s.albedo, s.roughness, s.metallic):
        assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(s.rotation, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(s.opacity, sigmoid(random_columns(layout)["opacity"]), atol=1e-6)


def test_materials_follow_each_trainers_activation(tmp_path: Path) -> None:
    def load(layout: str) -> tuple[Surfels, dict[str, np.ndarray]]:
        columns = random_columns(layout)
        return read_surfels(write(tmp_path / "a.ply", columns)).surfels, columns

    s, c = load("IRGS")
    np.testing.assert_allclose(s.albedo, 0.77 * sigmoid(columns_of(c, BASE)) + 0.03, atol=1e-6)
    np.testing.assert_allclose(s.roughness, sigmoid(c["roughness"]), atol=1e-6)
    assert (s.metallic == 0).all()
    s, c = load("Relightable 3D Gaussian")
    np.testing.assert_allclose(s.albedo, 0.77 * sigmoid(columns_of(c, BASE)) + 0.03, atol=1e-6)
    np.testing.assert_allclose(s.roughness, 0.9 * sigmoid(c["roughness"]) + 0.09, atol=1e-6)
    s, c = load("Ref-Gaussian")
    encoded = sigmoid(columns_of(c, [f"ori_color_{i}" for i in range(3)]))
    np.testing.assert_allclose(linear_to_srgb(s.albedo), encoded, atol=1e-5)
    np.testing.assert_allclose(s.metallic, sigmoid(c["refl_strength"]), atol=1e-6)
    assert s.extras["ind_asg"].shape == (50, 160)
    np.testing.assert_array_equal(s.extras["ind_asg"][:, 17], c["ind_asg_17"])
    s, c = load("Ref-Gaussian in IRGS")
    np.testing.assert_allclose(s.albedo, sigmoid(columns_of(c, BASE)), atol=1e-6)
    np.testing.assert_allclose(s.metallic, sigmoid(c["metallic"]), atol=1e-6)
    s, c = load("GS-ROR2")
    np.testing.assert_allclose(s.albedo, sigmoid(columns_of(c, ["albedo0", "albedo1", "albedo2"])), atol=1e-6)
    s, c = load("3DGS")
    captured = np.clip(0.5 + SH_C0 * columns_of(c, DC), 0, 1)
    np.testing.assert_allclose(s.albedo, srgb_to_linear(captured), atol=1e-6)
    assert (s.roughness == 0.5).all() and (s.metallic == 0).all()


def test_harmonics_are_channel_major_in_the_file(tmp_path: Path) -> None:
    columns = random_columns("2DGS")
    sh = read_surfels(write(tmp_path / "a.ply", columns)).surfels.sh
    assert sh.shape == (50, 16, 3)
    for channel in range(3):
        np.testing.assert_array_equal(sh[:, 0, channel], columns[f"f_dc_{channel}"])
        for k in range(15):
            np.testing.assert_array_equal(sh[:, 1 + k, channel], columns[f"f_rest_{15 * channel + k}"])


def test_surfels_keep_their_frame(tmp_path: Path) -> None:
    columns = random_columns("2DGS")
    s = read_surfels(write(tmp_path / "a.ply", columns)).surfels
    np.testing.assert_allclose(s.scale, np.exp(columns_of(columns, scales(2))), rtol=1e-6)
    q = columns_of(columns, ROT)
    np.testing.assert_allclose(s.rotation, q / np.linalg.norm(q, axis=1, keepdims=True), atol=1e-6)


def test_flattening_drops_exactly_the_shortest_axis(tmp_path: Path) -> None:
    """Covariance of the surfel = covariance of the Gaussian less its shortest axis; the frame is right-handed."""
    columns = random_columns("3DGS")
    file = read_surfels(write(tmp_path / "a.ply", columns))
    axes = np.exp(columns_of(columns, scales(3)).astype(np.float64))
    full = np.stack([rotation_matrix(*q) for q in columns_of(columns, ROT).astype(np.float64)])
    shortest = axes.argmin(axis=1)
    kept = axes.copy()
    kept[np.arange(50), shortest] = 0
    expected = np.einsum("nik,nk,njk->nij", full, kept**2, full)
    r = frames(file.surfels)
    flat = np.concatenate([file.surfels.scale.astype(np.float64), np.zeros((50, 1))], axis=1)
    np.testing.assert_allclose(np.einsum("nik,nk,njk->nij", r, flat**2, r), expected, rtol=1e-4, atol=1e-5)
    normal = full[np.arange(50), :, shortest]
    np.testing.assert_allclose(r[:, :, 2], normal, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(r), 1, atol=1e-6)
    ratio = np.sort(axes, axis=1)
    assert f"{int((ratio[:, 0] > 0.3 * ratio[:, 1]).sum())} of 50 were far from flat" in " ".join(file.notes)


def test_sugar_is_noticed(tmp_path: Path) -> None:
    columns = random_columns("3DGS")
    columns["scale_0"] = np.full(50, -12, np.float32)
    file = read_surfels(write(tmp_path / "a.ply", columns))
    first_column = np.stack([rotation_matrix(*q) for q in columns_of(columns, ROT)])[:, :, 0]
    np.testing.assert_allclose(frames(file.surfels)[:, :, 2], first_column, atol=1e-5)
    assert any("SuGaR" in note for note in file.notes)


def test_gaussian_mesh_positions_come_from_the_face(tmp_path: Path) -> None:
    columns = random_columns("GaussianMesh")
    s = read_surfels(write(tmp_path / "a.ply", columns)).surfels
    a, b, c = (columns_of(columns, [f"v{k}{axis}" for axis in "xyz"]).astype(np.float64) for k in (1, 2, 3))
    logits = np.exp(columns_of(columns, ["ca", "cb", "cc"]).astype(np.float64))
    w = logits / logits.sum(axis=1, keepdims=True)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = 4 * columns["radius"] * (sigmoid(columns["dis"]) - 0.5)
    np.testing.assert_allclose(
        s.centre, w[:, :1] * a + w[:, 1:2] * b + w[:, 2:] * c + height[:, None] * normal, atol=1e-5
    )
    np.testing.assert_allclose(s.extras["barycentric"], w, atol=1e-6)
    np.testing.assert_array_equal(s.extras["face_id"], columns["face_id"])


def test_bad_splats_are_dropped_and_counted(tmp_path: Path) -> None:
    columns = random_columns("2DGS")
    columns["x"][0] = np.nan
    columns["scale_1"][1] = 200.0  # exp overflows
    for name in ROT:
        columns[name][2] = 0.0
    columns["f_rest_7"][3] = np.inf
    columns["confidence"] = np.full(50, np.nan, np.float32)
    columns["score_0"], columns["score_1"] = columns["y"].copy(), columns["z"].copy()
    file = read_surfels(write(tmp_path / "a.ply", columns))
    assert len(file.surfels) == 46
    assert "4 of 50 splats dropped: NaN or infinite values" in file.notes
    assert file.unknown == ["confidence", "score_0", "score_1"]
    assert (file.surfels.extras["confidence"] == 0).all()
    np.testing.assert_array_equal(file.surfels.extras["score"][:, 1], columns["z"][4:])
    np.testing.assert_array_equal(file.surfels.centre[:, 1], columns["y"][4:])


def test_splats_absurdly_far_are_dropped_and_counted(tmp_path: Path) -> None:
    columns = random_columns("2DGS")
    columns["z"][4], columns["y"][7] = 1e20, -3e15
    file = read_surfels(write(tmp_path / "a.ply", columns))
    assert len(file.surfels) == 48 and np.abs(file.surfels.centre).max() < 10
    assert "2 of 50 splats dropped: NaN or infinite values, or centres beyond 1e+15" in file.notes


@pytest.mark.parametrize("missing", ["opacity", "scale_0", "rot_0"])
def test_splats_without_one_property_are_no_mesh(tmp_path: Path, missing: str) -> None:
    columns = random_columns("2DGS")
    del columns[missing]
    with pytest.raises(AssetError, match=f"lacks {missing}"):
        read_surfels(write(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("missing", ["x", "rot_3", "f_dc_1", "roughness", "base_color_1", "f_rest_4"])
def test_what_is_missing_is_named(tmp_path: Path, missing: str) -> None:
    columns = random_columns("IRGS")
    del columns[missing]
    if missing == "f_dc_1":  # without it only the trained colour is left, which is enough
        assert read_surfels(write(tmp_path / "a.ply", columns)).surfels.sh is None
        return
    with pytest.raises(AssetError, match="f_rest" if missing == "f_rest_4" else missing):
        read_surfels(write(tmp_path / "a.ply", columns))


def test_no_splats_is_a_valid_file(tmp_path: Path) -> None:
    for layout in LAYOUTS:
        assert len(read_surfels(write(tmp_path / "a.ply", random_columns(layout, 0))).surfels) == 0


@pytest.mark.parametrize("up", UP_AXES)
def test_turning_up_commutes_with_the_frame(tmp_path: Path, up: str) -> None:
    s = read_surfels(write(tmp_path / "a.ply", random_columns("2DGS"))).surfels
    turned, turn = surfels_to_z_up(s, up), UP_AXES[up]
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
    np.testing.assert_array_equal(turn @ axis, [0, 0, 1])
    assert np.linalg.det(turn) == 1
    np.testing.assert_allclose(turned.centre, s.centre @ turn.T, atol=1e-6)
    np.testing.assert_allclose(frames(turned), turn @ frames(s), atol=1e-5)


def test_a_real_capture_with_two_scales_is_the_flattened_one_with_three(shared_data: Path) -> None:
    """The 2DGS file was made from the 3DGS file by other code: both readers must agree."""
    three = read_surfels(shared_data / "splats/playbot_lod3.ply").surfels
    two = read_surfels(shared_data / "splats/playbot_lod3_2scale_sh2.ply").surfels
    np.testing.assert_array_equal(three.centre, two.centre)
    np.testing.assert_array_equal(three.sh, two.sh)
    np.testing.assert_allclose(np.sort(three.scale, axis=1), np.sort(two.scale, axis=1), rtol=1e-5)
    alignment = np.abs(np.einsum("ni,ni->n", frames(three)[:, :, 2], frames(two)[:, :, 2]))
    assert np.quantile(alignment, 0.001) > 0.9999


def test_packed_files(shared_data: Path, tmp_path: Path) -> None:
    biker = read_surfels(shared_data / "splats/biker.compressed.ply")
    assert biker.layout == "compressed PLY" and len(biker.surfels) == 152746
    np.testing.assert_allclose(np.linalg.norm(biker.surfels.rotation, axis=1), 1, atol=1e-5)
    file = read_surfels(shared_data / "splats/fixtures/minimal.splat")
    assert file.layout == "splat" and len(file.surfels) > 0
    table = np.zeros(3, [("p", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    table["p"], table["s"], table["c"] = [1, 2, 3], [0.2, 0.01, 0.3], [255, 0, 128, 255]
    table["q"] = [[255, 128, 128, 128]] * 3
    path = tmp_path / "a.splat"
    path.write_bytes(table.tobytes())
    s = read_surfels(path).surfels
    np.testing.assert_allclose(s.scale[0], [0.3, 0.2], rtol=1e-5)  # the frame turns cyclically: Z, X, then Y
    np.testing.assert_allclose(frames(s)[0][:, 2], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(linear_to_srgb(s.albedo[0]), [1, 0, 128 / 255], atol=1e-5)
    path.write_bytes(table.tobytes()[:-1])
    with pytest.raises(AssetError):
        read_surfels(path)


def test_compressed_ply_bit_fields(tmp_path: Path) -> None:
    """One splat packed by hand: every field at a value whose decoding is exact."""
    bounds = [f"{e}_{n}" for e in ("min", "max") for n in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    low, high = [0, 0, 0, -4, -4, -4], [2, 4, 8, 0, 0, 0]
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {b}" for b in bounds)]
    packed = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    header += ["element vertex 1", *(f"property uint {p}" for p in packed), "end_header", ""]
    position = 2047 << 21 | 0 << 11 | 2047
    # w is the largest; 1023 decodes to (1 - .5) sqrt 2 = .7071 for x, 511.5 would be 0: 511 and 512 straddle it
    rotation = 0 << 30 | 1023 << 20 | 511 << 10 | 512
    scale = 2047 << 21 | 0 << 11 | 2047
    colour = 255 << 24 | 0 << 16 | 0 << 8 | 255
    data = np.array([*low, *high], "<f4").tobytes() + np.array([position, rotation, scale, colour], "<u4").tobytes()
    path = tmp_path / "a.ply"
    path.write_bytes("\n".join(header).encode() + data)
    assert find_format(path).name == "compressed PLY"
    s = read_surfels(path).surfels
    np.testing.assert_allclose(s.centre[0], [2, 0, 8], atol=1e-6)
    np.testing.assert_allclose(s.scale[0], [1, 1], atol=1e-6)
    # x rotation by 90 degrees carries Y, the shortest, onto Z
    np.testing.assert_allclose(frames(s)[0][:, 2], [0, 0, 1], atol=3e-3)
    np.testing.assert_allclose(s.albedo[0], [1, 0, 0], atol=1e-5)
