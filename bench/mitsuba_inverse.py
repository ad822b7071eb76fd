"""Runs in an environment that has Mitsuba 3: materials and light from photographs, by its differentiable renderer.

    build/mitsuba/bin/python bench/mitsuba_inverse.py CAPTURE.npz OUT.npz SECONDS

CAPTURE holds `vertices faces`, and of each photograph `matrices` (4, 4), `fov_x` (degrees), `pictures` (h, w, 3) linear
and `masks` (h, w). Path replay backpropagation with direct light and one bounce, one photograph a step, Adam on
albedo, roughness and metallic of the vertices and on a 32 x 64 environment, until SECONDS of the wall clock are over.
"""

from __future__ import annotations

import sys
import time

import drjit
import mitsuba as mi
import numpy as np
from mitsuba_job import choose_variant

SAMPLES, ROWS, RATE, LIGHT_RATE = 16, 32, 0.03, 0.05
NAMES = ("albedo", "roughness", "metallic")


def scene_of(data: dict[str, np.ndarray]) -> mi.Scene:
    material = {"type": "principled", "specular": 0.5}
    for ours, theirs in zip(NAMES, ("base_color", "roughness", "metallic")):
        material[theirs] = {"type": "mesh_attribute", "name": f"vertex_{ours}"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": material})
    count = len(data["vertices"])
    mesh = mi.Mesh("subject", count, len(data["faces"]), properties, True)
    for name, size, value in zip(NAMES, (3, 1, 1), (0.4, 0.5, 0.2)):
        mesh.add_attribute(f"vertex_{name}", size, np.full(count * size, value, np.float32))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.float32(data["vertices"]).ravel()
    parameters["faces"] = np.uint32(data["faces"]).ravel()
    parameters.update()
    up = np.eye(4)
    up[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    level = 2.5 * float(data["pictures"][data["masks"] > 0.99].mean())
    light = mi.Bitmap(np.full((ROWS, 2 * ROWS, 3), level, np.float32))
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 3, "hide_emitters": True},
        "light": {"type": "envmap", "bitmap": light, "to_world": mi.ScalarTransform4f(up)},
        "subject": mesh,
    })  # fmt: skip


def sensor(matrix: np.ndarray, fov: float, shape: tuple[int, ...]) -> mi.Sensor:
    to_world = matrix @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return mi.load_dict({
        "type": "perspective", "fov": float(fov), "fov_axis": "x", "to_world": mi.ScalarTransform4f(to_world),
        "near_clip": 1e-3, "far_clip": 1e5, "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm", "width": shape[1], "height": shape[0], "pixel_format": "rgb",
            "component_format": "float32", "rfilter": {"type": "box"},
        },
    })  # fmt: skip


def main(source: str, out: str, seconds: float) -> None:
    variant = choose_variant()
    with np.load(source) as file:
        data = {name: file[name] for name in file.files}
    scene = scene_of(data)
    shape = data["masks"].shape[1:]
    sensors = [sensor(m, f, shape) for m, f in zip(data["matrices"], data["fov_x"])]
    pictures = [mi.TensorXf(np.float32(p)) for p in data["pictures"]]
    masks = [mi.TensorXf(np.float32(np.repeat(m[..., None] > 0.99, 3, axis=-1))) for m in data["masks"]]
    parameters = mi.traverse(scene)
    keys = [f"subject.vertex_{name}" for name in NAMES]
    optimiser = mi.ad.Adam(lr=RATE, params={key: parameters[key] for key in keys})
    optimiser["light.data"] = parameters["light.data"]
    optimiser.set_learning_rate({"light.data": LIGHT_RATE})
    order = np.random.default_rng(0)
    began, cpu, step = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - began < seconds:
        parameters.update(optimiser)
        k = int(order.integers(len(sensors)))
        shown = mi.render(scene, parameters, sensor=sensors[k], spp=SAMPLES, seed=step)
        error = drjit.abs(drjit.log(1 + shown) - drjit.log(1 + pictures[k])) * masks[k]
        drjit.backward(drjit.mean(error, axis=None))
        optimiser.step()
        for key in keys:
            optimiser[key] = drjit.clip(optimiser[key], 1e-3 if "roughness" not in key else 0.03, 1.0)
        optimiser["light.data"] = drjit.maximum(optimiser["light.data"], 1e-3)
        step += 1
    parameters.update(optimiser)
    found = {name: np.array(parameters[key]) for name, key in zip(NAMES, keys)}
    spent = time.process_time() - cpu
    np.savez(out, albedo=found["albedo"].reshape(-1, 3), roughness=found["roughness"], metallic=found["metallic"],
             spent=spent, steps=step)  # fmt: skip
    print(f"mitsuba {mi.__version__} {variant}: {step} steps, {spent:.0f} processor seconds", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
