"""Light baked on vertices and texels: what the renderer sees there, where the UV map says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_cli_convert_frame import FACES, SQUARE, frame_of, plate

from drgs_blender.build.bake import MARGIN, picture, texel_points
from drgs_blender.cli.main import main
from drgs_blender.core.frame import ObjectState, World
from drgs_blender.formats.exr import read_exr
from drgs_blender.ipc.frame_file import write_frame_file
from drgs_blender.render.scene.trace_scene import TraceObject

#: The square in the left half of the image.
UVS = (np.array([[0, 0], [0.5, 0], [0.5, 1], [0, 1]], np.float32))[FACES]


def trace_object() -> TraceObject:
    albedo = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], np.float32)
    return TraceObject("plate", SQUARE, FACES, albedo, np.ones(4), np.zeros(4))


def test_texels_lie_where_the_uv_map_puts_them() -> None:
    """Row 0 is v = 1; every texel's centre is on the surface, with the vertices' values between them."""
    points, texel = texel_points(trace_object(), UVS, 32)
    rows, columns = np.divmod(texel, 32)
    assert len(texel) == 16 * 32 and columns.max() == 15
    u, v = (columns + 0.5) / 16, 1 - (rows + 0.5) / 32
    np.testing.assert_allclose(points.origin, np.stack([2 * u - 1, 2 * v - 1, 0 * u], 1), atol=1e-6)
    np.testing.assert_allclose(points.albedo[:, :2], np.stack([u, v], 1), atol=1e-6)
    np.testing.assert_allclose(points.normal, np.tile([0, 0, 1], (len(texel), 1)), atol=1e-6)
    # A map that is repeated covers the same texels.
    _, again = texel_points(trace_object(), UVS + 3, 32)
    np.testing.assert_array_equal(again, texel)


def test_the_margin_goes_on_with_the_nearest_colour() -> None:
    size = 64
    pixels = picture(np.float32([[1, 2, 3]]), np.array([32 * size + 20]), size)
    assert (pixels[32, 20:37] == [1, 2, 3, 1]).all() and not pixels[32, 20 + MARGIN + 1].any()


@pytest.mark.parametrize("mirrored", [False, True])
def test_an_object_is_baked_as_it_is_lit(tmp_path: Path, mirrored: bool) -> None:
    """A rough plate under a white sky sends its albedo from every vertex and texel, whichever way it stands."""
    matrix = np.diag([-1.0 if mirrored else 1.0, 1, 1, 1])
    state = ObjectState("Plate", str(plate(tmp_path / "p.drgs")), matrix)
    state.albedo = np.float32([[0.2] * 3, [0.2] * 3, [0.6] * 3, [0.6] * 3])
    for number in (1, 2):
        world = World(colour=(number, number, number))
        write_frame_file(tmp_path / f"f_{number:04}.drgsframe", frame_of([state], world=world))
    np.save(tmp_path / "uvs.npy", UVS)
    arguments = ["bake", str(tmp_path / "f_####.drgsframe"), "--frames", "1-2", "--light", "diffuse", "--size", "32"]
    arguments += ["--object", "Plate", str(tmp_path / "v_####.npy")]
    arguments += ["--object", "Plate", str(tmp_path / "t_####.exr"), str(tmp_path / "uvs.npy")]
    assert main([*arguments, "--samples", "64"]) == 0
    first, second = (np.load(tmp_path / f"v_{n:04}.npy") for n in (1, 2))
    np.testing.assert_allclose(first[:, 0], [0.2, 0.2, 0.6, 0.6], rtol=0.03)
    np.testing.assert_allclose(second, 2 * first, rtol=0.03)
    image = read_exr(tmp_path / "t_0001.exr")[0]
    rows = image[:, 2:14, 0].mean(axis=1)
    np.testing.assert_allclose(rows, 0.6 - 0.4 * (np.arange(32) + 0.5) / 32, rtol=0.05)


def test_what_cannot_be_baked_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = ObjectState("Plate", str(plate(tmp_path / "p.drgs")))
    path = tmp_path / "f.drgsframe"
    write_frame_file(path, frame_of([state]))
    np.save(tmp_path / "uvs.npy", np.zeros((5, 3, 2), np.float32))
    np.save(tmp_path / "flat.npy", np.zeros((2, 3, 2), np.float32))
    cases = {
        ("Nobody", "a.npy"): "which has Plate",
        ("Plate", "a.txt"): "does not end in",
        ("Plate", "a.exr", "uvs.npy"): "has shape",
        ("Plate", "a.exr", "flat.npy"): "covers no texel",
        ("Plate", "a.exr", "none.npy"): "cannot be read",
    }
    for (name, *files), problem in cases.items():
        assert main(["bake", str(path), "--object", name, *(str(tmp_path / f) for f in files)]) == 64
        assert problem in capsys.readouterr().err
