"""Scalar code on a device: translated functions give Numba's results to the last bit, or are refused by name."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, IS_CARD, assert_same

from drgs_blender.compute.jit import njit
from drgs_blender.compute.warp.kernels import Launcher, ScratchArray, WarpKernel
from drgs_blender.compute.warp.runtime import load_module, warp
from drgs_blender.compute.warp.translate import Native, Translation, replacing
from drgs_blender.compute.warp.types import Array, Struct, TranslationError
from drgs_blender.core.frame import World
from drgs_blender.render import sampling
from drgs_blender.render.gpu.native_functions import NATIVES
from drgs_blender.render.integrator import brdf, wavefront
from drgs_blender.render.lights import environment

F, U = np.float32, np.uint32
ONE = F(1.0)
_STEPS = 3


class Scale(NamedTuple):
    factor: np.float32
    turns: int


class Pair(NamedTuple):
    first: Scale
    second: Scale


def on_device(function: Any, columns: list[np.ndarray], extra: tuple = (), natives: Any = NATIVES) -> np.ndarray:
    """(n, results) float64 of a translated function for rows of numbers, followed by the same named tuples for all."""
    translation = Translation(natives)
    kinds = [column.dtype.name for column in columns]
    made = translation.function(function, [*kinds, *(Struct(type(e)) for e in extra)])
    results = len(made.result) if isinstance(made.result, tuple) else 1
    names = [f"x{i}" for i in range(len(columns))]
    arrays = [f"{name}: {Array(kind)}" for name, kind in zip(names, kinds)]
    structs = [f"e{i}: {translation.struct(type(e))}" for i, e in enumerate(extra)]
    call = f"{made.name}({', '.join([*(f'{n}[t]' for n in names), *(f'e{i}' for i in range(len(extra)))])})"
    found = ", ".join(f"r{i}" for i in range(results))
    writes = "\n".join(f"    out[t, {i}] = wp.float64(r{i})" for i in range(results))
    translation.add(
        f"@wp.kernel\ndef run({', '.join([*arrays, *structs])}, out: {Array('float64', 2)}):\n"
        f"    t = wp.tid()\n    {found} = {call}\n{writes}"
    )
    wp, module = warp(), load_module(translation.source)
    inputs = [wp.array(c, dtype=getattr(wp, k), device=DEVICE) for c, k in zip(columns, kinds)]
    for value in extra:
        struct = getattr(module, type(value).__name__)()
        for name, part in value._asdict().items():
            setattr(struct, name, part)
        inputs.append(struct)
    out = wp.zeros((len(columns[0]), results), dtype=wp.float64, device=DEVICE)
    wp.launch(module.run, dim=len(columns[0]), inputs=[*inputs, out], device=DEVICE)
    return out.numpy()


def here(function: Any, columns: list[np.ndarray], extra: tuple = ()) -> np.ndarray:
    """The same by Numba."""
    compiled = function if hasattr(function, "py_func") else njit(function, cache=False)
    rows = [compiled(*row, *extra) for row in zip(*columns)]
    return np.array([row if isinstance(row, tuple) else (row,) for row in rows], np.float64)


def floats(count: int, *bounds: tuple[float, float], seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(*b, count).astype(np.float32) for b in bounds]


def units(count: int, seed: int = 0) -> list[np.ndarray]:
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return list((v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32).T)


@njit
def _evaluate(nl, nv, vl, nh2, sin2, r, g, b, kd, metallic, a2, norm, shading_model):  # type: ignore[no-untyped-def]
    weights = kd, (metallic, metallic, metallic), sampling.ONE - metallic
    return brdf.evaluate((nl, nv, vl, nh2, sin2), (r, g, b), weights, a2, norm, shading_model)


KEYS = [np.random.default_rng(1).integers(0, 2**32, 2000, dtype=np.uint32) for _ in range(2)]
RENDERER: dict[str, tuple[Any, list[np.ndarray]]] = {
    "mix": (sampling.mix, KEYS[:1]),
    "unit": (sampling.unit, KEYS[:1]),
    "scrambled": (sampling.scrambled, KEYS),
    "sincos_turns": (sampling.sincos_turns, floats(2000, (-2, 2))),
    "fast_acos": (sampling.fast_acos, floats(2000, (-1.1, 1.1))),
    "fast_atan2_turns": (sampling.fast_atan2_turns, floats(2000, (-1, 1), (-1, 1))),
    "basis": (sampling.basis, units(2000)),
    "cosine_hemisphere": (sampling.cosine_hemisphere, floats(2000, (0, 1), (0, 1))),
    "glossy_normal": (brdf.glossy_normal, [*units(500), *units(500, 1), *units(500, 2)]),
    "sample_vndf": (
        brdf.sample_vndf,
        [*floats(500, (0, 1), (0, 1)), *floats(500, (-0.5, 0.5), (-0.5, 0.5), (0.3, 0.7), (0.001, 1), (0, 1), seed=2)],
    ),
    "evaluate": (
        _evaluate,
        [*floats(500, (0.01, 1), (-0.2, 1), (-1, 1), *[(0, 1)] * 8, (0.1, 2)), np.arange(500) % 2],
    ),
}


#: Short ones: the others hold more of the language, and each takes a second to compile, here and there.
SHORT = {"unit", "scrambled", "fast_acos", "fast_atan2_turns", "basis", "cosine_hemisphere"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SHORT else []) for name in RENDERER]
)
def test_the_renderers_arithmetic_is_the_same_to_the_last_bit(name: str) -> None:
    function, columns = RENDERER[name]
    expected, found = here(function, columns), on_device(function, columns)
    if name == "glossy_normal":  # sines and arcs of two C libraries
        np.testing.assert_allclose(found, expected, atol=3e-7)
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.skipif(IS_CARD, reason="reads this process's memory")
def test_the_sky_is_looked_up_to_the_last_bit() -> None:
    image = np.random.default_rng(0).random((40, 80, 3)).astype(np.float32) ** 6
    sky = environment.EnvironmentLight(World(environment=image))
    u, v, z = floats(3000, (0, 1), (0, 1), (-1, 1))
    rows = np.random.default_rng(3).integers(0, 576, 3000)
    for function, columns in ((environment.envmap_radiance, [u, v]), (environment.envmap_pdf, [u, v, z, rows])):
        np.testing.assert_array_equal(
            on_device(function, columns, (sky.envmap,)), here(function, columns, (sky.envmap,))
        )


# --- the language ----------------------------------------------------------------------------------------------------


@njit
def _swapped(x, y):  # type: ignore[no-untyped-def]
    return y, x


def promotions(a, b, n):  # type: ignore[no-untyped-def]
    small = np.int32(n)
    return (
        a * n,
        a * b,
        small + small,
        U(n) * U(3),
        n / 7,
        math.floor(a * F(9.0)),
        n // 3,
        n % 5,
        (n + 20) >> 1,
        -small,
        a + 0.1,
        n ^ 3,
    )


def loops(a, b, n):  # type: ignore[no-untyped-def]
    total, count, last = F(0.0), 1, -1
    for i in range(n):
        if i == 2:
            continue
        for j in range(i, 2 * i + 1, 2):
            total += a * F(j)
            if j > 9:
                break
        last = i
    while count < n and not total > b * F(100.0):
        count = 2 * count + 1
        total, b = b, total
    return total, count, last


def constants(a, b, n):  # type: ignore[no-untyped-def]
    """A variable that starts as a constant which the loop also reads: Warp once took both for one."""
    node = 1
    while node < 40:
        node = 2 * node + 1
    other = 1
    return node, other, F(0.1), U(0xFFFFFFFF), 1 << 40, 1e-300, math.pi, ONE / F(3.0), _STEPS


def choices(a, b, n):  # type: ignore[no-untyped-def]
    x = a if a > b else (b if n & 1 else -a)
    y = n > 3 and (a < b or n == 5)
    z = 0 <= n < 4 and n not in (1, 2)
    if not y and z:
        x, w = _swapped(x, b)
    else:
        w = min(a, max(b, F(0.25)))
    return x, y, z, w, abs(a - b), math.copysign(a, b), min(n, 3), bool(n)


def tuples(a, b, n):  # type: ignore[no-untyped-def]
    pair = (a, b), n
    first, _ = pair
    both = _swapped(*first)
    return both[0], both[1], pair[1], _swapped(a, n)[:1][0]


def rebound(a, b, n):  # type: ignore[no-untyped-def]
    a = a * b
    n += 2
    return a, n


def test_a_constant_of_a_module_is_replaced_and_one_that_is_gone_is_missed() -> None:
    here, sources = sys.modules[__name__], []
    for given in ({}, {"constants": replacing(here, "_STEPS", 12345)}):
        translation = Translation(NATIVES, **given)
        translation.function(constants, ["float32", "float32", "int64"])
        sources.append(translation.source)
    assert ["12345" in source for source in sources] == [False, True]
    with pytest.raises(AttributeError, match="_GONE"):
        replacing(here, "_GONE", 1)


@pytest.mark.parametrize("function", [promotions, loops, constants, choices, tuples, rebound])
def test_the_language_means_what_numba_takes_it_for(function: Callable) -> None:
    columns = [*floats(64, (-1, 1), (-1, 1)), np.arange(64) % 8]
    np.testing.assert_array_equal(on_device(function, columns), here(function, columns))


def structures(a, scale):  # type: ignore[no-untyped-def]
    pair = Pair(scale, Scale(a, 4))
    factor, turns = scale
    return pair.first.factor * pair.second.factor, pair.second.turns + turns, _swapped(*scale)[1] + factor


def test_named_tuples_are_taken_and_made() -> None:
    columns, extra = floats(20, (0, 1)), (Scale(F(0.3), 7),)
    np.testing.assert_array_equal(on_device(structures, columns, extra), here(structures, columns, extra))


class Span(NamedTuple):
    """What Warp has no struct for: an array, a tuple, a truth value known beforehand, a named tuple."""

    values: np.ndarray
    ends: tuple[np.float32, np.float32]
    doubled: bool
    scale: Scale


class Spans(NamedTuple):
    first: Span
    start: int


@njit
def _at(span, i):  # type: ignore[no-untyped-def]
    low, high = span.ends
    x = low + span.values[i] * (high - low) * span.scale.factor
    if span.doubled:
        return x + x
    return x


def records(thread, stride, scratch, spans, out):  # type: ignore[no-untyped-def]
    values, ends, _, scale = spans.first
    scratch.count[0] = len(values)
    for i in range(thread, scratch.count[0], stride):
        out[0][i] = _at(spans.first, i) + F(spans.start)
        out[1][i] = _at(Span(values, (ends[1], ends[0]), False, scale), i)


class Own(NamedTuple):
    count: Any


def test_records_hold_arrays_and_tuples_by_name() -> None:
    values = floats(40, (-1, 1))[0]
    for doubled in (False, True):
        spans = Spans(Span(values, (F(0.25), F(3.0)), doubled, Scale(F(0.3), 7)), 5)
        expected, found = np.zeros((2, 40), np.float32), np.zeros((2, 40), np.float32)
        records(0, 1, Own(np.zeros(1, np.int64)), spans, expected)
        Launcher(DEVICE).launch(WarpKernel(records, Own(ScratchArray("int64", (1,))), {}), 40, [spans], list(found))
        assert_same(found, expected, 1e-7)


def powers(a, b, n):  # type: ignore[no-untyped-def]
    x, y = float(abs(a)) + 0.1, float(b)
    return x**-y, (abs(a) + ONE) ** b, np.sin(4 * x), np.cos(4 * x), np.arccos(b), np.degrees(y)


def test_powers_and_angles() -> None:
    """By another library than the processor's, so the last digits may differ."""
    columns = [*floats(64, (-1, 1), (-1, 1)), np.arange(64)]
    np.testing.assert_allclose(on_device(powers, columns), here(powers, columns), rtol=5e-7, atol=1e-7)


def rows_of(thread, stride, scratch, table, out):  # type: ignore[no-untyped-def]
    for i in range(thread, len(table), stride):
        row = table[i]
        out[0][i] = _inner(row[1], table[i, 0]) + len(row)


@njit
def _inner(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[1] + a.shape[0]


def test_rows_of_arrays_are_arrays() -> None:
    table, found = np.random.default_rng(1).normal(size=(9, 2, 3)), np.zeros(9)
    Launcher(DEVICE).launch(WarpKernel(rows_of, (), {}), 9, [table], [found])
    np.testing.assert_array_equal(found, table[:, 1, 0] * table[:, 0, 1] + 3 + 2)


def test_a_recorded_launch_does_its_work_whenever_it_is_called() -> None:
    launcher = Launcher(DEVICE)
    table, found = launcher.array(np.ones((9, 2, 3)), copy=True), launcher.zeros((9,), "float64")
    again = launcher.recorded(WarpKernel(rows_of, (), {}), 9, [table], [found])
    assert not found.numpy().any()
    for value in (1.0, 2.0):
        table.fill_(value)
        again()
        np.testing.assert_array_equal(found.numpy(), value * value + 3 + 2)


def test_what_is_not_reached_is_not_read() -> None:
    """Conditions end early on a device too: the second operand here would be read at address 0."""
    from drgs_blender.render.memory import load_float

    def guarded(n, scale):  # type: ignore[no-untyped-def]
        if n > 5 and load_float(scale.turns, n) > ONE:
            return ONE
        return load_float(scale.turns, n) if n > 5 else F(2.0)

    assert (on_device(guarded, [np.arange(4)], (Scale(ONE, 0),)) == 2.0).all()


# --- what has no counterpart ---------------------------------------------------------------------------------------


def _makes_a_list(a):  # type: ignore[no-untyped-def]
    return [a][0]


def _two_types(a):  # type: ignore[no-untyped-def]
    x = a
    x = np.float64(a)
    return x


def _counts(a):  # type: ignore[no-untyped-def]
    pair = a, a
    return pair[int(a)]


def _unknown(a):  # type: ignore[no-untyped-def]
    return np.linalg.norm(a)


def _calls_it(a):  # type: ignore[no-untyped-def]
    b = a + ONE
    return _makes_a_list_compiled(b)


_makes_a_list_compiled = njit(_makes_a_list)


@pytest.mark.parametrize("function, words", [
    (_makes_a_list, "[a]"), (_two_types, "x: is float32 here and float64 there"), (_unknown, "norm"),
    (_counts, "pair[int(a)]"),
    (_calls_it, "[a]"),
])  # fmt: skip
def test_what_cannot_be_translated_is_named_with_its_line(function: Callable, words: str) -> None:
    with pytest.raises(TranslationError) as caught:
        Translation().function(function, ["float32"])
    assert words in str(caught.value) and "test_device_translate.py:" in str(caught.value)


def test_natives_stand_for_functions() -> None:
    native = Native("@wp.func\ndef halved(x: wp.float32):\n    return x * 0.5", "halved", "float32")

    def use(a):  # type: ignore[no-untyped-def]
        return _makes_a_list_compiled(a) + ONE

    found = on_device(use, floats(5, (0, 1)), natives={_makes_a_list: native})
    np.testing.assert_array_equal(found[:, 0], floats(5, (0, 1))[0] * F(0.5) + ONE)


def test_every_constant_of_the_wavefront_is_said_to_count_in_lanes_or_not() -> None:
    """A device divides those that do: one that is left out has it read and write beside its fields."""
    constants = {name for name, value in vars(wavefront).items() if type(value) is int}
    assert constants == set(wavefront.IN_LANES)
    assert len(wavefront.IN_LANES) == len(set(wavefront.IN_LANES))
    assert all(getattr(wavefront, name) % wavefront.LANES == 0 for name in wavefront.IN_LANES)
