"""Materials that are a Holdout alone: objects of such are holdouts, as by Object Properties > Visibility > Holdout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import bpy
import numpy as np

from .instances import Visible
from .sockets import surface_of


class Holdouts:
    """Which materials of an export are such."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._known: dict[int, bool] = {}

    def _is(self, material: bpy.types.Material | None) -> bool:
        """Whether a material's whole surface is a Holdout."""
        if material is None:
            return False
        key = material.as_pointer()
        if key not in self._known:
            ref = surface_of(material.node_tree)
            origin = None if ref is None else ref.origin()
            self._known[key] = origin is not None and origin.socket.is_output and origin.node.type == "HOLDOUT"
        return self._known[key]

    def cut_out(
        self, item: Visible, slots: Sequence[bpy.types.Material | None], index: Callable[[], np.ndarray | None]
    ) -> Visible:
        """`item`, a holdout where all its faces are; where some are, with a warning.

        Parameters
        ----------
        slots : its materials
        index : gives the slot of each polygon; None: all are of the first
        """
        if not any(map(self._is, slots)):
            return item
        numbers = index()
        used = [0] if numbers is None else np.unique(np.clip(numbers, 0, len(slots) - 1)).tolist()
        holes = [number for number in used if self._is(slots[number])]
        if len(holes) == len(used):
            return replace(item, visibility=replace(item.visibility, holdout=True, shadow_catcher=False))
        if holes and not item.visibility.holdout:
            names = ", ".join(f'"{material.name}"' for number in holes if (material := slots[number]) is not None)
            self._warn(
                f'"{item.object.name}": the Holdout {names} is on a part of its faces, which are black, not cut out. '
                "Separate them into an object of their own (P in Edit Mode)"
            )
        return item
