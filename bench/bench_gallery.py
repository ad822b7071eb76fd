"""Pictures of the gallery: what figures of the paper show, of captured objects.

python bench/bench_gallery.py [--part composed lights poses reflections thin] [--size 256] [--samples 128]
python bench/bench_gallery.py --part variants --scenes scenes

All but variants show examples/captured. Variants are learned from photographs, in minutes: scenes are those of
`drgs evaluate --make-scenes scenes --objects spot --train 40 --test 8`. Writes out/gallery/gallery-PART.webp;
--publish writes to docs/images.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_matter_pictures import simulated
from bench_reconstruct import on_mesh, trained
from bench_thin import fur, surfels_of
from judge import environments, look_at, to_srgb
from light_ablation import ALONE
from ours import SESSION, pinhole
from PIL import Image, ImageDraw, ImageFont
from report import OUT, ROOT, add_publish, picture_path
from scipy.spatial import cKDTree

from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import Camera, Frame, Light, MeshState, ObjectState, RenderSettings, World
from drgs_blender.core.materials import Material
from drgs_blender.formats.harmonics import basis
from drgs_blender.formats.registry import read_environment
from drgs_blender.geometry.normals import unit
from drgs_blender.reconstruct.capture.training_views import composed as photograph
from drgs_blender.reconstruct.held_out import drawn
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.readers import read_capture

Array = np.ndarray
#: A title and what stands below it, (h, w, 3) sRGB in 0..1.
Tile = tuple[str, Array]

FOLDER = OUT / "gallery"
CAPTURED = ROOT / "examples" / "captured"
#: Lights: a name for artists, the HDRI of Blender's, its strength.
LIGHTS = {
    "outdoors, bright": ("city", 0.55), "outdoors, dim": ("night", 0.45), "indoors, bright": ("studio", 0.7),
    "indoors, dim": ("interior", 0.06), "sunset": ("sunset", 0.8),
}  # fmt: skip
#: Pascals of the jelly, and the frame that is shown of its fall.
MODULUS, FALLEN = 4e4, 13
#: From which colours are baked.
DIRECTIONS = 32
#: Pixels between tiles, and height of a title.
GAP, TITLE = 6, 20


def sheet(part: str, rows: list[list[Tile]], options: argparse.Namespace) -> None:
    """Write tiles of one size as the picture of a part."""
    height, width, _ = rows[0][0][1].shape
    across, down = width + GAP, height + TITLE + GAP
    picture = Image.new("RGB", (across * len(rows[0]) - GAP, down * len(rows) - GAP), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    for y, row in enumerate(rows):
        for x, (title, pixels) in enumerate(row):
            tile = Image.fromarray((255 * np.clip(pixels, 0, 1) + 0.5).astype(np.uint8))
            picture.paste(tile, (x * across, y * down + TITLE))
            draw.text((x * across + 3, y * down + 2), title, fill="black", font=font)
    picture.save(picture_path(f"gallery-{part}.webp", options), quality=88, method=6)


def encoded(linear: Array) -> Array:
    """(h, w, 3) sRGB of a linear picture, over white."""
    return to_srgb(linear[..., :3] + 1 - linear[..., 3:])


def bend(vertices: Array, turn: float, lean: float) -> Array:
    """Vertices twisted about the vertical by degrees from foot to top, and leant in parts of their height."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, up = (low + high)[:2] / 2, (vertices[:, 2] - low[2]) / (high[2] - low[2])
    angle = np.radians(turn) * up
    x, y = (vertices[:, :2] - middle).T
    moved = vertices.copy()
    moved[:, 0] = middle[0] + np.cos(angle) * x - np.sin(angle) * y + lean * (high[2] - low[2]) * up**2
    moved[:, 1] = middle[1] + np.sin(angle) * x + np.cos(angle) * y
    return moved


def standing(
    name: str, height: float, x: float = 0.0, y: float = 0.0, turn: float = 0.0, bent: tuple[float, float] | None = None
) -> ObjectState:
    """A captured object on the ground, so tall at rest, turned about the vertical by degrees, `bent` as of `bend`."""
    key = SESSION.load_asset(CAPTURED / f"{name}.drgs")
    vertices = SESSION.asset(key).mesh.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale, a = height / float(high[2] - low[2]), np.radians(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    matrix[:3, 3] = np.array([x, y, 0]) - matrix[:3, :3] @ np.append((low + high)[:2] / 2, low[2])
    return ObjectState(name, key, matrix, None if bent is None else bend(vertices, *bent))


def ground(roughness: float = 0.5, grey: float = 0.5) -> MeshState:
    """So large that its edge is out of sight."""
    corners = np.float32([[-40, -40, 0], [40, -40, 0], [40, 40, 0], [-40, 40, 0]])
    faces, look = np.int32([[0, 1, 2], [0, 2, 3]]), [Material("ground", (grey,) * 3, roughness)]
    return MeshState("ground", corners, faces, np.eye(4)[None], np.zeros(1, np.int32), materials=look)


@dataclass(frozen=True)
class View:
    """Of what stands at the origin: metres across, its middle's height, degrees from above, height over width."""

    width: float
    middle: float = 0.5
    above: float = 22.0
    shape: float = 1.0

    def camera(self, size: int) -> Camera:
        a, e, fov = np.radians(-70), np.radians(self.above), np.radians(24)
        away = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]) * self.width / 2 / np.tan(fov / 2)
        target = np.array([0.0, 0.0, self.middle])
        matrix = look_at(target + away, target).tolist()
        return pinhole({"matrix_world": matrix, "fov_x": 24.0, "width": size, "height": round(size * self.shape)})


def shown(
    objects: list[ObjectState],
    light: tuple[str, float],
    view: View,
    options: argparse.Namespace,
    *,
    floor: MeshState | None = None,
    lamps: tuple[Light, ...] = (),
    passes: tuple[str, ...] = ("Combined",),
    **settings: Any,
) -> dict[str, Array]:
    """Passes of objects under a light of `LIGHTS`, on a `floor` or on a transparent film."""
    world = World(read_environment(environments() / f"{light[0]}.exr").radiance, strength=light[1])
    given: dict[str, Any] = {"bounces": 3, "subpixel_samples": 16, "denoise": "svgf"} | settings
    how = RenderSettings(options.samples, film_transparent=floor is None, **given)
    meshes = [] if floor is None else [floor]
    return SESSION.render(Frame(1, view.camera(options.size), objects, world, how, passes, meshes, list(lamps)))


def poses(options: argparse.Namespace) -> list[list[Tile]]:
    """Objects at rest and bent: normals, and under two lights."""
    rows = []
    for name, turn, how in (("spot", 150, (60, 0.2)), ("robot", 30, (50, -0.25))):
        row: list[Tile] = []
        for title, pose in (("at rest", None), ("bent", how)):
            state = standing(name, 1.0, turn=turn, bent=pose)
            view = View(1.35, above=12.0)
            passes = ("Combined", "Normal", "Coverage")
            made = shown([state], LIGHTS["outdoors, bright"], view, options, passes=passes)
            share = np.clip(made["Coverage"], 0, 1)
            row.append((f"normals, {title}", (made["Normal"] / 2 + 0.5) * share + 1 - share))
            row.append((f"{title}, city", encoded(made["Combined"])))
            if pose is not None:
                made = shown([state], LIGHTS["sunset"], view, options)
                row.append((f"{title}, sunset", encoded(made["Combined"])))
        rows.append(row)
    return rows


def lights(options: argparse.Namespace) -> list[list[Tile]]:
    """A mesh-driven, a particle-driven and a thin object in the bright and the dim, outdoors and indoors."""
    fallen = standing("cat", 1.0, turn=-60)
    mesh = SESSION.asset(fallen.asset).mesh
    material = {"name": "jelly", "youngs_modulus": MODULUS, "density": 1000.0}
    low = float(mesh.vertices[:, 2].min())
    FOLDER.mkdir(parents=True, exist_ok=True)
    particles, vertices = simulated("gallery-cat", mesh, {"material": material}, FALLEN).driving(FALLEN)
    fallen = replace(fallen, vertices=np.ascontiguousarray(vertices, np.float32), particles=particles)
    fallen.matrix_world[2, 3] -= fallen.matrix_world[2, 2] * (float(vertices[:, 2].min()) - low)
    subjects = [
        ("mesh-driven", standing("robot", 1.0, turn=30, bent=(50, -0.25)), View(1.55)),
        ("particle-driven", fallen, View(1.35, 0.4)),
        ("thin", standing("fern", 0.5, turn=20, bent=(30, 0.5)), View(1.6, 0.2)),
    ]
    rows = []
    for about, state, view in subjects:
        row = []
        for title in ("outdoors, bright", "outdoors, dim", "indoors, bright", "indoors, dim"):
            made = shown([state], LIGHTS[title], view, options, floor=ground())
            row.append((f"{about}: {title}", encoded(made["Combined"])))
        rows.append(row)
    return rows


def lamp(x: float) -> Light:
    """A square light beside the scene."""
    place = np.array([x, -1.6, 2.4])
    return Light("lamp", "area", look_at(place, np.array([0, 0, 0.3])), power=200.0, size_x=0.4)


def composed(options: argparse.Namespace) -> list[list[Tile]]:
    """Four captures on a polished floor: a lamp from two sides, and all that they do to each other left out."""
    scene = [
        standing("robot", 1.0, -0.15, 0.3, 20), standing("cat", 0.75, 0.75, 0.05, -100),
        standing("spot", 0.55, 0.15, -0.55, 120), standing("fern", 0.35, -0.85, -0.25, 0),
    ]  # fmt: skip
    view, light = View(2.4, 0.35, above=19.0, shape=0.8), ("forest", 0.21)
    floor = ground(0.12, 0.3)
    alone = [replace(state, visibility=ALONE) for state in scene], replace(floor, visibility=ALONE)
    row = []
    for title, (states, plane), at, bounces in (
        ("lamp on the left", (scene, floor), -2.2, 3), ("lamp on the right", (scene, floor), 2.2, 3),
        ("without shadows and reflections", alone, 2.2, 0),
    ):  # fmt: skip
        made = shown(states, light, view, options, floor=plane, lamps=(lamp(at),), bounces=bounces)
        row.append((title, encoded(made["Combined"])))
    return [row]


def thin(options: argparse.Namespace) -> list[list[Tile]]:
    """A captured fern and a ball of fur that is given as surfels, relit."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    mesh, path = fur(), FOLDER / "fur.drgs"
    write_asset(path, Asset(surfels_of("fur", mesh), Mesh.empty()))
    ball = ObjectState("fur", SESSION.load_asset(path))
    rows = []
    for name, state, view, how in (
        ("fern", standing("fern", 0.5, turn=20), View(1.5, 0.2, above=30.0), {}),
        ("fur", ball, View(1.7), {"rays_see": "surfels"}),
    ):
        row = []
        for title, light in (("outdoors", "outdoors, bright"), ("sunset", "sunset")):
            made = shown([state], LIGHTS[light], view, options, floor=ground(), **how)
            row.append((f"{name}, {title}", encoded(made["Combined"])))
        rows.append(row)
    return rows


def photographed(state: ObjectState, light: tuple[str, float], options: argparse.Namespace) -> Path:
    """The asset of an object at rest with the colours that `DIRECTIONS` see on it, as of a capture without light."""
    asset = SESSION.asset(state.asset)
    scale = float(np.cbrt(np.linalg.det(state.matrix_world[:3, :3])))
    centre = asset.surfels.centre @ state.matrix_world[:3, :3].T + state.matrix_world[:3, 3]
    unknown = basis(np.zeros(3), 2).size
    left = np.tile(np.diag([1e-4] + [0.05] * (unknown - 1)), (len(centre), 1, 1))
    right, seen = np.zeros((len(centre), unknown, 3)), np.zeros(len(centre), bool)
    world = World(read_environment(environments() / f"{light[0]}.exr").radiance, strength=light[1])
    how = RenderSettings(options.samples, bounces=3, denoise="svgf", film_transparent=True)
    for k in range(DIRECTIONS):
        up, turn = 0.9 - 1.8 * (k + 0.5) / DIRECTIONS, np.pi * (1 + 5**0.5) * k
        target = np.array([0, 0, 0.5])
        eye = target + 3.2 * np.array([np.cos(turn) * (1 - up**2) ** 0.5, np.sin(turn) * (1 - up**2) ** 0.5, up])
        view = {"matrix_world": look_at(eye, target).tolist(), "fov_x": 28.0, "width": 160, "height": 160}
        camera = pinhole(view)
        passes = SESSION.render(Frame(1, camera, [state], world, how, ("Combined", "Position")))
        local = (centre - eye) @ camera.matrix_world[:3, :3]
        x, y = camera.cx - camera.fx * local[:, 0] / local[:, 2], camera.cy + camera.fy * local[:, 1] / local[:, 2]
        column, row = (np.clip(pixel.astype(int), 0, 159) for pixel in (x, y))
        colour, place = passes["Combined"][row, column], passes["Position"][row, column]
        met = (np.linalg.norm(place - centre, axis=1) < 0.03 * scale) & (colour[:, 3] > 0.98)
        away = unit(centre[met] - eye) @ state.matrix_world[:3, :3] / scale  # as the object has them
        values = basis(away, 2)
        left[met] += values[:, :, None] * values[:, None]
        right[met] += values[:, :, None] * (to_srgb(colour[met, None, :3]) - 0.5)
        seen |= met
    found = np.linalg.solve(left, right)
    found = found[seen][cKDTree(centre[seen]).query(centre)[1]].astype(np.float32)
    path = FOLDER / f"{state.name}-photographed.drgs"
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_asset(path, replace(asset, surfels=replace(asset.surfels, sh=found)))
    return path


def reflections(options: argparse.Namespace) -> list[list[Tile]]:
    """Polished metal that is bent and relit, without shadows and inter-reflection, and with colours that are baked."""
    rest, moved = (standing("spot", 1.0, turn=150, bent=how) for how in (None, (60, 0.2)))
    view = View(1.35, above=12.0)
    painted = replace(
        moved, asset=SESSION.load_asset(photographed(rest, LIGHTS["outdoors, bright"], options)), captured_colours=True
    )
    alone = replace(moved, visibility=ALONE)
    rows = []
    for title, light in (("city", "outdoors, bright"), ("sunset", "sunset")):
        row = []
        for about, state, bounces in (
            ("at rest", rest, 3), ("bent", moved, 3), ("bent, no shadows, no bounces", alone, 0),
            ("bent, colours of the day", painted, 3),
        ):  # fmt: skip
            made = shown([state], LIGHTS[light], view, options, bounces=bounces)
            row.append((f"{title}: {about}", encoded(made["Combined"])))
        rows.append(row)
    return rows


def variants(options: argparse.Namespace) -> list[list[Tile]]:
    """Surfels that are free, and on the mesh with and without what Algorithm 1 lets them learn: a view left out."""
    capture = read_capture(options.scenes / "spot", 200, 8)
    view, schedule = capture.testing[1], Schedule(iterations=1500, surfels=10000)
    training, _ = trained(capture, schedule, None)
    tiles = [("photograph", photograph(view, capture)), ("P: free", drawn(training.gaussians, view, capture))]
    tiles += [(name, drawn(gaussians, view, capture)) for name, gaussians, _ in on_mesh(training, capture, schedule)]
    return [tiles[:3], tiles[3:]]


PARTS: dict[str, Callable[[argparse.Namespace], list[list[Tile]]]] = {
    "composed": composed, "lights": lights, "poses": poses, "reflections": reflections, "thin": thin,
    "variants": variants,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=[part for part in PARTS if part != "variants"])
    parser.add_argument("--scenes", type=Path, help="folder with spot, for variants")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=128)
    add_publish(parser)
    options = parser.parse_args()
    for part in options.part:
        if part == "variants" and options.scenes is None:
            parser.error("--part variants needs --scenes")
        print(f"{part}: renders, some minutes", flush=True)
        sheet(part, PARTS[part](options), options)


if __name__ == "__main__":
    main()
