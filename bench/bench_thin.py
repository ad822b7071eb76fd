"""Thin and open structures: light meets surfels, or a mesh made from them; bent by a lattice; Cycles judges.

python bench/bench_thin.py [--size 240] [--subjects plant fur]

A plant of leaves and a ball of fur are made as meshes, which Cycles renders, and as surfels of the same shapes without
any mesh. The mesh tracer gets what a reconstruction would give it: the surfels' TSDF. Bent: in Blender one lattice
bends the meshes, and the proxy mesh that Add Proxy Mesh has put around the surfels.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from judge import blender_python, cycles_pictures, decibels, environments, frame_camera, systematic_error, to_srgb
from ours import pinhole
from report import OUT, ROOT, add_publish, picture_path, table, write_section
from scipy.ndimage import binary_erosion

from drgs_blender.build.proxy import mesh_from_surfels
from drgs_blender.core.asset import Asset, Mesh, Surfels
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import Frame, MeshState, ObjectState, ProxyMesh, RenderSettings, World
from drgs_blender.core.materials import Material
from drgs_blender.deform.attach import attach
from drgs_blender.deform.binding import bind
from drgs_blender.engine.session import Session
from drgs_blender.formats.registry import read_environment

Array = np.ndarray
STRENGTH, BOUNCES, AA = 0.35, 3, 16
GROUND = 0.5
RESOLUTION = 192
#: Triangles of proxies.
FACES = 2000
FIGURE = "proxies.png"


def sheets(strips: Array, colours: Array, roughness: float) -> Mesh:
    """A mesh of (n, k, m, 3) grids of points, one sheet each; (n, 3) colours."""
    n, k, m, _ = strips.shape
    cell = np.arange(k - 1)[:, None] * m + np.arange(m - 1)
    quads = np.stack([cell, cell + 1, cell + m + 1, cell + m], -1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    faces = (np.arange(n)[:, None, None] * k * m + faces).reshape(-1, 3)
    points = n * k * m
    albedo = np.repeat(colours, k * m, axis=0)
    return Mesh(strips.reshape(-1, 3), faces, albedo, np.full(points, roughness), np.zeros(points))


def plant(leaves: int = 220, seed: int = 1) -> Mesh:
    """Bent leaves around a stem, each folded along its middle."""
    rng = np.random.default_rng(seed)
    along, across = np.meshgrid(np.linspace(0, 1, 9), np.linspace(-1, 1, 5), indexing="ij")
    width = 0.09 * np.sin(np.pi * along**0.7) ** 0.8 + 0.002
    height, turn = rng.uniform(0.15, 1.0, leaves), rng.uniform(0, 2 * np.pi, leaves)
    length = rng.uniform(0.25, 0.5, leaves) * (1.25 - 0.6 * height)
    rise, droop = rng.uniform(0.1, 0.9, leaves), rng.uniform(0.2, 0.9, leaves)
    s = length[:, None, None]
    out = s * along * np.cos(0.6 * rise)[:, None, None]
    up = s * (along * rise[:, None, None] - droop[:, None, None] * along**2)
    side = width * across * (s / 0.4)
    up = up + 0.3 * np.abs(side)
    c, d = np.cos(turn)[:, None, None], np.sin(turn)[:, None, None]
    points = np.stack([c * out - d * side, d * out + c * side, up + height[:, None, None]], -1)
    colours = np.array([0.12, 0.35, 0.06]) + rng.uniform(-0.04, 0.08, (leaves, 3)) * [1, 1.5, 0.5]
    return sheets(points, colours, 0.45)


def fur(strands: int = 4000, seed: int = 2) -> Mesh:
    """A ball of bent, flat hairs."""
    rng = np.random.default_rng(seed)
    i = np.arange(strands) + 0.5
    z, turn = 1 - 2 * i / strands, np.pi * (1 + 5**0.5) * i
    normal = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], -1)
    comb = np.cross(normal, [0.3, 0.2, 1.0]) + 0.5 * rng.normal(size=(strands, 3)) - [0, 0, 0.8]
    s = np.linspace(0, 1, 6)[None, :, None]
    root = 0.32 * normal[:, None]
    middle = root + 0.2 * s * normal[:, None] + 0.16 * s**2 * comb[:, None]
    flat = np.cross(np.gradient(middle, axis=1), rng.normal(size=(strands, 1, 3)))
    flat /= np.linalg.norm(flat, axis=2, keepdims=True)
    half = 0.006 * (1.0 - 0.7 * s)
    middle[..., 2] += 0.6
    points = np.stack([middle - half * flat, middle + half * flat], axis=2)
    colours = np.array([0.45, 0.25, 0.12]) * rng.uniform(0.7, 1.3, (strands, 1))
    return sheets(points, colours, 0.4)


SUBJECTS = {"plant": plant, "fur": fur}


def surfels_of(name: str, mesh: Mesh) -> Surfels:
    """Surfels of the sheets' own shapes."""
    return attach(mesh, density=90.0 if name == "plant" else 60.0)[0]


def ground() -> MeshState:
    corners = 6.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    grey = [Material("ground", (GROUND,) * 3, roughness=0.6)]
    return MeshState(
        "ground", corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.eye(4)[None], np.zeros(1, np.int32),
        materials=grey,
    )  # fmt: skip


def with_ground(mesh: Mesh) -> dict[str, Array]:
    """Arrays for Cycles: the mesh and the ground as one."""
    plane = ground()
    n = len(mesh.vertices)
    return {
        "vertices": np.concatenate([mesh.vertices, plane.vertices]),
        "faces": np.concatenate([mesh.faces, plane.faces + n]),
        "albedo": np.concatenate([mesh.albedo, np.full((4, 3), GROUND)]).astype(np.float32),
        "roughness": np.append(mesh.roughness, np.full(4, 0.6)).astype(np.float32),
        "metallic": np.zeros(n + 4, np.float32),
    }


def bent(path: Path, mesh: Mesh) -> tuple[Array, ProxyMesh]:
    """Vertices of a mesh that a lattice bends in Blender, and the proxy of the asset at `path`, bent by the same."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces)
        job = {
            "asset": str(path), "mesh": str(folder / "mesh.npz"), "faces": FACES, "checkout": str(ROOT),
            "out": str(folder / "bent.npz"),
        }  # fmt: skip
        (folder / "job.json").write_text(json.dumps(job))
        words = [str(blender_python()), str(ROOT / "bench" / "proxy_job.py"), str(folder / "job.json")]
        user = {"BLENDER_USER_RESOURCES": str(folder / "user")}
        subprocess.run(words, check=True, env=os.environ | user, timeout=600)
        made = np.load(folder / "bent.npz")
        return made["bent"], ProxyMesh(*(made[key] for key in ("rest", "vertices", "faces")))


def judged(name: str, mesh: Mesh, camera: dict[str, Any], options: argparse.Namespace) -> Array:
    """Two pictures of Cycles of a mesh on the ground."""
    folder = OUT / "thin"
    np.savez(folder / f"{name}.npz", **with_ground(mesh))
    jobs = [
        {
            "mesh": str(folder / f"{name}.npz"), "environment": str(environments() / "city.exr"), "camera": camera,
            "samples": options.spp, "bounces": BOUNCES, "strength": STRENGTH, "terminator_offset": 0.0,
            "seed": seed, "out": str(folder / f"{name}-cycles-{options.size}-{seed}.npy"),
        }
        for seed in range(2)
    ]  # fmt: skip
    cycles_pictures(jobs, f"thin-{name}")
    return np.stack([np.load(job["out"]) for job in jobs])


def render(
    asset: Asset,
    path: Path,
    camera: dict[str, Any],
    options: argparse.Namespace,
    proxy: ProxyMesh | None = None,
    **settings: Any,
) -> tuple[Array, Array, float]:
    """Our pictures with two seeds, where the subject is, processor seconds of the second."""
    write_asset(path, asset)
    session = Session()
    key = session.load_asset(path)
    world = World(read_environment(environments() / "city.exr").radiance, strength=STRENGTH)
    how = RenderSettings(options.samples, bounces=BOUNCES, subpixel_samples=AA, film_transparent=True, **settings)
    subject = ObjectState("subject", key, pass_index=1, proxy=proxy)
    frame = Frame(1, pinhole(camera), [subject], world, how, ("Combined", "IndexOB"), [ground()])
    pictures = []
    for seed in range(2):  # kernels are loaded, and trees built, by the first
        frame.settings.seed = seed
        begin = time.process_time()
        passes = session.render(frame)
        seconds = time.process_time() - begin
        pictures.append(passes["Combined"])
    return np.stack(pictures), passes["IndexOB"][..., 0] == 1, seconds


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=240)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--subjects", nargs="+", choices=SUBJECTS, default=list(SUBJECTS))
    add_publish(parser)
    options = parser.parse_args()
    folder = OUT / "thin"
    folder.mkdir(parents=True, exist_ok=True)
    rows, figure = [], []
    for name in options.subjects:
        mesh = SUBJECTS[name]()
        surfels = surfels_of(name, mesh)
        camera = frame_camera(mesh.vertices, options.size, azimuth=-60, fill=0.9)
        theirs = judged(name, mesh, camera, options)
        began = time.process_time()
        made, _ = mesh_from_surfels(surfels, resolution=RESOLUTION)
        n = len(made.vertices)
        albedo = np.tile(surfels.albedo.mean(axis=0), (n, 1))
        fused = Mesh(made.vertices, made.faces, albedo, np.full(n, surfels.roughness[0]), np.zeros(n))
        binding, _ = bind(fused, surfels)
        making = time.process_time() - began
        alone, path = Asset(surfels, Mesh.empty()), folder / f"{name}.drgs"
        write_asset(path, alone)
        vertices, proxy = bent(path, mesh)
        moved = replace(mesh, vertices=vertices)
        beside = frame_camera(vertices, options.size, azimuth=-60, fill=0.9)
        then = judged(f"{name}-bent", moved, beside, options)
        met = {"rays_see": "surfels"}
        found = [
            ("at rest", "surfels", theirs, render(alone, path, camera, options, **met)),
            ("at rest", "TSDF", theirs, render(Asset(surfels, fused, binding), folder / "tsdf.drgs", camera, options)),
            ("bent", "surfels", then, render(alone, path, beside, options, proxy, **met)),
        ]
        pairs = [(true.mean(0), ours.mean(0)) for _, _, true, (ours, _, _) in found]
        save(folder / f"{name}.png", [picture for pair in pairs for picture in pair])
        figure.append(np.concatenate([picture for pair in pairs[::2] for picture in pair], axis=1))
        for pose, tracer, true, (ours, subject, seconds) in found:
            parts = [binary_erosion(subject), binary_erosion(~subject & (true[0, ..., 3] > 0.999))]
            errors = [decibels(systematic_error(ours, true, part)[0]) for part in parts]
            rows.append(
                (name, len(surfels), pose, tracer, *(f"{x:.1f}" for x in errors), f"{seconds:.1f}",
                 f"{making:.0f}" if tracer == "TSDF" else "-")
            )  # fmt: skip
    body = (
        f"{options.size}x{options.size}, city.exr, {BOUNCES} indirect bounces, {options.samples} samples, {AA} "
        f"sub-pixel samples, against "
        f"Cycles on the sheets themselves with {options.spp} spp. *surfels*: no mesh, `--rays-see surfels`. *TSDF*: "
        f"`--rays-see mesh` with the mesh fused from the surfels at {RESOLUTION} voxels. Bent: by a lattice of "
        f"Blender, the surfels by a proxy of about {FACES} triangles. PSNR in sRGB without the noise "
        "of either, inside the subject and on the ground around it; processor seconds of a frame, and of making and "
        "binding that mesh.\n\n"
        f"![Of each subject at rest and bent: Cycles, and surfels](images/{FIGURE})\n\n"
        + table(("Subject", "Surfels", "Pose", "Light meets", "Subject dB", "Ground dB", "CPU s", "Mesh CPU s"), rows)
    )
    if len(figure) == len(SUBJECTS):
        save(picture_path(FIGURE, options), [np.concatenate(figure)])
    write_section("thin", "Thin and open structures", body)


def save(path: Path, pictures: list[Array]) -> None:
    """Pictures side by side as PNG, or WebP by the path's suffix."""
    from PIL import Image

    pixels = 255 * to_srgb(np.concatenate(pictures, axis=1)[..., :3]) + 0.5
    how = {"quality": 92, "method": 6} if path.suffix == ".webp" else {"optimize": True}
    Image.fromarray(pixels.astype(np.uint8)).save(path, **how)


if __name__ == "__main__":
    main()
