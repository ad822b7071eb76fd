"""Tiny made-up sets in the layouts of published ones, of an asset that our own engine renders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import captures
import numpy as np
from PIL import Image
from shapes import sphere_mesh

from drgs_blender.core.asset import Asset, Environment, Mesh
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import COMPARED_PASSES
from drgs_blender.evaluate.metrics import on_white, straight
from drgs_blender.formats.exr import write_exr_environment, write_exr_picture
from drgs_blender.formats.latlong import directions

SAMPLES = 16
SETTINGS = RenderSettings(samples=SAMPLES, film_transparent=True)
WIDTH, HEIGHT, FOCAL = captures.WIDTH, captures.HEIGHT, captures.FOCAL


def light(seed: int) -> np.ndarray:
    """(16, 32, 3) radiance: dim, with two lamps somewhere."""
    random = np.random.default_rng(seed)
    ways = directions(16)
    radiance = np.full(ways.shape, 0.2) * random.uniform(0.5, 1.5, 3)
    for _ in range(2):
        towards = random.normal(size=3)
        towards /= np.linalg.norm(towards)
        radiance += np.exp(8 * (ways @ towards - 1))[..., None] * random.uniform(0.5, 2.5, 3)
    return radiance.astype(np.float32)


def object_asset(radiance: np.ndarray, **changes: np.ndarray) -> Asset:
    """An egg whose colour and roughness change from place to place; `changes` are channels of the mesh."""
    vertices, faces = sphere_mesh(3)
    vertices = (vertices * captures.AXES).astype(np.float32)
    albedo = np.clip(0.45 + 0.3 * np.sin(3 * vertices), 0, 1).astype(np.float32)
    roughness = np.clip(0.5 + 0.3 * vertices[:, 2], 0.2, 1).astype(np.float32)
    channels = {"albedo": albedo, "roughness": roughness, "metallic": np.zeros(len(vertices), np.float32)} | changes
    mesh = Mesh(vertices, faces, **channels)
    surfels, binding, _ = attach(mesh, None, density=60.0)
    return Asset(surfels, mesh, binding, Environment(radiance))


class Maker:
    """Writes sets of one asset."""

    def __init__(self, folder: Path, asset: Asset) -> None:
        self.file = folder / "true.drgs"
        write_asset(self.file, asset)
        self._session = Session()
        self._key = self._session.load_asset(self.file)
        self.training = asset.environment.radiance

    def render(self, matrix, radiance, width=WIDTH, height=HEIGHT, focal=FOCAL) -> dict[str, np.ndarray]:
        """All passes of a view."""
        camera = Camera(matrix, width, height, focal, focal, width / 2, height / 2)
        frame = Frame(
            noise_index=1, camera=camera, objects=[ObjectState("true", self._key)], world=World(radiance),
            settings=SETTINGS, passes=COMPARED_PASSES,
        )  # fmt: skip
        return dict(self._session.render(frame))

    def png(self, file: Path, matrix, radiance, alpha: bool = True) -> dict[str, np.ndarray]:
        """Write a picture with straight alpha, or on white."""
        passes = self.render(matrix, radiance)
        linear, cover = straight(passes)
        encoded = on_white(linear, np.ones_like(cover)) if alpha else on_white(linear, cover)
        save(file, np.dstack([encoded, cover]) if alpha else encoded)
        return passes

    def glossysynthetic(self, root: Path, name: str = "bell", relit: int = 2) -> Path:
        """Eight views, two lights more, of which the views past the sixteenth are of something else."""
        scene = captures.make(root / "GlossySynthetic" / name, 8)
        captures.write_nero(scene)
        for k, matrix in enumerate(scene.cameras):
            passes = self.png(scene.folder / f"{k}.png", matrix, self.training, alpha=False)
            depth = np.where(passes["Coverage"][..., 0] > 0.5, 20000, 65535).astype(np.uint16)
            Image.fromarray(depth).save(scene.folder / f"{k}-depth.png")
        for seed, lamp in enumerate(("corridor", "golf", "neon"), 10):
            relit_scene = captures.make(root / "glossy_relight" / "relight_gt" / f"{name}_{lamp}", relit)
            captures.write_nero(relit_scene)
            for k, matrix in enumerate(relit_scene.cameras):
                self.png(relit_scene.folder / f"{k}.png", matrix, light(seed))
            hdr(root / "glossy_relight" / "hdr2k" / f"{lamp}.exr", light(seed))
        return root

    def tensoir(self, root: Path, name: str = "lego") -> Path:
        """Six training and two test views, five lights."""
        scene = captures.make(root / name, 8)
        captures.write_tensoir(scene)
        lamps = {lamp: light(seed) for seed, lamp in enumerate(("bridge", "city", "fireplace", "forest", "night"), 20)}
        for k, matrix in enumerate(scene.cameras):
            folder = scene.folder / (f"train_{k:03d}" if k % 4 else f"test_{k // 4:03d}")
            for file in folder.glob("*.png"):
                file.unlink()
            passes = self.png(folder / "rgba_sunset.png", matrix, self.training)
            if k % 4:
                continue
            cover = np.clip(passes["Coverage"], 0, 1)
            save(folder / "albedo.png", np.dstack([passes["Albedo"], cover]))
            save(folder / "normal.png", np.dstack([(passes["Normal"] + 1) / 2, cover]))
            for lamp, radiance in lamps.items():
                self.png(folder / f"rgba_{lamp}.png", matrix, radiance)
        for lamp, radiance in lamps.items():
            hdr(root / "env" / "high_res_envmaps_2k" / f"{lamp}.exr", radiance)
        return root

    def shiny_blender(self, root: Path, name: str = "toaster") -> Path:
        """Eight training and three test views."""
        for split, count in (("train", 8), ("test", 3)):
            scene = captures.make(root / name, count)
            captures.write_nerf(scene, split)
            for k, matrix in enumerate(scene.cameras):
                passes = self.png(scene.folder / split / f"r_{k}.png", matrix, self.training)
                save(scene.folder / split / f"r_{k}_normal.png", (passes["Normal"] + 1) / 2)
        return root

    def stanford_orb(self, root: Path, name: str = "teapot", gains: tuple = (1.0, 1.0, 1.0)) -> Path:
        """Two scenes of an object, square pictures; the second one's world is turned against the first one's."""
        side, focal = 40, 55.0
        turn = np.eye(4)
        turn[:2, :2] = [[0, -1], [1, 0]]  # the second scene's world to the first one's
        scenes = {f"{name}_scene001": (self.training, np.eye(4)), f"{name}_scene002": (light(30), turn)}
        angle = 2 * np.arctan(0.5 * side / focal)
        for scene, (radiance, to_first) in scenes.items():
            folder, truth = root / "blender_HDR" / scene, root / "ground_truth" / scene
            for split, count in (("train", 6), ("test", 2)):
                frames = []
                for k, matrix in enumerate(captures.ring(count)):
                    passes = self.render(to_first @ matrix, radiance, side, side, focal)
                    linear, cover = straight(passes)
                    picture = linear * cover[..., None] * (np.asarray(gains) if scene.endswith("2") else 1)
                    exr(folder / split / f"{k:04d}.exr", picture)
                    save(folder / f"{split}_mask" / f"{k:04d}.png", cover)
                    own = matrix if scene.endswith("2") else to_first @ matrix
                    frames.append({"file_path": f"{split}/{k:04d}", "transform_matrix": own.tolist()})
                    if split == "train":
                        continue
                    exr(truth / "env_map" / f"{k:04d}.exr", seen_from(to_first @ matrix, radiance))
                    for kind, values in (
                        ("surface_normal", passes["Normal"] @ (to_first @ matrix)[:3, :3]),
                        ("z_depth", 3 * passes["Depth"][..., 0]),  # of any scale
                    ):
                        (truth / kind).mkdir(parents=True, exist_ok=True)
                        np.save(truth / kind / f"{k:04d}.npy", values.astype(np.float32))
                    from drgs_blender.core.color import linear_to_srgb

                    save(truth / "pseudo_gt_albedo" / f"{k:04d}.png", linear_to_srgb(np.clip(passes["Albedo"], 0, 1)))
                about = {"camera_angle_x": angle, "frames": frames}
                (folder / f"transforms_{split}.json").write_text(json.dumps(about))
        novel = [
            {"scene_name": f"{name}_scene002", "camera_angle_x": angle, "file_path": f"test/{k:04d}",
             "transform_matrix": (turn @ matrix).tolist()}
            for k, matrix in enumerate(captures.ring(2))
        ]  # fmt: skip
        file = root / "blender_HDR" / f"{name}_scene001" / "transforms_novel.json"
        file.write_text(json.dumps({"frames": novel}))
        return root


def seen_from(matrix: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """(64, 128, 3) lat-long of a light about a camera: forward in the middle, right at three quarters, up on top."""
    row, column = np.mgrid[:64, :128] + 0.5
    theta, phi = np.pi * row / 64, 2 * np.pi * (column / 128 - 0.5)
    own = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    x, y, z = np.moveaxis(own @ matrix[:3, :3].T, -1, 0)
    height, width = radiance.shape[:2]
    u = np.floor((0.5 - np.arctan2(y, x) / (2 * np.pi)) * width).astype(int) % width
    v = np.clip(np.floor(np.arccos(np.clip(z, -1, 1)) / np.pi * height).astype(int), 0, height - 1)
    return radiance[v, u]


def save(file: Path, pixels: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(np.nan_to_num(pixels), 0, 1) * 255).round().astype(np.uint8)).save(file)


def exr(file: Path, pixels: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_exr_picture(file, np.ascontiguousarray(pixels, np.float32))


def hdr(file: Path, radiance: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_exr_environment(file, Environment(radiance))


def with_mesh(asset: Asset, **channels: np.ndarray) -> Asset:
    """The asset with other materials of its mesh, and of its surfels by their binding."""
    mesh = replace(asset.mesh, **channels)
    corners, share = mesh.faces[asset.binding.face], asset.binding.barycentric
    moved = {
        name: np.einsum("nk,nk...->n...", share, values[corners]).astype(np.float32)
        for name, values in channels.items()
        if name != "vertices"
    }
    return replace(asset, mesh=mesh, surfels=replace(asset.surfels, **moved))
