"""Deformation: what binding and posing cost, and what the paper's update rule gets wrong.

python bench/bench_deform.py [--runs 20]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import trimesh
from report import table, write_section
from scipy.spatial.transform import Rotation

from drgs_blender.core.asset.model import Mesh, Surfels
from drgs_blender.deform.attach import attach
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.deform.surfel_update import paper_update, surfel_update
from drgs_blender.geometry.normals import VertexNormals, quaternions

FACES, SURFELS = 100_000, 300_000


def dented_ball() -> Mesh:
    """A closed mesh of about FACES triangles."""
    rows = round((FACES / 8) ** 0.5)
    source = trimesh.creation.uv_sphere(count=[rows, 2 * rows])
    v = source.vertices * (1 + 0.1 * np.sin(5 * source.vertices[:, [1, 2, 0]]))
    n = len(v)
    return Mesh(v, source.faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))


def scattered(mesh: Mesh) -> Surfels:
    """SURFELS free surfels near the mesh."""
    rng = np.random.default_rng(0)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    point, face = trimesh.sample.sample_surface(solid, SURFELS, seed=0)
    normal = solid.face_normals[face]
    side = np.cross(normal, rng.normal(size=normal.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    frame = np.stack([side, np.cross(normal, side), normal], -1)
    centre = point + 0.003 * normal * rng.normal(size=(SURFELS, 1))
    flat = np.full(SURFELS, 0.5)
    return Surfels(
        centre, np.full((SURFELS, 2), 0.005), quaternions(frame), flat, np.full((SURFELS, 3), 0.5), flat, flat
    )


def measure(call: Callable[[], object], runs: int) -> tuple[float, float]:
    """Median processor and wall time, milliseconds, after one call that compiles."""
    call()
    processor, wall = [], []
    for _ in range(runs):
        p, w = time.process_time(), time.perf_counter()
        call()
        processor.append(time.process_time() - p)
        wall.append(time.perf_counter() - w)
    return round(1e3 * float(np.median(processor)), 1), round(1e3 * float(np.median(wall)), 1)


def rule_errors() -> list[list[object]]:
    """Median errors of both update rules on random deformation gradients, against float64 F Sigma F^T."""
    rng = np.random.default_rng(0)
    n = 100_000
    rotation = Rotation.random(n, random_state=rng).as_matrix()
    scale = rng.uniform(0.2, 2, (n, 2))
    gradient = np.eye(3) + 0.4 * rng.normal(size=(n, 3, 3))
    gradient[np.linalg.det(gradient) < 0.05] = np.eye(3)
    image = gradient @ (rotation[..., :2] * scale[:, None])
    covariance = image @ image.swapaxes(1, 2)
    normal = np.cross(image[..., 0], image[..., 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rows = []
    single = [x.astype(np.float32) for x in (gradient, rotation, scale)]
    for name, (new, sizes) in {
        "exact (single precision)": surfel_update(*single),
        "paper, descending": paper_update(gradient, rotation, scale),
        "paper, ascending": paper_update(gradient, rotation, scale, descending=False),
    }.items():
        tangents = new[..., :2].astype(float) * sizes[:, None]
        error = np.linalg.norm(tangents @ tangents.swapaxes(1, 2) - covariance, axis=(1, 2))
        tilt = np.degrees(np.arcsin(np.minimum(np.linalg.norm(np.cross(new[..., 2], normal), axis=1), 1)))
        rows.append([name, float(np.median(error / np.linalg.norm(covariance, axis=(1, 2)))), float(np.median(tilt))])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=20)
    options = parser.parse_args()
    mesh = dented_ball()
    surfels = scattered(mesh)
    binding, _ = bind(mesh, surfels)
    driven = MeshDriven(mesh, surfels, binding)
    bent = (mesh.vertices + 0.1 * np.sin(3 * mesh.vertices[:, [2, 0, 1]])).astype(np.float32)
    paint = {"albedo": np.ones_like(mesh.albedo), "roughness": None, "metallic": None}
    normals = VertexNormals(mesh.faces, len(mesh.vertices))
    few = max(1, options.runs // 7)
    rows = [
        ["bind (once)", *measure(lambda: bind(mesh, surfels), few)],
        ["attach, Algorithm 1 (once)", *measure(lambda: attach(mesh, surfels), few)],
        ["prepare to drive (once)", *measure(lambda: MeshDriven(mesh, surfels, binding), few)],
        ["vertex normals", *measure(lambda: normals(bent), options.runs)],
        ["pose", *measure(lambda: driven.pose(bent), options.runs)],
        ["pose and repaint albedo", *measure(lambda: driven.pose(bent, materials=paint), options.runs)],
    ]
    body = f"{len(surfels):,} surfels on {len(mesh.faces):,} triangles; vertex normals are part of a pose.\n\n"
    body += table(["step", "processor ms", "wall ms"], rows)
    body += "\n\nUpdate of a surfel under random gradients (identity plus normal noise of 0.4), medians:\n\n"
    body += table(["rule", "relative error of the covariance", "tilt of the normal, degrees"], rule_errors())
    write_section("deform", "Deformation", body)


if __name__ == "__main__":
    main()
