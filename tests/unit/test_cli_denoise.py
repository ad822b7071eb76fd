"""``drgs denoise`` on frames that an engine rendered: the same bits however divided, cuts, faults, resuming."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere_mesh

from drgs_blender.cli import frame_store
from drgs_blender.cli.frame_lines import FrameLines
from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import Camera, Frame, MotionStep, ObjectState, Pose, RenderSettings, World
from drgs_blender.core.passes import TEMPORAL
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.render.film.frame_files import read_frame, write_frame

FRAMES = 8
#: From this frame on, another camera looks.
CUT = 6


def placed(number: float) -> np.ndarray:
    matrix = np.eye(4)
    c, s = np.cos(0.06 * number), np.sin(0.06 * number)
    matrix[:2, :2], matrix[0, 3] = [[c, -s], [s, c]], 0.02 * number
    return matrix


def seen(number: int, side: float) -> Camera:
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    matrix[:3, 3] = side + 0.02 * number, -4, 0
    return Camera(matrix, 48, 36, 60.0, 60.0, 24.0, 18.0)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory):
    """Folder of noisy frames 1 .. FRAMES of a turning object, and one of clean ones."""
    folder = tmp_path_factory.mktemp("denoise")
    vertices, faces = sphere_mesh(3)
    vertices = (vertices * (1 + 0.2 * np.cos(4 * np.arctan2(vertices[:, 1:2], vertices[:, :1])))).astype(np.float32)
    n = len(vertices)
    mesh = Mesh(vertices, faces, 0.5 + 0.4 * np.sin(5 * vertices), np.full(n, 0.6), np.zeros(n))
    surfels, binding, _ = attach(mesh, density=12.0)
    write_asset(folder / "ball.drgs", Asset(surfels, mesh, binding))
    session = Session()
    key = session.load_asset(folder / "ball.drgs")
    light = np.random.default_rng(7).uniform(0, 2, (16, 32, 3)).astype(np.float32)

    def write(name: str, samples: int, frames: range) -> None:
        (folder / name).mkdir()
        for number in frames:
            side = 0.0 if number < CUT else 0.5
            frame = Frame(
                number,
                seen(number, side),
                [ObjectState("ball", key, placed(number))],
                World(light),
                RenderSettings(3 * samples, subpixel_samples=3, film_transparent=True),
                TEMPORAL,
                previous=MotionStep(seen(number - 1, side), [Pose("ball", placed(number - 1)[None])]),
            )
            pictures = session.render(frame)
            frame_store.save(folder / name / f"{number:04d}.exr", pictures, frame, number, f"hash {number}")

    write("noisy", 1, range(1, FRAMES + 1))
    write("clean", 96, range(3, 5))
    return folder


@pytest.fixture
def denoise(rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Function that denoises and returns (exit code, lines on stdout, text on stderr)."""

    def run(frames: str, *options: str, out: str = "out", source: Path = rendered / "noisy"):
        pattern = str(tmp_path / out / "####.exr")
        code = main(["denoise", str(source / "####.exr"), "--frames", frames, "--out", pattern, *options])
        captured = capsys.readouterr()
        return code, captured.out.splitlines(), captured.err

    return run


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.slow
def test_chunks_give_the_same_files(denoise, tmp_path):
    """One run, runs of one, of three and of four, downwards, with other threads: not a byte differs."""
    code, lines, _ = denoise(f"1-{FRAMES}")
    assert code == 0 and lines[-1] == "DRGS_EXIT class=ok"
    whole = files(tmp_path / "out")
    assert len(whole) == FRAMES
    for size in (1, 3, 4):
        for first in reversed(range(1, FRAMES + 1, size)):
            chunk = f"{first}-{min(first + size - 1, FRAMES)}"
            assert denoise(chunk, "--threads", str(size % 2 + 1), out=f"by{size}")[0] == 0
        assert files(tmp_path / f"by{size}") == whole
    assert denoise(f"{FRAMES}-1x-1", "--sequence", f"1-{FRAMES}", out="down")[0] == 0
    assert files(tmp_path / "down") == whole


def test_it_says_where_frames_lie_as_whole_paths(rendered, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for said in ("Saved: '", "skipping existing frame '"):
        assert main(["denoise", str(rendered / "noisy" / "####.exr"), "--frames", "2", "--out", "here/####.exr"]) == 0
        assert f"{said}{tmp_path / 'here' / '0002.exr'}'" in capsys.readouterr().out


def test_neighbours_take_noise_away(denoise, rendered, tmp_path):
    denoise("3-4")
    denoise("3-4", "--window", "1", out="alone")

    def error(folder: Path) -> float:
        pictures = [
            [read_frame(f / f"000{n}.exr")[0]["Combined"] for n in (3, 4)] for f in (folder, rendered / "clean")
        ]
        return float(np.sqrt(np.mean((np.array(pictures[0]) - np.array(pictures[1]))[..., :3] ** 2)))

    assert error(tmp_path / "out") < 0.85 * error(tmp_path / "alone")
    assert error(tmp_path / "alone") < 0.7 * error(rendered / "noisy")


def test_one_frame_alone_is_what_the_engine_denoises_alone(denoise, rendered, tmp_path):
    """What is on disk is all that the denoiser works on."""
    from drgs_blender.render.denoise.noisy_frames import read_noisy
    from drgs_blender.render.denoise.svgf_spatial import denoise as spatial

    denoise("4", "--window", "1")
    found, metadata = read_frame(tmp_path / "out" / "0004.exr")
    noisy = read_noisy(rendered / "noisy" / "0004.exr")
    light = spatial(noisy.picture.components, noisy.picture.variance, noisy.picture.guides)
    for name, colour, part in (("DiffDir", "DiffCol", 0), ("GlossInd", "GlossCol", 3)):
        np.testing.assert_allclose(found[name] * found[colour], light[:, :, part], rtol=1e-6, atol=1e-7)
    diffuse, glossy = found["DiffDir"] + found["DiffInd"], found["GlossDir"] + found["GlossInd"]
    total = diffuse * found["DiffCol"] + glossy * found["GlossCol"] + found["Env"] + found["Emit"]
    np.testing.assert_allclose(found["Combined"][..., :3], total, rtol=2e-6, atol=1e-7)
    before = read_frame(rendered / "noisy" / "0004.exr")[0]
    assert (found["Combined"][..., 3] == before["Combined"][..., 3]).all()
    assert set(found) == set(TEMPORAL) - {"Variance", "Previous Position"} and metadata["frame"] == "4"


def test_neighbours_of_another_size_are_named(denoise, rendered, tmp_path):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for number in range(1, 4):
        shutil.copy(rendered / "noisy" / f"{number:04d}.exr", mixed)
    assert not any("size" in line for line in denoise("2", source=mixed)[1])
    pictures, metadata = read_frame(mixed / "0003.exr")
    frame_store.write_frame(mixed / "0003.exr", {k: v[:-4] for k, v in pictures.items()}, metadata)
    code, lines, _ = denoise("2", "--overwrite", source=mixed)
    assert code == 0 and any("0002.exr is of another size than its neighbours 0003.exr" in line for line in lines)


def test_frames_beyond_a_cut_take_no_part(denoise, rendered, tmp_path):
    denoise(str(CUT - 1))
    shorter = tmp_path / "shorter"
    shorter.mkdir()
    for number in range(1, CUT):
        shutil.copy(rendered / "noisy" / f"{number:04d}.exr", shorter)
    denoise(str(CUT - 1), out="short", source=shorter)
    a, b = (read_frame(tmp_path / f / f"{CUT - 1:04d}.exr")[0]["Combined"] for f in ("out", "short"))
    assert (a == b).all()
    # Where there is no cut, the frame after does.
    denoise("3", source=shorter, out="three")
    (shorter / "0004.exr").unlink()
    denoise("3", source=shorter, out="less")
    a, b = (read_frame(tmp_path / f / "0003.exr")[0]["Combined"] for f in ("three", "less"))
    assert (a != b).any()


def test_resumes_and_sees_what_changed(denoise, rendered, tmp_path):
    source = tmp_path / "copy"
    shutil.copytree(rendered / "noisy", source)
    denoise("1-4", source=source)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    _, lines, _ = denoise("1-5", source=source)
    assert sum(line.startswith("skipping existing") for line in lines) == 4
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    (tmp_path / "out" / "0002.exr").write_bytes((tmp_path / "out" / "0002.exr").read_bytes()[:-50])
    passes, metadata = read_frame(source / "0005.exr")
    write_frame(source / "0005.exr", passes, metadata | {"settings": "other"})
    _, lines, _ = denoise("1-5", source=source)
    saved = [line.removesuffix("'")[-8:-4] for line in lines if line.startswith("Saved")]
    assert saved == ["0002", "0003", "0004", "0005"]
    _, lines, _ = denoise("1-5", "--overwrite", source=source)
    assert sum(line.startswith("Saved") for line in lines) == 5


def test_frames_written_anew_meanwhile_are_not_passed_off_as_read(denoise, rendered, tmp_path, monkeypatch):
    """What is held in memory of a neighbour is of the file that the hash is of."""
    source, said = tmp_path / "copy", FrameLines.saved
    shutil.copytree(rendered / "noisy", source)

    def saved(lines: FrameLines, path: Path) -> None:
        said(lines, path)
        if Path(path).name == "0003.exr":
            passes, metadata = read_frame(source / "0004.exr")
            write_frame(source / "0004.exr", passes | {"DiffDir": 2 * passes["DiffDir"]}, metadata)

    with monkeypatch.context() as patch:
        patch.setattr(FrameLines, "saved", saved)
        assert denoise("3-4", source=source)[0] == 0
    assert denoise("4", source=source, out="fresh")[0] == 0
    assert (tmp_path / "out" / "0004.exr").read_bytes() == (tmp_path / "fresh" / "0004.exr").read_bytes()
    lines = denoise("3", source=source)[1]
    assert any(line.startswith("Saved") for line in lines)  # it is of the old one


def test_what_is_wrong_is_named(denoise, rendered, tmp_path):
    """File, what is wrong with it, and how to get a better one."""
    source = tmp_path / "bad"
    shutil.copytree(rendered / "noisy", source)
    passes, metadata = read_frame(source / "0002.exr")
    write_frame(source / "0002.exr", {k: v for k, v in passes.items() if k not in ("Variance", "Albedo")}, metadata)
    code, lines, text = denoise("3", source=source)
    assert code == 65 and lines[-1] == "DRGS_EXIT class=bad-asset" and not (tmp_path / "out" / "0003.exr").exists()
    assert "0002.exr: lacks the passes Albedo, Variance" in text and "--passes temporal" in text
    write_frame(source / "0002.exr", passes, metadata | {"denoise": "oidn"})
    assert "0002.exr: is denoised already (oidn)" in denoise("2", source=source)[2]
    write_frame(source / "0002.exr", passes, {"frame": "2"})
    assert "does not say through which camera" in denoise("2", source=source)[2]
    write_frame(source / "0002.exr", passes, metadata | {"frame": "3"})
    assert "0002.exr: is frame 3" in denoise("2", source=source)[2]
    (source / "0002.exr").write_bytes(b"nothing")
    assert denoise("1", source=source)[0] == 65
    (source / "0002.exr").unlink()
    assert denoise("1", source=source)[0] == 0
    code, _, text = denoise("1", "--sequence", "1-8", source=source, out="strict")
    assert code == 65 and "0002.exr: does not exist, but --sequence names it" in text
    assert "0002.exr: does not exist" in denoise("2", source=source)[2]
    assert denoise("1-2", "--sequence", "1", source=source)[0] == 64
    assert denoise("1", "--window", "4", source=source)[0] == 64
    assert denoise("4", "--passes", "Vector", source=source)[0] == 64
    assert denoise("1", source=tmp_path / "out")[0] == 64  # onto themselves


def test_the_same_noise_in_every_frame_is_told(denoise, rendered, tmp_path):
    source = tmp_path / "copy"
    shutil.copytree(rendered / "noisy", source)
    assert not any("same noise" in line for line in denoise("2-3", source=source)[1])
    for number in (1, 2, 3):
        path = source / f"{number:04d}.exr"
        passes, metadata = read_frame(path)
        write_frame(path, passes, metadata | {"noise": "0"})
    lines = denoise("2-3", source=source)[1]
    assert sum("same noise" in line for line in lines) == 1


def test_objects_without_light_take_no_part(rendered, tmp_path):
    """What is shown as captured covers pixels, but its colours are 0; the engine leaves it out, too."""
    from drgs_blender.render.denoise.noisy_frames import read_noisy

    passes, metadata = read_frame(rendered / "noisy" / "0003.exr")
    for name in ("DiffCol", "GlossCol", "TransCol"):
        passes[name][:, : passes[name].shape[1] // 2] = 0.0
    write_frame(tmp_path / "0003.exr", passes, metadata)
    noisy, whole = read_noisy(tmp_path / "0003.exr"), passes["Coverage"][..., 0]
    middle = whole.shape[1] // 2
    assert whole[:, :middle].any() and not noisy.picture.guides.coverage[:, :middle].any()
    np.testing.assert_array_equal(noisy.picture.guides.coverage[:, middle:], whole[:, middle:])
    np.testing.assert_array_equal(noisy.passes["Coverage"][..., 0], whole)


def test_frames_keep_the_cameras_to_the_bit(rendered):
    """The vectors that are made from a file are those of the engine."""
    from drgs_blender.render.denoise.noisy_frames import camera_metadata, read_noisy

    noisy = read_noisy(rendered / "noisy" / "0003.exr")
    assert noisy.follows(read_noisy(rendered / "noisy" / "0002.exr"))
    assert not noisy.follows(read_noisy(rendered / "noisy" / "0001.exr"))
    frame = Frame(3, replace(seen(3, 0.0), orthographic=True, region=(1, 2, 30, 20)), [])
    assert "previous" not in camera_metadata(frame) and "true" in camera_metadata(frame)["camera"]
