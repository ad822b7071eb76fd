"""The page on scripting: its examples do what they promise, and its tables name what is registered."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import blender_reference
import bpy
import numpy as np
import pytest
from doc_blocks import blocks
from physics_scenes import cache_of
from scenes import PACKAGE, ROOT, part, read_exr, write_ball, write_exr
from test_motion import READ

pytestmark = pytest.mark.blender_api

PAGE = (ROOT / "docs" / "scripting.md").read_text(encoding="utf-8")
WIDTH, HEIGHT = 160, 120
#: A script as a Blender with factory settings runs it: the page says how it begins and, in the module, ends.
FRESH = f"""
import os, sys, bpy
bpy.ops.preferences.addon_enable(module="{PACKAGE}")
code = 0
try:
    exec(open(sys.argv[1], encoding="utf-8").read(), {{"__name__": "__main__"}})
except SystemExit as end:
    code = end.code
bpy.ops.preferences.addon_disable(module="{PACKAGE}")
sys.stdout.flush()
os._exit(code)
"""


def examples(page: str) -> dict[str, str]:
    """Headings of the examples, and the block of Python below each."""
    parts = re.split(r"^### (.+)\n", page, flags=re.MULTILINE)[1:]
    found = {}
    for title, text in zip(parts[::2], parts[1::2]):
        (found[title],) = (code for language, code in blocks(text) if language == "python")
    return found


EXAMPLES = examples(PAGE)


def source(beginning: str, folder: Path) -> str:
    """The example whose heading begins so, for a folder."""
    (title,) = [t for t in EXAMPLES if t.startswith(beginning)]
    return EXAMPLES[title].replace("/shots", folder.as_posix())


def run(beginning: str, folder: Path) -> dict:
    """Run an example; returns its names."""
    names = {"__name__": "__main__"}
    exec(compile(source(beginning, folder), beginning, "exec"), names)
    return names


@pytest.fixture
def shots(tmp_path):
    """Folder of an example, with an asset and an image of light: grey, and bright in one direction."""
    radiance = np.full((8, 16, 3), 0.2, np.float32)
    radiance[1:4, 10:13] = 8.0
    write_ball(tmp_path / "toy.drgs", radiance)
    write_exr(tmp_path / "studio.exr", radiance)
    return tmp_path


def picture(path: Path) -> np.ndarray:
    """(h, w, 4) float32 as displayed."""
    return read_exr(path, WIDTH, HEIGHT)


def seen(pixels: np.ndarray) -> np.ndarray:
    """(h, w) bool, where there is something before an even background."""
    return np.abs(pixels - np.median(pixels[:4], axis=(0, 1))).max(axis=2) > 0.08


def vertices(obj) -> np.ndarray:
    """(n, 3) in the world, as evaluated in the present frame."""
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    matrix = np.array(evaluated.matrix_world)
    return part("addon.mesh_arrays").read_vertices(evaluated.data) @ matrix[:3, :3].T + matrix[:3, 3]


def read_asset(path: Path):
    return part("drgs_blender.core.asset.container").read_asset(path)


def test_a_still_is_rendered(shots):
    run("Import and render", shots)
    ball = seen(picture(shots / "still.png"))
    assert 0.75 * HEIGHT < ball.any(axis=1).sum() < HEIGHT, "it fills the picture"
    assert ball[HEIGHT // 2, WIDTH // 2] and not ball[:, :8].any() and not ball[:, -8:].any()


def test_the_light_is_turned(shots):
    names = run("Light it", shots)
    front, back = (picture(shots / f"light_{degrees:03}.png") for degrees in (0, 180))
    middle = np.s_[50:70, 70:90]
    assert front[..., 3][middle].min() > 0.9 and front[:4, :4, 3].max() == 0
    assert front[..., :3][middle].mean() > 1.5 * back[..., :3][middle].mean()
    (background,) = [n for n in names["scene"].world.node_tree.nodes if n.type == "BACKGROUND" and n.outputs[0].links]
    assert background.inputs["Strength"].default_value == 1.5


def test_an_armature_bends_it_from_frame_to_frame(shots):
    names = run("Bind to an armature", shots)
    assert [p.name for p in sorted((shots / "nod").iterdir())] == ["0001.png", "0002.png", "0003.png"]
    first, last = (picture(shots / "nod" / f"000{n}.png") for n in (1, 3))
    assert np.abs(first - last).max() > 0.1
    found = []
    for frame in (1, 3):
        names["scene"].frame_set(frame)
        found.append(vertices(names["toy"]))
    moved = np.linalg.norm(found[1] - found[0], axis=1)
    assert moved[found[0][:, 2] > 0.6].min() > 0.2 > 0.05 > moved[found[0][:, 2] < -0.9].max()


def test_a_part_is_gold_then_tinted_by_keyframes(shots):
    toy = run("Materials", shots)["toy"]
    metallic = part("addon.mesh_arrays").read_channel(toy.data, "metallic")
    upper = np.array([v.co.z for v in toy.data.vertices]) > 0
    assert (metallic[upper] == 1).all() and (metallic[~upper] < 1).all()
    gold, blue = (picture(shots / f"gold_{n:04}.png") for n in (1, 2))
    middle = np.s_[30:90, 70:90]
    assert (gold[..., 0] - gold[..., 2])[middle].mean() > 0.05 and (blue[..., 0] - blue[..., 2])[middle].max() < -0.05


def test_a_lattice_and_a_cage_bend_two(shots):
    names = run("Bend by", shots)
    bent, pulled = vertices(names["bent"]), vertices(names["pulled"])
    assert bent[:, 0].max() > 1.05 and bent[:, 2].max() == pytest.approx(1, abs=0.01)
    assert pulled[:, 2].max() > 1.3 and pulled[:, 2].min() == pytest.approx(-1, abs=0.05)
    assert names["cage"].hide_render and names["lattice"].type == "LATTICE"
    columns = seen(picture(shots / "bent.png")).any(axis=0)
    assert np.count_nonzero(np.diff(np.flatnonzero(columns)) > 1) == 1, "two objects with a gap between them"


@pytest.mark.slow
def test_matter_falls_on_the_floor(shots):
    names = run("Simulate", shots)
    toy, scene = names["toy"], names["scene"]
    assert cache_of(toy).frames() == list(range(1, 9)) and toy.drgs.physics.frame_end == 8
    assert vertices(toy)[:, 2].mean() < -0.05 and vertices(toy)[:, 2].min() > -1.2
    assert seen(picture(shots / "drop.png")).mean() > 0.1
    bpy.ops.wm.open_mainfile(filepath=str(shots / "drop.blend"))
    scene, toy = bpy.context.scene, bpy.data.objects["toy"]
    scene.frame_set(8)
    assert vertices(toy)[:, 2].mean() < -0.05, "the saved file plays the frames"


@pytest.mark.slow
def test_a_mesh_becomes_an_object_of_its_own(shots):
    names = run("Convert", shots)
    made, ring = names["made"], names["ring"]
    assert made.drgs.is_drgs and Path(bpy.path.abspath(made.drgs.path)) == shots / "ring.drgs"
    assert ring.hide_render and tuple(made.location) == (0, 0, 1)
    mesh = read_asset(shots / "ring.drgs").mesh
    np.testing.assert_allclose(mesh.albedo.mean(axis=0), (0.8, 0.05, 0.05), atol=0.01)
    assert (shots / "ring.blend").is_file()


@pytest.mark.slow
def test_splats_a_mesh_and_baked_light_are_written(shots):
    toy = run("Export", shots)["toy"]
    head = (shots / "toy.ply").read_bytes().partition(b"end_header")[0].decode()
    assert f"element vertex {len(read_asset(shots / 'toy.drgs').surfels.centre)}\n" in head and "f_dc_0" in head
    assert (shots / "toy.glb").read_bytes()[:4] == b"glTF"
    light = np.empty(4 * len(toy.data.vertices), np.float32)
    toy.data.attributes["relit"].data.foreach_get("color", light)
    light = light.reshape(-1, 4)[:, :3].mean(axis=1)
    assert light.min() > 0 and light.max() > 2 * light.min()
    bpy.ops.wm.open_mainfile(filepath=str(shots / "baked.blend"))
    assert "relit" in bpy.data.objects["toy"].data.attributes


def test_passes_of_two_objects_are_in_one_file(shots):
    run("Passes", shots)
    arrays = shots / "passes.npz"
    subprocess.run([os.environ["DRGS_ENGINE"], "-c", READ, shots / "passes.exr", arrays], check=True, timeout=100)
    found = dict(np.load(arrays))
    assert {"Combined", "Normal", "Albedo", "Roughness"} <= set(found)
    assert any(name.startswith("CryptoObject") for name in found)
    assert found["Combined"].shape[:2] == (HEIGHT, WIDTH) and np.isfinite(found["Combined"]).all()
    rows, half = slice(45, 75), WIDTH // 2
    left, right = (found["Albedo"][rows, columns].mean(axis=(0, 1)) for columns in (slice(half), slice(half, None)))
    assert np.abs(left - right).max() > 0.05, "the second one has another hue"
    assert bpy.context.scene.drgs.denoise == "svgf" and bpy.context.scene.drgs.samples == 32


@pytest.fixture
def folder(shots):
    """A folder of assets: one that is lit, one in the dark, and one that was cut off."""
    write_ball(shots / "dark.drgs")
    whole = (shots / "toy.drgs").read_bytes()
    (shots / "cut.drgs").write_bytes(whole[: len(whole) // 2])
    return shots


def check_folder(folder: Path, printed: str) -> None:
    """What a run leaves behind."""
    assert re.search(r"^cut\.drgs: ERROR: .*cut\.drgs", printed, re.MULTILINE)
    assert re.search(r"^dark\.drgs: WARNING: nothing lights the scene", printed, re.MULTILINE)
    assert not re.search(r"^toy\.drgs: ", printed, re.MULTILINE)
    names = sorted(p.name for p in (folder / "gold").iterdir())
    assert names == ["dark.drgs", "dark.png", "toy.drgs", "toy.png"]
    np.testing.assert_allclose(
        read_asset(folder / "gold" / "toy.drgs").mesh.metallic,
        0.8 + 0.2 * read_asset(folder / "toy.drgs").mesh.metallic,
        atol=0.01,
    )
    assert 0.2 < seen(picture(folder / "gold" / "toy.png")).mean() < 0.7


def test_a_folder_goes_through_and_its_code_says_what_failed(folder, capsys):
    with pytest.raises(SystemExit) as end:
        run("A folder", folder)
    assert end.value.code == 1
    check_folder(folder, capsys.readouterr().out)
    (folder / "cut.drgs").unlink()
    with pytest.raises(SystemExit) as end:
        run("A folder", folder)
    assert end.value.code == 0


@pytest.mark.slow
def test_a_fresh_blender_ends_with_the_code_of_a_script(folder):
    script = folder / "batch.py"
    script.write_text(source("A folder", folder), encoding="utf-8")
    done = subprocess.run([sys.executable, "-c", FRESH, script], capture_output=True, text=True, timeout=600)
    assert done.returncode == 1, done.stdout + done.stderr
    check_folder(folder, done.stdout)


def test_every_example_has_a_test():
    begun = tuple(re.findall(r'\brun\("([^"]+)", (?:shots|folder)\)', Path(__file__).read_text(encoding="utf-8")))
    assert len(EXAMPLES) == 10 and all(title.startswith(begun) for title in EXAMPLES)


def section(title: str) -> str:
    """What is below a heading of the page."""
    return re.split(r"^## ", PAGE.partition(f"\n## {title}\n")[2], flags=re.MULTILINE)[0]


def test_the_page_names_every_operator_and_no_other():
    listed = re.findall(r"`((?:drgs|import_scene)\.\w+)`", section("Operators"))
    assert sorted(listed) == list(blender_reference.operators(PACKAGE))
    used = set(re.findall(r"bpy\.ops\.((?:drgs|import_scene)\.\w+)", PAGE))
    assert used and used <= set(listed)


def test_the_page_names_every_property_and_no_other():
    listed: dict[str, list[str]] = {}
    for group, names in re.findall(r"^\| `([^`]+)` \| ([^|]+) \|", section("Properties"), re.MULTILINE):
        listed.setdefault(group, []).extend(re.findall(r"`(\w+)`", names))
    registered = {}
    for name, rna in blender_reference.groups(PACKAGE).items():
        own = [p for p in blender_reference.properties(rna) if not p.is_hidden]
        groups = {
            p.identifier for p in own if p.type == "POINTER" and blender_reference.own_group(p.fixed_type, PACKAGE)
        }
        key = "preferences" if name.startswith("preferences") else re.sub("^object", "obj", name)
        registered[key] = sorted({p.identifier for p in own} - groups)
    assert {group: sorted(names) for group, names in listed.items()} == registered


def test_the_page_names_every_value_and_no_other():
    listed = {}
    for owner, name, values in re.findall(r"^\| `([^`]+)` \| `(\w+)` \| ([^|]+) \|", section("Values"), re.MULTILINE):
        listed[owner, name] = re.findall(r"`([^`]+)`", values)
    owners = {re.sub("^object", "obj", name): rna for name, rna in blender_reference.groups(PACKAGE).items()}
    owners |= {f"bpy.ops.{name}": rna for name, rna in blender_reference.operators(PACKAGE).items()}
    registered = {
        (owner, p.identifier): [item.identifier for item in p.enum_items]
        for owner, rna in owners.items()
        for p in blender_reference.properties(rna)
        if p.type == "ENUM" and not p.is_hidden
    }
    assert listed == registered
