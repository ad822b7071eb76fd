"""Check what DR-GS needs on this computer: versions, Embree, OpenEXR, the engine, Blender, folders, variables.

Exit code 0 when rendering works, 69 when something essential is missing; each problem comes with its remedy.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import os
import platform
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from ..compute import numba_variables, targets
from ..core.errors import EXIT_NO_DEVICE, EXIT_OK, DeviceError, DrgsError
from ..core.own_python import install_remedy
from ..core.version import __version__

EXAMPLES = """examples:
  drgs doctor
  drgs doctor --json
  drgs doctor --node
  DRGS_BLENDER=/opt/blender/blender drgs doctor
"""

#: Earlier versions have known holes that a damaged file can use.
OPENEXR_MINIMUM = (3, 4, 10)
#: Jobs of `compute.manifest` in words.
_JOBS = {
    "frame": "rendering",
    "coupled": "simulation of several bodies",
    "denoise": "denoising",
    "hdr": ".hdr environments",
    "lights": "lights",
    "mattes": "Cryptomatte",
    "mesh": "--camera-sees mesh",
    "motion": "motion vectors",
    "reconstruct": "reconstruction",
    "simulate": "simulation",
    "surfel rays": "--rays-see surfels",
}
#: Variables that make several checks fail -> the one where that is said.
_SAID_AT = {targets.VARIABLE: "kernels", numba_variables.THREADS: "Numba", numba_variables.DISABLED: "Numba"}
_PACKAGE = "." if (Path(__file__).parents[2] / "pyproject.toml").is_file() else "drgs-blender"
_REINSTALL = f"Install it again: pip install --upgrade {_PACKAGE}"


@dataclass(slots=True)
class Finding:
    """The outcome of one check.

    ``state`` is "ok", "none" (not there and not needed), "absent" (optional, not there) or "missing" (essential).
    """

    name: str
    state: str
    detail: str
    remedy: str = ""


class NotNeeded(Exception):
    """Something is not there that rendering does without; (detail, remedy)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs doctor``."""
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--node", action="store_true", help="as a node of a farm: Blender and extension are needed")
    parser.add_argument(
        "--blender", metavar="PATH", help="blender program, or a Python (or its environment) that has bpy"
    )


def run(args: argparse.Namespace) -> int:
    """Check everything, print what was found."""
    checks = NODE_CHECKS if args.node else CHECKS
    findings = [check(name, essential, test, args) for name, essential, test in checks]
    healthy = all(finding.state != "missing" for finding in findings)
    if args.json:
        print(json.dumps({"healthy": healthy, "checks": [asdict(finding) for finding in findings]}, indent=2))
    else:
        for finding in findings:
            print(f"{finding.state:8} {finding.name:12} {finding.detail}")
            if finding.remedy:
                print(f"{'':22}{finding.remedy}")
        print("DR-GS can render here." if healthy else "DR-GS cannot render here until what is missing is there.")
    return EXIT_OK if healthy else EXIT_NO_DEVICE


def check(name: str, essential: bool, test: Callable[[argparse.Namespace], str], args: argparse.Namespace) -> Finding:
    """Run one test; what it raises becomes the finding."""
    state = "missing" if essential else "absent"
    try:
        return Finding(name, "ok", test(args))
    except NotNeeded as reason:
        return Finding(name, "none", *reason.args)
    except DrgsError as error:
        if where := _SAID_AT.get(error.subject):
            if where != name:
                return Finding(name, "none", f"not checked: see {where}")
            state = "missing"  # no kernel can be called
        subject = "" if error.subject.lower() == name.lower() else f"{error.subject}: "
        return Finding(name, state, f"{subject}{error.problem}", error.remedy)
    except ImportError as error:
        return Finding(name, state, str(error), _REINSTALL)
    except OSError as error:
        return Finding(name, state, str(error), "Check the path and its permissions")


def python(args: argparse.Namespace) -> str:
    """Interpreter and version of DR-GS."""
    return f"{platform.python_version()} at {sys.executable}, drgs {__version__}, {platform.platform(terse=True)}"


def numba(args: argparse.Namespace) -> str:
    """Numba and its threads."""
    from ..compute.jit import numba

    return f"{numba.__version__}, {numba.config.NUMBA_NUM_THREADS} threads"


def cache(args: argparse.Namespace) -> str:
    """Whether compiled kernels can be kept."""
    from ..compute.folders import cache_folder, wanted_folder

    if trouble := cache_folder().trouble:
        remedy = "Set DRGS_CACHE_DIR to a folder that is yours and can be written"
        raise DeviceError("kernel cache", trouble, remedy)
    return str(wanted_folder())


def kernels(args: argparse.Namespace) -> str:
    """The processor for which kernels are compiled, and how many are."""
    from ..compute import prepare, shipped, targets
    from ..compute.jit import numba

    wanted, own = shipped.versions(), {"numba": numba.__version__, "llvmlite": importlib.metadata.version("llvmlite")}
    counts = prepare.count_kernels()
    purposes = f", for {', '.join(_JOBS.get(job, job) for job in counts.jobs)}" if counts.jobs else ""
    missing = f"; {counts.missing} are compiled when first needed{purposes}" if counts.missing else ""
    text = f"{targets.current()}, {counts.shipped + counts.compiled} ready ({counts.shipped} shipped){missing}"
    if wanted and wanted != own:
        other = " and ".join(f"{name} {version}" for name, version in wanted.items())
        remedy = f"To use those of the release: pip install {' '.join(f'{n}=={v}' for n, v in wanted.items())}"
        raise DeviceError("kernels", f"{text}; those of the release were made with {other}", remedy)
    return text


def embree(args: argparse.Namespace) -> str:
    """Embree, loaded as the renderer loads it."""
    from ..render.scene.embree import library

    return f"embreex {importlib.metadata.version('embreex')}, {Path(library()._name).name}"


def openexr(args: argparse.Namespace) -> str:
    """OpenEXR of a safe version."""
    import OpenEXR

    version = importlib.metadata.version("OpenEXR")
    if tuple(int(part) for part in version.split(".")[:3] if part.isdigit()) < OPENEXR_MINIMUM:
        minimum = ".".join(map(str, OPENEXR_MINIMUM))
        raise DeviceError("OpenEXR", f"is {version}, older than {minimum}", "Run: pip install --upgrade OpenEXR")
    return f"{version} at {Path(OpenEXR.__file__).parent}"


def oidn(args: argparse.Namespace) -> str:
    """OpenImageDenoise, loaded as its denoisers load it."""
    from ..render.denoise.oidn import require

    require()
    return f"pyoidn {importlib.metadata.version('pyoidn')}"


def engine(args: argparse.Namespace) -> str:
    """Start an engine process as the extension does, and shake hands."""
    from ..ipc.client import EngineClient, engine_command, locate_engine

    command = locate_engine() if os.environ.get("DRGS_ENGINE") else engine_command()
    with EngineClient(command) as client:
        client.start()
        return f"answers, {command[0]}"


def blender(args: argparse.Namespace) -> str:
    """A Blender for `drgs render`."""
    from .find_blender import find_blender

    found = find_blender(args.blender)
    return f"{found.version()}, {found.program} ({found.origin})"


def extension(args: argparse.Namespace) -> str:
    """The extension in that Blender, enabled and greeted as for a render."""
    from .blender_process import BlenderProcess
    from .find_blender import extension_source, find_blender

    job = {"scene": "", "frames": [], "scripts": False, "passes": None}
    with BlenderProcess(find_blender(args.blender), job, str):
        return f"answers, {extension_source() or 'installed there'}"


def scikit_image(args: argparse.Namespace) -> str:
    """scikit-image, which builds the mesh of a capture that has none."""
    from skimage.measure import marching_cubes

    return f"{importlib.metadata.version('scikit-image')} at {Path(marching_cubes.__code__.co_filename).parents[1]}"


def torch(args: argparse.Namespace) -> str:
    """PyTorch, which relighting does not need."""
    try:
        return importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        raise DeviceError(
            "torch",
            "is not installed",
            f"Only reconstruction needs it: {install_remedy('torch', 'Reconstruction from Photographs')}",
        ) from None


def capture(args: argparse.Namespace) -> str:
    """Libraries that find the cameras of photographs and videos, and that run models of masks. They are not loaded."""
    from ..capture import libraries

    found, absent = [], []
    for name, library in libraries.LIBRARIES.items():
        if name == "torch":  # a row of its own
            continue
        package = re.split("[<>=]", library.package)[0]
        try:
            found.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            absent.append(name)
    if absent:
        remedy = f"Only drgs capture needs it: {libraries.install_command(absent)}"
        raise DeviceError(", ".join(absent), "not installed", remedy)
    return ", ".join(found)


def variables(args: argparse.Namespace) -> str:
    """Environment variables that are set."""
    return (
        ", ".join(f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("DRGS_")) or "none"
    )


def gpu(args: argparse.Namespace) -> str:
    """The graphics card that `--device cuda` uses."""
    from ..compute.warp.runtime import cuda_devices, warp
    from ..render.gpu.select_backend import card

    with _no_stderr():
        try:
            warp()
        except DeviceError as error:
            raise NotNeeded(f"{error.problem}; the CPU renders", error.remedy) from None
        if not cuda_devices():
            raise NotNeeded("no NVIDIA GPU found; the CPU renders", "If there is one, install or update its driver")
        return card()


@contextlib.contextmanager
def _no_stderr() -> Iterator[None]:
    """Without what libraries write to stderr: Warp's own code warns there of what the finding says."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


#: name, essential?, test
CHECKS: tuple[tuple[str, bool, Callable[[argparse.Namespace], str]], ...] = (
    ("Python", True, python),
    ("Numba", True, numba),
    ("kernel cache", False, cache),
    ("kernels", False, kernels),
    ("Embree", True, embree),
    ("OpenEXR", True, openexr),
    ("OIDN", False, oidn),
    ("engine", True, engine),
    ("Blender", False, blender),
    ("scikit-image", False, scikit_image),
    ("torch", False, torch),
    ("capture", False, capture),
    ("GPU", False, gpu),
    ("variables", False, variables),
)

#: Those of a node of a farm: what it renders with has to be there, in one version.
NODE_CHECKS = (*(c for c in CHECKS if c[2] is not blender), ("Blender", True, blender), ("extension", True, extension))
