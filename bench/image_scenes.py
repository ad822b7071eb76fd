"""Small scenes for bench_materials.py: images as Blender's Image Texture node shows them; see material_scenes.py."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from bsdf_scenes import stage
from composed_job import finish, monkey
from scene_nodes import look, node, painted_image

Array = np.ndarray


def files(job: dict) -> Path:
    """The folder of the images that a scene is given as files."""
    folder = Path(job["blend"]).with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def pattern(kind: int, size: int = 64) -> Array:
    """(size, size, 3) in [0, 1]: colours and stripes, rings or tiles, other ones for every number."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size * 2 - 1
    waves = (np.sin(9 * x + 2 * y), np.sin(14 * np.hypot(x, y)), np.sign(np.sin(7 * x) * np.sin(7 * y)), np.sin(11 * y))
    share = 0.5 + 0.4 * waves[kind % 4][..., None]
    first, second = np.random.default_rng(40 + kind).uniform(0.05, 0.95, (2, 3))
    return share * first + (1 - share) * second


def save(pixels: Array, path: Path) -> Path:
    """A PNG of (h, w, 3) values."""
    image = painted_image("Written", pixels, True)
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    bpy.data.images.remove(image)
    return path


def cards(*names: str, size: float = 0.7, height: float = 0.4) -> list[bpy.types.Object]:
    """Upright squares in a row on the stage, one for each material."""
    made = []
    for i, name in enumerate(names):
        place = ((size + 0.06) * (i - (len(names) - 1) / 2), 0, height)
        bpy.ops.mesh.primitive_plane_add(size=size, location=place, rotation=(math.pi / 2, 0, 0.15))
        made.append(finish(f"Card {i}", bpy.data.materials[name]))
    return made


def pictured(name: str, image: bpy.types.Image, **settings: object) -> bpy.types.Node:
    """A material that shows an image; its Image Texture node."""
    tree, principled = look(name, Roughness=0.6)
    made = node(tree, "TexImage", image=image, **settings)
    tree.links.new(made.outputs["Color"], principled.inputs["Base Color"])
    return made


def spread_uvs(obj: bpy.types.Object, scale: float, shift: float = 0.0) -> None:
    """Stretch a UV map over other tiles, or over an image's borders."""
    layer = obj.data.uv_layers.active.uv
    values = np.empty(2 * len(layer), np.float32)
    layer.foreach_get("vector", values)
    layer.foreach_set("vector", values * scale + np.float32(shift))


def udim(job: dict) -> None:
    """Four tiles on a card and on Suzanne."""
    numbers = (1001, 1002, 1011, 1012)
    for i, number in enumerate(numbers):
        save(pattern(i), files(job) / f"tile.{number}.png")
    image = bpy.data.images.load(str(files(job) / "tile.1001.png"))
    image.source, image.filepath = "TILED", str(files(job) / "tile.<UDIM>.png")
    for number in numbers:
        if number not in {tile.number for tile in image.tiles}:
            image.tiles.new(number)
    pictured("Tiled", image)
    (card,) = cards("Tiled", size=1.1, height=0.56)
    card.location.x = -0.6
    for obj in (card, monkey("Monkey", "Tiled", (0.6, 0, 0.55))):
        spread_uvs(obj, 2.0)
    stage()


def sequence(job: dict) -> None:
    """Frame 4 of a sequence by start and offset, cyclic and not."""
    for i in range(5):
        save(pattern(i), files(job) / f"take_{i + 1:04d}.png")
    for name, start, offset, cyclic in (("First", 3, 1, False), ("Second", 2, 2, False), ("Third", 1, 0, True)):
        image = bpy.data.images.load(str(files(job) / "take_0001.png"))
        image.source = "SEQUENCE"
        user = pictured(name, image).image_user
        user.frame_duration, user.frame_start, user.frame_offset = 3, start, offset
        user.use_cyclic, user.use_auto_refresh = cyclic, True
    cards("First", "Second", "Third")
    bpy.context.scene.frame_set(4)
    stage()


def movie(job: dict) -> None:
    """Frame 3 of a movie."""
    film = bpy.data.scenes.new("Film")
    stills = [save(pattern(i), files(job) / f"still_{i}.png") for i in range(4)]
    editor = film.sequence_editor_create()
    strip = editor.strips.new_image("Stills", str(stills[0]), 1, 1)
    for still in stills[1:]:
        strip.elements.append(still.name)
    strip.frame_final_duration = len(stills)
    film.frame_start, film.frame_end = 1, len(stills)
    film.view_settings.view_transform = "Standard"
    render = film.render
    render.resolution_x = render.resolution_y = 64
    render.image_settings.media_type, render.image_settings.file_format = "VIDEO", "FFMPEG"
    render.ffmpeg.format, render.ffmpeg.codec, render.ffmpeg.constant_rate_factor = "AVI", "FFV1", "LOSSLESS"
    render.use_file_extension, render.filepath = False, str(files(job) / "movie.avi")
    bpy.ops.render.render(animation=True, scene=film.name)
    bpy.data.scenes.remove(film)
    image = bpy.data.images.load(str(files(job) / "movie.avi"))
    user = pictured("Film", image).image_user
    user.frame_duration, user.frame_start, user.frame_offset, user.use_auto_refresh = 4, 1, 0, True
    (card,) = cards("Film", size=1.1, height=0.56)
    card.location.x = -0.6
    monkey("Monkey", "Film", (0.6, 0, 0.55))
    bpy.context.scene.frame_set(3)
    stage()


def interpolation(job: dict) -> None:
    """Twelve texels across, as Closest, Linear and Cubic show them."""
    coarse = painted_image("Coarse", np.random.default_rng(9).uniform(0.1, 0.9, (12, 12, 3)), True)
    for kind in ("Closest", "Linear", "Cubic"):
        pictured(kind, coarse, interpolation=kind)
    cards("Closest", "Linear", "Cubic")
    stage()


def extension(job: dict) -> None:
    """What lies beyond an image: all four ways."""
    image = painted_image("Rings", pattern(0), True)
    kinds = ("REPEAT", "EXTEND", "CLIP", "MIRROR")
    for kind in kinds:
        pictured(kind, image, extension=kind)
    for card in cards(*kinds, size=0.52, height=0.3):
        spread_uvs(card, 2.2, -0.7)
    stage()


IMAGES: dict[str, Callable[[dict], None]] = {
    made.__name__: made for made in (udim, sequence, movie, interpolation, extension)
}
