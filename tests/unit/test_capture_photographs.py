"""`drgs capture` of photographs that our own renderer takes: features, matches, structure from motion, the world."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from drgs_blender.capture.world_alignment import similarity
from drgs_blender.cli.main import main
from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.frame import Camera, Frame, MeshState, RenderSettings, World
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.engine.session import Session
from drgs_blender.reconstruct.readers import read_capture

ROOT = Path(__file__).resolve().parents[2]
#: Metres: half a table, half a box in X and Y, its height.
TABLE, BOX, HEIGHT = 0.5, 0.07, 0.12
DISTANCE = 0.6
SIZE, FOCAL = (400, 300), 430.0
COUNT = 9


def noise(seed: int, side: int = 512) -> Image:
    """Squares of many sizes: a texture that looks alike nowhere."""
    random, grey = np.random.default_rng(seed), np.full((side, side, 3), 128.0)
    for cells in (8, 16, 32, 64, 128):
        square = side // cells
        grey += 60 * (random.random((cells, cells, 3)) - 0.5).repeat(square, 0).repeat(square, 1)
    return Image(f"noise {seed}", grey.clip(0, 255).astype(np.uint8), "srgb")


def textured(name: str, corners: np.ndarray, uvs: np.ndarray, image: Image) -> MeshState:
    """Quads (n, 4, 3) with their places (n, 4, 2) in a picture."""
    faces = np.arange(4 * len(corners), dtype=np.int32).reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    material = Material(name, (1.0, 1.0, 1.0), roughness=0.7, base_colour_texture=Texture(image.name))
    return MeshState(
        name, corners.reshape(-1, 3).astype(np.float32), faces, np.eye(4)[None], np.zeros(1, np.int32),
        uvs=uvs.reshape(-1, 2).astype(np.float32)[faces], materials=[material],
    )  # fmt: skip


def still_life() -> tuple[list[MeshState], list[Image]]:
    """A box on a table, turned a little; each of its sides shows a part of its own of one picture."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    table = np.column_stack([TABLE * square, np.zeros(4)])[None]
    ground, cover = noise(1, 1024), noise(2)
    sides = [np.column_stack([BOX * square, np.full(4, HEIGHT)])]
    for k in range(4):
        c, s = math.cos(k * math.pi / 2), math.sin(k * math.pi / 2)
        side = np.column_stack([BOX * square[:, 0], np.full(4, -BOX), HEIGHT * (square[:, 1] + 1) / 2])
        sides.append(side @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    c, s = math.cos(0.3), math.sin(0.3)
    box = np.stack(sides) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    parts = [((square + 1) / 2 + [k % 3, k // 3]) / 3 for k in range(5)]
    meshes = [textured("table", table, (square + 1)[None] / 2, ground), textured("box", box, np.stack(parts), cover)]
    return meshes, [ground, cover]


def held(k: int) -> np.ndarray:
    """Camera to world, Blender's axes, of photograph k: steps of 22 degrees at two heights, held about level."""
    random = np.random.default_rng(k)
    angle, height = math.radians(22) * k, (0.6, 0.9)[k % 2] + 0.1 * random.random()
    back = np.array([math.cos(angle) * math.cos(height), math.sin(angle) * math.cos(height), math.sin(height)])
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    roll = 0.06 * (random.random() - 0.5)
    c, s = math.cos(roll), math.sin(roll)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], 1) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    matrix[:3, 3] = DISTANCE * (1 + 0.1 * (random.random() - 0.5)) * back + [0, 0, 0.4 * HEIGHT]
    return matrix


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Folder of photographs under a cloudy sky, and file -> true camera."""
    folder, session = tmp_path_factory.mktemp("photographs"), Session()
    meshes, images = still_life()
    settings = RenderSettings(samples=12, subpixel_samples=4)
    cameras = {}
    for k in range(COUNT):
        name, (width, height) = f"photo_{k}", SIZE
        cameras[name] = held(k)
        camera = Camera(cameras[name], width, height, FOCAL, FOCAL, width / 2, height / 2)
        frame = Frame(k, camera, [], World(colour=(0.8, 0.9, 1.0)), settings, meshes=meshes, images=images)
        shown = linear_to_srgb(session.render(frame)["Combined"][..., :3].clip(0, 1))
        Pillow.fromarray((shown * 255 + 0.5).astype(np.uint8)).save(folder / f"{name}.jpg", quality=95)
    return folder, cameras


@pytest.mark.slow
def test_cameras_of_rendered_photographs_are_found(photographs, tmp_path):
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    folder, cameras = photographs
    out = tmp_path / "capture"
    words = ["capture", str(folder), "--out", str(out), "--masks", "none"]
    assert main([*words, "--camera-distance", str(DISTANCE), "--no-progress"]) == 0
    found = {view.name: view.camera for view in read_capture(out).views}
    assert sorted(found) == sorted(cameras)
    ours, true = np.stack([found[name].matrix_world for name in cameras]), np.stack([*cameras.values()])
    scale, rotation, shift = similarity(ours[:, :3, 3], true[:, :3, 3])
    places = scale * ours[:, :3, 3] @ rotation.T + shift
    assert np.linalg.norm(places - true[:, :3, 3], axis=1).max() < 0.01 * DISTANCE
    turns = np.swapaxes(rotation @ ours[:, :3, :3], 1, 2) @ true[:, :3, :3]
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 0.5
    assert all(camera.fx == pytest.approx(FOCAL, rel=0.01) for camera in found.values())
    # the world is the table's: upright, in metres by the distance that was given, its surface at zero
    assert rotation[2, 2] > math.cos(math.radians(1.0))
    assert scale == pytest.approx(1.0, rel=0.02)
    assert shift[2] == pytest.approx(0.0, abs=0.01 * DISTANCE)


def test_pillow_works_after_structure_from_motion_was_loaded_first():
    """Without what `libraries` imports before it, the system's zlib mixes with pycolmap's own: a crash or a hang."""
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    program = (
        "from drgs_blender.capture import libraries\n"
        "libraries.load('pycolmap')\n"
        "import io\n"
        "from PIL import Image\n"
        "noise = bytes(k * k % 251 for k in range(64 * 64 * 3))\n"
        "for kind, more in (('PNG', {}), ('TIFF', {'compression': 'tiff_adobe_deflate'})):\n"
        "    file = io.BytesIO()\n"
        "    Image.frombytes('RGB', (64, 64), noise).save(file, kind, **more)\n"
        "    assert Image.open(io.BytesIO(file.getvalue())).tobytes() == noise\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM that one can catch")
def test_structure_from_motion_leaves_sigterm_to_who_had_it():
    """COLMAP's log library takes it for a crash: no state is saved, and what it prints is a stack trace."""
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    program = (
        "import os, signal\n"
        "from drgs_blender.capture import libraries\n"
        "from drgs_blender.cli.interrupt import interruptible\n"
        "with interruptible() as cancelled:\n"
        "    libraries.load('pycolmap')\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    assert cancelled()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, cwd=ROOT)
    assert done.returncode == 0 and "stopping after the current step" in done.stderr, done.stderr[-2000:]
