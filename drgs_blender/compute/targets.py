"""The processors for which kernels are compiled: few fixed ones, so that machines of different make agree.

A kernel is not compiled for the processor at hand but for the best of these that it has. So the nodes of a farm draw
the same frame bit for bit, and a release can bring kernels that are compiled already. What that costs against the
processor's own instruction set stands in docs/benchmarks.md (Starting).
"""

from __future__ import annotations

import os
import platform
from typing import Any

#: Target -> what the processor must have, in LLVM's words.  x86-64 psABI levels 3 and 4.
_V3 = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave")
_V4 = (*_V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")
TARGETS = {"x86-64-v4": _V4, "x86-64-v3": _V3}
#: Features on top of the name. LLVM's x86-64-v4 would split sixteen lanes in two halves of 256 bits.
_FEATURES = {"x86-64-v4": "-prefer-256-bit", "x86-64-v3": ""}
#: For processors that have none of these.
NATIVE = "native"


def choose() -> str:
    """Name of the target of this process.

    ``DRGS_CPU_TARGET`` or the best of `TARGETS` that the processor has; `NATIVE` is what LLVM finds out itself, and
    all there is on Arm.
    """
    if asked := os.environ.get("DRGS_CPU_TARGET"):
        return asked
    if platform.machine().lower() in ("x86_64", "amd64"):
        from llvmlite import binding

        has = binding.get_host_cpu_features()
        for name, needs in TARGETS.items():
            if all(has.get(feature, False) for feature in needs):
                return name
    return NATIVE


def settle(config: Any) -> None:
    """Set the target of this process in Numba's configuration, before anything is compiled."""
    target = choose()
    if target != NATIVE:
        config.CPU_NAME, config.CPU_FEATURES = target, _FEATURES.get(target, "")
