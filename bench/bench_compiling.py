"""Where the time of compiling a kernel goes: what Numba does in Python, and what LLVM does.

    python bench/bench_compiling.py [--kernel _kernel] [--python /usr/bin/python3.11]

``--python`` is another interpreter of the same version, which borrows this one's packages: how fast the interpreter
runs decides, as most of compiling is Python. Each interpreter compiles in processes of its own, in turn.
"""

from __future__ import annotations

import argparse
import collections
import gc
import json
import os
import statistics
import subprocess
import sys
import sysconfig
import tempfile
import time

from report import ROOT, table, write_section

#: Pass of Numba -> what it is, for readers.
PHASES = {
    "native_lowering": "LLVM code written, in Python",
    "native_parfor_lowering": "the same, of parallel loops",
    "nopython_type_inference": "types inferred, in Python",
}
RUNS = 3


def compiled(name: str) -> dict[str, float]:
    """Processor seconds of compiling one kernel of the list into an empty cache, by phase."""
    from numba.core import codegen, event

    from drgs_blender.compute import manifest

    spent: collections.Counter[str] = collections.Counter()
    stack: list[list[float]] = []

    class Passes(event.Listener):
        def on_start(self, event: event.Event) -> None:
            stack.append([time.process_time(), 0.0])

        def on_end(self, event: event.Event) -> None:
            began, inner = stack.pop()
            took = time.process_time() - began
            spent[event.data["name"].split(" [")[0]] += took - inner
            if stack:
                stack[-1][1] += took

    def timed(function: str) -> None:
        original = getattr(codegen.CPUCodeLibrary, function)

        def run(self: object) -> None:
            began = time.process_time()
            original(self)
            took = time.process_time() - began
            spent["LLVM"] += took
            if stack:
                stack[-1][1] += took

        setattr(codegen.CPUCodeLibrary, function, run)

    for function in ("_optimize_final_module", "_finalize_final_module"):
        timed(function)
    event.register("numba:run_pass", Passes())
    gc.disable()  # as the processes do that compile ahead
    kernel = next(k for kernels in manifest.jobs().values() for k in kernels if k.name == name)
    began = time.process_time()
    manifest.dispatcher(kernel).compile(manifest.signature(kernel))
    return dict(spent) | {"all": time.process_time() - began}


def in_process(python: str, name: str) -> dict[str, float]:
    """`compiled`, in a process of another interpreter that has this one's packages."""
    with tempfile.TemporaryDirectory() as cache:
        paths = [str(ROOT), str(ROOT / "bench"), sysconfig.get_path("purelib")]
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("DRGS_", "NUMBA_"))}
        environment |= {"PYTHONPATH": os.pathsep.join(paths), "DRGS_CACHE_DIR": cache, "DRGS_SHIPPED": "0"}
        command = [python, __file__, "--once", name]
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return json.loads(said.splitlines()[-1])


def main() -> None:
    """Measure, and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", default="_kernel", help="function of the list; default the integrator's")
    parser.add_argument("--python", help="another interpreter of the same version, to compare with")
    parser.add_argument("--once", metavar="KERNEL", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.once:
        print(json.dumps(compiled(options.once)))
        return
    pythons = [sys.executable, *([options.python] if options.python else [])]
    found: dict[str, list[dict[str, float]]] = {python: [] for python in pythons}
    for _ in range(RUNS):
        for python in pythons:
            found[python].append(in_process(python, options.kernel))
    own = {
        key: statistics.median(run.get(key, 0.0) for run in found[sys.executable]) for key in found[sys.executable][0]
    }
    named = [(PHASES.get(key, key), seconds) for key, seconds in own.items() if key in PHASES or key == "LLVM"]
    rest = own["all"] - sum(seconds for _, seconds in named)
    rows = [
        [what, f"{seconds:.1f}", f"{seconds / own['all']:.0%}"] for what, seconds in sorted(named, key=lambda r: -r[1])
    ]
    rows += [["other passes, in Python", f"{rest:.1f}", f"{rest / own['all']:.0%}"], ["all", f"{own['all']:.1f}", ""]]
    text = (
        f"Processor seconds of compiling the integrator's kernel, medians of {RUNS} processes with an empty cache.\n\n"
        + table(("Phase", "Seconds", "Share"), rows)
    )
    if options.python:
        other = statistics.median(run["all"] for run in found[options.python])
        version = subprocess.run([options.python, "--version"], capture_output=True, text=True).stdout.strip()
        text += (
            f"\n\n{version} of the Linux distribution, built with profile-guided optimisation, takes {other:.1f} s in "
            f"turn with this interpreter, {other / own['all']:.2f} of its time: most of compiling is Numba's Python."
        )
    write_section("compiling", "Compiling", text)


if __name__ == "__main__":
    main()
