"""Zips that bring the engine's packages: what Blender takes of them, and a picture without set-up or network."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

import bpy
import engine_wheels
import extension
import numpy as np
import pytest
from scenes import ROOT, part, read_exr, write_ball

bundle, link = part("addon.engine_bundle"), part("addon.engine_link")
environment = part("addon.engine_environment")
JOB = Path(__file__).with_name("bundle_job.py")
BUNDLES = [(platform, series) for platform in engine_wheels.PLATFORMS for series in engine_wheels.SERIES]


def blender_ext() -> Path:
    """Blender's own tool for extensions."""
    (found,) = Path(bpy.utils.resource_path("LOCAL")).glob("scripts/addons_core/bl_pkg/cli/blender_ext.py")
    return found


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    """All zips with wheels, which hold nothing: their names are what is looked at."""
    folder = tmp_path_factory.mktemp("zips")

    def empty(platform: str, python: str) -> list[Path]:
        made = [folder / name for name in engine_wheels.locked(platform, python)]
        for path in made:
            path.write_bytes(b"")
        return made

    (folder / "repository").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine_wheels, "fetch", empty)
        patch.setattr(engine_wheels, "slim", lambda path: path)
        return [extension.build(folder / "repository" / f"{n}.zip", bundle=b) for n, b in enumerate(BUNDLES)]


def test_blenders_validator_and_repositories_take_each_zip(zips):
    for archive in zips:
        done = subprocess.run([sys.executable, blender_ext(), "validate", archive], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    folder = zips[0].parent
    ours = json.loads(extension.write_index(zips).read_text(encoding="utf-8"))
    (folder / "index.json").unlink()
    command = [sys.executable, blender_ext(), "server-generate", "--repo-dir", folder]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "duplicate" not in done.stdout + done.stderr, done.stdout + done.stderr
    theirs = json.loads((folder / "index.json").read_text(encoding="utf-8"))
    assert len(ours["data"]) == len(BUNDLES)
    by_url = lambda entry: entry["archive_url"]  # noqa: E731
    assert sorted(ours["data"], key=by_url) == sorted(theirs["data"], key=by_url)


def test_wheels_fit_their_platform_and_blenders_and_are_all_that_the_engine_asks_for(zips):
    spec = importlib.util.spec_from_file_location("blender_ext", blender_ext())
    tool = importlib.util.module_from_spec(spec)
    sys.modules["blender_ext"] = tool
    spec.loader.exec_module(tool)
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    plain = lambda name: name.lower().replace("-", "_")  # noqa: E731
    for archive, (platform, series) in zip(zips, BUNDLES):
        with zipfile.ZipFile(archive) as opened:
            manifest = tomllib.loads(opened.read("blender_manifest.toml").decode())
            assert {f"./{n}" for n in opened.namelist() if n.endswith(".whl")} == set(manifest["wheels"])
        assert manifest["platforms"] == [platform]
        assert (manifest["blender_version_min"], manifest.get("blender_version_max", "")) == (series.begin, series.end)
        for wheel in manifest["wheels"]:
            assert tool.blender_platform_compatible_with_wheel_platform_from_filepath(platform, wheel), wheel
            versions = tool.python_versions_from_wheel(Path(wheel).name)
            assert versions <= {(2,), (3,), tuple(map(int, series.python.split(".")))}, wheel
        brought = {plain(Path(wheel).name.partition("-")[0]) for wheel in manifest["wheels"]}
        needed = {plain(text.partition(">")[0]) for text in asked} - {"numpy"}
        assert needed <= brought and "numpy" not in brought
    text = (ROOT / "blender_manifest.toml").read_text(encoding="utf-8")
    wrong = extension.manifest_text(
        text, "windows-x64", engine_wheels.SERIES[0], engine_wheels.locked("linux-x64", "3.11")
    )
    assert "not of the platform" in " ".join(extension.faults(tomllib.loads(wrong), extension.project_version()))


def test_versions_of_the_lock_are_those_of_the_table():
    for platform, series in BUNDLES:
        found = dict(name.split("-")[:2] for name in engine_wheels.locked(platform, series.python))
        wanted = {
            name: engine_wheels.OLDER.get((name, series.python), version)
            for name, version in engine_wheels.VERSIONS.items()
        }
        assert {name.lower().replace("-", "_"): version for name, version in wanted.items()} == found


def test_slim_wheels_are_the_same_packages_without_what_nobody_reads(tmp_path, capfd):
    path, big = tmp_path / "small-1.0-py3-none-any.whl", bytes(3 << 20)
    files = {
        "small/__init__.py": b"x = 1\n",
        "small/lib.so": big,
        "small/tests/test_it.py": b"",
        "share/doc/a.pdf": big,
        "share/doc/third-party-programs.txt": b"licences of others",
        "small/tests/LICENSE": b"another",
    }
    rows = "".join(f"{name},sha256=,1\n" for name in files) + "small-1.0.dist-info/RECORD,,\n"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (files | {"small-1.0.dist-info/RECORD": rows.encode()}).items():
            archive.writestr(name, data)
    slim = engine_wheels.slim(path)
    with zipfile.ZipFile(slim) as archive:
        kept = {name: archive.read(name) for name in archive.namelist()}
    record = kept.pop("small-1.0.dist-info/RECORD").decode()
    unused = {"small/tests/test_it.py", "share/doc/a.pdf"}
    assert kept == {name: data for name, data in files.items() if name not in unused}
    assert {row.partition(",")[0] for row in record.splitlines()} == {*kept, "small-1.0.dist-info/RECORD"}
    once = slim.read_bytes()
    slim.unlink()
    capfd.readouterr()
    for again, said in ((False, f"packed {path.name}"), (True, "")):  # what is there is not packed again
        assert engine_wheels.slim_all([path]) == [slim] and slim.read_bytes() == once
        assert said in (out := capfd.readouterr().out) and bool(out) != again


def source_with(folder: Path, *names: str) -> Path:
    """A folder of an extension whose manifest names wheels."""
    folder.mkdir()
    (folder / "blender_manifest.toml").write_text(f"wheels = {json.dumps([f'./wheels/{name}' for name in names])}")
    return folder


def test_what_a_bundle_lacks_is_named(tmp_path, monkeypatch):
    ours = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    # Packages of this very Python stand for unpacked ones
    there = f"pytest-1.0-{ours}-{ours}-linux_x86_64.whl"
    assert bundle.fault(source_with(tmp_path / "plain")) == "" and not bundle.wheels(tmp_path / "plain")
    whole = source_with(tmp_path / "whole", there, "pluggy-2-cp39-abi3-linux_x86_64.whl")
    assert bundle.fault(whole) == "" and bundle.site_packages(whole).is_dir()
    for name in ("first", "last"):  # other add-ons have their own folders, with one of the packages
        (tmp_path / name / "site-packages" / "pytest-2.dist-info").mkdir(parents=True)
    others = [tmp_path / name / "site-packages" for name in ("first", "last")]
    monkeypatch.setattr(sys, "path", [others[0], *sys.path, str(others[1])])
    assert bundle.fault(whole) == "" and bundle.site_packages(whole) not in others
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", "/opt/blender/blender")
        assert "lacks (it names '/opt/blender/blender')" in bundle.fault(whole) and not bundle.fault(tmp_path / "plain")
    lacking = source_with(tmp_path / "lacking", there, "numbo-0.68-py3-none-any.whl")
    assert "lack numbo 0.68" in bundle.fault(lacking)
    foreign = source_with(tmp_path / "foreign", "pytest-1.0-cp39-cp39-linux_x86_64.whl")
    assert "are for Python 3.9" in bundle.fault(foreign) and "the zip for this Blender" in bundle.fault(foreign)
    assert "name pytest.whl, which is no wheel" in bundle.fault(source_with(tmp_path / "odd", "pytest.whl"))
    monkeypatch.delenv("DRGS_ENGINE")
    names, complaint = bundle.wheels(lacking), bundle.fault(lacking)
    monkeypatch.setattr(bundle, "wheels", lambda: names)
    monkeypatch.setattr(bundle, "fault", lambda: complaint)
    assert "lack numbo 0.68" in link.problem() and link.origin() == ""
    with pytest.raises(RuntimeError, match=r"lack numbo 0\.68.*Set Up Engine"):
        bpy.ops.drgs.engine_test()


def test_which_engine_comes_first(tmp_path, monkeypatch):
    """A name, an environment that is ready, the bundle."""
    monkeypatch.delenv("DRGS_ENGINE")
    monkeypatch.setattr(bundle, "wheels", lambda: ("numba",))
    monkeypatch.setattr(bundle, "fault", lambda: "")
    monkeypatch.setattr(bundle, "site_packages", lambda: tmp_path)
    states = {"absent": "bundle", "partial": "bundle", "old": "bundle", "ready": "environment"}
    for state, origin in states.items():
        monkeypatch.setattr(environment, "state", lambda folder, state=state: state)
        assert link.origin() == origin
        assert ("Set Up Engine" in link.described()) == (state != "absent")
        if origin == "bundle":
            assert not link.problem()
            command = link.command_line()
            assert command[0] == sys.executable and str(tmp_path) in command and link.lacks_reconstruction()
    monkeypatch.setenv("DRGS_ENGINE", sys.executable)
    assert link.origin() == "named" and "DRGS_ENGINE" in link.described()


def test_a_package_that_cannot_be_imported_is_told_with_the_way_out(tmp_path, monkeypatch):
    monkeypatch.delenv("DRGS_ENGINE")
    (tmp_path / "numba.py").write_text("raise ImportError('libllvmlite.so: cannot open shared object file')")
    monkeypatch.setattr(bundle, "wheels", lambda: ("numba",))
    monkeypatch.setattr(bundle, "fault", lambda: "")
    monkeypatch.setattr(bundle, "site_packages", lambda: tmp_path)
    link.stop()
    try:
        with pytest.raises(part("drgs_blender.core.errors").DrgsError) as caught:
            link.load_asset(write_ball(tmp_path / "ball.drgs"))
    finally:
        link.stop()
    assert "libllvmlite.so" in str(caught.value) and "Set Up Engine" in str(caught.value)


def run_job(archive: Path, asset: Path, picture: Path, engine: str = "", denoise: str = "none") -> dict:
    """What `bundle_job.py` says, in a fresh profile, where the system can do it without any network."""
    profile = tempfile.mkdtemp(prefix="drgs-bundle-")
    names = {"DRGS_ENGINE": engine, "BLENDER_USER_RESOURCES": profile, "PYTHONPATH": "/nowhere"}
    variables = {name: value for name, value in (os.environ | names).items() if value}
    if not engine:
        variables.pop("DRGS_ENGINE", None)
    alone = ["unshare", "-n"] if shutil.which("unshare") else []
    if alone and subprocess.run([*alone, "true"], capture_output=True).returncode:
        alone = []
    job = {"zip": str(archive), "asset": str(asset), "picture": str(picture), "denoise": denoise}
    try:
        done = subprocess.run(
            [*alone, sys.executable, JOB, json.dumps(job)], env=variables, capture_output=True, text=True, timeout=900
        )
        lines = [line for line in done.stdout.splitlines() if line.startswith("JOB ")]
        assert done.returncode == 0 and lines, done.stdout[-2000:] + done.stderr[-2000:]
        return json.loads(lines[0].removeprefix("JOB "))
    finally:
        shutil.rmtree(profile, ignore_errors=True)


@pytest.fixture(scope="session")
def whole_zip(tmp_path_factory):
    """The zip of this Blender and system; nothing is fetched for it."""
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    series = next((s for s in engine_wheels.SERIES if s.python == python), None)
    if sys.platform != "linux" or series is None:
        pytest.skip(f"no zip is built for Python {python} on {sys.platform}")
    if not engine_wheels.is_ready("linux-x64", python):
        pytest.skip("the wheels are not in build/wheels: run tools/extension.py --platform linux-x64")
    return extension.build(tmp_path_factory.mktemp("zip") / "drgs.zip", bundle=("linux-x64", series))


@pytest.mark.slow
@pytest.mark.blender_api
@pytest.mark.parametrize("denoise", ["none", "oidn"])
def test_without_set_up_and_network_it_renders_what_the_environment_renders(whole_zip, tmp_path, denoise):
    asset = write_ball(tmp_path / "ball.drgs")
    pictures = [tmp_path / "bundle.exr", tmp_path / "environment.exr"]
    found = run_job(whole_zip, asset, pictures[0], denoise=denoise)
    assert found["origin"] == "bundle" and not found["problem"] and "engine" not in found["open"]
    assert found["command"][0] == sys.executable and "-I" in found["command"]
    assert "DR-GS can render here" in found["doctor"]
    other = run_job(whole_zip, asset, pictures[1], engine=os.environ["DRGS_ENGINE"], denoise=denoise)
    assert other["origin"] == "named"
    own, theirs = (read_exr(path, 96, 64) for path in pictures)
    assert own[..., 3].max() > 0.9 and own[..., :3].std() > 0.01
    if denoise == "none":
        np.testing.assert_array_equal(own, theirs)
    else:  # a network of half floats, whose sums depend on the machine's threads
        np.testing.assert_allclose(own, theirs, rtol=1e-2, atol=1e-2)
