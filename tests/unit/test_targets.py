"""The processors for which kernels are compiled: chosen by what a processor has, refused where it lacks something."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drgs_blender.compute import targets
from drgs_blender.core.errors import DeviceError, UsageError

ROOT = Path(__file__).resolve().parents[2]
V4, V3 = (next(t for t in targets.TARGETS if t.name == name) for name in ("x86-64-v4", "x86-64-v3"))


def features(*names: str, without: str = "") -> dict[str, bool]:
    """A processor as LLVM describes it: what it lacks is named as well, or not at all."""
    return {name: name != without for name in (*names, "sse2", "gfni")}


@pytest.mark.parametrize(
    ("machine", "system", "has", "name"),
    [
        ("x86_64", "Linux", features(*V4.needs), "x86-64-v4"),
        ("x86_64", "Windows", features(*V4.needs), "x86-64-v4"),
        ("x86_64", "Linux", features(*V4.needs, without="avx512dq"), "x86-64-v3"),
        ("x86_64", "Darwin", features(*V3.needs), "x86-64-v3"),
        ("x86_64", "Linux", features(*V3.needs, without="fma"), None),
        ("x86_64", "Linux", features(*V4.needs, without="avx2"), None),
        ("x86_64", "Linux", {}, None),
        ("arm64", "Darwin", {}, "apple-m1"),
        ("arm64", "Linux", {}, "armv8-a"),
        ("arm64", "Windows", {}, None),
        ("riscv64", "Linux", features(*V4.needs), None),
    ],
)
def test_the_best_target_that_a_processor_has(machine, system, has, name):
    found = targets.decide("", machine, system, has)
    assert (found and found.name) == name
    assert targets.decide("native", machine, system, has) is None


def test_every_single_feature_counts():
    for missing in V4.needs:
        found = targets.usable("x86_64", "Linux", features(*V4.needs, without=missing))
        assert V4 not in found and (V3 in found) == (missing not in V3.needs)


def test_a_lower_target_can_be_asked_for():
    assert targets.decide("x86-64-v3", "x86_64", "Linux", features(*V4.needs)) is V3


def test_a_target_that_the_processor_lacks_is_refused_by_name():
    with pytest.raises(DeviceError, match=r"x86-64-v4, which this processor cannot run: it lacks avx512bw\. .*-v3"):
        targets.decide("x86-64-v4", "x86_64", "Linux", features(*V4.needs, without="avx512bw"))
    with pytest.raises(DeviceError, match=r"apple-m1.*Set it to native"):
        targets.decide("apple-m1", "x86_64", "Linux", {})
    with pytest.raises(UsageError, match=r"znver4.*none of native, x86-64-v4"):
        targets.decide("znver4", "x86_64", "Linux", features(*V4.needs))


def test_llvm_knows_the_targets_of_this_machine():
    """Of one that it does not know, LLVM says so on standard error and goes on with less, or ends."""
    program = (
        "from llvmlite import binding as b; b.initialize_native_target(); b.initialize_native_asmprinter()\n"
        "m = b.Target.from_default_triple().create_target_machine(cpu={0!r}, features={1!r})\n"
        "m.emit_object(b.parse_assembly('define i32 @f() {{ ret i32 1 }}'))\n"
    )
    for cpu, wanted in [*((t.cpu, t.features) for t in targets.here()), ("no-such-one", "")]:
        done = subprocess.run([sys.executable, "-c", program.format(cpu, wanted)], capture_output=True, text=True)
        known = done.returncode == 0 and "recognized" not in done.stderr
        assert known == (cpu != "no-such-one"), done.stderr


@pytest.mark.parametrize("first", ["", "import numba; "])
def test_numba_compiles_for_the_target_and_children_decide_for_themselves(first):
    program = (
        f"{first}import os; from drgs_blender.compute import jit, targets\n"
        "jit.njit(lambda x: x + 1, cache=False)(1)\n"
        "tuple_ = jit.numba.core.registry.cpu_target.target_context.codegen().magic_tuple()\n"
        "print(targets.current(), *tuple_[1:], 'NUMBA_CPU_NAME' in os.environ)\n"
    )
    usable = targets.usable(targets.machine_name(), targets.platform.system(), _host())
    for target in usable:
        environment = os.environ | {"DRGS_CPU_TARGET": target.name, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == [target.name, target.cpu, *target.features.split(), "False"]


def _host() -> dict[str, bool]:
    from llvmlite import binding

    return dict(binding.get_host_cpu_features())


@pytest.mark.parametrize(("name", "code"), [("no-such-processor", 64), ("apple-m1", 69)])
def test_the_command_line_says_what_is_wrong_with_a_target(name, code, tmp_path):
    if name in [t.name for t in targets.here()]:
        pytest.skip("this processor has it")
    command = [sys.executable, "-m", "drgs_blender.cli.main", "make", ROOT / "examples/spot/spot_triangulated.obj"]
    environment = os.environ | {"DRGS_CPU_TARGET": name}
    done = subprocess.run(
        [*command, "--out", tmp_path / "a.drgs"], env=environment, capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == code, done.stderr
    assert f"DRGS_CPU_TARGET: is {name}" in done.stderr and "Traceback" not in done.stderr
