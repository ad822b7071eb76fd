"""A small real asset, a real frame of it, and engines in processes of their own."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.ipc.client import EngineClient

ROOT = Path(__file__).resolve().parents[2]


def engine_program(before: str = "") -> list[str]:
    """Command of an engine from this checkout that executes `before` first."""
    start = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{before}\nfrom drgs_blender.engine.server import main; main()"
    )
    return [sys.executable, "-I", "-c", start]


def bumpy_sphere(rings: int = 12, segments: int = 20) -> Mesh:
    """A closed mesh of two materials whose parts shadow each other."""
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2 * np.pi * np.arange(segments) / segments
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    radius = 1 + 0.25 * np.cos(4 * p) * np.sin(t) ** 2
    ring = np.stack([radius * np.sin(t) * np.cos(p), radius * np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    vertices = np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]])
    top, bottom = len(ring), len(ring) + 1
    faces = []
    for s in range(segments):
        n = (s + 1) % segments
        faces += [(top, s, n), (bottom, top - segments + n, top - segments + s)]
        for r in range(rings - 2):
            a, b, c, d = r * segments + s, (r + 1) * segments + s, (r + 1) * segments + n, r * segments + n
            faces += [(a, b, c), (a, c, d)]
    z = vertices[:, 2]
    albedo = np.stack([0.2 + 0.6 * (z > 0), np.full(len(z), 0.5), 0.3 + 0.4 * np.abs(z)], axis=1)
    return Mesh(vertices, np.array(faces), albedo, 0.2 + 0.6 * np.abs(z), (z > 0.5).astype(np.float32))


@pytest.fixture(scope="session")
def mesh() -> Mesh:
    return bumpy_sphere()


@pytest.fixture(scope="session")
def asset_path(tmp_path_factory: pytest.TempPathFactory, mesh: Mesh) -> Path:
    surfels, binding, _ = attach(mesh, density=12.0)
    path = tmp_path_factory.mktemp("asset") / "ball.drgs"
    write_asset(path, Asset(surfels, mesh, binding))
    return path


@pytest.fixture(scope="session")
def make_frame(asset_path: Path, mesh: Mesh) -> Callable[..., Frame]:
    """Function that makes a frame: bent by `bend`, of `size` pixels, with three times `samples` samples."""
    environment = np.random.default_rng(7).uniform(0, 2, (16, 32, 3)).astype(np.float32)

    def make(bend: float = 0.0, size: tuple[int, int] = (48, 36), samples: int = 2, **settings: object) -> Frame:
        width, height = size
        matrix = np.eye(4)
        matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks along +Y
        matrix[1, 3] = -4.0
        sampling = {
            "samples": 3 * samples,
            "subpixel_samples": 2,
            "film_transparent": True,
        }
        vertices = mesh.vertices.copy()
        vertices[:, 0] += np.float32(bend) * vertices[:, 2] ** 2
        return Frame(
            noise_index=3,
            camera=Camera(matrix, width, height, 1.3 * width, 1.3 * width, width / 2, height / 2),
            objects=[ObjectState("Ball", str(asset_path.resolve()), vertices=vertices)],
            world=World(environment.copy()),
            settings=RenderSettings(**sampling | settings),  # type: ignore[arg-type]
            passes=("Combined", "Depth", "Normal"),
        )

    return make


@pytest.fixture
def session(asset_path):
    made = Session()
    made.load_asset(asset_path)
    return made


@pytest.fixture
def make_client() -> Iterator[Callable[..., EngineClient]]:
    """Function that makes clients, which are closed at the end of the test."""
    made: list[EngineClient] = []

    def make(before: str = "", **options: object) -> EngineClient:
        made.append(EngineClient(engine_program(before), **options))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for client in made:
        client.close()
