"""Runs in an environment that has Mitsuba 3: renders of arrays, as cycles_job.py does with Cycles.

    build/mitsuba/bin/python bench/mitsuba_job.py JOB.json

Jobs are those of cycles_job.py (`mesh environment camera samples bounces strength seed out`). The material is Mitsuba's
`principled` with albedo, roughness and metallic at the vertices. Seconds are from arrays and files to pixels: mesh,
environment map, acceleration structure and picture; each kind of picture is rendered once before, for its kernels.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import drjit
import mitsuba as mi
import numpy as np

#: What Mitsuba 3.9 emits, LLVM 15 and 16 end the process over on x86 (fminimum, fmaximum).
OLDEST_LLVM = 17
#: Samples traced at once at most: what bounds the memory of the wavefront.
WAVEFRONT = 1 << 22


def choose_variant() -> str:
    """Set the fastest variant that works here: llvm_ad_rgb, which needs the system's libLLVM, or scalar_rgb."""
    name = "llvm_ad_rgb"
    try:
        mi.set_variant(name)
        str(mi.Float(1.0) + 1.0)
        version = drjit.detail.llvm_version()
        reason = "" if version[0] >= OLDEST_LLVM else f"LLVM {'.'.join(map(str, version))} is too old"
    except (ImportError, RuntimeError) as error:
        reason = str(error)
    if reason:
        print(f"mitsuba: no {name}: {reason}", flush=True)
        name = "scalar_rgb"
        mi.set_variant(name)
    return name


def subject(path: str) -> mi.Object:
    with np.load(path) as data:
        arrays = {k: np.asarray(data[k]) for k in data.files}
    material = {"type": "principled", "specular": 0.5}
    for ours, theirs in (("albedo", "base_color"), ("roughness", "roughness"), ("metallic", "metallic")):
        material[theirs] = {"type": "mesh_attribute", "name": f"vertex_{ours}"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": material})
    mesh = mi.Mesh("subject", len(arrays["vertices"]), len(arrays["faces"]), properties, True)
    for name, size in (("albedo", 3), ("roughness", 1), ("metallic", 1)):
        mesh.add_attribute(f"vertex_{name}", size, np.float32(arrays[name]).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.float32(arrays["vertices"]).ravel()
    parameters["faces"] = np.uint32(arrays["faces"]).ravel()
    parameters.update()  # which computes the smooth normals
    return mesh


def scene_of(job: dict) -> mi.Scene:
    camera = job["camera"]
    # Mitsuba's camera looks along +Z with +X to the left, its environment has +Y up.
    to_world = np.array(camera["matrix_world"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    up = np.eye(4)
    up[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    return mi.load_dict({
        "type": "scene",
        "integrator": {
            "type": "path", "max_depth": job["bounces"] + 2, "rr_depth": job["bounces"] + 5, "hide_emitters": True,
        },
        "sensor": {
            "type": "perspective", "fov": camera["fov_x"], "fov_axis": "x", "to_world": mi.ScalarTransform4f(to_world),
            "near_clip": 1e-3, "far_clip": 1e5,
            "sampler": {"type": "independent"},
            "film": {
                "type": "hdrfilm", "width": camera["width"], "height": camera["height"], "pixel_format": "rgba",
                "component_format": "float32", "rfilter": {"type": "box"},
            },
        },
        "light": {
            "type": "envmap", "filename": job["environment"], "scale": job["strength"],
            "to_world": mi.ScalarTransform4f(up),
        },
        "subject": subject(job["mesh"]),
    })  # fmt: skip


def render(job: dict) -> tuple[np.ndarray, float]:
    """(h, w, 4) linear picture with row 0 on top, and seconds."""
    begin = time.perf_counter()
    scene = scene_of(job)
    pixels = job["camera"]["width"] * job["camera"]["height"]
    left, mean, part = job["samples"], 0.0, 0
    while left:
        count = min(left, max(1, WAVEFRONT // pixels))
        picture = np.array(mi.render(scene, spp=count, seed=1000 * job["seed"] + part))
        mean = mean + picture * (count / job["samples"])
        left, part = left - count, part + 1
    return np.float32(mean), time.perf_counter() - begin


def main(path: str) -> None:
    variant = choose_variant()
    results, warm = [], set()
    for job in json.loads(Path(path).read_text()):
        kind = job["mesh"], job["samples"]
        if kind not in warm and not job.get("untimed"):
            render(job | {"seed": 999})
            warm.add(kind)
        picture, seconds = render(job)
        np.save(job["out"], picture)
        results.append({"out": job["out"], "seconds": seconds, "variant": variant, "version": mi.__version__})
        print(f"mitsuba: {job['out']} {seconds:.2f} s", flush=True)
    Path(path).with_suffix(".result.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1])
