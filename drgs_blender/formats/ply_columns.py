"""Columns of PLY files: some of them side by side, and what is left of them."""

from __future__ import annotations

import re

import numpy as np

Array = np.ndarray
Columns = dict[str, Array]


def stack(columns: Columns, names: tuple[str, ...]) -> Array:
    """Columns side by side as (n, len(names)) float32."""
    result = np.empty((len(columns[names[0]]), len(names)), np.float32)
    side = beside(columns, names)
    if side is not None:
        result[:] = side
    else:
        for i, name in enumerate(names):
            result[:, i] = columns[name]
    return result


def beside(columns: Columns, names: tuple[str, ...]) -> Array | None:
    """Columns that are neighbours in the file as one view of it, which is passed over once; None where they are not."""
    arrays = [columns[name] for name in names]
    first = arrays[0]
    if not all(a.dtype == np.float32 and a.strides == first.strides for a in arrays):
        return None
    if not all(a.ctypes.data == first.ctypes.data + 4 * i for i, a in enumerate(arrays)):
        return None
    shape = (len(first), len(names))
    return np.lib.stride_tricks.as_strided(first, shape, (*first.strides, 4), writeable=False)


def extra_columns(columns: Columns, names: set[str]) -> dict[str, Array]:
    """Properties that a surfel cannot hold; normals and numbered ones (a_0, a_1, ...) joined into one array each."""
    families: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        match = re.fullmatch(r"(.+?)_?(\d{1,6})", name)
        if match and match[1] not in names and not re.fullmatch("n[xyz]", match[1]):
            families.setdefault(match[1], []).append((int(match[2]), name))
    groups = {key: tuple(n for _, n in sorted(found)) for key, found in families.items() if len(found) > 1}
    for suffix in ("", "2"):
        axes = (f"nx{suffix}", f"ny{suffix}", f"nz{suffix}")
        if names.issuperset(axes):
            groups[f"normal{suffix}"] = axes
    grouped = {name for members in groups.values() for name in members}
    groups |= {name: (name,) for name in names - grouped}
    extras: dict[str, Array] = {}
    for key, members in sorted(groups.items()):
        values = stack(columns, members)
        if values.any():  # 3DGS and others write normals that are always zero
            extras[key] = values if len(members) > 1 else values[:, 0]
    return extras


def sanitised(extras: dict[str, Array], notes: list[str]) -> dict[str, Array]:
    """Extras with non-finite values set to 0, and said so."""
    for name, values in extras.items():
        bad = ~np.isfinite(values)
        if bad.any():
            notes.append(f"{int(bad.sum())} values of {name} that were NaN or infinite set to 0")
            values[bad] = 0.0
    return extras
