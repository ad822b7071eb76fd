"""What makes the time: threads, triangles, rays, the denoiser; and the memory of a large frame. Part of bench_light.py.

As a program it is the child process of its own measurements: light_cost.py threads|memory ARGUMENTS
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from light_cases import CASES, Case
from report import OUT, table

from drgs_blender.compute.closure import digest
from drgs_blender.compute.jit import njit
from drgs_blender.compute.threads import over_range, use_threads
from drgs_blender.core.asset import Asset, Binding, Mesh, Surfels
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.frame import Frame
from drgs_blender.core.passes import PASSES
from drgs_blender.engine.session import Session
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gbuffer.mesh import primary_mesh
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.shading_points import ShadingPoints

Array = np.ndarray
RAYS, RUNS = 32, 3
#: The paper's counts, so that the floor can trace the same rays.
FIXED = {"subpixel_samples": 4, "strategy_samples": (16, 8, 8)}
#: What a plain loop must gain by a second thread for the machine to count as free.
FREE = 1.8
#: The subject of all but the memory test.
CASE = next(case for case in CASES if case.name == "rough")


def median_seconds(work: Callable[[], object], runs: int = RUNS) -> float:
    """Median wall time after one run that is not counted."""
    times = []
    for _ in range(runs + 1):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return float(np.median(times[1:]))


@dataclass
class Stage:
    """Everything the integrator needs for one picture of `CASE`."""

    frame: Frame
    scene: TraceScene
    light: EnvironmentLight
    points: ShadingPoints

    @classmethod
    def of(cls, case: Case, mesh: Mesh, size: int) -> Stage:
        frame = case.frame("", size, RAYS, **FIXED)
        scene = TraceScene()
        scene.update([TraceObject("subject", mesh.vertices, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic)])
        parameters = camera_parameters(frame.camera, frame.settings, frame.noise_index)
        points = primary_mesh(scene, frame.camera, parameters, 0, size).points
        return cls(frame, scene, EnvironmentLight(frame.world), points)

    def seconds(self) -> float:
        """Of the integrator alone."""
        return median_seconds(
            lambda: integrate(self.scene, self.light, self.points, self.frame.settings, self.frame.noise_index)
        )


def child(environment: dict[str, str], *arguments: object) -> Any:
    """Run this file as a program; what it prints last, as JSON."""
    done = subprocess.run(
        [sys.executable, __file__, *map(str, arguments)], env=os.environ | environment, capture_output=True, text=True,
        timeout=900,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


@njit
def _plain(first: int, last: int, steps: int, sums: Array) -> None:
    """Work that any two free processors do in half the time of one."""
    for lane in range(first, last):
        total = 0.0
        for i in range(steps):
            total += np.sin(i * 1e-3 + lane)
        sums[lane] = total


def plain_loop() -> None:
    """`_plain` on all threads."""
    over_range(_plain, 16, 4_000_000, np.zeros(16))


def threads(size: int) -> list[list[object]]:
    """One thread against two, next to a plain loop: on a busy machine two threads do not get two processors."""
    one, two = (child({"NUMBA_NUM_THREADS": str(n)}, "threads", size) for n in (1, 2))
    gain, control = one["integrator"] / two["integrator"], one["plain"] / two["plain"]
    verdict = f"{gain:.2f} times as fast"
    if control < FREE:
        verdict = f"not measured: the machine was busy, a plain loop gained {control:.2f} times only"
    return [
        ["integrator, 1 thread / 2 threads", f"{one['integrator']:.2f} s / {two['integrator']:.2f} s", verdict],
        ["a plain loop, the same", f"{one['plain']:.2f} s / {two['plain']:.2f} s", f"{control:.2f} times as fast"],
    ]


def finer(mesh: Mesh, levels: int) -> Mesh:
    """Every triangle cut into four, `levels` times; the same shape and materials."""
    materials = np.column_stack([mesh.albedo, mesh.roughness, mesh.metallic])
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(levels):
        vertices, faces, found = trimesh.remesh.subdivide(vertices, faces, vertex_attributes={"m": materials})
        materials = found["m"]
    return Mesh(vertices, faces, materials[:, :3], materials[:, 3], materials[:, 4])


def growth(size: int) -> list[list[object]]:
    """Integrator, and nothing but its rays, at the subject's triangles and at sixteen times as many."""
    mesh = read_asset(CASE.files[0]).mesh
    rows, seconds, traced = [], [], []
    for levels in (0, 2):
        stage = Stage.of(CASE, finer(mesh, levels), size)
        seconds.append(stage.seconds())
        traced.append(floor_seconds(stage)[0])
        rows.append([f"integrator, {len(stage.scene.faces):,} triangles", f"{seconds[-1]:.2f} s", ""])
        stage.scene.close()
    rows[1][2] = f"{seconds[1] / seconds[0]:.2f} times the time; the floor's, {traced[1] / traced[0]:.2f} times"
    return rows


def floor_seconds(stage: Stage) -> tuple[float, int]:
    """Time of tracing as many rays of the same kinds as a frame, one by one and nothing else; and how many."""
    nearest, shadow = rays_of(stage, np.random.default_rng(0))
    bvh = stage.scene.bvh
    traced = sum(median_seconds(lambda rays=rays: bvh.intersect(*rays)) for rays in nearest)
    traced += median_seconds(lambda: bvh.occluded_many(*shadow))
    return traced, sum(len(rays[0]) for rays in nearest) + len(shadow[0])


def floor(size: int) -> list[list[object]]:
    """A frame against its rays alone."""
    stage = Stage.of(CASE, read_asset(CASE.files[0]).mesh, size)
    session = Session()
    frame = CASE.frame(session.load_asset(CASE.files[0]), size, RAYS, **FIXED)
    whole = median_seconds(lambda: session.render(frame))
    traced, count = floor_seconds(stage)
    beyond = f"beyond it {2e9 * (whole - traced) / count:.0f} ns of a processor a ray"
    return [
        [
            f"frame, {RAYS} rays, {FIXED['subpixel_samples']} sub-pixel samples",
            f"{whole:.2f} s",
            f"{whole / traced:.2f} times the floor; {beyond}",
        ],
        [f"floor: the same {count / 1e6:.1f} million rays", f"{traced:.2f} s", f"{count / traced / 1e6:.1f} million/s"],
    ]


def rays_of(stage: Stage, rng: np.random.Generator) -> tuple[list[tuple[Array, Array]], tuple[Array, Array]]:
    """Rays as a frame traces them: [camera, first hits] that look for the nearest face, and those of the shadow kind.

    Drawn from the same distributions at the same points, in the same order of points, as many as the integrator's
    (it leaves out directions below the surface, so do we).
    """
    settings, scene, points = stage.frame.settings, stage.scene, stage.points
    by_cosine, by_ggx, by_light = settings.strategy_samples
    camera = camera_rays(stage.frame, rng)
    origins, directions = [], []
    lift = 1e-5 * np.abs(points.origin).max(axis=1) + 2e-6 * scene.extent
    start = (points.origin + lift[:, None] * points.geometric_normal).astype(np.float32)
    for count, draw in (
        (by_cosine, lambda i: cosine(points.normal[i], rng)),
        (by_ggx, lambda i: ggx(points.normal[i], points.view[i], points.roughness[i], rng)),
        (by_light, lambda i: stage.light.sample(uint32_numbers(len(i), rng), points.normal[i])[0]),
    ):
        of = np.repeat(
            np.arange(len(points)), np.floor(count / settings.subpixel_samples + rng.random(len(points))).astype(int)
        )
        towards = draw(of)
        good = above(towards, points.normal[of]) & above(towards, points.geometric_normal[of])
        origins.append(start[of[good]])
        directions.append(np.asarray(towards[good], np.float32))
    first = np.concatenate(origins), np.concatenate(directions)
    t, face, _, _ = scene.bvh.intersect(*first)
    met = np.flatnonzero(face >= 0)
    corners = scene.vertices[scene.faces[face[met]]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    normal *= -np.sign((normal * first[1][met]).sum(axis=1, keepdims=True))
    hit = first[0][met] + t[met, None] * first[1][met]
    hit += (1e-5 * np.abs(hit).max(axis=1) + 2e-6 * scene.extent)[:, None] * normal
    towards = [stage.light.sample(uint32_numbers(len(met), rng), normal)[0], cosine(normal, rng)]
    good = [above(d, normal) for d in towards]
    shadow = (
        np.concatenate([hit[g] for g in good]).astype(np.float32),
        np.concatenate([d[g] for d, g in zip(towards, good)]).astype(np.float32),
    )
    return [camera, first], shadow


def uint32_numbers(count: int, rng: np.random.Generator) -> Array:
    """(count, 3) random numbers as light sampling takes them."""
    return rng.integers(0, 2**32, (count, 3), dtype=np.uint32)


def camera_rays(frame: Frame, rng: np.random.Generator) -> tuple[Array, Array]:
    """One ray a sub-pixel position, in the order of the picture."""
    camera = frame.camera
    y, x, _ = np.indices((camera.height, camera.width, frame.settings.subpixel_samples), np.float32).reshape(3, -1)
    x += rng.random(len(x), np.float32)
    y += rng.random(len(y), np.float32)
    local = np.stack([(x - camera.cx) / camera.fx, -(y - camera.cy) / camera.fy, -np.ones_like(x)], axis=1)
    directions = (local @ camera.matrix_world[:3, :3].T).astype(np.float32)
    return np.tile(camera.matrix_world[:3, 3].astype(np.float32), (len(x), 1)), directions


def above(directions: Array, normals: Array) -> Array:
    return (directions * normals).sum(axis=1) > 0


def cosine(normals: Array, rng: np.random.Generator) -> Array:
    """Directions in proportion to the cosine: the normal plus a point on the unit sphere."""
    ball = rng.standard_normal(normals.shape, np.float32)
    found = normals + ball / np.linalg.norm(ball, axis=1, keepdims=True)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)


def ggx(normals: Array, views: Array, roughness: Array, rng: np.random.Generator) -> Array:
    """Views mirrored at half vectors of the GGX distribution."""
    alpha = np.maximum(roughness**2, 1e-3)
    u = rng.random(len(normals), np.float32)
    tangent = np.cross(normals, rng.standard_normal(normals.shape, np.float32))
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-6)
    half = normals + (alpha * np.sqrt(u / np.maximum(1 - u, 1e-6)))[:, None] * tangent
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return 2 * (views * half).sum(axis=1, keepdims=True) * half - views


def svgf(size: int) -> list[object]:
    """Time between the phases Denoising and Done of a frame."""
    session = Session()
    frame = CASE.frame(session.load_asset(CASE.files[0]), size, RAYS, **FIXED, denoise="svgf")
    times: list[float] = []
    for _ in range(RUNS + 1):
        began: dict[str, float] = {}
        session.render(frame, lambda phase, _, began=began: began.setdefault(phase, time.perf_counter()))
        times.append(began["Done"] - began["Denoising"])
    return [f"SVGF, {size}x{size}", f"{np.median(times[1:]):.2f} s", ""]


def large_asset(count: int) -> Path:
    """A ball of about `count` triangles with `count` surfels on it, made once."""
    path = OUT / digest(Path(__file__)) / f"ball-{count}.drgs"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = max(4, round((count / 4) ** 0.5))
    ball = trimesh.creation.uv_sphere(count=[rows, rows])
    rng = np.random.default_rng(0)
    n = len(ball.vertices)
    mesh = Mesh(ball.vertices, ball.faces, rng.uniform(0.2, 0.8, (n, 3)), np.full(n, 0.4), np.zeros(n))
    face = rng.integers(0, len(ball.faces), count)
    weights = rng.dirichlet((1, 1, 1), count)
    centres = (ball.vertices[ball.faces[face]] * weights[..., None]).sum(axis=1)
    # The rotation that turns +Z into the normal, as (w, x, y, z).
    x, y, z = (centres / np.linalg.norm(centres, axis=1, keepdims=True)).T
    turn = np.column_stack([1 + z, -y, x, np.zeros(count)])
    turn[z < -0.9999] = 0, 1, 0, 0
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    size = np.full((count, 2), 2 * (4 * np.pi / count) ** 0.5)
    surfels = Surfels(
        centres, size, turn, np.full(count, 0.9), mesh.albedo[mesh.faces[face, 0]], np.full(count, 0.4), np.zeros(count)
    )
    binding = Binding(face, weights, np.zeros(count), np.tile([0.0, 0.0, 1.0], (count, 1)))
    write_asset(path, Asset(surfels, mesh, binding, None, {"source": "ball"}))
    return path


def memory(options: argparse.Namespace) -> str:
    """The text of the part about memory."""
    path, (width, height) = large_asset(options.million), options.memory_size
    least = child({}, "memory", large_asset(1000), 64, 64)  # which also compiles kernels that are not cached yet
    rows = [["hardly anything, 64x64", f"{least['gigabytes']:.2f}", ""]]
    found: dict[str, float] = {}
    for name, filled in (("in the picture's height", 0), ("filling the picture", 1)):
        found = child({}, "memory", path, width, height, filled)
        rows.append([f"the ball, {name}", f"{found['gigabytes']:.2f}", f"{found['seconds']:.0f}"])
    about = (
        f"A ball of {found['triangles']:,} triangles and {found['surfels']:,} surfels, {width}x{height}, all passes, "
        "SVGF, surfels as primary surface. Peak of a process of its own, and its processor time for this frame, "
        "its first."
    )
    return about + "\n\n" + table(("What", "GB", "processor s"), rows)


def peak_memory() -> int:
    """Largest resident memory of this process, bytes.

    Not ``getrusage``: there a Linux process starts with the peak of the one that started it.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("this system does not report the peak memory of a process")


def large_frame(path: Path, width: int, height: int, filled: bool = False) -> dict[str, float]:
    """Render the ball so that it fills the picture, or its height; largest memory of this process so far."""
    session = Session()
    key = session.load_asset(path)
    frame = CASE.frame(key, height, RAYS, **FIXED, camera_sees="surfels", denoise="svgf")
    camera = frame.camera
    reach, margin = (np.hypot(height, width), 0.99) if filled else (height, 1.2)
    distance = margin / np.sin(np.arctan(reach / 2 / camera.fy))
    camera.matrix_world = np.array([[1, 0, 0, 0], [0, 0, -1, -distance], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    camera.width, camera.cx = width, width / 2
    frame.passes = tuple(p.name for p in PASSES)
    begin = time.process_time()
    pictures = session.render(frame)
    seconds = time.process_time() - begin
    assert pictures["Coverage"].mean() > (0.999 if filled else 0.1), "the ball is not seen"
    asset = session.asset(key)
    return {
        "gigabytes": peak_memory() / 1e9,
        "seconds": seconds,
        "triangles": len(asset.mesh.faces),
        "surfels": len(asset.surfels),
    }


def cost(options: argparse.Namespace) -> str:
    """The part's text."""
    size = options.cost_size
    use_threads(2)
    rows = [*threads(size), *growth(size), *floor(size), svgf(size)]
    settings = CASE.frame("", 8, RAYS, **FIXED).settings
    return (
        f"{CASE.mesh}, {size}x{size}, {RAYS} rays (cosine, GGX and environment "
        f"{settings.strategy_samples}), {settings.bounces} indirect bounce, "
        f"{settings.subpixel_samples} sub-pixel samples, mesh as primary "
        f"surface, 2 threads unless said; medians of {RUNS}. The floor traces as many rays of the same kinds (camera, "
        "first hits, shadow rays of the bounce) in batches, single rays, no packets.\n\n"
        + table(("What", "Measured", ""), rows)
    )


def main(arguments: list[str]) -> None:
    task, *rest = arguments
    if task == "threads":
        stage = Stage.of(CASE, read_asset(CASE.files[0]).mesh, int(rest[0]))
        print(json.dumps({"integrator": stage.seconds(), "plain": median_seconds(plain_loop)}))
    elif task == "memory":
        print(json.dumps(large_frame(Path(rest[0]), *map(int, rest[1:]))))


if __name__ == "__main__":
    main(sys.argv[1:])
