"""Set up, test and show DR-GS from a clean checkout, on any system, with nothing but Python.

    python3.11 tools/dev.py demo          # two commands after `git clone`: this one, then look at the picture
    python3.11 tools/dev.py test

Standard library only. Two environments are made beside the checkout, because Blender's Python pins an older numpy:
``.venv`` (the engine) and ``.venv-blender`` (Blender as a module, for tests and batch rendering). `docs` makes a third,
``.venv-docs``, for the generator of the site.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import importlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import venv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import job_runner
import suites
from environments import STAMP, environments, python_of
from suites import Failure

ROOT = Path(__file__).resolve().parent.parent
#: Exactly this torch, so that pip never goes looking for a larger build; DRGS_TORCH replaces it (pip arguments).
TORCH = "torch==2.13.0"
BLENDER = "5.0.1"
BLENDER_FLOOR = "4.2.23"
#: Other versions by their series, which is the name of their suite.
BLENDER_OTHERS = {"4.5": "4.5.15", "5.2": "5.2.3", "5.3": "5.3.0"}
#: The newest with long-term support: `make check` runs a part of its suite, that of the others when asked for.
NEWEST_LTS = "5.2"
#: GB of disk that the environments of a demo take.
ROOM = 3.5
#: Seconds that Blender may take to say what its operators and properties are.
REFERENCE_SECONDS = 300
#: The same to fetch what tests alone need.
FETCH_SECONDS = 600
#: Programs of npm that read our files in the tests and write others for us.
NODE_PACKAGES = ("@adobe/spz@0.2.2", "@playcanvas/splat-transform@2.7.1", "gltf-validator@2.0.0-dev.3.10")
#: Shared library that Blender needs -> the Debian package that holds it.
APT_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libICE.so.6": "libice6",
    "libSM.so.6": "libsm6",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libXrender.so.1": "libxrender1",
    "libXxf86vm.so.1": "libxxf86vm1",
    "libgomp.so.1": "libgomp1",
    "libxkbcommon.so.0": "libxkbcommon0",
}
#: The groups of dependencies in pyproject.toml that the site takes, and that tests of `drgs capture` do.
DOCS, CAPTURE = "docs", "capture"
#: The suite of the oldest Blender.
FLOOR = "floor"
SUITES = {
    suites.LINT: suites.Suite("lint", ()),
    "engine": suites.Suite("engine", ("tests/unit", "tests/engine"), spread=True),
    "farm": suites.Suite("farm", ("tests/farm",)),
    "blender": suites.Suite(f"Blender {BLENDER}", ("tests/blender",)),
    FLOOR: suites.Suite(f"Blender {BLENDER_FLOOR}", ("tests/blender",), leaves="judged or (slow and not blender_api)"),
    **{
        series: suites.Suite(
            f"Blender {version}",
            ("tests/blender",),
            leaves="judged or slow or programs or not blender_api" if series == NEWEST_LTS else "",
        )
        for series, version in BLENDER_OTHERS.items()
    },
    suites.WINDOW: suites.Suite("a window", ("tests/ui",), times=suites.WINDOW_TIMES),
}
#: What `make test` and `make check` run, in this order: the longest first, and last the one that spreads over
#: processes, which takes what the others leave.
FAST = (suites.LINT, "blender", "farm", "engine")
ALL = (suites.LINT, "blender", FLOOR, NEWEST_LTS, "farm", "engine")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand; the return value is the exit code."""
    args = parse(argv)
    before = signal.signal(signal.SIGTERM, job_runner.interrupt)  # programs in groups of their own end, too
    try:
        return args.run(args)
    except Failure as failure:
        print(f"dev.py: {failure}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("dev.py: interrupted", file=sys.stderr)
        return 130
    finally:
        signal.signal(signal.SIGTERM, before)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line of this script."""
    parser = argparse.ArgumentParser(
        prog="dev.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # `clean --al` removed the environments
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: object, about: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=about, description=about, allow_abbrev=False)
        sub.set_defaults(run=run, passes_on=False)
        return sub

    env = command("env", run_env, "make or refresh the environments (instant when nothing changed)")
    env.add_argument("--engine", action="store_true", help="only the engine's environment")
    env.add_argument(
        "--blender",
        nargs="?",
        const=BLENDER,
        metavar="VERSION",
        type=blender_version,
        help=f"only Blender's environment, of this version, e.g. {BLENDER_FLOOR}; default {BLENDER}",
    )
    command("system", run_system, "print the system packages that Blender needs and that are missing (Linux)")
    names = ", ".join(SUITES)
    about = f"words: suites ({names}), files of tests, then options of pytest, e.g. -k material"
    test = command("test", run_test, f"the fast tests, for every commit; {about}")
    check = command("check", run_check, f"every test; {about}")
    check.add_argument("--rest", dest="others", action="store_true", help="only what `test` leaves out")
    demo = command("demo", run_demo, "render the demo through Blender; further arguments go to examples/demo.py")
    simulation = command(
        "demo-simulation", run_demo_simulation, "bake and render matter; see examples/demo_simulation.py"
    )
    extension = command("extension", run_extension, "build the extension's zip; arguments go to tools/extension.py")
    about = "build the site of the documentation in build/docs/html; any warning ends it; --links also asks other sites"
    docs = command("docs", run_docs, about)
    bench = command("bench", run_bench, "measure; further arguments go to bench/run.py")
    for sub in (test, check, demo, simulation, extension, docs, bench):
        sub.set_defaults(passes_on=True)
    clean = command("clean", run_clean, "remove build products and caches")
    clean.add_argument("--all", action="store_true", help="also the environments")
    args, rest = parser.parse_known_args(argv)
    args.rest = rest
    if rest and not args.passes_on:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    return args


# Environments


def blender_folder(version: str) -> Path:
    """``.venv-blender`` for the main version, ``.venv-blender-4.2`` and so on for the others."""
    series = ".".join(version.split(".")[:2])
    return ROOT / (".venv-blender" if version == BLENDER else f".venv-blender-{series}")


def blender_version(text: str) -> str:
    """The whole version of a Blender, as the package index names it; that of a series that has a suite."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version := BLENDER_OTHERS.get(text, text)):
        raise argparse.ArgumentTypeError(f"{text} is no whole version, such as {BLENDER}")
    return version


def ensure_engine() -> Path:
    """Make ``.venv`` when needed and return its interpreter."""
    return ensure(*about_engine(), "import drgs_blender")


def about_engine() -> tuple[Path, dict[str, object], list[list[str]]]:
    """Folder of the engine's environment, what is wanted in it, what pip installs."""
    project = project_table()
    torch = shlex.split(os.environ.get("DRGS_TORCH", TORCH))
    wanted = {
        "torch": torch,
        "dependencies": project["dependencies"],
        "optional": {k: v for k, v in project["optional-dependencies"].items() if k != DOCS},
        "scripts": project["scripts"],
    }
    return ROOT / ".venv", wanted, [torch, ["-e", f"{ROOT}[reconstruct,oidn,gpu,dev]"]]


def ensure_blender(version: str = BLENDER) -> Path:
    """Make the environment with Blender `version` as a module when needed and return its interpreter."""
    return ensure(*about_blender(version), "import bpy", python_for(version))


def about_blender(version: str) -> tuple[Path, dict[str, object], list[list[str]]]:
    """The same for Blender's."""
    packages = [f"bpy=={version}", "pytest>=8"]
    return blender_folder(version), {"packages": packages}, [packages]


def is_made(folder: Path, wanted: dict[str, object]) -> bool:
    """Whether an environment is there, as it is wanted."""
    stamp = folder / STAMP
    if not (python_of(folder).exists() and stamp.exists()):
        return False
    return stamp.read_text(encoding="utf-8") == json.dumps(wanted, indent=1, sort_keys=True)


def ensure(
    folder: Path, wanted: dict[str, object], steps: Iterable[list[str]], probe: str, python: Path | None = None
) -> Path:
    """Make `folder` a virtual environment in which each of `steps` was pip-installed and `probe` runs.

    A stamp in the folder remembers what was wanted, so a second call does nothing.
    """
    interpreter, stamp = python_of(folder), folder / STAMP
    text = json.dumps(wanted, indent=1, sort_keys=True)
    if is_made(folder, wanted):
        return interpreter
    started = time.monotonic()
    print(f"Preparing {folder.name} ...", flush=True)
    if not interpreter.exists():
        if python is None or python.resolve() == Path(sys.executable).resolve():
            venv.create(folder, with_pip=True)
        else:
            command = [str(python), "-m", "venv", str(folder)]
            if subprocess.run(command).returncode:
                raise Failure(f"{' '.join(command)} failed; its message is above")
    for step in steps:
        command = [str(interpreter), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *step]
        if subprocess.run(command, cwd=ROOT).returncode:
            raise Failure(
                f"pip install {' '.join(step)} failed in {folder.name}; its message is above{full_disk(folder)}"
            )
    trial = subprocess.run([interpreter, "-c", probe], capture_output=True, text=True, timeout=300, cwd=ROOT)
    if trial.returncode:
        raise Failure(import_trouble(folder, trial.stderr))
    stamp.write_text(text, encoding="utf-8")
    print(f"Preparing {folder.name} took {time.monotonic() - started:.0f} s", flush=True)
    return interpreter


def full_disk(folder: Path) -> str:
    """What a disk with hardly any room adds to a message: pip's own may be about a file that it could not read."""
    free = shutil.disk_usage(folder).free / 1e9
    return "" if free > ROOM else f". Only {free:.1f} GB of its disk are free: the environments take {ROOM} GB"


def ensure_docs() -> Path:
    """Make ``.venv-docs`` when needed and return its interpreter."""
    packages = project_table()["optional-dependencies"][DOCS]
    probe = "import furo, griffe, mermaidx, myst_parser, sphinx"
    return ensure(ROOT / ".venv-docs", {"packages": packages}, [packages], probe)


def project_table() -> dict[str, Any]:
    """The table `project` of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def ensure_node() -> None:
    """Fetch the programs of npm that tests compare with, where npm is there."""
    folder, npm = ROOT / ".venv-node", shutil.which("npm")
    if npm is None:
        return
    folder.mkdir(exist_ok=True)
    quiet = ["--no-audit", "--no-fund", "--no-update-notifier", "--no-progress", "--loglevel=error"]
    command = [npm, "install", "--prefix", str(folder), "--no-save", *quiet, *NODE_PACKAGES]
    fetch(folder, STAMP, NODE_PACKAGES, command, "the programs of npm that tests compare with")


def ensure_capture(engine: Path) -> None:
    """Fetch the libraries of `drgs capture` into the engine's environment.

    They come after it and may be missing: no demo waits for their 165 MB, and not every system has wheels of pycolmap.
    """
    packages = project_table()["optional-dependencies"][CAPTURE]
    pip = [str(engine), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:"]
    fetch(ROOT / ".venv", "drgs-stamp-capture.json", packages, [*pip, *packages], "the libraries of drgs capture")


def fetch(folder: Path, stamp: str, packages: Sequence[str], command: list[str], what: str) -> None:
    """Run the command that fetches packages which tests alone need, once; where it fails, say that these are skipped.

    A stamp in the folder remembers the packages.
    """
    path, text = folder / stamp, json.dumps(packages)
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return
    print(f"Fetching {what} (once) ...", flush=True)
    try:
        failed, why = subprocess.run(command, cwd=folder, timeout=FETCH_SECONDS).returncode, "see above"
    except subprocess.TimeoutExpired:  # npm tries again and again where it trusts no server
        failed, why = 1, f"not within {FETCH_SECONDS} s"
    if failed:
        print(f"Could not fetch {what}, {why}: tests that need them are skipped", flush=True)
        return
    path.write_text(text, encoding="utf-8")


def python_for(version: str) -> Path:
    """The Python for which Blender `version` exists as a module.

    Raises
    ------
    Failure
        There is none here.
    """
    minor = python_minor(version)
    if (found := find_python(minor)) is None:
        raise Failure(
            f"Blender {version} as a module needs Python 3.{minor}, which was not found. Install it, so that "
            f"{'py -' if os.name == 'nt' else 'python'}3.{minor} starts it, and run this script again"
        )
    return found


def python_minor(version: str) -> int:
    """11 for Blender 4.2 to 5.0, 13 for later ones: the minor version of their Python."""
    major, minor = map(int, version.split(".")[:2])
    return 11 if (major, minor) <= (5, 0) else 13


def find_python(minor: int) -> Path | None:
    """A Python 3.`minor`: this one, one on the PATH or where package managers put it."""
    if sys.version_info[:2] == (3, minor):
        return Path(sys.executable)
    name = f"python3.{minor}"
    candidates = [["py", f"-3.{minor}"]] if os.name == "nt" else [[name], [f"/opt/homebrew/bin/{name}"]]
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")  # on the PATH are those alone that it was told
    candidates += [[str(path)] for path in sorted(pyenv.glob(f"versions/3.{minor}.*/bin/{name}"))]
    for candidate in candidates:
        if shutil.which(candidate[0]):
            ask = [*candidate, "-c", "import sys; print(sys.executable)"]
            found = subprocess.run(ask, capture_output=True, text=True)
            if found.returncode == 0:
                return Path(found.stdout.strip())
    return None


def import_trouble(folder: Path, message: str) -> str:
    """Say why an import failed; on Linux name every missing system library and how to get them."""
    missing = set(re.findall(r"(\S+\.so[.\d]*): cannot open shared object file", message))
    if shutil.which("ldd"):
        for library in folder.glob("lib/python*/site-packages/bpy/__init__*.so"):
            listing = subprocess.run(["ldd", library], capture_output=True, text=True).stdout
            missing |= set(re.findall(r"(\S+) => not found", listing))
    if not missing:
        return f"{folder.name} does not work:\n{message.strip()}"
    packages = sorted({APT_PACKAGES.get(name, name) for name in missing})
    return (
        f"Blender needs system libraries that are not installed: {', '.join(sorted(missing))}.\n"
        f"On Debian or Ubuntu: sudo apt-get install -y --no-install-recommends {' '.join(packages)}"
    )


def run_env(args: argparse.Namespace) -> int:
    """Make the environments that are missing or out of date."""
    if args.engine:
        print(ensure_engine())
    elif args.blender:
        print(ensure_blender(args.blender))
    else:
        both()
        ensure_capture(python_of(ROOT / ".venv"))
        print(python_of(ROOT / ".venv"), python_of(blender_folder(BLENDER)), sep="\n")
    return 0


def both() -> None:
    """Make both environments, at the same time; return at once where they are there."""
    from steps import StepFailed, run_steps

    if not all(is_made(*about) for about in (about_engine()[:2], about_blender(BLENDER)[:2])):
        try:
            run_steps(environments(), ROOT / "build" / "environments.txt", ROOT, {})
        except StepFailed as failure:
            raise Failure(str(failure)) from failure


def run_system(args: argparse.Namespace) -> int:
    """Print the Debian packages of the shared libraries in the table that cannot be loaded here."""
    if sys.platform.startswith("linux"):
        print(" ".join(package for library, package in APT_PACKAGES.items() if not loads(library)))
    return 0


def loads(library: str) -> bool:
    """Whether the system's loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


# Tests


def run_test(args: argparse.Namespace) -> int:
    """Run the fast tests, or those that the words choose."""
    return run_suites(args, "fast", list(FAST))


def run_check(args: argparse.Namespace) -> int:
    """Run everything, or what the words choose of it."""
    every = [name for name in ALL if name != suites.LINT or not args.others]
    return run_suites(args, "slow" if args.others else "all", every)


def run_suites(args: argparse.Namespace, part: str, names: list[str]) -> int:
    """Run suites side by side: those that the words name, else `names`."""
    named, files, options = suites.parse(args.rest, SUITES, ROOT)
    if files or options:
        names = [name for name in names if name != suites.LINT]
        names += [suites.WINDOW] * any(file.startswith("tests/ui") for file in files)
    elif part != "fast" and not named:
        names += own_window()
    if not named and NEWEST_LTS in names and find_python(minor := python_minor(NEWEST_LTS)) is None:
        print(f"== {SUITES[NEWEST_LTS].title}: skipped, there is no Python 3.{minor}", flush=True)
        names.remove(NEWEST_LTS)
    plan = suites.Plan(part, named or names, [FLOOR, *BLENDER_OTHERS, suites.WINDOW], bool(named), files, options)
    engine = ensure_engine()  # every suite starts engines
    if {"engine", "farm"} & set(plan.suites):
        ensure_blender()  # they run `drgs render` through it
    if "engine" in plan.suites:
        ensure_node()
        ensure_capture(engine)
    pythons = {name: ensure_engine for name in SUITES} | {
        "blender": ensure_blender,
        FLOOR: lambda: ensure_blender(BLENDER_FLOOR),
    }
    for series, version in BLENDER_OTHERS.items():
        pythons[series] = functools.partial(ensure_blender, version)
    return suites.run(plan, SUITES, pythons, ROOT, os.environ | {"DRGS_ENGINE": str(engine)})


def own_window() -> list[str]:
    """The window's suite where a Blender is named for it, or there is one and Xvfb; otherwise say why not."""
    reason = no_window()
    if not reason and not os.environ.get("DRGS_UI_BLENDER") and not shutil.which("Xvfb"):
        reason = "Xvfb is not installed, and the screen is yours: ask for it by name"
    if reason:
        print(f"== a window: skipped, {reason}", flush=True)
    return [] if reason else [suites.WINDOW]


def no_window() -> str:
    """Why there is no Blender with a window, "" where there is one."""
    program = os.environ.get("DRGS_UI_BLENDER") or shutil.which("blender")
    if not program:
        return "there is no Blender on the PATH, and DRGS_UI_BLENDER names none"
    command = [program] if Path(program).is_file() else shlex.split(program)
    try:
        said = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=120).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{program} does not start ({error})"
    found = re.match(r"Blender (\d+)\.(\d+)", said)
    if found is None:
        return f"{program} does not say which Blender it is"
    oldest = tuple(int(part) for part in BLENDER_FLOOR.split(".")[:2])
    if (int(found[1]), int(found[2])) < oldest:
        return f"Blender {found[1]}.{found[2]} is older than {oldest[0]}.{oldest[1]}"
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not shutil.which("Xvfb"):
        return "there is no display, and no Xvfb"
    return ""


# Programs of the project


def run_demo(args: argparse.Namespace) -> int:
    """Render the demo, and make both environments meanwhile."""
    return with_steps("demo", args.rest)


def run_demo_simulation(args: argparse.Namespace) -> int:
    """Bake and render simulated matter, and make both environments meanwhile."""
    return with_steps("demo_simulation", args.rest)


def with_steps(script: str, rest: Sequence[str]) -> int:
    """Run a script of the examples that takes the environments as steps before its own."""
    sys.path.insert(0, str(ROOT / "examples"))
    return int(importlib.import_module(script).main(rest, environments()))


def run_bench(args: argparse.Namespace) -> int:
    """Measure."""
    return with_both("bench/run.py", args.rest)


def run_extension(args: argparse.Namespace) -> int:
    """Build the extension."""
    return with_both("tools/extension.py", args.rest)


def run_docs(args: argparse.Namespace) -> int:
    """Build the site: the reference of Blender's side by Blender, all else by the generator."""
    blender, generator = ensure_blender(), ensure_docs()
    pages = ROOT / "build" / "docs" / "blender"
    print("== reference of operators and properties, by Blender", flush=True)
    shutil.rmtree(pages, ignore_errors=True)
    command = [str(blender), str(ROOT / "tools" / "blender_reference.py"), "--out", str(pages)]
    try:
        code = subprocess.run(command, cwd=ROOT, timeout=REFERENCE_SECONDS).returncode
    except subprocess.TimeoutExpired as error:
        raise Failure(f"tools/blender_reference.py did not end within {REFERENCE_SECONDS} s; run it alone") from error
    return code or run([generator, ROOT / "tools" / "docs.py", *args.rest])


def with_both(program: str, rest: Sequence[str]) -> int:
    """Run a program of the project in the engine's environment; `DRGS_BLENDER` names Blender's."""
    both()
    os.environ.setdefault("DRGS_BLENDER", str(python_of(blender_folder(BLENDER))))
    return run([python_of(ROOT / ".venv"), ROOT / program, *rest])


def run_clean(args: argparse.Namespace) -> int:
    """Remove what can be made again."""
    folders = [ROOT / name for name in ("build", "dist", "out", ".pytest_cache", ".ruff_cache", ".mypy_cache")]
    if args.all:
        folders += [*ROOT.glob(".venv*"), *ROOT.glob("*.egg-info")]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    return 0


def run(command: Sequence[str | Path]) -> int:
    """Run a command with DRGS_ENGINE set; on an interrupt end it with all its children; its exit code."""
    environment = os.environ | {"DRGS_ENGINE": str(python_of(ROOT / ".venv"))}
    own_group = os.name != "nt"
    process = subprocess.Popen([str(part) for part in command], cwd=ROOT, env=environment, start_new_session=own_group)
    try:
        return process.wait()
    finally:
        job_runner.end(process, patience=0.0)


if __name__ == "__main__":
    sys.exit(main())
