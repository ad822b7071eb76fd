"""Surfels that hang on the faces of a mesh (Algorithm 1 of the paper), with what of them is learned.

A centre is sum_k w_k v_k + d r n: its place on the face is fixed, its offset d along the face's normal in units of the
face's mean edge r is learned, as are opacity, shape and colour.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ...core.asset.model import Binding, Mesh
from ...deform.attach import attach
from ...deform.face_frames import Faces
from ..backend import CPU, LearningBackend
from .gaussians import Gaussians

#: Surfels are kept this far from 0 and 1 in opacity when they become logits.
_MARGIN = 0.01


class Attached(Gaussians):
    """Surfels on faces: ``offset`` (n,) takes the place of ``centre``.

    Parameters
    ----------
    parameters : dict of str to tensor
    base, normal : (n, 3) tensor
        Point on the face, and the face's unit normal; world space.
    edge : (n,) tensor
        Mean length of the face's edges; metres.
    fixed : tuple of str
        Names of parameters that are not learned.
    light : tensor, optional
    backend : LearningBackend
    """

    def __init__(
        self, parameters: dict[str, Tensor], base: Tensor, normal: Tensor, edge: Tensor, fixed: tuple[str, ...] = (),
        light: Tensor | None = None, backend: LearningBackend = CPU,
    ) -> None:  # fmt: skip
        super().__init__(parameters, light, backend)
        self.base, self.normal, self.edge, self.fixed = base, normal, edge, fixed
        for name in fixed:
            parameters[name].requires_grad_(False)

    def centres(self) -> Tensor:
        """(n, 3) world positions."""
        return self.base + (self.parameters["offset"] * self.edge)[:, None] * self.normal

    def like(self, parameters: dict[str, Tensor]) -> Attached:
        """The same faces with other parameters."""
        return Attached(parameters, self.base, self.normal, self.edge, self.fixed, self.light, self.backend)

    def on(self, backend: LearningBackend) -> Attached:
        """The same surfels with tensors on another backend's device."""
        parameters, light = self._tensors_on(backend)
        base, normal, edge = (t.to(backend.device) for t in (self.base, self.normal, self.edge))
        return Attached(parameters, base, normal, edge, self.fixed, light, backend)


def attach_learned(
    mesh: Mesh, pretrained: Gaussians, fixed: tuple[str, ...] = ()
) -> tuple[Attached, Binding, dict[str, Any]]:
    """Surfels on every face, that begin with opacity and colour of the pretrained ones near them.

    Parameters
    ----------
    mesh : Mesh
    pretrained : Gaussians
    fixed : tuple of str
        Parameters that stay as they begin: "offset", "opacity".

    Returns
    -------
    surfels : Attached
    binding : Binding
        At offset 0.
    report : dict
        Of `deform.attach.attach`.
    """
    learned = pretrained.surfels()
    faces = Faces.of(mesh.vertices, mesh.faces)
    # One surfel a face, as in the paper: faces are as large as voxels, only those twice as long are cut.
    extent = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    surfels, binding, report = attach(mesh, learned, density=extent / (2 * float(faces.mean_edge.mean())))
    _, near = cKDTree(learned.centre).query(surfels.centre, k=min(4, len(learned)))
    near = near.reshape(len(surfels), -1)
    weight = learned.opacity[near] + 1e-3
    weight /= weight.sum(1, keepdims=True)
    mean = lambda values: np.einsum("nk,nk...->n...", weight, values[near])  # noqa: E731
    raw = pretrained.arrays()
    opacity = np.clip(surfels.opacity, _MARGIN, 1 - _MARGIN)
    values = {
        "offset": np.zeros(len(surfels)),
        "scale": np.log(np.maximum(surfels.scale, 1e-9)),
        "rotation": surfels.rotation,
        "opacity": np.log(opacity / (1 - opacity)),
        **{name: mean(raw[name]) for name in ("sh", "tint", "blur")},
    }
    tensor = lambda a: torch.tensor(np.asarray(a), dtype=torch.float32)  # noqa: E731
    parameters = {k: tensor(v) for k, v in values.items()}
    attached = Attached(
        parameters, tensor(surfels.centre), tensor(faces.normal[binding.face]), tensor(faces.mean_edge[binding.face]),
        fixed, pretrained.light,
    )  # fmt: skip
    return attached, binding, report


def bound(binding: Binding, attached: Attached) -> Binding:
    """The binding with the offsets that were learned."""
    return replace(binding, offset=attached.parameters["offset"].detach().numpy().copy())
