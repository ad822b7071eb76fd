"""What is written for farm managers."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from drgs_blender.cli.farm import flamenco
from drgs_blender.cli.farm.job import Job
from drgs_blender.cli.frame_lines import FrameLines
from drgs_blender.cli.frame_range import cut_frames, parse_frames, write_frames
from drgs_blender.core.errors import UsageError

node = pytest.mark.skipif(not shutil.which("node"), reason="node runs the job type")

#: What Flamenco's own tests say of its function frameChunker.
CHUNKS = {
    ("1-10,20-25,40", 4): ["1-4", "5-8", "9,10,20,21", "22-25", "40"],
    (" 1  .. 10,\t20..25\n,40   ", 4): ["1-4", "5-8", "9,10,20,21", "22-25", "40"],
    ("47", 4): ["47"],
    ("1-3", 3): ["1-3"],
}

#: Stands for what a Manager gives to a job type, and prints the tasks.
MANAGER = """
const fs = require("fs"), vm = require("vm");
const input = JSON.parse(fs.readFileSync(0, "utf8"));
const tasks = [];
function frameChunker(range, size) {
    const frames = new Set();
    for (const part of range.replaceAll("..", "-").split(",")) {
        const ends = part.split("-").map(text => parseInt(text.trim()));
        if (ends.length > 2 || ends.some(isNaN)) throw "invalid range " + part;
        for (let frame = ends[0]; frame <= ends[ends.length - 1]; frame++) frames.add(frame);
    }
    const sorted = [...frames].sort((a, b) => a - b), chunks = [];
    for (let i = 0; i < sorted.length; i += size) {
        const chunk = sorted.slice(i, i + size), terms = [];
        for (let a = 0, b; a < chunk.length; a = b + 1) {
            for (b = a; chunk[b + 1] === chunk[b] + 1;) b++;
            terms.push(b - a > 1 ? chunk[a] + "-" + chunk[b] : chunk.slice(a, b + 1).join(","));
        }
        chunks.push(terms.join(","));
    }
    return chunks;
}
const world = {
    frameChunker: frameChunker,
    print: function () {},
    author: {
        Task: (name, type) => ({
            name: name, type: type, commands: [], after: [],
            addCommand: function (command) { this.commands.push(command); },
            addDependency: function (task) { this.after.push(task.name); },
        }),
        Command: (name, parameters) => ({name: name, parameters: parameters}),
    },
};
vm.createContext(world);
if (input.chunk) {
    console.log(JSON.stringify(frameChunker(input.chunk[0], input.chunk[1])));
} else {
    vm.runInContext(input.script + "\\nthis.JOB_TYPE = JOB_TYPE; this.compileJob = compileJob;", world);
    world.compileJob({settings: input.settings, addTask: task => tasks.push(task)});
    console.log(JSON.stringify({type: world.JOB_TYPE, tasks: tasks}));
}
"""


def manager(**given: object) -> object:
    """What the stand-in of a Flamenco Manager answers."""
    result = subprocess.run(
        ["node", "-e", MANAGER], input=json.dumps(given), capture_output=True, text=True, timeout=30
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def make_job(**changes: object) -> Job:
    given = {
        "name": "shot", "scene": Path("/p/shot.blend"), "frames": [1, 2, 3, 4, 5], "out": "/p/f/####.exr",
        "clean": None, "chunk": 2, "options": ("--samples", "8"), "program": ("drgs",),
    }  # fmt: skip
    return Job(**given | changes)


def test_frames_survive_being_written(n=300):
    rng = random.Random(3)
    for _ in range(n):
        frames = list(dict.fromkeys(rng.choices(range(-20, 60), k=rng.randrange(1, 30))))
        assert parse_frames(write_frames(frames)) == frames
    assert write_frames(range(1, 25)) == "1-24"
    assert write_frames([1, 3, 5, 30, 31]) == "1-5:2,30,31"
    assert write_frames([3, 2, 1, -5]) == "3-1:-1,-5"
    assert cut_frames([1, 2, 3, 4, 5], 2) == [[1, 2], [3, 4], [5]]


@pytest.mark.parametrize(
    "options",
    [
        ["--options=--samples many"],
        ["--options=--frames 7"],
        ["--options=--out x.exr"],
        ["--options='--samples"],
        ["--frames", "1..0"],
        ["--denoised", "f/####.exr"],
    ],
)
def test_what_a_node_would_refuse_is_refused_here(drgs, tmp_path, options):
    (tmp_path / "a.blend").touch()
    job = ["submit", "slurm", tmp_path / "a.blend", "--frames", "1-2", "--out", "f/####.exr", "--no-check"]
    assert drgs(*job, "--to", tmp_path / "job", *options)[0] == 64
    assert not (tmp_path / "job").exists()


@pytest.mark.parametrize("place", ["--sbatch=--partition=farm\ntouch ran", "--to=job\ntouch ran"])
def test_line_breaks_become_no_lines_of_the_script(drgs, tmp_path, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.blend").touch()
    job = ["submit", "slurm", "a.blend", "--frames", "1-2", "--out", "f/####.exr", "--no-check", "--to", "job"]
    code, _, error = drgs(*job, place)
    assert code == 64 and "line break" in error
    assert not list(tmp_path.rglob("*.sbatch"))


@pytest.mark.skipif(not shutil.which("bash"), reason="the script is one of bash")
@pytest.mark.parametrize(("code", "attempt", "ends"), [(75, 0, 75), (73, 0, 75), (65, 0, 65), (75, 3, 1), (73, 3, 1)])
def test_chunks_are_given_back_where_users_may_not_requeue(drgs, tmp_path, code, attempt, ends):
    """`RequeueExit=75` of slurm.conf does it then, of a chunk that met a full disk too."""
    (tmp_path / "a.blend").touch()
    (tmp_path / "scontrol").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "scontrol").chmod(0o755)
    job = ["submit", "slurm", tmp_path / "a.blend", "--frames", "1", "--out", tmp_path / "####.exr", "--no-check"]
    assert drgs(*job, "--to", tmp_path / "job", "--drgs", f"sh -c 'exit {code}'")[0] == 0
    own = {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_JOB_ID": "1", "SLURM_RESTART_COUNT": str(attempt)}
    environment = os.environ | own | {"DRGS_PAUSE": "0", "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", tmp_path / "job" / "render.sbatch"], env=environment, capture_output=True)
    assert done.returncode == ends, done.stdout


@pytest.mark.skipif(os.name == "nt", reason="backslashes part folders there")
def test_folder_whose_logs_slurm_would_lose_is_refused(drgs, tmp_path):
    (tmp_path / "a.blend").touch()
    job = ["submit", "slurm", tmp_path / "a.blend", "--frames", "1-2", "--out", tmp_path / "####.exr", "--no-check"]
    code, _, error = drgs(*job, "--to", tmp_path / "a\\b")
    assert code == 64 and "backslash" in error and "Choose another folder" in error
    assert not list(tmp_path.rglob("*.sbatch"))


@pytest.mark.skipif(sys.platform != "linux", reason="where names are bytes")
def test_names_of_any_bytes_reach_the_script(drgs, tmp_path):
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    (folder / "a.blend").touch()
    job = ["submit", "slurm", folder / "a.blend", "--frames", "1-2", "--out", folder / "####.exr", "--no-check"]
    assert drgs(*job, "--to", folder / "job")[0] == 0
    assert os.fsencode(folder / "a.blend") in (folder / "job" / "render.sbatch").read_bytes()


@node
def test_flamenco_chunks_as_its_own_tests_say():
    for (frames, size), chunks in CHUNKS.items():
        assert manager(chunk=[frames, size]) == chunks
        assert [frame for chunk in chunks for frame in parse_frames(chunk)] == parse_frames("".join(frames.split()))


@node
def test_flamenco_job_type_makes_the_commands_of_the_job(tmp_path):
    job = make_job(frames=[1, 2, 3, 5, 7], clean="/p/clean/####.exr")
    command = flamenco.write_job(job, tmp_path, "http://farm:8080/")
    described = json.loads((tmp_path / "job.json").read_text())
    assert command.endswith(" http://farm:8080/api/v3/jobs") and described["type"] == "drgs-render"
    answer = manager(script=(tmp_path / "drgs_render.js").read_text(), settings=described["settings"])
    settings = {setting["key"]: setting for setting in answer["type"]["settings"]}
    assert described["settings"].keys() == settings.keys()
    assert {s["type"] for s in settings.values()} <= {"string", "int32", "float", "bool"}
    tasks = answer["tasks"]
    render, denoise = [t for t in tasks if not t["after"]], [t for t in tasks if t["after"]]
    assert [t["name"] for t in render] == ["render-1,2", "render-3,5", "render-7"]
    assert [t["name"] for t in denoise] == ["denoise-1,2", "denoise-3,5", "denoise-7"]
    assert all(t["after"] == [r["name"] for r in render] and t["type"] == "blender" for t in denoise)
    for made, of_job in ((render, job.render), (denoise, job.denoise)):
        for task, chunk in zip(made, ("1,2", "3,5", "7"), strict=True):
            (command,) = task["commands"]
            words = command["parameters"]
            assert command["name"] == "blender-render" and words["exe"] == "{drgs}"
            line = ["drgs", *words["argsBefore"], words["blendfile"], *words["args"]]
            wanted = of_job(chunk)
            if made is denoise:  # the range in Flamenco's own notation
                assert parse_frames(line[4].removeprefix("--sequence=")) == job.frames
                line[4] = wanted[4]
            assert line == wanted


@pytest.mark.parametrize("changes", [{"frames": [-1, 0]}, {"options": ("--blender", "/a b/blender")}])
def test_what_flamenco_cannot_express_is_refused(tmp_path, changes):
    with pytest.raises(UsageError):
        flamenco.write_job(make_job(**changes), tmp_path, "http://farm")
    assert not list(tmp_path.iterdir())


def test_lines_are_those_that_workers_look_for(capsys):
    """Flamenco's `Saved: '(.*)'` in any line, Deadline's `^Fra:.*Sample ...$`, OpenJD's `openjd_progress: `."""
    paths = ["/p/f/0001.exr", "/p/it's here/0002.exr", "/p/f/0003.exr"]
    with FrameLines(interval=0, openjd=3) as lines:
        for number, path in enumerate(paths, 1):
            lines.begin(number, 16)
            lines.progress(number, "rendering", 0.5)
            lines.skipped(path) if number == 3 else lines.saved(path)
            lines.finished(number)
    text = capsys.readouterr().out
    saved = [match[1] for line in text.splitlines() if (match := re.search("Saved: '(.*)'", line))]
    assert saved == paths[:2]
    assert "skipping existing frame '/p/f/0003.exr'" in text
    assert re.findall(r"^Fra:.*Sample\s(\d+)\/(\d+)$", text, re.M) == [("0", "16"), ("8", "16")] * 3
    done = [float(number) for number in re.findall(r"^openjd_progress: (\d+\.\d)$", text, re.M)]
    assert done == [16.7, 33.3, 50.0, 66.7, 83.3, 100.0]
    assert not re.search("Error:|Exception:|Warning", text)
    assert all(
        re.match(r"Fra:|Saved: '| Time: |skipping |openjd_(progress|status): ", line) for line in text.splitlines()
    )
