"""From a zip with the engine's packages to the first picture: a fresh profile, an empty cache, no network.

    python bench/bench_bundle.py [--repeats N] [--zips dist/*.zip]

Takes the zips that lie in ``dist`` (tools/extension.py --platform all --kernels) and runs the one for the Blender of
`DRGS_BLENDER`, or of .venv-blender. Where the system can, the process has no network (``unshare``).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

from report import ROOT, table, write_section

sys.path.insert(0, str(ROOT / "tools"))
import environments

JOB = ROOT / "tests" / "blender" / "bundle_job.py"


def run(archive: Path, asset: Path, variables: dict[str, str]) -> dict[str, float]:
    """Seconds of each step, in a Blender of its own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kept = {key: value for key, value in os.environ.items() if key not in ("DRGS_ENGINE", "PYTHONPATH")}
        kept |= {"BLENDER_USER_RESOURCES": str(folder / "profile"), "DRGS_CACHE_DIR": str(folder / "cache")}
        job = {"zip": str(archive), "asset": str(asset), "picture": str(folder / "out.exr"), "denoise": "oidn"}
        alone = ["unshare", "-n"] if shutil.which("unshare") and os.name == "posix" and os.geteuid() == 0 else []
        done = subprocess.run(
            [*alone, environments.blender(), JOB, json.dumps(job)], env=kept | variables, capture_output=True, text=True
        )
        lines = [line for line in done.stdout.splitlines() if line.startswith("JOB ")]
        if not lines:
            raise SystemExit(done.stdout + done.stderr)
        found = json.loads(lines[0].removeprefix("JOB "))
        assert found["origin"] == "bundle", found
        seconds: dict[str, float] = found["seconds"]
        return seconds


def facts(path: Path) -> dict[str, object]:
    """The manifest of a zip."""
    with zipfile.ZipFile(path) as archive:
        return tomllib.loads(archive.read("blender_manifest.toml").decode())


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--zips", nargs="+", type=Path, default=sorted((ROOT / "dist").glob("drgs-*-blender-*.zip")))
    options = parser.parse_args()
    answer = subprocess.run(
        [environments.blender(), "-c", "import bpy; print('VERSION', bpy.app.version_string)"],
        capture_output=True, text=True,
    )  # fmt: skip
    version = answer.stdout.rpartition("VERSION ")[2].split()[0]
    series = tuple(map(int, version.split(".")))

    def fits(path: Path) -> bool:
        manifest = facts(path)
        first, end = (str(manifest.get(f"blender_version_{name}", "99.0.0")) for name in ("min", "max"))
        inside = tuple(map(int, first.split("."))) <= series < tuple(map(int, end.split(".")))
        return inside and manifest["platforms"] == ["linux-x64"]

    archive = next((path for path in options.zips if fits(path)), None)
    if archive is None:
        parser.error("no such zip for this Blender: run tools/extension.py --platform linux-x64 --kernels")
    rows = []
    with tempfile.TemporaryDirectory() as name:
        asset = Path(name) / "spot.drgs"
        make = [environments.python_of(environments.ENGINE), "-m", "drgs_blender.cli.main", "make"]
        subprocess.run([*make, ROOT / "examples/spot/spot_triangulated.obj", "--out", asset], check=True)
        for text, variables in (("kernels of the zip", {}), ("kernels compiled", {"DRGS_SHIPPED": "0"})):
            runs = [run(archive, asset, variables) for _ in range(options.repeats)]
            steps = {step: statistics.median(r[step] for r in runs) for step in runs[0]}
            rows.append([text, *(f"{value:.1f}" for value in steps.values()), f"{sum(steps.values()):.1f}"])
    sizes = [[path.name, f"{path.stat().st_size / 1e6:.1f}"] for path in options.zips]
    body = (
        f"Blender {version}, {archive.name}: seconds, the median of {options.repeats}, of a fresh profile and an empty "
        "cache without a network. The picture has 96 x 64 pixels and is denoised by OIDN.\n\n"
        + table(["", "install", "import", "first picture", "together"], rows)
        + "\n\n"
        + table(["zip", "MB"], sizes)
    )
    write_section("bundle", "From a zip to the first picture, without set-up", body)


if __name__ == "__main__":
    main()
