"""What bench_light.py looks at: four subjects, the same arrays for every renderer; our pictures with their times."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from judge import environments, foreground, frame_camera
from ours import pinhole
from report import OUT
from subjects import asset_path, spread_materials

from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.frame import Frame, ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.formats.registry import read_environment

Array = np.ndarray

FOLDER = OUT / "light"
#: Indirect bounces in every renderer.
BOUNCES = 1
#: Pixels a side of the pictures that measure the setup.
TINY = 8
#: Sub-pixel positions of our references; other pictures have as many as the settings choose for their rays.
REFERENCE_AA = 64
#: Strength of the world, as in the parity bench: hardly a pixel is clipped.
STRENGTH = 0.35
#: Triangles of the subjects at most.
TRIANGLES = 82000


@dataclass(frozen=True)
class Case:
    """One subject under one map. Without numbers, its materials are spread over it (see `spread_materials`)."""

    name: str
    mesh: str
    light: str
    roughness: float | None = None
    metallic: float = 0.0

    @cached_property
    def files(self) -> tuple[Path, Path]:
        """(.drgs, .npz), made once for these sources."""
        source = asset_path(self.mesh, max_triangles=TRIANGLES)
        drgs = source.with_name(f"light-{self.name}.drgs")
        npz = drgs.with_suffix(".npz")
        if not (drgs.exists() and npz.exists()):
            asset = read_asset(source)
            data = spread_materials(asset.mesh)
            if self.roughness is not None:
                data["roughness"] = np.full_like(data["roughness"], self.roughness)
                data["metallic"] = np.full_like(data["metallic"], self.metallic)
            write_asset(drgs, Asset(asset.surfels, Mesh(**data), asset.binding, None, {"source": self.mesh}))
            np.savez(npz, **data)
        return drgs, npz

    @property
    def materials(self) -> str:
        """The materials in words."""
        if self.roughness is None:
            return "spread materials"
        return f"roughness {self.roughness:g}, metallic {self.metallic:g}"

    @property
    def environment(self) -> Path:
        return environments() / f"{self.light}.exr"

    def camera(self, size: int) -> dict[str, Any]:
        with np.load(self.files[1]) as data:
            return frame_camera(data["vertices"], size, azimuth=-60, fill=0.66)

    def job(self, size: int, samples: int, seed: int, out: Path, **more: Any) -> dict[str, Any]:
        """What cycles_job.py and mitsuba_job.py take."""
        FOLDER.mkdir(parents=True, exist_ok=True)
        return {
            "mesh": str(self.files[1]), "environment": str(self.environment), "camera": self.camera(size),
            "samples": samples, "bounces": BOUNCES, "strength": STRENGTH, "seed": seed, "terminator_offset": 0.0,
            "out": str(out),
        } | more  # fmt: skip

    def frame(self, key: str, size: int, samples: int, seed: int = 0, **settings: Any) -> Frame:
        """A frame of ours; reads the environment's file."""
        chosen: dict[str, Any] = {
            "camera_sees": "mesh",
            "bounces": BOUNCES,
            "film_transparent": True,
            "threads": 2,
            "samples": samples,
        }
        return Frame(
            noise_index=1,
            camera=pinhole(self.camera(size)),
            objects=[ObjectState(self.name, key)],
            world=World(environment=read_environment(self.environment).radiance, strength=STRENGTH),
            settings=RenderSettings(**(chosen | {"seed": seed} | settings)),
        )

    def picture(self, size: int, samples: int, seed: int = 0, **settings: Any) -> tuple[Array, float]:
        """Our picture and its seconds, from arrays and the map's file to pixels, in a session that knows the asset."""
        session = Session()
        key = session.load_asset(self.files[0])
        begin = time.perf_counter()
        picture = session.render(self.frame(key, size, samples, seed, **settings))["Combined"]
        return picture, time.perf_counter() - begin


CASES = (
    Case("glossy", "cat", "city", roughness=0.2, metallic=1.0),
    Case("rough", "cat", "studio", roughness=0.8),
    Case("mixed", "robot", "studio"),
    Case("sun", "spot", "sunset"),
)


def chosen(options: argparse.Namespace) -> list[Case]:
    """The cases that the command line names."""
    return [case for case in CASES if case.name in options.cases]


@dataclass(frozen=True)
class Plan:
    """What decides on a measurement, next to case and renderer."""

    size: int
    seeds: int
    subpixel_samples: int
    reference_rays: int
    reference_spp: int

    @classmethod
    def of(cls, options: argparse.Namespace) -> Plan:
        return cls(options.size, options.seeds, options.subpixel_samples, options.reference_rays, options.reference_spp)


@dataclass(frozen=True, eq=False)
class Reference:
    """A converged picture and where it is wholly covered by the subject."""

    picture: Array
    mask: Array

    @classmethod
    def of(cls, picture: Array, alpha: float = 0.999) -> Reference:
        """Covered is what has `alpha`; surfels blend, and never reach one."""
        return cls(picture, foreground((picture[..., 3] > alpha).astype(np.float32)))


def converged(case: Case, size: int, rays: int) -> Reference:
    """Our converged picture; its seed is none that is measured."""
    return Reference.of(case.picture(size, rays, 1000, subpixel_samples=REFERENCE_AA)[0])


@cache
def our_reference(case: Case, plan: Plan) -> Reference:
    """`converged`, once."""
    return converged(case, plan.size, plan.reference_rays)
