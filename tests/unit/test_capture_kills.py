"""`drgs capture` that is killed or stopped at each stage goes on when the same command is given again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_capture_photographs import BOX, HEIGHT, TABLE, held

from drgs_blender.capture.world_alignment import similarity
from drgs_blender.reconstruct.readers import read_capture

ROOT = Path(__file__).resolve().parents[2]
SIZE, FOCAL, COUNT = (320, 240), 340.0, 9

#: Runs the command of argv once for each ending: at a call of a phase, or before a file gets its name. Forks share what
#: is imported. It prints, for each run, how it ended and (phase, part) of all its calls. All on one core: threads work
#: in any order, by which focal lengths of two runs on a busy machine have differed by 5e-4.
PROGRAM = """
import json, os, signal, sys
from pathlib import Path
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from drgs_blender.capture import features, libraries, pipeline
from drgs_blender.cli import capture, main
libraries.load("pycolmap")
features._BATCH, features._PAIRS = 3, 12
make = pipeline.make_capture

def run(words, phase, calls, number):
    seen = []

    def told(source, folder, settings, tell, cancelled):
        def tell_and_end(now, part):
            seen.append((now, round(part, 4)))
            log.write_text(json.dumps(seen))
            tell(now, part)
            if sum(name == now for name, _ in seen) == calls and now == phase:
                os.kill(os.getpid(), number)
        return make(source, folder, settings, tell_and_end, cancelled)

    def replace(old, new):
        if Path(new).name == phase:
            os.kill(os.getpid(), number)
        rename(old, new)

    rename, os.replace, pipeline.make_capture = os.replace, replace, told
    return main.main(words)

log = Path(sys.argv[1])
for words, phase, calls, number in json.loads(sys.argv[2]):
    log.write_text("[]")
    if not (child := os.fork()):
        os._exit(run(words, phase, calls, number))
    status = os.waitpid(child, 0)[1]
    print(json.dumps([os.waitstatus_to_exitcode(status), json.loads(log.read_text())]), flush=True)
"""

#: Phase or file, the how many-th call of it, the signal; in the order of the work.
KILL = int(signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
ENDINGS = (
    ("reading pictures", 4, KILL),
    ("photo_6.jpg", 1, KILL),  # a working copy
    ("finding features", 2, KILL),
    ("finding features", 2, int(signal.SIGINT)),
    ("matching features", 2, KILL),
    ("matching features", 2, int(signal.SIGTERM)),
    ("incremental mapping", 4, KILL),
    ("adjusting cameras", 1, KILL),
    ("capture.png", 1, KILL),
    ("transforms.json", 1, KILL),
)


def photograph(matrix: np.ndarray, textures: list[np.ndarray]) -> np.ndarray:
    """(h, w, 3) uint8: a box on a table with squares on it, at the corners of pixels, without light."""
    width, height = SIZE
    x, y = np.meshgrid(np.arange(2 * width) / 2 + 0.25, np.arange(2 * height) / 2 + 0.25)
    rays = np.stack([(x - width / 2) / FOCAL, (height / 2 - y) / FOCAL, -np.ones_like(x)], -1) @ matrix[:3, :3].T
    shown, nearest = np.full(rays.shape, 200.0), np.full(x.shape, np.inf)
    faces = [(2, 0.0, TABLE), (2, HEIGHT, BOX), *((axis, side, BOX) for axis in (0, 1) for side in (-BOX, BOX))]
    for (axis, place, half), texture in zip(faces, textures, strict=True):
        depth = (place - matrix[axis, 3]) / rays[..., axis]
        point = matrix[:3, 3] + depth[..., None] * rays
        u, v = (point[..., other] for other in range(3) if other != axis)
        low, high = (-half, half) if axis == 2 else (0.0, HEIGHT)
        hit = (depth > 0) & (depth < nearest) & (abs(u) <= half) & (v >= low) & (v <= high)
        rows, columns = (v - low) / (high - low), (u + half) / (2 * half)
        cells = [np.minimum(part[hit] * len(texture), len(texture) - 1).astype(int) for part in (rows, columns)]
        shown[hit], nearest[hit] = texture[cells[0], cells[1]], depth[hit]
    return shown.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).astype(np.uint8)


def squares(seed: int, side: int) -> np.ndarray:
    """(side, side, 3): squares of several sizes, which look alike nowhere."""
    random, found = np.random.default_rng(seed), np.full((side, side, 3), 128.0)
    for cells in (side // 16, side // 8, side // 4):
        found += 60 * (random.random((cells, cells, 3)) - 0.5).repeat(side // cells, 0).repeat(side // cells, 1)
    return found.clip(0, 255)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_a_capture_that_is_killed_at_each_stage_ends_as_one_that_is_not(tmp_path):
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    photographs, undisturbed, out = (tmp_path / name for name in ("photographs", "undisturbed", "out"))
    photographs.mkdir()
    textures = [squares(0, 1024), *(squares(k, 128) for k in range(1, 6))]
    for k in range(COUNT):
        Image.fromarray(photograph(held(k), textures)).save(photographs / f"photo_{k}.jpg", quality=95)
    words = ["capture", str(photographs), "--masks", "none", "--feature-resolution", "320", "--poses", "features", "-q"]
    runs = [([*words, "--out", str(undisturbed)], "", 0, 0)]
    runs += [([*words, "--out", str(out)], *ending) for ending in (*ENDINGS, ("", 0, 0))]
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "log"), json.dumps(runs)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, cwd=ROOT)
    ended = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    codes = {int(signal.SIGINT): 130, int(signal.SIGTERM): 143, KILL: -KILL}
    assert [code for code, _ in ended] == [0, *(codes[number] for _, _, number in ENDINGS), 0], done.stderr[-2000:]
    # what was done is not done again
    for phase in ("finding features", "matching features"):
        begun = [next((part for name, part in calls if name == phase), None) for _, calls in ended[1:]]
        reached = [part for part in begun if part is not None]
        assert reached == sorted(reached) and reached[0] < reached[1] < reached[2] == reached[-1], (phase, begun)
    # and the result is that of an undisturbed run but for the heading, which nothing decides, with nothing beside it
    assert len(list((out / "images").iterdir())) == COUNT
    listed = [{path.relative_to(folder) for path in folder.rglob("*")} for folder in (out, undisturbed)]
    assert listed[0] == listed[1]
    ours, wanted = ({view.name: view.camera for view in read_capture(folder).views} for folder in (out, undisturbed))
    assert ours.keys() == wanted.keys()
    assert ours["photo_0"].fx == pytest.approx(wanted["photo_0"].fx, rel=1e-4)
    places = [np.stack([cameras[name].matrix_world[:3, 3] for name in wanted]) for cameras in (ours, wanted)]
    scale, rotation, shift = similarity(*places)
    assert np.abs(scale * places[0] @ rotation.T + shift - places[1]).max() < 1e-4
    assert scale == pytest.approx(1, abs=1e-4) and rotation[2, 2] == pytest.approx(1, abs=1e-4)
