"""Layers of the meshes of a scene: values at corners that textures refer to, and what normal and bump maps need.

Values stay where they are: compiled code reads them at their address.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...compute.jit import plain
from ...core.arrays import Array, frozen
from ...core.asset.model import as_float
from ...core.errors import UsageError
from ...core.frame import MeshState
from ..memory import AddressOf, address
from .detailed_normal import FACES, FRAME_INTS, MATRICES, NORMALS, TURNS, VERTICES
from .instances import Instances, normal_matrices
from .tangents import corner_tangents
from .trace_mesh import Part


class Placements(NamedTuple):
    """Where the meshes of a scene stand.

    Attributes
    ----------
    stands : sequence of Instances
        Of each mesh.
    matrices, turns : array
        (p, 3, 4) and (p, 3, 3) float32, of all that have several instances, and of their normals.
    first : int
        First source that is a mesh.
    """

    stands: Sequence[Instances]
    matrices: Array
    turns: Array
    first: int

    def of(self, part: Part) -> tuple[Array, Array]:
        """Matrices and turns of a part, read at row 0 where it is in world space."""
        if part.instanced:
            return self.matrices, self.turns
        matrix = self.stands[part.source - self.first].matrices[:1]
        return np.ascontiguousarray(matrix, np.float32), np.ascontiguousarray(normal_matrices(matrix), np.float32)


@dataclass(slots=True)
class _Values:
    """A layer made ready, or tangents, and what it was made of."""

    given: tuple[Array | None, ...]
    values: Array
    bad: int = 0

    def fits(self, given: tuple[Array | None, ...]) -> bool:
        """Whether this is still what `given` makes."""
        same = len(given) == len(self.given) and all(a is b for a, b in zip(given, self.given))
        return same and all(array is None or frozen(array) for array in given)


class MeshLayers:
    """Layers that the materials of a scene's meshes refer to.

    Attributes
    ----------
    warnings : list of str
        About values that are no numbers.
    """

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self._rows: dict[tuple[int, str, bool], int] = {}
        self._values: dict[tuple[int, str, bool], _Values] = {}
        self._first_face: dict[int, int] = {}
        self._frames: list[tuple[int, Part, Array, Array, Array]] = []

    def begin(self) -> None:
        """Forget which layers are referred to; what was made of them stays until the next `update`."""
        self._rows = {}

    def row(self, mesh: int, state: MeshState, name: str, tangents: bool) -> int | None:
        """Row of a layer in the table, or of the tangents of its coordinates; None where the mesh has no such layer."""
        values = _given(state, name)
        if values is None or (tangents and np.shape(values)[-1] != 2):
            return None
        return self._rows.setdefault((mesh, name, tangents), len(self._rows))

    def update(
        self, parts: dict[int, Part], meshes: Sequence[MeshState], detailed: Sequence[bool], placed: Placements
    ) -> None:
        """Bring all up to date.

        Parameters
        ----------
        parts : dict
            Of the meshes that are traced.
        meshes : sequence of MeshState
        detailed : sequence of bool
            Which of them have normal or bump maps.
        placed : Placements
        """
        known, self._values, self.warnings = self._values, {}, []
        for key in self._rows:
            mesh, name, tangents = key
            if mesh in parts:
                self._values[key] = self._made(meshes[mesh], parts[mesh], name, tangents, known.get(key))
        self._first_face = {mesh: part.face.start for mesh, part in parts.items()}
        self._frames = []
        for mesh, state in enumerate(meshes):
            if mesh not in parts or not detailed[mesh]:
                continue
            vertices = as_float(state.vertices, (-1, 3), f"vertices of {state.name}")
            self._frames.append((mesh, parts[mesh], vertices, *placed.of(parts[mesh])))

    def tables(self, first_face: int, address_of: AddressOf = address) -> tuple[Array, Array]:
        """Tables for compiled code.

        Parameters
        ----------
        first_face : int
            First face of the scene that is of a mesh.
        address_of : callable
            Where the arrays lie.

        Returns
        -------
        layers : (l, 2) int64 array
            Address of each layer's values, as if it were of all faces of meshes; numbers a corner, `WORDS` of
            tangents.
        frames : (meshes, FRAME_INTS) int64 array
            Of each mesh: addresses of the normals of its corners, as if of all rows of normals; of its vertices, object
            space; of its faces, as if of all faces of meshes; of matrices and of turns of normals.
        """
        layers = np.zeros((len(self._rows), 2), np.int64)
        for key, row in self._rows.items():
            if key in self._values:
                values = self._values[key].values
                width = values.shape[2]
                layers[row] = address_of(values) - 12 * width * (self._first_face[key[0]] - first_face), width
        frames = np.zeros((1 + max((frame[0] for frame in self._frames), default=0), FRAME_INTS), np.int64)
        for mesh, part, vertices, matrices, turns in self._frames:
            assert part.own_normals is not None
            frames[mesh, NORMALS] = address_of(part.own_normals) - 12 * part.row.start
            frames[mesh, VERTICES] = address_of(vertices)
            frames[mesh, FACES] = address_of(part.faces) - 12 * (part.face.start - first_face)
            frames[mesh, MATRICES], frames[mesh, TURNS] = address_of(matrices), address_of(turns)
        return layers, frames

    def _made(self, mesh: MeshState, part: Part, name: str, tangents: bool, known: _Values | None) -> _Values:
        given = _given(mesh, name)
        assert given is not None
        shape = (mesh.faces, mesh.vertices, mesh.corner_normals, mesh.vertex_normals) if tangents else ()
        made_of = (given, *shape)
        if known is None or not known.fits(made_of):
            count = np.shape(given)[-1] if np.ndim(given) == 3 else 0
            subject = f'values "{name}" of {mesh.name}' if name else f"texture coordinates of {mesh.name}"
            if count not in (2, 4):
                raise UsageError(subject, f"have shape {np.shape(given)}", "Give two or four numbers a corner")
            values = as_float(given, (len(part.faces), 3, count), subject)
            values, bad = finite(values)
            if tangents:
                assert part.own_normals is not None
                vertices = as_float(mesh.vertices, (-1, 3), f"vertices of {mesh.name}")
                values = corner_tangents(vertices, part.faces, part.own_normals, part.corner_rows, values)
            known = _Values(made_of, plain(values), bad)
        if known.bad:
            what = f'values "{name}"' if name else "texture coordinates"
            self.warnings.append(f"{mesh.name}: {known.bad} {what} are not finite; 0 is used")
        return known


def finite(values: Array) -> tuple[Array, int]:
    """`values` with 0 for each that is not finite, and how many these are."""
    with np.errstate(over="ignore", invalid="ignore"):
        bad = 0 if np.isfinite(values.sum()) else int(np.count_nonzero(~np.isfinite(values)))
    return (np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0), bad) if bad else (values, 0)


def _given(mesh: MeshState, name: str) -> Array | None:
    """Values of a layer as given; "" is for the mesh's own texture coordinates."""
    if not name:
        return mesh.uvs
    return next((layer.values for layer in mesh.layers if layer.name == name), None)
