"""The engine's own environment: made, cancelled, resumed, repaired; real pip, a small engine."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import zipfile
from pathlib import Path, PurePosixPath
from types import SimpleNamespace

import bpy
import pytest
from scenes import PACKAGE, part

setup = part("addon.engine_setup")
environment = part("addon.engine_environment")
job = part("addon.setup_job")
requirements = environment.requirements
errors = part("drgs_blender.core.errors")

DOCTOR = "import {0}\nprint('DR-GS can render here.')\n"
#: Compiles nothing, and says what `drgs_blender.compute.prepare` says.
PREPARE = """
import sys, time
assert sys.argv[1:] == ["--all"], sys.argv
for i in range(4):
    print(f"{TEXT}, {i} of 4", flush=True)
    time.sleep(0.1)
print("The engine is ready", flush=True)
"""
PREPARING = part("drgs_blender.core.phases").PREPARING


def wheel(folder: Path, name: str) -> str:
    """A package of one empty module; its requirement."""
    path, info = folder / f"{name}-1.0-py3-none-any.whl", f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.py", "")
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return f"{name} @ {path.as_uri()}"


def engine_source(folder: Path, requirement: str, program: str) -> Path:
    """Sources of an engine with one requirement, whose `drgs doctor` is `program`."""
    cli, compute = folder / "drgs_blender" / "cli", folder / "drgs_blender" / "compute"
    cli.mkdir(parents=True)
    compute.mkdir()
    (compute / "__init__.py").write_text("")
    (compute / "prepare.py").write_text(f"TEXT = {PREPARING!r}\n{PREPARE}")
    extra = wheel(folder, "tinytorch")
    (folder / "pyproject.toml").write_text(
        f'[project]\nname = "small"\ndependencies = ["{requirement}"]\n'
        f'[project.optional-dependencies]\nreconstruct = ["{extra}"]\n'
    )
    for path, text in ((cli.parent / "__init__.py", ""), (cli / "__init__.py", ""), (cli / "main.py", program)):
        path.write_text(text)
    return folder


def until_done(running, seconds: float = 120, texts: list[str] | None = None) -> list[float]:
    """Poll to the end; the fractions that were seen, and in `texts` what was said. No poll may take long."""
    fractions, end = [], time.monotonic() + seconds
    while True:
        begin = time.thread_time()
        done = running.poll()
        assert time.thread_time() - begin < 0.5
        fractions.append(running.fraction)
        if texts is not None and running.text not in texts:
            texts.append(running.text)
        if done:
            if running.error is not None and "Preparing pip" in str(running.error):
                pytest.skip("no package index can be reached")
            return fractions
        assert time.monotonic() < end, running.text
        time.sleep(0.02)


def packages_of_this_python() -> str:
    """What tells one state of the installed packages from another."""
    found = sorted(p.name for p in Path(bpy.__file__).parents[1].iterdir())
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


def alive(group: int) -> list[str]:
    """States of the processes of a group that have not ended."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, own = status.read_text().rpartition(")")[2].split()[:3]
        except OSError:  # it has just ended
            continue
        if int(own) == group and state != "Z":
            found.append(state)
    return found


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Path]:
    """An environment whose set-up was cancelled and went on, and the sources of its engine."""
    top = tmp_path_factory.mktemp("setup")
    source = engine_source(top / "source", wheel(top, "tinydep"), DOCTOR.format("tinydep"))
    folder, before = top / "engine", packages_of_this_python()
    assert environment.state(folder, source) == "absent" and environment.needs_network(folder, source)
    running = setup.EngineSetup(folder, Path(sys.executable), source)
    process = running._process
    time.sleep(0.3)
    begin = time.monotonic()
    running.cancel()
    assert time.monotonic() - begin < 2 and process.poll() is not None and running.done
    assert environment.state(folder, source) == "partial"
    if sys.platform == "linux":
        while alive(process.pid) and time.monotonic() - begin < 5:  # killed, and a moment away from its end
            time.sleep(0.02)
        assert not alive(process.pid)
    more = setup.EngineSetup(folder, Path(sys.executable), source)
    fractions = until_done(more)
    assert more.error is None and more.text == "Ready"
    assert fractions == sorted(fractions) and fractions[-1] == 1 and len(set(fractions)) > 3
    assert packages_of_this_python() == before
    return folder, source


@pytest.mark.slow
@pytest.mark.parametrize("there", [True, False])
def test_the_versions_of_shipped_kernels_are_asked_for_first_and_not_insisted_on(tmp_path, monkeypatch, there):
    source = engine_source(tmp_path / "source", wheel(tmp_path, "tinydep"), DOCTOR.format("tinydep"))
    kernels = source / "drgs_blender" / "compute" / "kernels"
    kernels.mkdir(parents=True)
    wheel(tmp_path, "numba"), wheel(tmp_path, "llvmlite")
    version = "1.0" if there else "0.0.0.1"
    (kernels / "versions.json").write_text(json.dumps({"numba": version, "llvmlite": "1.0", "pythons": []}))
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    folder = tmp_path / "engine"
    running = setup.EngineSetup(folder, Path(sys.executable), source)
    titles = [step.text for step in running._steps]
    assert titles.index("Installing Numba") == titles.index("Installing packages") - 1
    fractions = until_done(running)
    assert running.error is None and fractions == sorted(fractions) and fractions[-1] == 1
    assert environment.state(folder, source) == "ready"
    assert bool(list(environment.site_packages(folder).glob("numba-1.0.dist-info"))) == there
    again = setup.EngineSetup(folder, Path("/no/python/is/needed"), source)
    assert ("Installing Numba" in [step.text for step in again._steps]) != there
    again.cancel()


@pytest.mark.slow
def test_another_version_of_the_engine_needs_no_network(made):
    folder, source = made
    assert environment.state(folder, source) == "ready" and not environment.needs_network(folder, source)
    (source / "drgs_blender" / "new.py").write_text("")
    environment.digest.cache_clear()
    assert environment.state(folder, source) == "old"
    again = setup.EngineSetup(folder, Path("/no/python/is/needed"), source)
    assert [step.text for step in again._steps] == ["Trying the engine", PREPARING]
    until_done(again)
    assert again.error is None and environment.state(folder, source) == "ready"
    assert list(folder.rglob("new.py")) and not list(folder.rglob("drgs_blender.old"))


@pytest.mark.slow
def test_reconstruction_is_added_to_an_engine_that_is_ready(made):
    folder, source = made
    assert environment.needs_network(folder, source, environment.RECONSTRUCT) and not list(folder.rglob("tinytorch.py"))
    running = setup.EngineSetup(folder, Path("/no/python/is/needed"), source, extras=[environment.RECONSTRUCT])
    assert running.fraction < 0.1
    fractions = until_done(running)
    assert running.error is None and fractions == sorted(fractions) and fractions[-1] == 1
    assert environment.state(folder, source) == "ready" and list(folder.rglob("tinytorch.py"))
    assert not environment.needs_network(folder, source, environment.RECONSTRUCT)


@pytest.mark.slow
def test_an_engine_without_reconstruction_renders_and_says_so(made, monkeypatch):
    """Packages that cannot be had leave a working engine, and their want is told before files are chosen."""
    folder, source = made
    stamp = folder / environment.SET_UP
    before = stamp.read_text()
    entries = json.loads(before)
    entries.pop("reconstruct", None)
    stamp.write_text(json.dumps(entries))
    text = (source / "pyproject.toml").read_text()
    try:
        (source / "pyproject.toml").write_text(text.replace("tinytorch-1.0", "tinytorch-2.0"))
        environment.requirements.cache_clear()
        running = setup.EngineSetup(folder, Path("/no/python/is/needed"), source, extras=[environment.RECONSTRUCT])
        until_done(running)
        assert "Installing PyTorch" in str(running.error) and environment.state(folder, source) == "ready"
        link = part("addon.engine_link")
        monkeypatch.delenv("DRGS_ENGINE")
        monkeypatch.setattr(link, "engine_folder", lambda create=False: folder)
        monkeypatch.setattr(environment, "digest", lambda where=None: json.loads(before)["sources"])
        monkeypatch.setattr(
            environment, "requirements", lambda where=None, group=environment.ENGINE: requirements(source, group)
        )
        assert link.lacks_reconstruction()
        with pytest.raises(RuntimeError, match="without PyTorch"):
            bpy.ops.drgs.reconstruct(filepath=str(source))
    finally:
        (source / "pyproject.toml").write_text(text)
        requirements.cache_clear()
        stamp.write_text(before)


@pytest.fixture
def prepare(made):
    """Function that gives the small engine another program for its kernels, until the test has ended."""
    program = made[1] / "drgs_blender" / "compute" / "prepare.py"
    before = program.read_text()

    def write(text: str) -> None:
        program.write_text(text)
        environment.digest.cache_clear()

    yield write
    write(before)


def test_kernels_come_last_and_are_counted(made):
    folder, source = made
    running, texts = setup.EngineSetup(folder, Path("/no/python/is/needed"), source), []
    fractions = until_done(running, texts=texts)
    assert running.error is None and not running.remark
    counted = [text for text in texts if text.startswith(f"{PREPARING}, ")]
    assert counted == [f"{PREPARING}, {i} of 4" for i in range(4)] and texts[-1] == "Ready"
    assert fractions == sorted(fractions) and len(set(fractions)) > 4


def test_kernels_that_cannot_be_compiled_are_named_and_the_engine_works(made, prepare):
    folder, source = made
    prepare("raise SystemExit('error: the compiler is tired')")
    running = setup.EngineSetup(folder, Path("/no/python/is/needed"), source)
    assert until_done(running)[-1] == 1
    assert running.error is None and running.text == "Ready" and environment.state(folder, source) == "ready"
    assert running.remark.startswith(f"{PREPARING} failed: error: the compiler is tired. ")
    assert "setup.log" in running.remark


def test_cancelled_among_its_kernels_the_engine_works(made, prepare, monkeypatch):
    folder, source = made
    prepare(f"import time\nprint('{PREPARING}, 1 of 2', flush=True)\ntime.sleep(600)")
    running = setup.EngineSetup(folder, Path("/no/python/is/needed"), source)
    end = time.monotonic() + 60
    while not running.text.endswith("1 of 2"):
        assert not running.poll() and time.monotonic() < end, running.text
        time.sleep(0.02)
    assert environment.state(folder, source) == "ready"
    process, begin = running._process, time.monotonic()
    monkeypatch.setattr(job, "job", running)
    assert bpy.ops.drgs.engine_setup_cancel() == {"FINISHED"}
    assert time.monotonic() - begin < 2 and process.poll() is not None and running.done and running.error is None
    assert environment.state(folder, source) == "ready"
    said = [m.text for m in part("addon.messages").history]
    assert said[-2:] == [f"The engine is set up in {folder}", "What is missing is compiled when it is first used"]


def test_an_engine_that_does_not_work_is_not_ready(made):
    folder, source = made
    program = source / "drgs_blender" / "cli" / "main.py"
    before = program.read_text()
    try:
        program.write_text("raise SystemExit('error: no Embree')")
        environment.digest.cache_clear()
        running = setup.EngineSetup(folder, Path(sys.executable), source)
        until_done(running)
        assert "no Embree" in str(running.error) and "setup.log" in str(running.error)
        assert environment.state(folder, source) == "old"
    finally:
        program.write_text(before)
        environment.digest.cache_clear()


@pytest.mark.skipif(os.name == "nt", reason="environments have no links there")
def test_an_environment_whose_python_has_gone_is_made_anew(made, tmp_path):
    folder, source = made
    own = environment.interpreter(folder)
    kept = own.readlink()
    own.unlink()
    own.symlink_to(tmp_path / "gone")
    try:
        assert environment.state(folder, source) == "partial" and environment.needs_network(folder, source)
        running = setup.EngineSetup(folder, tmp_path / "no-python", source)
        assert "--clear" in running._plan(Path(sys.executable), False, [setup.ENGINE], "")[0].command
    finally:
        own.unlink()
        own.symlink_to(kept)


def test_a_python_that_is_none_is_named(tmp_path):
    source = engine_source(tmp_path / "source", "x", "")
    running = setup.EngineSetup(tmp_path / "engine", tmp_path / "no-python", source)
    assert running.done and "no-python" in str(running.error)


@pytest.mark.slow
def test_an_index_that_does_not_answer_is_told_from_a_package_that_is_not_there(tmp_path, monkeypatch):
    """What pip says last is the same for both."""
    monkeypatch.setenv("PIP_RETRIES", "1")
    monkeypatch.setenv("PIP_INDEX_URL", "http://localhost:9/simple")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    for name in ("PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    source = engine_source(tmp_path / "source", "drgs-no-such-package", "")
    running = setup.EngineSetup(tmp_path / "engine", Path(sys.executable), source)
    end = time.monotonic() + 240
    while not running.poll():
        assert time.monotonic() < end, running.text
        time.sleep(0.05)
    assert "the package index does not answer (" in str(running.error)


def test_too_little_room_is_told_before_anything_is_fetched(tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "ENGINE", setup.ENGINE._replace(disk=1e18))
    with pytest.raises(errors.DeviceError, match="MB left"):
        setup.EngineSetup(tmp_path / "engine", Path(sys.executable))


def test_the_extension_brings_what_the_engine_needs():
    assert any(r.startswith("numba") for r in environment.requirements())
    assert (environment.SOURCE / "drgs_blender" / "cli" / "doctor.py").is_file()


class Labels:
    """A layout that keeps the texts of its labels."""

    def __init__(self):
        self.texts = []

    def column(self, **_):
        return self

    def label(self, text="", **_):
        self.texts.append(text)

    def prop(self, *_):
        pass


def test_what_finds_cameras_is_a_part_of_its_own_and_the_set_up_says_what_it_adds(monkeypatch, tmp_path):
    link, operator = part("addon.engine_link"), part("operators.engine_setup")
    monkeypatch.delenv("DRGS_ENGINE")
    monkeypatch.setattr(environment, "state", lambda folder: "ready")
    lacking = {environment.CAPTURE, environment.FILES}
    monkeypatch.setattr(environment, "needs_network", lambda folder, source=None, group=None: group in lacking)
    assert link.lacks_capture() and not link.lacks_reconstruction()
    cls = operator.DRGS_OT_engine_setup
    fields = SimpleNamespace(reconstruct=True, capture=True, gpu=False, files=True, afresh=False, layout=Labels())
    for name in ("_groups", "_extras", "_missing"):
        setattr(fields, name, getattr(cls, name).__get__(fields))
    cls.draw(fields, bpy.context)
    texts = " ".join(fields.layout.texts)
    assert (
        texts.startswith("Adds COLMAP, OpenCV and PyAV, which find the cameras of") and "USD, 3MF and COLLADA" in texts
    )
    monkeypatch.setenv("DRGS_ENGINE", str(tmp_path))  # an environment of the user's own says itself what it lacks
    assert not link.lacks_capture()


def test_offline_nothing_begins(scene, monkeypatch):
    if bpy.app.online_access:
        pytest.skip("this Blender is online")
    with pytest.raises(RuntimeError, match="Allow Online Access"):
        bpy.ops.drgs.engine_setup()
    assert not job.running() and environment.state(part("addon.engine_link").engine_folder()) == "absent"


def test_an_existing_engine_is_chosen_and_another_program_refused(scene, monkeypatch, tmp_path):
    place = os.environ["DRGS_ENGINE"]
    monkeypatch.delenv("DRGS_ENGINE")
    link, settings = part("addon.engine_link"), bpy.context.preferences.addons[PACKAGE].preferences
    link.stop()
    assert "not set up" in link.problem()
    with pytest.raises(RuntimeError, match="Press Set Up Engine"):
        bpy.ops.drgs.engine_test()
    (tmp_path / "text").write_text("no program")
    with pytest.raises(RuntimeError, match="is not an interpreter"):
        bpy.ops.drgs.engine_choose(filepath=str(tmp_path / "text"))
    assert not settings.engine_python
    try:
        assert bpy.ops.drgs.engine_choose(filepath=place) == {"FINISHED"}
        assert settings.engine_python == place and link.is_running() and not link.problem()
    finally:
        settings.engine_python = ""


def test_a_long_path_is_divided_between_its_folders():
    lines = part("operators.engine_setup").path_lines
    assert lines(PurePosixPath("/home/someone/a b/user_default/drgs"), 24) == [
        "/home/someone/a b/",
        "user_default/drgs",
    ]
    assert lines(PurePosixPath("/short"), 24) == ["/short"]
    assert all(len(line) <= 24 for line in lines(PurePosixPath("/" + "x" * 60 + "/drgs"), 24))
