"""The processors for which kernels are compiled: few fixed ones, so that machines of different make agree.

A kernel is not compiled for the processor at hand but for the best of these that it has. So the nodes of a farm run
the same code, and a release can bring kernels that are compiled already (docs/kernels.md).
"""

from __future__ import annotations

import functools
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..core.errors import DeviceError, UsageError

VARIABLE = "DRGS_CPU_TARGET"


@dataclass(frozen=True)
class Target:
    """A processor to compile for.

    Attributes
    ----------
    name : str
        Name for users.
    machine : str
        "x86_64" or "arm64".
    needs : tuple of str
        Required processor features, by LLVM's names.
    cpu, features : str
        Arguments of LLVM.
    systems : tuple of str
        Names by `platform.system` of where it is used; () is everywhere.
    """

    name: str
    machine: str
    needs: tuple[str, ...]
    cpu: str
    features: str = ""
    systems: tuple[str, ...] = ()


#: x86-64 psABI levels 3 and 4, above what level 2 has and every processor of level 3.
_V3 = ("sse4.2", "popcnt", "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave")
_V4 = (*_V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")
#: The best first.
TARGETS = (
    # LLVM's x86-64-v4 has loops use half of each register; its Zen 4 has not.
    Target("x86-64-v4", "x86_64", _V4, "x86-64-v4", "-prefer-256-bit"),
    Target("x86-64-v3", "x86_64", _V3, "x86-64-v3"),
    Target("apple-m1", "arm64", (), "apple-m1", systems=("Darwin",)),
    Target("armv8-a", "arm64", (), "generic", systems=("Linux",)),
)
#: What LLVM finds out itself: for processors that have none of these.
NATIVE = "native"
_MACHINES = {"amd64": "x86_64", "x86_64": "x86_64", "aarch64": "arm64", "arm64": "arm64"}


def machine_name() -> str:
    """This machine's architecture in the words of `Target.machine`; its own where there is no target of it."""
    own = platform.machine().lower()
    return _MACHINES.get(own, own)


def here() -> list[Target]:
    """The targets of this machine's architecture and system, whether or not its processor has them."""
    return _of(machine_name(), platform.system())


def usable(machine: str, system: str, has: Mapping[str, bool]) -> list[Target]:
    """The targets that a processor can run, the best first.

    Parameters
    ----------
    machine, system : str
        As `Target.machine` and `Target.systems`.
    has : mapping of str to bool
        Features of the processor, in LLVM's words; what is not named is not there.
    """
    return [target for target in _of(machine, system) if not _lacking(target, has)]


def decide(asked: str, machine: str, system: str, has: Mapping[str, bool]) -> Target | None:
    """The target to compile for.

    Parameters
    ----------
    asked : str
        Name of a target, "native", or "" for the best one.
    machine, system : str
        As for `usable`.
    has : mapping of str to bool
        As for `usable`.
        As for `usable`.

    Returns
    -------
    Target or None
        None is what LLVM finds out itself.

    Raises
    ------
    UsageError
        When there is no target of that name.
    DeviceError
        When this processor cannot run it: its code would end the process at an unknown instruction.
    """
    fit = usable(machine, system, has)
    if asked == NATIVE:
        return None
    if not asked:
        return fit[0] if fit else None
    known = {target.name: target for target in TARGETS}
    if asked not in known:
        raise UsageError(VARIABLE, f"is {asked}, which is none of {', '.join((NATIVE, *known))}", "Correct or unset it")
    target = known[asked]
    if target in fit:
        return target
    what = f"is {asked}, which this processor cannot run"
    if target in _of(machine, system):
        what += f": it lacks {', '.join(_lacking(target, has))}"
    choice = [t.name for t in fit] or [NATIVE]
    raise DeviceError(VARIABLE, what, f"Set it to {' or '.join(choice)}, or unset it")


def _of(machine: str, system: str) -> list[Target]:
    return [t for t in TARGETS if t.machine == machine and (not t.systems or system in t.systems)]


def _lacking(target: Target, has: Mapping[str, bool]) -> list[str]:
    return [feature for feature in target.needs if not has.get(feature, False)]


@functools.cache
def choose() -> Target | None:
    """The target of this process: that of `VARIABLE`, or the best one.

    Raises
    ------
    UsageError, DeviceError
        As `decide`.
    """
    from llvmlite import binding

    asked = os.environ.get(VARIABLE, "").strip().lower()
    return decide(asked, machine_name(), platform.system(), binding.get_host_cpu_features())


def settle(config: Any) -> None:
    """Tell Numba the target, before it compiles anything. Its own variables, where they are set, go first.

    Nothing is written to the environment: a job that this process sends to another machine must not carry it there.

    Parameters
    ----------
    config : module
        ``numba.config``.
    """
    config.reload_config()  # else Numba does when it compiles, if variables have changed, and forgets what is set here
    if config.CPU_NAME is None and config.CPU_FEATURES is None and (target := choose()) is not None:
        config.CPU_NAME, config.CPU_FEATURES = target.cpu, target.features


def current() -> str:
    """Name of the target for which this process compiles: one of `TARGETS`, "native", or Numba's CPU name."""
    from numba import config

    if config.CPU_NAME is None:
        return NATIVE
    chosen = config.CPU_NAME, config.CPU_FEATURES
    named = (t.name for t in TARGETS if (t.cpu, t.features) == chosen and t.machine == machine_name())
    return next(named, str(config.CPU_NAME))
