"""Numba's shortcuts: the results are those of plain Numba, no memory is lost, and Numba is left as it was."""

import gc
import itertools
import sys
from typing import NamedTuple

import numba
import numpy as np
import pytest
from llvmlite import binding
from numba.core import ir, postproc, types
from numba.core.runtime import _nrt_python, rtsys

from drgs_blender.compute import kernel_compiler, numba_shortcuts
from drgs_blender.compute.jit import njit

pytestmark = pytest.mark.skipif(not kernel_compiler.is_tested(), reason="Numba compiles in its own way")


class Pair(NamedTuple):
    """Two arrays."""

    a: np.ndarray
    b: np.ndarray


def _methods() -> list:
    return [types.BaseFunction.get_call_type, postproc.PostProcessor.run, ir.Inst._rec_list_vars]


@pytest.mark.parametrize("sign", ["+", "/", "//", "<"])
def test_operators_of_mixed_types_are_those_of_numba(sign) -> None:
    """What is remembered for some types is not taken for others."""
    pairs = ", ".join(f"{a} {sign} {b}" for a, b in itertools.product("abcd", "abcd"))
    space: dict = {}
    exec(f"def calls(a, b, c, d):\n    return {pairs}", space)
    own, plain = njit(space["calls"], cache=False), numba.njit(space["calls"], error_model="numpy")
    numbers = np.int32(-7), np.uint8(3), np.float32(0.3), True
    np.testing.assert_array_equal(own(*numbers), plain(*numbers))
    assert own.nopython_signatures == plain.nopython_signatures


def test_lifetimes_of_branches_and_loops() -> None:
    """Variables that live across blocks, are written on one side only, or are read after a loop."""

    def branches(values, limit):
        best, at = -1.0, -1
        for i in range(len(values)):
            if values[i] > limit:
                continue
            scaled = values[i] * 2
            if scaled > best:
                best, at = scaled, i
            while scaled > 1:
                scaled /= 2
                if scaled < 0.7:
                    break
            else:
                best += scaled
        return best, at

    values = np.random.default_rng(1).uniform(0, 4, 100)
    assert njit(branches, cache=False)(values, 3.0) == numba.njit(branches)(values, 3.0) == branches(values, 3.0)


@njit(cache=False)
def _row(pair, i):
    return pair.a[i]


@njit(cache=False)
def _made(n):
    return np.full(n, 2.0)


@njit(cache=False)
def _total(pair):
    total = 0.0
    for i in range(len(pair.a)):
        row = _row(pair, i)  # a view, which a function returned
        total += (row * pair.b).sum() + _made(len(row)).sum()
    return total


@njit(cache=False)
def _swapped(pair):
    other = Pair(pair.b, pair.a)
    return other


@njit(cache=False)
def _raises(pair, limit):
    made = np.zeros(len(pair.b))
    if pair.b[0] > limit:
        raise ValueError("too much")
    return made


@pytest.fixture
def counted():
    """Numba counts what it allocates and frees."""
    rtsys.initialize(numba.core.registry.cpu_target.target_context)
    _nrt_python.memsys_enable_stats()
    yield
    _nrt_python.memsys_disable_stats()


def test_no_reference_is_lost_or_kept(counted) -> None:
    """Arrays that are lent, viewed, made, returned in records or left behind by an error."""
    pair = Pair(np.ones((4, 3)), np.arange(3.0))
    _total(pair), _swapped(pair), _raises(pair, 1.0)  # compiled
    gc.collect()
    held = [sys.getrefcount(array) for array in pair]
    begun = rtsys.get_allocation_stats()
    for _ in range(100):
        assert _total(pair) == 4 * 3.0 + 4 * 6.0
        swapped = _swapped(pair)
        assert swapped.a is not None and np.shares_memory(swapped.a, pair.b)
        assert _raises(pair, 1.0).shape == (3,)
    del swapped
    gc.collect()
    stats = rtsys.get_allocation_stats()
    assert stats.alloc - begun.alloc == stats.free - begun.free > 0
    assert [sys.getrefcount(array) for array in pair] == held


def _assigns(a, b, chosen, out):
    out[:] = a + b


def _overlaps(a, b, chosen, out):
    out[1:] = out[:-1]


def _picks(a, b, chosen, out):
    for i, value in enumerate(a[chosen]):
        out[i] = value


def _places(a, b, chosen, out):
    out[chosen] = b[chosen]


def _adds(a, b, chosen, out):
    out += a * 2 - b


def _turns(a, b, chosen, out):
    both = (a, b) if len(chosen) > 1 else (b, a)
    for x, y in zip(both[0][::-1], both[1].reshape(2, -1).T.ravel()):
        out[0] += x * y


def _fails(a, b, chosen, out):
    if a[0] < 10:
        raise ValueError(f"{a[0]}")


@pytest.mark.parametrize("function", [_assigns, _overlaps, _picks, _places, _adds, _turns, _fails])
def test_ways_to_make_arrays_without_a_call(function, counted) -> None:
    """Results are Numba's, and what was made on the way is freed."""

    def run(compiled) -> np.ndarray:
        out = np.arange(6.0)
        try:
            compiled(np.linspace(1, 2, 6), np.linspace(3, 9, 6) ** 2, np.array([4, 0, 4]), out)
        except ValueError:
            assert function is _fails
        return out

    own = njit(function, cache=False)
    np.testing.assert_array_equal(run(own), run(numba.njit(function)))
    begun = rtsys.get_allocation_stats()
    for _ in range(20):
        run(own)
    stats = rtsys.get_allocation_stats()
    if function is not _fails:  # the text of an error stays with Numba
        assert stats.alloc - begun.alloc == stats.free - begun.free


_ORDER = np.array([2, 0, 1])


@njit(cache=False)
def _changes_index(pair):
    i = 0
    a = pair[i]
    i = 1
    b = pair[i]
    return a[0] + b[0, 0]


@njit(cache=False)
def _lends(n):
    return _changes_index((np.ones(n), np.ones((n, n))))


@njit(cache=False)
def _reorders(n):
    return _reordered(np.arange(float(n)))


@njit(cache=False)
def _reordered(a):
    b = a[_ORDER]
    return b[0] + a.imag[1]


@pytest.mark.parametrize(("function", "result"), [(_lends, 2.0), (_reorders, 2.0)])
def test_what_looks_like_a_view_and_is_not_is_freed(function, result, counted) -> None:
    assert function(5) == result
    begun = rtsys.get_allocation_stats()
    for _ in range(20):
        function(5)
    stats = rtsys.get_allocation_stats()
    assert stats.alloc - begun.alloc == stats.free - begun.free > 0


class Named(NamedTuple):
    """An array with a text."""

    name: str
    a: np.ndarray


def test_texts_in_records_and_prints(capfd) -> None:
    """A text that comes with arrays is released; what is printed is the view, not the array that it is of."""

    @njit(cache=False)
    def first(named):
        return named.a[0]

    @njit(cache=False)
    def shows(a):
        print(a[1])

    text = "".join(["a text", " of its own"])
    named = Named(text, np.ones(3))
    assert first(named) == 1.0
    held = sys.getrefcount(text)
    for _ in range(50):
        first(named)
    assert sys.getrefcount(text) == held
    shows(np.arange(6.0).reshape(2, 3))
    assert capfd.readouterr().out.strip() == "[3. 4. 5.]"


def test_what_a_kernel_returns_outlives_its_arguments() -> None:
    row = _row(Pair(np.full((2, 1000), 7.0), np.zeros(1)), 1)
    gc.collect()
    others = [np.zeros(1000) for _ in range(100)]
    assert (row == 7.0).all() and len(others) == 100


def test_functions_that_borrow_count_no_references() -> None:
    """What only reads its arrays has no counting in its code; what makes arrays has."""

    def code(function, *arguments) -> str:
        function(*arguments)
        return function.inspect_llvm(function.signatures[-1])

    @njit(cache=False)
    def reads(pair, out):
        for i in range(len(out)):
            out[i] = pair.b[i] + pair.a[i, 0]

    @njit(cache=False)
    def makes(n):
        return np.zeros(n)

    assert "NRT_incref" not in code(reads, Pair(np.ones((3, 3)), np.ones(3)), np.zeros(3))
    assert "NRT_MemInfo" in code(makes, 3)


def test_numba_is_left_as_it_was() -> None:
    """After a kernel, and after one that does not compile."""
    before = _methods()

    @njit(cache=False)
    def wrong(a):
        return a + "text"

    with pytest.raises(numba.TypingError):
        wrong(1)
    njit(lambda a: a + 1, cache=False)(1)
    assert _methods() == before
    with numba_shortcuts.shortcuts():
        assert all(now is not then for now, then in zip(_methods(), before, strict=True))


def test_functions_that_several_call_are_linked_once(monkeypatch) -> None:
    """Calls in a diamond, one branch of it never taken, of kernels of ours and of a function of Numba's own kind."""

    @njit
    def bottom(x):
        total = 0.0
        for k in range(3):
            total += x * k
        return total

    @njit
    def left(x, taken):
        return bottom(x) if taken else 1.0

    @njit
    def right(x):
        return bottom(x) + left(x, True)

    def top(x):
        return left(x, False) + right(x) + bottom(x + 1)

    linked: list[str] = []
    link_in = binding.ModuleRef.link_in

    def record(self: binding.ModuleRef, other: binding.ModuleRef, preserve: bool = False) -> None:
        if preserve:  # a library, not a part of this one
            linked.extend(each.name for each in other.functions if not each.is_declaration)
        link_in(self, other, preserve)

    monkeypatch.setattr(binding.ModuleRef, "link_in", record)
    ours, numbas = njit(top, cache=False), numba.njit(top)
    assert ours(2.0) == 22.0
    functions = [name for name in linked if any(part in name for part in ("bottom", "left", "right"))]
    assert len(functions) == len(set(functions)) >= 3, functions
    assert numbas(2.0) == top(2.0) == 22.0
    other = njit(lambda x: right(x), cache=False)
    assert other(2.0) == 12.0
