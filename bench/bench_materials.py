"""Materials, worlds and meshes as Blender shows them: small scenes against Cycles, one per feature, and two of many.

python bench/bench_materials.py [--size 192] [--seeds 2] [--spp 512] [--samples 1024] [--scenes NAME ...]

With --scenes the other rows of the section stay as they are.

Both pictures come out of Blender, ours through the extension, from one file (`composed_job.py`, `material_scenes.py`).
"""

from __future__ import annotations

import argparse
import re

import numpy as np
from bench_composed import BOUNCES, compare, options_of
from judge import psnr, systematic_error, without_noise
from report import DOCUMENT, section_pattern, table, write_section
from scipy.ndimage import binary_erosion

SCENES = {
    "helmet": "a glTF file: normal, metallic and roughness maps, five materials, lenses of alpha",
    "statue": "a glTF file: gilded, normal map; 128 sub-pixel samples",
    "normal_map": "normal map, strength .8",
    "bump": "heights",
    "colours": "colour attribute of corners, float attribute of points as roughness",
    "coordinates": "images by object and generated coordinates",
    "leaves": "cards with cut-out leaves",
    "veil": "alpha as a number, Mix with Transparent BSDF",
    "sky": "Sky Texture with its sun",
    "procedural_world": "World of noise and a colour ramp",
    "procedural": "Voronoi cells as colour, noise as roughness",
    "procedural_bump": "Voronoi cells and noise as heights",
    "forest": "all at once: leaves, statue, captured object, sky",
    "workshop": "all at once: helmet, bumps, cells, captured object, four lamps, World of noise",
    "coat": "coats: clear, rough and tinted",
    "sheen": "sheen over cloth, Sheen BSDF",
    "glass": "smooth glass, IOR 1.33 to 2.4",
    "rough_glass": "frosted glass, half glass",
    "thin_glass": "a pane of glass",
    "anisotropy": "brushed metals",
    "metals": "Multiscatter GGX: rough metals, one half",
    "specular": "IOR, specular level and tint, rough Diffuse BSDF",
    "glass_nodes": "Glass, Refraction and Glossy BSDF",
    "translucent": "Translucent BSDF, mixed with Diffuse",
    "mixes": "Mix and Add of unlike BSDFs",
    "udim": "UDIM: a tiled image of four tiles",
    "sequence": "image sequence at a frame: start, offset, cyclic",
    "movie": "a movie's frame",
    "interpolation": "image interpolation: Closest, Linear, Cubic",
    "extension": "image extension: Repeat, Extend, Clip, Mirror",
    "light_linking": "light linking of a spot, an area light, a mesh that emits",
    "shadow_linking": "shadow linking of a sun, a lamp, a mesh that emits",
    "light_groups": "light groups of a lamp, the sky, a mesh that emits",
    "light_passes": "passes of light and of surface colours (8 bounces in both)",
    "equirectangular": "panoramic camera: equirectangular",
    "equidistant": "panoramic camera: equidistant fisheye, 200 degrees",
    "equisolid": "panoramic camera: equisolid fisheye, 10 mm",
    "motion_blur": "motion blur of what moves, turns and grows",
    "deform_blur": "motion blur of a shape key",
    "depth_of_field": "depth of field, aperture of five blades",
    "subsurface": "subsurface scattering (Christensen-Burley) over 1 mm: its diffuse limit, which is what we render",
    "painted_light": "DR-GS object, painted opacity and emission",
    "painted_lobes": "DR-GS object, painted coat and specular",
    "terminator": "coarse smooth meshes with Blender's own shadow terminator offset",
    "hair": "particle hair with children, hair curves, captured object",
}
_LOBES = ("Diffuse", "Glossy", "Transmission")
#: Scenes of which passes are compared; the worst one is in the table.
PASSES = {
    "light_groups": ("Combined_lamps", "Combined_sky", "Combined_glow"),
    "light_passes": (*(f"{lobe} {part}" for lobe in _LOBES for part in ("Direct", "Indirect", "Color")), "Emission"),
}
TITLE = "Materials and worlds against Cycles"
#: A run of some scenes, as the section has it; its group is these.
_RUN = re.compile(r"\n\nRows [^\n]*:\n\n`[^`\n]*--scenes ([^`\n]*)`[^\n]*")


def main() -> None:
    """Measure and write the section."""
    options = options_of(__doc__ or "", SCENES, seeds=2, spp=512, samples=1024)
    rows = compare(options, row, "materials", "material_scenes", PASSES)
    if options.scenes == list(SCENES):
        write_section("materials", TITLE, report(options, rows))
    elif section := section_pattern("materials").search(DOCUMENT.read_text(encoding="utf-8")):
        if f"{options.size} x {options.size}" not in section[0] or f"mean of {options.seeds} with" not in section[0]:
            raise SystemExit("the section was measured with another --size or --seeds: its rows are kept")
        write_section("materials", TITLE, replaced(section[0], rows, f"{options.spp} and {options.samples} samples"))


def row(name: str, ours: np.ndarray, theirs: np.ndarray) -> tuple[str, ...]:
    """A scene's line of the table; of several passes that of the worst."""
    passes = PASSES.get(name, ("",))
    tiles = zip(*(np.split(pictures, len(passes), axis=2) for pictures in (ours, theirs)), strict=True)
    found = [figures(*pair) for pair in tiles]
    for of_pass, (_, *cells) in zip(passes, found, strict=True):
        print(of_pass, *cells)
    worst, (_, *cells) = max(enumerate(found), key=lambda item: item[1][0])
    more = f": the worst of {len(passes)}, {passes[worst]}" if len(passes) > 1 else ""
    return name, SCENES[name] + more, *map(str, cells)


def figures(ours: np.ndarray, theirs: np.ndarray) -> tuple[float | str, ...]:
    """The most that a picture's systematic error may be, and its cells; of the pixels where Cycles shows something."""
    mask = binary_erosion(theirs[..., 3].min(0) > 0.999, iterations=2)
    error, deviation = systematic_error(ours, theirs, mask)
    a, b = ours.mean(0), theirs.mean(0)
    light = a[mask][:, :3].mean() / b[mask][:, :3].mean() - 1
    return (
        max(error, 0) + 2 * deviation,
        without_noise(error, deviation),
        f"{psnr(a, b, mask):.2f}",
        f"{light:+.2%}",
        f"{psnr(theirs[0], theirs[1], mask):.1f}",
    )


def replaced(section: str, rows: list[tuple[str, ...]], samples: str) -> str:
    """The text of a section with these rows, in place of its own or where the order of `SCENES` has them.

    Rows that were measured with other numbers of samples than the section say so. Runs of which no row is left go.
    """
    lines = section.splitlines()[2:-1]  # neither its marks nor its title
    old = {name: line for line in lines if line.startswith("| ") and (name := line.split(" | ")[0][2:]) in SCENES}
    first = lines.index(next(iter(old.values())))
    lines = lines[:first] + [line for line in lines[first:] if line not in old.values()]
    note = "" if "of {} spp and {}".format(*samples.split()[::2]) in section else f" ({samples})"
    for name, what, *cells in rows:
        old[name] = "| " + " | ".join([name, what + note, *cells]) + " |"
    lines[first:first] = [old[name] for name in SCENES if name in old]
    again = f"Rows that name {samples}:" if note else "Rows measured alone:"
    measured = {name for name, *_ in rows}
    text = _RUN.sub(lambda run: "" if measured.issuperset(run[1].split()) else run[0], "\n".join(lines))
    return f"{text}\n\n{again}"


def report(options: argparse.Namespace, rows: list[tuple[str, ...]]) -> str:
    """The text of the section."""
    columns = ("Scene", "", "No noise, dB", "PSNR dB", "Mean light", "Cycles itself")
    return (
        f"Foreground PSNR in sRGB (mask of Cycles, eroded by 2 px), {options.size} x {options.size}, of .blend files "
        "rendered by Cycles of bpy 5.0.1 and through the extension, *Camera Sees: Mesh*, 16 sub-pixel samples, "
        f"{BOUNCES} bounces in both. Each picture is the mean of {options.seeds} with independent random numbers, of "
        f"{options.spp} spp and {options.samples} samples. Cycles' clamps are off, and its shadow terminator "
        "offsets but in `terminator`. "
        "*No noise* and *Cycles itself* as in the section on parity.\n\n" + table(columns, rows)
    )


if __name__ == "__main__":
    main()
