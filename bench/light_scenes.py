"""Scenes that nobody tuned to, for part `cases` of bench_light.py: one mesh each, with all its objects and materials.

The statues are of the development data (see tests/conftest.py); where these are missing, their cases are refused.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from judge import environments, look_at
from light_cases import CASES, TRIANGLES, Case
from report import OUT, ROOT
from subjects import SOURCES, asset_path, source_digest

from drgs_blender.build.make import make_asset
from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.frame import Frame, Light

Array = np.ndarray

SHARED = Path(os.environ.get("DRGS_SHARED", ROOT.parent / "shared")) / "data"
#: Files of the development data, and which axis is up.
STATUES = {
    "demosthenes": ("demosthenes/demosthenes-low-res.obj", "y"),
    "goathead": ("goathead/goathead.obj", "y"),
    "human": ("human/human_man.obj", "y"),
    "skull": ("skull/skull_low_resolution.obj", "y"),
}
#: A range: from bottom to top of the object.
Value = float | tuple[float, float]


@dataclass(frozen=True)
class Part:
    """An object about a metre tall: where it stands, turned about the vertical by degrees, and of what it is."""

    mesh: str
    roughness: Value
    metallic: Value = 0.0
    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0
    height: float = 1.0
    albedo: float | None = None

    @property
    def missing(self) -> bool:
        return self.mesh in STATUES and not self._statue.exists()

    @property
    def _statue(self) -> Path:
        return SHARED / "meshes" / "odedstein" / STATUES[self.mesh][0]

    def arrays(self) -> dict[str, Array]:
        """Vertices, faces and materials, in the scene."""
        if self.mesh in SOURCES:
            mesh = read_asset(asset_path(self.mesh, max_triangles=TRIANGLES)).mesh
        else:
            mesh = make_asset(self._statue, up=STATUES[self.mesh][1], max_texture=0, max_surfels=1).mesh
        v = np.asarray(mesh.vertices, np.float64)
        low, high = v.min(0), v.max(0)
        v = (v - [*((low + high)[:2] / 2), low[2]]) * (self.height / (high - low)[2])
        a = np.radians(self.turn)
        up = v[:, 2] / self.height
        v = v @ np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]]) + [self.x, self.y, 0]
        albedo = np.clip(mesh.albedo, 0.05, 0.95) if self.albedo is None else np.full((len(v), 3), self.albedo)
        return {
            "vertices": v.astype(np.float32),
            "faces": mesh.faces,
            "albedo": albedo.astype(np.float32),
            "roughness": np.interp(up, (0, 1), np.broadcast_to(self.roughness, 2)).astype(np.float32),
            "metallic": np.interp(up, (0, 1), np.broadcast_to(self.metallic, 2)).astype(np.float32),
        }


def ground(roughness: float) -> dict[str, Array]:
    corners = np.float32([[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0]])
    return {
        "vertices": corners,
        "faces": np.int32([[0, 1, 2], [0, 2, 3]]),
        "albedo": np.full((4, 3), 0.5, np.float32),
        "roughness": np.full(4, roughness, np.float32),
        "metallic": np.zeros(4, np.float32),
    }


def merged(parts: Sequence[dict[str, Array]]) -> dict[str, Array]:
    before = np.cumsum([0, *(len(part["vertices"]) for part in parts)])
    joined = {k: np.concatenate([part[k] for part in parts]) for k in parts[0] if k != "faces"}
    return joined | {"faces": np.concatenate([p["faces"] + n for p, n in zip(parts, before, strict=False)])}


@dataclass(frozen=True)
class Scene(Case):
    """Objects under one map, maybe on a ground and with lights."""

    parts: tuple[Part, ...] = ()
    floor: float | None = None
    lamps: tuple[dict[str, Any], ...] = ()
    bounces: int = 1
    strength: float = 0.5
    azimuth: float = -60.0
    angle: float = 24.0

    @property
    def missing(self) -> bool:
        return any(part.missing for part in self.parts) or not self.environment.exists()

    @property
    def environment(self) -> Path:  # type: ignore[override]
        return SHARED / "env" / self.light if self.light.endswith(".hdr") else environments() / f"{self.light}.exr"

    @cached_property
    def files(self) -> tuple[Path, Path]:  # type: ignore[override]
        drgs = OUT / source_digest() / f"scene-{self.name}.drgs"
        npz = drgs.with_suffix(".npz")
        if not (drgs.exists() and npz.exists()):
            drgs.parent.mkdir(parents=True, exist_ok=True)
            pieces = [part.arrays() for part in self.parts] + ([] if self.floor is None else [ground(self.floor)])
            data = merged(pieces)
            source = read_asset(asset_path("spot", max_triangles=TRIANGLES))
            # The mesh is what camera and rays see; an asset has some surfels.
            write_asset(drgs, Asset(source.surfels, Mesh(**data), None, None, {"source": self.name}))
            np.savez(npz, **data)
        return drgs, npz

    @property
    def materials(self) -> str:
        return "; ".join(f"{p.mesh} (roughness {p.roughness}, metallic {p.metallic})" for p in self.parts)

    def camera(self, size: int) -> dict[str, Any]:
        a = np.radians(self.azimuth)
        eye = np.array([3.2 * np.cos(a), 3.2 * np.sin(a), 1.1])
        matrix = look_at(eye, np.array([0.0, 0.0, 0.5]))
        return {"matrix_world": matrix.tolist(), "width": size, "height": size, "fov_x": self.angle}

    def job(self, size: int, samples: int, seed: int, out: Path, **more: Any) -> dict[str, Any]:
        own = {"bounces": self.bounces, "strength": self.strength, "lamps": self.lamps}
        return super().job(size, samples, seed, out, **(own | more))

    def frame(self, key: str, size: int, samples: int, seed: int = 0, **settings: Any) -> Frame:
        frame = super().frame(key, size, samples, seed, **({"bounces": self.bounces} | settings))
        assert frame.world is not None
        lights = [Light("lamp", **(lamp | {"matrix_world": np.array(lamp["matrix_world"])})) for lamp in self.lamps]
        return replace(frame, world=replace(frame.world, strength=self.strength), lights=lights)


def lamp(kind: str, place: tuple[float, float, float], power: float, **more: Any) -> dict[str, Any]:
    """A light at `place` that shines towards the middle of the scene."""
    matrix = look_at(np.array(place), np.array([0.0, 0.0, 0.5]))
    return {"kind": kind, "power": power, "matrix_world": matrix.tolist(), **more}


METAL = {"metallic": 1.0, "albedo": 0.8}
SCENES = (
    Scene("statue", "demosthenes", "sunrise", parts=(Part("demosthenes", (0.3, 0.08), **METAL),)),
    Scene("statue-rough", "demosthenes", "sunrise", parts=(Part("demosthenes", 0.8, albedo=0.6),)),
    Scene("statue-brushed", "demosthenes", "sunrise", parts=(Part("demosthenes", (0.6, 0.4), **METAL),)),
    Scene("statue-city", "demosthenes", "city", bounces=4, parts=(Part("demosthenes", 0.2, **METAL),)),
    Scene("lamps-indoors", "skull", "interior", parts=(Part("skull", (0.15, 0.7), (0.0, 1.0), albedo=0.7),)),
    Scene("dim", "robot", "night", strength=3.0, parts=(Part("robot", (0.1, 0.9), (1.0, 0.0)),)),
    Scene("contact", "spot", "forest", floor=0.6, angle=32.0, parts=(Part("spot", 0.4, turn=210),)),
    Scene(
        "facing", "several", "sunrise", floor=0.3, bounces=4, angle=36.0,
        parts=(
            Part("cat", 0.2, 1.0, x=-0.45, y=-0.2, turn=60, height=0.8),
            Part("spot", 0.5, 0.0, x=0.4, y=-0.3, turn=160, height=0.7),
            Part("robot", (0.1, 0.6), (0.0, 1.0), y=0.45, height=1.0),
        ),
    ),
    Scene(
        "lights", "helmet", "courtyard", floor=0.5, strength=0.15, angle=32.0, parts=(Part("helmet", (0.2, 0.6), 0.5),),
        lamps=(
            lamp("point", (1.5, -1.5, 1.8), 60.0, radius=0.05, colour=(1.0, 0.8, 0.6)),
            lamp("area", (-1.8, -0.6, 1.2), 40.0, size_x=0.5),
            lamp("sun", (1.0, 2.0, 3.0), 0.5, angle=0.01),
        ),
    ),
)  # fmt: skip
#: Looked at when nothing is changed any more.
KEPT = (
    Scene("kept-metal", "goathead", "park.hdr", parts=(Part("goathead", (0.08, 0.3), **METAL),)),
    Scene("kept-mixed", "human", "city", floor=0.4, parts=(Part("human", (0.2, 0.8), (1.0, 0.0), albedo=0.6),)),
)
EVERY: tuple[Case, ...] = CASES + SCENES + KEPT
